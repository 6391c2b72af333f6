//! Where walls are open.
//!
//! In: a map segment, a scan and its pose, the robot's way. Out: the stretch of the segment that beams went through, or the robot did.
//! A line that was seen on both sides of a door may have become one segment through it, and doors are opened: what was seen through is no
//! wall. The line stays, and what stands of it stays on both sides.
//!
//! As in [`visibility`](super::visibility) only a distance tells that a beam went through.

use nalgebra::Point2;

use crate::geometry::math::{max, min};
use crate::geometry::pose::cross;
use crate::geometry::segment::Segment;
use crate::map::visibility::View;

/// Settings of cutting. Chosen on the simulated office and flat, seeds 1 to 3; that recorded logs come out as before was checked on aces,
/// mit-csail, fr079, exp1, exp3 and csail.
#[derive(Clone, Copy, Debug, PartialEq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct OpeningConfig {
    /// A stretch that is seen through is an opening from this width on, metres.
    pub min_width_m: f32,
    /// Width that the robot needs where it drives through, metres.
    pub passage_m: f32,
    /// Lines whose beams are looked up after each keyframe; they take turns.
    pub lines_per_scan: u8,
    /// A line is cut once this many scans have seen it; until then it is only forgotten as a whole.
    pub min_hits: u16,
}

impl OpeningConfig {
    /// Whether it is the turn of the line with this rank among so many; `first`, modulo their number, is whose turn is first.
    pub(crate) fn looks_at(&self, rank: usize, lines: usize, first: usize) -> bool {
        let lines = lines.max(1);
        (rank + lines - first % lines) % lines < usize::from(self.lines_per_scan)
    }
}

/// Distance of the places at which beams are looked up, metres; longer segments have [`MOST_SAMPLES`].
const STEP_M: f32 = 0.1;
/// Most places on a segment at which beams are looked up.
const MOST_SAMPLES: u16 = 64;
/// Fewest beams that went through an opening: one alone may be an error.
const LEAST_BEAMS: u16 = 4;
/// What is left of a segment is dropped if it is shorter than this, metres.
const SHORTEST_M: f32 = 0.15;

/// A stretch of a segment, along its direction from its start, metres.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Stretch {
    /// Where it begins.
    pub from_m: f32,
    /// Where it ends.
    pub to_m: f32,
}

impl Stretch {
    /// The widest stretch that a scan sees through, if it is wide enough. None if the whole segment is: that is for
    /// [`visibility`](super::visibility) to judge.
    ///
    /// Work: a look-up for each tenth of a metre, 64 at the most.
    pub fn seen_through(segment: &Segment, view: &View<'_, '_>, config: &OpeningConfig) -> Option<Self> {
        let length_m = segment.length_m();
        let samples = ((length_m / STEP_M) as u16).clamp(1, MOST_SAMPLES);
        let step_m = length_m / f32::from(samples);
        let mut widest: Option<(u16, u16)> = None;
        let (mut begin, mut beams, mut last_beam) = (0, 0u16, None);
        for k in 0..=samples {
            let beam =
                view.beam_through(segment, segment.start + segment.direction * (f32::from(k) * step_m));
            if beam.is_some() && beam != last_beam {
                beams += 1;
            }
            last_beam = beam;
            if beam.is_none() {
                (begin, beams) = (k + 1, 0);
            } else if beams >= LEAST_BEAMS && widest.is_none_or(|(from, to)| k - begin > to - from) {
                widest = Some((begin, k));
            }
        }
        let (from, to) = widest.filter(|widest| *widest != (0, samples))?;
        let opening = Self { from_m: f32::from(from) * step_m, to_m: f32::from(to) * step_m };
        (opening.to_m - opening.from_m >= config.min_width_m).then_some(opening)
    }

    /// What the robot needs of a segment across which it went from one position to another.
    pub fn driven_through(segment: &Segment, way: [Point2<f32>; 2], config: &OpeningConfig) -> Option<Self> {
        let [from, to] = way;
        let side = |point: Point2<f32>| cross(segment.direction, point - segment.start);
        let (before, behind) = (side(from), side(to));
        if before * behind >= 0.0 {
            return None;
        }
        let at = from + (to - from) * (before / (before - behind));
        let along_m = segment.direction.dot(&(at - segment.start));
        let half_m = 0.5 * config.passage_m;
        let is_within = along_m > 0.0 && along_m < segment.length_m();
        is_within.then_some(Self { from_m: along_m - half_m, to_m: along_m + half_m })
    }

    /// What is left of the segment before and behind it.
    pub fn cut(&self, segment: &Segment) -> [Option<Segment>; 2] {
        let length_m = segment.length_m();
        let part = |from_m: f32, to_m: f32| {
            let at = |along_m: f32| segment.start + segment.direction * along_m;
            (to_m - from_m >= SHORTEST_M).then(|| Segment { start: at(from_m), end: at(to_m), ..*segment })
        };
        [part(0.0, min(self.from_m, length_m)), part(max(self.to_m, 0.0), length_m)]
    }
}

