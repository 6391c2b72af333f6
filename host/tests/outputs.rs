//! What every run leaves behind, as `lineslam simulate` writes it.

use std::collections::BTreeMap;
use std::io::Cursor;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use dxf::entities::EntityType;
use lineslam::log::{Log, LoggedScan, Odometry};
use lineslam::output::grid::{FREE, Grid, OCCUPIED, UNKNOWN};
use lineslam::output::{csv, dxf as drawing};
use lineslam::replay;
use lineslam::robot::Robot;
use nalgebra::{Isometry2, Point2, Vector2};
use slam_core::{MapSegment, SlamConfig};

fn simulate(out: &Path, more: &[&str]) -> Output {
    let world = Path::new(env!("CARGO_MANIFEST_DIR")).join("../worlds/hall_quarter.toml");
    Command::new(env!("CARGO_BIN_EXE_lineslam"))
        .arg("simulate")
        .arg(world)
        .arg("--out")
        .arg(out)
        .args(more)
        .output()
        .unwrap()
}

fn names(folder: &Path) -> Vec<String> {
    let entries = std::fs::read_dir(folder).unwrap();
    let mut names: Vec<String> = entries.map(|e| e.unwrap().file_name().into_string().unwrap()).collect();
    names.sort();
    names
}

fn numbers(line: &str, separator: char) -> Vec<f64> {
    line.split(separator).filter_map(|word| word.parse().ok()).collect()
}

#[test]
fn a_run_writes_every_file_and_the_recording_where_it_is_asked_for() {
    let folder = tempfile::tempdir().unwrap();
    let (out, recording) = (folder.path().join("out"), folder.path().join("elsewhere/run.mcap"));
    let output = simulate(&out, &["--mcap", recording.to_str().unwrap()]);
    assert!(output.status.success(), "{output:?}");
    let expected = [
        "log.jsonl",
        "map.csv",
        "map.dxf",
        "map.json",
        "map.pgm",
        "map.svg",
        "map.yaml",
        "odometry.tum",
        "report.json",
        "trajectory.csv",
        "trajectory.tum",
        "trajectory_final.tum",
        "truth.tum",
    ];
    assert_eq!(names(&out), expected);
    assert_eq!(names(recording.parent().unwrap()), ["run.mcap"]);
    let text = |name: &str| std::fs::read_to_string(out.join(name)).unwrap();
    assert!(text("map.yaml").contains("\nmode: trinary\n"));

    let scans = text("trajectory.tum").lines().count();
    assert_eq!(text("trajectory_final.tum").lines().count(), scans);
    let table = text("trajectory.csv");
    let header = "stamp_s,x_m,y_m,theta_rad,cov_xx_m2,cov_xy_m2,cov_xt_m_rad,cov_yy_m2,cov_yt_m_rad,cov_tt_rad2,\
                  state,fixed,odometry,support,residual_m";
    assert_eq!(table.lines().next(), Some(header));
    assert_eq!(table.lines().count(), scans + 1);
    let (mut states, mut fixed) = (BTreeMap::<&str, usize>::new(), BTreeMap::<&str, usize>::new());
    for (row, pose) in table.lines().skip(1).zip(text("trajectory.tum").lines()) {
        let words: Vec<&str> = row.split(',').collect();
        *states.entry(words[10]).or_default() += 1;
        *fixed.entry(words[11]).or_default() += 1;
        assert!(["used", "left_out", "useless"].contains(&words[12]), "{row}");
        let (row, pose) = (numbers(row, ','), numbers(pose, ' '));
        assert_eq!(row.len(), 12, "every number is one");
        assert!((0..3).all(|k| (row[k] - pose[k]).abs() < 1e-6), "{row:?} {pose:?}");
        assert!(row[4] > 0.0 && row[7] > 0.0 && row[9] > 0.0, "variances: {row:?}");
        assert!((0.0..=1.0).contains(&row[10]), "support: {row:?}");
    }
    assert!(states["tracking"] > scans / 2 && fixed["full"] > scans / 2, "{states:?} {fixed:?}");
    let known = ["tracking", "uncertain", "lost", "rejected"];
    assert!(states.keys().all(|state| known.contains(state)), "{states:?}");
    let known = ["full", "corridor", "blind", "uncorrected"];
    assert!(fixed.keys().all(|what| known.contains(what)), "{fixed:?}");
    let report: serde_json::Value = serde_json::from_str(&text("report.json")).unwrap();
    for state in ["tracking", "uncertain", "lost"] {
        let counted = states.get(state).copied().unwrap_or_default();
        assert_eq!(report["tracking"][state], counted, "{state}");
    }

    let bytes = std::fs::read(&recording).unwrap();
    let mut topics = BTreeMap::<String, usize>::new();
    for message in mcap::MessageStream::new(&bytes).unwrap() {
        *topics.entry(message.unwrap().channel.topic.clone()).or_default() += 1;
    }
    for topic in ["/scan", "/odom", "/tf", "/pose", "/joint_states"] {
        assert_eq!(topics[topic], scans, "{topic}");
    }
    for topic in ["/tf_static", "/path", "/map", "/segments"] {
        assert_eq!(topics[topic], 1, "{topic}");
    }
    let summary = mcap::Summary::read(&bytes).unwrap().expect("there is a summary");
    assert!(!summary.chunk_indexes.is_empty());
}

