//! `lineslam replay`.

use std::path::PathBuf;

use lineslam::output;
use lineslam::output::report::Report;
use lineslam::output::svg::Scene;
use nalgebra::Isometry2;
use slam_core::geometry::pose::pose;

use super::common::{self, print_summary, results};
use super::log_args::{LogArgs, warn};
use super::start_args::StartArgs;

#[derive(clap::Args)]
pub struct Args {
    #[command(flatten)]
    log: LogArgs,
    #[command(flatten)]
    begin: StartArgs,
    /// Where the robot stands in the map: x and y in metres, heading in degrees.
    #[arg(long, value_name = "X,Y,DEG", requires = "map", allow_hyphen_values = true, value_parser = start_pose)]
    start: Option<Isometry2<f32>>,
    /// Folder for trajectory.tum and .csv, trajectory_final.tum, odometry.tum, map.csv, map.json, map.svg, map.dxf, map.pgm
    /// with map.yaml, and report.json.
    #[arg(long, value_name = "FOLDER", default_value = "out")]
    out: PathBuf,
    /// Also record the run as ROS 2 messages in this MCAP file, for ros2 bag play, RViz and Foxglove.
    #[arg(long, value_name = "FILE")]
    mcap: Option<PathBuf>,
}

/// Three numbers with commas between them.
fn start_pose(text: &str) -> Result<Isometry2<f32>, String> {
    let numbers: Vec<f32> = text
        .split(',')
        .map(|word| word.trim().parse().ok().filter(|v: &f32| v.is_finite()))
        .collect::<Option<_>>()
        .ok_or("expected three numbers, as 1.5,-2,90")?;
    match numbers[..] {
        [x, y, deg] => Ok(pose(x, y, deg.to_radians())),
        _ => Err(format!("{} numbers where X,Y,DEG are expected", numbers.len())),
    }
}

pub fn run(args: &Args) -> anyhow::Result<()> {
    let start = args.begin.start(args.start)?;
    let config = args.begin.config;
    // A given robot file is checked first: its beams are what the log must have.
    let given = args.begin.robot()?;
    let wheels = given.as_ref().is_some_and(|robot| robot.wheels.is_some());
    let log = args.log.read(given.as_ref(), wheels)?;
    let robot = given.unwrap_or_else(|| log.usual_robot());
    warn(&log.warnings);
    let result = common::run(&start, &log, &robot, config)?;
    let report = Report::new(&log, &robot, config.name(), &result);
    warn(report.warnings.get(log.warnings.len()..).unwrap_or_default());
    let path = &args.log.log;
    let name = path.file_name().map_or_else(String::new, |n| n.to_string_lossy().into_owned());
    let scene = Scene { title: &name, subtitle: config.subtitle(), ..Scene::default() };
    let files = results(&log, &result, &report, &scene, args.mcap.as_deref())?;
    output::write_all(&args.out, &files)?;
    print_summary("log", &path.display().to_string(), &args.out, &report);
    Ok(())
}