/// Where a segment is open: the robot's way tells, or the scan's beams.
pub(crate) fn opening(
    segment: &Segment,
    way: [Point2<f32>; 2],
    view: Option<&View<'_, '_>>,
    config: &OpeningConfig,
) -> Option<Stretch> {
    Stretch::driven_through(segment, way, config)
        .or_else(|| view.and_then(|view| Stretch::seen_through(segment, view, config)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::SlamConfig;
    use crate::map::visibility::ForgetConfig;
    use crate::sensor::scan::{Scan, SensorConfig};
    use nalgebra::Isometry2;

    const FORGETTING: ForgetConfig =
        ForgetConfig { margin_m: 0.2, margin_sigmas: 3.0, min_sine: 0.1, scans: 3 };

    fn config() -> OpeningConfig {
        SlamConfig::default().openings.unwrap()
    }

    fn sensor() -> SensorConfig {
        let mut sensor = SlamConfig::default().sensor;
        sensor.mounting.base_from_laser = Isometry2::identity();
        sensor
    }

    /// A wall across the robot's way, 2 m ahead, from y = -1.5 to 1.5 m; its free side is the robot's.
    fn wall() -> Segment {
        Segment::from_ends(Point2::new(2.0, -1.5), Point2::new(2.0, 1.5), 100, 1e-4, Point2::origin())
    }

    /// What of the wall a scan sees through that finds it, but within these bounds a wall 2 m behind.
    fn seen_through(from_m: f32, to_m: f32) -> Option<Stretch> {
        let sensor = sensor();
        let mut ranges = [0u16; 682];
        for (beam, range_mm) in ranges.iter_mut().enumerate() {
            let tan = sensor.geometry.bearing(beam).tan();
            let distance_m = if (from_m..=to_m).contains(&(2.0 * tan)) { 4.0 } else { 2.0 };
            *range_mm = (1e3 * distance_m * (1.0 + tan * tan).sqrt()).min(5000.0) as u16;
        }
        let scan = Scan { ranges_mm: &ranges };
        let view = View::new(&scan, &Isometry2::identity(), &sensor, &FORGETTING);
        Stretch::seen_through(&wall(), &view, &config())
    }

    #[test]
    fn a_door_is_cut_out_of_a_wall() {
        let wall = wall();
        for (from_m, to_m) in [(-0.5, 0.4), (0.1, 0.9), (-1.2, -0.4)] {
            let opening = seen_through(from_m, to_m).unwrap();
            let [a, b] = opening.cut(&wall).map(Option::unwrap);
            let edges = [a.end.y, b.start.y];
            assert!((edges[0] - from_m).abs() < 0.11 && (edges[1] - to_m).abs() < 0.11, "{edges:?}");
            assert_eq!((a.start, b.end, a.moments), (wall.start, wall.end, wall.moments));
        }
    }

    #[test]
    fn what_is_narrow_whole_or_at_an_end_is_no_door() {
        assert_eq!(seen_through(0.0, 0.3), None, "a gap of 0.3 m");
        assert_eq!(seen_through(9.0, 9.0), None, "a wall that stands");
        assert_eq!(seen_through(-1.6, 1.6), None, "a wall that is gone is forgotten, not cut");
        let parts = seen_through(0.8, 1.6).unwrap().cut(&wall());
        assert_eq!(parts.iter().flatten().count(), 1, "what was too long becomes shorter");
    }

    #[test]
    fn where_the_robot_drove_there_is_no_wall() {
        let way = |from: (f32, f32), to: (f32, f32)| {
            let way = [Point2::new(from.0, from.1), Point2::new(to.0, to.1)];
            Stretch::driven_through(&wall(), way, &config())
        };
        let opening = way((1.9, 0.3), (2.1, 0.3)).unwrap();
        assert_eq!(way((2.1, 0.3), (1.9, 0.3)), Some(opening), "there and back");
        let [a, b] = opening.cut(&wall()).map(Option::unwrap);
        assert!((a.end.y - 0.05).abs() < 1e-5 && (b.start.y - 0.55).abs() < 1e-5, "{a:?} {b:?}");
        assert_eq!(way((1.5, 0.3), (1.9, 0.3)), None, "before it");
        assert_eq!(way((1.9, 1.6), (2.1, 1.6)), None, "past its end");
        assert_eq!(way((2.0, 0.0), (2.0, 0.0)), None, "at rest");
        let stub = Segment { start: Point2::new(2.0, 0.2), end: Point2::new(2.0, 0.4), ..wall() };
        let across = [Point2::new(1.9, 0.3), Point2::new(2.1, 0.3)];
        let opening = Stretch::driven_through(&stub, across, &config()).unwrap();
        assert_eq!(opening.cut(&stub), [None, None], "nothing is left of a stub");
    }

    #[test]
    fn lines_take_turns() {
        let config = OpeningConfig { lines_per_scan: 3, ..config() };
        for lines in [1usize, 3, 7, 20] {
            let mut looked_at = std::vec![0; lines];
            for first in (0..3 * lines.div_ceil(3)).step_by(3) {
                let now: std::vec::Vec<usize> =
                    (0..lines).filter(|k| config.looks_at(*k, lines, first)).collect();
                assert_eq!(now.len(), lines.min(3));
                now.into_iter().for_each(|k| looked_at[k] += 1);
            }
            assert!(looked_at.iter().all(|count| *count > 0), "{lines}: {looked_at:?}");
        }
    }
}
