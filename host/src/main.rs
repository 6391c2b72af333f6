//! `lineslam`: line-segment SLAM on a PC.
#![forbid(unsafe_code)]

mod commands;

use std::process::ExitCode;

use clap::{Parser, Subcommand};
use commands::{benchmark, calibrate, connect, experiments, live, record, replay, scan, score, simulate};
use lineslam::benchmark::BenchmarkError;
use lineslam::calibrate::CalibrationError;
use lineslam::emulated::EmulationError;
use lineslam::experiments::ExperimentError;
use lineslam::log::LogError;
use lineslam::map_file::MapFileError;
use lineslam::replay::ReplayError;
use lineslam::score::ScoreError;
use lineslam::sim::BadSetting;
use lineslam::toml_file::FileError;

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
    Replay(replay::Args),
    /// Drive a simulated robot through a world and see how well it maps it.
    Simulate(simulate::Args),
    /// Judge a trajectory by a reference, or by relations between poses that were checked by hand.
    Score(score::Args),
    /// Replay all recorded logs of a folder, and write the page that compares the results with published ones.
    Benchmark(benchmark::Args),
    /// Learn wheel radii, track, delay and mounting from a drive, and write a robot file.
    Calibrate(calibrate::Args),
    /// Run the paper's experiments and more, and write the page with tables and figures.
    Experiments(experiments::Args),
    /// See what the robot does, and tell it what to do.
    Connect(connect::Args),
    /// Record what the robot says: scans, wheels, poses and events, for replay, calibrate, ROS and Foxglove.
    Record(record::Args),
    /// Watch a log or a simulated drive being mapped, in the browser.
    Live(live::Args),
    /// Ask a sensor on a serial port who it is and draw one of its scans.
    Scan(scan::Args),
}

fn main() -> ExitCode {
    let done = match Cli::parse().command {
        Command::Replay(args) => replay::run(&args),
        Command::Simulate(args) => simulate::run(&args),
        Command::Score(args) => score::run(&args),
        Command::Benchmark(args) => benchmark::run(&args),
        Command::Calibrate(args) => calibrate::run(&args),
        Command::Experiments(args) => experiments::run(&args),
        Command::Connect(args) => connect::run(&args),
        Command::Record(args) => record::run(&args),
        Command::Live(args) => live::run(&args),
        Command::Scan(args) => scan::run(&args),
    };
    match done {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error:#}");
            let bad_input = error.is::<LogError>()
                || error.is::<FileError>()
                || error.is::<MapFileError>()
                || error.is::<ReplayError>()
                || error.is::<ScoreError>()
                || error.is::<BenchmarkError>()
                || error.is::<BadSetting>()
                || error.is::<CalibrationError>()
                || error.is::<ExperimentError>()
                || matches!(error.downcast_ref(), Some(EmulationError::UnknownWorld { .. }));
            ExitCode::from(if bad_input { 2 } else { 1 })
        }
    }
}
