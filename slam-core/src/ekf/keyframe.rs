//! Which scans the filter sees.
//!
//! Scans taken from nearly the same place share errors: corners cut alike, edges mixed alike. To take them for independent would make
//! the filter overconfident, and would cost most where there is least to learn. So a scan becomes a keyframe when the robot has moved
//! on since the last one, and now and then while it stands. The pose of every other scan is tracked against the map as the last
//! keyframe left it, by fewer beams; meanwhile the keyframe's update is spread over scans, so that none takes long.

use nalgebra::{Isometry2, Matrix3, Vector2, Vector3};

use crate::geometry::math::sqrt;
use crate::geometry::pose::perpendicular;
use crate::odometry::Increment;

/// When a scan becomes a keyframe.
#[derive(Clone, Copy, Debug, PartialEq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct KeyframeConfig {
    /// Way since the last keyframe from which on a scan is one, metres; a radian counts as a metre.
    pub way_m: f32,
    /// Scans since the last keyframe from which on a scan is one, wherever the robot is.
    pub scans: u32,
    /// All scans up to this number are keyframes: what is seen first says where the map's frame lies.
    pub at_start: u32,
    /// A scan between keyframes only follows the robot. Beams of it are left out where that leaves points no farther
    /// apart than this on a surface that faces the sensor, metres.
    pub spacing_between_m: f32,
    /// A scan explained to less than this share is no keyframe, …
    pub min_score: f32,
    /// … unless so many scans have passed since the last: the robot may have come to where nothing is known.
    pub scans_below: u32,
    /// … or so long a way, metres; a radian counts as a metre.
    pub way_below_m: f32,
}

/// The last keyframe and the way since.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Keyframe {
    /// Pose of `base` in `map` by the filter.
    pub map_from_base: Isometry2<f32>,
    /// What the odometry said since, its systematic errors included.
    pub since: Increment,
    /// Scans since.
    pub scans: u32,
    /// Its variance relative to the lines around it.
    pub local_variance: LocalVariance,
}

impl Keyframe {
    /// A keyframe just taken.
    pub fn at(map_from_base: Isometry2<f32>, local_variance: LocalVariance) -> Self {
        Self { map_from_base, since: Increment::identity(), scans: 0, local_variance }
    }

    /// Whether the robot has gone on far enough for another one; `number` is that of the scan.
    pub fn is_due(&self, number: u32, config: &KeyframeConfig) -> bool {
        number < config.at_start
            || self.scans >= config.scans
            || self.since.distance_m + self.since.turn_rad >= config.way_m
    }
}

/// The filter's pose at its last commit, with no update pending: poses until the next one are relative to it.
///
/// Derivation. Tracking holds the lines fixed, so it gives the covariance L of a pose's error relative to the lines around it. The
/// error that these lines have in common moves the anchor a and a later pose n alike, as one rigid body with the Jacobian J of
/// compounding; relative to the lines their errors are independent of it. By the law of total covariance the filter's marginal is
/// P_a = Λ + L_a with Λ of the lines, and the later pose has J·Λ·Jᵀ + L_n = J·P_a·Jᵀ + (L_n − L_a), the turn of L_a over some
/// decimetres neglected. [`Self::carried`] is the first part, [`Self::grown`] the second: L_a is taken to have the shape of L_n, block by
/// block, and where the pose is surer than at the anchor nothing is subtracted, which errs on the side of caution by L_a at the most.
///
/// Reference: Smith, Self and Cheeseman, "Estimating uncertain spatial relationships in robotics", 1990 (compounding of relative poses);
/// Castellanos and Tardós, "Mobile Robot Localization and Map Building", 1999 (what features have in common is the frame's error).
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Anchor {
    /// Of `base` in `map`.
    pub position: Vector2<f32>,
    /// Of the pose (x, y, θ).
    pub covariance: Matrix3<f32>,
    /// What of that is the pose's variance relative to the lines around it.
    pub local_variance: LocalVariance,
}

/// Variances of a pose relative to the lines around it, as if these were known for certain.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct LocalVariance {
    /// Of both coordinates, summed.
    position: f32,
    heading: f32,
}

