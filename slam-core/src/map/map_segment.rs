//! A segment as the map keeps it, 40 bytes: its line, how sure that is, and its ends; the scatter of its points belongs to extraction.
//!
//! The ends are kept as whole steps of 2 mm along the line, and the information as the upper half of an `f32`: errors across the line, which
//! the estimate is made of, keep all their digits.

use nalgebra::{Point2, Vector2};

use crate::geometry::math::{max, min};
use crate::geometry::pose::cross;
use crate::geometry::segment::{Moments, Segment};

/// Ends are kept in steps of this length along the line, metres; up to 65 m from the centroid.
pub(crate) const END_STEP_M: f32 = 0.002;

/// A segment of the map.
#[derive(Clone, Copy, Debug, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct MapSegment {
    /// In `map`, metres: where offset and direction are uncorrelated.
    centroid: Point2<f32>,
    /// Unit vector; the free side is on its left.
    direction: Vector2<f32>,
    /// From the centroid, in steps.
    ends: [i16; 2],
    /// Upper halves of the information on offset (1/m²) and direction (1/rad²).
    information: [u16; 2],
    /// Number of points it was fitted to.
    inliers: u32,
    /// Number of the last scan that saw it.
    pub last_seen: u32,
    /// Way the robot had driven by then, metres.
    pub seen_at_m: f32,
    /// Number of scans that saw it, with the filter of keyframes; stays at its maximum.
    pub hits: u16,
    /// Scans whose beams went through it since it was last seen.
    pub seen_through: u16,
}

/// After this way unseen a segment is worth half, metres.
const HALF_WORTH_M: f32 = 5.0;

impl MapSegment {
    /// A segment in `map`, seen so often, the last time by scan `last_seen` after a way of `seen_at_m`.
    pub fn new(segment: &Segment, hits: u16, last_seen: u32, seen_at_m: f32) -> Self {
        let mut entry = Self {
            centroid: Point2::origin(),
            direction: Vector2::zeros(),
            ends: [0; 2],
            information: [0; 2],
            inliers: 0,
            last_seen,
            seen_at_m,
            hits,
            seen_through: 0,
        };
        entry.set_segment(segment);
        entry
    }

    /// The segment in `map`. Its weight and scatter say how sure its line is; while it is tracked with the pose, how sure it would be if the
    /// pose were known.
    pub fn segment(&self) -> Segment {
        let Self { centroid, direction, .. } = *self;
        let [from, to] = self.ends.map(|steps| centroid + direction * (f32::from(steps) * END_STEP_M));
        let [weight, along] = self.information.map(|half| f32::from_bits(u32::from(half) << 16));
        let [x, y] = [direction.x, direction.y];
        let scatter = [along * x * x, along * x * y, along * y * y];
        let moments = Moments { inliers: self.inliers, weight, centroid, scatter };
        Segment { moments, direction, start: from, end: to }
    }

    /// Unit direction from start to end; the free side is on its left.
    #[inline]
    pub fn direction(&self) -> Vector2<f32> {
        self.direction
    }

    /// Distance between the ends, metres.
    #[inline]
    pub fn length_m(&self) -> f32 {
        let [from, to] = self.ends.map(f32::from);
        (to - from) * END_STEP_M
    }

    /// Point half way between the ends.
    #[inline]
    pub fn midpoint(&self) -> Point2<f32> {
        let [from, to] = self.ends.map(f32::from);
        self.centroid + self.direction * ((from + to) * (0.5 * END_STEP_M))
    }

    /// Signed distance of a point from its line, metres; positive on the free side.
    #[inline]
    pub fn signed_distance(&self, point: Point2<f32>) -> f32 {
        cross(self.direction, point - self.centroid)
    }

    /// Whether a point of it lies within `reach_m` of a position.
    pub(crate) fn is_within(&self, position: Point2<f32>, reach_m: f32) -> bool {
        let from_centroid = position - self.centroid;
        let [from, to] = self.ends.map(|steps| f32::from(steps) * END_STEP_M);
        let along_m = max(min(self.direction.dot(&from_centroid), to), from);
        (from_centroid - self.direction * along_m).norm_squared() < reach_m * reach_m
    }

    /// Number of points it was fitted to.
    pub fn inliers(&self) -> u32 {
        self.inliers
    }

    /// Changes the segment, and nothing else.
    #[inline(never)]
    pub fn set_segment(&mut self, segment: &Segment) {
        let Segment { moments, direction, start, end } = segment;
        self.centroid = moments.centroid;
        self.direction = *direction;
        self.ends = [start, end].map(|end| steps(segment.along_of(*end)));
        self.information = [moments.weight, moments.scatter_along(*direction)].map(upper_half);
        self.inliers = moments.inliers;
    }

