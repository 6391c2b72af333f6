//! docs/logs.md: its example is read, and what its writers write.

use std::path::Path;
use std::process::{Command, Stdio};

use host_tests::{root, skipped};
use lineslam::log::{self, Log, Odometry, ReadOptions};
use lineslam::replay;
use slam_core::SlamConfig;

/// The first block of a language on the page.
fn block(language: &str) -> String {
    let page = std::fs::read_to_string(root().join("docs/logs.md")).unwrap();
    let (_, rest) = page.split_once(&format!("```{language}\n")).unwrap();
    rest.split_once("```").unwrap().0.to_owned()
}

fn read(folder: &Path, text: &[u8]) -> Log {
    let path = folder.join("log.jsonl");
    std::fs::write(&path, text).unwrap();
    log::read(&path, &ReadOptions::default()).unwrap()
}

#[test]
fn the_example_is_read() {
    let folder = tempfile::tempdir().unwrap();
    let log = read(folder.path(), block("json").as_bytes());
    assert_eq!((log.format, log.scans.len(), log.commonest_beams), ("plain", 2, 5));
    assert!(log.warnings.is_empty() && log.skipped.is_empty(), "{log:?}");
    assert_eq!(log.odometry[1], (1_100_000, Odometry::Ticks([31, 33])));
    assert_eq!(log.odometry.len(), 3);
    let robot = log.usual_robot();
    assert_eq!(robot.wheels.unwrap().counter_bits, 16);
    let sensor = robot.sensor_for(&log.layout(1));
    let codes = sensor.codes;
    assert_eq!(
        codes.read(log.scans[1].ranges_mm[1]),
        slam_core::sensor::scan::Reading::Bad,
        "null is not measured"
    );
    assert_eq!(codes.read(5600), slam_core::sensor::scan::Reading::NoEcho, "the greatest range met nothing");
    assert!((sensor.geometry.step_rad().to_degrees() - 45.0).abs() < 1e-4);
    replay::run(&log, &robot, SlamConfig::default(), || {}).unwrap();
}

#[test]
fn what_the_python_writer_writes_is_mapped() {
    let python = Command::new("python3").args(["-c", &block("python")]).stderr(Stdio::inherit()).output();
    let Ok(output) = python else {
        return skipped("what_the_python_writer_writes_is_mapped", Path::new("python3"));
    };
    assert!(output.status.success());
    let folder = tempfile::tempdir().unwrap();
    let log = read(folder.path(), &output.stdout);
    let replay = replay::run(&log, &log.usual_robot(), SlamConfig::default(), || {}).unwrap();
    assert_eq!(replay.steps.len(), 50);
    let last = replay.steps[49].pose.translation.vector;
    assert!((last.x - 0.98).abs() < 0.01 && last.y.abs() < 0.01, "{last}");
    // A scanner that looks all round sees all four walls; the one that its first and last beam share may be two pieces.
    let walls = replay.map.iter().filter(|wall| wall.length_m() > 1.0).count();
    assert!((4..=5).contains(&walls), "{walls} walls");
}

#[test]
fn what_the_c_writer_writes_is_read() {
    let folder = tempfile::tempdir().unwrap();
    let (source, program) = (folder.path().join("writer.c"), folder.path().join("writer"));
    std::fs::write(&source, block("c")).unwrap();
    let built = Command::new("cc").args(["-Wall", "-Werror", "-o"]).arg(&program).arg(&source).status();
    if !built.is_ok_and(|status| status.success()) {
        return skipped("what_the_c_writer_writes_is_read", Path::new("cc"));
    }
    let output = Command::new(&program).output().unwrap();
    let log = read(folder.path(), &output.stdout);
    assert_eq!((log.scans.len(), log.odometry.len(), log.commonest_beams), (5, 5, 682));
    assert_eq!(log.odometry[4], (1_400_000, Odometry::Ticks([40, 40])));
}
