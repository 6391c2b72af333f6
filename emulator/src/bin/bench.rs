//! `cargo xtask bench-target` runs this: a firmware that counts, on a core whose every instruction takes one cycle, and on one that
//! takes as many as a Cortex-M4F.

use std::path::PathBuf;
use std::process::ExitCode;

use clap::Parser;
use emulator::bench;

/// Runs the benchmark firmware on an emulated core and prints what it counted: instructions, and cycles by a model.
#[derive(Parser)]
#[command(bin_name = "cargo xtask bench-target")]
struct Cli {
    /// The benchmark firmware.
    #[arg(long, value_name = "ELF")]
    firmware: PathBuf,
    /// Print the firmware's log as it comes, of the core of one cycle.
    #[arg(long)]
    log: bool,
}

fn main() -> ExitCode {
    let cli = Cli::parse();
    match bench::run(&cli.firmware, cli.log).and_then(|report| report.print()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error:#}");
            ExitCode::FAILURE
        }
    }
}
