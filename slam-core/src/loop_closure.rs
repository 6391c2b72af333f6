//! Coming back to where the robot was long ago.
//!
//! In: the scan's segments, the corrected pose, the part of the map not seen for a long way. Out: the pose by that old
//! part, and a map bent to fit.
//!
//! Scan by scan the pose agrees with the segments seen last; over a loop it drifts away from those seen first. A pose
//! graph would spread the correction over all poses of the loop. Here the map itself carries what is needed: each
//! segment knows how far the robot had driven when it last saw it, and is moved by the share of the correction that
//! this way is of the loop's. That is linear in the segments and needs no memory of poses.

use nalgebra::{Isometry2, Matrix3, Vector2};

use crate::estimator::{Estimator, Surroundings};
use crate::geometry::math::{max, min, sin_cos, wrap_angle};
use crate::geometry::pose::{components, difference, pose};
use crate::map::MapSegment;
use crate::tracking::Hypothesis;
use crate::tracking::correction::{Observability, Prior, Verdict};
use crate::tracking::tracker::{Kernel, Scene};
use crate::update::Stage;

/// Settings of loop closure.
#[derive(Clone, Copy, Debug, PartialEq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct LoopConfig {
    /// Segments not seen for this way are old, metres.
    pub min_way_m: f32,
    /// Growth of the position's drift, metres for each √metre of way.
    pub sigma_position_m_per_sqrt_m: f32,
    /// Growth of the heading's drift, radians for each √metre of way.
    pub sigma_heading_rad_per_sqrt_m: f32,
    /// Share of the scan that must be recognised among the old segments.
    pub min_support: f32,
    /// χ² of the correction, by the pose's own covariance, from which the robot counts as having drifted.
    pub min_chi2: f32,
    /// χ² of the correction, by the filter's covariance of the pose, up to which it is believed.
    pub max_chi2: f32,
    /// Consecutive scans that must ask for the same correction.
    pub confirmations: u8,
    /// Corrections that differ by less than this in position are the same, metres.
    pub same_position_m: f32,
    /// Corrections that differ by less than this in heading are the same, radians.
    pub same_heading_rad: f32,
}

/// Covariance of what the pose has drifted since segments seen `way_m` ago.
fn drift(config: &LoopConfig, way_m: f32) -> Matrix3<f32> {
    let var_position = config.sigma_position_m_per_sqrt_m * config.sigma_position_m_per_sqrt_m * way_m;
    let var_heading = config.sigma_heading_rad_per_sqrt_m * config.sigma_heading_rad_per_sqrt_m * way_m;
    Matrix3::from_diagonal(&nalgebra::Vector3::new(var_position, var_position, var_heading))
}

/// A loop that was closed.
#[derive(Clone, Copy, Debug)]
pub struct Closure {
    /// Pose by the segments seen last.
    pub drifted: Isometry2<f32>,
    /// Pose by the segments seen long ago.
    pub closed: Isometry2<f32>,
    /// Way driven when those were seen last, metres.
    pub loop_began_m: f32,
    /// Way driven now, metres.
    pub way_m: f32,
}

/// Recognises old parts of the map, and closes loops.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct LoopCloser {
    /// The correction that the last scans asked for, and how many of them.
    asked: Option<(Isometry2<f32>, u8)>,
}

impl LoopCloser {
    /// Looks for the scan at hand among what was not seen for long. Where the loop is closed the map is bent and the pose moved with it;
    /// returns the closure and the directions of the pose that the old lines fix.
    ///
    /// Work: one step for each line around the robot; where some are old, that of one hypothesis.
    pub fn close<const N: usize>(
        &mut self,
        config: &LoopConfig,
        estimator: &mut Estimator,
        around: &mut Surroundings<'_, N>,
        watch: &mut impl FnMut(Stage),
    ) -> Option<(Closure, Observability)> {
        watch(Stage::Association);
        let way_m = estimator.travelled_m();
        let unseen_m =
            |i: &u16| around.map.segments().get(usize::from(*i)).map_or(0.0, |s| way_m - s.seen_at_m);
        let oldest_m = around.tracker.nearby.all().iter().map(unseen_m).fold(0.0, max);
        if oldest_m < config.min_way_m {
            return None;
        }
        estimator.commit(around);
        let local = estimator.local();
        let (hypothesis, loop_began_m) = among_old_lines(config, &local, way_m, oldest_m, around, watch);
        let closure = Closure { drifted: local.pose, closed: hypothesis.pose, loop_began_m, way_m };
        let mut closed = None;
        if !is_likely(config, &hypothesis, &local, estimator) {
            *self = Self::default();
        } else if self.confirmed_by(&closure, config) {
            around.map.iter_mut().for_each(|entry| closure.bend_segment(entry));
            estimator.accept(&hypothesis);
            closed = Some((closure, hypothesis.observability));
        }
        watch(Stage::Association);
        let scene = Scene { observed: around.observed, map: around.map.segments(), config: around.config };
        let local = estimator.local();
        around.tracker.associate(&scene, &Hypothesis::at(local.pose, local.covariance));
        closed
    }

