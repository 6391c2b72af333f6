//! Odd inputs from the field around one clean drive, and what is right for each: `../shared/cases` has them and says so.
//!
//! Group A are files: each must do exactly what is said. Group B are drives in which something goes wrong.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::OnceLock;

use host_tests::{lineslam, python_with, root, skipped};
use lineslam::score::{StampedPose, absolute_trajectory_error, parse_tum};
use serde_json::Value;

/// The cases, made once for all tests, and a test's folder for what is made of them.
struct Cases {
    made: &'static Path,
    out: tempfile::TempDir,
}

/// What `replay` did.
struct Done {
    code: i32,
    stderr: String,
    out: PathBuf,
}

impl Cases {
    /// `None`, said, where they cannot be made.
    fn new(test: &str) -> Option<Self> {
        let script = root().join("../shared/cases/make_cases.py");
        if !script.exists() {
            skipped(test, &script);
            return None;
        }
        let Some(python) = python_with("numpy") else {
            skipped(test, Path::new("python3 with numpy"));
            return None;
        };
        static MADE: OnceLock<PathBuf> = OnceLock::new();
        let made = MADE.get_or_init(|| {
            let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("cases");
            let robot = root().join("robots/paper.toml");
            let made = Command::new(python).arg(script).arg(&folder).arg(robot).output().unwrap();
            assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));
            folder
        });
        Some(Self { made, out: tempfile::tempdir().unwrap() })
    }

    /// The case whose file begins with this name and ends in `.log`, `.dat` or `.dat.gz`.
    fn file(&self, name: &str) -> PathBuf {
        let files = std::fs::read_dir(self.made).unwrap().map(|entry| entry.unwrap().path());
        let fits = |path: &PathBuf| {
            let file = path.file_name().unwrap().to_string_lossy().into_owned();
            file.starts_with(&format!("{name}_"))
                && [".log", ".dat", ".dat.gz"].iter().any(|end| file.ends_with(end))
        };
        files.into_iter().find(fits).unwrap_or_else(|| panic!("no case {name}"))
    }

    fn replay(&self, name: &str, more: &[&str]) -> Done {
        let log = self.file(name);
        let out = self.out.path().join(name);
        // Nothing of an earlier run of the same case.
        let _ = std::fs::remove_dir_all(&out);
        let mut command = Command::new(lineslam());
        command.arg("replay").arg(&log).arg("--out").arg(&out).args(more);
        if name.starts_with('m') && !more.contains(&"--robot") {
            // A robot file of the case's own name lies beside it where it has another robot.
            let own = self.made.join(log.file_name().unwrap()).with_extension("toml");
            command.arg("--robot").arg(if own.exists() { own } else { root().join("robots/paper.toml") });
        }
        let output = command.output().unwrap();
        let stderr = String::from_utf8(output.stderr).unwrap();
        Done { code: output.status.code().unwrap(), stderr, out }
    }

    /// The truth of a case: its own, or that of the clean drive.
    fn truth(&self, name: &str) -> Vec<StampedPose> {
        let log = self.file(name);
        let stem = log.file_name().unwrap().to_string_lossy().split(".dat").next().unwrap().to_owned();
        let own = self.made.join(format!("{}.truth.tum", stem.trim_end_matches(".log")));
        let base = if name.starts_with('m') { "m01_base" } else { "c01_base" };
        let path = if own.exists() { own } else { self.made.join(format!("{base}.truth.tum")) };
        parse_tum(&std::fs::read_to_string(path).unwrap()).unwrap()
    }
}

impl Done {
    fn report(&self) -> Value {
        assert_eq!(self.code, 0, "{}", self.stderr);
        serde_json::from_slice(&std::fs::read(self.out.join("report.json")).unwrap()).unwrap()
    }

    fn poses(&self, file: &str) -> Vec<StampedPose> {
        assert_eq!(self.code, 0, "{}", self.stderr);
        parse_tum(&std::fs::read_to_string(self.out.join(file)).unwrap()).unwrap()
    }

    /// Trajectory error against the truth, metres, by stamps.
    fn error_m(&self, truth: &[StampedPose]) -> f64 {
        let poses = self.poses("trajectory.tum");
        // A truth of a scan that was left out has no pose to be held against.
        let has = |t: &&StampedPose| poses.iter().any(|p| (p.stamp_s - t.stamp_s).abs() < 2e-3);
        let truth: Vec<StampedPose> = truth.iter().filter(has).copied().collect();
        assert!(!truth.is_empty(), "no stamp agrees");
        absolute_trajectory_error(&poses, &truth).unwrap()
    }

