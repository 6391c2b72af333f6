//! A log through the core: what the robot would have known, scan by scan.

use std::time::{Duration, Instant};

use nalgebra::Isometry2;
use slam_core::config::ConfigError;
use slam_core::geometry::pose::pose;
use slam_core::map::{MapCounters, MapSegment};
use slam_core::odometry::{Increment, OdometryNoise};
use slam_core::sensor::scan::{ScanGeometry, SensorConfig};
use slam_core::slam::Counters;
use slam_core::{OdometryTrack, Scan, ScanMotion, Slam, SlamConfig, SlamUpdate};

use crate::log::{LEAST_JUMP_M, Log, MOST_SPEED, Odometry};
use crate::robot::Robot;

/// Map segments of the replayed `Slam`: what the firmware has.
pub const MAP_SEGMENTS: usize = 512;
/// Map segments seen in fewer scans are not yet sure: drawn thin, and not judged.
pub const ESTABLISHED_HITS: u16 = 3;
/// Beams of the replayed `Slam` for a URG-04LX, for what has more, and at the most.
const URG_BEAMS: usize = 682;
const MANY_BEAMS: usize = 2048;
pub(crate) const MOST_BEAMS: usize = 8192;
/// Odometry samples held, which must span the sweep of a scan.
const TRACK: usize = 256;
/// Where there is no odometry the robot may move this fast, m/s and rad/s, …
const UNKNOWN_SPEED: [f32; 2] = [0.5, 1.0];
/// … which makes the pose this unsure: between scans 0.1 s apart by a decimetre and six degrees. Chosen on one log, of a scanner
/// carried by hand (ccny_demo).
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
    /// The map at the end.
    pub map: Vec<MapSegment>,
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
    /// The robot.
    pub robot: Robot,
}

impl Replay {
    /// The scanner as it was for a scan of the log.
    pub fn sensor_of(&self, log: &Log, scan: usize) -> SensorConfig {
        self.robot.sensor_for(&log.layout(scan))
    }
}

/// Runs a log through the core. `progress` is called after each scan.
pub fn run(
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
        config.odometry.bias = None;
    }
    match beams {
        ..=URG_BEAMS => run_sized::<URG_BEAMS>(log, robot, config, progress),
        _ if beams <= MANY_BEAMS => run_sized::<MANY_BEAMS>(log, robot, config, progress),
        _ if beams <= MOST_BEAMS => run_sized::<MOST_BEAMS>(log, robot, config, progress),
        _ => {
            let source = ConfigError::TooManyBeams { beams, capacity: MOST_BEAMS };
            Err(ReplayError::Config { robot: robot.name.clone(), source })
        }
    }
}

