//! Recordings of a robot, which is a simulated drive: what is written, and what a replay makes of it.

mod recorded;

use std::path::{Path, PathBuf};

use lineslam::configuration::Configuration;
use lineslam::log::{self, Log, LogError, Odometry, ReadOptions};
use lineslam::recording::course::Missing;
use lineslam::recording::{Recorder, Summary};
use lineslam::replay::{self, Agreement, Replay, Start};
use link::FromRobot;
use link::from_robot::{Cause, Event, Happened, ResetCause};
use recorded::{Driven, eventful, robot, robot_file};
use slam_core::geometry::pose::components;

/// 2026, microseconds.
const NOW_US: u64 = 1_770_000_000_000_000;

/// Records messages that come a millisecond apart.
fn record(path: &Path, plain: Option<&Path>, said: &[FromRobot]) -> Summary {
    let mut recorder = Recorder::create(path, plain, false).unwrap();
    for (k, message) in said.iter().enumerate() {
        recorder.take(message, NOW_US + 1000 * k as u64).unwrap();
    }
    recorder.finish().unwrap()
}

fn read(path: &Path) -> Result<Log, LogError> {
    log::read(path, &ReadOptions::default())
}

fn followed(log: &Log) -> Replay {
    let start = Start { follows: true, ..Start::default() };
    replay::run_from(&start, log, &robot(), Configuration::Default.config(), || ()).unwrap()
}

fn bits(replay: &Replay) -> Vec<[u32; 3]> {
    replay.steps.iter().map(|step| <[f32; 3]>::from(components(&step.pose)).map(f32::to_bits)).collect()
}

fn suspected(log: &Log) -> Vec<&'static str> {
    log.warnings.iter().map(|warning| warning.suspected).collect()
}

struct Folder(tempfile::TempDir);

impl Folder {
    fn new() -> Self {
        Self(tempfile::tempdir().unwrap())
    }

    fn file(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }
}

#[test]
fn a_replay_has_the_robot_s_trajectory_bit_for_bit_through_all_that_may_happen() {
    let (folder, driven) = (Folder::new(), eventful());
    let path = folder.file("drive.mcap");
    let summary = record(&path, None, &driven.said);
    assert_eq!((summary.scans, summary.runs, summary.joined), (210, 2, false));
    assert!(summary.missing.is_none());
    let log = read(&path).unwrap();
    assert_eq!((log.format, suspected(&log)), ("robot", vec![]));
    let replay = followed(&log);
    assert_eq!(bits(&replay), driven.scan_poses());
    let all = driven.said.iter().filter(|message| matches!(message, FromRobot::Pose(_))).count();
    assert_eq!(replay.agreement, Some(Agreement { same: all, ..Agreement::default() }));
    // Stamps are the recorder's, and go on through the reset.
    assert!(log.scans.windows(2).all(|pair| pair[0].stamp_us < pair[1].stamp_us));
    assert!(log.scans[0].stamp_us.abs_diff(NOW_US) < 10_000_000);
    // What the robot did is what makes it: as any other log it goes another way.
    let plain = replay::run(&log, &robot(), Configuration::Default.config(), || ()).unwrap();
    assert_ne!(bits(&plain), driven.scan_poses());
}

#[test]
fn a_number_that_is_another_shows() {
    let (folder, mut driven) = (Folder::new(), Driven::new());
    driven.scans(0..40);
    for message in &mut driven.said {
        if let FromRobot::Ranges(part) = message {
            part.revolution_us += u32::from(part.number == 30) * 400;
        }
    }
    let path = folder.file("drive.mcap");
    record(&path, None, &driven.said);
    let agreement = followed(&read(&path).unwrap()).agreement.unwrap();
    assert_eq!((agreement.same, agreement.first_different), (29, Some(30)));
}

