//! The fixed set of scans, as constants: a drive through the simulated office, seed 1, and the map it ends with.

use std::error::Error;
use std::fmt::Write;
use std::path::{Path, PathBuf};
use std::{env, fs};

use lineslam::replay::{self, Step};
use lineslam::robot::Robot;
use lineslam::sim::world::World;
use lineslam::sim::{self, SimConfig};
use nalgebra::{Isometry2, Vector2};
use slam_core::pose::{components, pose};
use slam_core::{MapSegment, SlamConfig};

/// Scans in the set, one after the other.
const SCANS: usize = 300;
/// Segments of the largest map.
const SEGMENTS: usize = 500;
/// Copies of the building stand so far apart, metres.
const APART_M: f32 = 60.0;

fn main() {
    for argument in ["--nmagic", "-Tlink.x", "-Tdefmt.x"] {
        println!("cargo::rustc-link-arg-bins={argument}");
    }
    let root = PathBuf::from(env::var_os("CARGO_MANIFEST_DIR").expect("cargo sets it")).join("..");
    let out = PathBuf::from(env::var_os("OUT_DIR").expect("cargo sets it"));
    let (world, robot) = (root.join("worlds/office.toml"), root.join("robots/paper.toml"));
    for file in [&world, &robot, &root.join("memory.x"), &PathBuf::from("build.rs")] {
        println!("cargo::rerun-if-changed={}", file.display());
    }
    if env::var("CARGO_CFG_TARGET_OS").is_ok_and(|os| os != "none") {
        return;
    }
    fs::copy(root.join("memory.x"), out.join("memory.x")).expect("memory.x can be copied");
    println!("cargo::rustc-link-search={}", out.display());
    match constants(&world, &robot) {
        Ok(text) => fs::write(out.join("set.rs"), text).expect("set.rs can be written"),
        Err(error) => {
            println!("cargo::error={error}");
            std::process::exit(1);
        }
    }
}

fn constants(world: &Path, robot: &Path) -> Result<String, Box<dyn Error>> {
    let (world, robot) = (World::load(world)?, Robot::load(robot)?);
    let drive = sim::drive(&world, &robot, &SimConfig::default(), 1)?;
    let replayed = replay::run(&drive.log, &robot, SlamConfig::default(), || {})?;
    let from = (replayed.steps.len() - SCANS) / 2;
    let steps = &replayed.steps[from..from + SCANS];
    let mut text = String::new();
    writeln!(text, "/// Ranges of each scan, millimetres.")?;
    writeln!(text, "pub static RANGES_MM: [[u16; {}]; {SCANS}] = [", drive.log.scans[from].ranges_mm.len())?;
    for scan in &drive.log.scans[from..from + SCANS] {
        writeln!(text, "{:?},", scan.ranges_mm)?;
    }
    writeln!(text, "];\n/// Way, turn and motion since the scan before, and the sweep, of each scan.")?;
    writeln!(text, "pub static MOTIONS: [(f32, f32, [f32; 3], [[f32; 3]; SWEEP_KNOTS]); {SCANS}] = [")?;
    for step in steps {
        let m = &step.motion;
        let sweep: Vec<[f32; 3]> = m.middle_from_knot.iter().map(numbers).collect();
        let last = &m.since_previous;
        let moved = numbers(&last.before_from_after);
        writeln!(text, "({:?}, {:?}, {moved:?}, {sweep:?}),", last.distance_m, last.turn_rad)?;
    }
    let begin = numbers(&replayed.steps[from - 1].pose_in_final_map);
    writeln!(text, "];\n/// Where the robot was a scan before.\npub const BEGIN: [f32; 3] = {begin:?};")?;
    writeln!(text, "/// The map: nearest to the way first.\npub static MAP: [MapSegment; {SEGMENTS}] = [")?;
    for entry in map(&replayed.map, steps) {
        writeln!(text, "{},", literal(&entry))?;
    }
    writeln!(text, "];")?;
    Ok(text)
}

fn numbers(at: &Isometry2<f32>) -> [f32; 3] {
    components(at).into()
}

/// The building's own segments, then those of its copies beside it.
fn map(own: &[MapSegment], steps: &[Step]) -> Vec<MapSegment> {
    let from_way = |entry: &MapSegment| {
        let middle = entry.segment.midpoint().coords;
        steps
            .iter()
            .map(|s| (middle - s.pose_in_final_map.translation.vector).norm())
            .fold(f32::MAX, f32::min)
    };
    let mut own = own.to_vec();
    own.sort_by(|a, b| from_way(a).total_cmp(&from_way(b)));
    let copies = (0..).flat_map(|copy| {
        let beside = pose(0.0, copy as f32 * APART_M, 0.0);
        own.iter().map(move |entry| MapSegment { segment: entry.segment.transformed(&beside), ..*entry })
    });
    copies.take(SEGMENTS).collect()
}

fn literal(entry: &MapSegment) -> String {
    let s = &entry.segment;
    let m = &s.moments;
    let vector = |v: Vector2<f32>| format!("Vector2::new({:?}, {:?})", v.x, v.y);
    let point = |p: nalgebra::Point2<f32>| format!("Point2::new({:?}, {:?})", p.x, p.y);
    format!(
        "MapSegment {{ segment: Segment {{ moments: Moments {{ inliers: {}, weight: {:?}, centroid: {}, scatter: {:?} }}, \
         direction: {}, start: {}, end: {} }}, hits: {}, seen_through: 0, last_seen: 0, seen_at_m: 0.0 }}",
        m.inliers,
        m.weight,
        point(m.centroid),
        m.scatter,
        vector(s.direction),
        point(s.start),
        point(s.end),
        entry.hits
    )
}
