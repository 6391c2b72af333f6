//! The fixed set of scans, as constants for the benchmark firmware: a drive through the simulated office, seed 1, and the map it ends with.

use std::error::Error;
use std::fmt::Write;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use clap::Parser;
use lineslam::robot::Robot;
use lineslam::sim::fixed_set::FixedSet;
use nalgebra::{Isometry2, Vector2};
use slam_core::MapSegment;
use slam_core::geometry::pose::components;

/// Scans in the set, one after the other.
const SCANS: usize = 300;
/// Segments of the largest map.
const SEGMENTS: usize = 500;

/// Writes the fixed set of scans as Rust constants, which `bench-target` is built with.
#[derive(Parser)]
struct Cli {
    /// The world that is driven through.
    #[arg(long, value_name = "FILE")]
    world: PathBuf,
    /// The robot that drives.
    #[arg(long, value_name = "FILE")]
    robot: PathBuf,
    /// Where the constants go. A file that has them already is left alone, so that nothing is built again.
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
}

fn main() -> ExitCode {
    match write(&Cli::parse()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error}");
            ExitCode::FAILURE
        }
    }
}

fn write(cli: &Cli) -> Result<(), Box<dyn Error>> {
    let text = constants(&cli.world, &cli.robot)?;
    if std::fs::read_to_string(&cli.out).is_ok_and(|there| there == text) {
        return Ok(());
    }
    std::fs::write(&cli.out, text).map_err(|error| format!("{}: {error}", cli.out.display()).into())
}

fn constants(world: &Path, robot: &Path) -> Result<String, Box<dyn Error>> {
    let set = FixedSet::new(world, &Robot::load(robot)?, SCANS)?;
    let beams = set.ranges_mm.first().map_or(0, Vec::len);
    let mut text = String::new();
    writeln!(text, "/// Ranges of each scan, millimetres.")?;
    writeln!(text, "static RANGES_MM: [[u16; {beams}]; {SCANS}] = [")?;
    for ranges_mm in &set.ranges_mm {
        writeln!(text, "{ranges_mm:?},")?;
    }
    writeln!(text, "];\n/// The motion that led to each scan.")?;
    writeln!(text, "static MOTIONS: [Motion; {SCANS}] = [")?;
    for motion in &set.motions {
        let sweep: Vec<[f32; 3]> = motion.middle_from_knot.iter().map(numbers).collect();
        let last = &motion.since_previous;
        let (way, turn, moved) = (last.distance_m, last.turn_rad, numbers(&last.before_from_after));
        writeln!(
            text,
            "Motion {{ distance_m: {way:?}, turn_rad: {turn:?}, moved: {moved:?}, sweep: {sweep:?} }},"
        )?;
    }
    let begin = numbers(&set.begin);
    writeln!(text, "];\n/// Where the robot was a scan before.\nconst BEGIN: [f32; 3] = {begin:?};")?;
    writeln!(
        text,
        "/// The map, with the scans that saw each segment: nearest to the way first.\nstatic MAP: [(Segment, u16); {SEGMENTS}] = ["
    )?;
    for entry in set.map(SEGMENTS) {
        writeln!(text, "{},", literal(&entry))?;
    }
    writeln!(text, "];")?;
    Ok(text)
}

fn numbers(at: &Isometry2<f32>) -> [f32; 3] {
    components(at).into()
}

fn literal(entry: &MapSegment) -> String {
    let s = &entry.segment();
    let m = &s.moments;
    let vector = |v: Vector2<f32>| format!("Vector2::new({:?}, {:?})", v.x, v.y);
    let point = |p: nalgebra::Point2<f32>| format!("Point2::new({:?}, {:?})", p.x, p.y);
    format!(
        "(Segment {{ moments: Moments {{ inliers: {}, weight: {:?}, centroid: {}, scatter: {:?} }}, \
         direction: {}, start: {}, end: {} }}, {})",
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
