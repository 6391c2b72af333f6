//! Where the beams of a scan went: what maps of cells and points are drawn from.
//!
//! In: the ranges of the log and the motion of the replay. Out: the end of each beam in `base` at the middle beam, all
//! beams, those too that met nothing in range.

use nalgebra::{Isometry2, Point2};
use slam_core::frontend::deskew::{ScanPoint, deskew};
use slam_core::sensor::scan::{RangeCodes, Reading};
use slam_core::{Scan, ScanMotion};

use crate::log::Log;
use crate::replay::{MOST_BEAMS, Replay};

/// Beams that met nothing are followed no farther than this, metres.
pub const REACH_M: f32 = 15.0;

/// One beam that the sensor could judge.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Beam {
    /// Its number in the scan.
    pub index: u16,
    /// Where it ended, in `base`: at an obstacle, or where nothing was seen any more.
    pub end: Point2<f32>,
    /// Its length, metres.
    pub length_m: f32,
    /// Whether it ended at an obstacle.
    pub obstacle: bool,
}

/// What the beams of one scan saw.
#[derive(Clone, Debug)]
pub struct Seen {
    /// Where the sensor was at the middle beam, in `base`.
    pub sensor: Point2<f32>,
    /// Beams in their order, without those that could not be measured.
    pub beams: Vec<Beam>,
}

impl Seen {
    /// The ends of the beams that met something.
    pub fn obstacles(&self) -> impl Iterator<Item = Point2<f32>> {
        self.beams.iter().filter(|beam| beam.obstacle).map(|beam| beam.end)
    }

    /// The same scan laid by a pose of `base`.
    #[must_use]
    pub fn at(mut self, pose: &Isometry2<f32>) -> Self {
        self.sensor = pose * self.sensor;
        self.beams.iter_mut().for_each(|beam| beam.end = pose * beam.end);
        self
    }
}

/// Places the beams of a scan of a replayed log; none of a scan that the core refused.
pub fn seen(log: &Log, replay: &Replay, scan: usize) -> Seen {
    let sensor = replay.sensor_of(log, scan);
    let at = Point2::from(sensor.mounting.base_from_laser.translation.vector);
    let (Some(step), Some(logged)) = (replay.steps.get(scan), log.scans.get(scan)) else {
        return Seen { sensor: at, beams: Vec::new() };
    };
    if step.update.rejected.is_some() {
        return Seen { sensor: at, beams: Vec::new() };
    }
    let still = ScanMotion::instantaneous(step.motion.since_previous);
    let motion = if step.motion.is_finite() { &step.motion } else { &still };
    // The core places obstacles only. So a beam that met nothing is given the sensor's reach as its range.
    let codes = sensor.codes;
    let reach_mm = codes.max_mm.min((REACH_M * 1e3) as u16).max(codes.min_mm);
    let ranges_mm: Vec<u16> = logged
        .ranges_mm
        .iter()
        .map(|&value_mm| match codes.read(value_mm) {
            Reading::Range(_) => value_mm,
            Reading::NoEcho => reach_mm,
            // Beyond the greatest distance, where nothing is placed.
            Reading::Bad => u16::MAX,
        })
        .collect();
    let max_mm = codes.max_mm.min(u16::MAX - 1);
    let all = slam_core::sensor::scan::SensorConfig {
        codes: RangeCodes { max_mm, no_echo_mm: [(1, 0); 2], ..codes },
        ..sensor
    };
    let mut points = heapless::Vec::<ScanPoint, MOST_BEAMS>::new();
    deskew(&Scan { ranges_mm: &ranges_mm }, motion, &all, &replay.config.deskew, 0.0, &mut points);
    let beams = points.iter().map(|point| Beam {
        index: point.beam,
        end: point.position,
        length_m: point.range_m,
        obstacle: logged
            .ranges_mm
            .get(usize::from(point.beam))
            .is_some_and(|&value_mm| matches!(codes.read(value_mm), Reading::Range(_))),
    });
    Seen { sensor: at, beams: beams.collect() }
}

/// The same for every scan, laid by the poses of the final map.
pub fn all_in_final_map(log: &Log, replay: &Replay) -> impl Iterator<Item = Seen> {
    replay.steps.iter().enumerate().map(|(k, step)| seen(log, replay, k).at(&step.pose_in_final_map))
}