#[test]
fn what_is_missing_is_counted_said_and_known_again_once_the_map_is_forgotten() {
    let (folder, mut driven) = (Folder::new(), Driven::new());
    driven.scans(0..50);
    driven.told(Cause::Forgotten);
    driven.scans(50..60);
    // A part of a scan, a pose of another, samples.
    let is_ticks = |message: &FromRobot| matches!(message, FromRobot::Ticks(_));
    let at = driven.said.iter().enumerate().filter(|(_, message)| is_ticks(message)).nth(30).unwrap().0;
    let FromRobot::Ticks(ticks) = driven.said.remove(at) else { unreachable!() };
    let lost = ticks.steps.len() as u32 + 1;
    driven.said.retain(|message| match message {
        FromRobot::Ranges(part) => !(part.number == 10 && part.first == 98),
        FromRobot::Pose(pose) => pose.number != 20,
        _ => true,
    });
    let path = folder.file("drive.mcap");
    let summary = record(&path, None, &driven.said);
    assert_eq!(summary.missing, Missing { scans: 1, poses: 1, samples: lost });
    let log = read(&path).unwrap();
    assert_eq!(log.course.as_ref().unwrap().missing, summary.missing);
    assert_eq!(suspected(&log), ["missing_from_recording"]);
    let text = &log.warnings[0].message;
    let samples = if lost == 1 { "sample" } else { "samples" };
    let words = format!("1 scan, 1 pose and {lost} {samples} of the wheels missing");
    assert!(text.starts_with(&words), "{text}");
    let agreement = followed(&log).agreement.unwrap();
    // Nine before the first loss, and eleven from the new map on.
    assert_eq!((agreement.same, agreement.different), (20, 0));
    assert_eq!(agreement.unknown, 61 - 2 - 20);
    // The end of the file says it too.
    assert!(String::from_utf8_lossy(&std::fs::read(&path).unwrap()).contains("missing_scans"));
}

#[test]
fn a_recording_that_begins_in_a_drive_says_so() {
    let (folder, mut driven) = (Folder::new(), Driven::new());
    driven.scans(0..20);
    let from = driven.said.len();
    driven.scans(20..40);
    let path = folder.file("drive.mcap");
    let summary = record(&path, None, &[&driven.said[..1], &driven.said[from..]].concat());
    assert!(summary.joined && summary.missing.is_none(), "{summary:?}");
    let log = read(&path).unwrap();
    assert_eq!(suspected(&log), ["recording_begins_in_drive"]);
    let agreement = followed(&log).agreement.unwrap();
    assert_eq!((agreement.same, agreement.different), (0, 0));
    assert!(agreement.unknown >= 19, "{agreement:?}");
}

#[test]
fn a_file_that_is_cut_anywhere_is_read_up_to_there() {
    let (folder, mut driven) = (Folder::new(), Driven::new());
    driven.scans(0..60);
    let (path, cut_path) = (folder.file("drive.mcap"), folder.file("cut.mcap"));
    let mut recorder = Recorder::create(&path, None, false).unwrap();
    for (k, message) in driven.said.iter().enumerate() {
        // Several chunks.
        recorder.take(message, NOW_US + 10_000 * k as u64).unwrap();
    }
    recorder.finish().unwrap();
    let (bytes, whole) = (std::fs::read(&path).unwrap(), read(&path).unwrap());
    let mut before = 0;
    let cuts = (0..bytes.len()).step_by(331).chain(bytes.len().saturating_sub(400)..bytes.len());
    for cut in cuts {
        std::fs::write(&cut_path, &bytes[..cut]).unwrap();
        match read(&cut_path) {
            Ok(log) => {
                assert!(log.scans.len() >= before, "{cut}");
                before = log.scans.len();
                assert!(log.scans.iter().zip(&whole.scans).all(|(a, b)| a == b), "{cut}");
                // But for the magic after the last record.
                let is_said = suspected(&log).contains(&"damaged");
                assert!(is_said || cut >= bytes.len() - 8, "{cut} of {}", bytes.len());
            }
            // Before there is a scan that is whole.
            Err(LogError::NoScan { .. } | LogError::Damaged { .. } | LogError::NotALog { .. }) => {
                assert_eq!(before, 0, "{cut}");
            }
            Err(other) => panic!("{cut}: {other}"),
        }
    }
    println!("{before} of {} scans at the last cut, {} bytes", whole.scans.len(), bytes.len());
    assert_eq!(before, whole.scans.len());
}