    /// The same with another segment.
    #[must_use]
    pub fn with_segment(mut self, segment: &Segment) -> Self {
        self.set_segment(segment);
        self
    }

    /// The same, last seen after a way of `seen_at_m`.
    #[must_use]
    pub fn seen_at(self, seen_at_m: f32) -> Self {
        Self { seen_at_m, ..self }
    }

    /// Takes in the points of another segment.
    pub(crate) fn add_inliers(&mut self, segment: &Segment) {
        self.inliers = self.inliers.saturating_add(segment.moments.inliers);
    }

    /// What it is worth keeping, to a robot that has driven so far.
    pub(super) fn worth(&self, way_m: f32) -> f32 {
        f32::from(self.hits) / (1.0 + max(way_m - self.seen_at_m, 0.0) / HALF_WORTH_M)
    }
}

/// The nearest number of whole steps; the farthest that there is room for.
#[inline]
fn steps(along_m: f32) -> i16 {
    let steps = along_m / END_STEP_M;
    // The conversion cuts towards zero, and saturates.
    (steps + 0.5_f32.copysign(steps)) as i16
}

/// The upper half of a number's bits, rounded; of what is beyond the largest number, that.
#[inline]
fn upper_half(value: f32) -> u16 {
    const LARGEST: f32 = f32::from_bits(0x7F7F_0000);
    ((min(value, LARGEST).to_bits() + 0x8000) >> 16) as u16
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::line_noise::{variances, with_variances};
    use crate::geometry::pose::pose;
    use proptest::prelude::*;

    fn segment(at: [f32; 2], heading: f32, [from, to]: [f32; 2], sigmas: [f32; 2]) -> Segment {
        let along = Segment::from_ends([from, 0.0].into(), [to, 0.0].into(), 77, 1.0, [from, 1.0].into());
        let along = with_variances(&along, sigmas[0] * sigmas[0], sigmas[1] * sigmas[1]);
        along.transformed(&pose(at[0], at[1], heading))
    }

    proptest! {
        #[test]
        fn what_is_kept_comes_back(
            x in -300f32..300.0, y in -300f32..300.0, heading in -3.2f32..3.2, from in -40f32..0.0, length in 0.05f32..80.0,
            offset in 1e-4f32..0.1, turn in 1e-4f32..0.1,
        ) {
            let segment = segment([x, y], heading, [from, from + length], [offset, turn]);
            let entry = MapSegment::new(&segment, 3, 9, 1.5);
            let back = entry.segment();
            prop_assert_eq!(back.line(), segment.line(), "the line keeps all its digits");
            prop_assert_eq!((back.moments.centroid, back.moments.inliers), (segment.moments.centroid, 77));
            for (a, b) in [(back.start, segment.start), (back.end, segment.end)] {
                prop_assert!((a - b).norm() < 0.5 * END_STEP_M + 2e-4, "{} {}", a, b);
            }
            for (a, b) in variances(&back).into_iter().zip(variances(&segment)) {
                prop_assert!((a / b - 1.0).abs() < 0.005, "{} {}", a, b);
            }
            let again = entry.with_segment(&back);
            prop_assert_eq!(again.ends, entry.ends, "what was rounded once stays");
            prop_assert_eq!(entry.with_segment(&entry.segment().transformed(&pose(3.0, -7.0, 1.0))).ends, entry.ends);
        }
    }

    #[test]
    fn it_is_within_reach_of_what_its_nearest_point_is() {
        let entry = MapSegment::new(&segment([1.0, 2.0], 0.6, [-1.0, 3.0], [0.01, 0.01]), 1, 1, 0.0);
        let positions = (0..400).map(|k| Point2::new((k % 20) as f32 - 10.0, (k / 20) as f32 - 10.0));
        for position in positions {
            let distance_m = (entry.segment().nearest_to(position) - position).norm();
            assert!(entry.is_within(position, distance_m + 1e-3), "{position}");
            assert!(distance_m < 1e-3 || !entry.is_within(position, distance_m - 1e-3), "{position}");
        }
    }

    #[test]
    fn what_is_too_long_or_too_sure_is_kept_at_the_limit() {
        let long = segment([0.0; 2], 0.0, [-100.0, 100.0], [0.01, 0.01]);
        assert!((MapSegment::new(&long, 1, 1, 0.0).length_m() - 2.0 * 65.535).abs() < 0.01);
        let mut sure = long;
        sure.moments.weight = f32::MAX;
        assert!(MapSegment::new(&sure, 1, 1, 0.0).segment().is_finite());
        let mut broken = long;
        broken.moments.centroid.x = f32::NAN;
        assert!(!MapSegment::new(&broken, 1, 1, 0.0).segment().is_finite());
    }
}
