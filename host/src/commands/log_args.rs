//! What every command that reads a log takes.

use std::path::{Path, PathBuf};

use indicatif::{ProgressBar, ProgressStyle};
use lineslam::log::{self, Format, Log, RangeUnit, ReadOptions, Scanner, StampUnit, Warning};
use lineslam::robot::Robot;

use super::common::terminal;

#[derive(clap::Args)]
pub struct LogArgs {
    /// The log: a ROS bag (.bag, .mcap, .db3 or its folder), a CARMEN or mines log or JSON lines, these plain or gzipped.
    pub log: PathBuf,
    #[command(flatten)]
    reading: ReadArgs,
}

/// How it is read.
#[derive(clap::Args)]
pub struct ReadArgs {
    /// Format of the log.
    #[arg(long, value_enum, default_value_t = Format::Auto)]
    format: Format,
    /// Skip and count records that cannot be read, instead of stopping at the first.
    #[arg(long)]
    lenient: bool,
    /// Topic of a bag's scans; needed where there are several.
    #[arg(long, value_name = "TOPIC")]
    scan_topic: Option<String>,
    /// Topic of a bag's odometry (Odometry, transforms or joint states); needed where there are several.
    #[arg(long, value_name = "TOPIC")]
    odom_topic: Option<String>,
    /// Scanner of a CARMEN log that has several.
    #[arg(long, value_enum)]
    scanner: Option<Scanner>,
    /// Unit of the time stamps of a text log, where it is not that of the format.
    #[arg(long, value_enum)]
    stamps: Option<StampUnit>,
    /// Unit of the ranges, where it is not that of the format.
    #[arg(long, value_enum)]
    ranges: Option<RangeUnit>,
}

impl LogArgs {
    /// Reads the log. `wheels` prefers how far wheels turned to poses, where a bag has both.
    pub fn read(&self, robot: Option<&Robot>, wheels: bool) -> Result<Log, log::LogError> {
        self.reading.read(&self.log, robot, wheels)
    }
}

impl ReadArgs {
    /// The same of a log that is named elsewhere.
    pub fn read(&self, path: &Path, robot: Option<&Robot>, wheels: bool) -> Result<Log, log::LogError> {
        let style = ProgressStyle::with_template(
            "{bar:40.cyan/dim} {bytes}/{total_bytes} read  {bytes_per_sec}  {eta} left",
        )
        .expect("the template is a constant");
        let bar = ProgressBar::with_draw_target(None, terminal()).with_style(style);
        let progress = |done, all| {
            bar.set_length(all);
            bar.set_position(done);
        };
        let options = ReadOptions {
            format: self.format,
            beams: robot.and_then(Robot::beams),
            lenient: self.lenient,
            stamps: self.stamps,
            ranges: self.ranges,
            scanner: self.scanner,
            scan_topic: self.scan_topic.as_deref(),
            odom_topic: self.odom_topic.as_deref(),
            wheels,
            progress: &progress,
        };
        let log = log::read(path, &options)?;
        bar.finish_and_clear();
        Ok(log)
    }
}

/// Says on stderr what looks wrong.
pub fn warn(warnings: &[Warning]) {
    for warning in warnings {
        eprintln!("warning: {}", warning.message);
    }
}
