//! `lineslam replay`.

use std::path::PathBuf;

use lineslam::output;
use lineslam::output::report::Report;
use lineslam::output::svg::Scene;
use lineslam::robot::Robot;

use super::common::{self, Configuration, print_summary, results};
use super::log_args::{LogArgs, warn};

#[derive(clap::Args)]
pub struct Args {
    #[command(flatten)]
    log: LogArgs,
    /// Robot file: wheels, scanner, mounting. Without it what the log states is used; what it does not, such as noise, is that of
    /// mines.toml for a mines log and of sick.toml for others.
    #[arg(long, value_name = "FILE")]
    robot: Option<PathBuf>,
    /// Which algorithm.
    #[arg(long, value_enum, default_value_t = Configuration::Default)]
    config: Configuration,
    /// Folder for trajectory.tum and .csv, trajectory_final.tum, odometry.tum, map.csv, map.svg, map.dxf, map.pgm with
    /// map.yaml, and report.json.
    #[arg(long, value_name = "FOLDER", default_value = "out")]
    out: PathBuf,
    /// Also record the run as ROS 2 messages in this MCAP file, for ros2 bag play, RViz and Foxglove.
    #[arg(long, value_name = "FILE")]
    mcap: Option<PathBuf>,
}

pub fn run(args: &Args) -> anyhow::Result<()> {
    // A given robot file is checked first: its beams are what the log must have.
    let given = args.robot.as_deref().map(Robot::load).transpose()?;
    let wheels = given.as_ref().is_some_and(|robot| robot.wheels.is_some());
    let log = args.log.read(given.as_ref(), wheels)?;
    let robot = given.unwrap_or_else(|| log.usual_robot());
    warn(&log.warnings);
    let result = common::run(&log, &robot, args.config)?;
    let report = Report::new(&log, &robot, args.config.name(), &result);
    warn(report.warnings.get(log.warnings.len()..).unwrap_or_default());
    let path = &args.log.log;
    let name = path.file_name().map_or_else(String::new, |n| n.to_string_lossy().into_owned());
    let scene = Scene { title: &name, subtitle: args.config.subtitle(), ..Scene::default() };
    let files = results(&log, &result, &report, &scene, args.mcap.as_deref())?;
    output::write_all(&args.out, &files)?;
    print_summary("log", &path.display().to_string(), &args.out, &report);
    Ok(())
}