#[test]
fn the_same_run_gives_the_same_recording_and_drawing() {
    let folder = tempfile::tempdir().unwrap();
    let run = |name: &str| {
        let out: PathBuf = folder.path().join(name);
        let recording = out.join("run.mcap");
        assert!(simulate(&out, &["--mcap", recording.to_str().unwrap()]).status.success());
        (std::fs::read(recording).unwrap(), std::fs::read(out.join("map.dxf")).unwrap())
    };
    assert!(run("first") == run("second"));
}

#[test]
fn nothing_is_written_when_the_recording_cannot_be() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("out");
    let output = simulate(&out, &["--mcap", folder.path().to_str().unwrap()]);
    assert_eq!(output.status.code(), Some(1));
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(said.contains(folder.path().to_str().unwrap()), "{said}");
    assert!(!out.exists() || names(&out).is_empty(), "{:?}", names(&out));
}

#[test]
fn segments_lie_in_the_drawing_by_how_often_they_were_seen() {
    let along = |x: f32| {
        let ends = [Point2::new(x, 0.0), Point2::new(x, 2.5)];
        slam_core::Segment::from_ends(ends[0], ends[1], 20, 1e-4, Point2::new(x - 1.0, 0.0))
    };
    let map: Vec<MapSegment> = [(0.0, 1), (1.0, 3), (2.0, 10)]
        .into_iter()
        .map(|(x, hits)| MapSegment::new(&along(x), hits, 0, 0.0))
        .collect();
    let bytes = drawing::render(&map, [Isometry2::identity()].iter()).unwrap();
    let read = dxf::Drawing::load(&mut Cursor::new(bytes)).unwrap();
    let lines: Vec<(&str, f64, f64)> = read
        .entities()
        .map(|entity| match &entity.specific {
            EntityType::Line(line) => (entity.common.layer.as_str(), line.p1.x, line.p2.y),
            other => panic!("{other:?}"),
        })
        .collect();
    let expected = [("WALLS_TENTATIVE", 0.0, 2.5), ("WALLS", 1.0, 2.5), ("WALLS_SURE", 2.0, 2.5)];
    assert_eq!(lines, expected);
    assert_eq!(csv::render(&map).unwrap().iter().filter(|b| **b == b'\n').count(), 4);
}

/// A robot that stands still: to the left a wall, ahead nothing in range, to the right nothing that could be measured
/// but for one beam that met nothing.
#[test]
fn what_was_seen_to_be_empty_is_free_and_what_was_not_seen_is_unknown() {
    // At 45° to the right.
    const ALONE: usize = 340 - 128;
    let robot = Robot::usual_for("simulated");
    let sensor = robot.config().sensor;
    let ranges_mm: Vec<u16> = (0..682)
        .map(|beam| match sensor.geometry.bearing(beam).to_degrees() {
            left if left > 30.0 => 1000,
            ahead if ahead > -30.0 || beam == ALONE => 0,
            _ => 16,
        })
        .collect();
    let stamps = [1_000_000, 1_100_000, 1_200_000];
    let scan = |stamp_us| LoggedScan { line: 1, stamp_us, ranges_mm: ranges_mm.clone(), geometry: None };
    let log = Log {
        scans: stamps.map(scan).into(),
        odometry: stamps.map(|stamp_us| (stamp_us, Odometry::Ticks([0, 0]))).into(),
        ..Log::default()
    };
    let result = replay::run(&log, &robot, SlamConfig::default(), || {}).unwrap();
    let grid = Grid::of(&log, &result);
    let at = |x: f64, y: f64| {
        let cell = (Vector2::new(x, y) - grid.origin.coords) / grid.cell_m;
        grid.cells[cell.y as usize * grid.width as usize + cell.x as usize]
    };
    let laser = f64::from(sensor.mounting.base_from_laser.translation.x);
    assert_eq!(at(laser, 1.0), OCCUPIED, "the wall");
    assert_eq!(at(laser, 0.5), FREE, "before the wall");
    assert_eq!(at(laser + 5.5, 0.0), FREE, "ahead, where nothing was");
    assert_eq!(at(laser + 0.5, -0.7), UNKNOWN, "to the right");
    assert_eq!(at(laser + 1.0, -1.0), UNKNOWN, "where only one beam met nothing");
}
