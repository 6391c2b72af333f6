//! `lineslam`: line-segment SLAM on a PC.
#![forbid(unsafe_code)]

use std::io::IsTerminal;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use anyhow::Context;
use clap::{Args, Parser, Subcommand, ValueEnum};
use comfy_table::{CellAlignment, Table, presets};
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use lineslam::calibrate::{self, CalibrationError};
use lineslam::experiments::{self, ExperimentError, document};
use lineslam::log::{self, Format, Log, ReadOptions};
use lineslam::output::report::{Report, SimulationReport};
use lineslam::output::scan::{self, Beams};
use lineslam::output::svg::Scene;
use lineslam::output::{self, csv, grid, svg, tum};
use lineslam::replay::{self, Replay, ReplayError};
use lineslam::robot::Robot;
use lineslam::serial::{self, OneScan};
use lineslam::sim::world::World;
use lineslam::sim::{self, BadSetting, SimConfig, judge};
use lineslam::toml_file::FileError;
use slam_core::SlamConfig;
use slam_core::scan::{RangeCodes, ScanGeometry};

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
    /// Drive a simulated robot through a world and see how well it maps it.
    Simulate(SimulateArgs),
    /// Learn wheel radii, track, delay and mounting from a drive, and write a robot file.
    Calibrate(CalibrateArgs),
    /// Run the paper's experiments and more, and write the page with tables and figures.
    Experiments(ExperimentsArgs),
    /// Ask a sensor on a serial port who it is and draw one of its scans.
    Scan(ScanArgs),
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

#[derive(Args)]
struct SimulateArgs {
    /// World file: walls, things, people, and the robot's path.
    world: PathBuf,
    /// Seed of all noise; the same seed gives the same drive.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Robot file. By default paper.toml.
    #[arg(long, value_name = "FILE")]
    robot: Option<PathBuf>,
    /// Which algorithm: the best we know, or the paper step for step.
    #[arg(long, value_enum, default_value_t = Configuration::Default)]
    config: Configuration,
    /// Folder for all that replay writes, and for log.dat, which replay reads, and truth.tum.
    #[arg(long, value_name = "FOLDER", default_value = "out")]
    out: PathBuf,
    /// Change an error of the simulated robot: wheel.radius_error, wheel.radius_difference, wheel.track_error,
    /// wheel.slip_m_per_sqrt_m, sensor.sigma_m, sensor.sigma_per_m, sensor.uniform_m, sensor.dropout,
    /// sensor.mixed_pixels, sensor.least_incidence, sensor.skip_every, sensor.delay_s.
    #[arg(long = "set", value_name = "KEY=VALUE")]
    settings: Vec<String>,
}

#[derive(Args)]
struct CalibrateArgs {
    /// The log, plain or gzipped, with wheel ticks.
    log: PathBuf,
    /// Robot file that describes the robot nearly.
    #[arg(long, value_name = "FILE")]
    robot: PathBuf,
    /// Format of the log.
    #[arg(long, value_enum, default_value_t = Format::Auto)]
    format: Format,
    /// The robot file to write: the one given, with what the log told.
    #[arg(long, value_name = "FILE", default_value = "calibrated.toml")]
    out: PathBuf,
    /// Skip and count records that cannot be read, instead of stopping at the first.
    #[arg(long)]
    lenient: bool,
}

#[derive(Args)]
struct ExperimentsArgs {
    /// Drives of each building.
    #[arg(long, default_value_t = 20, value_parser = clap::value_parser!(u32).range(1..=1000))]
    seeds: u32,
    /// Seed of the first drive; the others follow.
    #[arg(long, default_value_t = 1001)]
    first_seed: u64,
    /// Folder of the worlds hall, corridor, office and parallel.
    #[arg(long, value_name = "FOLDER", default_value = "worlds")]
    worlds: PathBuf,
    /// Folder of recorded logs with their references; without it that part is left out.
    #[arg(long, value_name = "FOLDER", env = "LINESLAM_DATA")]
    data: Option<PathBuf>,
    /// Folder for experiments.md and images/.
    #[arg(long, value_name = "FOLDER", default_value = "docs")]
    out: PathBuf,
}

#[derive(Args)]
struct ScanArgs {
    /// Serial port of the sensor, such as /dev/ttyACM0.
    #[arg(long, value_name = "DEVICE")]
    port: String,
    /// Bit rate to work at; a sensor on USB takes any.
    #[arg(long, default_value_t = 115_200, value_name = "BIT/S")]
    baud_rate: u32,
    /// Attempts to connect.
    #[arg(long, default_value_t = 3, value_parser = clap::value_parser!(u32).range(1..=1000))]
    attempts: u32,
    /// The drawing.
    #[arg(long, value_name = "FILE", default_value = "scan.svg")]
    out: PathBuf,
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

