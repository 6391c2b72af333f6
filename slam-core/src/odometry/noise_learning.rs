//! How noisy lines and wheels really are, learnt while driving.
//!
//! In: after each scan that fixed the pose, how far observed segments lie off their map lines, and how far the odometry was off
//! over some way. Out: the line noise and the odometry noise to be used. What is configured is how bad a robot of this kind may
//! be; a good one among straight walls is better, and knows it after some metres.
//!
//! Both are variances of residuals, exponentially forgotten and bounded, as in adaptive Kalman filtering by covariance matching
//! (Mehra, "Approaches to adaptive filtering", IEEE TAC 1972). The residuals contain the scanner's own noise, which is not taken
//! out; for lines a share of them is taken instead.

use nalgebra::{Isometry2, Vector3};

use crate::geometry::line_noise::LineNoise;
use crate::geometry::math::{max, min, sqrt, within};
use crate::geometry::pose::{log, normalized};
use crate::odometry::{Increment, OdometryNoise};

/// Settings.
#[derive(Clone, Copy, Debug, PartialEq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct LearningConfig {
    /// Scans after which what was known of lines counts by 1/e.
    pub line_scans: f32,
    /// A line's offset is never taken to be surer than this, metres.
    pub least_sigma_offset_m: f32,
    /// Standard deviation of a line's offset, as a share of the residuals' root mean square.
    pub offset_per_residual: f32,
    /// Pieces of the way after which what was known of the odometry counts by 1/e.
    pub odometry_pieces: f32,
    /// Length of a piece, metres; a radian counts as a metre.
    pub piece_m: f32,
    /// The odometry's variances are never taken to be smaller than this share of the configured ones.
    pub least_share: f32,
    /// A pose fixed worse than this says nothing of the odometry, metres.
    pub max_sigma_m: f32,
}

/// What has been learnt.
#[derive(Clone, Copy, Debug)]
pub struct NoiseLearning {
    configured_line: LineNoise,
    configured_odometry: OdometryNoise,
    residual_m2: f32,
    /// Variances of position and heading, as shares of the configured ones.
    shares: [f32; 2],
    /// Since the pose was fixed last: what the odometry said, and from where.
    since: Option<(Increment, Isometry2<f32>)>,
}

/// A residual of the odometry counts up to this many of its variances.
const MOST_CHI2: f32 = 9.0;

impl NoiseLearning {
    /// Nothing learnt yet.
    pub fn new(line: LineNoise, odometry: OdometryNoise) -> Self {
        Self {
            configured_line: line,
            configured_odometry: odometry,
            residual_m2: f32::NAN,
            shares: [1.0; 2],
            since: None,
        }
    }

    /// Errors of lines beyond their points' noise.
    pub fn line_noise(&self, config: &LearningConfig) -> LineNoise {
        let most = self.configured_line.sigma_offset_m;
        let learnt = config.offset_per_residual * sqrt(max(self.residual_m2, 0.0));
        let sigma_offset_m = if self.residual_m2.is_finite() {
            max(min(learnt, most), min(config.least_sigma_offset_m, most))
        } else {
            most
        };
        LineNoise { sigma_offset_m, ..self.configured_line }
    }

    /// Growth of the odometry's uncertainty. The floors stay.
    pub fn odometry_noise(&self) -> OdometryNoise {
        let [position, heading] = self.shares.map(sqrt);
        let n = &self.configured_odometry;
        OdometryNoise {
            sigma_along_m_per_sqrt_m: position * n.sigma_along_m_per_sqrt_m,
            sigma_across_m_per_sqrt_m: position * n.sigma_across_m_per_sqrt_m,
            sigma_heading_rad_per_sqrt_m: heading * n.sigma_heading_rad_per_sqrt_m,
            sigma_heading_rad_per_sqrt_rad: heading * n.sigma_heading_rad_per_sqrt_rad,
            ..*n
        }
    }

    /// Takes in the root mean square distance of the observed segments from their map lines after the correction.
    pub fn take_residual(&mut self, residual_m: f32, config: &LearningConfig) {
        let now = residual_m * residual_m;
        if !now.is_finite() {
            return;
        }
        if !self.residual_m2.is_finite() {
            self.residual_m2 =
                self.configured_line.var_offset() / (config.offset_per_residual * config.offset_per_residual);
        }
        // One bad scan is no noisier world.
        let now = min(now, 4.0 * self.residual_m2);
        self.residual_m2 += (now - self.residual_m2) / config.line_scans;
    }

    /// Takes in what the odometry said since the last scan, without its systematic errors.
    pub fn drive(&mut self, increment: &Increment) {
        if let Some((since, _)) = &mut self.since {
            let next = since.then(increment);
            *since = Increment { before_from_after: normalized(&next.before_from_after), ..next };
        }
    }

    /// The scan fixed the pose, with this standard deviation in its worst direction.
    pub fn fixed(&mut self, map_from_base: &Isometry2<f32>, sigma_m: f32, config: &LearningConfig) {
        if sigma_m > config.max_sigma_m {
            return;
        }
        let Some((said, from)) = self.since else {
            self.since = Some((Increment::identity(), *map_from_base));
            return;
        };
        if said.distance_m + said.turn_rad < config.piece_m {
            return;
        }
        self.since = Some((Increment::identity(), *map_from_base));
        let seen = from.inverse() * map_from_base;
        let off: Vector3<f32> = log(&(said.before_from_after.inverse() * seen));
        let expected = self.configured_odometry.covariance(&said);
        let position = (off.x * off.x + off.y * off.y) / (expected.m11 + expected.m22);
        let heading = off.z * off.z / expected.m33;
        for (share, now) in self.shares.iter_mut().zip([position, heading]) {
            if now.is_finite() {
                *share += (min(now, MOST_CHI2) - *share) / config.odometry_pieces;
                *share = within(*share, config.least_share, 1.0);
            }
        }
    }

    /// The map has moved under the robot, or the scan overruled the odometry: the piece at hand says nothing.
    pub fn interrupt(&mut self) {
        self.since = None;
    }
}
