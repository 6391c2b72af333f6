//! A log through the core: what the robot would have known, scan by scan.

use std::time::{Duration, Instant};

use nalgebra::Isometry2;
use slam_core::config::ConfigError;
use slam_core::geometry::pose::pose;
use slam_core::map::{MapCounters, MapSegment};
use slam_core::odometry::delay::Delay;
use slam_core::odometry::{DifferentialDrive, Increment, OdometryNoise};
use slam_core::relocalisation::SearchState;
use slam_core::sensor::scan::SensorConfig;
use slam_core::slam::Counters;
use slam_core::{Mapper, ScanMotion, Slam, SlamConfig, SlamUpdate, WheelTicks};

use crate::log::{Log, Odometry};
use crate::map_file::{MapFile, MapFileError};
use crate::robot::{Robot, Wheels};

/// Map segments and places of the replayed `Slam`: what the firmware has.
pub const MAP_SEGMENTS: usize = 1024;
const PLACES: usize = 256;
/// Map segments seen in fewer scans are not yet sure: drawn thin, and not judged.
pub const ESTABLISHED_HITS: u16 = 3;
/// Beams of the replayed `Slam` for a URG-04LX, for what has more, and at the most.
const URG_BEAMS: usize = 682;
const MANY_BEAMS: usize = 2048;
pub(crate) const MOST_BEAMS: usize = 8192;
/// Odometry samples held, which must span the sweep of a scan.
const TRACK: usize = 256;
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

/// Why a log could not be replayed with a robot.
#[derive(Debug, thiserror::Error)]
pub enum ReplayError {
    /// The log counts ticks and the robot file has no wheels.
    #[error(
        "the log counts wheel ticks, but robot '{robot}' has no [wheels]: give a robot file that has, with --robot"
    )]
    NoWheels {
        /// Name of the robot.
        robot: String,
    },
    /// The map to begin in cannot be used.
    #[error(transparent)]
    Map(#[from] MapFileError),
    /// Robot and configuration do not make sense together.
    #[error("robot '{robot}'")]
    Config {
        /// Name of the robot.
        robot: String,
        /// What the core said.
        source: ConfigError,
    },
}

/// One scan's outcome.
#[derive(Clone, Debug)]
pub struct Step {
    /// Stamp as logged, microseconds.
    pub stamp_us: u64,
    /// Pose of `base` in `map` at the middle beam, as the robot knew it then.
    pub pose: Isometry2<f32>,
    /// The same pose in the final map: loops closed later have moved it with the walls around it.
    pub pose_in_final_map: Isometry2<f32>,
    /// Dead reckoning: pose of `base` in `odom`, which agrees with `map` at the first scan.
    pub odometry: Isometry2<f32>,
    /// All that the core said.
    pub update: SlamUpdate,
    /// How the robot moved for it, by odometry.
    pub motion: ScanMotion,
    /// Time the core took.
    pub took: Duration,
}

/// A replayed log.
#[derive(Debug)]
pub struct Replay {
    /// Scan by scan.
    pub steps: Vec<Step>,
    /// All that is known of the building at the end, to be loaded again.
    pub map_file: MapFile,
    /// The map at the end: its walls.
    pub map: Vec<MapSegment>,
    /// The same with all that is tentative, as the front end has it.
    pub local_map: Vec<MapSegment>,
    /// The map's counters.
    pub map_counters: MapCounters,
    /// The core's counters.
    pub counters: Counters,
    /// Size of the `Slam` that was used, bytes.
    pub slam_bytes: usize,
    /// The configuration, robot included.
    pub config: SlamConfig,
    /// Way driven by odometry, or without any by the scanner, metres.
    pub distance_m: f64,
    /// Steps of the odometry that no robot can make; they were taken as none.
    pub impossible_steps: usize,
    /// When both counters had been restarted, microseconds.
    pub restarts_us: Vec<u64>,
    /// By how much scans were stamped late, beyond what the robot file says.
    pub delay: Option<Delay>,
    /// The robot.
    pub robot: Robot,
}

impl Replay {
    /// The scanner as it was for a scan of the log.
    pub fn sensor_of(&self, log: &Log, scan: usize) -> SensorConfig {
        self.robot.sensor_for(&log.layout(scan))
    }
}

/// Where a robot begins.
#[derive(Clone, Debug, Default)]
pub struct Start {
    /// In this map; else in an empty one.
    pub map: Option<MapFile>,
    /// At this pose in it; else it looks for itself.
    pub pose: Option<Isometry2<f32>>,
    /// Whether the map stays as it is.
    pub frozen: bool,
}

/// Runs a log through the core. `progress` is called after each scan.
pub fn run(
    log: &Log,
    robot: &Robot,
    config: SlamConfig,
    progress: impl FnMut(),
) -> Result<Replay, ReplayError> {
    run_from(&Start::default(), log, robot, config, progress)
}

