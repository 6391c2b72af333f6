//! `lineslam replay`.

use std::path::PathBuf;

use lineslam::log::{self, Format, ReadOptions};
use lineslam::output;
use lineslam::output::report::Report;
use lineslam::output::svg::Scene;
use lineslam::robot::Robot;

use super::common::{Configuration, print_summary, results};

#[derive(clap::Args)]
pub struct Args {
    /// The log, plain or gzipped.
    log: PathBuf,
    /// Robot file: wheels, scanner, mounting. By default mines.toml for a mines log, sick.toml for a CARMEN log.
    #[arg(long, value_name = "FILE")]
    robot: Option<PathBuf>,
    /// Format of the log.
    #[arg(long, value_enum, default_value_t = Format::Auto)]
    format: Format,
    /// Which algorithm: the best we know, or the paper step for step.
    #[arg(long, value_enum, default_value_t = Configuration::Default)]
    config: Configuration,
    /// Folder for trajectory.tum, odometry.tum, map.csv, map.svg, map.pgm, map.yaml and report.json.
    #[arg(long, value_name = "FOLDER", default_value = "out")]
    out: PathBuf,
    /// Skip and count records that cannot be read, instead of stopping at the first.
    #[arg(long)]
    lenient: bool,
}

pub fn run(args: &Args) -> anyhow::Result<()> {
    // A given robot file is checked first: its beams are what the log must have.
    let given = args.robot.as_deref().map(Robot::load).transpose()?;
    let options = |beams| ReadOptions { format: args.format, beams, lenient: args.lenient };
    let log = log::read(&args.log, &options(given.as_ref().and_then(Robot::beams)))?;
    let robot = given.unwrap_or_else(|| Robot::usual_for(log.format));
    let result = super::common::run(&log, &robot, args.config)?;
    let report = Report::new(&log, &robot, args.config.name(), &result);
    let name = args.log.file_name().map_or_else(String::new, |n| n.to_string_lossy().into_owned());
    let scene = Scene { title: &name, subtitle: args.config.subtitle(), ..Scene::default() };
    let files = results(&result, &report, &scene)?;
    output::write_all(&args.out, &files)?;
    print_summary("log", &args.log.display().to_string(), &args.out, &report);
    Ok(())
}
