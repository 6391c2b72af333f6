//! The measures of `lineslam::score` against those of the referee, Python scripts beside the recorded logs that share no code with
//! ours. They need numpy; `cargo xtask test` provides it. Where scripts, Python or logs are absent each test says that it was skipped.

use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::process::Command;

use host_tests::{data, recorded, root, skipped};
use lineslam::benchmark::{perturbed, walls};
use lineslam::log::{self, Log, ReadOptions};
use lineslam::output::tum;
use lineslam::replay;
use lineslam::robot::Robot;
use lineslam::score::{
    AgainstReference, StampedPose, against_reference, at_laser, parse_tum, read_relations, read_tum,
    relation_errors,
};
use nalgebra::{Isometry2, Vector2};
use slam_core::SlamConfig;

/// Agreement that is asked for: metres, degrees.
const WITHIN: f64 = 1e-4;

/// A Python with numpy, and the folder of the scripts.
struct Referee {
    python: OsString,
    scripts: PathBuf,
}

impl Referee {
    /// `None` where it cannot be had; the test says so.
    fn call(test: &str) -> Option<Self> {
        let scripts = root().join("../shared/referee");
        let python = std::env::var_os("LINESLAM_PYTHON").unwrap_or_else(|| "python3".into());
        let imports = Command::new(&python).args(["-c", "import numpy"]).output();
        if !imports.is_ok_and(|o| o.status.success()) {
            skipped(test, Path::new("python3 with numpy"));
            return None;
        }
        if !scripts.join("score.py").exists() {
            skipped(test, &scripts);
            return None;
        }
        Some(Self { python, scripts })
    }

    fn run(&self, command: &mut Command) -> String {
        let output = command.output().unwrap();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        String::from_utf8(output.stdout).unwrap()
    }

    /// What it says of a trajectory on a log with a reference: JSON.
    fn score(&self, log: &str, trajectory: &Path) -> String {
        let mut command = Command::new(&self.python);
        command.arg(self.scripts.join("score.py")).arg(log).arg(trajectory).arg("--json");
        self.run(command.arg("--data").arg(data()))
    }

    /// Number of relations used, mean and deviation of the translation, mean and deviation of the rotation, median of the translation.
    fn relations(&self, trajectory: &Path, relations: &Path, laser_m: f64) -> [f64; 6] {
        let script = "import sys; sys.path.insert(0, sys.argv[1]); import numpy, relations\n\
                      e, r, n = relations.errors(sys.argv[2], sys.argv[3], float(sys.argv[4]))\n\
                      print(len(e), e.mean(), e.std(), r.mean(), r.std(), numpy.median(e))";
        let mut command = Command::new(&self.python);
        command.args(["-B", "-c", script]).arg(&self.scripts).arg(trajectory).arg(relations);
        let said = self.run(command.arg(laser_m.to_string()));
        let numbers: Vec<f64> = said.split_whitespace().map(|w| w.parse().unwrap()).collect();
        numbers.try_into().unwrap()
    }
}

/// The number after these keys, one after the other.
fn value(json: &str, keys: &[&str]) -> f64 {
    let rest = keys.iter().fold(json, |rest, key| {
        rest.split_once(&format!("\"{key}\":")).unwrap_or_else(|| panic!("no {key} in {json}")).1
    });
    rest.split([',', '}']).next().unwrap().trim().parse().unwrap()
}

fn assert_agrees(what: &str, theirs: f64, ours: f64) {
    assert!((theirs - ours).abs() < WITHIN, "{what}: the referee says {theirs}, we say {ours}");
}

/// Every measure of ours and the referee's; the largest difference.
fn compare(name: &str, said: &str, ours: &AgainstReference) -> f64 {
    let mut pairs = vec![
        ("coverage".to_owned(), value(said, &["coverage"]), ours.coverage),
        ("ATE".into(), value(said, &["reference", "ate_rmse_m"]), ours.ate_rmse_m),
        ("median".into(), value(said, &["reference", "ate_med_m"]), ours.ate_med_m),
        ("max".into(), value(said, &["reference", "ate_max_m"]), ours.ate_max_m),
        ("heading".into(), value(said, &["reference", "rot_rmse_deg"]), ours.rot_rmse_deg),
        ("path of the reference".into(), value(said, &["reference", "path_ref_m"]), ours.path_ref_m),
        ("path".into(), value(said, &["reference", "path_est_m"]), ours.path_est_m),
    ];
    for (kind, e) in &ours.rpe {
        let at = |key: &str| value(said, &["rpe", kind, key]);
        pairs.push((format!("pairs of {kind}"), at("n"), e.n as f64));
        pairs.push((format!("{kind}, translation"), at("trans_m"), e.trans_m));
        pairs.push((format!("{kind}, its deviation"), at("trans_std"), e.trans_std));
        pairs.push((format!("{kind}, its median"), at("trans_med"), e.trans_med));
        pairs.push((format!("{kind}, rotation"), at("rot_deg"), e.rot_deg));
        pairs.push((format!("{kind}, its deviation"), at("rot_std"), e.rot_std));
    }
    let rpe = said.split_once("\"rpe\":").unwrap().1.split_once("}\n  }").map_or("", |(rpe, _)| rpe);
    assert_eq!(rpe.matches("\"n\":").count(), ours.rpe.len(), "{name}: the same kinds of pairs: {said}");
    for (what, theirs, ours) in &pairs {
        assert_agrees(&format!("{name}, {what}"), *theirs, *ours);
    }
    pairs.iter().map(|(_, theirs, ours)| (theirs - ours).abs()).fold(0.0, f64::max)
}

