//! `lineslam score` as a user runs it.

use std::f64::consts::TAU;
use std::fmt::Write;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use tempfile::TempDir;

struct Bench {
    folder: TempDir,
}

impl Bench {
    fn new() -> Self {
        Self { folder: tempfile::tempdir().unwrap() }
    }

    fn file(&self, name: &str, content: &str) -> PathBuf {
        let path = self.folder.path().join(name);
        std::fs::write(&path, content).unwrap();
        path
    }

    fn score(&self, arguments: &[&str]) -> Output {
        Command::new(env!("CARGO_BIN_EXE_lineslam"))
            .arg("score")
            .args(arguments)
            .current_dir(self.folder.path())
            .output()
            .unwrap()
    }

    fn json(&self, arguments: &[&str]) -> serde_json::Value {
        let output = self.score(&[arguments, &["--json"]].concat());
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        serde_json::from_slice(&output.stdout).unwrap()
    }

    /// The command must fail with code 2, say all of `words`, and print nothing else.
    fn refuses(&self, arguments: &[&str], words: &[&str]) {
        let output = self.score(arguments);
        let said = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{said}");
        for word in words {
            assert!(said.contains(word), "'{word}' is not in: {said}");
        }
        assert!(output.stdout.is_empty());
    }
}

/// A pose of a robot that drives twice round a circle of 8 m, 200 poses a round.
fn on_circle(k: u32) -> (f64, f64, f64) {
    let angle = TAU * f64::from(k) / 200.0;
    (8.0 * angle.cos(), 8.0 * angle.sin(), angle + TAU / 4.0)
}

/// The drive as a TUM file; each pose changed.
fn circle(change: impl Fn(u32, (f64, f64, f64)) -> (f64, f64, f64)) -> String {
    let mut text = String::from("# timestamp x y z qx qy qz qw\n");
    for k in 0..400 {
        let (x, y, heading) = change(k, on_circle(k));
        let stamp_s = 100.0 + 0.1 * f64::from(k);
        let (sin, cos) = (0.5 * heading).sin_cos();
        writeln!(text, "{stamp_s:.6} {x:.9} {y:.9} 0 0 0 {sin:.12} {cos:.12}").unwrap();
    }
    text
}

fn number(json: &serde_json::Value, path: &str) -> f64 {
    json.pointer(path).unwrap_or_else(|| panic!("no {path} in {json}")).as_f64().unwrap()
}

fn near(got: f64, want: f64) {
    assert!((got - want).abs() < 1e-6, "{got} is not {want}");
}

#[test]
fn a_trajectory_carried_elsewhere_has_no_error() {
    let bench = Bench::new();
    bench.file("ref.tum", &circle(|_, pose| pose));
    let (sin, cos) = 1.1_f64.sin_cos();
    let carried =
        |(x, y, heading): (f64, f64, f64)| (30.0 + cos * x - sin * y, sin * x + cos * y, heading + 1.1);
    for (name, text) in [("same.tum", circle(|_, p| p)), ("carried.tum", circle(|_, p| carried(p)))] {
        bench.file(name, &text);
        let json = bench.json(&[name, "--reference", "ref.tum"]);
        for measure in ["ate_rmse_m", "ate_med_m", "ate_max_m", "rot_rmse_deg"] {
            near(number(&json, &format!("/reference/{measure}")), 0.0);
        }
        near(number(&json, "/reference/coverage"), 1.0);
        near(number(&json, "/reference/path_est_m"), number(&json, "/reference/path_ref_m"));
        for kind in ["step", "1m", "5m", "10m", "25m", "50m", "revisit"] {
            near(number(&json, &format!("/reference/rpe/{kind}/trans_m")), 0.0);
            near(number(&json, &format!("/reference/rpe/{kind}/rot_deg")), 0.0);
        }
        near(number(&json, "/reference/rpe/step/n"), 399.0);
    }
}

#[test]
fn errors_of_a_known_size_are_found() {
    let bench = Bench::new();
    bench.file("ref.tum", &circle(|_, pose| pose));
    // Poses in turn 0.1 m farther out and nearer in, with headings off by 2°.
    let off = circle(|k, (x, y, heading)| {
        let scale = if k % 2 == 0 { 8.1 / 8.0 } else { 7.9 / 8.0 };
        (scale * x, scale * y, heading + 2.0_f64.to_radians())
    });
    bench.file("off.tum", &off);
    let json = bench.json(&["off.tum", "--reference", "ref.tum"]);
    for measure in ["ate_rmse_m", "ate_med_m", "ate_max_m"] {
        assert!((number(&json, &format!("/reference/{measure}")) - 0.1).abs() < 2e-4, "{json}");
    }
    assert!((number(&json, "/reference/rot_rmse_deg") - 2.0).abs() < 0.01, "{json}");
    near(number(&json, "/reference/rpe/step/rot_deg"), 0.0);
    assert!(number(&json, "/reference/rpe/step/trans_m") > 0.19, "{json}");

    let output = bench.score(&["off.tum", "--reference", "ref.tum"]);
    let table = String::from_utf8_lossy(&output.stdout);
    for word in ["off.tum, 400 poses", "rmse 0.1000 m", "back at a place", "50 m of way apart", "rotation, °"]
    {
        assert!(table.contains(word), "'{word}' is not in\n{table}");
    }
}

