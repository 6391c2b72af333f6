//! The loop of a replay: odometry and scans of a log go into the core in the order in which a robot would have had them.

use std::time::{Duration, Instant};

use slam_core::capacity::{PLACES, SEGMENTS};
use slam_core::config::ConfigError;
use slam_core::geometry::pose::pose;
use slam_core::odometry::{DifferentialDrive, Increment, OdometryNoise};
use slam_core::{Mapper, ScanMotion, SlamConfig, SlamUpdate, WheelTicks};

use super::follow::{Agreement, Followed, Follower};
use super::{MOST_BEAMS, ReplayError, Start};
use crate::log::{Log, Odometry};
use crate::robot::{Robot, Wheels};

/// Odometry samples held, which must span the sweep of a scan.
pub(super) const TRACK: usize = 256;
/// Where there is no odometry a robot of [unknown speed](slam_core::mapper::UNKNOWN_SPEED) makes the pose this unsure: between scans
/// 0.1 s apart by a decimetre and six degrees. Chosen on one log, of a scanner carried by hand (ccny_demo).
const UNKNOWN_MOTION: OdometryNoise = OdometryNoise {
    sigma_along_m_per_sqrt_m: 0.3,
    sigma_across_m_per_sqrt_m: 0.3,
    sigma_heading_rad_per_sqrt_m: 0.0,
    sigma_heading_rad_per_sqrt_rad: 0.3,
    sigma_position_floor_m: 0.05,
    sigma_heading_floor_rad: 0.02,
};
/// Stamps are moved by this, so that a delay cannot lead before zero.
const STAMP_OFFSET_US: u64 = 100_000_000;

/// Most beams of a scan.
pub(super) fn beams(log: &Log) -> usize {
    log.scans.iter().map(|s| s.ranges_mm.len()).max().unwrap_or(0)
}

/// A log on its way through the core, scan by scan. Room for `BEAMS` beams and `K` samples of the odometry.
pub struct Run<'a, const BEAMS: usize = MOST_BEAMS, const K: usize = TRACK> {
    log: &'a Log,
    robot: &'a Robot,
    config: SlamConfig,
    feed: OdometryFeed<'a>,
    next: usize,
    /// Where what was done to the robot that recorded the log is done again.
    follower: Option<Follower<'a>>,
    drive: Option<DifferentialDrive>,
    /// What the robot has aboard. Between scans it can be told what a robot can be told.
    pub mapper: Box<Mapper<SEGMENTS, K, BEAMS, PLACES>>,
}

/// What came of a scan.
#[derive(Clone, Debug)]
pub struct Taken {
    /// Its index in the log.
    pub scan: usize,
    /// How the robot moved for it, by odometry.
    pub motion: ScanMotion,
    /// All that the core said.
    pub update: SlamUpdate,
    /// Time the core took.
    pub took: Duration,
}

impl<'a, const BEAMS: usize, const K: usize> Run<'a, BEAMS, K> {
    /// Before the first scan.
    pub fn new(
        start: &Start,
        log: &'a Log,
        robot: &'a Robot,
        mut config: SlamConfig,
    ) -> Result<Self, ReplayError> {
        let beams = beams(log);
        if beams > MOST_BEAMS {
            let source = ConfigError::TooManyBeams { beams, capacity: MOST_BEAMS };
            return Err(ReplayError::Config { robot: robot.name.clone(), source });
        }
        robot.apply(&mut config, &log.layout(0));
        if log.odometry.is_empty() {
            config.odometry.noise = UNKNOWN_MOTION;
            (config.odometry.bias, config.odometry.delay) = (None, None);
        }
        let follower = log.course.as_ref().filter(|_| start.follows).map(Follower::new);
        let drive = match (&follower, robot.wheels.zip(robot.drive())) {
            // A robot counts in 32 bits itself.
            (Some(_), wheels) => wheels.map(|(_, drive)| drive),
            (None, wheels) => wheels.map(|(wheels, drive)| drive_of_counters(&wheels, drive)),
        };
        let mut mapper = new_mapper(robot, config, drive)?;
        if let Some(map) = &start.map {
            map.hand_to(&mut mapper, start.pose)?;
        }
        mapper.set_mapping(!start.frozen);
        let feed = OdometryFeed::new(log, robot)?;
        Ok(Self { log, robot, config, feed, next: 0, follower, drive, mapper })
    }

    /// The configuration that it began with, robot included.
    pub fn config(&self) -> &SlamConfig {
        &self.config
    }

    /// When both counters had been restarted so far, microseconds.
    pub fn restarts_us(&self) -> &[u64] {
        &self.feed.restarts_us
    }

    /// How what was followed so far compares with what the robot said, if that is done.
    pub fn agreement(&self) -> Option<Agreement> {
        self.follower.as_ref().map(Follower::agreement)
    }

    /// Stamp of the next scan, microseconds; `None` at the end.
    pub fn next_us(&self) -> Option<u64> {
        self.log.scans.get(self.next).map(|scan| scan.stamp_us)
    }

    /// Forgets map, pose and counters; the log goes on.
    pub fn forget(&mut self) -> Result<(), ReplayError> {
        self.mapper = new_mapper(self.robot, self.config, self.drive)?;
        Ok(())
    }

