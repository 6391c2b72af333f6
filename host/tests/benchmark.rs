//! `lineslam benchmark` as a user runs it.

use std::path::Path;
use std::process::{Command, Output};

fn benchmark(data: &Path, out: &Path, more: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_lineslam"))
        .args(["benchmark", "--data"])
        .arg(data)
        .arg("--out")
        .arg(out)
        .args(more)
        .output()
        .unwrap()
}

/// Range to the walls of a room of 8 m by 6 m, from (x, 0) along a bearing.
fn room(x: f64, bearing: f64) -> f64 {
    // Never quite along a wall.
    let (s, c) = (bearing + 1e-9).sin_cos();
    let along_x = if c > 0.0 { (5.0 - x) / c } else { (-3.0 - x) / c };
    let along_y = if s > 0.0 { 2.5 / s } else { -3.5 / s };
    along_x.min(along_y)
}

/// A robot with a SICK scanner drives 0.1 m a scan along x.
fn drive(scans: usize) -> String {
    let flaser = |k: usize| {
        let x = 0.1 * k as f64;
        let range = |beam: i32| format!("{:.2}", room(x, f64::from(beam - 90).to_radians()));
        let ranges: Vec<String> = (0..181).map(range).collect();
        let t = 100.5 + 0.2 * k as f64;
        format!("FLASER 181 {} {x} 0 0 {x} 0 0 {t} host {t}\n", ranges.join(" "))
    };
    (0..scans).map(flaser).collect()
}

/// Where it is, as a reference and as relations.
fn truth(scans: usize) -> (String, String) {
    let tum = |k: usize| format!("{} {} 0 0 0 0 0 1\n", 100.5 + 0.2 * k as f64, 0.1 * k as f64);
    ((0..scans).map(tum).collect(), "100.5 102.5 1.0 0 0\n100.7 102.7 1.0 0 0 0 0 0\n".into())
}

#[test]
fn good_and_bad_logs_each_have_a_row() {
    let folder = tempfile::tempdir().unwrap();
    let (data, out) = (folder.path().join("logs"), folder.path().join("out"));
    std::fs::create_dir_all(data.join("below")).unwrap();
    std::fs::write(data.join("room.log"), drive(20)).unwrap();
    let (reference, relations) = truth(20);
    std::fs::write(data.join("room.ref.tum"), reference).unwrap();
    std::fs::write(data.join("room.relations"), relations).unwrap();
    std::fs::write(data.join("below/broken.log"), "this is no log\n").unwrap();
    let output = benchmark(&data, &out, &["--runs", "3"]);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    assert!(output.stderr.is_empty(), "a pipe gets no progress bar");
    let table = String::from_utf8_lossy(&output.stdout);
    assert!(table.contains("broken.log"), "{table}");
    let room = table.lines().find(|line| line.contains("room.log")).unwrap();
    assert!(room.contains("20") && room.contains("0.0"), "{table}");
    assert!(table.contains("relations, m"), "{table}");
    assert!(table.lines().all(|line| line.chars().count() < 160), "{table}");
    assert!(!table.contains("NaN"), "{table}");
    let page = std::fs::read_to_string(out.join("benchmark.md")).unwrap();
    assert!(
        page.contains("- broken.log: not replayed: ") && page.contains("benchmark --data LOGS --runs 3\n"),
        "{page}"
    );
    let firm =
        page.lines().filter(|line| line.starts_with("| room.log")).find(|line| line.contains("relations, m"));
    let errors: Vec<f64> = firm.unwrap().split('|').filter_map(|cell| cell.trim().parse().ok()).collect();
    assert!(matches!(errors[..], [_, median, worst] if median <= worst && worst < 0.1), "{page}");
    assert!(!page.contains(&*data.to_string_lossy()), "nobody else has this folder: {page}");
    let svg = std::fs::read_to_string(out.join("images/benchmark_room.svg")).unwrap();
    assert!(svg.starts_with("<svg") && page.contains("](images/benchmark_room.svg)"));
}

#[test]
fn a_log_that_is_not_there_is_an_error_and_nothing_is_written() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("out");
    std::fs::write(folder.path().join("room.log"), drive(3)).unwrap();
    let refuses = |data: &Path, more: &[&str], words: &[&str]| {
        let output = benchmark(data, &out, more);
        let said = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{said}");
        assert!(words.iter().all(|word| said.contains(word)), "{said}");
        assert!(!out.exists());
    };
    refuses(folder.path(), &["--logs", "exp9,room"], &["exp9", "room.log"]);
    refuses(&folder.path().join("absent"), &[], &["absent"]);
    let empty = tempfile::tempdir().unwrap();
    refuses(empty.path(), &[], &["no log here", ".log, .clf, .dat"]);
}
