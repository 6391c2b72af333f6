//! `lineslam simulate` and the simulator behind it: the same seed gives the same bytes, the log reads back, and what is
//! simulated is what was asked for.

use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use lineslam::log::{self, Odometry, ReadOptions};
use lineslam::robot::Robot;
use lineslam::sim::world::World;
use lineslam::sim::{SimConfig, SimKind, drive};

fn worlds() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../worlds")
}

fn world(name: &str) -> World {
    World::load(&worlds().join(name)).unwrap_or_else(|e| panic!("{e}"))
}

fn robot() -> Robot {
    Robot::usual_for("simulated")
}

fn simulate(out: &Path, arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_lineslam"))
        .arg("simulate")
        .args(arguments)
        .arg("--out")
        .arg(out)
        .output()
        .unwrap()
}

#[test]
fn every_world_is_good_and_its_path_is_driven_to_the_end() {
    for entry in std::fs::read_dir(worlds()).unwrap() {
        let path = entry.unwrap().path();
        let world = World::load(&path).unwrap_or_else(|e| panic!("{e}"));
        let drive = drive(&world, &robot(), &SimConfig::default(), 1).unwrap();
        let [x, y] = *world.path.points.last().unwrap();
        let end = drive.truth.last().unwrap().translation.vector;
        assert!((end - nalgebra::Vector2::new(x, y)).norm() < 0.25, "{}: ends at {end}", path.display());
        // No wall is driven through: the robot keeps a hand's breadth from everything.
        let edges = world.edges();
        let clearance = drive.truth.iter().map(|pose| {
            let at = nalgebra::Point2::from(pose.translation.vector);
            edges.iter().map(|e| lineslam::sim::scanner::distance_to(e, at)).fold(f64::INFINITY, f64::min)
        });
        assert!(clearance.fold(f64::INFINITY, f64::min) > 0.1, "{}", path.display());
    }
}

/// The robot's radius is 0.2 m, and neither slip nor a caster's kick takes it off its way.
#[test]
fn in_furnished_worlds_the_robot_keeps_clear_of_everything() {
    for (name, corners) in [("lab", 9), ("flat", 14), ("loop", 14), ("twins", 11)] {
        let world = world(&format!("{name}.toml"));
        assert_eq!(world.corners.len(), corners);
        let (edges, discs) = (world.edges(), world.discs());
        for kind in SimKind::ALL {
            let drive = drive(&world, &robot(), &SimConfig::of(kind), 1).unwrap();
            for pose in drive.truth.iter().step_by(4) {
                let at = nalgebra::Point2::from(pose.translation.vector);
                let edge = edges.iter().map(|e| lineslam::sim::scanner::distance_to(e, at));
                let disc = discs.iter().map(|d| (d.centre - at).norm() - d.radius);
                let clear = edge.chain(disc).fold(f64::INFINITY, f64::min);
                assert!(clear > 0.2, "{name}: {clear:.2} m from something at {at}");
            }
        }
    }
}

#[test]
fn the_twins_are_alike() {
    let world = world("twins.toml");
    let inside = |x: f64| -> Vec<nalgebra::Point2<f64>> {
        let edges = world.edges().into_iter().flat_map(|e| [e.from, e.to]);
        let points = edges.chain(world.discs().into_iter().map(|d| d.centre));
        let near = points.filter(|p| p.y > 2.05 && (x..x + 4.3).contains(&p.x));
        near.map(|p| nalgebra::Point2::new(p.x - x, p.y)).collect()
    };
    let (west, east) = (inside(1.4), inside(8.4));
    assert!(west.len() > 40 && west.len() == east.len());
    for point in west {
        assert!(east.iter().any(|other| (other - point).norm() < 1e-6), "{point} is in the west room alone");
    }
}