/// A reference as a poor estimate of itself: elsewhere, drifting, noisy, begun late, with stamps of its own and with gaps.
fn spoilt(reference: &[StampedPose]) -> String {
    let mut state = 0x9E37_79B9_7F4A_7C15_u64;
    let mut noise = || {
        // xorshift64
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        (state >> 11) as f64 / (1u64 << 53) as f64 - 0.5
    };
    let n = reference.len();
    let carry = Isometry2::new(Vector2::new(12.0, -7.0), 2.5);
    let poses: Vec<_> = reference
        .iter()
        .enumerate()
        .map(|(k, p)| {
            let drift = 1e-3 * k as f64;
            let off = Isometry2::new(Vector2::new(0.1 * noise() + drift, 0.1 * noise()), 0.05 * noise());
            let late_us = if k % 5 == 0 { 30_000 } else { 0 };
            ((p.stamp_s * 1e6).round() as u64 + late_us, carry * p.pose * off)
        })
        .enumerate()
        .filter(|(k, _)| *k > n / 50 && k % 7 != 0 && !(n / 2..n / 2 + n / 20).contains(k))
        .map(|(_, pose)| pose)
        .collect();
    tum::render_f64(poses.iter().map(|(stamp_us, pose)| (*stamp_us, pose)))
}

#[test]
fn the_referee_agrees_on_poor_trajectories() {
    let test = "the_referee_agrees_on_poor_trajectories";
    let Some(referee) = Referee::call(test) else { return };
    let folder = tempfile::tempdir().unwrap();
    for log in ["exp1", "csail", "fr079", "fr101", "seattle"] {
        let Some(reference) = recorded(&format!("{log}.ref.tum"), test) else { continue };
        let reference = read_tum(&reference).unwrap();
        let text = spoilt(&reference);
        let file = folder.path().join(format!("{log}.tum"));
        std::fs::write(&file, &text).unwrap();
        let estimate = parse_tum(&text).unwrap();
        let ours = against_reference(&estimate, &reference).unwrap();
        assert!(ours.coverage < 1.0 && ours.exact < ours.coverage, "{log}: gaps and stamps of its own");
        let off = compare(log, &referee.score(log, &file), &ours);
        println!("{log}: largest difference from the referee {off:.1e}");
    }
}

#[test]
fn the_referee_agrees_on_relations() {
    let test = "the_referee_agrees_on_relations";
    let Some(referee) = Referee::call(test) else { return };
    let Some(trajectory) = recorded("fr079.ref.tum", test) else { return };
    let Some(relations) = recorded("fr079.relations", test) else { return };
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("fr079.tum");
    std::fs::write(&file, spoilt(&read_tum(&trajectory).unwrap())).unwrap();
    for (trajectory, laser_m) in [(&trajectory, 0.0), (&trajectory, 0.04), (&file, 0.0), (&file, -0.2)] {
        let poses = at_laser(&read_tum(trajectory).unwrap(), laser_m);
        let e = relation_errors(&poses, &read_relations(&relations).unwrap()).unwrap().errors;
        let ours = [e.n as f64, e.trans_m, e.trans_std, e.rot_deg, e.rot_std, e.trans_med];
        let theirs = referee.relations(trajectory, &relations, laser_m);
        for (theirs, ours) in theirs.into_iter().zip(ours) {
            assert_agrees(&format!("{}, laser {laser_m}", trajectory.display()), theirs, ours);
        }
        println!("fr079, laser {laser_m}: {theirs:?}");
    }
}

/// A log whose walls must stay thin.
struct Thin {
    name: &'static str,
    file: &'static str,
    /// Thickness of the walls of the reference's own map, metres, as the referee measures it …
    reference_m: f64,
    /// … and how many times that ours may be.
    thicker: f64,
}

const LOGS: [Thin; 5] = [
    Thin { name: "exp1", file: "exp1.dat.gz", reference_m: 0.039, thicker: 1.3 },
    Thin { name: "csail", file: "csail.log.gz", reference_m: 0.029, thicker: 1.8 },
    Thin { name: "fr079", file: "fr079.log.gz", reference_m: 0.054, thicker: 1.1 },
    Thin { name: "fr101", file: "fr101.log.gz", reference_m: 0.034, thicker: 1.2 },
    Thin { name: "seattle", file: "seattle.log.gz", reference_m: 0.016, thicker: 1.2 },
];

