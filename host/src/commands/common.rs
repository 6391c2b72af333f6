//! What several commands share.

use std::io::IsTerminal;
use std::path::{Path, PathBuf};

use anyhow::Context;
use comfy_table::{CellAlignment, Table, presets};
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
pub use lineslam::configuration::Configuration;
use lineslam::log::Log;
use lineslam::output::grid::Grid;
use lineslam::output::report::Report;
use lineslam::output::svg::{Picture, Scene};
use lineslam::output::{self, csv, dxf, mcap, svg, trajectory_csv, tum};
use lineslam::replay::{self, Replay, ReplayError, Start};
use lineslam::robot::Robot;

/// Writes a single file, whole or not at all.
pub fn write_one(path: &Path, text: String) -> anyhow::Result<()> {
    let folder = path.parent().unwrap_or(Path::new(""));
    let name = path.file_name().context("--out is not a file name")?;
    Ok(output::write_all(folder, &[(name, text.into_bytes())])?)
}

pub fn run(
    start: &Start,
    log: &Log,
    robot: &Robot,
    configuration: Configuration,
) -> Result<Replay, ReplayError> {
    let progress = progress_bar(log.scans.len(), "scans");
    let result = replay::run_from(start, log, robot, configuration.config(), || progress.inc(1))?;
    progress.finish_and_clear();
    Ok(result)
}

/// The files that every run leaves behind, and the recording for ROS where one is asked for.
pub fn results(
    log: &Log,
    result: &Replay,
    report: &Report,
    scene: &Scene<'_>,
    recording: Option<&Path>,
) -> anyhow::Result<Vec<(PathBuf, Vec<u8>)>> {
    let grid = Grid::of(log, result);
    let path = result.steps.iter().map(|step| &step.pose_in_final_map);
    let mut files: Vec<(PathBuf, Vec<u8>)> = [
        ("trajectory.tum", tum::render(replay::trajectory(&result.steps)).into_bytes()),
        ("trajectory_final.tum", tum::render(replay::final_trajectory(&result.steps)).into_bytes()),
        ("trajectory.csv", trajectory_csv::render(&result.steps).context("trajectory.csv")?),
        ("odometry.tum", tum::render(replay::dead_reckoning(&result.steps)).into_bytes()),
        ("map.csv", csv::render(&result.map).context("map.csv")?),
        ("map.json", result.map_file.render().context("map.json")?),
        ("map.svg", svg::render(&Picture::of(log, result), scene).into_bytes()),
        ("map.dxf", dxf::render(&result.map, path).context("map.dxf")?),
        ("map.pgm", grid.pgm().context("map.pgm")?),
        ("map.yaml", grid.yaml().into_bytes()),
        ("report.json", report.render().context("report.json")?),
    ]
    .map(|(name, bytes)| (name.into(), bytes))
    .into();
    if let Some(path) = recording {
        let named = || path.display().to_string();
        let bytes = mcap::render(log, result, &grid).with_context(named)?;
        // Relative to where the command was called, not to the folder of the other files.
        files.push((std::path::absolute(path).with_context(named)?, bytes));
    }
    Ok(files)
}

/// A bar on a terminal, nothing in a pipe.
pub fn progress_bar(steps: usize, what: &'static str) -> ProgressBar {
    let style = ProgressStyle::with_template("{bar:40.cyan/dim} {pos}/{len} {msg}  {per_sec}  {eta} left")
        .expect("the template is a constant");
    ProgressBar::with_draw_target(Some(steps as u64), terminal()).with_style(style).with_message(what)
}

/// Where progress is shown: on a terminal.
pub fn terminal() -> ProgressDrawTarget {
    if std::io::stderr().is_terminal() { ProgressDrawTarget::stderr() } else { ProgressDrawTarget::hidden() }
}

pub fn print_summary(source: &str, name: &str, out: &Path, report: &Report) {
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
        ("tracking", report.tracking.line()),
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
    if let Some(agreement) = &report.as_the_robot {
        let words = format!(
            "{} poses bit for bit, {} others; {} that cannot be compared",
            agreement.same, agreement.different, agreement.unknown
        );
        rows.push(("as the robot had them", words));
    }
    if let Some(odometry) = report.odometry.as_ref().filter(|odometry| odometry.delay_used) {
        let beyond = "beyond scan_delay_s of the robot file; used";
        rows.push((
            "scans stamped late by",
            format!("{:.3} s, sigma {:.3} s, {beyond}", odometry.delay_s, odometry.delay_sigma_s),
        ));
    }
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
