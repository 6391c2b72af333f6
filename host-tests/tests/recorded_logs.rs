//! Recorded logs against their references: the table of absolute trajectory errors, and the promises made on it.
//!
//! The logs belong to others and are not part of this project. They are looked for in `../shared/data` beside the
//! checkout, or in the folder that `LINESLAM_DATA` names; where they are absent each test says that it was skipped.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use comfy_table::{Table, presets};
use host_tests::{data, root};
use lineslam::log::{self, ReadOptions};
use lineslam::output::tum;
use lineslam::replay::{self, Replay};
use lineslam::robot::Robot;
use lineslam::score::{absolute_trajectory_error, parse_tum};
use slam_core::SlamConfig;

/// A log, and what the default configuration must keep.
struct Recorded {
    name: &'static str,
    file: &'static str,
    /// Absolute trajectory error, metres …
    limit_m: f64,
    /// … and with other noise on every range.
    noisy_limit_m: f64,
}

const LOGS: [Recorded; 5] = [
    Recorded { name: "exp1", file: "exp1.dat.gz", limit_m: 0.22, noisy_limit_m: 0.35 },
    Recorded { name: "csail", file: "csail.log.gz", limit_m: 0.60, noisy_limit_m: 3.0 },
    Recorded { name: "fr079", file: "fr079.log.gz", limit_m: 0.10, noisy_limit_m: 0.25 },
    Recorded { name: "fr101", file: "fr101.log.gz", limit_m: 0.06, noisy_limit_m: 0.1 },
    Recorded { name: "seattle", file: "seattle.log.gz", limit_m: 0.09, noisy_limit_m: 0.15 },
];

fn path(recorded: &Recorded, test: &str) -> Option<PathBuf> {
    host_tests::recorded(recorded.file, test)
}

fn replay(path: &Path, config: SlamConfig) -> Replay {
    let options = ReadOptions::default();
    let log = log::read(path, &options).unwrap();
    replay::run(&log, &Robot::usual_for(log.format), config, || {}).unwrap()
}

fn error_m(trajectory: &str, recorded: &Recorded) -> f64 {
    let reference = std::fs::read_to_string(data().join(format!("{}.ref.tum", recorded.name))).unwrap();
    absolute_trajectory_error(&parse_tum(trajectory).unwrap(), &parse_tum(&reference).unwrap()).unwrap()
}

#[test]
fn default_beats_the_paper_and_dead_reckoning_on_every_log() {
    let mut table = Table::new();
    table.load_style(presets::UTF8_FULL_CONDENSED);
    table.set_header(["log", "scans", "dead reckoning", "paper", "default", "promised"]);
    let mut failures = Vec::new();
    for recorded in &LOGS {
        let Some(path) = path(recorded, "default_beats_the_paper_and_dead_reckoning_on_every_log") else {
            continue;
        };
        let ours = replay(&path, SlamConfig::default());
        let paper = replay(&path, SlamConfig::paper());
        let error = |text: String| error_m(&text, recorded);
        let default_m = error(tum::render(replay::final_trajectory(&ours.steps)));
        let paper_m = error(tum::render(replay::trajectory(&paper.steps)));
        let odometry_m = error(tum::render(replay::dead_reckoning(&ours.steps)));
        let metres = |m: f64| format!("{m:.3}");
        table.add_row([
            recorded.name.to_owned(),
            ours.steps.len().to_string(),
            metres(odometry_m),
            metres(paper_m),
            metres(default_m),
            format!("≤ {:.2}", recorded.limit_m),
        ]);
        if default_m > recorded.limit_m || default_m >= paper_m || default_m >= odometry_m {
            failures.push(recorded.name);
        }
    }
    println!("Absolute trajectory error, rmse in metres after one SE(2) alignment\n{table}");
    assert!(failures.is_empty(), "{failures:?} are not as promised");
}

