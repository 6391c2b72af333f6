//! Recorded logs: what people have of their robots, read whole and checked before anything is computed from it.
//!
//! ```text
//!  file ──► reader of its format ──► [Records] ──► assemble ──► [Log]
//! ```
//!
//! A reader turns records into numbers and keeps their order; `assemble` is the same for all formats and settles stamps, order,
//! units and numbers of beams. What a good log may have is counted in [`Log::skipped`] or said in [`Log::warnings`]; a record
//! that cannot be read is an error that names file and line, and lenient reading skips and counts it.

mod assemble;
mod carmen;
pub mod doubts;

mod error;
mod mines;
mod plain;

pub mod records;
mod robot;
pub mod ros;
mod text;

use std::collections::BTreeMap;
use std::io::Read;
use std::path::Path;

pub use error::{Defect, LogError, Place, Warning};

pub use plain::render as plain_text;
pub(crate) use plain::{header as plain_header, line as plain_line};
pub use records::Records;
pub use robot::Course;

use crate::robot::{Robot, ScanLayout, StatedGeometry, Wheels};

/// Formats that can be read.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum Format {
    /// Found out from the file.
    Auto,
    /// 707 numbers a line: time in µs, wheel ticks, 682 ranges (the CoreSLAM and BreezySLAM test data).
    Mines,
    /// CARMEN: FLASER, RLASER, ROBOTLASER, RAWLASER, ODOM and PARAM records.
    Carmen,
    /// JSON lines, as docs/logs.md describes them.
    Plain,
    /// A ROS 1 bag.
    Ros1,
    /// A ROS 2 bag in MCAP.
    Mcap,
    /// A ROS 2 bag in SQLite: the .db3, or the folder with its metadata.yaml.
    Db3,
}

impl Format {
    /// Its name in reports.
    pub fn name(self) -> &'static str {
        match self {
            Self::Auto => "auto",
            Self::Mines => "mines",
            Self::Carmen => "carmen",
            Self::Plain => "plain",
            Self::Ros1 => "ros1",
            Self::Mcap => "mcap",
            Self::Db3 => "db3",
        }
    }

    /// Where in such a file the record is that a reader numbered.
    fn place(self, place: usize) -> Place {
        match self {
            Self::Ros1 | Self::Mcap | Self::Db3 => Place::Message(place),
            _ => Place::Line(place),
        }
    }
}

/// Units that time stamps of a text log may have.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum StampUnit {
    /// Seconds.
    S,
    /// Milliseconds.
    Ms,
    /// Microseconds.
    Us,
    /// Nanoseconds.
    Ns,
}

impl StampUnit {
    /// Microseconds in one of them.
    pub fn us(self) -> f64 {
        match self {
            Self::S => 1e6,
            Self::Ms => 1e3,
            Self::Us => 1.0,
            Self::Ns => 1e-3,
        }
    }
}

/// Units that ranges of a log may have.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum RangeUnit {
    /// Metres.
    M,
    /// Centimetres.
    Cm,
    /// Millimetres.
    Mm,
}

impl RangeUnit {
    /// Millimetres in one of them.
    pub fn mm(self) -> f64 {
        match self {
            Self::M => 1e3,
            Self::Cm => 10.0,
            Self::Mm => 1.0,
        }
    }
}

/// Scanners of a CARMEN log, by their records.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, clap::ValueEnum)]
#[value(rename_all = "UPPER")]
pub enum Scanner {
    /// The front one, with the robot's pose.
    Robotlaser1,
    /// The front one, in the old format.
    Flaser,
    /// The front one, without pose.
    Rawlaser1,
    /// The rear one, with the robot's pose.
    Robotlaser2,
    /// The rear one, in the old format.
    Rlaser,
    /// The rear one, without pose.
    Rawlaser2,
    /// A third one, without pose.
    Rawlaser3,
    /// A fourth one, without pose.
    Rawlaser4,
}

/// Odometry as a log reports it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Odometry {
    /// Counters of the left and right wheel.
    Ticks([i64; 2]),
    /// How far the left and the right wheel have turned, radians.
    Angles([f64; 2]),
    /// Pose (x, y, θ) in the log's own odometry frame, metres and radians.
    Pose([f64; 3]),
}

/// One scan of a log.
#[derive(Clone, Debug, PartialEq)]
pub struct LoggedScan {
    /// Line or message of the file, from 1.
    pub line: usize,
    /// Instant of the middle beam as the log states it, microseconds.
    pub stamp_us: u64,
    /// Ranges, millimetres, saturated; first beam first.
    pub ranges_mm: Vec<u16>,
    /// Index in [`Log::geometries`], where the log states how the beams lie.
    pub geometry: Option<usize>,
}

