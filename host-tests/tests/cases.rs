//! Odd inputs from the field around one clean drive, and what is right for each: `../shared/cases` has them and says so.
//!
//! Group A are files: each must do exactly what is said. Group B are drives in which something goes wrong: run and printed.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::OnceLock;

use comfy_table::{Table, presets};
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
        if name.starts_with('m') {
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

/// What is right for these is the next step of the project: what happens is printed.
#[test]
fn drives_in_which_something_goes_wrong_are_run() {
    let Some(cases) = Cases::new("drives_in_which_something_goes_wrong_are_run") else { return };
    let mut table = Table::new();
    table.load_style(presets::NOTHING);
    table.set_header(["case", "trajectory error, m", "largest sigma, m", "said"]);
    for name in [
        "m02", "m03", "m04", "m08", "m09", "m11", "m13", "m13b", "m13c", "m24", "m26", "m27", "m28", "m29",
        "m30", "c19", "c20",
    ] {
        let done = cases.replay(name, &[]);
        let error_m = done.error_m(&cases.truth(name));
        let report = done.report();
        let said: Vec<&str> =
            report["warnings"].as_array().unwrap().iter().filter_map(|w| w["suspected"].as_str()).collect();
        table.add_row([name.to_owned(), format!("{error_m:.4}"), sigma_m(&done), said.join(", ")]);
    }
    println!("{table}");
}

/// The largest standard deviation of a position that was reported.
fn sigma_m(done: &Done) -> String {
    let text = std::fs::read_to_string(done.out.join("trajectory.csv")).unwrap();
    let mut lines = text.lines();
    let column = |name: &str| text.lines().next().unwrap().split(',').position(|c| c == name).unwrap();
    let (xx, yy) = (column("cov_xx_m2"), column("cov_yy_m2"));
    lines.next();
    let variance = |line: &str| {
        let words: Vec<f64> = line.split(',').map(|w| w.parse().unwrap_or(0.0)).collect();
        words[xx].max(words[yy])
    };
    format!("{:.4}", lines.map(variance).fold(0.0, f64::max).sqrt())
}