/// The same in a map that there is already.
pub fn run_from(
    start: &Start,
    log: &Log,
    robot: &Robot,
    config: SlamConfig,
    progress: impl FnMut(),
) -> Result<Replay, ReplayError> {
    let beams = log.scans.iter().map(|s| s.ranges_mm.len()).max().unwrap_or(0);
    let mut config = config;
    robot.apply(&mut config, &log.layout(0));
    if log.odometry.is_empty() {
        config.odometry.noise = UNKNOWN_MOTION;
        (config.odometry.bias, config.odometry.delay) = (None, None);
    }
    match beams {
        ..=URG_BEAMS => run_sized::<URG_BEAMS>(start, log, robot, config, progress),
        _ if beams <= MANY_BEAMS => run_sized::<MANY_BEAMS>(start, log, robot, config, progress),
        _ if beams <= MOST_BEAMS => run_sized::<MOST_BEAMS>(start, log, robot, config, progress),
        _ => {
            let source = ConfigError::TooManyBeams { beams, capacity: MOST_BEAMS };
            Err(ReplayError::Config { robot: robot.name.clone(), source })
        }
    }
}

fn run_sized<const BEAMS: usize>(
    start: &Start,
    log: &Log,
    robot: &Robot,
    config: SlamConfig,
    mut progress: impl FnMut(),
) -> Result<Replay, ReplayError> {
    let refused = |source| ReplayError::Config { robot: robot.name.clone(), source };
    let wheels = robot.wheels.zip(robot.drive());
    let drive = wheels.map(|(wheels, drive)| drive_of_counters(&wheels, drive));
    let mut mapper = Mapper::<MAP_SEGMENTS, TRACK, BEAMS, PLACES>::new(config, drive).map_err(refused)?;
    if let Some(map) = &start.map {
        map.hand_to(&mut mapper, start.pose)?;
    }
    mapper.set_mapping(!start.frozen);
    let mut feed = OdometryFeed::new(log, robot)?;
    let delay_us = (robot.sensor.scan_delay_s * 1e6).round() as i64;
    let mut steps: Vec<Step> = Vec::with_capacity(log.scans.len());
    let mut odometry = start.pose.unwrap_or_else(Isometry2::identity);
    let mut distance_m = 0.0;
    for (k, scan) in log.scans.iter().enumerate() {
        let sensor = robot.sensor_for(&log.layout(k));
        if sensor != mapper.slam().config().sensor {
            mapper.set_sensor(sensor).map_err(refused)?;
        }
        let middle_us = (scan.stamp_us + STAMP_OFFSET_US).saturating_add_signed(-delay_us);
        let until_us = mapper.wanted_until_us(middle_us);
        feed.advance(&mut mapper, until_us);
        let motion = mapper.motion(middle_us).unwrap_or_else(|| mapper.unknown_motion(middle_us));
        let started = Instant::now();
        let update = mapper.scan_with(middle_us, &scan.ranges_mm, &motion);
        let took = started.elapsed();
        odometry *= motion.since_previous.before_from_after;
        if update.closure.is_some() {
            let places = mapper.slam().places();
            for step in &mut steps {
                step.pose_in_final_map = places.moved_pose(step.update.way_m, &step.pose_in_final_map);
            }
        }
        let has_jumped = update.relocalisation.is_some_and(|r| r.state == SearchState::Found);
        distance_m += match steps.last().filter(|_| !has_jumped) {
            // Without odometry as far as the scanner says.
            Some(before) if log.odometry.is_empty() => {
                f64::from((update.pose.translation.vector - before.pose.translation.vector).norm())
            }
            _ if log.odometry.is_empty() => 0.0,
            _ => f64::from(motion.since_previous.distance_m),
        };
        steps.push(Step {
            stamp_us: scan.stamp_us,
            pose: update.pose,
            pose_in_final_map: update.pose,
            odometry,
            update,
            motion,
            took,
        });
        progress();
    }
    let slam = mapper.slam();
    Ok(Replay {
        steps,
        map_file: MapFile::of(slam),
        map: slam.walls().copied().collect(),
        local_map: slam.map().segments().to_vec(),
        map_counters: slam.map().counters(),
        counters: slam.counters(),
        slam_bytes: Slam::<MAP_SEGMENTS, BEAMS, PLACES>::BYTES,
        config,
        distance_m,
        impossible_steps: mapper.counters().impossible_steps as usize,
        restarts_us: feed.restarts_us,
        delay: mapper.delay(),
        robot: robot.clone(),
    })
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
    fn advance<const BEAMS: usize>(
        &mut self,
        mapper: &mut Mapper<MAP_SEGMENTS, TRACK, BEAMS, PLACES>,
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

/// Stamps and poses of a replay, for writing and scoring.
pub fn trajectory(steps: &[Step]) -> impl Iterator<Item = (u64, &Isometry2<f32>)> {
    steps.iter().map(|s| (s.stamp_us, &s.pose))
}

/// Stamps and poses as they are in the final map.
pub fn final_trajectory(steps: &[Step]) -> impl Iterator<Item = (u64, &Isometry2<f32>)> {
    steps.iter().map(|s| (s.stamp_us, &s.pose_in_final_map))
}

/// Stamps and poses by dead reckoning.
pub fn dead_reckoning(steps: &[Step]) -> impl Iterator<Item = (u64, &Isometry2<f32>)> {
    steps.iter().map(|s| (s.stamp_us, &s.odometry))
}