/// What a real robot's log is like, on the numbers of exp1 and exp3: 43 % of the beams without echo, 3 % error codes, nine ranges in
/// ten below 3.5 m, stamps 69 to 136 ms apart.
#[test]
fn a_real_lab_is_like_the_recorded_one() {
    let drive = drive(&world("lab.toml"), &robot(), &SimConfig::of(SimKind::Real), 5).unwrap();
    // The outer 70 beams of the recorded logs see the rover.
    let mut ranges: Vec<u16> = drive.log.scans.iter().flat_map(|s| s.ranges_mm[70..612].to_vec()).collect();
    ranges.sort_unstable();
    let share = |most: u16| ranges.partition_point(|mm| *mm <= most) as f64 / ranges.len() as f64;
    assert!((0.35..0.5).contains(&share(0)), "{} without echo", share(0));
    assert!((0.02..0.05).contains(&(share(19) - share(0))), "{} error codes", share(19) - share(0));
    let seen = &ranges[ranges.partition_point(|mm| *mm < 20)..];
    assert!((3000..4000).contains(&seen[seen.len() * 9 / 10]), "{}", seen[seen.len() * 9 / 10]);
    let mut apart: Vec<u64> = drive.log.scans.windows(2).map(|w| w[1].stamp_us - w[0].stamp_us).collect();
    apart.sort_unstable();
    let at = |share: f64| apart[(apart.len() as f64 * share) as usize] / 1000;
    assert!((60..80).contains(&at(0.05)) && (95..105).contains(&at(0.5)) && (120..145).contains(&at(0.95)));
}

#[test]
fn a_lifted_robot_is_put_down_elsewhere_and_its_wheels_stand_still() {
    let world = world("hall_quarter.toml");
    let mut config = SimConfig::default();
    for setting in ["fault.lift_at_s=10", "fault.lift_by_m=3", "wheel.slip_m_per_sqrt_m=0"] {
        config.set(setting).unwrap();
    }
    let lifted = drive(&world, &robot(), &config, 1).unwrap();
    let at =
        |time_s: f64| lifted.log.scans.iter().position(|s| s.stamp_us as f64 * 1e-6 - 1.0 > time_s).unwrap();
    let (before, after) = (at(10.1), at(12.9));
    assert_eq!(lifted.log.odometry[before].1, lifted.log.odometry[after].1);
    let way = (lifted.truth[at(13.1)].translation.vector - lifted.truth[at(9.9)].translation.vector).norm();
    assert!((2.8..3.2).contains(&way), "{way} m");
    let end = lifted.truth.last().unwrap().translation.vector;
    let [x, y] = *world.path.points.last().unwrap();
    assert!(
        (end - nalgebra::Vector2::new(x, y)).norm() < 0.25,
        "it drives on to its goal, and ends at {end}"
    );
}

/// Each error has random numbers of its own: a clock that jitters moves no wheel, a bias no speckle.
#[test]
fn turning_an_error_off_does_not_move_the_others() {
    let world = world("hall_quarter.toml");
    let driven = |settings: &[&str]| {
        let mut config = SimConfig::of(SimKind::Real);
        settings.iter().for_each(|setting| config.set(setting).unwrap());
        drive(&world, &robot(), &config, 6).unwrap()
    };
    let all = driven(&[]);
    let no_bias = driven(&["sensor.bias=0", "sensor.speckle=0"]);
    assert_eq!((&all.truth, &all.log.odometry), (&no_bias.truth, &no_bias.log.odometry));
    let unmoved = |a: u16, b: u16| a.abs_diff(b) <= 90 || a <= 20 || b <= 20;
    let pairs = all.log.scans.iter().zip(&no_bias.log.scans);
    let (mut moved, mut count) = (0, 0);
    for (a, b) in pairs.flat_map(|(a, b)| a.ranges_mm.iter().zip(&b.ranges_mm)) {
        moved += usize::from(!unmoved(*a, *b));
        count += 1;
    }
    assert!((moved as f64) < 0.005 * f64::from(count), "{moved} of {count} moved by more than bias");
    assert_eq!(no_bias.unit.range_scale, 1.0);
    assert!(all.unit.range_scale != 1.0 && (all.unit.range_scale - 1.0).abs() <= 0.01);
    assert_eq!(all.unit.radius_scale, no_bias.unit.radius_scale);
}

#[test]
fn the_same_seed_gives_the_same_bytes_and_another_seed_others() {
    let folder = tempfile::tempdir().unwrap();
    let world = worlds().join("hall_quarter.toml");
    let world = world.to_str().unwrap();
    let log = |name: &str, seed: &str| {
        let out = folder.path().join(name);
        let output = simulate(&out, &[world, "--seed", seed]);
        assert!(output.status.success(), "{output:?}");
        (std::fs::read(out.join("log.jsonl")).unwrap(), std::fs::read(out.join("trajectory.tum")).unwrap())
    };
    assert_eq!(log("a", "5"), log("b", "5"));
    assert_ne!(log("a", "5").0, log("c", "6").0);
}