    /// A column of `trajectory.csv`.
    fn column(&self, name: &str) -> Vec<String> {
        let text = std::fs::read_to_string(self.out.join("trajectory.csv")).unwrap();
        let mut lines = text.lines().map(|line| line.split(','));
        let k = lines.next().unwrap().position(|c| c == name).unwrap();
        lines.map(|mut words| words.nth(k).unwrap().to_owned()).collect()
    }

    fn off(&self, truth: &[StampedPose]) -> Vec<Off> {
        let variances = ["cov_xx_m2", "cov_yy_m2"]
            .map(|name| self.column(name).into_iter().map(|w| w.parse::<f64>().unwrap()));
        let [xx, yy] = variances;
        let sigmas_m: Vec<f64> = xx.zip(yy).map(|(xx, yy)| xx.max(yy).sqrt()).collect();
        off(&self.poses("trajectory.tum"), truth, &sigmas_m)
    }

    fn least_distance_of_path_and_walls_m(&self) -> f64 {
        let map = std::fs::read_to_string(self.out.join("map.csv")).unwrap();
        let walls: Vec<Vec<f64>> =
            map.lines().skip(1).map(|line| line.split(',').map(|w| w.parse().unwrap()).collect()).collect();
        let distance = |p: &StampedPose, w: &[f64]| {
            let (x, y) = (p.pose.translation.x, p.pose.translation.y);
            let (dx, dy) = (w[2] - w[0], w[3] - w[1]);
            let along = (((x - w[0]) * dx + (y - w[1]) * dy) / (dx * dx + dy * dy)).clamp(0.0, 1.0);
            (x - w[0] - along * dx).hypot(y - w[1] - along * dy)
        };
        let poses = self.poses("trajectory.tum");
        let all = poses.iter().flat_map(|p| walls.iter().map(move |w| distance(p, w)));
        all.fold(f64::INFINITY, f64::min)
    }

    fn suspects(&self, what: &str) -> bool {
        let report = self.report();
        let warnings = report["warnings"].as_array().unwrap();
        let said = |w: &Value| w["suspected"] == what && self.stderr.contains(w["message"].as_str().unwrap());
        warnings.iter().any(said)
    }

    /// Exit code 2 with these words, and nothing written.
    fn refused(&self, words: &[&str]) {
        assert_eq!(self.code, 2, "{}", self.stderr);
        for word in words {
            assert!(self.stderr.contains(word), "'{word}' is not in: {}", self.stderr);
        }
        assert!(!self.out.exists());
    }
}

/// As clean as the drive without the twist: within a millimetre or a tenth, whichever is more.
fn is_clean(error_m: f64, base_m: f64) -> bool {
    error_m <= base_m + f64::max(0.001, 0.1 * base_m)
}

#[test]
fn carmen_files_do_what_is_right() {
    let Some(cases) = Cases::new("carmen_files_do_what_is_right") else { return };
    let truth = cases.truth("c01");
    let base = cases.replay("c01", &[]);
    let base_m = base.error_m(&truth);
    println!("c01: {base_m:.4} m");
    assert!(base_m < 0.003 && base.stderr.is_empty());
    let no_skips = serde_json::json!({});
    let one = |reason: &str| serde_json::json!({ reason: 1 });
    for (name, scans, skipped) in [
        ("c02", 454, no_skips.clone()),
        ("c03", 454, no_skips.clone()),
        ("c05", 454, no_skips.clone()),
        ("c07", 454, no_skips.clone()),
        ("c08", 429, no_skips.clone()),
        ("c11", 454, one("odometry_time_not_increasing")),
        ("c17", 454, no_skips.clone()),
        ("c18", 454, no_skips.clone()),
        ("c21", 453, one("cut_off")),
        ("c22", 454, no_skips.clone()),
        ("c23", 454, no_skips),
    ] {
        let done = cases.replay(name, &[]);
        let error_m = done.error_m(&truth);
        println!("{name}: {error_m:.4} m");
        assert!(is_clean(error_m, base_m), "{name}: {error_m} m, {base_m} m without the twist");
        assert_eq!(done.report()["scans_used"], scans, "{name}");
        assert_eq!(done.report()["records_skipped"], skipped, "{name}");
    }
    // The last line of a recorder that was stopped hard is said without being an error.
    assert!(cases.replay("c21", &[]).suspects("cut_off"));
    // No motion is lost while the scanner is silent.
    let (silent, end) =
        (cases.replay("c08", &[]), |done: &Done| done.poses("odometry.tum").pop().unwrap().pose);
    let off_m = (end(&silent).translation.vector - end(&base).translation.vector).norm();
    let way_m = |done: &Done| done.report()["distance_m"].as_f64().unwrap();
    assert!(off_m < 1e-3 && (way_m(&silent) - way_m(&base)).abs() < 1e-3, "{off_m} m off");
}

