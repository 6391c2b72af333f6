//! The tables and the page, of made-up results.

use std::path::PathBuf;
use std::time::Duration;

use super::page::render;
use super::tables::summary;
use super::*;
use crate::score::{PairErrors, RelationErrors};

fn found(name: &str, log: &str, container: Container) -> Found {
    Found {
        path: PathBuf::from(name),
        name: name.to_owned(),
        log: log.to_owned(),
        container,
        reference: None,
        relations: Vec::new(),
        same: Vec::new(),
    }
}

fn measured() -> Measured {
    Measured {
        scans: 756,
        skipped: 3,
        distance_m: 61.2,
        loops_closed: 2,
        took: Duration::from_millis(378),
        slam_bytes: 87 * 1024,
        reference: None,
        relations: None,
        firmness: None,
        figure: "<svg/>".into(),
    }
}

fn by_reference() -> ByReference {
    let walls = Walls { whole_m: 0.0417, pass_m: f64::NAN };
    ByReference {
        ate_rmse_m: Poses { dead_reckoning: 8.67, online: 0.26, in_final_map: f64::NAN },
        online_walls: walls,
        final_walls: walls,
        reference_walls: walls,
    }
}

fn by_relations(published: bool) -> ByRelations {
    let of = |trans_m: f64| RelationErrors {
        of: 1685,
        errors: PairErrors { n: 1600, trans_m, trans_std: 0.05, trans_med: 0.04, rot_deg: 0.6, rot_std: 0.7 },
    };
    let errors = Poses { dead_reckoning: of(6.5), online: of(0.0912), in_final_map: of(0.0475) };
    ByRelations { laser_m: 0.04, errors, published }
}

fn rows() -> Vec<Row> {
    let row = |found: Found, outcome: Result<Measured, String>| Row { found, outcome, remarks: Vec::new() };
    let csail = Measured { reference: Some(by_reference()), ..measured() };
    let both = Measured { relations: Some(by_relations(false)), ..csail.clone() };
    let bag = Measured { relations: Some(by_relations(true)), ..measured() };
    let mut rows = vec![
        row(found("csail.log", "csail", Container::Text), Ok(csail)),
        row(found("fr079.log", "fr079", Container::Text), Ok(both)),
        row(found("fr079.bag", "fr079", Container::Bag), Ok(bag)),
        row(found("lab.dat", "lab", Container::Text), Ok(Measured { took: Duration::ZERO, ..measured() })),
        row(found("bad.log", "bad", Container::Text), Err("bad.log: line 3: the record is truncated".into())),
    ];
    rows[3].remarks.push("all stamps are zero".into());
    rows
}

#[test]
fn the_table_has_each_log_the_others_figures_and_no_nan() {
    let table = summary(&rows()).to_string();
    for word in ["csail.log", "fr079.bag", "lab.dat", "not replayed: bad.log: line", "2000"] {
        assert!(table.contains(word), "{word}\n{table}");
    }
    assert!(table.contains("0.0452 ± 0.0354 Cartographer"), "{table}");
    assert_eq!(
        table.matches("0.0452 ± 0.0354 Cartographer").count(),
        1,
        "not beside odometry made up\n{table}"
    );
    assert!(table.contains("9.19 KISS-ICP + odometry"), "{table}");
    assert!(!table.contains("NaN") && !table.contains("inf"), "{table}");
    let widest = table.lines().map(|line| line.chars().count()).max().unwrap();
    assert!(widest < 160, "{widest} columns\n{table}");
}

#[test]
fn the_page_has_tables_pictures_sources_and_no_nan() {
    let page = render(&rows(), "the command", &Noise::NONE, "images");
    for word in [
        "```sh\nthe command\n```",
        "| lineslam, online",
        "| Cartographer [3]",
        "| GMapping, 30 particles, final [1]",
        "- bad.log: not replayed: bad.log: line 3",
        "- lab.dat: all stamps are zero",
        "](images/benchmark_csail.svg)",
        "](images/benchmark_fr079_bag.svg)",
        "aces with relations",
        "git clone https://github.com/INESCTEC/ricoslam",
        "0.0475 ± 0.0500",
    ] {
        assert!(page.contains(word), "{word}\n{page}");
    }
    assert!(!page.contains("benchmark_bad.svg"), "no picture of what was not replayed");
    assert!(!page.contains("NaN") && !page.contains("inf "), "{page}");
    assert!(!page.contains("BreezySLAM RMHC [1] | –"), "figures that are there stand there");
}

#[test]
fn without_references_the_page_has_no_empty_tables() {
    let rows = &rows()[3..];
    let page = render(rows, "the command", &Noise::NONE, "images");
    for heading in ["## Absolute", "## Relations", "## How thick"] {
        assert!(!page.contains(heading), "{page}");
    }
    assert!(page.contains("csail with reference") && page.contains("hospital with relations"), "{page}");
}

#[test]
fn figures_with_noise_stand_on_the_page_where_they_were_asked_for_and_otherwise_how_to_ask() {
    let page = render(&rows(), "the command", &Noise::NONE, "images");
    assert!(
        page.contains("## How firmly the figures stand\n\nNot tried")
            && page.contains("the command --runs 20\n")
    );
    assert!(super::tables::firm_summary(&rows()).is_none());
    let mut rows = rows();
    let firmness = Firmness { measure: "ATE, m", plain_m: 0.2601, median_m: 0.2702, worst_m: 1.5003 };
    rows[0].outcome.as_mut().unwrap().firmness = Some(firmness);
    let noise = Noise { runs: 20, sigma_m: 0.005 };
    let page = render(&rows, "the command", &noise, "images");
    assert!(page.contains("20 times more, with Gaussian noise of 5 mm"), "{page}");
    let line = page.lines().find(|line| line.contains("1.500")).unwrap();
    let cells: Vec<&str> = line.split('|').map(str::trim).collect();
    assert_eq!(cells[1..6], ["csail.log", "ATE, m", "0.260", "0.270", "1.500"]);
    assert!(super::tables::firm_summary(&rows).unwrap().to_string().contains("1.500"));
}