/// The promise must not hang on one set of numbers: every range is moved by up to ±3 mm, from three seeds.
#[test]
fn promises_hold_with_other_noise() {
    for recorded in &LOGS {
        let Some(path) = path(recorded, "promises_hold_with_other_noise") else { continue };
        let options = ReadOptions::default();
        let original = log::read(&path, &options).unwrap();
        for seed in 1..=3u64 {
            let mut log = original.clone();
            let mut state = seed.wrapping_mul(0x9E37_79B9_7F4A_7C15);
            for range in
                log.scans.iter_mut().flat_map(|s| &mut s.ranges_mm).filter(|r| (100..60_000).contains(&**r))
            {
                // xorshift64
                state ^= state << 13;
                state ^= state >> 7;
                state ^= state << 17;
                *range = *range - 3 + (state % 7) as u16;
            }
            let robot = Robot::usual_for(log.format);
            let result = replay::run(&log, &robot, SlamConfig::default(), || {}).unwrap();
            let error = error_m(&tum::render(replay::final_trajectory(&result.steps)), recorded);
            assert!(error <= recorded.noisy_limit_m, "{} with seed {seed}: {error:.3} m", recorded.name);
        }
    }
}

/// From the nominal robot file, which knows neither the track nor that scans are stamped late.
#[test]
fn calibration_finds_what_is_wrong_with_the_rover() {
    let Some(path) = path(&LOGS[0], "calibration_finds_what_is_wrong_with_the_rover") else { return };
    let known = std::fs::read_to_string(root().join("robots/mines.toml")).unwrap();
    let nominal =
        known.replace("track_m = 0.308", "track_m = 0.330").replace("delay_s = 0.15", "delay_s = 0.0");
    let folder = std::env::temp_dir().join(format!("lineslam-calibrate-{}", std::process::id()));
    std::fs::create_dir_all(&folder).unwrap();
    let file = folder.join("nominal.toml");
    std::fs::write(&file, nominal).unwrap();
    let options = ReadOptions::default();
    let log = log::read(&path, &options).unwrap();
    let found = lineslam::calibrate::calibrate(&log, &file, || {}).unwrap();
    for (key, before, truth, within) in [("track_m", 0.33, 0.308, 0.010), ("scan_delay_s", 0.0, 0.15, 0.010)]
    {
        let parameter = found.parameters.iter().find(|p| p.key[1] == key).unwrap();
        println!("exp1, {key}: {:.4} ± {:.4}", parameter.value, parameter.sigma);
        assert!((parameter.before - before).abs() < 1e-6, "{parameter:?}");
        assert!(parameter.told && (parameter.value - truth).abs() < within, "{parameter:?}");
    }
    std::fs::remove_dir_all(&folder).unwrap();
}

#[test]
fn exp1_replays_within_a_second() {
    let Some(path) = path(&LOGS[0], "exp1_replays_within_a_second") else { return };
    let started = Instant::now();
    let result = replay(&path, SlamConfig::default());
    let took = started.elapsed();
    println!("exp1: {} scans read and replayed in {took:?}", result.steps.len());
    assert_eq!(result.steps.len(), 756);
    assert!(took < Duration::from_secs(1), "{took:?}");
}

/// A log replayed twice is the same to the last bit, map and covariances included.
#[test]
fn the_same_log_gives_the_same_bits() {
    let Some(path) = path(&LOGS[0], "the_same_log_gives_the_same_bits") else { return };
    for config in [SlamConfig::default(), SlamConfig::paper(), SlamConfig::paper_partial()] {
        let bits = |r: &Replay| {
            let mut bits: Vec<u32> = Vec::new();
            for step in &r.steps {
                bits.extend([step.pose.translation.x, step.pose.translation.y].map(f32::to_bits));
                bits.extend([step.pose.rotation.re, step.pose.rotation.im].map(f32::to_bits));
                bits.extend(step.update.covariance.iter().map(|v| v.to_bits()));
            }
            bits
        };
        let [a, b] = [(); 2].map(|()| replay(&path, config));
        assert_eq!(bits(&a), bits(&b));
        assert_eq!(a.map, b.map);
    }
}
