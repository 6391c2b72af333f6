//! What is no longer there.
//!
//! In: map segments, the corrected pose, the scan. Out: which of them beams went through. People walk on,
//! doors are opened: their segments are seen through, again and again, and forgotten.
//!
//! Only a distance tells that a beam went through; a beam without echo may have met glass. A segment must be seen through
//! along its whole length, and more often than it was seen.

use nalgebra::{Isometry2, Point2, Vector2};

use crate::geometry::math::{atan2, sqrt};
use crate::geometry::segment::Segment;
use crate::map::{MapSegment, SegmentMap};
use crate::sensor::scan::{Reading, Scan, SensorConfig};

/// Settings of forgetting.
#[derive(Clone, Copy, Debug, PartialEq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct ForgetConfig {
    /// A beam went through a segment when it ended farther behind it than this, metres, …
    pub margin_m: f32,
    /// … and than this many standard deviations of its range.
    pub margin_sigmas: f32,
    /// Segments seen at a flatter angle are not judged, as the sine of the angle.
    pub min_sine: f32,
    /// A segment is forgotten when this many scans, and as many as saw it, have seen through it since it was last seen.
    pub scans: u16,
}

/// Parts of a segment at which beams are looked up.
const SAMPLES: [f32; 3] = [0.2, 0.5, 0.8];

/// A scan, from where it was taken, and when a beam counts as having gone through.
pub(crate) struct View<'a, 's> {
    scan: &'a Scan<'s>,
    laser_from_map: Isometry2<f32>,
    sensor: &'a SensorConfig,
    config: &'a ForgetConfig,
}

impl<'a, 's> View<'a, 's> {
    pub fn new(
        scan: &'a Scan<'s>,
        pose: &Isometry2<f32>,
        sensor: &'a SensorConfig,
        config: &'a ForgetConfig,
    ) -> Self {
        let laser_from_map = (pose * sensor.mounting.base_from_laser).inverse();
        Self { scan, laser_from_map, sensor, config }
    }

    /// Whether the beam towards the middle of a segment ended there.
    fn measures(&self, segment: &Segment) -> bool {
        let point = self.laser_from_map * segment.midpoint();
        let facing = (self.laser_from_map.rotation * segment.normal()).dot(&point.coords) < 0.0;
        let distance = sqrt(point.coords.norm_squared());
        facing
            && self
                .range_towards(&point.coords)
                .is_some_and(|(_, range_m)| (range_m - distance).abs() <= self.margin_m(range_m))
    }

    /// Whether the beams towards a segment all ended behind it.
    fn sees_through(&self, segment: &Segment) -> bool {
        SAMPLES.iter().all(|&share| {
            let point = segment.start + (segment.end - segment.start) * share;
            self.beam_through(segment, point).is_some()
        })
    }

    /// The beam towards a point of a segment, if it ended behind it. Not if it met the segment too flatly; from which side does not
    /// matter.
    pub fn beam_through(&self, segment: &Segment, point: Point2<f32>) -> Option<usize> {
        let normal = self.laser_from_map.rotation * segment.normal();
        let point = self.laser_from_map * point;
        let distance = sqrt(point.coords.norm_squared());
        if normal.dot(&point.coords).abs() < self.config.min_sine * distance {
            return None;
        }
        let (beam, range_m) = self.range_towards(&point.coords)?;
        (range_m > distance + self.margin_m(range_m)).then_some(beam)
    }

    /// How far from a segment a beam of this range may end and have met it.
    fn margin_m(&self, range_m: f32) -> f32 {
        self.config.margin_m + self.config.margin_sigmas * sqrt(self.sensor.noise.variance(range_m))
    }

    /// The beam towards a point of `laser`, and the range that it measured, if it measured one.
    fn range_towards(&self, point: &Vector2<f32>) -> Option<(usize, f32)> {
        let sensor = self.sensor;
        let side = if sensor.mounting.upside_down { -1.0 } else { 1.0 };
        let geometry = &sensor.geometry;
        let turn = geometry.steps_per_revolution;
        let steps =
            side * atan2(point.y, point.x) / geometry.step_rad() + f32::from(geometry.front_step) + 0.5;
        // The bearing is known up to a whole turn: the one at or after the first step is taken.
        let first = f32::from(geometry.first_step);
        let steps = if steps < first { steps + turn } else { steps };
        let beam = (steps - first) as usize;
        let step = geometry.first_step.saturating_add(beam as u16);
        let (used_from, used_to) = sensor.used_steps;
        let value_mm = self.scan.ranges_mm.get(beam).filter(|_| (used_from..=used_to).contains(&step))?;
        match sensor.codes.read(*value_mm) {
            Reading::Range(range_m) => Some((beam, range_m)),
            Reading::NoEcho | Reading::Bad => None,
        }
    }
}