impl LocalVariance {
    /// Of a covariance (x, y, θ).
    pub fn of(covariance: &Matrix3<f32>) -> Self {
        Self { position: covariance.m11 + covariance.m22, heading: covariance.m33 }
    }

    /// With another covariance added.
    pub fn plus(self, covariance: &Matrix3<f32>) -> Self {
        let by = Self::of(covariance);
        Self { position: self.position + by.position, heading: self.heading + by.heading }
    }
}

impl Anchor {
    /// Covariance of a pose that is rigidly attached to the anchor: J·P·Jᵀ.
    pub fn carried(&self, map_from_base: &Isometry2<f32>) -> Matrix3<f32> {
        let lever = perpendicular(map_from_base.translation.vector - self.position);
        let mut by_pose = Matrix3::identity();
        (by_pose.m13, by_pose.m23) = (lever.x, lever.y);
        by_pose * self.covariance * by_pose.transpose()
    }

    /// What a pose's covariance relative to the lines around it adds to that: its growth since the anchor, which has its own in it
    /// already.
    pub fn grown(&self, covariance: &Matrix3<f32>) -> Matrix3<f32> {
        let share = |before: f32, now: f32| if now > before { sqrt(1.0 - before / now) } else { 0.0 };
        let (before, now) = (self.local_variance, LocalVariance::of(covariance));
        let position = share(before.position, now.position);
        let heading = share(before.heading, now.heading);
        let shares = Matrix3::from_diagonal(&Vector3::new(position, position, heading));
        shares * covariance * shares
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::pose::pose;

    const CONFIG: KeyframeConfig = KeyframeConfig {
        way_m: 0.1,
        scans: 5,
        at_start: 2,
        spacing_between_m: 0.0,
        min_score: 0.0,
        scans_below: 0,
        way_below_m: 0.0,
    };

    #[test]
    fn it_is_due_at_the_start_after_a_way_after_a_turn_and_after_a_while() {
        let mut last = Keyframe::at(Isometry2::identity(), LocalVariance::default());
        assert!(last.is_due(0, &CONFIG) && last.is_due(1, &CONFIG) && !last.is_due(2, &CONFIG));
        // Back and forth is a way too.
        for step in [0.06, -0.06] {
            assert!(!last.is_due(9, &CONFIG));
            last.since = last.since.then(&Increment::from_motion(pose(step, 0.0, 0.0)));
        }
        assert!(last.is_due(9, &CONFIG));
        last = Keyframe::at(Isometry2::identity(), LocalVariance::default());
        last.since = Increment::from_motion(pose(0.0, 0.0, -0.11));
        assert!(last.is_due(9, &CONFIG));
        last = Keyframe { scans: 5, ..Keyframe::at(Isometry2::identity(), LocalVariance::default()) };
        assert!(last.is_due(9, &CONFIG));
    }

    #[test]
    fn away_from_the_anchor_the_heading_s_error_moves_the_robot() {
        let covariance = Matrix3::from_diagonal(&nalgebra::Vector3::new(1e-4, 1e-4, 4e-4));
        let anchor = Anchor { position: Vector2::new(1.0, 1.0), covariance, ..Anchor::default() };
        let carried = anchor.carried(&pose(3.0, 1.0, 0.0));
        assert!((carried.m22 - (1e-4 + 4.0 * 4e-4)).abs() < 1e-8 && (carried.m11 - 1e-4).abs() < 1e-8);
        assert!((carried.m23 - 2.0 * 4e-4).abs() < 1e-8);
    }

    #[test]
    fn only_what_an_error_has_grown_by_is_added() {
        let before = Matrix3::from_diagonal(&Vector3::new(1e-4, 3e-4, 1e-4));
        let anchor = Anchor { local_variance: LocalVariance::of(&before), ..Anchor::default() };
        assert_eq!(anchor.grown(&before), Matrix3::zeros());
        assert_eq!(anchor.grown(&(before * 0.5)), Matrix3::zeros());
        let grown = anchor.grown(&(before * 4.0));
        assert!((grown - before * 3.0).amax() < 1e-9, "{grown}");
    }
}
