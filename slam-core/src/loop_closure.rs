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

use crate::map::MapSegment;
use crate::math::{min, sin_cos, wrap_angle};
use crate::pose::{components, pose};

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
    /// χ² of the correction, by the joint estimate's covariance of the pose, up to which it is believed.
    pub max_chi2: f32,
    /// Consecutive scans that must ask for the same correction.
    pub confirmations: u8,
    /// Corrections that differ by less than this in position are the same, metres.
    pub same_position_m: f32,
    /// Corrections that differ by less than this in heading are the same, radians.
    pub same_heading_rad: f32,
}

/// Covariance of what the pose has drifted since segments seen `way_m` ago.
pub(crate) fn drift(config: &LoopConfig, way_m: f32) -> Matrix3<f32> {
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

/// The correction that the last scans asked for, and how many of them.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct PendingClosure {
    asked: Option<(Isometry2<f32>, u8)>,
}

impl PendingClosure {
    /// Whether enough scans in a row have asked for the same correction, this one included. Starts anew when they have.
    pub fn confirmed_by(&mut self, closure: &Closure, config: &LoopConfig) -> bool {
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
    pub(crate) fn bend_segment(&self, entry: &mut MapSegment) {
        let bent = entry.segment.transformed(&self.bend(entry.seen_at_m));
        if bent.is_finite() {
            entry.segment = bent;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::segment::Segment;
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
