//! One simulated drive in three kinds of log: JSON lines, MCAP and a ROS 1 bag that another program wrote. Replayed, all give
//! the same trajectory to the last bit.

use std::path::{Path, PathBuf};
use std::process::Command;

use host_tests::{lineslam, python_with, root, skipped};

fn run(arguments: &[&Path]) {
    let output = Command::new(lineslam()).args(arguments).output().unwrap();
    assert!(output.status.success(), "{arguments:?}: {}", String::from_utf8_lossy(&output.stderr));
}

fn word(word: &str) -> &Path {
    Path::new(word)
}

/// A drive of the simulator, with its log and its recording.
fn simulated(folder: &Path) -> (PathBuf, PathBuf) {
    let (out, mcap) = (folder.join("simulated"), folder.join("run.mcap"));
    let world = root().join("worlds/hall_quarter.toml");
    run(&[word("simulate"), &world, word("--seed"), word("5"), word("--out"), &out, word("--mcap"), &mcap]);
    (out, mcap)
}

/// The trajectory that a replay of a log writes, with the simulator's robot file or with what the log states.
fn replayed(log: &Path, out: &Path, with_robot: bool) -> String {
    let robot = root().join("robots/paper.toml");
    let mut arguments = vec![word("replay"), log, word("--out"), out];
    if with_robot {
        arguments.extend([word("--robot"), &robot]);
    }
    run(&arguments);
    std::fs::read_to_string(out.join("trajectory.tum")).unwrap()
}

/// The largest distance between two trajectories with the same stamps, metres.
fn apart_m(a: &str, b: &str) -> f64 {
    let read = |text: &str| lineslam::score::parse_tum(text).unwrap();
    let (a, b) = (read(a), read(b));
    assert_eq!(a.len(), b.len());
    let apart = |(a, b): (&lineslam::score::StampedPose, &lineslam::score::StampedPose)| {
        assert!((a.stamp_s - b.stamp_s).abs() < 1e-5, "{} {}", a.stamp_s, b.stamp_s);
        (a.pose.translation.vector - b.pose.translation.vector).norm()
    };
    a.iter().zip(&b).map(apart).fold(0.0, f64::max)
}

#[test]
fn json_lines_and_mcap_give_the_drive_s_own_trajectory() {
    let folder = tempfile::tempdir().unwrap();
    let (out, mcap) = simulated(folder.path());
    let own = std::fs::read_to_string(out.join("trajectory.tum")).unwrap();
    assert!(own.lines().count() > 200);
    assert_eq!(replayed(&out.join("log.jsonl"), &folder.path().join("plain"), true), own);
    assert_eq!(replayed(&mcap, &folder.path().join("mcap"), true), own);
    // With what the logs state themselves, another robot's noise and, from the bag, the odometry's poses.
    for (name, log) in [("plain", out.join("log.jsonl")), ("mcap", mcap)] {
        let stated = replayed(&log, &folder.path().join(format!("{name}_stated")), false);
        let apart_m = apart_m(&stated, &own);
        println!("{name}, without a robot file: {apart_m:.3} m off at the most");
        assert!(apart_m < 0.3, "{name}");
    }
}

#[test]
fn a_ros_1_bag_that_rosbags_wrote_gives_the_same_trajectory() {
    let test = "a_ros_1_bag_that_rosbags_wrote_gives_the_same_trajectory";
    let Some(python) = python_with("numpy, rosbags") else {
        return skipped(test, Path::new("python3 with numpy and rosbags"));
    };
    let folder = tempfile::tempdir().unwrap();
    let (out, _) = simulated(folder.path());
    let own = std::fs::read_to_string(out.join("trajectory.tum")).unwrap();
    let script = root().join("host-tests/tests/write_ros1.py");
    for compression in ["none", "bz2", "lz4"] {
        let bag = folder.path().join(format!("{compression}.bag"));
        let log = out.join("log.jsonl");
        let output =
            Command::new(&python).arg(&script).arg(&log).arg(&bag).arg(compression).output().unwrap();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        assert_eq!(replayed(&bag, &folder.path().join(compression), true), own, "{compression}");
    }
}
