//! The page: tables, pictures, and what the reader needs to know of them.

use std::fmt::Write;

use super::published::{Measure, PUBLISHED, SOURCES};
use super::tables::{cost_table, firm_table, relation_tables, trajectory_table, walls_table};
use super::{Found, Noise, PASS_M, Row};

/// Name of a log's picture.
pub fn image(found: &Found) -> String {
    format!("benchmark_{}.svg", found.slug())
}

/// Logs of the benchmark that are not among the rows.
fn absent(rows: &[Row]) -> Vec<String> {
    let exp3 = rows.iter().any(|row| row.found.log == "exp3" && row.by_reference().is_some());
    // It has a reference, though there are no figures of others.
    let mut absent: Vec<String> = if exp3 { Vec::new() } else { vec!["exp3 with reference".into()] };
    for p in PUBLISHED {
        let (name, there) = match p.measure {
            Measure::Relations => {
                let there = |row: &Row| row.by_relations().is_some_and(|r| r.published);
                (format!("{} with relations", p.log), rows.iter().any(|r| r.found.log == p.log && there(r)))
            }
            Measure::Trajectory => {
                let there = |row: &Row| row.by_reference().is_some();
                (format!("{} with reference", p.log), rows.iter().any(|r| r.found.log == p.log && there(r)))
            }
            _ => continue,
        };
        if !there && !absent.contains(&name) {
            absent.push(name);
        }
    }
    absent
}

/// The page. `command` is what the reader types for it, `noise` how it replayed logs again, `images` the pictures' folder as seen
/// from the page.
pub fn render(rows: &[Row], command: &str, noise: &Noise, images: &str) -> String {
    let mut page = String::new();
    let mut say = |text: &str| {
        // Writing to a String cannot fail.
        let _ = writeln!(page, "{text}\n");
    };
    say("# Benchmark");
    say(
        "Recorded logs that others use too, replayed by the default configuration with one set of constants, beside what others\n\
         publish. The robot file is the usual one of the log's format; none is tuned to a log.",
    );
    say(&format!("All of this page, pictures included, is written by\n\n```sh\n{command}\n```"));
    say(
        "`LOGS` is a folder in which the logs are looked for by name, with the folders below it. Ours are measured by that command;\n\
         the others' figures are quoted, with the [source](#sources) in brackets.",
    );
    let absent = absent(rows);
    if !absent.is_empty() {
        say(&format!("Left out, because the folder does not have them: {}.", absent.join(", ")));
    }
    if let Some(table) = trajectory_table(rows) {
        say("## Absolute trajectory error");
        say("Root mean square distance from the reference, metres, after one SE(2) alignment:");
        say(&table.to_string());
        say(TRAJECTORY);
    }
    if let Some([metres, degrees, used]) = relation_tables(rows) {
        say("## Relations checked by hand");
        say("Translational error of Kümmerle's relations, mean ± standard deviation, metres:");
        say(&metres.to_string());
        say("Rotational error, degrees:");
        say(&degrees.to_string());
        say("What was used:");
        say(&used.to_string());
        say(RELATIONS);
    }
    firmness(rows, command, noise, &mut say);
    say("## What it took");
    say(&cost_table(rows).to_string());
    say(COST);
    let remarks: Vec<String> = reasons(rows).chain(remarks(rows)).collect();
    if !remarks.is_empty() {
        say(&remarks.join("\n"));
    }
    if trajectory_table(rows).is_some() {
        say("## How thick the walls are");
        say(&walls_table(rows).to_string());
        say(&format!(
            "Metres: the standard deviation of the points within 0.3 m of a point, across their wall, median over all points, when each\n\
             scan is laid where its pose says. Within {PASS_M} m of way nothing is come back to."
        ));
    }
    say("## Maps");
    say(
        "The final map (dark blue) and the path in it (red); the reference (green) is laid on where there is one.",
    );
    for row in rows.iter().filter(|r| r.outcome.is_ok()) {
        say(&format!("![Map of {}]({images}/{})", row.found.name, image(&row.found)));
    }
    say("## Where the logs are");
    say(DATA);
    say("## Sources");
    let sources: Vec<String> =
        SOURCES.iter().enumerate().map(|(k, (_, text))| format!("{}. {text}.", k + 1)).collect();
    say(&sources.join("\n"));
    page.truncate(page.trim_end().len());
    page.push('\n');
    page
}

