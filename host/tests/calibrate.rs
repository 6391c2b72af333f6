//! `lineslam calibrate`: what is wrong with a simulated robot is found, and what a drive cannot tell is said.

use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use lineslam::calibrate::{self, Calibration, CalibrationError};
use lineslam::robot::Robot;
use lineslam::sim::world::World;
use lineslam::sim::{SimConfig, drive};
use lineslam::toml_file;

const PAPER: &str = include_str!("../../robots/paper.toml");

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..")
}

/// A robot file that is wrong about the mounting; the simulated wheels make it wrong about those.
fn wrong_file(folder: &Path) -> PathBuf {
    let text = PAPER
        .replace("x_m = 0.140", "x_m = 0.10 # measured with a ruler")
        .replace("y_m = 0.0", "y_m = 0.03")
        .replace("yaw_deg = 0.0", "yaw_deg = 2.0");
    assert_ne!(text, PAPER);
    let path = folder.join("wrong.toml");
    std::fs::write(&path, text).unwrap();
    path
}

fn simulated(world: &World, seed: u64, robot: &Path) -> (Result<Calibration, CalibrationError>, [f64; 7]) {
    let mut errors = SimConfig::default();
    errors.set("sensor.delay_s=0.08").unwrap();
    let drive = drive(world, &Robot::usual_for("simulated"), &errors, seed).unwrap();
    let ([left, right], track) = drive.true_wheels;
    (calibrate::calibrate(&drive.log, robot, || {}), [left, right, track, 0.08, 0.14, 0.0, 0.0])
}

#[test]
fn known_errors_are_found_within_the_stated_uncertainty() {
    let folder = tempfile::tempdir().unwrap();
    let wrong = wrong_file(folder.path());
    let (mut squares, mut count) = (0.0, 0.0);
    for (name, seed) in [("hall_quarter", 31), ("hall_quarter", 32), ("office", 33), ("hall", 34)] {
        let world = World::load(&root().join(format!("worlds/{name}.toml"))).unwrap();
        let (result, truth) = simulated(&world, seed, &wrong);
        for (parameter, truth) in result.unwrap().parameters.iter().zip(truth) {
            let sigmas = (parameter.value - truth) / parameter.sigma;
            assert!(parameter.told, "{name} {seed}: {parameter:?}");
            assert!(sigmas.abs() < 3.0, "{name} {seed}: {parameter:?}, the truth is {truth}");
            squares += sigmas * sigmas;
            count += 1.0;
        }
    }
    // Neither too small nor boastful the other way.
    let rms: f64 = f64::sqrt(squares / count);
    assert!((0.3..1.5).contains(&rms), "errors are {rms} of what is stated");
}

#[test]
fn a_drive_without_turns_cannot_tell_the_track() {
    let world = r#"
        name = "straight"
        [[wall]]
        closed = true
        points = [[0, 0], [12, 0], [12, 3], [9, 3], [9, 4], [6, 4], [6, 3], [3, 3], [3, 4], [0, 4]]
        [path]
        heading_deg = 0
        speed = 0.3
        points = [[1, 1.5], [11, 1.5]]
    "#;
    let world: World = toml_file::parse(world, Path::new("straight.toml")).unwrap();
    let folder = tempfile::tempdir().unwrap();
    let robot = folder.path().join("robot.toml");
    std::fs::write(&robot, PAPER).unwrap();
    let (result, truth) = simulated(&world, 7, &robot);
    let result = result.unwrap();
    let named = |key: &str| result.parameters.iter().find(|p| p.key[1] == key).unwrap();
    for key in ["track_m", "x_m", "y_m"] {
        assert!(!named(key).told, "{:?}", named(key));
    }
    let left = named("left_radius_m");
    assert!(left.told && (left.value - truth[0]).abs() < 3.0 * left.sigma, "{left:?}");
    assert!(result.robot_file.contains("track_m = 0.3\n"), "the file's value stays: {}", result.robot_file);
}

#[test]
fn two_parallel_walls_are_not_enough() {
    let world = World::load(&root().join("worlds/parallel.toml")).unwrap();
    let folder = tempfile::tempdir().unwrap();
    let (result, _) = simulated(&world, 1, &wrong_file(folder.path()));
    assert!(matches!(result, Err(CalibrationError::TooShort { .. })), "{result:?}");
}

fn command(log: &Path, robot: &Path, out: &Path) -> Output {
    Command::new(env!("CARGO_BIN_EXE_lineslam"))
        .arg("calibrate")
        .arg(log)
        .arg("--robot")
        .arg(robot)
        .arg("--out")
        .arg(out)
        .output()
        .unwrap()
}

#[test]
fn the_command_writes_a_robot_file_and_keeps_its_comments() {
    let folder = tempfile::tempdir().unwrap();
    let (log, out) = (folder.path().join("log.jsonl"), folder.path().join("new/robot.toml"));
    let world = World::load(&root().join("worlds/hall_quarter.toml")).unwrap();
    let drive = drive(&world, &Robot::usual_for("simulated"), &SimConfig::default(), 3).unwrap();
    std::fs::write(&log, lineslam::log::plain_text(&drive.log, &Robot::usual_for("simulated"))).unwrap();
    let wrong = wrong_file(folder.path());
    let own = std::fs::read_to_string(root().join("sensors/urg-04lx.toml")).unwrap();
    std::fs::write(folder.path().join("own.toml"), own).unwrap();
    let text = std::fs::read_to_string(&wrong).unwrap().replace("\"urg-04lx\"", "\"own.toml\"");
    std::fs::write(&wrong, text).unwrap();
    let output = command(&log, &wrong, &out);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    assert!(String::from_utf8_lossy(&output.stdout).contains("wheels.track_m"));
    Robot::load(&out).unwrap();
    let text = std::fs::read_to_string(&out).unwrap();
    assert!(text.contains("# measured with a ruler") && !text.contains("x_m = 0.10 "), "{text}");
}

#[test]
fn a_log_without_ticks_and_a_robot_without_wheels_are_clear_errors() {
    let folder = tempfile::tempdir().unwrap();
    let log = folder.path().join("poses.log");
    let flaser = |k: u32| format!("FLASER 3 1.0 1.0 1.0 {k} 0 0 {k} 0 0 {k}.0 host {k}.0\n");
    std::fs::write(&log, (0..5).map(flaser).collect::<String>()).unwrap();
    let out = folder.path().join("out.toml");
    let sick = root().join("robots/sick.toml");
    let output = command(&log, &sick, &out);
    assert_eq!(output.status.code(), Some(2), "{output:?}");
    assert!(String::from_utf8_lossy(&output.stderr).contains("no [wheels]"), "{output:?}");
    let with_wheels = PAPER.replace("[mounting]", "[sensor.field]\nof_view_deg = 180.0\n\n[mounting]");
    let robot = folder.path().join("wheels.toml");
    std::fs::write(&robot, with_wheels).unwrap();
    let output = command(&log, &robot, &out);
    assert_eq!(output.status.code(), Some(2), "{output:?}");
    assert!(String::from_utf8_lossy(&output.stderr).contains("not wheel ticks"), "{output:?}");
    assert!(!out.exists());
}
