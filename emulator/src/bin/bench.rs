//! `cargo xtask bench-target` runs this: a firmware that counts, on a core whose every instruction takes one cycle.

use std::path::PathBuf;
use std::process::ExitCode;

use clap::Parser;
use emulator::bench::{self, Measured};

/// Runs the benchmark firmware on an emulated core and prints what it counted: instructions.
#[derive(Parser)]
#[command(bin_name = "cargo xtask bench-target")]
struct Cli {
    /// The benchmark firmware.
    #[arg(long, value_name = "ELF")]
    firmware: PathBuf,
    /// Print the firmware's log as it comes.
    #[arg(long)]
    log: bool,
}

fn main() -> ExitCode {
    let cli = Cli::parse();
    match bench::run(&cli.firmware, cli.log).and_then(|measured: Measured| measured.print()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error:#}");
            ExitCode::FAILURE
        }
    }
}
