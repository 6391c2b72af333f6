//! `cargo xtask`: one word for each thing a person or CI does.
#![forbid(unsafe_code)]

mod bench;
mod board_setup;
mod firmware;
mod performance;
mod run;
mod size;
mod stress;
mod test;

use std::process::ExitCode;

use clap::{Parser, Subcommand};
use firmware::Build;

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
    /// The hall, driven round and mapped by the firmware on an emulated board, on a page in the browser; needs no hardware.
    Demo {
        /// Do not open the page in a browser. The command then ends with the drive; a page that was opened stays until Ctrl-C.
        #[arg(long)]
        no_open: bool,
    },
    /// Run the firmware on an emulated board in a simulated building.
    #[command(disable_help_flag = true)]
    Emulate {
        /// What the emulator takes; `--help` shows it.
        #[arg(trailing_var_arg = true, allow_hyphen_values = true, value_name = "ARGUMENTS")]
        arguments: Vec<String>,
    },
    /// Build the firmware, for the robot that LINESLAM_ROBOT names or robots/paper.toml.
    Firmware,
    /// Build the firmware, flash it with probe-rs, and show its log.
    Flash,
    /// Show the log of the firmware that runs, with probe-rs.
    Attach,
    /// Set the board's option bytes with probe-rs, once: brown-out reset at level 3.
    BoardSetup,
    /// Flash and RAM of the firmware by section and crate, against the budget, and of the sensor's driver alone.
    Size,
    /// Instructions that decoding a scan takes, counted by callgrind.
    Bench,
    /// Instructions of each stage of the core on an emulated Cortex-M4F, and of the functions it uses.
    BenchTarget,
    /// Replay recorded logs changed in ways that a good system hardly notices, and print the trajectory error of each.
    Stress {
        /// Seeds of the noise on every range.
        #[arg(long, default_value_t = 6)]
        seeds: u32,
        /// Names of the logs, with commas between; by default all that are there.
        #[arg(long, value_name = "NAME,...")]
        logs: Option<String>,
    },
    /// Measure what docs/performance.md says, on the emulated core and on this PC, and write it.
    Performance,
}

fn main() -> ExitCode {
    let done = match Cli::parse().task {
        Task::Test => test::everything(),
        Task::Demo { no_open } => firmware::demo(no_open),
        Task::Emulate { arguments } => firmware::emulate(&arguments),
        Task::Firmware => firmware::build(Build::Flashed).map(|elf| println!("{}", elf.display())),
        Task::Flash => firmware::flash(),
        Task::Attach => firmware::attach(),
        Task::BoardSetup => board_setup::run(),
        Task::Size => size::report(),
        Task::Bench => bench::report(),
        Task::BenchTarget => firmware::bench(),
        Task::Stress { seeds, logs } => stress::report(seeds, logs.as_deref()),
        Task::Performance => performance::report(),
    };
    match done {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error:#}");
            ExitCode::FAILURE
        }
    }
}