#[test]
fn units_and_stamps_that_are_wrong_are_said() {
    let Some(cases) = Cases::new("units_and_stamps_that_are_wrong_are_said") else { return };
    let base = cases.replay("c01", &[]).poses("trajectory.tum");
    let as_the_base = |poses: Vec<StampedPose>| {
        assert_eq!(poses.len(), base.len());
        let off = |(a, b): (&StampedPose, &StampedPose)| {
            (a.pose.translation.vector - b.pose.translation.vector).norm()
        };
        let worst = poses.iter().zip(&base).map(off).fold(0.0, f64::max);
        assert!(worst < 0.01, "{worst} m off");
    };
    cases.replay("c04", &[]).refused(&["median range is 2227 m", "millimetres", "--ranges mm"]);
    as_the_base(cases.replay("c04", &["--ranges", "mm"]).poses("trajectory.tum"));
    let epoch = cases.replay("c13", &[]);
    assert!(epoch.suspects("stamps_not_in_seconds") && epoch.stderr.contains("milliseconds"));
    let poses = epoch.poses("trajectory.tum");
    assert!((poses[0].stamp_s - 1.6e9 - 0.2).abs() < 1e-3, "{}", poses[0].stamp_s);
    as_the_base(poses);
    let without = cases.replay("c16", &[]);
    assert!(without.suspects("stamps_made_up"));
    as_the_base(without.poses("trajectory.tum"));
    cases.replay("m06", &[]).refused(&["0.1 ms apart", "milliseconds", "--stamps ms"]);
    let told = cases.replay("m06", &["--stamps", "ms"]);
    let error_m = told.error_m(&cases.truth("m01"));
    assert!(is_clean(error_m, 0.0005), "{error_m}");
}

#[test]
fn mines_files_do_what_is_right() {
    let Some(cases) = Cases::new("mines_files_do_what_is_right") else { return };
    let truth = cases.truth("m01");
    let base = cases.replay("m01", &[]);
    let base_m = base.error_m(&truth);
    println!("m01: {base_m:.4} m");
    assert!(base_m < 0.001 && base.stderr.is_empty());
    for (name, scans) in [("m14", 908), ("m15", 908), ("m16", 908), ("m17", 907), ("m19", 908)] {
        let done = cases.replay(name, &[]);
        let error_m = done.error_m(&cases.truth(name));
        println!("{name}: {error_m:.4} m");
        assert!(is_clean(error_m, base_m), "{name}: {error_m} m, {base_m} m without the twist");
        assert_eq!(done.report()["scans_used"], scans, "{name}");
    }
    let cut = cases.replay("m17", &[]);
    assert!(cut.suspects("cut_off"));
    assert_eq!(cut.report()["records_skipped"], serde_json::json!({ "cut_off": 1 }));
    let trajectory = |done: &Done| std::fs::read(done.out.join("trajectory.tum")).unwrap();
    let twice = cases.replay("m18", &[]);
    assert_eq!(twice.report()["records_skipped"], serde_json::json!({ "repeated": 1 }));
    assert_eq!(trajectory(&twice), trajectory(&base), "bit for bit");
    cases.replay("m20", &[]).refused(&["line 909", "backwards", "908 scans", "--lenient"]);
    let first = cases.replay("m20", &["--lenient"]);
    assert!(first.suspects("second_run") && first.stderr.contains("908 scans"), "{}", first.stderr);
    assert_eq!(trajectory(&first), trajectory(&base), "the first run");
    cases.replay("m21", &[]).refused(&["line 1", "363 numbers", "707"]);
    cases.replay("m23", &[]).refused(&["UTF-16", "expected"]);
}