fn run_sized<const BEAMS: usize>(
    log: &Log,
    robot: &Robot,
    config: SlamConfig,
    mut progress: impl FnMut(),
) -> Result<Replay, ReplayError> {
    let refused = |source| ReplayError::Config { robot: robot.name.clone(), source };
    let mut slam = Slam::<MAP_SEGMENTS, BEAMS>::new(config).map_err(refused)?;
    let mut feed = OdometryFeed::new(log, robot, &config)?;
    let delay_us = (robot.sensor.scan_delay_s * 1e6).round() as i64;
    let mut steps: Vec<Step> = Vec::with_capacity(log.scans.len());
    let mut odometry = Isometry2::identity();
    let mut distance_m = 0.0;
    for (k, scan) in log.scans.iter().enumerate() {
        let sensor = robot.sensor_for(&log.layout(k));
        if sensor != slam.config().sensor {
            slam.set_sensor(sensor).map_err(refused)?;
        }
        let middle_us = (scan.stamp_us + STAMP_OFFSET_US).saturating_add_signed(-delay_us);
        let motion = feed.motion(middle_us, &sensor.geometry);
        let started = Instant::now();
        let update = slam.process_scan(&Scan { ranges_mm: &scan.ranges_mm }, &motion);
        let took = started.elapsed();
        odometry *= motion.since_previous.before_from_after;
        if let Some(closure) = &update.closure {
            for step in &mut steps {
                step.pose_in_final_map = closure.bend(step.update.way_m) * step.pose_in_final_map;
            }
        }
        distance_m += match steps.last() {
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
    Ok(Replay {
        steps,
        map: slam.map().segments().to_vec(),
        map_counters: slam.map().counters(),
        counters: slam.counters(),
        slam_bytes: Slam::<MAP_SEGMENTS, BEAMS>::BYTES,
        config,
        distance_m,
        impossible_steps: feed.impossible_steps,
        restarts_us: feed.restarts_us,
        robot: robot.clone(),
    })
}

/// Hands the log's odometry to the core's track, no further than needed, and tells the motion of each scan.
struct OdometryFeed<'a> {
    rest: std::slice::Iter<'a, (u64, Odometry)>,
    last: Option<(u64, Odometry)>,
    robot: &'a Robot,
    config: &'a SlamConfig,
    track: OdometryTrack<TRACK>,
    /// Where the motion of the next scan begins: at the scan before, …
    from_us: Option<u64>,
    /// … but for what was taken out of the track before it could be overwritten.
    carried: Option<Increment>,
    /// Samples fed since then.
    since: usize,
    impossible_steps: usize,
    restarts_us: Vec<u64>,
}

impl<'a> OdometryFeed<'a> {
    fn new(log: &'a Log, robot: &'a Robot, config: &'a SlamConfig) -> Result<Self, ReplayError> {
        let counts_wheels = log.odometry.iter().any(|(_, o)| !matches!(o, Odometry::Pose(_)));
        if counts_wheels && robot.wheels.is_none() {
            return Err(ReplayError::NoWheels { robot: robot.name.clone() });
        }
        let track = OdometryTrack::default();
        Ok(Self {
            rest: log.odometry.iter(),
            last: None,
            robot,
            config,
            track,
            from_us: None,
            carried: None,
            since: 0,
            impossible_steps: 0,
            restarts_us: Vec::new(),
        })
    }

    /// The motion for a scan whose middle beam was taken at `middle_us`. Without any odometry all that is known is how far the
    /// robot may have moved.
    fn motion(&mut self, middle_us: u64, geometry: &ScanGeometry) -> ScanMotion {
        let half_sweep_us = geometry.sweep_us() / 2;
        self.advance(middle_us + half_sweep_us, middle_us.saturating_sub(half_sweep_us));
        let Some(mut motion) = self.track.scan_motion(self.from_us, middle_us, geometry) else {
            let since_us =
                self.from_us.replace(middle_us).map_or(0, |from_us| middle_us.saturating_sub(from_us));
            let [distance_m, turn_rad] = UNKNOWN_SPEED.map(|speed| speed * since_us as f32 * 1e-6);
            return ScanMotion::instantaneous(Increment { distance_m, turn_rad, ..Increment::identity() });
        };
        if let Some(carried) = self.carried.take() {
            motion.since_previous = carried.then(&motion.since_previous);
        }
        (self.from_us, self.since) = (Some(middle_us), 0);
        motion
    }

    /// Feeds samples until one lies at or after `until_us`. The poses from `sweep_us` on stay in the track.
    fn advance(&mut self, until_us: u64, sweep_us: u64) {
        while self.last.is_none_or(|(fed_us, _)| fed_us < until_us)
            && let Some((stamp_us, odometry)) = self.rest.next()
        {
            let stamp_us = stamp_us + STAMP_OFFSET_US;
            let step =
                self.last.map_or(Increment::identity(), |last| self.increment(last, (stamp_us, *odometry)));
            self.last = Some((stamp_us, *odometry));
            // The log's odometry is sorted and without equal stamps.
            let pushed = self.track.push(stamp_us, step);
            debug_assert!(pushed.is_ok());
            self.since += 1;
            // Before the track forgets where the motion begins.
            if self.since >= TRACK / 2
                && let Some(from_us) =
                    self.from_us.filter(|from_us| (*from_us..=sweep_us).contains(&stamp_us))
                && let Some(motion) = self.track.between(from_us, stamp_us)
            {
                self.carried = Some(self.carried.map_or(motion, |carried| carried.then(&motion)));
                (self.from_us, self.since) = (Some(stamp_us), 0);
            }
        }
    }

    fn increment(&mut self, before: (u64, Odometry), after: (u64, Odometry)) -> Increment {
        let step = self.step(before.1, after.1);
        if let (Odometry::Ticks(from), Odometry::Ticks(to), Some((wheels, drive))) =
            (before.1, after.1, self.robot.wheels.zip(self.robot.drive()))
        {
            let possible = |ticks: [i32; 2]| drive.is_possible(ticks[0], ticks[1], after.0 - before.0);
            if possible(wheels.ticks_between(from, to)) {
                return step;
            }
            if possible(wheels.ticks_between([0, 0], to)) {
                self.restarts_us.push(after.0 - STAMP_OFFSET_US);
            }
            self.impossible_steps += 1;
            return Increment::identity();
        }
        let most_m = LEAST_JUMP_M + MOST_SPEED * (after.0 - before.0) as f64 * 1e-6;
        if f64::from(step.distance_m) <= most_m {
            return step;
        }
        self.impossible_steps += 1;
        Increment::identity()
    }

    fn step(&self, before: Odometry, after: Odometry) -> Increment {
        let integration = self.config.odometry.integration;
        match (before, after, self.robot.wheels.zip(self.robot.drive())) {
            (Odometry::Ticks(before), Odometry::Ticks(after), Some((wheels, drive))) => {
                let [left, right] = wheels.ticks_between(before, after);
                drive.increment(left, right, integration)
            }
            (Odometry::Angles(before), Odometry::Angles(after), Some((wheels, drive))) => {
                let ticks_per_rad = f64::from(wheels.ticks_per_turn) / (2.0 * std::f64::consts::PI);
                let [left, right] = [0, 1].map(|side| ((after[side] - before[side]) * ticks_per_rad) as f32);
                drive.increment_of_parts(left, right, integration)
            }
            (Odometry::Pose(before), Odometry::Pose(after), _) => {
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
