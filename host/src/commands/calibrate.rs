//! `lineslam calibrate`.

use std::path::PathBuf;

use comfy_table::{CellAlignment, Table, presets};
use lineslam::calibrate;
use lineslam::robot::Robot;

use super::common::{progress_bar, write_one};
use super::log_args::{LogArgs, warn};

#[derive(clap::Args)]
pub struct Args {
    #[command(flatten)]
    log: LogArgs,
    /// Robot file that describes the robot nearly.
    #[arg(long, value_name = "FILE")]
    robot: PathBuf,
    /// The robot file to write: the one given, with what the log told.
    #[arg(long, value_name = "FILE", default_value = "calibrated.toml")]
    out: PathBuf,
}

pub fn run(args: &Args) -> anyhow::Result<()> {
    // Checked first: its beams are what the log must have.
    let robot = Robot::load(&args.robot)?;
    let log = args.log.read(Some(&robot), true)?;
    warn(&log.warnings);
    let progress = progress_bar(calibrate::ROUNDS, "replays at most");
    let result = calibrate::calibrate(&log, &args.robot, || progress.inc(1))?;
    progress.finish_and_clear();
    let mut table = Table::new();
    table.load_style(presets::NOTHING);
    table.set_header(["", "file", "log", "± 1σ", ""]);
    for p in &result.parameters {
        let told = if p.told { "" } else { "the log cannot tell: the file's value stays" };
        let digits = |v: f64| format!("{v:.4}");
        table.add_row([p.key.join("."), digits(p.before), digits(p.value), digits(p.sigma), told.into()]);
    }
    for column in table.column_iter_mut().skip(1).take(3) {
        column.set_cell_alignment(CellAlignment::Right);
    }
    write_one(&args.out, result.robot_file)?;
    println!("{table}\n\nby {} windows; written to {}", result.windows, args.out.display());
    Ok(())
}
