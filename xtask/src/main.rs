//! `cargo xtask`: one word for each thing a person or CI does.
#![forbid(unsafe_code)]

mod bench;
mod run;
mod size;
mod test;

use std::process::ExitCode;

use clap::{Parser, Subcommand};

/// The target of the firmware.
pub const TARGET: &str = "thumbv7em-none-eabihf";

/// One word for each thing a person or CI does.
#[derive(Parser)]
#[command(bin_name = "cargo xtask")]
struct Cli {
    #[command(subcommand)]
    task: Task,
}

#[derive(Subcommand)]
enum Task {
    /// Everything CI runs: format, clippy for host and target, docs, sizes, costs, all tests.
    Test,
    /// Flash and RAM of the driver on the microcontroller.
    Size,
    /// Instructions that decoding a scan takes, counted by callgrind.
    Bench,
}

fn main() -> ExitCode {
    let done = match Cli::parse().task {
        Task::Test => test::everything(),
        Task::Size => size::report(),
        Task::Bench => bench::report(),
    };
    match done {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error:#}");
            ExitCode::FAILURE
        }
    }
}
