//! How much later scans are stamped than the odometry, estimated while driving.
//!
//! In: after each scan that fixed the pose, what the scanner turned it by against the odometry (the innovation of the heading), and
//! the odometry's turn rate then. Out: the delay of the scans' stamps beyond what the robot file says, with its uncertainty, and
//! what of it is to be used.
//!
//! A scan that is stamped Δ too late is given the odometry of a moment that had not come yet. Over some scans the scanner's turn
//! less the odometry's is then −Δ·(ω₁ − ω₀), with the turn rates ω at both ends: a turn that begins or ends tells it, an even one
//! does not. Slipping wheels and a wrong track feign a delay, but shorten (or lengthen) the turn at its beginning and at its end
//! alike, where ω₁ − ω₀ has opposite signs. So a delay is estimated from each of the two by recursive least squares with a prior
//! and a robust weight (Huber); their mean is the estimate, in which such errors cancel out, and it is not used where they differ
//! too much.
//!
//! Reference: J. Kelly and G. S. Sukhatme, "A general framework for temporal calibration of multiple proprioceptive and
//! exteroceptive sensors" (2010), who align the orientations that two sensors report; they do so offline, over the whole drive.

use crate::geometry::math::{max, min, sqrt, within};

/// Settings of the estimate.
#[derive(Clone, Copy, Debug, PartialEq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct DelayConfig {
    /// Standard deviation of the delay before anything is known, seconds.
    pub sigma_s: f32,
    /// Delays beyond this are limited to it, seconds. The odometry must be held for so much longer.
    pub max_s: f32,
    /// A delay is used once its standard deviation is below this, seconds, …
    pub max_sigma_s: f32,
    /// … and it is so many of them; half as many are enough once it is in use.
    pub significance: f32,
}

/// What is known of the delay.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Delay {
    /// By how much later scans are stamped than the robot file says, seconds; below zero: earlier.
    pub delay_s: f32,
    /// Its standard deviation, seconds.
    pub sigma_s: f32,
    /// Whether it is in use.
    pub used: bool,
}

/// The turn rate at an instant is taken over so long before and after it, microseconds: half the time between samples at 10 Hz.
pub(crate) const RATE_WITHIN_US: u64 = 50_000;
/// Scans between which turns are compared: a pose follows its scan within two or three.
const SCANS: usize = 4;
/// Changes of the turn rate below this tell nothing, rad/s.
const LEAST_CHANGE_RAD_S: f32 = 0.1;
/// Residuals beyond this many standard deviations count less.
const KERNEL_SIGMAS: f32 = 1.5;
/// What happened so many changes of the turn rate back counts by 1/e: the slip of some floor, or the temper of a clock.
const MEMORY: f32 = 400.0;
/// Residuals that the first ones are weighed by, rad: between a scanner's noise and that of slipping wheels.
const FIRST_SCALE_RAD: f32 = 0.01;
/// Residuals after which half of their scale is their own.
const SCALE_MEMORY: f32 = 40.0;
/// The delay in use changes by no more than this from scan to scan, seconds: less than the odometry's noise at any speed.
const MOST_STEP_S: f32 = 0.002;
/// No delay is surer than this, seconds: what of slip and track does not cancel out.
const LEAST_SIGMA_S: f32 = 0.003;
/// The two estimates may differ by so many times their mean.
const MOST_DIFFERENCE: f32 = 1.3;

/// Turns that begin, or end.
#[derive(Clone, Copy, Debug, Default)]
struct Phase {
    /// Σ w·x²/σ², 1/s², and Σ w·x·r/σ², 1/s.
    information: f32,
    weighted: f32,
}

impl Phase {
    /// The estimate and its variance, with the prior. Compiled once: 0.2 kB of flash less.
    #[inline(never)]
    fn estimate(&self, config: &DelayConfig) -> (f32, f32) {
        let information = self.information + 1.0 / (config.sigma_s * config.sigma_s);
        (self.weighted / information, 1.0 / information)
    }
}

/// The estimate as it stands.
#[derive(Clone, Copy, Debug)]
pub struct DelayEstimator {
    /// Turn of the scanner less that of the odometry so far, as it were without the delay in use, radians, and turn rate, rad/s, at
    /// the last scans, the oldest first.
    levels: [[f32; 2]; SCANS],
    /// How many of them are there.
    scans: usize,
    gap_rad: f32,
    /// Turns that begin and that end.
    phases: [Phase; 2],
    /// Mean size of the residuals, radians.
    scale_rad: f32,
    /// What is to be used, and what is: the one follows the other slowly.
    wanted_s: f32,
    used_s: f32,
}

impl Default for DelayEstimator {
    fn default() -> Self {
        Self {
            levels: [[0.0; 2]; SCANS],
            scans: 0,
            gap_rad: 0.0,
            phases: [Phase::default(); 2],
            scale_rad: FIRST_SCALE_RAD,
            wanted_s: 0.0,
            used_s: 0.0,
        }
    }
}

impl DelayEstimator {
    /// What is used of it, seconds: zero until it is known well.
    pub fn used_s(&self) -> f32 {
        self.used_s
    }

