//! Simulated drives: a world, a base and a scanner, with the errors that real ones have, from one seed.
//!
//! The base follows its path; the scanner turns ten times a second and takes each beam where the robot is at that
//! instant. What comes out is the log that a robot's host would have written, and the truth. The same seed gives the
//! same log on every machine: all transcendental functions are `libm`'s.

pub mod base;
pub mod fixed_set;
pub mod judge;
pub mod scanner;
pub mod world;

use nalgebra::Isometry2;
use rand_pcg::Pcg64;
use serde::{Deserialize, Serialize};

use crate::log::{Log, LoggedScan, Odometry};
use crate::replay::ReplayError;
use crate::robot::Robot;
use base::Base;
use scanner::Scanner;
use world::World;

/// The world is stepped this often, microseconds.
const STEP_US: u64 = 1000;
/// A drive that has not ended by then ends anyway, microseconds.
const LONGEST_US: u64 = 3_600_000_000;
/// Stamp of the first scan, microseconds.
const FIRST_STAMP_US: u64 = 1_000_000;

/// What is wrong with the simulated robot. Every key can be set from the command line.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SimConfig {
    /// The base.
    pub wheel: WheelModel,
    /// The scanner.
    pub sensor: SensorModel,
}

/// Errors of the base.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct WheelModel {
    /// Relative error of both radii; the sign is the seed's.
    pub radius_error: f64,
    /// Relative difference between the radii; the sign is the seed's.
    pub radius_difference: f64,
    /// Relative error of the track; the sign is the seed's.
    pub track_error: f64,
    /// Random slip of each wheel, metres for each √metre.
    pub slip_m_per_sqrt_m: f64,
}

impl Default for WheelModel {
    fn default() -> Self {
        Self { radius_error: 0.01, radius_difference: 0.002, track_error: 0.02, slip_m_per_sqrt_m: 0.004 }
    }
}

/// Errors of the scanner.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SensorModel {
    /// Least standard deviation of a range, metres.
    pub sigma_m: f64,
    /// Standard deviation of a range as a share of it.
    pub sigma_per_m: f64,
    /// Uniform error on top, ± metres. The paper's ±30 mm: 0.03, with both sigmas zero.
    pub uniform_m: f64,
    /// Share of the beams that fail with an error code.
    pub dropout: f64,
    /// Share of the beams at edges that fall between both surfaces.
    pub mixed_pixels: f64,
    /// Surfaces seen flatter than this, as the cosine between beam and normal, fail with an error code.
    pub least_incidence: f64,
    /// Every so-manieth scan is missing; zero for none.
    pub skip_every: u32,
    /// Time from a scan's middle beam to its stamp and the ticks beside it, seconds.
    pub delay_s: f64,
}

impl Default for SensorModel {
    fn default() -> Self {
        Self {
            sigma_m: 0.01,
            sigma_per_m: 0.01,
            uniform_m: 0.0,
            dropout: 0.01,
            mixed_pixels: 0.3,
            least_incidence: 0.08,
            skip_every: 0,
            delay_s: 0.0,
        }
    }
}

/// A setting that cannot be made.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("--set {setting}: {reason}")]
pub struct BadSetting {
    /// As given.
    pub setting: String,
    /// What is wrong with it.
    pub reason: String,
}

impl SimConfig {
    /// Changes one value, given as `wheel.radius_error=0.01`.
    pub fn set(&mut self, setting: &str) -> Result<(), BadSetting> {
        let bad = |reason: String| BadSetting { setting: setting.to_owned(), reason };
        let (key, value) = setting.split_once('=').ok_or_else(|| bad("expected key=value".into()))?;
        let value: toml::Value = match value.parse::<f64>() {
            Ok(number) if number.is_finite() && number.fract() == 0.0 && key.ends_with("every") => {
                toml::Value::Integer(number as i64)
            }
            Ok(number) if number.is_finite() => toml::Value::Float(number),
            _ => return Err(bad(format!("'{value}' is not a number"))),
        };
        let mut all = toml::Table::try_from(*self).map_err(|e| bad(e.to_string()))?;
        let unknown = || bad(format!("there is no key '{key}'"));
        let (table, name) = key.split_once('.').ok_or_else(unknown)?;
        let slot = all.get_mut(table).and_then(toml::Value::as_table_mut).and_then(|t| t.get_mut(name));
        *slot.ok_or_else(unknown)? = value;
        let changed: Self = all.try_into().map_err(|e| bad(e.to_string()))?;
        changed.check().map_err(bad)?;
        *self = changed;
        Ok(())
    }
}

