//! `lineslam replay` as a user runs it: what it writes, and what it says about bad input.

use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use flate2::Compression;
use flate2::write::GzEncoder;
use tempfile::TempDir;

/// A folder with logs in it, and the folder the command writes to.
struct Bench {
    folder: TempDir,
}

impl Bench {
    fn new() -> Self {
        Self { folder: tempfile::tempdir().unwrap() }
    }

    fn file(&self, name: &str, content: impl AsRef<[u8]>) -> PathBuf {
        let path = self.folder.path().join(name);
        std::fs::write(&path, content).unwrap();
        path
    }

    fn out(&self) -> PathBuf {
        self.folder.path().join("out")
    }

    fn replay(&self, log: &Path, more: &[&str]) -> Output {
        Command::new(env!("CARGO_BIN_EXE_lineslam"))
            .arg("replay")
            .arg(log)
            .arg("--out")
            .arg(self.out())
            .args(more)
            .output()
            .unwrap()
    }

    /// The command must fail with code 2, name the file and say all of `words`, and must not have written anything.
    fn refuses(&self, log: &Path, more: &[&str], words: &[&str]) {
        let output = self.replay(log, more);
        let said = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{said}");
        for word in words {
            assert!(said.contains(word), "'{word}' is not in: {said}");
        }
        assert!(output.stdout.is_empty());
        assert!(!self.out().exists(), "something was written");
    }

    fn report(&self) -> serde_json::Value {
        serde_json::from_slice(&std::fs::read(self.out().join("report.json")).unwrap()).unwrap()
    }

    fn lines(&self, name: &str) -> Vec<String> {
        std::fs::read_to_string(self.out().join(name)).unwrap().lines().map(str::to_owned).collect()
    }
}

