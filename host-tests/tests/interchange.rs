//! What `lineslam` writes for others, read back by others: the recording by two Python packages for MCAP and ROS bags,
//! the drawing by one for DXF. The checks are in `interchange.py` beside this file; here a run is made for them.

use std::path::{Path, PathBuf};
use std::process::Command;

use host_tests::{python_with, root, skipped};
use lineslam::log::Odometry;
use lineslam::output::grid::Grid;
use lineslam::output::{csv, dxf, mcap, trajectory_csv, tum, write_all};
use lineslam::replay::{self, Replay};
use lineslam::robot::Robot;
use lineslam::sim::world::World;
use lineslam::sim::{self, Drive, SimConfig};
use serde_json::json;
use slam_core::SlamConfig;

/// A Python that has the readers; `cargo xtask test` provides one.
fn python(test: &str) -> Option<PathBuf> {
    let python = python_with("numpy, mcap, mcap_ros2, rosbags, ezdxf");
    if python.is_none() {
        skipped(test, Path::new("python3 with numpy, mcap, mcap-ros2-support, rosbags and ezdxf"));
    }
    python
}

/// The simulator's robot, its file changed.
fn robot(changes: &[(&str, &str)]) -> Robot {
    let path = root().join("robots/paper.toml");
    let mut text = std::fs::read_to_string(&path).unwrap();
    for (from, to) in changes {
        assert!(text.contains(from), "'{from}' is not in paper.toml");
        text = text.replacen(from, to, 1);
    }
    Robot::parse(&text, &path).unwrap()
}

fn drive() -> Drive {
    let world = World::load(&root().join("worlds/hall_quarter.toml")).unwrap();
    let mut errors = SimConfig::default();
    errors.set("sensor.dropout=0.05").unwrap();
    sim::drive(&world, &robot(&[]), &errors, 4).unwrap()
}

/// How far the wheels had turned at each reading, by adding up.
fn wheel_angles(drive: &Drive, ticks_per_turn: f64) -> Vec<[f64; 2]> {
    let mut angles = vec![[0.0; 2]];
    let readings = drive.log.odometry.iter().map(|(_, odometry)| match odometry {
        Odometry::Ticks(ticks) => *ticks,
        other => unreachable!("the simulated robot counts ticks, not {other:?}"),
    });
    let readings: Vec<[i64; 2]> = readings.collect();
    for pair in readings.windows(2) {
        let last = *angles.last().unwrap();
        angles.push([0, 1].map(|side| {
            let moved = (pair[1][side] - pair[0][side] + 32_768).rem_euclid(65_536) - 32_768;
            last[side] + moved as f64 * std::f64::consts::TAU / ticks_per_turn
        }));
    }
    angles
}

fn facts(drive: &Drive, replay: &Replay) -> serde_json::Value {
    let sensor = replay.config.sensor;
    let hits = |range: std::ops::RangeInclusive<u16>| {
        replay.map.iter().filter(|entry| range.contains(&entry.hits)).count()
    };
    let logged = drive.log.scans.iter();
    json!({
        "scans": drive.log.scans.len(),
        "wheel_readings": drive.log.odometry.len(),
        "wheel_angles": wheel_angles(drive, 2000.0),
        "logged": logged.map(|s| json!({"stamp_us": s.stamp_us, "ranges_mm": s.ranges_mm})).collect::<Vec<_>>(),
        "min_mm": sensor.codes.min_mm,
        "max_mm": sensor.codes.max_mm,
        "no_echo_mm": [0, 6],
        "upside_down": sensor.mounting.upside_down,
        "segments_by_hits": [hits(10..=u16::MAX), hits(3..=9), hits(0..=2)],
    })
}

fn read_by_others(test: &str, drive: &Drive, robot: &Robot) {
    let Some(python) = python(test) else { return };
    let replay = replay::run(&drive.log, robot, SlamConfig::default(), || {}).unwrap();
    let grid = Grid::of(&drive.log, &replay);
    let path = replay.steps.iter().map(|step| &step.pose_in_final_map);
    let folder = tempfile::tempdir().unwrap();
    let files = [
        ("run.mcap", mcap::render(&drive.log, &replay, &grid).unwrap()),
        ("map.dxf", dxf::render(&replay.map, path).unwrap()),
        ("map.pgm", grid.pgm().unwrap()),
        ("map.yaml", grid.yaml().into_bytes()),
        ("map.csv", csv::render(&replay.map).unwrap()),
        ("trajectory.csv", trajectory_csv::render(&replay.steps).unwrap()),
        ("trajectory_final.tum", tum::render(replay::final_trajectory(&replay.steps)).into_bytes()),
        ("facts.json", facts(drive, &replay).to_string().into_bytes()),
    ];
    write_all(folder.path(), &files).unwrap();
    let script = root().join("host-tests/tests/interchange.py");
    let output = Command::new(python).arg(script).arg(folder.path()).output().unwrap();
    print!("{}", String::from_utf8_lossy(&output.stdout));
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
}

#[test]
fn a_run_is_read_by_others() {
    read_by_others("a_run_is_read_by_others", &drive(), &robot(&[]));
}

/// The same scans from a scanner that hangs head down: they come in the other order, and its front is one step off.
#[test]
fn a_scanner_head_down_is_read_by_others() {
    let mut drive = drive();
    drive.log.scans.iter_mut().for_each(|scan| scan.ranges_mm.reverse());
    let robot = robot(&[
        ("[mounting]", "[sensor.steps]\nfront = 385\n\n[mounting]"),
        ("upside_down = false", "upside_down = true"),
    ]);
    read_by_others("a_scanner_head_down_is_read_by_others", &drive, &robot);
}
