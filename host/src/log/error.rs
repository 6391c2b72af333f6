//! What can be wrong with a log, and what the user should know of one that was read.

use std::fmt;
use std::path::{Path, PathBuf};

/// Something about a log that looks wrong, though it could be used.
#[derive(Clone, Debug, PartialEq, Eq, serde::Serialize)]
pub struct Warning {
    /// What is suspected, in a word for programs.
    pub suspected: &'static str,
    /// The same for people: from what number, and what to pass to mend it.
    pub message: String,
}

impl Warning {
    /// A warning.
    pub fn new(suspected: &'static str, message: impl Into<String>) -> Self {
        Self { suspected, message: message.into() }
    }
}

/// What is wrong with a record.
#[derive(Clone, Debug, PartialEq)]
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
    /// A scan with a number of beams that does not fit the scanner.
    BeamCount {
        /// Beams of the scanner, or of most scans.
        expected: usize,
        /// Beams of the scan.
        actual: usize,
    },
    /// A stamp of a scan that is not later than the one before.
    TimeNotIncreasing {
        /// Stamp of the scan before, microseconds.
        before_us: i64,
        /// Stamp of this one, microseconds.
        stamp_us: i64,
        /// Scans from here on that are not later than the one before.
        scans: usize,
    },
    /// A record or message that is not what it says it is.
    Malformed(String),
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
            Self::Malformed(_) => "malformed",
        }
    }
}

impl fmt::Display for Defect {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let seconds = |us: &i64| *us as f64 * 1e-6;
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
            Self::TimeNotIncreasing { before_us, stamp_us, scans } => write!(
                f,
                "time runs backwards: {:.6} s comes after {:.6} s; with this one, {scans} scans are not later than that",
                seconds(stamp_us),
                seconds(before_us)
            ),
            Self::Malformed(what) => f.write_str(what),
        }
    }
}

/// Where in a file something is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Place {
    /// A line, from 1.
    Line(usize),
    /// A message, from 1.
    Message(usize),
    /// A byte.
    Byte(u64),
}

impl fmt::Display for Place {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Line(line) => write!(f, "line {line}"),
            Self::Message(message) => write!(f, "message {message}"),
            Self::Byte(byte) => write!(f, "byte {byte}"),
        }
    }
}

/// Why a log could not be used.
#[derive(Debug, thiserror::Error)]
pub enum LogError {
    /// The file could not be opened.
    #[error("{}", path.display())]
    Open {
        /// The log.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The file could not be read on, or its compression is broken.
    #[error("{}: {place}: the file cannot be read beyond this; --lenient uses what comes before", path.display())]
    Read {
        /// The log.
        path: PathBuf,
        /// Where.
        place: Place,
        /// What the system said.
        source: std::io::Error,
    },
    /// Not a log of any kind that can be read, or not of the kind that its name or an option says.
    #[error("{}: {what}", path.display())]
    NotALog {
        /// The log.
        path: PathBuf,
        /// What was expected, and what this looks like.
        what: String,
    },
    /// A record that cannot be used.
    #[error("{}: {place}: {defect}; --lenient skips and counts such records", path.display())]
    Record {
        /// The log.
        path: PathBuf,
        /// Where.
        place: Place,
        /// What is wrong.
        defect: Defect,
    },
    /// The container is damaged.
    #[error("{}: {place}: {what}", path.display())]
    Damaged {
        /// The log.
        path: PathBuf,
        /// Where.
        place: Place,
        /// What is wrong.
        what: String,
    },
    /// Scans or odometry cannot be told among the topics.
    #[error("{}: {what}\n{topics}", path.display())]
    Topics {
        /// The log.
        path: PathBuf,
        /// What is missing or ambiguous, and the option that settles it.
        what: String,
        /// The topics that there are, with type and count, a line each.
        topics: String,
    },
    /// Numbers that no robot has: most likely in another unit.
    #[error("{}: {}", path.display(), warning.message)]
    Suspect {
        /// The log.
        path: PathBuf,
        /// What is suspected, from what number, and what to pass.
        warning: Warning,
    },
    /// Most of it could not be used.
    #[error("{}: only {used} of {all} scans could be used ({reasons})", path.display())]
    MostlyUnusable {
        /// The log.
        path: PathBuf,
        /// Scans that could be used.
        used: usize,
        /// Scans in the file.
        all: usize,
        /// What was skipped, and why.
        reasons: String,
    },
    /// Nothing to replay.
    #[error("{}: the log ends without a single scan ({read})", path.display())]
    NoScan {
        /// The log.
        path: PathBuf,
        /// What was read.
        read: String,
    },
}

impl LogError {
    /// A file that could not be opened.
    pub fn open(path: &Path) -> impl FnOnce(std::io::Error) -> Self {
        let path = path.to_owned();
        move |source| Self::Open { path, source }
    }
}
