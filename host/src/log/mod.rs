//! Recorded logs: what the robot's host wrote down, line by line.
//!
//! A log is read whole and checked before anything is computed from it. A record that cannot be read is an error that
//! names file and line; lenient reading skips and counts it.

mod carmen;
mod mines;

use std::collections::BTreeMap;
use std::fmt;
use std::io::{BufRead, BufReader, Read};
use std::path::{Path, PathBuf};

use crate::robot::StatedGeometry;

/// Formats that can be read.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum Format {
    /// Found out from the first record.
    Auto,
    /// 707 numbers a line: time in µs, wheel ticks, 682 ranges (the CoreSLAM and BreezySLAM test data).
    Mines,
    /// CARMEN: FLASER, ROBOTLASER1 and ODOM records.
    Carmen,
}

/// What is wrong with a record.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Defect {
    /// Fewer words than the record must have.
    Truncated {
        /// Words the record must have.
        expected: usize,
        /// Words it has.
        actual: usize,
    },
    /// More words than the record can have.
    TooLong {
        /// Words the record may have.
        expected: usize,
        /// Words it has.
        actual: usize,
    },
    /// A word that is not the number it should be.
    NotANumber {
        /// What the number means.
        field: &'static str,
        /// The word.
        word: String,
    },
    /// A scan with another number of beams than the robot file or the scans before.
    BeamCount {
        /// Beams of the sensor.
        expected: usize,
        /// Beams of the scan.
        actual: usize,
    },
    /// A stamp that is not later than the one before.
    TimeNotIncreasing {
        /// Stamp of the record before, seconds.
        before: String,
        /// Stamp of this one, seconds.
        stamp: String,
    },
    /// Bytes that are not text.
    NotText,
}

impl Defect {
    /// The kind of defect, as reports count it.
    pub fn reason(&self) -> &'static str {
        match self {
            Self::Truncated { .. } => "truncated",
            Self::TooLong { .. } => "too_long",
            Self::NotANumber { .. } => "not_a_number",
            Self::BeamCount { .. } => "wrong_beam_count",
            Self::TimeNotIncreasing { .. } => "time_not_increasing",
            Self::NotText => "not_text",
        }
    }
}

impl fmt::Display for Defect {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Truncated { expected, actual } => {
                write!(f, "the record is truncated: {actual} words of {expected}")
            }
            Self::TooLong { expected, actual } => {
                write!(f, "the record has {actual} words instead of {expected}")
            }
            Self::NotANumber { field, word } => write!(f, "{field}: '{word}' is not a number it can be"),
            Self::BeamCount { expected, actual } => {
                write!(f, "the scan has {actual} beams instead of {expected}")
            }
            Self::TimeNotIncreasing { before, stamp } => {
                write!(f, "time runs backwards: {stamp} s comes after {before} s")
            }
            Self::NotText => write!(f, "the line is not text"),
        }
    }
}

/// Why a log could not be used.
#[derive(Debug, thiserror::Error)]
pub enum LogError {
    /// The file could not be read, or its compression is broken.
    #[error("{}: line {line}", path.display())]
    Read {
        /// The log.
        path: PathBuf,
        /// Line reached, from 1.
        line: usize,
        /// What the system said.
        source: std::io::Error,
    },
    /// The name says gzip, the bytes do not.
    #[error("{}: line 1: the name ends in .gz, but this is not gzip data", path.display())]
    NotGzip {
        /// The log.
        path: PathBuf,
    },
    /// Neither format fits the first record.
    #[error("{}: line {line}: neither a mines nor a CARMEN record: '{start}'", path.display())]
    UnknownFormat {
        /// The log.
        path: PathBuf,
        /// Line, from 1.
        line: usize,
        /// How the line begins.
        start: String,
    },
    /// A record that cannot be used.
    #[error("{}: line {line}: {defect}", path.display())]
    Record {
        /// The log.
        path: PathBuf,
        /// Line, from 1.
        line: usize,
        /// What is wrong.
        defect: Defect,
    },
    /// Nothing to replay.
    #[error("{}: line {lines}: the log ends without a single scan", path.display())]
    NoScan {
        /// The log.
        path: PathBuf,
        /// Lines read.
        lines: usize,
    },
}

/// Odometry as a log reports it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Odometry {
    /// Counters of the left and right wheel.
    Ticks([i64; 2]),
    /// Pose (x, y, θ) in the log's own odometry frame, metres and radians.
    Pose([f64; 3]),
}

/// One scan of a log.
#[derive(Clone, Debug, PartialEq)]
pub struct LoggedScan {
    /// Line, from 1.
    pub line: usize,
    /// Stamp, microseconds.
    pub stamp_us: u64,
    /// Ranges, millimetres, saturated; first beam first.
    pub ranges_mm: Vec<u16>,
}

/// A log, read and checked.
#[derive(Clone, Debug, Default)]
pub struct Log {
    /// Scans with increasing stamps.
    pub scans: Vec<LoggedScan>,
    /// Odometry with increasing stamps.
    pub odometry: Vec<(u64, Odometry)>,
    /// Beams and mounting, where the log states them.
    pub stated: Option<StatedGeometry>,
    /// Records skipped by lenient reading, by reason.
    pub skipped: BTreeMap<&'static str, usize>,
    /// Format it was read as.
    pub format: &'static str,
}

/// What one line gives.
#[derive(Default)]
struct Record {
    odometry: Option<Odometry>,
    stamp_us: u64,
    ranges_mm: Option<Vec<u16>>,
    stated: Option<StatedGeometry>,
}

