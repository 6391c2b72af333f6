//! Scans as messages, and the frames that they are in.

use slam_core::sensor::scan::{Mounting, Reading, SensorConfig};

use super::file::{header, nanoseconds};
use super::messages::{LaserScan, Pose, TfMessage, TransformStamped};
use super::{BASE, exact};
use crate::log::Log;
use crate::replay::Replay;

pub(crate) const LASER: &str = "laser";
/// Mountings that differ less, in metres and radians, are the same.
const SAME_MOUNTING: f32 = 1e-4;

/// The scanner's frames: one for each way that it was mounted, the first called `laser`.
pub struct Frames {
    mountings: Vec<(Mounting, String)>,
}

impl Frames {
    pub fn of(log: &Log, replay: &Replay) -> Self {
        let mut frames = Self { mountings: Vec::new() };
        for k in 0..replay.steps.len() {
            let mounting = replay.sensor_of(log, k).mounting;
            if frames.name(&mounting).is_none() {
                let name = match frames.mountings.len() {
                    0 => LASER.to_owned(),
                    n => format!("{LASER}_{}", n + 1),
                };
                frames.mountings.push((mounting, name));
            }
        }
        frames
    }

    fn name(&self, mounting: &Mounting) -> Option<&str> {
        let same = |other: &Mounting| {
            let apart = other.base_from_laser.inverse() * mounting.base_from_laser;
            other.upside_down == mounting.upside_down
                && apart.translation.vector.norm() < SAME_MOUNTING
                && apart.rotation.angle().abs() < SAME_MOUNTING
        };
        self.mountings.iter().find(|(other, _)| same(other)).map(|(_, name)| name.as_str())
    }

    /// From `base_link` to each of them.
    pub fn message(&self, ns: u64) -> TfMessage<'_> {
        let transforms = self.mountings.iter().map(|(mounting, name)| base_from_laser(mounting, name, ns));
        TfMessage { transforms: transforms.collect() }
    }
}

/// From `base_link` to a scanner's frame.
pub(crate) fn base_from_laser<'a>(mounting: &Mounting, frame: &'a str, ns: u64) -> TransformStamped<'a> {
    let upright = Pose::of(&exact(&mounting.base_from_laser));
    let transform = if mounting.upside_down { upright.head_down() } else { upright };
    TransformStamped { header: header(ns, BASE), child_frame_id: frame, transform }
}

/// Instant of a scan's first beam. A log that begins at zero has no earlier one.
pub fn first_beam_ns(log: &Log, replay: &Replay, k: usize) -> u64 {
    let beams = log.scans[k].ranges_mm.len();
    let half_s = f64::from(time_increment(&replay.sensor_of(log, k))) * beams.saturating_sub(1) as f64 / 2.0;
    nanoseconds(log.scans[k].stamp_us).saturating_add_signed(-(half_s * 1e9).round() as i64)
}

/// Time from beam to beam, seconds.
fn time_increment(sensor: &SensorConfig) -> f32 {
    sensor.geometry.revolution_us as f32 * 1e-6 / sensor.geometry.steps_per_revolution
}

/// A scan as its message.
pub fn scan<'a>(log: &Log, replay: &Replay, frames: &'a Frames, k: usize, ns: u64) -> LaserScan<'a> {
    let sensor = replay.sensor_of(log, k);
    let (geometry, codes) = (&sensor.geometry, &sensor.codes);
    let ranges_mm = &log.scans[k].ranges_mm;
    LaserScan {
        header: header(ns, frames.name(&sensor.mounting).unwrap_or(LASER)),
        angle_min: geometry.bearing(0),
        angle_max: geometry.bearing(ranges_mm.len().saturating_sub(1)),
        angle_increment: geometry.step_rad(),
        time_increment: time_increment(&sensor),
        scan_time: geometry.revolution_us as f32 * 1e-6,
        range_min: metres(codes.min_mm.into()),
        // What is at the greatest range is taken for nothing by whoever reads it.
        range_max: metres(u32::from(codes.max_mm) + 1),
        ranges: ranges_mm.iter().map(|&value_mm| range_m(codes.read(value_mm), value_mm)).collect(),
        intensities: &[],
    }
}

/// A reading as REP 117 writes it.
pub(crate) fn range_m(reading: Reading, value_mm: u16) -> f32 {
    match reading {
        Reading::Range(_) => metres(value_mm.into()),
        Reading::NoEcho => f32::INFINITY,
        Reading::Bad => f32::NAN,
    }
}

/// The nearest number there is, so that the millimetres can be had back.
pub(crate) fn metres(mm: u32) -> f32 {
    mm as f32 / 1000.0
}

#[cfg(test)]
mod tests {
    use super::*;
    use slam_core::sensor::scan::RangeCodes;

    #[test]
    fn every_range_can_be_had_back() {
        for mm in 0..=u16::MAX {
            assert_eq!((f64::from(metres(mm.into())) * 1000.0).round() as u16, mm);
        }
    }

    #[test]
    fn readings_are_written_as_rep_117_says() {
        let codes = RangeCodes::URG_04LX;
        let written = |value_mm: u16| range_m(codes.read(value_mm), value_mm);
        assert_eq!(written(1234), 1.234);
        assert_eq!(written(0), f32::INFINITY);
        assert_eq!(written(codes.max_mm + 1), f32::INFINITY);
        assert!(written(16).is_nan());
        // The greatest distance is below the limit, from which on a reader sees nothing in range.
        assert!(written(codes.max_mm) < metres(u32::from(codes.max_mm) + 1));
    }
}