    /// The estimate.
    pub fn delay(&self, config: &DelayConfig) -> Delay {
        let [begin, end] = &self.phases;
        self.mean(begin.estimate(config), end.estimate(config), config)
    }

    fn mean(
        &self,
        (begin_s, begin_var): (f32, f32),
        (end_s, end_var): (f32, f32),
        config: &DelayConfig,
    ) -> Delay {
        let sigma_s = sqrt(0.25 * (begin_var + end_var) + LEAST_SIGMA_S * LEAST_SIGMA_S);
        let delay_s = within(0.5 * (begin_s + end_s), -config.max_s, config.max_s);
        Delay { delay_s, sigma_s, used: self.wanted_s != 0.0 }
    }

    /// Takes in by how much a scan turned the pose that the odometry predicted, radians, and the odometry's turn rate then, rad/s.
    pub fn update(&mut self, innovation_rad: f32, rate_rad_s: f32, config: &DelayConfig) {
        if !(innovation_rad.is_finite() && rate_rad_s.is_finite()) {
            return self.interrupt();
        }
        self.gap_rad += innovation_rad;
        let now = [self.gap_rad - self.used_s * rate_rad_s, rate_rad_s];
        self.used_s += within(self.wanted_s - self.used_s, -MOST_STEP_S, MOST_STEP_S);
        let [oldest, b, c, d] = self.levels;
        self.levels = [b, c, d, now];
        if self.scans < SCANS {
            self.scans += 1;
            return;
        }
        let change = oldest[1] - now[1];
        if change.abs() >= LEAST_CHANGE_RAD_S {
            self.take(usize::from(now[1].abs() < oldest[1].abs()), now[0] - oldest[0], change, config);
        }
    }

    /// Takes in a residual, radians, of turns that begin (0) or end (1): delay · change, rad/s.
    fn take(&mut self, phase: usize, residual_rad: f32, change_rad_s: f32, config: &DelayConfig) {
        let Some(phase) = self.phases.get_mut(phase) else { return };
        let off = (residual_rad - change_rad_s * phase.estimate(config).0).abs();
        // Neighbouring windows share most of their scans.
        let limit = KERNEL_SIGMAS * self.scale_rad;
        let weight = if off > limit { limit / off } else { 1.0 };
        let weight = weight / (SCANS as f32 * self.scale_rad * self.scale_rad);
        let kept = 1.0 - 1.0 / MEMORY;
        phase.information = kept * phase.information + weight * change_rad_s * change_rad_s;
        phase.weighted = kept * phase.weighted + weight * change_rad_s * residual_rad;
        // The mean size of a Gaussian is 0.8 σ. Wild ones do not widen it at once.
        self.scale_rad += (1.25 * min(off, 3.0 * self.scale_rad) - self.scale_rad) / SCALE_MEMORY;
        self.scale_rad = max(self.scale_rad, 1e-3);
        self.decide(config);
    }

    /// Whether it is used from now on.
    fn decide(&mut self, config: &DelayConfig) {
        let [begin, end] = &self.phases;
        let (begin, end) = (begin.estimate(config), end.estimate(config));
        let Delay { delay_s, sigma_s, used } = self.mean(begin, end, config);
        // In use, it stays so with half of what that took.
        let slack = if used { 2.0 } else { 1.0 };
        let agree = (begin.0 - end.0).abs() <= slack * MOST_DIFFERENCE * delay_s.abs();
        let significant = slack * delay_s.abs() >= config.significance * sigma_s;
        let is_used = sigma_s <= config.max_sigma_s && significant && agree;
        self.wanted_s = if is_used { delay_s } else { 0.0 };
    }

