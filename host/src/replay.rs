//! A log through the core: what the robot would have known, scan by scan.

use std::time::{Duration, Instant};

use nalgebra::{Isometry2, Point2};
use slam_core::config::ConfigError;
use slam_core::map::{MapCounters, MapSegment};
use slam_core::odometry::Increment;
use slam_core::pose::pose;
use slam_core::slam::Counters;
use slam_core::{OdometryTrack, Scan, ScanMotion, Slam, SlamConfig, SlamUpdate};

use crate::log::{Log, Odometry};
use crate::robot::Robot;

/// Map segments of the replayed `Slam`: what the firmware has.
pub const MAP_SEGMENTS: usize = 512;
/// Map segments seen in fewer scans are not yet sure: drawn thin, and not judged.
pub const ESTABLISHED_HITS: u16 = 3;
/// Beams of the replayed `Slam` for a URG-04LX, and for anything with more.
const URG_BEAMS: usize = 682;
const MOST_BEAMS: usize = 2048;
/// Odometry samples held; a log has at most a few between two scans.
const TRACK: usize = 256;
/// Stamps are moved by this, so that a delay cannot lead before zero.
const STAMP_OFFSET_US: u64 = 100_000_000;

/// Why a log could not be replayed with a robot.
#[derive(Debug, thiserror::Error)]
pub enum ReplayError {
    /// The log counts ticks and the robot file has no wheels.
    #[error("the log counts wheel ticks, but robot '{robot}' has no [wheels]")]
    NoWheels {
        /// Name of the robot.
        robot: String,
    },
    /// No odometry record at all.
    #[error("the log has no odometry")]
    NoOdometry,
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
    /// Points of the scan in `base`.
    pub points: Vec<Point2<f32>>,
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
    /// Way driven by odometry, metres.
    pub distance_m: f64,
}

/// Runs a log through the core. `progress` is called after each scan.
pub fn run(
    log: &Log,
    robot: &Robot,
    config: SlamConfig,
    progress: impl FnMut(),
) -> Result<Replay, ReplayError> {
    let beams = log.scans.first().map_or(0, |s| s.ranges_mm.len());
    if beams > MOST_BEAMS {
        let source = ConfigError::TooManyBeams { beams, capacity: MOST_BEAMS };
        return Err(ReplayError::Config { robot: robot.name.clone(), source });
    }
    let mut config = config;
    robot.apply(&mut config, beams, log.stated.as_ref());
    if beams <= URG_BEAMS {
        run_sized::<URG_BEAMS>(log, robot, config, progress)
    } else {
        run_sized::<MOST_BEAMS>(log, robot, config, progress)
    }
}

fn run_sized<const BEAMS: usize>(
    log: &Log,
    robot: &Robot,
    config: SlamConfig,
    mut progress: impl FnMut(),
) -> Result<Replay, ReplayError> {
    let mut slam = Slam::<MAP_SEGMENTS, BEAMS>::new(config)
        .map_err(|source| ReplayError::Config { robot: robot.name.clone(), source })?;
    let mut feed = OdometryFeed::new(log, robot, &config)?;
    let delay_us = (robot.sensor.scan_delay_s * 1e6).round() as i64;
    let half_sweep_us = config.sensor.geometry.sweep_us() / 2;
    let mut steps = Vec::with_capacity(log.scans.len());
    let mut odometry = Isometry2::identity();
    let mut distance_m = 0.0;
    let mut previous_us = None;
    for scan in &log.scans {
        let middle_us = (scan.stamp_us + STAMP_OFFSET_US).saturating_add_signed(-delay_us);
        feed.advance(middle_us + half_sweep_us);
        let motion = feed
            .track
            .scan_motion(previous_us, middle_us, &config.sensor.geometry)
            .ok_or(ReplayError::NoOdometry)?;
        previous_us = Some(middle_us);
        let started = Instant::now();
        let update = slam.process_scan(&Scan { ranges_mm: &scan.ranges_mm }, &motion);
        let took = started.elapsed();
        odometry *= motion.since_previous.before_from_after;
        if let Some(closure) = &update.closure {
            for step in &mut steps {
                let step: &mut Step = step;
                step.pose_in_final_map = closure.bend(step.update.way_m) * step.pose_in_final_map;
            }
        }
        distance_m += f64::from(motion.since_previous.distance_m);
        steps.push(Step {
            stamp_us: scan.stamp_us,
            pose: update.pose,
            pose_in_final_map: update.pose,
            odometry,
            update,
            motion,
            took,
            points: slam.points().iter().map(|p| p.position).collect(),
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
    })
}

/// Hands the log's odometry to the core's track, no further than needed.
struct OdometryFeed<'a> {
    rest: std::slice::Iter<'a, (u64, Odometry)>,
    last: Option<Odometry>,
    robot: &'a Robot,
    config: &'a SlamConfig,
    track: OdometryTrack<TRACK>,
    fed_us: u64,
}

impl<'a> OdometryFeed<'a> {
    fn new(log: &'a Log, robot: &'a Robot, config: &'a SlamConfig) -> Result<Self, ReplayError> {
        let counts_ticks = log.odometry.iter().any(|(_, o)| matches!(o, Odometry::Ticks(_)));
        if counts_ticks && robot.wheels.is_none() {
            return Err(ReplayError::NoWheels { robot: robot.name.clone() });
        }
        let track = OdometryTrack::default();
        Ok(Self { rest: log.odometry.iter(), last: None, robot, config, track, fed_us: 0 })
    }

    /// Feeds samples until one lies at or after `until_us`.
    fn advance(&mut self, until_us: u64) {
        while self.fed_us < until_us
            && let Some((stamp_us, odometry)) = self.rest.next()
        {
            let step = self.last.map_or(Increment::identity(), |last| self.increment(last, *odometry));
            self.last = Some(*odometry);
            self.fed_us = stamp_us + STAMP_OFFSET_US;
            // The log's odometry is sorted and without equal stamps.
            let pushed = self.track.push(self.fed_us, step);
            debug_assert!(pushed.is_ok());
        }
    }

    fn increment(&self, before: Odometry, after: Odometry) -> Increment {
        match (before, after) {
            (Odometry::Ticks(before), Odometry::Ticks(after)) => {
                let Some((wheels, drive)) = self.robot.wheels.zip(self.robot.drive()) else {
                    return Increment::identity();
                };
                let [left, right] = wheels.ticks_between(before, after);
                drive.increment(left, right, self.config.odometry.integration)
            }
            (Odometry::Pose(before), Odometry::Pose(after)) => {
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

/// Stamps and poses by dead reckoning.
pub fn dead_reckoning(steps: &[Step]) -> impl Iterator<Item = (u64, &Isometry2<f32>)> {
    steps.iter().map(|s| (s.stamp_us, &s.odometry))
}