/// A log, read and checked.
#[derive(Clone, Debug, Default)]
pub struct Log {
    /// Scans with increasing stamps.
    pub scans: Vec<LoggedScan>,
    /// Odometry with increasing stamps.
    pub odometry: Vec<(u64, Odometry)>,
    /// How beams lie, where the log states it.
    pub geometries: Vec<StatedGeometry>,
    /// Number of ranges that most scans have.
    pub commonest_beams: usize,
    /// The wheels, where the log states them.
    pub wheels: Option<Wheels>,
    /// Records passed over, by reason.
    pub skipped: BTreeMap<&'static str, usize>,
    /// What the user should know.
    pub warnings: Vec<Warning>,
    /// Format it was read as.
    pub format: &'static str,
    /// What was done to the robot that recorded it, where it said so: with it a replay computes the bits that the robot computed.
    pub course: Option<Course>,
}

impl Log {
    /// The robot that logs of this format were usually recorded with, and what this log states of its wheels.
    pub fn usual_robot(&self) -> Robot {
        let robot = Robot::usual_for(self.format);
        Robot { wheels: self.wheels.or(robot.wheels), ..robot }
    }

    /// How the beams of a scan lie, as far as the log tells.
    pub fn layout(&self, scan: usize) -> ScanLayout<'_> {
        let scan = self.scans.get(scan);
        ScanLayout {
            beams: scan.map_or(0, |s| s.ranges_mm.len()),
            commonest: self.commonest_beams,
            stated: scan.and_then(|s| self.geometries.get(s.geometry?)),
        }
    }
}

/// How logs are read.
#[derive(Clone, Copy)]
pub struct ReadOptions<'a> {
    /// Format of the log.
    pub format: Format,
    /// Number of ranges each scan must have, where a robot file says so.
    pub beams: Option<usize>,
    /// Skip and count records that cannot be used.
    pub lenient: bool,
    /// Unit of the time stamps, where the format's own is wrong.
    pub stamps: Option<StampUnit>,
    /// Unit of the ranges, where the format's own is wrong.
    pub ranges: Option<RangeUnit>,
    /// The scanner of a CARMEN log.
    pub scanner: Option<Scanner>,
    /// The topic of a bag's scans.
    pub scan_topic: Option<&'a str>,
    /// The topic of a bag's odometry, transforms or joint states.
    pub odom_topic: Option<&'a str>,
    /// Prefer how far wheels turned to poses, where a bag has both.
    pub wheels: bool,
    /// Told how many bytes of how many have been read.
    pub progress: &'a (dyn Fn(u64, u64) + Sync),
}

impl Default for ReadOptions<'_> {
    fn default() -> Self {
        Self {
            format: Format::Auto,
            beams: None,
            lenient: false,
            stamps: None,
            ranges: None,
            scanner: None,
            scan_topic: None,
            odom_topic: None,
            wheels: false,
            progress: &|_, _| {},
        }
    }
}

/// Reads a log of any format, plain or, if it is a text, gzipped.
pub fn read(path: &Path, options: &ReadOptions<'_>) -> Result<Log, LogError> {
    let format = match options.format {
        Format::Auto => of_container(path)?.unwrap_or(Format::Auto),
        format => format,
    };
    let (format, records) = match format {
        Format::Ros1 | Format::Mcap | Format::Db3 => (format, ros::read(path, format, options)?),
        format => text::read(path, format, options)?,
    };
    assemble::log(path, format, records, options)
}

/// The format of a file that is not a text, by how it begins.
fn of_container(path: &Path) -> Result<Option<Format>, LogError> {
    if path.is_dir() {
        if path.join("metadata.yaml").exists() {
            return Ok(Some(Format::Db3));
        }
        let source = std::io::ErrorKind::IsADirectory.into();
        return Err(LogError::Open { path: path.to_owned(), source });
    }
    let mut head = Vec::new();
    let file = std::fs::File::open(path).map_err(LogError::open(path))?;
    file.take(16).read_to_end(&mut head).map_err(LogError::open(path))?;
    let begins = |magic: &[u8]| head.starts_with(magic);
    Ok(match () {
        () if begins(b"#ROSBAG V") => Some(Format::Ros1),
        () if begins(b"\x89MCAP0\r\n") => Some(Format::Mcap),
        () if begins(b"SQLite format 3\0") => Some(Format::Db3),
        () => None,
    })
}

/// The number a word is, if it is one and finite.
fn number(field: &'static str, word: &str) -> Result<f64, Defect> {
    let defect = || Defect::NotANumber { field, word: word.chars().take(20).collect() };
    word.parse::<f64>().ok().filter(|v| v.is_finite()).ok_or_else(defect)
}

/// The whole number a word is.
fn integer<T: std::str::FromStr>(field: &'static str, word: &str) -> Result<T, Defect> {
    word.parse().map_err(|_| Defect::NotANumber { field, word: word.chars().take(20).collect() })
}

/// The whole number a word is, though it may be written with a point.
fn whole(field: &'static str, word: &str) -> Result<i64, Defect> {
    integer(field, word).or_else(|defect| match word.parse::<f64>() {
        Ok(value) if value.fract() == 0.0 && value.abs() < 1e15 => Ok(value as i64),
        _ => Err(defect),
    })
}