#[test]
fn the_referee_agrees() {
    let test = "the_referee_agrees";
    let Some(referee) = Referee::call(test) else { return };
    let folder = tempfile::tempdir().unwrap();
    for Thin { name, file, reference_m, .. } in LOGS {
        let Some(path) = recorded(file, test) else { continue };
        let log = log::read(&path, &ReadOptions::default()).unwrap();
        let robot = Robot::usual_for(log.format);
        let replayed = replay::run(&log, &robot, SlamConfig::default(), || {}).unwrap();
        let text = tum::render(replay::final_trajectory(&replayed.steps));
        let trajectory = folder.path().join(format!("{name}.tum"));
        std::fs::write(&trajectory, &text).unwrap();
        let said = referee.score(name, &trajectory);
        assert_eq!(value(&said, &["coverage"]), 1.0, "{name}: a pose for every scan");
        let poses = parse_tum(&text).unwrap();
        let reference = read_tum(&data().join(format!("{name}.ref.tum"))).unwrap();
        let ours = against_reference(&poses, &reference).unwrap();
        let off = compare(name, &said, &ours);
        let thickness_m = value(&said, &["thickness_med_m"]);
        let ours_m = walls(&log, &replayed, &poses).whole_m;
        assert!(
            (ours_m / thickness_m - 1.0).abs() < 0.05,
            "{name}: the referee says walls are {thickness_m} m thick, we say {ours_m}"
        );
        println!(
            "{name}: error {:.3} m, largest difference from the referee {off:.1e}, wall thickness {thickness_m:.4} m ({ours_m:.4} m by ours), the \
             reference's {reference_m:.3} m",
            ours.ate_rmse_m
        );
    }
}

/// One drive may have luck or none: the median of it as it is and four times with 5 mm more noise.
#[test]
fn walls_are_as_thin_as_the_references_on_most_drives() {
    let test = "walls_are_as_thin_as_the_references_on_most_drives";
    for Thin { name, file, reference_m, thicker } in LOGS {
        let Some(path) = recorded(file, test) else { continue };
        let log = log::read(&path, &ReadOptions::default()).unwrap();
        let robot = Robot::usual_for(log.format);
        let thickness_m = |log: &Log| -> f64 {
            let replayed = replay::run(log, &robot, SlamConfig::default(), || {}).unwrap();
            let poses = parse_tum(&tum::render(replay::final_trajectory(&replayed.steps))).unwrap();
            walls(log, &replayed, &poses).whole_m
        };
        let mut found_m: Vec<f64> = std::thread::scope(|threads| {
            let noisy = (1..=4).map(|seed| perturbed(&log, &robot, 0.005, seed));
            let drives: Vec<_> = noisy.map(|log| threads.spawn(move || thickness_m(&log))).collect();
            std::iter::once(thickness_m(&log)).chain(drives.into_iter().map(|d| d.join().unwrap())).collect()
        });
        found_m.sort_by(f64::total_cmp);
        println!("{name}: walls {found_m:.4?} m thick, the reference's {reference_m:.3} m");
        assert!(found_m[2] <= thicker * reference_m, "walls of {name} are {found_m:.4?} m thick");
    }
}

/// On the logs with relations, with the odometry of the robots.
#[test]
fn the_referee_agrees_on_relations_of_bags() {
    let test = "the_referee_agrees_on_relations_of_bags";
    let Some(referee) = Referee::call(test) else { return };
    let folder = tempfile::tempdir().unwrap();
    for (name, laser_m, most_m) in [("aces", 0.0, 0.07), ("fr079", 0.04, 0.045), ("mit-csail", 0.0, 0.040)] {
        let Some(path) = recorded(&format!("kuemmerle/{name}.bag"), test) else { continue };
        let Some(relations) = recorded(&format!("kuemmerle/{name}.relations"), test) else { continue };
        let log = log::read(&path, &ReadOptions::default()).unwrap();
        let robot = Robot::usual_for(log.format);
        let steps = replay::run(&log, &robot, SlamConfig::default(), || {}).unwrap().steps;
        let trajectory = folder.path().join(format!("{name}.tum"));
        std::fs::write(&trajectory, tum::render(replay::final_trajectory(&steps))).unwrap();
        let poses = at_laser(&read_tum(&trajectory).unwrap(), laser_m);
        let found = relation_errors(&poses, &read_relations(&relations).unwrap()).unwrap();
        let e = found.errors;
        let ours = [e.n as f64, e.trans_m, e.trans_std, e.rot_deg, e.rot_std, e.trans_med];
        for (theirs, ours) in referee.relations(&trajectory, &relations, laser_m).into_iter().zip(ours) {
            assert_agrees(name, theirs, ours);
        }
        println!(
            "{name}: {:.4} ± {:.4} m, {:.3} ± {:.3}°, {} of {}",
            e.trans_m, e.trans_std, e.rot_deg, e.rot_std, e.n, found.of
        );
        assert!(e.trans_m <= most_m, "{name}: {} m", e.trans_m);
    }
}