/// A name, and what is done to the lines of a good log that is still one.
type Twist = (&'static str, fn(&mut Vec<String>));

/// A name, what is done to the lines of a good log, and what must be said of it.
type Spoilt = (&'static str, fn(&mut Vec<String>), &'static [&'static str]);

/// Range to the walls of a room of 8 m by 6 m, from (x, 0) along a bearing.
fn room(x: f64, bearing: f64) -> f64 {
    // Never quite along a wall.
    let (s, c) = (bearing + 1e-9).sin_cos();
    let along_x = if c > 0.0 { (5.0 - x) / c } else { (-3.0 - x) / c };
    let along_y = if s > 0.0 { 2.5 / s } else { -3.5 / s };
    along_x.min(along_y)
}

/// A robot with a SICK scanner drives 0.1 m a scan along x.
fn flaser(k: usize) -> String {
    let x = 0.1 * k as f64;
    let ranges: Vec<String> =
        (0..181).map(|i| format!("{:.2}", room(x, f64::from(i - 90).to_radians()))).collect();
    let t = 100.5 + 0.2 * k as f64;
    format!("FLASER 181 {} {x} 0 0 {x} 0 0 {t} host {t}", ranges.join(" "))
}

fn carmen_log(scans: usize) -> Vec<String> {
    let mut lines = vec!["# a comment".to_owned(), "PARAM robot_width 0.4 nohost 0".to_owned()];
    lines.extend((0..scans).map(flaser));
    lines
}

/// The same drive as the mines rover records it: ticks of both wheels, 682 ranges in millimetres.
fn mines_line(k: usize) -> String {
    let x = 0.02 * k as f64;
    let ticks = (x / (2.0 * std::f64::consts::PI * 0.077) * 2000.0).round() as i64;
    let mut words = vec![(200_000_000 + 100_000 * k).to_string(), "0".into(), (500 + ticks).to_string()];
    words.push((700 + ticks).to_string());
    words.extend((4..24).map(|_| "0".to_owned()));
    // The scan on a line is older than its ticks.
    let scan_x = (x - 0.03).max(0.0);
    for beam in 0..682 {
        let range = room(scan_x + 0.145, (f64::from(beam) - 340.5) * std::f64::consts::PI / 512.0);
        words.push(if range < 5.0 { format!("{:.0}", range * 1000.0) } else { "0".into() });
    }
    words.push("0".into());
    words.join(" ")
}

fn gzip(text: &str) -> Vec<u8> {
    let mut encoder = GzEncoder::new(Vec::new(), Compression::fast());
    encoder.write_all(text.as_bytes()).unwrap();
    encoder.finish().unwrap()
}

#[test]
fn writes_every_file_for_a_carmen_log() {
    let bench = Bench::new();
    let log = bench.file("room.log", carmen_log(12).join("\n"));
    let output = bench.replay(&log, &[]);
    assert!(output.status.success(), "{output:?}");
    assert!(output.stderr.is_empty(), "a pipe gets no progress bar");
    let summary = String::from_utf8_lossy(&output.stdout);
    assert!(summary.contains("scans used  12"), "{summary}");

    let mut names: Vec<String> = std::fs::read_dir(bench.out())
        .unwrap()
        .map(|entry| entry.unwrap().file_name().into_string().unwrap())
        .collect();
    names.sort();
    let expected = [
        "map.csv",
        "map.dxf",
        "map.json",
        "map.pgm",
        "map.svg",
        "map.yaml",
        "odometry.tum",
        "report.json",
        "trajectory.csv",
        "trajectory.tum",
        "trajectory_final.tum",
    ];
    assert_eq!(names, expected);

    let trajectory = bench.lines("trajectory.tum");
    assert_eq!(trajectory.len(), 12);
    assert!(trajectory[0].starts_with("100.500000 0.0"), "stamped as in the log: {}", trajectory[0]);
    let last: Vec<f64> = trajectory[11].split(' ').map(|w| w.parse().unwrap()).collect();
    assert!(
        (last[0] - 102.7).abs() < 1e-9 && (last[1] - 1.1).abs() < 0.02 && last[2].abs() < 0.02,
        "{last:?}"
    );
    assert_eq!(bench.lines("odometry.tum").len(), 12);

    let map = bench.lines("map.csv");
    assert_eq!(map[0], "x1_m,y1_m,x2_m,y2_m,inliers");
    assert_eq!(map.len() - 1, 3, "the room ahead of the scanner has three walls: {map:?}");
    assert!(bench.lines("map.svg")[0].starts_with("<svg"));

    let report = bench.report();
    assert_eq!(report["scans_used"], 12);
    assert_eq!(report["segments"], 3);
    assert_eq!(report["robot"], "sick");
    assert!((report["distance_m"].as_f64().unwrap() - 1.1).abs() < 1e-3);
    assert!((report["duration_s"].as_f64().unwrap() - 2.2).abs() < 1e-9);
    assert!(report["scan_us"]["median"].as_f64().unwrap() > 0.0);
    assert!(report["slam_bytes"].as_u64().unwrap() > 0);
    assert_eq!(report["config"]["sensor"]["geometry"]["steps_per_revolution"], 360.0);
}

#[test]
fn grid_is_what_map_server_reads() {
    let bench = Bench::new();
    bench.replay(&bench.file("room.log", carmen_log(12).join("\n")), &[]);
    let pgm = std::fs::read(bench.out().join("map.pgm")).unwrap();
    let header: Vec<&str> = std::str::from_utf8(&pgm[..15]).unwrap().split_whitespace().collect();
    assert_eq!(header[0], "P5");
    let (width, height): (usize, usize) = (header[1].parse().unwrap(), header[2].parse().unwrap());
    let pixels = &pgm[pgm.len() - width * height..];
    let yaml = std::fs::read_to_string(bench.out().join("map.yaml")).unwrap();
    assert!(yaml.contains("\nmode: trinary\n"), "{yaml}");
    let origin: Vec<f64> = yaml
        .lines()
        .find_map(|l| l.strip_prefix("origin: "))
        .unwrap()
        .trim_matches(['[', ']'])
        .split(", ")
        .map(|w| w.parse().unwrap())
        .collect();
    let at = |x: f64, y: f64| {
        let (column, row) = ((x - origin[0]) / 0.05, (y - origin[1]) / 0.05);
        pixels[(height - 1 - row as usize) * width + column as usize]
    };
    assert_eq!(at(2.0, 0.0), 254, "free in the middle");
    assert_eq!(at(5.02, 0.0), 0, "occupied at the wall ahead");
    assert_eq!(at(3.0, 2.52), 0, "occupied at the wall on the left");
    assert_eq!(pixels[0], 205, "unknown outside the walls");
}

#[test]
fn mines_logs_are_found_out_and_may_be_gzipped() {
    let text = (0..20).map(mines_line).collect::<Vec<_>>().join("\n");
    for (name, content) in [("exp.dat", text.clone().into_bytes()), ("exp.dat.gz", gzip(&text))] {
        let bench = Bench::new();
        let output = bench.replay(&bench.file(name, content), &[]);
        assert!(output.status.success(), "{output:?}");
        assert_eq!(bench.report()["format"], "mines");
        assert_eq!(bench.report()["robot"], "mines");
        // The pose is that of the scan, one and a half lines before the ticks beside it.
        let last: Vec<f64> =
            bench.lines("trajectory.tum")[19].split(' ').map(|w| w.parse().unwrap()).collect();
        assert!((last[0] - 201.9).abs() < 1e-9);
        assert!((last[1] - (0.38 - 0.03)).abs() < 0.01, "{last:?}");
    }
}

#[test]
fn robot_laser_records_bring_their_own_geometry() {
    // 121 beams over 120°, the scanner 0.2 m ahead; odometry in a frame turned by 90°.
    let record = |k: usize| {
        let x = 0.1 * k as f64;
        let ranges: Vec<String> =
            (0..121).map(|i| format!("{:.3}", room(x + 0.2, f64::from(i - 60).to_radians()))).collect();
        let (start, fov, step) = (-60f64.to_radians(), 120f64.to_radians(), 1f64.to_radians());
        let quarter = std::f64::consts::FRAC_PI_2;
        let t = 10.0 + k as f64;
        format!(
            "ROBOTLASER1 0 {start} {fov} {step} 30 0.01 0 121 {} 2 7 8 0 {} {quarter} 0 {x} {quarter} 0.1 0 1 1 0 {t} host {t}",
            ranges.join(" "),
            x + 0.2
        )
    };
    let odom =
        |k: usize| format!("ODOM 0 {} 1.5707963 0.1 0 0 {} host 0", 0.1 * k as f64 - 0.05, 9.5 + k as f64);
    let text = (0..10).map(|k| format!("{}\n{}", odom(k), record(k))).collect::<Vec<_>>().join("\n");
    let bench = Bench::new();
    let output = bench.replay(&bench.file("campus.log", text), &[]);
    assert!(output.status.success(), "{output:?}");
    let last: Vec<f64> = bench.lines("trajectory.tum")[9].split(' ').map(|w| w.parse().unwrap()).collect();
    assert!((last[1] - 0.9).abs() < 0.02 && last[2].abs() < 0.02, "{last:?}");
    let map = bench.lines("map.csv");
    let ahead = map.iter().skip(1).any(|l| {
        let v: Vec<f64> = l.split(',').map(|w| w.parse().unwrap()).collect();
        (v[0] - 5.0).abs() < 0.02 && (v[2] - 5.0).abs() < 0.02
    });
    assert!(ahead, "the wall 5 m ahead of the axle is there: {map:?}");
}

/// A scanner that looks all round and does not turn evenly, as cheap ones do: each scan has its own number of beams.
#[test]
fn each_scan_may_have_beams_of_its_own() {
    let line = |k: usize| {
        let (x, beams) = (0.05 * k as f64, 340 + 7 * (k % 5));
        let step = 360.0 / beams as f64;
        let bearing = |i: usize| (-180.0 + step * i as f64).to_radians();
        let ranges: Vec<String> = (0..beams).map(|i| format!("{:.3}", room(x, bearing(i)))).collect();
        format!(
            "{{\"t_us\":{},\"pose\":[{x},0,0],\"sensor\":{{\"first_bearing_deg\":-180,\"step_deg\":{step},\
             \"max_range_m\":12}},\"ranges_m\":[{}]}}",
            100_000 * (k + 1),
            ranges.join(",")
        )
    };
    let text: Vec<String> =
        std::iter::once("{\"lineslam_log\":1}".to_owned()).chain((0..40).map(line)).collect();
    let bench = Bench::new();
    let output = bench.replay(&bench.file("round.jsonl", text.join("\n")), &[]);
    assert!(output.status.success(), "{output:?}");
    assert_eq!(bench.report()["scans_used"], 40);
    assert_eq!(bench.report()["warnings"][0]["suspected"], "beam_counts_vary");
    let last: Vec<f64> = bench.lines("trajectory.tum")[39].split(' ').map(|w| w.parse().unwrap()).collect();
    assert!((last[1] - 1.95).abs() < 0.01 && last[2].abs() < 0.01, "{last:?}");
    // Each wall is there, and nothing else.
    for wall in bench.lines("map.csv").iter().skip(1) {
        let v: Vec<f64> = wall.split(',').map(|w| w.parse().unwrap()).collect();
        let on = |axis: usize, at: f64| (v[axis] - at).abs() < 0.02 && (v[axis + 2] - at).abs() < 0.02;
        assert!(on(0, 5.0) || on(0, -3.0) || on(1, 2.5) || on(1, -3.5), "{wall}");
    }
    assert!((4..=6).contains(&(bench.lines("map.csv").len() - 1)), "{:?}", bench.lines("map.csv"));
}

#[test]
fn what_real_logs_are_like_does_not_stop_them() {
    let plain = Bench::new();
    assert!(plain.replay(&plain.file("room.log", carmen_log(12).join("\n")), &[]).status.success());
    let expected = plain.lines("trajectory.tum");
    let twists: [Twist; 6] = [
        ("codes", |l| {
            let mut words: Vec<String> = l[5].split(' ').map(str::to_owned).collect();
            for (at, code) in [(20, "-1"), (40, "nan"), (60, "inf"), (80, "-inf"), (100, "0"), (120, "1e9")] {
                words[at] = code.into();
            }
            l[5] = words.join(" ");
        }),
        ("far away", |l| {
            // The odometry starts 500 km away.
            for line in l.iter_mut().skip(2) {
                let mut words: Vec<String> = line.split(' ').map(str::to_owned).collect();
                for at in [183, 186] {
                    words[at] = (words[at].parse::<f64>().unwrap() + 5e5).to_string();
                }
                *line = words.join(" ");
            }
        }),
        ("jump", |l| l.insert(6, "ODOM 400 0 0 0 0 0 101.15 host 101.15".into())),
        ("old", |l| l.insert(9, "ODOM 0 0 0 0 0 0 100.6 host 1".into())),
        ("negative", |l| l.insert(9, "ODOM 0 0 0 0 0 0 -3 host 1".into())),
        ("comment", |l| l.insert(4, "# \u{fc}".into())),
    ];
    for (name, twist) in twists {
        let bench = Bench::new();
        let mut lines = carmen_log(12);
        twist(&mut lines);
        let output = bench.replay(&bench.file("room.log", lines.join("\n")), &[]);
        assert!(output.status.success(), "{name}: {output:?}");
        let got = bench.lines("trajectory.tum");
        assert_eq!(got.len(), expected.len(), "{name}");
        for (got, expected) in got.iter().zip(&expected) {
            let numbers = |line: &str| line.split(' ').map(|w| w.parse::<f64>().unwrap()).collect::<Vec<_>>();
            let (got, expected) = (numbers(got), numbers(expected));
            assert!(
                (got[1] - expected[1]).hypot(got[2] - expected[2]) < 0.01,
                "{name}: {got:?} {expected:?}"
            );
        }
    }
}

/// A thousand readings of the odometry between two scans, on a way that is no straight line.
#[test]
fn no_motion_is_lost_between_scans_far_apart() {
    let mut lines = carmen_log(3);
    let at = |k: usize| {
        // Out to the left and back to where the next scan is.
        let share = k as f64 / 2000.0;
        (0.2 + 0.1 * share, 3.0 * (share * std::f64::consts::PI).sin())
    };
    for k in 1..2000 {
        let (x, y) = at(k);
        let t = 100.9 + 0.03 * k as f64;
        lines.push(format!("ODOM {x} {y} 0 0 0 0 {t} host {t}"));
    }
    let (x, y) = at(2000);
    let scan = flaser(3)
        .replace(" 0.30000000000000004 0 0 0.30000000000000004 0 0 ", &format!(" {x} {y} 0 {x} {y} 0 "));
    lines.push(scan.replace("101.1 host 101.1", "160.9 host 160.9"));
    let bench = Bench::new();
    let output = bench.replay(&bench.file("gap.log", lines.join("\n")), &[]);
    assert!(output.status.success(), "{output:?}");
    let distance_m = bench.report()["distance_m"].as_f64().unwrap();
    assert!((distance_m - 6.2).abs() < 0.05, "{distance_m}");
    let end: Vec<f64> = bench.lines("odometry.tum")[3].split(' ').map(|w| w.parse().unwrap()).collect();
    assert!((end[1] - x).abs() < 1e-3 && (end[2] - y).abs() < 1e-3, "{end:?}");
}

#[test]
fn a_log_most_of_which_cannot_be_used_is_refused() {
    let mut lines = carmen_log(12);
    for line in &mut lines[3..11] {
        line.truncate(300);
    }
    let bench = Bench::new();
    let log = bench.file("spoilt.log", lines.join("\n"));
    bench.refuses(&log, &["--lenient"], &["only 4 of 12 scans", "8 truncated"]);
}

#[test]
fn the_scanner_of_a_log_with_several_is_chosen() {
    let rear = |line: &str| {
        // The scanner on the back sees the room the other way round.
        let x: f64 = line.split(' ').nth(183).unwrap().parse().unwrap();
        let ranges: Vec<String> =
            (0..181).map(|i| format!("{:.2}", room(x - 0.2, f64::from(i + 90).to_radians()))).collect();
        let tail: Vec<&str> = line.split(' ').skip(183).collect();
        format!("RLASER 181 {} {}", ranges.join(" "), tail.join(" "))
    };
    let mut lines = vec!["PARAM robot_rearlaser_offset -0.2 nohost 0".to_owned()];
    for k in 0..12 {
        lines.extend([flaser(k), rear(&flaser(k))]);
    }
    let bench = Bench::new();
    let log = bench.file("both.log", lines.join("\n"));
    let output = bench.replay(&log, &[]);
    assert!(output.status.success(), "{output:?}");
    assert_eq!(bench.report()["warnings"][0]["suspected"], "several_scanners");
    let output = bench.replay(&log, &["--scanner", "RLASER"]);
    assert!(output.status.success(), "{output:?}");
    let behind = bench.lines("map.csv").iter().skip(1).any(|l| {
        let v: Vec<f64> = l.split(',').map(|w| w.parse().unwrap()).collect();
        (v[0] + 3.0).abs() < 0.02 && (v[2] + 3.0).abs() < 0.02
    });
    assert!(behind, "the wall behind is there: {:?}", bench.lines("map.csv"));
    std::fs::remove_dir_all(bench.out()).unwrap();
    bench.refuses(&log, &["--scanner", "RAWLASER3"], &["no RAWLASER3"]);
}

#[test]
fn every_configuration_runs() {
    let bench = Bench::new();
    let log = bench.file("room.log", carmen_log(12).join("\n"));
    for (name, weight, singular) in [
        ("paper", "equal", "keep_pose"),
        ("paper-weighted", "inliers", "keep_pose"),
        ("paper-partial", "inliers", "correct_observed"),
    ] {
        assert!(bench.replay(&log, &["--config", name]).status.success());
        let report = bench.report();
        assert_eq!(report["configuration"], name);
        assert!(report["config"]["extraction"]["ransac"].is_object());
        assert_eq!(report["config"]["registration"]["end_points"]["weight"], weight, "{name}");
        assert_eq!(report["config"]["correction"]["least_squares"]["singular"], singular, "{name}");
    }
}

#[test]
fn bad_records_name_file_and_line() {
    let cases: [Spoilt; 6] = [
        ("truncated", |l| l[5].truncate(200), &["line 6", "truncated"]),
        (
            "text",
            |l| l[5] = l[5].replacen("3.00", "three", 1).replacen(" 2.5", " two", 1),
            &["line 6", "range", "not a number"],
        ),
        (
            "beams",
            |l| l[5] = "FLASER 3 1 1 1 0 0 0 0 0 0 101.1 host 101.1".into(),
            &["line 6", "3 beams instead of 181"],
        ),
        ("backwards", |l| l.swap(5, 6), &["line 7", "time runs backwards", "101.100000", "101.300000"]),
        ("nan", |l| l[5] = l[5].replace(" 101.1 host", " NaN host"), &["line 6", "time stamp", "NaN"]),
        (
            "stamp",
            |l| l[5] = l[5].replace(" 101.1 host", " -4 host"),
            &["line 6", "time runs backwards", "-4"],
        ),
    ];
    for (name, spoil, words) in cases {
        let bench = Bench::new();
        let mut lines = carmen_log(12);
        spoil(&mut lines);
        let log = bench.file(name, lines.join("\n"));
        bench.refuses(&log, &[], &[words, &[name, "--lenient"]].concat());
    }
}

#[test]
fn bad_mines_records_name_file_and_line() {
    let cases: [Spoilt; 4] = [
        ("truncated", |l| l[3].truncate(1500), &["line 4", "truncated"]),
        ("text", |l| l[3] = l[3].replacen("200300000", "noon", 1), &["line 4", "time", "noon"]),
        ("backwards", |l| l.swap(3, 4), &["line 5", "time runs backwards"]),
        ("long", |l| l[3].push_str(" 1 2 3"), &["line 4", "710 words"]),
    ];
    for (name, spoil, words) in cases {
        let bench = Bench::new();
        let mut lines: Vec<String> = (0..8).map(mines_line).collect();
        spoil(&mut lines);
        let log = bench.file(name, lines.join("\n"));
        bench.refuses(&log, &[], &[words, &[name]].concat());
    }
}

#[test]
fn files_that_are_no_log_are_named() {
    let bench = Bench::new();
    bench.refuses(&bench.file("empty.log", ""), &[], &["empty.log", "without a single scan"]);
    bench.refuses(
        &bench.file("odom.log", "ODOM 0 0 0 0 0 0 1 host 1\n"),
        &[],
        &["odom.log", "line 1", "without a single scan"],
    );
    bench.refuses(&bench.file("plain.log.gz", carmen_log(3).join("\n")), &[], &["plain.log.gz", "not gzip"]);
    bench.refuses(
        &bench.file("note.txt", "dear diary\n"),
        &[],
        &["note.txt", "line 1", "neither", "dear diary"],
    );
    bench.refuses(&bench.file("bytes.log", [0xff, 0xfe, 0x00, 0x0a]), &[], &["bytes.log", "UTF-16"]);
    bench.refuses(&bench.folder.path().join("absent.log"), &[], &["absent.log: No such file"]);
    bench.refuses(bench.folder.path(), &[], &["is a directory"]);
    bench.refuses(&bench.file("a.log", b"\x28\xb5\x2f\xfd\0\0"), &[], &["a.log", "zstd -d"]);
    bench.refuses(&bench.file("b.log", b"a\0b\n"), &[], &["b.log", "binary"]);
    let numbers = vec!["1"; 363].join(" ");
    bench.refuses(
        &bench.file("c.log", numbers),
        &[],
        &["c.log", "line 1", "363 numbers", "707", "FLASER", "docs/logs.md"],
    );
    let mut cut = gzip(&carmen_log(400).join("\n"));
    cut.truncate(cut.len() / 2);
    bench.refuses(&bench.file("cut.log.gz", cut), &[], &["cut.log.gz", "line "]);
    let carmen = bench.file("room.log", carmen_log(3).join("\n"));
    bench.refuses(&carmen, &["--format", "mines"], &["room.log", "neither"]);
    let mines = bench.file("exp.dat", (0..3).map(mines_line).collect::<Vec<_>>().join("\n"));
    bench.refuses(&mines, &["--format", "carmen"], &["exp.dat", "line 1"]);
}

#[test]
fn lenient_reading_skips_and_counts() {
    let bench = Bench::new();
    let mut lines = carmen_log(12);
    lines[4].truncate(100);
    lines[6] = lines[6].replacen("FLASER 181", "FLASER many", 1);
    lines.insert(9, lines[3].clone());
    lines.push("FLASER 3 1 1 1 0 0 0 0 0 0 999 host 999".into());
    let log = bench.file("spoilt.log", lines.join("\n"));
    bench.refuses(&log, &[], &["line 5"]);
    let output = bench.replay(&log, &["--lenient"]);
    assert!(output.status.success(), "{output:?}");
    let report = bench.report();
    assert_eq!(report["scans_used"], 10);
    let expected = serde_json::json!({
        "truncated": 1, "not_a_number": 1, "time_not_increasing": 1, "wrong_beam_count": 1
    });
    assert_eq!(report["records_skipped"], expected);
    assert!(String::from_utf8_lossy(&output.stdout).contains("1 truncated"));
}

#[test]
fn lenient_reading_uses_a_log_that_was_cut_off() {
    let bench = Bench::new();
    let mut cut = gzip(&carmen_log(400).join("\n"));
    cut.truncate(cut.len() / 2);
    let output = bench.replay(&bench.file("cut.log.gz", cut), &["--lenient"]);
    assert!(output.status.success(), "{output:?}");
    assert!(bench.report()["scans_used"].as_u64().unwrap() > 50);
    assert_eq!(bench.report()["records_skipped"]["cut_off"], 1);
}

/// A robot whose file names no profile.
const SPELLED_OUT: &str = r#"
name = "rover"

[wheels]
left_radius_m = 0.077
right_radius_m = 0.077
track_m = 0.308
ticks_per_turn = 2000.0
counter_bits = 32

[odometry_noise]
along_m_per_sqrt_m = 0.02
across_m_per_sqrt_m = 0.02
heading_deg_per_sqrt_m = 2.0
heading_deg_per_sqrt_turn_deg = 0.5
position_floor_m = 0.002
heading_floor_deg = 0.15

[sensor]
model = "URG-04LX"
min_range_mm = 21
max_range_mm = 5600
no_echo_mm = [[0, 0], [6, 6]]
sigma_m = 0.01
sigma_per_m = 0.01
sigma_bearing_deg = 0.75
line_sigma_m = 0.02
scan_delay_s = 0.15

[sensor.steps]
first = 44
last = 725
front = 384
per_revolution = 1024.0
revolution_s = 0.1
used = [114, 655]

[mounting]
x_m = 0.145
y_m = 0.0
yaw_deg = -0.176
upside_down = false
"#;

#[test]
fn robot_files_are_checked_key_by_key() {
    let good = SPELLED_OUT;
    let cases: [(&str, &str, &[&str]); 13] = [
        ("track_m = 0.308", "track_m = 0.308\ntrak_m = 1", &["trak_m"]),
        ("track_m = 0.308\n", "", &["track_m", "missing"]),
        ("track_m = 0.308", "track_m = -0.3", &["wheels.track_m", "-0.3"]),
        ("track_m = 0.308", "track_m = \"wide\"", &["track_m", "string"]),
        ("counter_bits = 32", "counter_bits = 24", &["wheels.counter_bits", "24"]),
        ("sigma_m = 0.01\n", "", &["sensor.sigma_m", "missing"]),
        ("max_range_mm = 5600", "max_range_mm = 10", &["sensor.max_range_mm", "10"]),
        ("max_range_mm = 5600", "max_range_mm = 70000", &["sensor.max_range_mm", "70000"]),
        ("[[0, 0], [6, 6]]", "[[6, 0]]", &["sensor.no_echo_mm", "[6, 0]"]),
        ("last = 725", "last = 20", &["sensor.steps.last", "20"]),
        ("used = [114, 655]", "used = [10, 655]", &["sensor.steps.used"]),
        ("scan_delay_s = 0.15", "scan_delay_s = nan", &["sensor.scan_delay_s", "NaN"]),
        ("[sensor.steps]", "[sensor.field]\nof_view_deg = 180.0\n[sensor.steps]", &["either"]),
    ];
    let bench = Bench::new();
    let log = bench.file("exp.dat", (0..3).map(mines_line).collect::<Vec<_>>().join("\n"));
    for (from, to, words) in cases {
        assert!(good.contains(from), "{from} is not in the robot file");
        let robot = bench.file("robot.toml", good.replacen(from, to, 1));
        let robot = robot.to_str().unwrap();
        bench.refuses(&log, &["--robot", robot], &[words, &["robot.toml"]].concat());
    }
    bench.refuses(&log, &["--robot", "nowhere.toml"], &["nowhere.toml"]);
    let sick = concat!(env!("CARGO_MANIFEST_DIR"), "/../robots/sick.toml");
    bench.refuses(&log, &["--robot", sick], &["'sick'", "[wheels]"]);
    let carmen = bench.file("room.log", carmen_log(3).join("\n"));
    let mines = concat!(env!("CARGO_MANIFEST_DIR"), "/../robots/mines.toml");
    bench.refuses(&carmen, &["--robot", mines], &["room.log", "line 3", "181 beams instead of 682"]);
}

#[test]
fn every_robot_file_is_good() {
    for entry in std::fs::read_dir(concat!(env!("CARGO_MANIFEST_DIR"), "/../robots")).unwrap() {
        let path = entry.unwrap().path();
        lineslam::robot::Robot::load(&path).unwrap_or_else(|e| panic!("{e}"));
    }
}

#[test]
fn results_are_written_whole_or_not_at_all() {
    let bench = Bench::new();
    let log = bench.file("room.log", carmen_log(3).join("\n"));
    std::fs::create_dir_all(bench.out().join("map.svg")).unwrap();
    let output = bench.replay(&log, &[]);
    assert_eq!(output.status.code(), Some(1));
    assert!(String::from_utf8_lossy(&output.stderr).contains("map.svg"), "{output:?}");
    assert_eq!(std::fs::read_dir(bench.out()).unwrap().count(), 1, "nothing but the obstacle");
}

#[test]
fn a_wrong_command_line_is_explained() {
    let output = Command::new(env!("CARGO_BIN_EXE_lineslam"))
        .args(["replay", "x", "--config", "best"])
        .output()
        .unwrap();
    assert_eq!(output.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&output.stderr).contains("best"));
}

/// Drivers of scanners that look all round close the turn: as many beams as degrees, and one more.
#[test]
fn a_closed_turn_is_a_scan_and_more_than_that_is_not() {
    let text = |beams: usize| {
        let line = |k: usize| {
            let x = 0.05 * k as f64;
            let bearing = |i: usize| (i as f64 - 180.0).to_radians();
            let ranges: Vec<String> = (0..beams).map(|i| format!("{:.3}", room(x, bearing(i)))).collect();
            format!(
                "{{\"t_us\":{},\"pose\":[{x},0,0],\"ranges_m\":[{}]}}",
                100_000 * (k + 1),
                ranges.join(",")
            )
        };
        let head =
            "{\"lineslam_log\":1,\"sensor\":{\"first_bearing_deg\":-180,\"step_deg\":1,\"max_range_m\":12}}";
        let lines: Vec<String> = std::iter::once(head.to_owned()).chain((0..10).map(line)).collect();
        lines.join("\n")
    };
    let bench = Bench::new();
    let output = bench.replay(&bench.file("closed.jsonl", text(361)), &[]);
    assert!(output.status.success(), "{output:?}");
    std::fs::remove_dir_all(bench.out()).unwrap();
    bench.refuses(
        &bench.file("twice.jsonl", text(400)),
        &[],
        &["twice.jsonl", "line 2", "400 beams", "1.11 times"],
    );
}

#[test]
fn clocks_that_have_nothing_to_do_with_each_other_are_said() {
    let mut lines: Vec<String> = carmen_log(12).iter().map(|l| l.replace("FLASER", "RAWLASER1")).collect();
    for (k, line) in lines.iter_mut().enumerate().skip(2) {
        // The scanner's clock began when it was switched on.
        let words: Vec<&str> = line.split(' ').collect();
        *line = format!(
            "RAWLASER1 0 -1.570796 3.141593 0.0174533 80 0.01 0 181 {} 0 {} host 0",
            words[2..183].join(" "),
            0.2 * k as f64
        );
        let odometry = format!("ODOM {} 0 0 0 0 0 {} host 0", 0.1 * (k - 2) as f64, 5000.0 + 0.2 * k as f64);
        line.push_str(&format!("\n{odometry}"));
    }
    let bench = Bench::new();
    let output = bench.replay(&bench.file("clocks.log", lines.join("\n")), &[]);
    assert!(output.status.success(), "{output:?}");
    assert_eq!(bench.report()["warnings"][0]["suspected"], "odometry_of_another_time");
    assert!(String::from_utf8_lossy(&output.stderr).contains("5000.400"), "{output:?}");
}

/// One scan of many that comes too late, as when a network held it up, does not stop a log.
#[test]
fn few_scans_out_of_order_are_left_out_and_said() {
    let mut lines = carmen_log(100);
    lines.swap(50, 51);
    let bench = Bench::new();
    let output = bench.replay(&bench.file("late.log", lines.join("\n")), &[]);
    assert!(output.status.success(), "{output:?}");
    assert_eq!(bench.report()["scans_used"], 99);
    assert_eq!(bench.report()["records_skipped"], serde_json::json!({ "time_not_increasing": 1 }));
    assert!(String::from_utf8_lossy(&output.stderr).contains("line 52: time runs backwards"), "{output:?}");
}

/// Ranges in centimetres, and a table of another program with semicolons and points.
#[test]
fn other_units_and_separators_are_understood_when_told() {
    let bench = Bench::new();
    let centimetres = |line: String| {
        let words: Vec<String> = line
            .split(' ')
            .enumerate()
            .map(|(at, w)| match w.parse::<f64>() {
                Ok(v) if (2..183).contains(&at) => (v * 100.0).to_string(),
                _ => w.to_owned(),
            })
            .collect();
        words.join(" ")
    };
    let lines: Vec<String> = (0..12).map(flaser).map(centimetres).collect();
    let log = bench.file("cm.log", lines.join("\n"));
    bench.refuses(&log, &[], &["median range is", "centimetres", "--ranges cm"]);
    assert!(bench.replay(&log, &["--ranges", "cm"]).status.success());
    let last: Vec<f64> = bench.lines("trajectory.tum")[11].split(' ').map(|w| w.parse().unwrap()).collect();
    assert!((last[1] - 1.1).abs() < 0.02, "{last:?}");
    let table: Vec<String> = (0..12).map(mines_line).map(|line| line.replace(' ', ".0;")).collect();
    let output = bench.replay(&bench.file("table.dat", table.join("\n")), &[]);
    assert!(output.status.success(), "{output:?}");
    assert_eq!(bench.report()["scans_used"], 12);
}

/// A drive in the lab, and the map of its first replay.
fn lab() -> (Bench, PathBuf, PathBuf) {
    let bench = Bench::new();
    let world = Path::new(env!("CARGO_MANIFEST_DIR")).join("../worlds/lab.toml");
    let done = Command::new(env!("CARGO_BIN_EXE_lineslam"))
        .arg("simulate")
        .arg(world)
        .arg("--out")
        .arg(bench.folder.path().join("drive"))
        .output()
        .unwrap();
    assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
    let folder = bench.folder.path().join("drive");
    (bench, folder.join("log.jsonl"), folder.join("map.json"))
}

#[test]
fn a_map_that_was_written_is_driven_in() {
    let (bench, log, map) = lab();
    let map = map.to_str().unwrap();
    let before: serde_json::Value = serde_json::from_slice(&std::fs::read(map).unwrap()).unwrap();
    assert_eq!((&before["format"], &before["version"]), (&"lineslam map".into(), &1.into()));
    assert!(before["lines"].as_array().unwrap().len() > 40 && before["places"].as_array().unwrap().len() > 5);
    // Somewhere in it, the map as it is: found, and the pose that of the first run.
    let found = bench.replay(&log, &["--map", map, "--localise"]);
    assert!(found.status.success(), "{}", String::from_utf8_lossy(&found.stderr));
    assert_eq!(bench.report()["tracking"]["relocalised"], 1);
    let ends = bench.lines("trajectory.tum").pop().unwrap();
    let now: serde_json::Value =
        serde_json::from_slice(&std::fs::read(bench.out().join("map.json")).unwrap()).unwrap();
    assert_eq!(
        (&now["lines"].as_array().unwrap().len(), &now["places"]),
        (&before["lines"].as_array().unwrap().len(), &before["places"])
    );
    // The same from a pose that was told.
    assert!(bench.replay(&log, &["--map", map, "--localise", "--start", "0,0,0"]).status.success());
    assert_eq!(bench.report()["tracking"]["lost"], 0);
    let told = bench.lines("trajectory.tum").pop().unwrap();
    let xy =
        |line: &str| -> Vec<f64> { line.split(' ').skip(1).take(2).map(|v| v.parse().unwrap()).collect() };
    let off = xy(&ends).iter().zip(xy(&told)).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
    assert!(off < 0.05, "{ends} {told}");
    // And going on to map.
    assert!(bench.replay(&log, &["--map", map, "--start=0,0,0"]).status.success());
    let after: serde_json::Value =
        serde_json::from_slice(&std::fs::read(bench.out().join("map.json")).unwrap()).unwrap();
    assert!(after["way_m"].as_f64().unwrap() > 1.9 * before["way_m"].as_f64().unwrap());
}

#[test]
fn maps_that_are_none_are_refused() {
    let bench = Bench::new();
    let log = bench.file("log.carmen", carmen_log(20).join("\n"));
    let whole = r#"{"format":"lineslam map","version":1,"way_m":0,"odometry_bias":[0,0,0],"lines":[LINE],"places":[],"loops":[]}"#;
    let line = r#"{"start_m":[0,0],"end_m":[1,0],"middle_m":0.5,"sigma_offset_m":0.01,"sigma_direction_rad":0.01,"points":9,"hits":9,"seen_at_m":0}"#;
    let good = whole.replace("LINE", line);
    for (content, words) in [
        (good.replace("lineslam map", "another map"), &["map.json", "not a lineslam map", "another map"][..]),
        (good.replace("\"version\":1", "\"version\":7"), &["map.json", "version 7", "version 1"]),
        (good.replace("\"end_m\":[1,0]", "\"end_m\":[0,0]"), &["map.json", "lines[0]", "makes no sense"]),
        (good.replace("\"hits\":9,", ""), &["map.json", "hits", "line 1"]),
        (good.replace("\"points\"", "\"dots\""), &["map.json", "dots"]),
        (good.replace("]}", ""), &["map.json", "EOF"]),
        (String::new(), &["map.json", "EOF"]),
        (whole.replace("LINE", &[line; 1025].join(",")), &["map.json", "1025 lines", "1024"]),
    ] {
        let map = bench.file("map.json", content);
        bench.refuses(&log, &["--map", map.to_str().unwrap()], words);
    }
    let map = bench.file("map.json", good);
    let map = map.to_str().unwrap();
    bench.refuses(&log, &["--map", map], &["map.json", "no places", "where it stands"]);
    bench.refuses(&log, &["--map", "missing.json"], &["missing.json", "No such file"]);
    bench.refuses(&log, &["--map", map, "--config", "paper"], &["--map", "--config paper"]);
    bench.refuses(&log, &["--map", map, "--start", "1,2"], &["--start", "2 numbers", "X,Y,DEG"]);
    bench.refuses(&log, &["--map", map, "--start", "1,2,north"], &["--start", "1.5,-2,90"]);
    bench.refuses(&log, &["--localise"], &["--map"]);
    assert!(bench.replay(&log, &["--map", map, "--start", "-1,-2,-90"]).status.success());
}
