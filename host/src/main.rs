//! `lineslam`: line-segment SLAM on a PC.
#![forbid(unsafe_code)]

use std::io::IsTerminal;
use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::Context;
use clap::{Args, Parser, Subcommand, ValueEnum};
use comfy_table::{CellAlignment, Table, presets};
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use lineslam::log::{self, Format, Log, ReadOptions};
use lineslam::output::report::Report;
use lineslam::output::svg::Caption;
use lineslam::output::{self, csv, grid, svg, tum};
use lineslam::replay::{self, Replay, ReplayError};
use lineslam::robot::{Robot, RobotError};
use slam_core::SlamConfig;

/// Line-segment SLAM, the same core as on the microcontroller.
#[derive(Parser)]
#[command(version, about)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Turn a recorded log into a map and a trajectory.
    Replay(ReplayArgs),
}

#[derive(Args)]
struct ReplayArgs {
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

#[derive(Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Configuration {
    Default,
    Paper,
}

impl Configuration {
    fn name(self) -> &'static str {
        match self {
            Self::Default => "default",
            Self::Paper => "paper",
        }
    }

    fn config(self) -> SlamConfig {
        match self {
            Self::Default => SlamConfig::default(),
            Self::Paper => SlamConfig::paper(),
        }
    }
}

fn main() -> ExitCode {
    let Command::Replay(args) = Cli::parse().command;
    match replay(&args) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error:#}");
            let bad_input =
                error.is::<log::LogError>() || error.is::<RobotError>() || error.is::<ReplayError>();
            ExitCode::from(if bad_input { 2 } else { 1 })
        }
    }
}

fn replay(args: &ReplayArgs) -> anyhow::Result<()> {
    // A given robot file is checked first: its beams are what the log must have.
    let given = args.robot.as_deref().map(Robot::load).transpose()?;
    let options = |beams| ReadOptions { format: args.format, beams, lenient: args.lenient };
    let log = log::read(&args.log, &options(given.as_ref().and_then(Robot::beams)))?;
    let robot = match given {
        Some(robot) => robot,
        None => Robot::usual_for(log.format),
    };
    let progress = progress_bar(log.scans.len());
    let result = replay::run(&log, &robot, args.config.config(), || progress.inc(1))?;
    progress.finish_and_clear();
    let report = Report::new(&log, &robot, args.config.name(), &result);
    write(args, &result, &report)?;
    print_summary(args, &log, &report);
    Ok(())
}

fn write(args: &ReplayArgs, result: &Replay, report: &Report) -> anyhow::Result<()> {
    let name = args.log.file_name().map_or_else(String::new, |n| n.to_string_lossy().into_owned());
    let caption = Caption { log: &name, configuration: args.config.name() };
    let grid = grid::render(&result.steps).context("map.pgm")?;
    let files = [
        ("trajectory.tum", tum::render(replay::trajectory(&result.steps)).into_bytes()),
        ("odometry.tum", tum::render(replay::dead_reckoning(&result.steps)).into_bytes()),
        ("map.csv", csv::render(&result.map).context("map.csv")?),
        ("map.svg", svg::render(result, &caption).into_bytes()),
        ("map.pgm", grid.pgm),
        ("map.yaml", grid.yaml.into_bytes()),
        ("report.json", report.render().context("report.json")?),
    ];
    output::write_all(&args.out, &files)?;
    Ok(())
}

/// A bar on a terminal, nothing in a pipe.
fn progress_bar(scans: usize) -> ProgressBar {
    let style = ProgressStyle::with_template("{bar:40.cyan/dim} {pos}/{len} scans  {per_sec}  {eta} left")
        .expect("the template is a constant");
    let target = if std::io::stderr().is_terminal() {
        ProgressDrawTarget::stderr()
    } else {
        ProgressDrawTarget::hidden()
    };
    ProgressBar::with_draw_target(Some(scans as u64), target).with_style(style)
}

fn print_summary(args: &ReplayArgs, log: &Log, report: &Report) {
    let mut table = Table::new();
    table.load_style(presets::NOTHING);
    let skipped = match log.skipped.values().sum::<usize>() {
        0 => "none".to_owned(),
        _ => log.skipped.iter().map(|(reason, n)| format!("{n} {reason}")).collect::<Vec<_>>().join(", "),
    };
    for (what, value) in [
        ("log", format!("{} ({})", args.log.display(), report.format)),
        ("robot, configuration", format!("{}, {}", report.robot, report.configuration)),
        ("scans used", report.scans_used.to_string()),
        ("records skipped", skipped),
        ("driven", format!("{:.1} m in {:.1} s", report.distance_m, report.duration_s)),
        ("map", format!("{} segments, room for {}", report.segments, report.map_capacity)),
        (
            "time for a scan, here",
            format!(
                "median {:.0} µs, p99 {:.0} µs, max {:.0} µs",
                report.scan_us.median, report.scan_us.p99, report.scan_us.max
            ),
        ),
        ("RAM of Slam", format!("{} bytes", report.slam_bytes)),
        ("written to", args.out.display().to_string()),
    ] {
        table.add_row([what.to_owned(), value]);
    }
    if let Some(column) = table.column_mut(0) {
        column.set_cell_alignment(CellAlignment::Right);
    }
    println!("{table}");
}
