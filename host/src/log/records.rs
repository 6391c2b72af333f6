//! What a reader finds in a log, in the order of the file. Nothing is judged yet: `assemble` makes a [`Log`](super::Log) of it.

use std::collections::BTreeMap;

use super::robot::Course;
use super::{Odometry, Warning};
use crate::robot::{StatedGeometry, Wheels};

/// A beam that met nothing in range, whatever the sensor's codes: beyond every greatest distance.
pub const NO_ECHO_MM: u16 = u16::MAX;
/// A beam that could not be measured, whatever the sensor's codes: below every least distance, and no code for "nothing in
/// range" of any scanner we know.
pub const BAD_MM: u16 = 1;

/// Where odometry comes from. Each source has a clock and a frame of its own.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Source {
    /// The record of a scan brings it. At equal stamps it is believed before the others.
    Scan,
    /// Records of their own.
    Own,
}

/// One scan, as it stands in the file.
#[derive(Clone, Debug)]
pub struct ScanRecord {
    /// Line or message of the file, from 1.
    pub place: usize,
    /// Instant of the middle beam as the log states it, microseconds.
    pub stamp_us: i64,
    /// Ranges, millimetres or codes, first beam first.
    pub ranges_mm: Vec<u16>,
    /// Index in [`Records::geometries`], where the log states how the beams lie.
    pub geometry: Option<usize>,
}

/// One reading of the odometry, as it stands in the file.
#[derive(Clone, Copy, Debug)]
pub struct OdometryRecord {
    /// Line or message of the file, from 1.
    pub place: usize,
    /// Stamp, microseconds.
    pub stamp_us: i64,
    /// Where it comes from.
    pub source: Source,
    /// What it says.
    pub odometry: Odometry,
}

/// Everything that a reader found.
#[derive(Clone, Debug, Default)]
pub struct Records {
    /// The scans.
    pub scans: Vec<ScanRecord>,
    /// The odometry.
    pub odometry: Vec<OdometryRecord>,
    /// How beams lie, as the log states it.
    pub geometries: Vec<StatedGeometry>,
    /// The wheels, as the log states them.
    pub wheels: Option<Wheels>,
    /// A sample of the distances as they stand in the file, before the unit was applied.
    pub distances: Sample,
    /// Records passed over, by reason.
    pub skipped: BTreeMap<&'static str, usize>,
    /// What the user should know.
    pub warnings: Vec<Warning>,
    /// What was done to the robot that recorded it, where it said so.
    pub course: Option<Course>,
}

impl Records {
    /// Counts a record that was passed over.
    pub fn skip(&mut self, reason: &'static str) {
        *self.skipped.entry(reason).or_default() += 1;
    }

    /// The index of a geometry; one that the last scan had is not kept twice.
    pub fn geometry(&mut self, stated: StatedGeometry) -> usize {
        if self.geometries.last() != Some(&stated) {
            self.geometries.push(stated);
        }
        self.geometries.len() - 1
    }

    /// Appends a reading of the odometry.
    pub fn odometry(&mut self, place: usize, stamp_us: i64, source: Source, odometry: Odometry) {
        self.odometry.push(OdometryRecord { place, stamp_us, source, odometry });
    }

    /// A distance to millimetres. `mm_per_unit` is 1000 for metres. As REP 117 has it, +∞ is "nothing in range", −∞ and NaN are not
    /// measured, and no scanner measures below zero.
    pub fn range_mm(&mut self, value: f64, mm_per_unit: f64) -> u16 {
        self.distances.add(value);
        let mm = (value * mm_per_unit).round();
        if mm >= f64::from(NO_ECHO_MM) {
            NO_ECHO_MM
        } else if mm > 0.0 {
            mm as u16
        } else if mm == 0.0 {
            0
        } else {
            BAD_MM
        }
    }
}

/// Some of many numbers, evenly taken, of which the median is wanted.
#[derive(Clone, Debug, Default)]
pub struct Sample {
    seen: usize,
    taken: Vec<f64>,
}

impl Sample {
    const EVERY: usize = 37;
    const MOST: usize = 100_000;

    fn add(&mut self, value: f64) {
        self.seen += 1;
        if value > 0.0
            && value.is_finite()
            && self.seen.is_multiple_of(Self::EVERY)
            && self.taken.len() < Self::MOST
        {
            self.taken.push(value);
        }
    }

    /// The median; `None` of none.
    pub fn median(&self) -> Option<f64> {
        crate::score::Spread::of(self.taken.iter().copied()).map(|s| s.median)
    }
}