#[test]
fn twists_of_the_scans_leave_the_drive_clean() {
    let Some(cases) = Cases::new("twists_of_the_scans_leave_the_drive_clean") else { return };
    for (names, base) in [(&["m11", "m13", "m13b", "m13c", "m29", "m30"][..], "m01"), (&["c19"], "c01")] {
        let base_m = cases.replay(base, &[]).error_m(&cases.truth(base));
        for name in names {
            let done = cases.replay(name, &[]);
            let error_m = done.error_m(&cases.truth(name));
            println!("{name}: {error_m:.4} m");
            assert!(is_clean(error_m, base_m), "{name}: {error_m} m, {base_m} m without the twist");
        }
    }
    // What the scanner sees of the robot itself makes no wall on its path.
    let done = cases.replay("m11", &[]);
    let least_m = done.least_distance_of_path_and_walls_m();
    println!("m11: the path passes a wall at {least_m:.3} m");
    assert!(least_m > 0.2, "{least_m} m");
    // A revolution that scans every 100 ms cannot take: as clean, or named.
    let wrong = cases.made.join("m31_revolution_wrong.toml");
    let done = cases.replay("m01", &["--robot", wrong.to_str().unwrap()]);
    let error_m = done.error_m(&cases.truth("m01"));
    println!("m01 with m31: {error_m:.4} m");
    let base_m = cases.replay("m01", &[]).error_m(&cases.truth("m01"));
    assert!(is_clean(error_m, base_m), "{error_m} m");
    // Head down without the robot file's flag.
    let upright = root().join("robots/paper.toml");
    assert!(
        cases.replay("m30", &["--robot", upright.to_str().unwrap()]).suspects("odometry_turns_the_other_way")
    );
}

#[test]
fn odometry_that_is_wrong_is_found_out_and_the_scanner_followed() {
    let Some(cases) = Cases::new("odometry_that_is_wrong_is_found_out_and_the_scanner_followed") else {
        return;
    };
    for (name, most_m, said) in [
        ("m02", 0.05, "odometry_useless"),
        ("m03", 0.05, "odometry_useless"),
        ("m04", 0.05, "odometry_useless"),
        ("m24", 0.02, "odometry_slipped"),
        ("c20", 0.10, "odometry_useless"),
    ] {
        let done = cases.replay(name, &[]);
        let (error_m, off) = (done.error_m(&cases.truth(name)), done.off(&cases.truth(name)));
        let sigmas = worst_in_sigmas(&off);
        println!("{name}: {error_m:.4} m, at worst {sigmas:.1} sigmas");
        assert!(error_m <= most_m, "{name}: {error_m} m");
        assert!(done.suspects(said), "{name}: {}", done.stderr);
        // What is wrong has been said; beyond this the covariance would be of no use all the same.
        assert!(sigmas <= 10.0, "{name}: wrong by {sigmas} of its own sigmas");
    }
    for (name, words) in [
        ("m02", "the wheels seem swapped"),
        ("m03", "the right encoder counts backward"),
        ("m04", "the left encoder is dead"),
    ] {
        let done = cases.replay(name, &[]);
        assert!(done.suspects("wheel_fault") && done.stderr.contains(words), "{name}: {}", done.stderr);
        let out = cases.out.path().join(format!("{name}.toml"));
        let refused = Command::new(lineslam())
            .args(["calibrate", "--robot"])
            .arg(root().join("robots/paper.toml"))
            .arg("--out")
            .arg(&out)
            .arg(cases.file(name))
            .output()
            .unwrap();
        let said = String::from_utf8_lossy(&refused.stderr).into_owned();
        assert!(!refused.status.success() && said.contains(words), "{name}: {said}");
        assert!(!out.exists(), "{name}: something was written");
    }
    // The robot stands while its wheels spin: from its truth's halt on the pose stays too.
    let (done, truth) = (cases.replay("m24", &[]), cases.truth("m24"));
    let stands = |a: &StampedPose, b: &StampedPose| {
        (a.pose.translation.vector - b.pose.translation.vector).norm() < 1e-6
    };
    let halts: Vec<f64> = truth.windows(2).filter(|w| stands(&w[0], &w[1])).map(|w| w[1].stamp_s).collect();
    let first_s = done.report()["tracking"]["first_left_out_s"].as_f64().unwrap();
    let halt = halts.iter().filter(|s| (**s - first_s).abs() < 5.0);
    let poses = done.poses("trajectory.tum");
    let there: Vec<_> = halt
        .filter_map(|s| poses.iter().find(|p| (p.stamp_s - s).abs() < 2e-3))
        .map(|p| p.pose.translation.vector)
        .collect();
    assert!(there.len() > 20, "{} scans at a halt", there.len());
    let moved_m = there.iter().map(|p| (p - there[0]).norm()).fold(0.0, f64::max);
    println!("m24: moved {moved_m:.4} m");
    assert!(moved_m < 0.05, "{moved_m} m");
}

