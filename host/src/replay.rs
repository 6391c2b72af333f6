//! A log through the core: what the robot would have known, scan by scan.

mod follow;
mod run;

use std::time::Duration;

pub use follow::Agreement;
use nalgebra::Isometry2;
use run::TRACK;
pub use run::{Run, Taken};
use slam_core::capacity::{PLACES, SAMPLES, SEGMENTS};
use slam_core::config::ConfigError;
use slam_core::map::{MapCounters, MapSegment};
use slam_core::odometry::delay::Delay;
use slam_core::relocalisation::SearchState;
use slam_core::sensor::scan::SensorConfig;
use slam_core::slam::Counters;
use slam_core::{ScanMotion, Slam, SlamConfig, SlamUpdate};

use crate::log::Log;
use crate::map_file::{MapFile, MapFileError};
use crate::robot::Robot;

/// Map segments seen in fewer scans are not yet sure: drawn thin, and not judged.
pub const ESTABLISHED_HITS: u16 = 3;
/// Beams of the replayed `Slam` for a URG-04LX, for what has more, and at the most.
const URG_BEAMS: usize = 682;
const MANY_BEAMS: usize = 2048;
pub(crate) const MOST_BEAMS: usize = 8192;

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
    /// The system has no thread for it.
    #[error("cannot start a thread")]
    Thread(#[source] std::io::Error),
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
    /// How it compares with what the robot said, where that was followed.
    pub agreement: Option<Agreement>,
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
    /// Whether, of a recording of a robot, all is done again that was done to the robot: with its robot file the same bits come out.
    pub follows: bool,
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
    match run::beams(log) {
        ..=URG_BEAMS if start.follows && log.course.is_some() => {
            run_sized::<URG_BEAMS, SAMPLES>(start, log, robot, config, progress)
        }
        ..=URG_BEAMS => run_sized::<URG_BEAMS, TRACK>(start, log, robot, config, progress),
        beams if beams <= MANY_BEAMS => run_sized::<MANY_BEAMS, TRACK>(start, log, robot, config, progress),
        _ => run_sized::<MOST_BEAMS, TRACK>(start, log, robot, config, progress),
    }
}

fn run_sized<const BEAMS: usize, const K: usize>(
    start: &Start,
    log: &Log,
    robot: &Robot,
    config: SlamConfig,
    mut progress: impl FnMut(),
) -> Result<Replay, ReplayError> {
    let mut run = Run::<BEAMS, K>::new(start, log, robot, config)?;
    let mut steps: Vec<Step> = Vec::with_capacity(log.scans.len());
    let mut odometry = start.pose.unwrap_or_else(Isometry2::identity);
    let mut distance_m = 0.0;
    while let Some(Taken { scan, motion, update, took }) = run.step()? {
        odometry *= motion.since_previous.before_from_after;
        if update.closure.is_some() {
            let places = run.mapper.slam().places();
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
        let stamp_us = log.scans.get(scan).map_or(0, |scan| scan.stamp_us);
        let pose = update.pose;
        steps.push(Step { stamp_us, pose, pose_in_final_map: pose, odometry, update, motion, took });
        progress();
    }
    let (mapper, slam) = (&run.mapper, run.mapper.slam());
    Ok(Replay {
        steps,
        map_file: MapFile::of(slam),
        map: slam.walls().copied().collect(),
        local_map: slam.map().segments().to_vec(),
        map_counters: slam.map().counters(),
        counters: slam.counters(),
        slam_bytes: Slam::<SEGMENTS, BEAMS, PLACES>::BYTES,
        config: *run.config(),
        distance_m,
        impossible_steps: mapper.counters().impossible_steps as usize,
        delay: mapper.delay(),
        restarts_us: run.restarts_us().to_vec(),
        agreement: run.agreement(),
        robot: robot.clone(),
    })
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