    /// Hands the next scan to the core, with the odometry up to there; `None` at the end.
    pub fn step(&mut self) -> Result<Option<Taken>, ReplayError> {
        if let Some(follower) = &mut self.follower {
            let anew = || new_mapper(self.robot, self.config, self.drive);
            while let Some(Followed { place, motion, update, took }) =
                follower.step(&mut self.mapper, anew)?
            {
                // One whose stamp was not later than the one before is not among them.
                let rest = self.log.scans.get(self.next..).unwrap_or_default();
                if let Some(ahead) = rest.iter().position(|scan| scan.line == place) {
                    let scan = self.next + ahead;
                    self.next = scan + 1;
                    return Ok(Some(Taken { scan, motion, update, took }));
                }
            }
            self.next = self.log.scans.len();
            return Ok(None);
        }
        let Some(scan) = self.log.scans.get(self.next) else { return Ok(None) };
        let index = self.next;
        self.next += 1;
        let mapper = &mut self.mapper;
        let sensor = self.robot.sensor_for(&self.log.layout(index));
        if sensor != mapper.slam().config().sensor {
            mapper.set_sensor(sensor).map_err(refused(self.robot))?;
        }
        let delay_us = (self.robot.sensor.scan_delay_s * 1e6).round() as i64;
        let middle_us = (scan.stamp_us + STAMP_OFFSET_US).saturating_add_signed(-delay_us);
        let until_us = mapper.wanted_until_us(middle_us);
        self.feed.advance(mapper, until_us);
        let motion = mapper.motion(middle_us).unwrap_or_else(|| mapper.unknown_motion(middle_us));
        let started = Instant::now();
        let update = mapper.scan_with(middle_us, &scan.ranges_mm, &motion);
        Ok(Some(Taken { scan: index, motion, update, took: started.elapsed() }))
    }
}

fn refused(robot: &Robot) -> impl FnOnce(ConfigError) -> ReplayError {
    |source| ReplayError::Config { robot: robot.name.clone(), source }
}

fn new_mapper<const BEAMS: usize, const K: usize>(
    robot: &Robot,
    config: SlamConfig,
    drive: Option<DifferentialDrive>,
) -> Result<Box<Mapper<SEGMENTS, K, BEAMS, PLACES>>, ReplayError> {
    Mapper::new(config, drive).map(Box::new).map_err(refused(robot))
}

/// The drive for counters handed over as [`counters`] does.
fn drive_of_counters(wheels: &Wheels, drive: DifferentialDrive) -> DifferentialDrive {
    let ticks_per_turn = drive.ticks_per_turn * 2.0f32.powi(unused_bits(wheels) as i32);
    DifferentialDrive { ticks_per_turn, ..drive }
}

/// Counters in the upper bits of 32, so that they wrap where the robot's do.
fn counters(wheels: &Wheels, ticks: [i64; 2]) -> [i32; 2] {
    ticks.map(|ticks| (ticks as i32) << unused_bits(wheels))
}

fn unused_bits(wheels: &Wheels) -> u32 {
    32 - u32::from(wheels.counter_bits)
}

/// Hands the log's odometry to the core, no further than needed.
struct OdometryFeed<'a> {
    rest: std::slice::Iter<'a, (u64, Odometry)>,
    last: Option<(u64, Odometry)>,
    wheels: Option<(Wheels, DifferentialDrive)>,
    restarts_us: Vec<u64>,
}

impl<'a> OdometryFeed<'a> {
    fn new(log: &'a Log, robot: &Robot) -> Result<Self, ReplayError> {
        let counts_wheels = log.odometry.iter().any(|(_, o)| !matches!(o, Odometry::Pose(_)));
        let wheels = robot.wheels.zip(robot.drive());
        if counts_wheels && wheels.is_none() {
            return Err(ReplayError::NoWheels { robot: robot.name.clone() });
        }
        Ok(Self { rest: log.odometry.iter(), last: None, wheels, restarts_us: Vec::new() })
    }

    /// Feeds samples until one lies at or after `until_us`.
    fn advance<const BEAMS: usize, const K: usize>(
        &mut self,
        mapper: &mut Mapper<SEGMENTS, K, BEAMS, PLACES>,
        until_us: u64,
    ) {
        while self.last.is_none_or(|(logged_us, _)| logged_us + STAMP_OFFSET_US < until_us)
            && let Some((logged_us, odometry)) = self.rest.next()
        {
            let stamp_us = logged_us + STAMP_OFFSET_US;
            let restarted = mapper.counters().counters_restarted;
            match (odometry, self.wheels) {
                (Odometry::Ticks(ticks), Some((wheels, _))) => {
                    let [left, right] = counters(&wheels, *ticks);
                    mapper.push(WheelTicks { stamp_us, left, right });
                }
                _ => mapper.push_motion(stamp_us, self.motion_to(odometry, mapper.slam().config())),
            }
            if mapper.counters().counters_restarted != restarted {
                self.restarts_us.push(*logged_us);
            }
            self.last = Some((*logged_us, *odometry));
        }
    }

    /// The motion since the last sample, by what does not count ticks.
    fn motion_to(&self, odometry: &Odometry, config: &SlamConfig) -> Increment {
        let last = self.last.map(|(_, odometry)| odometry);
        match (last, odometry, self.wheels) {
            (Some(Odometry::Angles(before)), Odometry::Angles(after), Some((wheels, drive))) => {
                let ticks_per_rad = f64::from(wheels.ticks_per_turn) / (2.0 * std::f64::consts::PI);
                let [left, right] = [0, 1].map(|side| ((after[side] - before[side]) * ticks_per_rad) as f32);
                drive.increment_of_parts(left, right, config.odometry.integration)
            }
            (Some(Odometry::Pose(before)), Odometry::Pose(after), _) => {
                let (s, c) = before[2].sin_cos();
                let (dx, dy) = (after[0] - before[0], after[1] - before[1]);
                let turn = after[2] - before[2];
                Increment::from_motion(pose(
                    (c * dx + s * dy) as f32,
                    (c * dy - s * dx) as f32,
                    turn.sin().atan2(turn.cos()) as f32,
                ))
            }
            _ => Increment::identity(),
        }
    }
}