#[test]
fn the_log_replays_to_the_same_trajectory() {
    let folder = tempfile::tempdir().unwrap();
    let (first, second) = (folder.path().join("first"), folder.path().join("second"));
    let world = worlds().join("hall_quarter.toml");
    assert!(simulate(&first, &[world.to_str().unwrap()]).status.success());
    let robot = Path::new(env!("CARGO_MANIFEST_DIR")).join("../robots/paper.toml");
    let output = Command::new(env!("CARGO_BIN_EXE_lineslam"))
        .args(["replay".as_ref(), first.join("log.jsonl").as_os_str(), "--robot".as_ref(), robot.as_os_str()])
        .arg("--out")
        .arg(&second)
        .output()
        .unwrap();
    assert!(output.status.success(), "{output:?}");
    let read = |folder: &Path| std::fs::read_to_string(folder.join("trajectory.tum")).unwrap();
    assert_eq!(read(&first), read(&second));
}

#[test]
fn the_report_has_the_truth_s_word() {
    let folder = tempfile::tempdir().unwrap();
    let world = worlds().join("hall_quarter.toml");
    let output = simulate(folder.path(), &[world.to_str().unwrap(), "--set", "sensor.dropout=0.05"]);
    assert!(output.status.success(), "{output:?}");
    let text = std::fs::read(folder.path().join("report.json")).unwrap();
    let report: serde_json::Value = serde_json::from_slice(&text).unwrap();
    for key in ["corner_error_m", "ate_rmse_m", "final_position_error_m"] {
        let value = report[key].as_f64().unwrap_or_else(|| panic!("no {key}"));
        assert!(value > 0.0 && value < 0.1, "{key} = {value}");
    }
    assert!(
        report["dead_reckoning"]["ate_rmse_m"].as_f64().unwrap() > report["ate_rmse_m"].as_f64().unwrap()
    );
    // Each alignment leaves less than the one before.
    let errors = ["unaligned_rmse_m", "ate_rmse_m", "scaled_rmse_m"].map(|key| report[key].as_f64().unwrap());
    assert!(errors.is_sorted_by(|a, b| a >= b), "{errors:?}");
    for laid in ["laid", "laid_with_scale"] {
        let found = report[laid]["corners_found"].as_u64().unwrap();
        assert!(found >= report["corners_found"].as_u64().unwrap(), "{laid}: {found}");
        assert!((report[laid]["scale"].as_f64().unwrap() - 1.0).abs() < 0.02, "{laid}");
    }
    assert_eq!(report["errors"]["sensor"]["dropout"], 0.05);
    assert_eq!(report["world"], "hall_quarter");
    let truth = std::fs::read_to_string(folder.path().join("truth.tum")).unwrap();
    assert_eq!(truth.lines().count() as u64, report["scans_used"].as_u64().unwrap());
}

#[test]
fn bad_settings_and_worlds_are_named() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("out");
    let hall = worlds().join("hall_quarter.toml");
    let hall = hall.to_str().unwrap();
    let refused = |arguments: &[&str], words: &[&str]| {
        let output = simulate(&out, arguments);
        let said = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{said}");
        assert!(words.iter().all(|w| said.contains(w)), "{words:?} are not in: {said}");
        assert!(!out.exists());
    };
    refused(&[hall, "--set", "wheel.colour=1"], &["wheel.colour=1", "no key 'wheel.colour'"]);
    refused(&[hall, "--set", "wheel.radius_error"], &["wheel.radius_error", "key=value"]);
    refused(&[hall, "--set", "sensor.dropout=often"], &["sensor.dropout=often", "not a number"]);
    refused(&[hall, "--set", "sensor.dropout=7"], &["sensor.dropout=7"]);
    refused(&["nowhere.toml"], &["nowhere.toml"]);
    let good = std::fs::read_to_string(hall).unwrap();
    for (from, to, words) in [
        ("name = ", "nam = ", ["nam", "bad.toml"]),
        ("radius = 0.25", "radius = -1", ["pillar 1: radius", "bad.toml"]),
        ("at = [0, 0]", "at = [3.3, 3.3]", ["corner 'a'", "no two walls"]),
    ] {
        let bad = folder.path().join("bad.toml");
        assert!(good.contains(from));
        std::fs::write(&bad, good.replacen(from, to, 1)).unwrap();
        refused(&[bad.to_str().unwrap()], &words);
    }
}