#[test]
fn where_poses_are_missing_the_robot_counts_as_standing_still_and_that_is_said() {
    let bench = Bench::new();
    bench.file("ref.tum", &circle(|_, pose| pose));
    let whole = circle(|_, pose| pose);
    let lines: Vec<&str> = whole.lines().collect();
    bench.file("half.tum", &lines[..201].join("\n"));
    let json = bench.json(&["half.tum", "--reference", "ref.tum"]);
    near(number(&json, "/reference/coverage"), 0.5);
    assert!(number(&json, "/reference/ate_rmse_m") > 1.0, "{json}");
    let output = bench.score(&["half.tum", "--reference", "ref.tum"]);
    let table = String::from_utf8_lossy(&output.stdout);
    assert!(table.contains("at 50.0 % of its stamps there is no pose: scored as standing still"), "{table}");
}

/// Relations of a quarter of a round, of both kinds of line.
fn relations(laser_m: f64) -> String {
    let mut text = String::new();
    for k in 0..10 {
        // A quarter round: ahead by the radius, to the left by the radius, turned by 90°; the laser turns with the robot.
        let (x, y) = (8.0 - laser_m, 8.0 + laser_m);
        let (a, b) = (100.0 + f64::from(k), 105.0 + f64::from(k));
        let turn = TAU / 4.0;
        if k % 2 == 0 {
            writeln!(text, "{a:.3} {b:.3} {x} {y} {turn}").unwrap();
        } else {
            writeln!(text, "{a:.3} {b:.3} {x} {y} 0 0 0 {turn}").unwrap();
        }
    }
    text
}

#[test]
fn relations_are_held_against_the_robot_or_its_laser() {
    let bench = Bench::new();
    bench.file("circle.tum", &circle(|_, pose| pose));
    bench.file("base.relations", &relations(0.0));
    bench.file("laser.relations", &(relations(0.25) + "500 501 0 0 0\n"));
    let json = bench.json(&["circle.tum", "--relations", "base.relations"]);
    near(number(&json, "/relations/trans_m"), 0.0);
    near(number(&json, "/relations/rot_deg"), 0.0);
    assert!(json.get("reference").is_none());
    let json = bench.json(&["circle.tum", "--relations", "laser.relations"]);
    near(number(&json, "/relations/trans_m"), 0.25 * 2.0_f64.sqrt());
    near(number(&json, "/relations/trans_std"), 0.0);
    let both =
        ["circle.tum", "--relations", "laser.relations", "--laser", "0.25", "--reference", "circle.tum"];
    let json = bench.json(&both);
    near(number(&json, "/relations/trans_m"), 0.0);
    near(number(&json, "/relations/n"), 10.0);
    near(number(&json, "/relations/of"), 11.0);
    near(number(&json, "/reference/ate_rmse_m"), 0.0);
    let output = bench.score(&both);
    let table = String::from_utf8_lossy(&output.stdout);
    assert!(table.contains("laser.relations, 10 of 11 used, of the laser 0.25 m ahead"), "{table}");
}

#[test]
fn what_cannot_be_used_is_named_with_its_line() {
    let bench = Bench::new();
    bench.file("good.tum", &circle(|_, pose| pose));
    bench.file("bad.tum", "1 0 0 0 0 0 0 1\n2 0 0 0 0 0 0\n");
    bench.file("one.tum", "1 0 0 0 0 0 0 1\n");
    bench.file("bad.relations", "# t1 t2 x y yaw\n100 101 0 0 0\n\n100 101 0 0 east\n");
    bench.file("empty.relations", "# nothing yet\n");
    bench.refuses(&["bad.tum", "--reference", "good.tum"], &["bad.tum", "line 2", "timestamp x y z"]);
    bench.refuses(&["good.tum", "--reference", "bad.tum"], &["bad.tum", "line 2"]);
    bench.refuses(&["one.tum", "--reference", "good.tum"], &["one.tum", "1 poses, at least 2"]);
    bench.refuses(
        &["good.tum", "--relations", "bad.relations"],
        &["bad.relations", "line 4", "t1 t2 x y yaw"],
    );
    bench.refuses(&["good.tum", "--relations", "empty.relations"], &["empty.relations", "0 relations"]);
    bench.refuses(&["absent.tum", "--reference", "good.tum"], &["absent.tum"]);
}

#[test]
fn files_of_different_times_are_an_error_with_both_spans() {
    let bench = Bench::new();
    bench.file("now.tum", &circle(|_, pose| pose));
    bench.file("then.tum", "1 0 0 0 0 0 0 1\n2 1 0 0 0 0 0 1\n");
    bench.file("then.relations", "1 2 0 0 0\n");
    let spans = ["100.000 to 139.900 s", "1.000 to 2.000 s", "do not overlap in time"];
    bench.refuses(&["now.tum", "--reference", "then.tum"], &spans);
    bench.refuses(&["now.tum", "--relations", "then.relations"], &spans);
}

#[test]
fn something_to_judge_by_is_needed() {
    let bench = Bench::new();
    let file = bench.file("now.tum", &circle(|_, pose| pose));
    let file: &Path = &file;
    bench.refuses(&[file.to_str().unwrap()], &["--reference", "--relations"]);
    bench.refuses(&["now.tum", "--reference", "now.tum", "--laser", "0.1"], &["--relations"]);
}