#[test]
fn ros_messages_and_the_plain_log_tell_the_same_drive() {
    let (folder, mut driven) = (Folder::new(), Driven::new());
    driven.said.push(FromRobot::Event(Happened { at_us: 1, event: Event::Started(ResetCause::Pin) }));
    driven.scans(0..40);
    let (path, plain_path) = (folder.file("drive.mcap"), folder.file("drive.jsonl"));
    record(&path, Some(&plain_path), &driven.said);
    let exact = read(&path).unwrap();
    let options = ReadOptions { scan_topic: Some("/scan"), wheels: true, ..ReadOptions::default() };
    let ros = log::read(&path, &options).unwrap();
    let plain = read(&plain_path).unwrap();
    assert_eq!((ros.format, plain.format), ("mcap", "plain"));
    assert_eq!((exact.scans.len(), ros.scans.len(), plain.scans.len()), (40, 40, 40));
    for ((exact, ros), plain) in exact.scans.iter().zip(&ros.scans).zip(&plain.scans) {
        assert_eq!((exact.stamp_us, &exact.ranges_mm), (plain.stamp_us, &plain.ranges_mm));
        assert!(exact.stamp_us.abs_diff(ros.stamp_us) <= 1);
        let seen = |mm: &u16| (20..=5600).contains(mm);
        let both = exact.ranges_mm.iter().zip(&ros.ranges_mm);
        assert!(both.clone().all(|(a, b)| seen(a) == seen(b) && (!seen(a) || a == b)));
    }
    let [of_ros, of_exact] = [&ros, &exact].map(|log| log.geometries[0]);
    assert_eq!(of_ros.limits_m, of_exact.limits_m);
    assert_eq!(
        of_ros.base_from_laser.map(|m| m.map(|v| (v * 1e5) as i32)),
        of_exact.base_from_laser.map(|m| m.map(|v| (v * 1e5) as i32))
    );
    assert!((of_ros.revolution_s - of_exact.revolution_s).abs() < 1e-6);
    // As angles, and as counters.
    let turn = f64::from(robot().wheels.unwrap().ticks_per_turn) / std::f64::consts::TAU;
    for ((at_us, ticks), (ros_us, angles)) in exact.odometry.iter().zip(&ros.odometry) {
        let (Odometry::Ticks(ticks), Odometry::Angles(angles)) = (ticks, angles) else {
            panic!("{angles:?}")
        };
        assert_eq!(at_us, ros_us);
        assert!((0..2).all(|side| (angles[side] * turn - ticks[side] as f64).abs() < 1e-6));
    }
    assert!(
        String::from_utf8_lossy(&std::fs::read(&plain_path).unwrap())
            .starts_with("{\"lineslam_log\":1,\"robot\":\"paper\"")
    );
}

#[test]
fn calibrate_takes_a_recording() {
    let (folder, mut driven) = (Folder::new(), Driven::new());
    driven.scans(0..900);
    let path = folder.file("drive.mcap");
    record(&path, None, &driven.said);
    let result = lineslam::calibrate::calibrate(&read(&path).unwrap(), &robot_file(), || ()).unwrap();
    println!("{:?}", result.parameters);
    let told = |key: &str| result.parameters.iter().find(|p| p.key[1] == key).unwrap();
    for key in ["left_radius_m", "right_radius_m"] {
        let radius = told(key);
        assert!(radius.told && (radius.value / radius.before - 1.0).abs() < 0.02, "{radius:?}");
    }
    assert!(result.windows > 50, "{}", result.windows);
}

#[test]
fn a_file_that_is_there_is_not_overwritten_unasked() {
    let folder = Folder::new();
    let path = folder.file("drive.mcap");
    std::fs::write(&path, "mine").unwrap();
    let error = Recorder::create(&path, None, false).map(|_| ()).unwrap_err().to_string();
    assert!(error.contains("drive.mcap is there already; --force"), "{error}");
    assert_eq!(std::fs::read(&path).unwrap(), b"mine");
    assert!(Recorder::create(&path, None, true).is_ok());
    let nowhere = folder.file("nowhere/drive.mcap");
    let error = Recorder::create(&nowhere, None, false).map(|_| ()).unwrap_err().to_string();
    assert!(error.contains("nowhere/drive.mcap"), "{error}");
}