impl SimConfig {
    /// Says which value no robot can have.
    fn check(&self) -> Result<(), String> {
        let share = |name: &str, value: f64| {
            if (0.0..=1.0).contains(&value) { Ok(()) } else { Err(format!("{name} is not within 0 to 1")) }
        };
        let small = |name: &str, value: f64| {
            if value.abs() < 0.5 { Ok(()) } else { Err(format!("{name} is not within ±0.5")) }
        };
        let not_negative = |name: &str, value: f64| {
            if value >= 0.0 { Ok(()) } else { Err(format!("{name} is below zero")) }
        };
        small("wheel.radius_error", self.wheel.radius_error)?;
        small("wheel.radius_difference", self.wheel.radius_difference)?;
        small("wheel.track_error", self.wheel.track_error)?;
        not_negative("wheel.slip_m_per_sqrt_m", self.wheel.slip_m_per_sqrt_m)?;
        not_negative("sensor.sigma_m", self.sensor.sigma_m)?;
        not_negative("sensor.sigma_per_m", self.sensor.sigma_per_m)?;
        not_negative("sensor.uniform_m", self.sensor.uniform_m)?;
        share("sensor.dropout", self.sensor.dropout)?;
        share("sensor.mixed_pixels", self.sensor.mixed_pixels)?;
        share("sensor.least_incidence", self.sensor.least_incidence)?;
        not_negative("sensor.delay_s", self.sensor.delay_s)
    }
}

/// A simulated drive.
#[derive(Clone, Debug)]
pub struct Drive {
    /// What the robot's host recorded.
    pub log: Log,
    /// Pose of `base` in the blueprint's frame at each scan's middle beam.
    pub truth: Vec<Isometry2<f64>>,
    /// Wheel radii (left, right) and track as they really were, metres.
    pub true_wheels: ([f64; 2], f64),
}

/// Drives the world's path once.
pub fn drive(world: &World, robot: &Robot, sim: &SimConfig, seed: u64) -> Result<Drive, ReplayError> {
    let wheels = robot.wheels.ok_or_else(|| ReplayError::NoWheels { robot: robot.name.clone() })?;
    let sensor = robot.config().sensor;
    let geometry = sensor.geometry;
    let base_from_laser: Isometry2<f64> = nalgebra::convert(sensor.mounting.base_from_laser);
    let [base_rng, scanner_rng] = streams(seed);
    let mut base = Base::new(&world.path, wheels, &sim.wheel, base_rng);
    let mut scanner = Scanner::new(world, sim.sensor, geometry, scanner_rng);

    // Poses and ticks at every step so far.
    let mut poses = vec![base.pose];
    let mut ticks = vec![base.ticks()];
    let period_us = u64::from(geometry.revolution_us);
    let beam_us = f64::from(geometry.revolution_us) / f64::from(geometry.steps_per_revolution);
    let first_beam_us = f64::from(geometry.first_step) * beam_us;
    let middle_us = first_beam_us + 0.5 * geometry.sweep_us() as f64;
    let delay_us = (sim.sensor.delay_s * 1e6).round().max(0.0);
    let mut drive = Drive {
        log: Log { format: "simulated", commonest_beams: geometry.beams(), ..Log::default() },
        truth: Vec::new(),
        true_wheels: base.truth(),
    };
    for k in 0.. {
        let begin_us = k * period_us;
        let need_us = begin_us
            + (middle_us + delay_us).max(first_beam_us + geometry.sweep_us() as f64) as u64
            + STEP_US;
        while (poses.len() as u64 - 1) * STEP_US < need_us {
            base.step(STEP_US as f64 * 1e-6);
            poses.push(base.pose);
            ticks.push(base.ticks());
        }
        if begin_us > LONGEST_US || base.arrived() {
            break;
        }
        if sim.sensor.skip_every > 0 && (k + 1) % u64::from(sim.sensor.skip_every) == 0 {
            continue;
        }
        let at = |us: f64| interpolate(&poses, us / STEP_US as f64);
        let people = world.people_at((begin_us as f64 + middle_us) * 1e-6);
        let ranges_mm = scanner.scan(
            |beam| at(begin_us as f64 + first_beam_us + beam as f64 * beam_us) * base_from_laser,
            &people,
        );
        let stamped_us = begin_us + (middle_us + delay_us) as u64;
        let stamp_us = FIRST_STAMP_US + stamped_us;
        drive.truth.push(at(begin_us as f64 + middle_us));
        drive.log.odometry.push((stamp_us, Odometry::Ticks(ticks[(stamped_us / STEP_US) as usize])));
        drive.log.scans.push(LoggedScan { line: k as usize + 1, stamp_us, ranges_mm, geometry: None });
    }
    Ok(drive)
}

/// Random numbers for the base and for the scanner: a stream for each, so that one does not move the other.
pub fn streams(seed: u64) -> [Pcg64; 2] {
    [1, 2].map(|k| Pcg64::new(u128::from(seed).wrapping_mul(0x9E37_79B9_7F4A_7C15) + 1, k))
}

/// The pose at a fraction of a step.
pub fn interpolate(poses: &[Isometry2<f64>], step: f64) -> Isometry2<f64> {
    let index = (step.max(0.0) as usize).min(poses.len().saturating_sub(2));
    poses[index].lerp_slerp(&poses[index + 1], (step - index as f64).clamp(0.0, 1.0))
}
