//! Is the odometry to be believed, and how far: the one owner of all that is learnt from comparing it with the scanner.
//!
//! In: after each scan the motion as the odometry has it, and what the scan says of the pose. Out: the covariance of motions, the
//! motion to expect where the odometry is useless, what is wrong with the wheels, and the noise of odometry and lines.

use nalgebra::{Isometry2, Matrix3};

use crate::config::{OdometryConfig, SlamConfig};
use crate::geometry::line_noise::LineNoise;
use crate::odometry::bias::OdometryBias;
use crate::odometry::monitor::OdometryMonitor;
use crate::odometry::noise_learning::NoiseLearning;
use crate::odometry::track::ScanMotion;
use crate::odometry::wheel_faults::{WheelFault, WheelMonitor};
use crate::odometry::{Increment, OdometryNoise};
use crate::tracking::correction::{Observability, Verdict};

/// The odometry against the scanner.
#[derive(Clone, Debug)]
pub(crate) struct OdometryHealth {
    monitor: OdometryMonitor,
    wheels: WheelMonitor,
    learning: NoiseLearning,
    /// Whether the last scan fixed the pose.
    fixed: bool,
}

/// What a scan says of the motion that led to it.
#[derive(Clone, Copy, Debug)]
pub(crate) struct ScanEvidence<'a> {
    /// Pose of `base` in `map` at the scan before, …
    pub previous: &'a Isometry2<f32>,
    /// … and at this one.
    pub pose: &'a Isometry2<f32>,
    /// Share of the scan that the map explains there.
    pub support: f32,
    /// Directions of the pose that the pairs fix.
    pub observability: &'a Observability,
    /// Root mean square distance of the observed segments from their map lines, metres.
    pub residual_m: f32,
    /// Whether the scan overruled the odometry.
    pub jumped: bool,
    /// Systematic errors of the odometry.
    pub bias: &'a OdometryBias,
}

impl OdometryHealth {
    /// Wheels that are believed, with noise as it is configured.
    pub fn new(line_noise: LineNoise, odometry_noise: OdometryNoise) -> Self {
        Self {
            monitor: OdometryMonitor::default(),
            wheels: WheelMonitor::default(),
            learning: NoiseLearning::new(line_noise, odometry_noise),
            fixed: false,
        }
    }

    /// Whether the odometry is of no use, and the scanner is followed alone.
    pub fn is_useless(&self) -> bool {
        self.monitor.is_useless()
    }

    /// The map, and the robot in it, was moved: the way at hand says nothing of the odometry.
    pub fn map_moved(&mut self) {
        self.learning.interrupt();
    }

    /// What is wrong with the wheels, where that is known.
    pub fn wheel_fault(&self) -> Option<WheelFault> {
        self.wheels.fault()
    }

    /// The motion to expect instead of the one that is reported: the last motion goes on where the odometry is useless, and what the
    /// scanner has seen already is taken off where it comes late.
    pub fn expected(&self, motion: &ScanMotion) -> Option<ScanMotion> {
        let increment = if self.is_useless() {
            Some(self.monitor.expected())
        } else {
            self.monitor.late_remainder(&motion.since_previous)
        };
        increment.map(|increment| motion.evenly(increment))
    }

    /// Covariance (x, y, θ) that an increment adds, in `base` before it.
    pub fn covariance(&self, increment: &Increment, config: &OdometryConfig) -> Matrix3<f32> {
        let mut noise = config.noise.covariance(increment);
        if let Some(config) = config.monitor.as_ref().filter(|_| self.is_useless()) {
            noise += self.monitor.expected_covariance(config);
        }
        noise
    }

    /// Takes in a motion by the odometry and what the scan says of it. Returns the noise of lines and odometry to be used from now on,
    /// where that is learnt.
    pub fn update(
        &mut self,
        motion: &Increment,
        scan: &ScanEvidence<'_>,
        config: &SlamConfig,
    ) -> Option<(LineNoise, OdometryNoise)> {
        let monitor = config.odometry.monitor.as_ref()?;
        let fixed = scan.support >= monitor.min_score && scan.observability.verdict == Verdict::Full;
        let by_scanner = scan.previous.inverse() * scan.pose;
        self.monitor.account(motion, &by_scanner, fixed && !scan.jumped);
        if fixed && self.fixed {
            self.monitor.update(motion, &by_scanner, monitor);
            if let Some(track_m) = config.odometry.track_m {
                self.wheels.update(motion, &by_scanner, track_m);
            }
        } else {
            self.monitor.lost_sight();
            self.wheels.interrupt();
        }
        self.fixed = fixed;
        let learning = config.learning.as_ref()?;
        self.learning.drive(&scan.bias.corrected(motion));
        if scan.jumped || self.is_useless() {
            self.learning.interrupt();
        } else if fixed {
            self.learning.fixed(scan.pose, scan.observability.weak_sigma_m, learning);
        }
        if fixed {
            self.learning.take_residual(scan.residual_m, learning);
        }
        Some((self.learning.line_noise(learning), self.learning.odometry_noise()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::pose::pose;

    /// Scans that fix the pose of a robot that goes 5 cm each, while its counters stand still.
    fn frozen(config: &SlamConfig, scans: usize) -> OdometryHealth {
        let mut health = OdometryHealth::new(config.line_noise, config.odometry.noise);
        let observability =
            Observability { verdict: Verdict::Full, weak_sigma_m: 0.01, ..Observability::BLIND };
        for k in 0..scans {
            let [previous, now] = [k, k + 1].map(|k| pose(0.05 * k as f32, 0.0, 0.0));
            let evidence = ScanEvidence {
                previous: &previous,
                pose: &now,
                support: 1.0,
                observability: &observability,
                residual_m: 0.005,
                jumped: false,
                bias: &OdometryBias::default(),
            };
            let learnt = health.update(&Increment::identity(), &evidence, config);
            assert!(learnt.is_some(), "the default learns");
        }
        health
    }

    #[test]
    fn counters_that_stand_still_are_found_and_the_last_motion_goes_on() {
        let mut config = SlamConfig::default();
        config.odometry.track_m = Some(0.3);
        let good = frozen(&config, 1);
        let reported = ScanMotion::instantaneous(Increment::identity());
        assert!(!good.is_useless() && good.expected(&reported).is_none());
        let frozen = frozen(&config, 60);
        assert!(frozen.is_useless());
        assert_eq!(frozen.wheel_fault(), Some(WheelFault::BothDead));
        let expected = frozen.expected(&reported).unwrap().since_previous;
        assert!((expected.distance_m - 0.05).abs() < 1e-3, "{expected:?}");
        // And that is less sure than wheels that turn.
        let [before, now] = [&good, &frozen].map(|h| h.covariance(&expected, &config.odometry));
        assert!(now.m11 > 4.0 * before.m11, "{before} {now}");
    }
}
