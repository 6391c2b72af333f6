//! Systematic errors of the odometry, learnt while driving.
//!
//! In: what each correction moved the pose by, against what the odometry had said. Out: a scale of the distance, a scale
//! of the turn, and a turn for each metre (unequal wheels), applied to the increments to come.
//!
//! A scan corrects only a part of a prediction's error, so a constant error of the odometry would leave the pose behind
//! by a constant, and each new wall with it. Learnt, it vanishes. Three scalars, estimated by a Kalman filter whose
//! measurement noise is the prediction's own uncertainty.

use nalgebra::{Matrix2, Matrix3, Vector2, Vector3};

use crate::odometry::Increment;
use crate::pose::{exp, log};

/// Settings of the learning.
#[derive(Clone, Copy, Debug, PartialEq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct BiasConfig {
    /// Standard deviation of the distance's relative error before anything is learnt.
    pub sigma_distance: f32,
    /// Standard deviation of the turn's relative error.
    pub sigma_turn: f32,
    /// Standard deviation of the turn for each metre, radians.
    pub sigma_turn_per_m: f32,
    /// Errors larger than this many of those standard deviations are not believed.
    pub most_sigmas: f32,
}

/// What is known of the systematic errors.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct OdometryBias {
    config: BiasConfig,
    /// Relative error of the distance, and its variance.
    distance: f32,
    var_distance: f32,
    /// Relative error of the turn, and turn for each metre, with their covariance.
    turning: Vector2<f32>,
    covariance: Matrix2<f32>,
}

impl OdometryBias {
    /// Nothing is known yet.
    pub fn new(config: BiasConfig) -> Self {
        let square = |v: f32| v * v;
        let variances = Vector2::new(square(config.sigma_turn), square(config.sigma_turn_per_m));
        Self {
            config,
            distance: 0.0,
            var_distance: square(config.sigma_distance),
            turning: Vector2::zeros(),
            covariance: Matrix2::from_diagonal(&variances),
        }
    }

    /// Relative error of the distance (positive: the odometry says too little), relative error of the turn, and turn that
    /// the odometry misses for each metre, radians.
    pub fn estimate(&self) -> [f32; 3] {
        [self.distance, self.turning.x, self.turning.y]
    }

    /// The increment without its systematic error.
    #[must_use]
    pub fn corrected(&self, increment: &Increment) -> Increment {
        let mut twist = log(&increment.before_from_after);
        let forward = twist.x;
        twist.x += self.distance * forward;
        twist.z += self.turning.x * twist.z + self.turning.y * forward;
        Increment { before_from_after: exp(&twist), ..*increment }
    }

    /// Learns from a correction: `moved` is the corrected pose in the predicted one, `covariance` that of the
    /// prediction, in `base`.
    pub fn learn(&mut self, increment: &Increment, moved: &Vector3<f32>, covariance: &Matrix3<f32>) {
        let twist = log(&increment.before_from_after);
        let (forward, turn) = (twist.x, twist.z);

        let variance = forward * forward * self.var_distance + covariance.m11;
        if variance > 0.0 && variance.is_finite() {
            let gain = self.var_distance * forward / variance;
            self.distance += gain * moved.x;
            self.var_distance *= 1.0 - gain * forward;
        }

        let row = Vector2::new(turn, forward);
        let spread = self.covariance * row;
        let variance = row.dot(&spread) + covariance.m33;
        if variance > 0.0 && variance.is_finite() {
            let gain = spread / variance;
            self.turning += gain * moved.z;
            self.covariance -= gain * spread.transpose();
        }
        self.bound();
    }

    fn bound(&mut self) {
        let c = &self.config;
        let within = |value: f32, sigma: f32| {
            let most = c.most_sigmas * sigma;
            if value.is_finite() { value.clamp(-most, most) } else { 0.0 }
        };
        self.distance = within(self.distance, c.sigma_distance);
        self.turning.x = within(self.turning.x, c.sigma_turn);
        self.turning.y = within(self.turning.y, c.sigma_turn_per_m);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pose::pose;

    const CONFIG: BiasConfig =
        BiasConfig { sigma_distance: 0.03, sigma_turn: 0.05, sigma_turn_per_m: 0.02, most_sigmas: 3.0 };

    /// A tracker that corrects a third of its error each scan still learns all of the odometry's.
    #[test]
    fn errors_are_learnt_from_partial_corrections() {
        let mut bias = OdometryBias::new(CONFIG);
        let (mut behind_m, mut behind_rad) = (0.0f32, 0.0f32);
        let noise = Matrix3::from_diagonal(&Vector3::new(1e-5, 1e-5, 1e-5));
        for k in 0..3000 {
            let (forward, turn) = (0.05, if k % 100 < 30 { 0.1 } else { 0.0 });
            // The odometry says 2 % too little way, 4 % too little turn, and misses 0.01 rad a metre.
            let said = Increment::from_motion(exp(&Vector3::new(
                forward / 1.02,
                0.0,
                (turn - 0.01 * forward) / 1.04,
            )));
            let used = bias.corrected(&said);
            let twist = log(&used.before_from_after);
            behind_m += forward - twist.x;
            behind_rad += turn - twist.z;
            let moved = Vector3::new(behind_m / 3.0, 0.0, behind_rad / 3.0);
            behind_m -= moved.x;
            behind_rad -= moved.z;
            bias.learn(&said, &moved, &noise);
        }
        let [distance, turn, turn_per_m] = bias.estimate();
        assert!((distance - 0.02).abs() < 0.003, "{distance}");
        assert!((turn - 0.04).abs() < 0.008, "{turn}");
        assert!((turn_per_m - 0.01).abs() < 0.002, "{turn_per_m}");
        assert!(behind_m.abs() < 1e-3 && behind_rad.abs() < 2e-3, "{behind_m} {behind_rad}");
    }

    #[test]
    fn nonsense_is_not_believed() {
        let mut bias = OdometryBias::new(CONFIG);
        let increment = Increment::from_motion(pose(1.0, 0.0, 0.5));
        for moved in [1e9, f32::NAN, f32::INFINITY] {
            bias.learn(&increment, &Vector3::new(moved, moved, moved), &(Matrix3::identity() * 1e-6));
            let [distance, turn, turn_per_m] = bias.estimate();
            assert!(
                distance.abs() <= 0.09 + 1e-6 && turn.abs() <= 0.15 + 1e-6 && turn_per_m.abs() <= 0.06 + 1e-6
            );
        }
        let [distance, ..] = bias.estimate();
        assert!(distance.is_finite());
    }
}