#[test]
fn counters_wrap_scans_go_missing_and_ticks_lie_as_asked() {
    let world = world("hall_quarter.toml");
    let plain = drive(&world, &robot(), &SimConfig::default(), 1).unwrap();
    let ticks: Vec<i64> = plain
        .log
        .odometry
        .iter()
        .map(|(_, o)| match o {
            Odometry::Ticks([left, _]) => *left,
            Odometry::Angles(_) | Odometry::Pose(_) => unreachable!("the simulated robot counts ticks"),
        })
        .collect();
    assert!(ticks.iter().all(|t| (0..65_536).contains(t)));
    assert!(ticks.windows(2).any(|w| w[1] < w[0] - 60_000), "16-bit counters wrap on this drive");

    let mut config = SimConfig::default();
    config.set("sensor.skip_every=5").unwrap();
    let gaps = drive(&world, &robot(), &config, 1).unwrap();
    let (all, some) = (plain.log.scans.len(), gaps.log.scans.len());
    assert!((some as f64 / all as f64 - 0.8).abs() < 0.01, "{some} of {all} scans");

    let mut config = SimConfig::default();
    config.set("wheel.radius_error=0.03").unwrap();
    config.set("wheel.radius_difference=0").unwrap();
    let ([left, right], _) = drive(&world, &robot(), &config, 1).unwrap().true_wheels;
    assert!(
        (left - right).abs() < 1e-12 && ((left / 0.05 - 1.0).abs() - 0.03).abs() < 1e-6,
        "{left} {right}"
    );
}

/// Noise of the ranges is that of the model: σ of 10 mm up to 1 m, 1 % of the range beyond.
#[test]
fn range_noise_is_the_model_s() {
    let text = "name = \"wall\"\n[[wall]]\npoints = [[2, -50], [2, 50]]\n[path]\nheading_deg = 90\nspeed = 0.2\npoints = [[0, 0], [0, 1]]\n";
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("wall.toml");
    std::fs::write(&path, text).unwrap();
    let world = World::load(&path).unwrap();
    let mut config = SimConfig::default();
    for quiet in ["sensor.dropout=0", "sensor.mixed_pixels=0"] {
        config.set(quiet).unwrap();
    }
    let drive = drive(&world, &robot(), &config, 3).unwrap();
    // The beam at −90° (256 steps right of the front) meets the wall at 2 m.
    let beam = 384 - 44 - 256;
    let straight: Vec<f64> = drive
        .log
        .scans
        .iter()
        .zip(&drive.truth)
        .filter(|(_, t)| (t.rotation.angle() - std::f64::consts::FRAC_PI_2).abs() < 1e-3)
        .map(|(s, t)| f64::from(s.ranges_mm[beam]) * 1e-3 - (2.0 - t.translation.x))
        .collect();
    let n = straight.len() as f64;
    assert!(n > 30.0);
    let rms = (straight.iter().map(|e| e * e).sum::<f64>() / n).sqrt();
    assert!((0.013..0.028).contains(&rms), "σ is {rms} m at 2 m");
}

#[test]
fn a_written_log_is_read_as_it_was() {
    let drive = drive(&world("parallel.toml"), &robot(), &SimConfig::default(), 2).unwrap();
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("log.jsonl");
    std::fs::write(&path, log::plain_text(&drive.log, &robot())).unwrap();
    let options = ReadOptions { beams: robot().beams(), ..ReadOptions::default() };
    let read = log::read(&path, &options).unwrap();
    assert_eq!(read.format, "plain");
    assert_eq!(read.odometry, drive.log.odometry);
    assert_eq!(read.scans.len(), drive.log.scans.len());
    for (read, written) in read.scans.iter().zip(&drive.log.scans) {
        assert_eq!((read.stamp_us, &read.ranges_mm), (written.stamp_us, &written.ranges_mm));
    }
    // What the first line says of the robot is what the robot file says.
    let (stated, known) = (read.usual_robot(), robot());
    assert_eq!(stated.drive(), known.drive());
    let [stated, known] = [&stated, &known].map(|robot| robot.sensor_for(&read.layout(0)));
    for beam in [0, 100, 681] {
        let bearing = |sensor: &slam_core::sensor::scan::SensorConfig| {
            slam_core::geometry::pose::heading(&sensor.mounting.base_from_laser)
                + sensor.geometry.bearing(beam)
        };
        assert!(
            (bearing(&stated) - bearing(&known)).abs() < 1e-5,
            "{} {}",
            bearing(&stated),
            bearing(&known)
        );
    }
    assert_eq!((stated.codes.min_mm, stated.codes.max_mm), (known.codes.min_mm, known.codes.max_mm));
    assert!((i64::from(stated.geometry.revolution_us) - i64::from(known.geometry.revolution_us)).abs() <= 1);
}