/// How logs are read.
#[derive(Clone, Copy, Debug)]
pub struct ReadOptions {
    /// Format of the log.
    pub format: Format,
    /// Number of beams each scan must have, where the robot file says so.
    pub beams: Option<usize>,
    /// Skip and count records that cannot be used.
    pub lenient: bool,
}

/// Reads a log, plain or gzipped.
pub fn read(path: &Path, options: &ReadOptions) -> Result<Log, LogError> {
    Reader { path, options, log: Log::default(), beams: options.beams, line: 0 }.read()
}

struct Reader<'a> {
    path: &'a Path,
    options: &'a ReadOptions,
    log: Log,
    beams: Option<usize>,
    line: usize,
}

impl Reader<'_> {
    fn read(mut self) -> Result<Log, LogError> {
        let mut input = self.open()?;
        let mut format = None;
        let mut bytes = Vec::new();
        loop {
            bytes.clear();
            self.line += 1;
            match input.read_until(b'\n', &mut bytes) {
                Ok(0) => break,
                Ok(_) => {}
                // A log that was cut off, as when the robot lost power, is good up to there.
                Err(_) if self.options.lenient && !self.log.scans.is_empty() => {
                    *self.log.skipped.entry("cut_off").or_default() += 1;
                    break;
                }
                Err(source) => return Err(self.read_error(source)),
            }
            let Ok(text) = std::str::from_utf8(&bytes) else {
                self.refuse(Defect::NotText)?;
                continue;
            };
            let text = text.trim();
            if text.is_empty() || text.starts_with('#') {
                continue;
            }
            let format = match format {
                Some(format) => format,
                None => *format.insert(self.detect(text)?),
            };
            let record = match format {
                Format::Carmen => carmen::record(text),
                _ => mines::record(text),
            };
            match record.and_then(|record| record.map_or(Ok(()), |r| self.take(r))) {
                Ok(()) => {}
                Err(defect) => self.refuse(defect)?,
            }
        }
        if self.log.scans.is_empty() {
            return Err(LogError::NoScan { path: self.path.to_owned(), lines: self.line - 1 });
        }
        self.log.format = if format == Some(Format::Carmen) { "carmen" } else { "mines" };
        // Odometry comes from records of several kinds, each in order, but not among each other.
        self.log.odometry.sort_by_key(|(stamp, _)| *stamp);
        self.log.odometry.dedup_by_key(|(stamp, _)| *stamp);
        Ok(self.log)
    }

    fn open(&self) -> Result<Box<dyn BufRead>, LogError> {
        let file = std::fs::File::open(self.path).map_err(|source| self.read_error(source))?;
        let mut file = BufReader::new(file);
        let head = file.fill_buf().map_err(|source| self.read_error(source))?;
        if head.starts_with(&[0x1f, 0x8b]) {
            return Ok(Box::new(BufReader::new(flate2::bufread::MultiGzDecoder::new(file))));
        }
        let named_gzip = self.path.extension().is_some_and(|e| e.eq_ignore_ascii_case("gz"));
        if named_gzip && !head.is_empty() {
            return Err(LogError::NotGzip { path: self.path.to_owned() });
        }
        Ok(Box::new(file.take(u64::MAX)))
    }

    fn detect(&self, text: &str) -> Result<Format, LogError> {
        match self.options.format {
            Format::Auto if mines::looks_like(text) => Ok(Format::Mines),
            Format::Auto if carmen::looks_like(text) => Ok(Format::Carmen),
            Format::Mines if mines::looks_like(text) => Ok(Format::Mines),
            Format::Carmen if carmen::looks_like(text) => Ok(Format::Carmen),
            _ => Err(LogError::UnknownFormat {
                path: self.path.to_owned(),
                line: self.line,
                start: text.chars().take(40).collect(),
            }),
        }
    }

    fn take(&mut self, record: Record) -> Result<(), Defect> {
        if let Some(ranges_mm) = record.ranges_mm {
            let expected = *self.beams.get_or_insert(ranges_mm.len());
            if ranges_mm.len() != expected {
                return Err(Defect::BeamCount { expected, actual: ranges_mm.len() });
            }
            if let Some(before) = self.log.scans.last().map(|s| s.stamp_us)
                && record.stamp_us <= before
            {
                return Err(backwards(before, record.stamp_us));
            }
            self.log.stated = self.log.stated.or(record.stated);
            self.log.scans.push(LoggedScan { line: self.line, stamp_us: record.stamp_us, ranges_mm });
        }
        if let Some(odometry) = record.odometry {
            self.log.odometry.push((record.stamp_us, odometry));
        }
        Ok(())
    }

    fn refuse(&mut self, defect: Defect) -> Result<(), LogError> {
        if !self.options.lenient {
            return Err(LogError::Record { path: self.path.to_owned(), line: self.line, defect });
        }
        *self.log.skipped.entry(defect.reason()).or_default() += 1;
        Ok(())
    }

    fn read_error(&self, source: std::io::Error) -> LogError {
        LogError::Read { path: self.path.to_owned(), line: self.line.max(1), source }
    }
}

fn backwards(before_us: u64, stamp_us: u64) -> Defect {
    let seconds = |us: u64| format!("{}.{:06}", us / 1_000_000, us % 1_000_000);
    Defect::TimeNotIncreasing { before: seconds(before_us), stamp: seconds(stamp_us) }
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