    /// For pictures.
    fn subtitle(self) -> &'static str {
        match self {
            Self::Default => "default configuration",
            Self::Paper => "paper configuration",
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
    let done = match Cli::parse().command {
        Command::Replay(args) => replay(&args),
        Command::Simulate(args) => simulate(&args),
        Command::Calibrate(args) => run_calibrate(&args),
        Command::Experiments(args) => run_experiments(&args),
        Command::Scan(args) => run_scan(&args),
    };
    match done {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error:#}");
            let bad_input = error.is::<log::LogError>()
                || error.is::<FileError>()
                || error.is::<ReplayError>()
                || error.is::<BadSetting>()
                || error.is::<CalibrationError>()
                || error.is::<ExperimentError>();
            ExitCode::from(if bad_input { 2 } else { 1 })
        }
    }
}

fn replay(args: &ReplayArgs) -> anyhow::Result<()> {
    // A given robot file is checked first: its beams are what the log must have.
    let given = args.robot.as_deref().map(Robot::load).transpose()?;
    let options = |beams| ReadOptions { format: args.format, beams, lenient: args.lenient };
    let log = log::read(&args.log, &options(given.as_ref().and_then(Robot::beams)))?;
    let robot = given.unwrap_or_else(|| Robot::usual_for(log.format));
    let result = run(&log, &robot, args.config)?;
    let report = Report::new(&log, &robot, args.config.name(), &result);
    let name = args.log.file_name().map_or_else(String::new, |n| n.to_string_lossy().into_owned());
    let scene = Scene { title: &name, subtitle: args.config.subtitle(), ..Scene::default() };
    let files = results(&result, &report, &scene)?;
    output::write_all(&args.out, &files)?;
    print_summary("log", &args.log.display().to_string(), &args.out, &report);
    Ok(())
}

fn simulate(args: &SimulateArgs) -> anyhow::Result<()> {
    let world = World::load(&args.world)?;
    let robot = args.robot.as_deref().map_or_else(|| Ok(Robot::usual_for("simulated")), Robot::load)?;
    let mut errors = SimConfig::default();
    for setting in &args.settings {
        errors.set(setting)?;
    }
    let drive = sim::drive(&world, &robot, &errors, args.seed)?;
    let result = run(&drive.log, &robot, args.config)?;
    let mut report = Report::new(&drive.log, &robot, args.config.name(), &result);
    report.simulation = Some(SimulationReport::new(&world, &drive, &result, args.seed, errors));
    let caption = format!("{}, seed {}", world.name, args.seed);
    let blueprint = judge::blueprint_in_map(&world, &drive);
    let scene = Scene {
        title: &caption,
        subtitle: args.config.subtitle(),
        blueprint: &blueprint,
        ..Scene::default()
    };
    let mut files = results(&result, &report, &scene)?;
    files.push(("log.dat", sim::mines_text(&drive.log).into_bytes()));
    let stamps = drive.log.scans.iter().map(|s| s.stamp_us);
    files.push(("truth.tum", tum::render_f64(stamps.zip(&drive.truth)).into_bytes()));
    output::write_all(&args.out, &files)?;
    print_summary("world", &caption, &args.out, &report);
    Ok(())
}