    /// A scan did not fix the pose, or left the odometry out: turns before and after it are not compared.
    pub fn interrupt(&mut self) {
        (self.scans, self.gap_rad) = (0, 0.0);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::vec::Vec;

    const CONFIG: DelayConfig =
        DelayConfig { sigma_s: 0.05, max_s: 0.1, max_sigma_s: 0.008, significance: 4.0 };
    /// Of the drive's samples, seconds.
    const STEP_S: f64 = 0.001;
    const SCAN_S: f64 = 0.1;

    /// Headings of scanner and odometry, in f64, sample by sample: turns of both signs, each a trapezoid of its turn rate, and
    /// between them straight on. `slip_rad` goes with the odometry's turn at every start.
    struct Drive {
        scanner: Vec<f64>,
        odometry: Vec<f64>,
    }

    impl Drive {
        fn new(turns: usize, scale: f64, slip_rad: impl Fn(usize) -> f64) -> Self {
            let (mut rate, mut heading, mut said) = (0.0f64, 0.0, 0.0);
            let mut drive = Self { scanner: Vec::new(), odometry: Vec::new() };
            for turn in 0..turns {
                let sign = if turn % 3 == 0 { -1.0 } else { 1.0 };
                let (top, lasts_s) = (0.7 + 0.1 * (turn % 6) as f64, 1.0 + 0.13 * (turn % 7) as f64);
                // Straight on, then the turn.
                for (wanted, lasts_s) in [(0.0, 1.47 + 0.11 * (turn % 5) as f64), (sign * top, lasts_s)] {
                    for k in 0..(lasts_s / STEP_S) as usize {
                        rate += (wanted - rate).clamp(-3.0 * STEP_S, 3.0 * STEP_S);
                        heading += rate * STEP_S;
                        said += rate * STEP_S * (1.0 + scale);
                        if wanted != 0.0 && k < 150 {
                            said += sign * slip_rad(turn) / 150.0;
                        }
                        drive.scanner.push(heading);
                        drive.odometry.push(said);
                    }
                }
            }
            drive
        }

        fn at(headings: &[f64], time_s: f64) -> f64 {
            headings[((time_s / STEP_S).max(0.0) as usize).min(headings.len() - 1)]
        }

        /// Scans that are stamped so late, and a scanner whose headings are as noisy as this.
        fn run(&self, late_s: f64, noise_rad: f64) -> DelayEstimator {
            use rand_core::{Rng, SeedableRng};
            let mut rng = rand_pcg::Pcg32::seed_from_u64(5);
            let mut gauss =
                || (0..12).map(|_| f64::from(rng.next_u32()) / f64::from(u32::MAX)).sum::<f64>() - 6.0;
            let mut estimator = DelayEstimator::default();
            let mut last: Option<[f64; 2]> = None;
            let scans = (self.scanner.len() as f64 * STEP_S / SCAN_S) as usize;
            for scan in 2..scans - 2 {
                let time_s = scan as f64 * SCAN_S;
                let looked_s = time_s + late_s - f64::from(estimator.used_s());
                let seen = Self::at(&self.scanner, time_s) + noise_rad * gauss();
                let said = Self::at(&self.odometry, looked_s);
                let half_s = RATE_WITHIN_US as f64 * 1e-6;
                let around = [looked_s - half_s, looked_s + half_s].map(|t| Self::at(&self.odometry, t));
                let rate = (around[1] - around[0]) / (2.0 * half_s);
                if let Some([seen_before, said_before]) = last {
                    let innovation = (seen - seen_before) - (said - said_before);
                    estimator.update(innovation as f32, rate as f32, &CONFIG);
                }
                last = Some([seen, said]);
            }
            estimator
        }
    }

    #[test]
    fn a_delay_is_found_and_used_and_none_is_not() {
        let drive = Drive::new(60, 0.0, |_| 0.0);
        for late_s in [0.04, -0.03, 0.09, 0.0] {
            let estimator = drive.run(late_s, 0.004);
            let delay = estimator.delay(&CONFIG);
            assert!((f64::from(delay.delay_s) - late_s).abs() < 0.008, "{late_s}: {delay:?}");
            assert_eq!(delay.used, late_s != 0.0, "{late_s}: {delay:?}");
            assert!((f64::from(delay.delay_s) - late_s).abs() < 3.0 * f64::from(delay.sigma_s), "{delay:?}");
        }
    }

    #[test]
    fn wheels_that_slip_at_starts_feign_none() {
        // Five degrees at each third start, and at all.
        for (share, slip_rad) in [(3, 0.087), (1, 0.03), (1, 0.087)] {
            let drive = Drive::new(60, 0.0, |turn| if turn % share == 0 { slip_rad } else { 0.0 });
            let delay = drive.run(0.0, 0.004).delay(&CONFIG);
            assert!(!delay.used, "{share} {slip_rad}: {delay:?}");
            if share > 1 {
                assert!(delay.delay_s.abs() < 0.008, "{delay:?}");
            }
        }
    }

    #[test]
    fn a_wrong_track_cancels_out_and_a_delay_beside_it_is_found() {
        for (scale, late_s) in [(0.05, 0.0), (-0.05, 0.0), (0.05, 0.04), (-0.05, -0.03)] {
            let delay = Drive::new(60, scale, |_| 0.0).run(late_s, 0.004).delay(&CONFIG);
            assert!((f64::from(delay.delay_s) - late_s).abs() < 0.008, "{scale} {late_s}: {delay:?}");
            assert_eq!(delay.used, late_s != 0.0, "{scale} {late_s}: {delay:?}");
        }
    }

    #[test]
    fn a_straight_drive_says_nothing() {
        let straight = Drive { scanner: Vec::from([0.0; 100_000]), odometry: Vec::from([0.0; 100_000]) };
        let delay = straight.run(0.05, 0.004).delay(&CONFIG);
        assert_eq!((delay.delay_s, delay.used), (0.0, false));
        assert!(delay.sigma_s > 0.7 * CONFIG.sigma_s);
    }

    #[test]
    fn numbers_that_are_not_finite_leave_it_as_it_is() {
        let mut estimator = Drive::new(60, 0.0, |_| 0.0).run(0.04, 0.004);
        let before = estimator.delay(&CONFIG);
        for (innovation, rate) in [(f32::NAN, 0.5), (0.1, f32::INFINITY)] {
            estimator.update(innovation, rate, &CONFIG);
        }
        assert_eq!(estimator.delay(&CONFIG), before);
    }
}
