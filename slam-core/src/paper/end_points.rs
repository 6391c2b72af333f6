//! Registration, equation (10) and Fig. 6 of the paper.
//!
//! In: observed segments in `base`, the corrected pose, the pairs. Out: a changed map.
//!
//! ```text
//!  (10)     p' = R(θ) p + (x, y)
//! ```
//!
//! carries the segments to `map`. Those without a pair are added. A pair becomes the least-squares line through its four end
//! points, ended by the farthest of their feet, and stands for the points of both: n = n_m + n_g (Fig. 6). The points in between
//! are forgotten, and however often a wall was seen before, one more look moves it by half of what it disagrees.
//!
//! [`EndPointWeight::Inliers`] is no longer the paper: see [`SlamConfig::paper_weighted`](crate::SlamConfig::paper_weighted).

use nalgebra::Isometry2;

use crate::ekf::keyframe_update::{Observed, RegistrationReport, mark_seen};
use crate::geometry::segment::{Moments, Segment};
use crate::map::SegmentMap;

/// Settings of the paper's registration.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct EndPointsConfig {
    /// What an end point weighs.
    pub weight: EndPointWeight,
}

/// What each of the four end points weighs when a line is laid through them.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize), serde(rename_all = "snake_case"))]
pub enum EndPointWeight {
    /// All the same, as the paper has it.
    Equal,
    /// Half of the inliers of its segment, as in equation (3).
    Inliers,
}

/// The map by the corrected pose.
///
/// Work: one step for each observed segment.
pub fn register_end_points<const N: usize>(
    seen: &Observed<'_>,
    pose: &Isometry2<f32>,
    config: &EndPointsConfig,
    map: &mut SegmentMap<N>,
) -> RegistrationReport {
    let mut report = RegistrationReport { keyframe: true, committed: true, ..RegistrationReport::default() };
    for pair in seen.pairs {
        let (Some(segment), Some(entry)) = (seen.segments.get(pair.observed), map.get_mut(pair.mapped))
        else {
            continue;
        };
        // Eq. (10), then Fig. 6.
        let joined = joined_by_end_points(&entry.segment(), &segment.transformed(pose), config.weight);
        if !joined.is_finite() {
            report.doubtful += 1;
            continue;
        }
        entry.set_segment(&joined);
        mark_seen(entry, &seen.stamp);
        report.matched += 1;
    }
    for segment in seen.unknown() {
        let segment = segment.transformed(pose);
        if segment.is_finite() && map.insert(segment, seen.stamp.scan, seen.stamp.way_m).is_some() {
            report.new += 1;
        }
    }
    report
}

/// Fig. 6: the least-squares line through the four end points; n = n_m + n_g.
fn joined_by_end_points(mapped: &Segment, seen: &Segment, weight: EndPointWeight) -> Segment {
    let ends = [mapped.start, mapped.end, seen.start, seen.end];
    let inliers = mapped.moments.inliers.saturating_add(seen.moments.inliers);
    let whole = mapped.moments.weight + seen.moments.weight;
    let [before, now] = [mapped, seen].map(|segment| match weight {
        EndPointWeight::Equal => 0.25 * whole,
        EndPointWeight::Inliers => 0.5 * whole * segment.moments.inliers as f32 / inliers as f32,
    });
    let mut moments = Moments::from_points(ends.into_iter().zip([before, before, now, now]));
    moments.inliers = inliers;
    // The map segment's free side is kept: a point just off its middle on that side.
    Segment::fitted(moments, &ends, mapped.midpoint() + mapped.normal())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::paper::fixtures::wall;
    use nalgebra::Point2;
    use proptest::prelude::*;

    /// The line of least squared distances through points, in f64 and without moments: the direction is found by halving the
    /// interval around the best of many. Returns a point on it and its direction.
    fn line_through(points: [(f64, f64); 4]) -> ((f64, f64), f64) {
        let mean = |pick: fn(&(f64, f64)) -> f64| points.iter().map(pick).sum::<f64>() / 4.0;
        let (mx, my) = (mean(|p| p.0), mean(|p| p.1));
        let cost = |angle: f64| {
            let (s, c) = angle.sin_cos();
            points.iter().map(|(x, y)| (c * (y - my) - s * (x - mx)).powi(2)).sum::<f64>()
        };
        let step = core::f64::consts::PI / 720.0;
        let best =
            (0..720).map(|k| f64::from(k) * step).min_by(|a, b| cost(*a).total_cmp(&cost(*b))).unwrap();
        let (mut low, mut high) = (best - step, best + step);
        for _ in 0..100 {
            let (a, b) = (low + (high - low) / 3.0, high - (high - low) / 3.0);
            if cost(a) < cost(b) { high = b } else { low = a }
        }
        ((mx, my), 0.5 * (low + high))
    }

    proptest! {
        #[test]
        fn the_literal_merge_is_the_line_through_four_end_points(
            x in -20.0f32..20.0, y in -20.0f32..20.0, turn in -3.0f32..3.0, off in -0.2f32..0.2, tilt in -0.1f32..0.1,
            along in -2.0f32..2.0, points in 2usize..200,
        ) {
            let at = |s: f32, d: f32| (x + s * turn.cos() - d * turn.sin(), y + s * turn.sin() + d * turn.cos());
            let mapped = wall(at(0.0, 0.0), at(3.0, 0.0), 50);
            // Seen from the same side, as pairs are.
            let (from, to) = (at(along, off), at(along + 2.0, off + tilt));
            let seen = Segment::fitted(
                wall(from, to, points).moments,
                &[Point2::new(from.0, from.1), Point2::new(to.0, to.1)],
                mapped.midpoint() + mapped.normal() * 5.0,
            );
            let ends = [mapped.start, mapped.end, seen.start, seen.end];
            let plain = ends.map(|p| (f64::from(p.x), f64::from(p.y)));
            let ((mx, my), angle) = line_through(plain);
            let joined = joined_by_end_points(&mapped, &seen, EndPointWeight::Equal);
            let (s, c) = angle.sin_cos();
            let off_line = |p: Point2<f32>| (c * (f64::from(p.y) - my) - s * (f64::from(p.x) - mx)).abs();
            prop_assert!(off_line(joined.start) < 2e-5 && off_line(joined.end) < 2e-5, "{joined:?}");
            // The farthest feet are its ends.
            let feet = plain.map(|(px, py)| c * (px - mx) + s * (py - my));
            let long = feet.iter().copied().fold(f64::MIN, f64::max) - feet.iter().copied().fold(f64::MAX, f64::min);
            prop_assert!((f64::from(joined.length_m()) - long).abs() < 2e-5);
            prop_assert_eq!(joined.moments.inliers, 50 + points as u32);
            prop_assert!(joined.normal().dot(&mapped.normal()) > 0.0, "the free side stays");
        }
    }

    #[test]
    fn how_often_a_wall_was_seen_counts_for_the_weighted_merge_only() {
        let (mut mapped, seen) = (wall((0.0, 1.0), (2.0, 1.0), 40), wall((0.0, 1.1), (2.0, 1.2), 40));
        mapped.moments.inliers = 19 * 40;
        let height = |weight| joined_by_end_points(&mapped, &seen, weight).moments.centroid.y;
        assert!((height(EndPointWeight::Equal) - 1.075).abs() < 1e-6);
        assert!((height(EndPointWeight::Inliers) - (0.95 + 0.05 * 1.15)).abs() < 1e-6);
    }
}