#[test]
fn without_anything_to_see_it_is_lost_and_says_so() {
    let Some(cases) = Cases::new("without_anything_to_see_it_is_lost_and_says_so") else { return };
    let blind = cases.replay("m08", &[]);
    let states = blind.column("state");
    assert!(states.last().unwrap() == "lost" && blind.suspects("tracking_lost"));
    assert!(blind.poses("trajectory.tum").iter().all(|p| p.pose.translation.vector.norm().is_finite()));
    let variances: Vec<f64> = blind.column("cov_xx_m2").iter().map(|w| w.parse().unwrap()).collect();
    assert!(variances.iter().all(|v| v.is_finite()) && variances.last() > variances.get(100));
    // Empty scans first are no harm.
    let late = cases.replay("m09", &[]);
    let error_m = late.error_m(&cases.truth("m09"));
    println!("m09: {error_m:.4} m");
    assert!(error_m <= 0.01, "{error_m} m");
}

#[test]
fn standing_spinning_and_going_to_and_fro_hold_the_pose() {
    let Some(cases) = Cases::new("standing_spinning_and_going_to_and_fro_hold_the_pose") else { return };
    let worst = |name: &str| {
        let off = cases.replay(name, &[]).off(&cases.truth(name));
        let most = |of: fn(&Off) -> f64| off.iter().map(of).fold(0.0, f64::max);
        let (off_m, off_deg) = (most(|o| o.position_m), most(|o| o.heading_rad.to_degrees()));
        println!("{name}: at worst {off_m:.4} m, {off_deg:.3} degrees");
        (off_m, off_deg)
    };
    let (off_m, off_deg) = worst("m26");
    assert!(off_m < 0.005 && off_deg < 0.1);
    assert!(worst("m27").1 < 0.5);
    // Dead reckoning comes back over the wrap of the counters.
    let done = cases.replay("m28", &[]);
    let off = off(&done.poses("odometry.tum"), &cases.truth("m28"), &[]);
    println!("m28: odometry ends {:.4} m off", off.last().unwrap().position_m);
    assert!(off.last().unwrap().position_m < 0.002);
}

/// How far a pose is off when the first is laid on the truth's, and its own standard deviation of the position.
struct Off {
    position_m: f64,
    heading_rad: f64,
    sigma_m: f64,
}

fn off(poses: &[StampedPose], truth: &[StampedPose], sigmas_m: &[f64]) -> Vec<Off> {
    let of = |pose: &StampedPose| truth.iter().find(|t| (t.stamp_s - pose.stamp_s).abs() < 2e-3);
    let pairs: Vec<(usize, &StampedPose, &StampedPose)> =
        poses.iter().enumerate().filter_map(|(k, pose)| Some((k, pose, of(pose)?))).collect();
    let map_from_world = pairs[0].1.pose * pairs[0].2.pose.inverse();
    let off = |(k, pose, truth): &(usize, &StampedPose, &StampedPose)| {
        let wrong = (map_from_world * truth.pose).inverse() * pose.pose;
        Off {
            position_m: wrong.translation.vector.norm(),
            heading_rad: wrong.rotation.angle().abs(),
            sigma_m: sigmas_m.get(*k).copied().unwrap_or(f64::NAN),
        }
    };
    pairs.iter().map(off).collect()
}

/// The worst error in its own standard deviations. The first pose's error is in all of them: a millimetre is allowed for it.
fn worst_in_sigmas(off: &[Off]) -> f64 {
    off.iter().map(|o| o.position_m / (o.sigma_m + 1e-3)).fold(0.0, f64::max)
}