fn run_calibrate(args: &CalibrateArgs) -> anyhow::Result<()> {
    // Checked first: its beams are what the log must have.
    let robot = Robot::load(&args.robot)?;
    let options = ReadOptions { format: args.format, beams: robot.beams(), lenient: args.lenient };
    let log = log::read(&args.log, &options)?;
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

fn run_experiments(args: &ExperimentsArgs) -> anyhow::Result<()> {
    let seeds = args.first_seed..args.first_seed.saturating_add(u64::from(args.seeds));
    let options = experiments::Options { worlds: args.worlds.clone(), data: args.data.clone(), seeds };
    let progress = progress_bar(experiments::steps(&options), "drives");
    let results = experiments::run(&options, || progress.inc(1))?;
    progress.finish_and_clear();
    let with_data = if results.recorded.is_empty() { "" } else { " --data LOGS" };
    let command = format!(
        "cargo run --release -p lineslam -- experiments --seeds {} --first-seed {}{with_data}",
        args.seeds, args.first_seed
    );
    let page = document::render(&results, &command, "images");
    let mut files: Vec<(PathBuf, Vec<u8>)> = vec![("experiments.md".into(), page.into_bytes())];
    files.extend(
        results
            .figures
            .iter()
            .map(|(name, text)| (Path::new("images").join(name), text.clone().into_bytes())),
    );
    output::write_all(&args.out, &files)?;
    println!("{}\n\n{}", document::buildings(&results), document::robustness(&results));
    println!("\n{}\n\n{}", document::honesty(&results), document::featureless(&results));
    if !results.recorded.is_empty() {
        println!("\n{}\n\n{}", document::recorded(&results.recorded), document::walls(&results.recorded));
    }
    println!("\nwritten to {}", args.out.join("experiments.md").display());
    Ok(())
}

fn run_scan(args: &ScanArgs) -> anyhow::Result<()> {
    let OneScan { info, baud_rate, ranges_mm } = serial::one_scan(&args.port, args.baud_rate, args.attempts)?;
    let (geometry, codes) = (ScanGeometry::from(&info), RangeCodes::from(&info));
    let beams = Beams::count(&ranges_mm, &codes);
    let seen = format!(
        "{} ranges, {} beams with nothing in range, {} not measured",
        beams.ranges, beams.no_echo, beams.bad
    );
    let title = format!("{} {}", info.product, info.serial);
    write_one(&args.out, scan::render(&title, &seen, &geometry, &codes, &ranges_mm))?;
    let degrees = |beam: usize| geometry.bearing(beam).to_degrees();
    let field = format!(
        "{} beams from {:.1}° to {:.1}°, {} to {} mm, {} rpm",
        info.beams(),
        degrees(0),
        degrees(info.beams() - 1),
        info.min_range_mm,
        info.max_range_mm,
        info.revolutions_per_minute
    );
    let mut table = Table::new();
    table.load_style(presets::NOTHING);
    let rows = [
        ("port", format!("{} at {baud_rate} bit/s", args.port)),
        ("model", info.model.to_string()),
        ("vendor", info.vendor.to_string()),
        ("product", info.product.to_string()),
        ("firmware", info.firmware.to_string()),
        ("protocol", info.protocol.to_string()),
        ("serial number", info.serial.to_string()),
        ("field of view", field),
        ("scan", seen),
        ("written to", args.out.display().to_string()),
    ];
    for (name, value) in rows {
        table.add_row([name.to_owned(), value]);
    }
    println!("{table}");
    Ok(())
}

/// Writes a single file, whole or not at all.
fn write_one(path: &Path, text: String) -> anyhow::Result<()> {
    let folder = path.parent().unwrap_or(Path::new(""));
    let name = path.file_name().context("--out is not a file name")?;
    Ok(output::write_all(folder, &[(name, text.into_bytes())])?)
}

fn run(log: &Log, robot: &Robot, configuration: Configuration) -> Result<Replay, ReplayError> {
    let progress = progress_bar(log.scans.len(), "scans");
    let result = replay::run(log, robot, configuration.config(), || progress.inc(1))?;
    progress.finish_and_clear();
    Ok(result)
}

/// The files that every run leaves behind.
fn results(
    result: &Replay,
    report: &Report,
    scene: &Scene<'_>,
) -> anyhow::Result<Vec<(&'static str, Vec<u8>)>> {
    let grid = grid::render(result).context("map.pgm")?;
    Ok(vec![
        ("trajectory.tum", tum::render(replay::trajectory(&result.steps)).into_bytes()),
        ("odometry.tum", tum::render(replay::dead_reckoning(&result.steps)).into_bytes()),
        ("map.csv", csv::render(&result.map).context("map.csv")?),
        ("map.svg", svg::render(&result.into(), scene).into_bytes()),
        ("map.pgm", grid.pgm),
        ("map.yaml", grid.yaml.into_bytes()),
        ("report.json", report.render().context("report.json")?),
    ])
}

/// A bar on a terminal, nothing in a pipe.
fn progress_bar(steps: usize, what: &'static str) -> ProgressBar {
    let style = ProgressStyle::with_template("{bar:40.cyan/dim} {pos}/{len} {msg}  {per_sec}  {eta} left")
        .expect("the template is a constant");
    let target = if std::io::stderr().is_terminal() {
        ProgressDrawTarget::stderr()
    } else {
        ProgressDrawTarget::hidden()
    };
    ProgressBar::with_draw_target(Some(steps as u64), target).with_style(style).with_message(what)
}

fn print_summary(source: &str, name: &str, out: &Path, report: &Report) {
    let mut table = Table::new();
    table.load_style(presets::NOTHING);
    let skipped = match report.records_skipped.values().sum::<usize>() {
        0 => "none".to_owned(),
        _ => report
            .records_skipped
            .iter()
            .map(|(reason, n)| format!("{n} {reason}"))
            .collect::<Vec<_>>()
            .join(", "),
    };
    let mut rows = vec![
        (source, format!("{name} ({})", report.format)),
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
    ];
    if let Some(simulation) = &report.simulation {
        rows.extend(simulation.rows());
    }
    rows.push(("written to", out.display().to_string()));
    for (what, value) in rows {
        table.add_row([what.to_owned(), value]);
    }
    if let Some(column) = table.column_mut(0) {
        column.set_cell_alignment(CellAlignment::Right);
    }
    println!("{table}");
}
