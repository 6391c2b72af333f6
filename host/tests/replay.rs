//! `lineslam replay` as a user runs it: what it writes, and what it says about bad input.

use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use flate2::Compression;
use flate2::write::GzEncoder;
use tempfile::TempDir;

/// A folder with logs in it, and the folder the command writes to.
struct Bench {
    folder: TempDir,
}

impl Bench {
    fn new() -> Self {
        Self { folder: tempfile::tempdir().unwrap() }
    }

    fn file(&self, name: &str, content: impl AsRef<[u8]>) -> PathBuf {
        let path = self.folder.path().join(name);
        std::fs::write(&path, content).unwrap();
        path
    }

    fn out(&self) -> PathBuf {
        self.folder.path().join("out")
    }

    fn replay(&self, log: &Path, more: &[&str]) -> Output {
        Command::new(env!("CARGO_BIN_EXE_lineslam"))
            .arg("replay")
            .arg(log)
            .arg("--out")
            .arg(self.out())
            .args(more)
            .output()
            .unwrap()
    }

    /// The command must fail with code 2, name the file and say all of `words`, and must not have written anything.
    fn refuses(&self, log: &Path, more: &[&str], words: &[&str]) {
        let output = self.replay(log, more);
        let said = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{said}");
        for word in words {
            assert!(said.contains(word), "'{word}' is not in: {said}");
        }
        assert!(output.stdout.is_empty());
        assert!(!self.out().exists(), "something was written");
    }

    fn report(&self) -> serde_json::Value {
        serde_json::from_slice(&std::fs::read(self.out().join("report.json")).unwrap()).unwrap()
    }

    fn lines(&self, name: &str) -> Vec<String> {
        std::fs::read_to_string(self.out().join(name)).unwrap().lines().map(str::to_owned).collect()
    }
}

