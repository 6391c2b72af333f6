//! Simulated drives: a world, a base and a scanner, with the errors that real ones have, from one seed.
//!
//! [`SimKind::Ideal`] has errors that average out, [`SimKind::Real`] those that ordinary robots have besides. Each error has a stream
//! of random numbers of its own, so that one that is turned off does not move the others. Faults are events, and happen when asked
//! for.
//!
//! The base follows its path; the scanner turns ten times a second and takes each beam where the robot is at that
//! instant. What comes out is the log that a robot's host would have written, and the truth. The same seed gives the
//! same log on every machine: all transcendental functions are `libm`'s.

pub mod base;
pub mod bias;
pub mod clock;
pub mod config;
pub mod encoders;
pub mod fixed_set;
pub mod judge;
pub mod rays;
pub mod scanner;
pub mod settings;
pub mod slip;
pub mod streams;
pub mod surfaces;
pub mod things;
pub mod tilt;
pub mod world;

pub use config::{ClockModel, FaultModel, SensorModel, SimConfig, SimKind, WallModel, WheelModel};
pub use settings::BadSetting;

use nalgebra::Isometry2;
use serde::Serialize;

use crate::log::{Log, LoggedScan, Odometry};
use crate::replay::ReplayError;
use crate::robot::{Robot, Wheels};
use base::Base;
use clock::Clock;
use scanner::{Moment, Scanner};
use world::World;

/// The world is stepped this often, microseconds.
const STEP_US: u64 = 1000;
/// A drive that has not ended by then ends anyway, microseconds.
const LONGEST_US: f64 = 3.6e9;
/// Stamp of the first scan, microseconds.
const FIRST_STAMP_US: u64 = 1_000_000;

/// A simulated drive.
#[derive(Clone, Debug)]
pub struct Drive {
    /// What the robot's host recorded.
    pub log: Log,
    /// Pose of `base` in the blueprint's frame at each scan's middle beam.
    pub truth: Vec<Isometry2<f64>>,
    /// Wheel radii (left, right) and track as they really were, metres.
    pub true_wheels: ([f64; 2], f64),
    /// What was wrong with this unit.
    pub unit: UnitErrors,
}

/// Errors of one unit that stay as they are: no log tells all of them, and a map is right but for them.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct UnitErrors {
    /// Ranges of the warm scanner over true ranges, as the factor that fits best. A map is so much too large.
    pub range_scale: f64,
    /// True wheel radii (left, right) over the robot file's.
    pub radius_scale: [f64; 2],
    /// True track over the robot file's.
    pub track_scale: f64,
    /// Mean time from a scan's middle beam to its stamp, seconds.
    pub stamp_delay_s: f64,
}

impl UnitErrors {
    /// A unit that is as its files say, and one of which nothing is known.
    pub const NONE: Self =
        Self { range_scale: 1.0, radius_scale: [1.0; 2], track_scale: 1.0, stamp_delay_s: 0.0 };
}

/// Drives the world's path once.
pub fn drive(world: &World, robot: &Robot, sim: &SimConfig, seed: u64) -> Result<Drive, ReplayError> {
    let wheels = robot.wheels.ok_or_else(|| ReplayError::NoWheels { robot: robot.name.clone() })?;
    let geometry = robot.config().sensor.geometry;
    let mut base = Base::new(&world.path, wheels, sim, seed);
    let mut scanner = Scanner::new(world, robot, sim, seed);
    let mut clock = Clock::new(&sim.clock, seed);

    // What there was at every step so far.
    let mut track = Track::new(&base);
    let period_us = f64::from(geometry.revolution_us);
    let delay_us = (sim.sensor.delay_s * 1e6).round().max(0.0);
    let mut drive = Drive {
        log: Log { format: "simulated", commonest_beams: geometry.beams(), ..Log::default() },
        truth: Vec::new(),
        true_wheels: base.truth(),
        unit: unit_errors(&wheels, &base, &scanner, &clock, delay_us * 1e-6),
    };
    let mut begin_us = 0.0;
    for k in 0.. {
        let slower = clock.revolution(period_us * 1e-6);
        let beam_us = slower * period_us / f64::from(geometry.steps_per_revolution);
        let first_beam_us = f64::from(geometry.first_step) * beam_us;
        let sweep_us = slower * geometry.sweep_us() as f64;
        let middle_us = first_beam_us + 0.5 * sweep_us;
        let late_us = delay_us + clock.late_us();
        let need_us = begin_us as u64 + (middle_us + late_us).max(first_beam_us + sweep_us) as u64 + STEP_US;
        track.drive_to(&mut base, need_us);
        if begin_us > LONGEST_US || base.arrived() {
            break;
        }
        let this_us = begin_us;
        begin_us += (slower * period_us).round();
        if sim.sensor.skip_every > 0 && (k + 1) % u64::from(sim.sensor.skip_every) == 0 {
            continue;
        }
        let time_s = (this_us + middle_us) * 1e-6;
        let ranges_mm = scanner.scan(
            |beam| track.pose(this_us + first_beam_us + beam as f64 * beam_us),
            &world.people_at(time_s),
            Moment { time_s, carried: track.carried(this_us + middle_us) },
        );
        let stamped_us = clock.ordered(this_us as u64 + (middle_us + late_us).max(0.0) as u64);
        track.drive_to(&mut base, stamped_us + STEP_US);
        let stamp_us = FIRST_STAMP_US + stamped_us;
        drive.truth.push(track.pose(this_us + middle_us));
        drive.log.odometry.push((stamp_us, Odometry::Ticks(track.ticks[(stamped_us / STEP_US) as usize])));
        drive.log.scans.push(LoggedScan { line: k as usize + 1, stamp_us, ranges_mm, geometry: None });
    }
    Ok(drive)
}

fn unit_errors(wheels: &Wheels, base: &Base, scanner: &Scanner, clock: &Clock, delay_s: f64) -> UnitErrors {
    let ([left, right], track) = base.truth();
    UnitErrors {
        range_scale: scanner.range_scale(),
        radius_scale: [left / f64::from(wheels.left_radius_m), right / f64::from(wheels.right_radius_m)],
        track_scale: track / f64::from(wheels.track_m),
        stamp_delay_s: delay_s + clock.mean_late_s(),
    }
}

/// A drive so far, step by step.
struct Track {
    poses: Vec<Isometry2<f64>>,
    ticks: Vec<[i64; 2]>,
    carried: Vec<bool>,
}

impl Track {
    fn new(base: &Base) -> Self {
        Self { poses: vec![base.pose], ticks: vec![base.ticks()], carried: vec![false] }
    }

    fn drive_to(&mut self, base: &mut Base, us: u64) {
        while (self.poses.len() as u64 - 1) * STEP_US < us {
            base.step(STEP_US as f64 * 1e-6);
            self.poses.push(base.pose);
            self.ticks.push(base.ticks());
            self.carried.push(base.is_carried());
        }
    }

    fn pose(&self, us: f64) -> Isometry2<f64> {
        interpolate(&self.poses, us / STEP_US as f64)
    }

    fn carried(&self, us: f64) -> bool {
        self.carried.get((us / STEP_US as f64) as usize).copied().unwrap_or(false)
    }
}

/// The pose at a fraction of a step.
pub fn interpolate(poses: &[Isometry2<f64>], step: f64) -> Isometry2<f64> {
    let index = (step.max(0.0) as usize).min(poses.len().saturating_sub(2));
    poses[index].lerp_slerp(&poses[index + 1], (step - index as f64).clamp(0.0, 1.0))
}