/// What becomes of the figures with noise, or how to find out.
fn firmness(rows: &[Row], command: &str, noise: &Noise, say: &mut impl FnMut(&str)) {
    say("## How firmly the figures stand");
    if noise.runs == 0 {
        say(&format!("Not tried for this page. {FIRMNESS} This command does, 20 times a log:"));
        say(&format!("```sh\n{command} --runs 20\n```"));
        return;
    }
    let (runs, mm) = (noise.runs, 1e3 * noise.sigma_m);
    say(&format!(
        "Each log was replayed {runs} times more, with Gaussian noise of {mm} mm on every range (seeds 1 to {runs}). {FIRMNESS}"
    ));
    match firm_table(rows) {
        Some(table) => say(&table.to_string()),
        None => say("No log has a reference or relations, and so none has a figure."),
    }
    say(&format!("```sh\n{command}\n```"));
}

/// What the reader should know of the logs, a line each.
pub fn remarks(rows: &[Row]) -> Vec<String> {
    let of = |row: &Row| row.remarks.iter().map(|text| line(row, text)).collect::<Vec<String>>();
    rows.iter().flat_map(of).collect()
}

/// Why logs gave nothing, a line each.
fn reasons(rows: &[Row]) -> impl Iterator<Item = String> {
    rows.iter().filter_map(|row| {
        let reason = row.outcome.as_ref().err()?;
        Some(line(row, &format!("not replayed: {reason}")))
    })
}

fn line(row: &Row, text: &str) -> String {
    format!("- {}: {text}", row.found.name)
}

const TRAJECTORY: &str = "\
*online* is the pose as the robot knew it when the scan was taken; *final* is the same pose in the final map, after loops
closed later have moved it. *dead reckoning* is the wheels alone, with the robot file's wheels and track; what others have for
exp1 is with the track's nominal width. The references of exp1 and exp3 are pseudo references, good to about 0.15 m; those of the
SICK logs were corrected by GMapping and carry 3 to 8 cm of their own error. The odometry of fr079.log, fr101 and seattle is made from
the reference, with noise and systematic errors from a fixed seed.";

const RELATIONS: &str = "\
A relation says where the robot was at one instant as seen from another; people have checked each by hand. The error is the
distance between that and what the trajectory says, linear between its poses. The relations of fr079 are those of the laser, so
the poses are moved to where the log says that it sits. Others' figures are of final, corrected trajectories, so *final* is what
compares with them. None stands beside a log whose odometry was made for it.";

const FIRMNESS: &str = "\
A figure of one drive is one draw: noise less than the scanner's own\nshows how much of it is chance. The error is online, metres: the mean of the relations where there are any, else the absolute\n\
trajectory error.";

const COST: &str = "\
*scans used* is what the core took in, *records skipped* what the reader passed over or could not use. *loops closed* counts
corrections by a place seen again after a way. *scans a second* is the number of scans by the time that the core took for them, on one
core of a PC, one log at a time; reading and drawing are not in it. *RAM of the core* is all that it has: map of 1024 segments, 256 places, scan,
buffers. It does not grow.";

const DATA: &str = "\
They belong to others and are not part of this project. As people publish them:

```sh
mkdir LOGS && cd LOGS
git clone https://github.com/INESCTEC/ricoslam
git clone https://github.com/simondlevy/BreezySLAM
git clone https://github.com/OpenSLAM-org/openslam_tinyslam
git clone https://github.com/acschaefer/ple
git clone https://github.com/xiaofeng419/SLAM-2D-LIDAR-SCAN
```

| repository | folder | what |
|---|---|---|
| INESCTEC/ricoslam | `inesctec_mrdt_slam_2d_datasets/` | bags of Kümmerle's logs, with the odometry of the robots: aces, fr079, intel, mit-csail, mit-killian (its stamps are made up), hospital (fr-clinic), the last with its relations |
| simondlevy/BreezySLAM | `examples/` | exp1, exp2: URG-04LX and wheel ticks, recorded at Mines ParisTech |
| OpenSLAM-org/openslam_tinyslam | `test/` | exp3 and others of the same rover |
| acschaefer/ple | `data/carmen/` | CARMEN logs of the Radish repository, recorded by C. Stachniss, D. Hähnel and others |
| xiaofeng419/SLAM-2D-LIDAR-SCAN | `DataSet/` | csail; relations of fr079, intel and mit-killian |

and the command above. Where relations are not in these, they are at
<http://ais.informatik.uni-freiburg.de/slamevaluation/datasets.php>; put NAME.relations beside the log or anywhere in `LOGS`. A
trajectory NAME.ref.tum beside a log is its reference. Of several conversions of a log in a folder one is replayed. A log that is not in
the tables above is replayed as well.";