/// A name, what is done to the lines of a good log, and what must be said of it.
type Spoilt = (&'static str, fn(&mut Vec<String>), &'static [&'static str]);

/// Range to the walls of a room of 8 m by 6 m, from (x, 0) along a bearing.
fn room(x: f64, bearing: f64) -> f64 {
    // Never quite along a wall.
    let (s, c) = (bearing + 1e-9).sin_cos();
    let along_x = if c > 0.0 { (5.0 - x) / c } else { (-3.0 - x) / c };
    let along_y = if s > 0.0 { 2.5 / s } else { -3.5 / s };
    along_x.min(along_y)
}

/// A robot with a SICK scanner drives 0.1 m a scan along x.
fn flaser(k: usize) -> String {
    let x = 0.1 * k as f64;
    let ranges: Vec<String> =
        (0..181).map(|i| format!("{:.2}", room(x, f64::from(i - 90).to_radians()))).collect();
    let t = 100.5 + 0.2 * k as f64;
    format!("FLASER 181 {} {x} 0 0 {x} 0 0 {t} host {t}", ranges.join(" "))
}

fn carmen_log(scans: usize) -> Vec<String> {
    let mut lines = vec!["# a comment".to_owned(), "PARAM robot_width 0.4 nohost 0".to_owned()];
    lines.extend((0..scans).map(flaser));
    lines
}

/// The same drive as the mines rover records it: ticks of both wheels, 682 ranges in millimetres.
fn mines_line(k: usize) -> String {
    let x = 0.02 * k as f64;
    let ticks = (x / (2.0 * std::f64::consts::PI * 0.077) * 2000.0).round() as i64;
    let mut words = vec![(200_000_000 + 100_000 * k).to_string(), "0".into(), (500 + ticks).to_string()];
    words.push((700 + ticks).to_string());
    words.extend((4..24).map(|_| "0".to_owned()));
    // The scan on a line is older than its ticks.
    let scan_x = (x - 0.03).max(0.0);
    for beam in 0..682 {
        let range = room(scan_x + 0.145, (f64::from(beam) - 340.5) * std::f64::consts::PI / 512.0);
        words.push(if range < 5.0 { format!("{:.0}", range * 1000.0) } else { "0".into() });
    }
    words.push("0".into());
    words.join(" ")
}

fn gzip(text: &str) -> Vec<u8> {
    let mut encoder = GzEncoder::new(Vec::new(), Compression::fast());
    encoder.write_all(text.as_bytes()).unwrap();
    encoder.finish().unwrap()
}

#[test]
fn writes_every_file_for_a_carmen_log() {
    let bench = Bench::new();
    let log = bench.file("room.log", carmen_log(12).join("\n"));
    let output = bench.replay(&log, &[]);
    assert!(output.status.success(), "{output:?}");
    assert!(output.stderr.is_empty(), "a pipe gets no progress bar");
    let summary = String::from_utf8_lossy(&output.stdout);
    assert!(summary.contains("scans used  12"), "{summary}");

    let mut names: Vec<String> = std::fs::read_dir(bench.out())
        .unwrap()
        .map(|entry| entry.unwrap().file_name().into_string().unwrap())
        .collect();
    names.sort();
    let expected =
        ["map.csv", "map.pgm", "map.svg", "map.yaml", "odometry.tum", "report.json", "trajectory.tum"];
    assert_eq!(names, expected);

    let trajectory = bench.lines("trajectory.tum");
    assert_eq!(trajectory.len(), 12);
    assert!(trajectory[0].starts_with("100.500000 0.0"), "stamped as in the log: {}", trajectory[0]);
    let last: Vec<f64> = trajectory[11].split(' ').map(|w| w.parse().unwrap()).collect();
    assert!(
        (last[0] - 102.7).abs() < 1e-9 && (last[1] - 1.1).abs() < 0.02 && last[2].abs() < 0.02,
        "{last:?}"
    );
    assert_eq!(bench.lines("odometry.tum").len(), 12);

    let map = bench.lines("map.csv");
    assert_eq!(map[0], "x1_m,y1_m,x2_m,y2_m,inliers");
    assert_eq!(map.len() - 1, 3, "the room ahead of the scanner has three walls: {map:?}");
    assert!(bench.lines("map.svg")[0].starts_with("<svg"));

    let report = bench.report();
    assert_eq!(report["scans_used"], 12);
    assert_eq!(report["segments"], 3);
    assert_eq!(report["robot"], "sick");
    assert!((report["distance_m"].as_f64().unwrap() - 1.1).abs() < 1e-3);
    assert!((report["duration_s"].as_f64().unwrap() - 2.2).abs() < 1e-9);
    assert!(report["scan_us"]["median"].as_f64().unwrap() > 0.0);
    assert!(report["slam_bytes"].as_u64().unwrap() > 0);
    assert_eq!(report["config"]["sensor"]["geometry"]["steps_per_revolution"], 360.0);
}

#[test]
fn grid_is_what_map_server_reads() {
    let bench = Bench::new();
    bench.replay(&bench.file("room.log", carmen_log(12).join("\n")), &[]);
    let pgm = std::fs::read(bench.out().join("map.pgm")).unwrap();
    let header: Vec<&str> = std::str::from_utf8(&pgm[..15]).unwrap().split_whitespace().collect();
    assert_eq!(header[0], "P5");
    let (width, height): (usize, usize) = (header[1].parse().unwrap(), header[2].parse().unwrap());
    let pixels = &pgm[pgm.len() - width * height..];
    let yaml = std::fs::read_to_string(bench.out().join("map.yaml")).unwrap();
    let origin: Vec<f64> = yaml
        .lines()
        .find_map(|l| l.strip_prefix("origin: "))
        .unwrap()
        .trim_matches(['[', ']'])
        .split(", ")
        .map(|w| w.parse().unwrap())
        .collect();
    let at = |x: f64, y: f64| {
        let (column, row) = ((x - origin[0]) / 0.05, (y - origin[1]) / 0.05);
        pixels[(height - 1 - row as usize) * width + column as usize]
    };
    assert_eq!(at(2.0, 0.0), 254, "free in the middle");
    assert_eq!(at(5.02, 0.0), 0, "occupied at the wall ahead");
    assert_eq!(at(3.0, 2.52), 0, "occupied at the wall on the left");
    assert_eq!(pixels[0], 205, "unknown outside the walls");
}

#[test]
fn mines_logs_are_found_out_and_may_be_gzipped() {
    let text = (0..20).map(mines_line).collect::<Vec<_>>().join("\n");
    for (name, content) in [("exp.dat", text.clone().into_bytes()), ("exp.dat.gz", gzip(&text))] {
        let bench = Bench::new();
        let output = bench.replay(&bench.file(name, content), &[]);
        assert!(output.status.success(), "{output:?}");
        assert_eq!(bench.report()["format"], "mines");
        assert_eq!(bench.report()["robot"], "mines");
        // The pose is that of the scan, one and a half lines before the ticks beside it.
        let last: Vec<f64> =
            bench.lines("trajectory.tum")[19].split(' ').map(|w| w.parse().unwrap()).collect();
        assert!((last[0] - 201.9).abs() < 1e-9);
        assert!((last[1] - (0.38 - 0.03)).abs() < 0.01, "{last:?}");
    }
}

#[test]
fn robot_laser_records_bring_their_own_geometry() {
    // 121 beams over 120°, the scanner 0.2 m ahead; odometry in a frame turned by 90°.
    let record = |k: usize| {
        let x = 0.1 * k as f64;
        let ranges: Vec<String> =
            (0..121).map(|i| format!("{:.3}", room(x + 0.2, f64::from(i - 60).to_radians()))).collect();
        let (start, fov, step) = (-60f64.to_radians(), 120f64.to_radians(), 1f64.to_radians());
        let quarter = std::f64::consts::FRAC_PI_2;
        let t = 10.0 + k as f64;
        format!(
            "ROBOTLASER1 0 {start} {fov} {step} 30 0.01 0 121 {} 2 7 8 0 {} {quarter} 0 {x} {quarter} 0.1 0 1 1 0 {t} host {t}",
            ranges.join(" "),
            x + 0.2
        )
    };
    let odom =
        |k: usize| format!("ODOM 0 {} 1.5707963 0.1 0 0 {} host 0", 0.1 * k as f64 - 0.05, 9.5 + k as f64);
    let text = (0..10).map(|k| format!("{}\n{}", odom(k), record(k))).collect::<Vec<_>>().join("\n");
    let bench = Bench::new();
    let output = bench.replay(&bench.file("campus.log", text), &[]);
    assert!(output.status.success(), "{output:?}");
    let last: Vec<f64> = bench.lines("trajectory.tum")[9].split(' ').map(|w| w.parse().unwrap()).collect();
    assert!((last[1] - 0.9).abs() < 0.02 && last[2].abs() < 0.02, "{last:?}");
    let map = bench.lines("map.csv");
    let ahead = map.iter().skip(1).any(|l| {
        let v: Vec<f64> = l.split(',').map(|w| w.parse().unwrap()).collect();
        (v[0] - 5.0).abs() < 0.02 && (v[2] - 5.0).abs() < 0.02
    });
    assert!(ahead, "the wall 5 m ahead of the axle is there: {map:?}");
}

#[test]
fn both_configurations_run() {
    let bench = Bench::new();
    let log = bench.file("room.log", carmen_log(12).join("\n"));
    assert!(bench.replay(&log, &["--config", "paper"]).status.success());
    assert_eq!(bench.report()["configuration"], "paper");
    assert!(bench.report()["config"]["extraction"]["ransac"].is_object());
}

#[test]
fn bad_records_name_file_and_line() {
    let cases: [Spoilt; 6] = [
        ("truncated", |l| l[5].truncate(200), &["line 6", "truncated"]),
        (
            "text",
            |l| l[5] = l[5].replacen("3.00", "three", 1).replacen(" 2.5", " two", 1),
            &["line 6", "range", "not a number"],
        ),
        (
            "beams",
            |l| l[5] = l[5].replacen("FLASER 181 ", "FLASER 182 1.00 ", 1),
            &["line 6", "182 beams instead of 181"],
        ),
        ("backwards", |l| l.swap(5, 6), &["line 7", "time runs backwards", "101.100000", "101.300000"]),
        (
            "nan",
            |l| l[5] = l[5].replacen(" 181 ", " 181 NaN ", 1).replacen(" 0 0 101", " 0 101", 1),
            &["line 6", "NaN"],
        ),
        ("stamp", |l| l[5] = l[5].replace(" 101.1 host", " -4 host"), &["line 6", "time stamp", "-4"]),
    ];
    for (name, spoil, words) in cases {
        let bench = Bench::new();
        let mut lines = carmen_log(12);
        spoil(&mut lines);
        let log = bench.file(name, lines.join("\n"));
        bench.refuses(&log, &[], &[words, &[name]].concat());
    }
}

#[test]
fn bad_mines_records_name_file_and_line() {
    let cases: [Spoilt; 4] = [
        ("truncated", |l| l[3].truncate(1500), &["line 4", "truncated"]),
        ("text", |l| l[3] = l[3].replacen("200300000", "noon", 1), &["line 4", "time", "noon"]),
        ("backwards", |l| l.swap(3, 4), &["line 5", "time runs backwards"]),
        ("long", |l| l[3].push_str(" 1 2 3"), &["line 4", "710 words"]),
    ];
    for (name, spoil, words) in cases {
        let bench = Bench::new();
        let mut lines: Vec<String> = (0..8).map(mines_line).collect();
        spoil(&mut lines);
        let log = bench.file(name, lines.join("\n"));
        bench.refuses(&log, &[], &[words, &[name]].concat());
    }
}

#[test]
fn files_that_are_no_log_are_named() {
    let bench = Bench::new();
    bench.refuses(&bench.file("empty.log", ""), &[], &["empty.log", "without a single scan"]);
    bench.refuses(
        &bench.file("odom.log", "ODOM 0 0 0 0 0 0 1 host 1\n"),
        &[],
        &["odom.log", "line 1", "without a single scan"],
    );
    bench.refuses(&bench.file("plain.log.gz", carmen_log(3).join("\n")), &[], &["plain.log.gz", "not gzip"]);
    bench.refuses(
        &bench.file("note.txt", "dear diary\n"),
        &[],
        &["note.txt", "line 1", "neither", "dear diary"],
    );
    bench.refuses(
        &bench.file("bytes.log", [0xff, 0xfe, 0x00, 0x0a]),
        &[],
        &["bytes.log", "line 1", "not text"],
    );
    bench.refuses(&bench.folder.path().join("absent.log"), &[], &["absent.log", "No such file"]);
    bench.refuses(bench.folder.path(), &[], &["Is a directory"]);
    let mut cut = gzip(&carmen_log(400).join("\n"));
    cut.truncate(cut.len() / 2);
    bench.refuses(&bench.file("cut.log.gz", cut), &[], &["cut.log.gz", "line "]);
    let carmen = bench.file("room.log", carmen_log(3).join("\n"));
    bench.refuses(&carmen, &["--format", "mines"], &["room.log", "neither"]);
    let mines = bench.file("exp.dat", (0..3).map(mines_line).collect::<Vec<_>>().join("\n"));
    bench.refuses(&mines, &["--format", "carmen"], &["exp.dat", "line 1"]);
}

#[test]
fn lenient_reading_skips_and_counts() {
    let bench = Bench::new();
    let mut lines = carmen_log(12);
    lines[4].truncate(100);
    lines[6] = lines[6].replacen("FLASER 181", "FLASER many", 1);
    lines.insert(9, lines[3].clone());
    lines.push("FLASER 3 1 1 1 0 0 0 0 0 0 999 host 999".into());
    let log = bench.file("spoilt.log", lines.join("\n"));
    bench.refuses(&log, &[], &["line 5"]);
    let output = bench.replay(&log, &["--lenient"]);
    assert!(output.status.success(), "{output:?}");
    let report = bench.report();
    assert_eq!(report["scans_used"], 10);
    let expected = serde_json::json!({
        "truncated": 1, "not_a_number": 1, "time_not_increasing": 1, "wrong_beam_count": 1
    });
    assert_eq!(report["records_skipped"], expected);
    assert!(String::from_utf8_lossy(&output.stdout).contains("1 truncated"));
}

#[test]
fn lenient_reading_uses_a_log_that_was_cut_off() {
    let bench = Bench::new();
    let mut cut = gzip(&carmen_log(400).join("\n"));
    cut.truncate(cut.len() / 2);
    let output = bench.replay(&bench.file("cut.log.gz", cut), &["--lenient"]);
    assert!(output.status.success(), "{output:?}");
    assert!(bench.report()["scans_used"].as_u64().unwrap() > 50);
    assert_eq!(bench.report()["records_skipped"]["cut_off"], 1);
}

#[test]
fn robot_files_are_checked_key_by_key() {
    let good = include_str!("../../robots/mines.toml");
    let cases: [(&str, &str, &[&str]); 12] = [
        ("track_m = 0.308", "track_m = 0.308\ntrak_m = 1", &["trak_m"]),
        ("track_m = 0.308\n", "", &["track_m", "missing"]),
        ("track_m = 0.308", "track_m = -0.3", &["wheels.track_m", "-0.3"]),
        ("track_m = 0.308", "track_m = \"wide\"", &["track_m", "string"]),
        ("counter_bits = 32", "counter_bits = 24", &["wheels.counter_bits", "24"]),
        ("max_range_mm = 5600", "max_range_mm = 10", &["sensor.max_range_mm", "10"]),
        ("max_range_mm = 5600", "max_range_mm = 70000", &["sensor.max_range_mm", "70000"]),
        ("[[0, 0], [6, 6]]", "[[6, 0]]", &["sensor.no_echo_mm", "[6, 0]"]),
        ("last = 725", "last = 20", &["sensor.steps.last", "20"]),
        ("used = [114, 655]", "used = [10, 655]", &["sensor.steps.used"]),
        ("scan_delay_s = 0.15", "scan_delay_s = nan", &["sensor.scan_delay_s", "NaN"]),
        ("[sensor.steps]", "[sensor.field]\nof_view_deg = 180.0\n[sensor.steps]", &["either"]),
    ];
    let bench = Bench::new();
    let log = bench.file("exp.dat", (0..3).map(mines_line).collect::<Vec<_>>().join("\n"));
    for (from, to, words) in cases {
        assert!(good.contains(from), "{from} is not in the robot file");
        let robot = bench.file("robot.toml", good.replacen(from, to, 1));
        let robot = robot.to_str().unwrap();
        bench.refuses(&log, &["--robot", robot], &[words, &["robot.toml"]].concat());
    }
    bench.refuses(&log, &["--robot", "nowhere.toml"], &["nowhere.toml"]);
    let sick = concat!(env!("CARGO_MANIFEST_DIR"), "/../robots/sick.toml");
    bench.refuses(&log, &["--robot", sick], &["'sick'", "[wheels]"]);
    let carmen = bench.file("room.log", carmen_log(3).join("\n"));
    let mines = concat!(env!("CARGO_MANIFEST_DIR"), "/../robots/mines.toml");
    bench.refuses(&carmen, &["--robot", mines], &["room.log", "line 3", "181 beams instead of 682"]);
}

#[test]
fn every_robot_file_is_good() {
    for entry in std::fs::read_dir(concat!(env!("CARGO_MANIFEST_DIR"), "/../robots")).unwrap() {
        let path = entry.unwrap().path();
        lineslam::robot::Robot::load(&path).unwrap_or_else(|e| panic!("{e}"));
    }
}

#[test]
fn results_are_written_whole_or_not_at_all() {
    let bench = Bench::new();
    let log = bench.file("room.log", carmen_log(3).join("\n"));
    std::fs::create_dir_all(bench.out().join("map.svg")).unwrap();
    let output = bench.replay(&log, &[]);
    assert_eq!(output.status.code(), Some(1));
    assert!(String::from_utf8_lossy(&output.stderr).contains("map.svg"), "{output:?}");
    assert_eq!(std::fs::read_dir(bench.out()).unwrap().count(), 1, "nothing but the obstacle");
}

#[test]
fn a_wrong_command_line_is_explained() {
    let output = Command::new(env!("CARGO_BIN_EXE_lineslam"))
        .args(["replay", "x", "--config", "best"])
        .output()
        .unwrap();
    assert_eq!(output.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&output.stderr).contains("best"));
}