/// Counts the scans that have seen through a candidate since it was last seen, this one included. Work: three look-ups for each
/// candidate.
pub(crate) fn mark_seen_through<const N: usize>(
    view: &View<'_, '_>,
    scan_number: u32,
    candidates: &[u16],
    map: &mut SegmentMap<N>,
) {
    for &candidate in candidates {
        let Some(entry) = map.get_mut(usize::from(candidate)) else { continue };
        if entry.last_seen == scan_number {
            entry.seen_through = 0;
        } else if view.sees_through(&entry.segment()) {
            entry.seen_through = entry.seen_through.saturating_add(1);
        }
    }
}

/// How many map segments seen before lie where a scan from this pose measured something, and how many it saw through.
///
/// Work: three look-ups for each candidate.
pub(crate) fn confirmed_and_contradicted(
    view: &View<'_, '_>,
    candidates: &[u16],
    map: &[MapSegment],
) -> [u16; 2] {
    let mut counts = [0u16; 2];
    for entry in candidates.iter().filter_map(|candidate| map.get(usize::from(*candidate))) {
        let counted = match () {
            () if entry.hits < view.config.scans => continue,
            () if view.sees_through(&entry.segment()) => 1,
            () if view.measures(&entry.segment()) => 0,
            () => continue,
        };
        if let Some(count) = counts.get_mut(counted) {
            *count = count.saturating_add(1);
        }
    }
    counts
}

/// Whether a segment has been seen through often enough to be forgotten.
pub fn is_gone(entry: &MapSegment, config: &ForgetConfig) -> bool {
    entry.seen_through >= config.scans && entry.seen_through >= entry.hits
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::SlamConfig;

    const CONFIG: ForgetConfig = ForgetConfig { margin_m: 0.2, margin_sigmas: 3.0, min_sine: 0.3, scans: 3 };

    /// A segment across the robot's view, 2 m ahead of the axle, its free side towards it or away from it.
    fn segment(facing: bool) -> Segment {
        let viewpoint = Point2::new(if facing { 0.0 } else { 4.0 }, 0.0);
        Segment::from_ends(Point2::new(2.0, -0.2), Point2::new(2.0, 0.2), 10, 1e-4, viewpoint)
    }

    fn left_after(scans: u32, hits: u16, range_mm: u16, facing: bool) -> usize {
        let sensor = SlamConfig::paper().sensor;
        let mut map = SegmentMap::<4>::new();
        map.insert(segment(facing), 0, 0.0);
        map.get_mut(0).unwrap().hits = hits;
        for scan_number in 1..=scans {
            let ranges = [range_mm; 682];
            let scan = Scan { ranges_mm: &ranges };
            let here = Isometry2::identity();
            let view = View::new(&scan, &here, &sensor, &CONFIG);
            mark_seen_through(&view, scan_number, &[0], &mut map);
            if map.segments().first().is_some_and(|s| is_gone(s, &CONFIG)) {
                map.forget(0);
            }
        }
        map.segments().len()
    }

    #[test]
    fn what_beams_go_through_is_forgotten() {
        assert_eq!(left_after(2, 1, 3000, true), 1, "not at once");
        assert_eq!(left_after(3, 1, 3000, true), 0);
        assert_eq!(left_after(5, 6, 3000, true), 1, "what was seen more often stays longer");
        assert_eq!(left_after(6, 6, 3000, true), 0);
    }

    #[test]
    fn what_is_hidden_or_gives_no_echo_stays() {
        assert_eq!(left_after(9, 1, 1000, true), 1, "hidden");
        assert_eq!(left_after(9, 1, 1870, true), 1, "still there");
        assert_eq!(left_after(9, 1, 0, true), 1, "no echo");
        assert_eq!(left_after(3, 1, 3000, false), 0, "a wall would have stopped beams from behind as well");
        assert_eq!(left_after(3, 1, 3000, false), 0, "a wall would have stopped beams from behind as well");
    }

    #[test]
    fn beams_behind_the_robot_and_out_of_use_are_none() {
        let sensor = SlamConfig::paper().sensor;
        let ranges = [1234u16; 682];
        let scan = Scan { ranges_mm: &ranges };
        let here = Isometry2::identity();
        let view = View::new(&scan, &here, &sensor, &CONFIG);
        assert!(view.range_towards(&Vector2::new(1.0, 0.0)).is_some());
        assert!(view.range_towards(&Vector2::new(-1.0, 0.0)).is_none());
        for (beam, bearing) in [(0usize, -119.53f32), (340, 0.0), (681, 119.88)] {
            let mut ranges = [0u16; 682];
            ranges[beam] = 1000;
            let (s, c) = bearing.to_radians().sin_cos();
            let scan = Scan { ranges_mm: &ranges };
            let view = View::new(&scan, &here, &sensor, &CONFIG);
            assert_eq!(view.range_towards(&Vector2::new(c, s)).map(|(at, _)| at), Some(beam));
        }
    }
}
