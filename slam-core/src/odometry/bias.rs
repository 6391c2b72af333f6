//! Systematic errors of the odometry, learnt while driving.
//!
//! A scan corrects only a part of a prediction's error, so a constant error of the odometry would leave the pose behind
//! by a constant, and each new wall with it. Three of them are estimated together with the pose, see
//! [`EkfSlam`](crate::ekf::filter::EkfSlam): a scale of the distance, a scale of the turn, and a turn for each metre (unequal wheels).

use nalgebra::{Matrix3, Vector3};

use crate::geometry::pose::{exp, log, perpendicular};
use crate::odometry::Increment;

/// How large the errors may be before anything is learnt.
#[derive(Clone, Copy, Debug, PartialEq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct BiasConfig {
    /// Standard deviation of the distance's relative error.
    pub sigma_distance: f32,
    /// Standard deviation of the turn's relative error.
    pub sigma_turn: f32,
    /// Standard deviation of the turn for each metre, radians.
    pub sigma_turn_per_m: f32,
}

impl BiasConfig {
    /// The three, as [`OdometryBias`] orders them.
    pub fn sigmas(&self) -> Vector3<f32> {
        Vector3::new(self.sigma_distance, self.sigma_turn, self.sigma_turn_per_m)
    }
}

/// The errors as known so far: relative error of the distance (positive: the odometry says too little), relative error of
/// the turn, and turn that the odometry misses for each metre, radians.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct OdometryBias(pub Vector3<f32>);

impl OdometryBias {
    /// The increment without its systematic error.
    #[must_use]
    pub fn corrected(&self, increment: &Increment) -> Increment {
        let mut twist = log(&increment.before_from_after);
        let forward = twist.x;
        twist.x += self.0.x * forward;
        twist.z += self.0.y * twist.z + self.0.z * forward;
        Increment { before_from_after: exp(&twist), ..*increment }
    }

    /// Derivative of the motion (x, y, θ), in the frame before it, by the three errors. A turn is taken as spread over the
    /// way.
    pub fn derivative(increment: &Increment) -> Matrix3<f32> {
        let twist = log(&increment.before_from_after);
        let moved = increment.before_from_after.translation.vector;
        let (forward, turn) = (twist.x, twist.z);
        let aside = perpendicular(moved) * 0.5;
        Matrix3::new(
            moved.x,
            turn * aside.x,
            forward * aside.x,
            moved.y,
            turn * aside.y,
            forward * aside.y,
            0.0,
            turn,
            forward,
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::pose::components;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn derivative_is_the_finite_difference(forward in -1.0f32..1.0, turn in -0.2f32..0.2) {
            let increment = Increment::from_motion(exp(&Vector3::new(forward, 0.0, turn)));
            let derivative = OdometryBias::derivative(&increment);
            let h = 1e-2;
            for k in 0..3 {
                let at = |h: f32| {
                    let mut errors = Vector3::zeros();
                    errors[k] = h;
                    components(&OdometryBias(errors).corrected(&increment).before_from_after)
                };
                let slope = (at(h) - at(-h)) / (2.0 * h);
                prop_assert!((slope - derivative.column(k)).norm() < 2e-2, "{} {}", slope, derivative);
            }
        }
    }

    #[test]
    fn nothing_learnt_changes_nothing() {
        let increment = Increment::from_motion(exp(&Vector3::new(0.4, 0.0, 0.3)));
        let same = OdometryBias::default().corrected(&increment);
        assert!(
            (components(&same.before_from_after) - components(&increment.before_from_after)).norm() < 1e-6
        );
    }
}