    /// Whether enough scans in a row have asked for the same correction, this one included. Starts anew when they have.
    fn confirmed_by(&mut self, closure: &Closure, config: &LoopConfig) -> bool {
        let times = match self.asked {
            Some((correction, times)) => {
                let off = components(&(correction * closure.drifted).inv_mul(&closure.closed));
                let same =
                    off.xy().norm() <= config.same_position_m && off.z.abs() <= config.same_heading_rad;
                if same { times.saturating_add(1) } else { 1 }
            }
            None => 1,
        };
        let confirmed = times >= config.confirmations;
        let correction = closure.closed * closure.drifted.inverse();
        self.asked = if confirmed { None } else { Some((correction, times)) };
        confirmed
    }
}

/// The pose by the lines that were not seen for long, and the way driven when the last of those paired was seen.
fn among_old_lines<const N: usize>(
    config: &LoopConfig,
    local: &Prior,
    way_m: f32,
    oldest_m: f32,
    around: &mut Surroundings<'_, N>,
    watch: &mut impl FnMut(Stage),
) -> (Hypothesis, f32) {
    let scene = Scene { observed: around.observed, map: around.map.segments(), config: around.config };
    let is_old = |entry: &MapSegment| way_m - entry.seen_at_m >= config.min_way_m;
    around.tracker.gather(scene.map, &local.pose, scene.config, is_old);
    let prior = Prior { covariance: local.covariance + drift(config, oldest_m), ..*local };
    let start = Hypothesis::of_prior(&prior);
    let hypothesis = around.tracker.refined(&scene, &prior, start, Kernel::Strict, watch);
    around.tracker.gather_all(&scene, &local.pose);
    let seen_at_m = around.tracker.pairs.iter().filter_map(|p| scene.map.get(p.mapped)).map(|s| s.seen_at_m);
    (hypothesis, seen_at_m.fold(0.0, max))
}

/// Whether the old lines fix a pose that the robot has drifted from, and may have.
fn is_likely(config: &LoopConfig, hypothesis: &Hypothesis, local: &Prior, estimator: &Estimator) -> bool {
    let is_seen = hypothesis.observability.verdict == Verdict::Full && hypothesis.score >= config.min_support;
    let drifted = chi2_between(&hypothesis.pose, &local.pose, &local.covariance) >= config.min_chi2;
    // The filter knows how far the pose may have drifted.
    let may_have = estimator
        .filter_covariance()
        .is_none_or(|covariance| chi2_between(&hypothesis.pose, &local.pose, &covariance) <= config.max_chi2);
    is_seen && drifted && may_have
}

/// Squared Mahalanobis distance between two poses.
fn chi2_between(a: &Isometry2<f32>, b: &Isometry2<f32>, covariance: &Matrix3<f32>) -> f32 {
    let off = difference(a, b);
    covariance.try_inverse().map_or(0.0, |w| off.dot(&(w * off)))
}

impl Closure {
    /// The motion in `map` of what was seen after a way of `seen_at_m`: nothing before the loop began, all of the
    /// correction now, turning about where the robot is.
    pub fn bend(&self, seen_at_m: f32) -> Isometry2<f32> {
        let length_m = self.way_m - self.loop_began_m;
        if seen_at_m <= self.loop_began_m || length_m <= 0.0 {
            return Isometry2::identity();
        }
        let share = min((seen_at_m - self.loop_began_m) / length_m, 1.0);
        let (from, to) = (components(&self.drifted), components(&self.closed));
        let turn = share * wrap_angle(to.z - from.z);
        let shift = (to.xy() - from.xy()) * share;
        let (s, c) = sin_cos(turn);
        let centre = from.xy();
        let turned = Vector2::new(c * centre.x - s * centre.y, s * centre.x + c * centre.y);
        let offset = centre - turned + shift;
        pose(offset.x, offset.y, turn)
    }

    /// Moves a segment of the map.
    fn bend_segment(&self, entry: &mut MapSegment) {
        let bent = entry.segment.transformed(&self.bend(entry.seen_at_m));
        if bent.is_finite() {
            entry.segment = bent;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::segment::Segment;
    use nalgebra::Point2;

    fn entry(x: f32, seen_at_m: f32) -> MapSegment {
        let segment =
            Segment::from_ends(Point2::new(x, 0.0), Point2::new(x, 1.0), 10, 1e-4, Point2::new(x - 1.0, 0.0));
        MapSegment { segment, hits: 1, seen_through: 0, last_seen: 0, seen_at_m }
    }

    #[test]
    fn old_segments_stay_and_new_ones_move_with_the_robot() {
        let (drifted, closed) = (pose(5.0, 1.0, 0.1), pose(5.2, 0.7, 0.15));
        let closure = Closure { drifted, closed, loop_began_m: 10.0, way_m: 110.0 };
        let mut old = entry(1.0, 9.0);
        closure.bend_segment(&mut old);
        assert_eq!(old, entry(1.0, 9.0));
        let mut new = entry(4.0, 110.0);
        closure.bend_segment(&mut new);
        // Seen from the robot, nothing changed.
        let before = drifted.inverse() * entry(4.0, 110.0).segment.start;
        assert!((closed.inverse() * new.segment.start - before).norm() < 1e-5);
    }

    #[test]
    fn half_way_segments_move_half() {
        let closure = Closure {
            drifted: pose(0.0, 0.0, 0.0),
            closed: pose(0.4, -0.2, 0.0),
            loop_began_m: 0.0,
            way_m: 50.0,
        };
        let mut middle = entry(1.0, 25.0);
        closure.bend_segment(&mut middle);
        assert!((middle.segment.start - Point2::new(1.2, -0.1)).norm() < 1e-5);
    }
}
