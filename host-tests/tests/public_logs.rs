//! Logs as people download them: read without any flag, and what is odd about each is said.

use std::path::PathBuf;
use std::process::Command;

use host_tests::{lineslam, recorded};
use serde_json::Value;

/// The report of a replay without a robot file or any flag, and what it said on stderr.
fn replay(file: &str, test: &str) -> Option<(Value, String)> {
    let path: PathBuf = recorded(file, test)?;
    let out = tempfile::tempdir().unwrap();
    let output =
        Command::new(lineslam()).arg("replay").arg(path).arg("--out").arg(out.path()).output().unwrap();
    let stderr = String::from_utf8(output.stderr).unwrap();
    assert!(output.status.success(), "{file}: {stderr}");
    let report = std::fs::read(out.path().join("report.json")).unwrap();
    let report: Value = serde_json::from_slice(&report).unwrap();
    let scans = &report["scans_used"];
    println!(
        "{file}: {scans} scans, {:.1} m, skipped {}",
        report["distance_m"].as_f64().unwrap(),
        report["records_skipped"]
    );
    Some((report, stderr))
}

fn suspects(report: &Value, what: &str) -> bool {
    report["warnings"].as_array().unwrap().iter().any(|warning| warning["suspected"] == what)
}

#[test]
fn public_logs_give_what_their_table_says() {
    let test = "public_logs_give_what_their_table_says";
    if let Some((report, _)) = replay("public/freiburg-101-corrected.log.gz", test) {
        assert_eq!(report["scans_used"], 292);
    }
    if let Some((report, _)) = replay("public/fhw-corrected.log.gz", test) {
        assert_eq!(report["scans_used"], 488);
        let distance_m = report["distance_m"].as_f64().unwrap();
        assert!((distance_m - 404.0).abs() < 4.0, "{distance_m}");
    }
    if let Some((report, stderr)) = replay("public/orebro-corrected.log.gz", test) {
        assert_eq!(report["scans_used"], 237);
        assert!(suspects(&report, "stamps_made_up") && stderr.contains("order in the file"));
    }
    if let Some((report, stderr)) = replay("public/test_lab2.dat.gz", test) {
        assert_eq!(report["scans_used"], 404);
        assert_eq!(report["records_skipped"]["cut_off"], 1);
        assert!(suspects(&report, "cut_off") && stderr.contains("cut off in line 405"));
    }
    if let Some((report, stderr)) = replay("public/ccny_demo.bag", test) {
        assert!(report["scans_used"].as_u64().unwrap() >= 278);
        assert!(suspects(&report, "damaged") && suspects(&report, "no_odometry"));
        assert!(stderr.contains("byte 798265"), "{stderr}");
        // Followed by the scanner: most of the scans fix the pose, and it moved.
        let full = report["observability"]["full"].as_u64().unwrap();
        assert!(full >= 250, "{full}");
        assert!((1.0..15.0).contains(&report["distance_m"].as_f64().unwrap()), "{}", report["distance_m"]);
    }
}

#[test]
fn the_benchmark_s_bags_replay_without_a_robot_file() {
    let test = "the_benchmark_s_bags_replay_without_a_robot_file";
    for (name, scans, way_m) in [("aces", 7374, 325.0), ("fr079", 4934, 392.0), ("mit-csail", 1988, 374.0)] {
        let Some((report, _)) = replay(&format!("kuemmerle/{name}.bag"), test) else { continue };
        assert_eq!((report["format"].as_str(), &report["scans_used"]), (Some("ros1"), &scans.into()));
        assert!((report["distance_m"].as_f64().unwrap() - way_m).abs() < 2.0, "{}", report["distance_m"]);
    }
}
