//! One log: replayed, timed and scored.

use std::error::Error;
use std::path::{Path, PathBuf};
use std::time::Duration;

use slam_core::SlamConfig;

use super::firmness::{Firmness, Noise, firmness};
use super::walls::{Walls, walls};
use super::{Container, Found, Row, figure};
use crate::log::{self, Log, ReadOptions};
use crate::replay::{self, Replay};
use crate::score::{
    self, Relation, RelationErrors, ScoreError, StampedPose, at_laser, read_relations, read_tum, span_s,
};

/// The same of each of a replay's trajectories.
#[derive(Clone, Copy, Debug)]
pub struct Poses<T> {
    /// By the wheels alone.
    pub dead_reckoning: T,
    /// As the robot knew them when each scan was taken.
    pub online: T,
    /// In the final map: loops closed later have moved them.
    pub in_final_map: T,
}

impl<T> Poses<T> {
    /// Online, in the final map, dead reckoning.
    pub fn all(&self) -> [&T; 3] {
        [&self.online, &self.in_final_map, &self.dead_reckoning]
    }

    fn try_map<U>(&self, of: impl Fn(&T) -> Option<U>) -> Option<Poses<U>> {
        Some(Poses {
            dead_reckoning: of(&self.dead_reckoning)?,
            online: of(&self.online)?,
            in_final_map: of(&self.in_final_map)?,
        })
    }
}

/// What a reference says.
#[derive(Clone, Debug)]
pub struct ByReference {
    /// Absolute trajectory error, rmse, metres.
    pub ate_rmse_m: Poses<f64>,
    /// Walls of the scans laid by the poses as the robot knew them.
    pub online_walls: Walls,
    /// The same of the poses in the final map.
    pub final_walls: Walls,
    /// The same of the reference's poses.
    pub reference_walls: Walls,
}

/// What relations say.
#[derive(Clone, Debug)]
pub struct ByRelations {
    /// How far ahead of the robot's centre the relations' frame is, metres.
    pub laser_m: f64,
    /// Their errors.
    pub errors: Poses<RelationErrors>,
    /// Whether others publish figures on this very log: it has the odometry that the robot had.
    pub published: bool,
}

/// What was measured on a log.
#[derive(Clone, Debug)]
pub struct Measured {
    /// Scans replayed.
    pub scans: usize,
    /// Records passed over.
    pub skipped: usize,
    /// Way driven, by odometry, metres.
    pub distance_m: f64,
    /// Loops closed.
    pub loops_closed: u32,
    /// Time that the core took for all scans.
    pub took: Duration,
    /// RAM of the core, bytes.
    pub slam_bytes: usize,
    /// By the reference, where there is one.
    pub reference: Option<ByReference>,
    /// By relations, where there are any.
    pub relations: Option<ByRelations>,
    /// What becomes of its main measure with noise, where that was asked for.
    pub firmness: Option<Firmness>,
    /// Picture of the map.
    pub figure: String,
}

impl Measured {
    /// Scans that the core takes in a second.
    pub fn scans_per_s(&self) -> f64 {
        self.scans as f64 / self.took.as_secs_f64()
    }
}

/// Replays and scores a log, and again with noise where that is asked for. `data` is left out of what is said of files.
pub fn measure(found: Found, data: &Path, noise: &Noise) -> Row {
    let mut remarks = Vec::new();
    if !found.same.is_empty() {
        remarks.push(format!(
            "the same log as {}, which {} left out",
            found.same.join(", "),
            match found.same[..] {
                [_] => "is",
                _ => "are",
            }
        ));
    }
    let outcome = replayed(&found, noise, &mut remarks).map_err(|error| whole(&*error));
    let shown = |text: String| {
        let folder = format!("{}/", data.display().to_string().trim_end_matches('/'));
        text.replace(&folder, "").split_whitespace().collect::<Vec<_>>().join(" ")
    };
    Row { found, outcome: outcome.map_err(shown), remarks: remarks.into_iter().map(shown).collect() }
}

/// An error with all that caused it.
fn whole(error: &(dyn Error + 'static)) -> String {
    let mut text = error.to_string();
    let mut cause = error.source();
    while let Some(error) = cause {
        text = format!("{text}: {error}");
        cause = error.source();
    }
    text
}

fn replayed(found: &Found, noise: &Noise, remarks: &mut Vec<String>) -> Result<Measured, Box<dyn Error>> {
    let log = log::read(&found.path, &ReadOptions::default())?;
    remarks.extend(log.warnings.iter().map(|w| w.message.clone()));
    let robot = log.usual_robot();
    let replay = replay::run(&log, &robot, SlamConfig::default(), || {})?;
    let poses = Poses {
        dead_reckoning: stamped(&replay, |s| &s.odometry),
        online: stamped(&replay, |s| &s.pose),
        in_final_map: stamped(&replay, |s| &s.pose_in_final_map),
    };
    let reference = found.reference.as_deref().and_then(|path| {
        let reference = said(read_tum(path), remarks)?;
        let scored = by_reference(&log, &replay, &poses, &reference);
        if scored.is_none() {
            remarks.push(format!("{} is of another time", path.display()));
        }
        Some((scored?, reference))
    });
    let relations = fitting(&found.relations, &poses.online, remarks);
    let trajectory = reference.as_ref().map(|(_, trajectory)| trajectory.as_slice());
    // Relations were checked by hand; references have errors of their own.
    let (measure, main): (_, MainMeasure<'_>) = match (&relations, trajectory) {
        (Some(relations), _) => ("relations, m", &|r| final_relation_error_m(found, r, relations)),
        (None, Some(trajectory)) => ("ATE, m", &|r| {
            score::absolute_trajectory_error(&stamped(r, |s| &s.pose_in_final_map), trajectory)
        }),
        (None, None) => ("", &|_| None),
    };
    let firmness = match main(&replay) {
        Some(plain_m) if noise.runs > 0 => firmness((&log, &robot), noise, measure, plain_m, main)?,
        _ => None,
    };
    Ok(Measured {
        scans: replay.steps.len(),
        skipped: log.skipped.values().sum(),
        distance_m: replay.distance_m,
        loops_closed: replay.counters.loops_closed,
        took: replay.steps.iter().map(|s| s.took).sum(),
        slam_bytes: replay.slam_bytes,
        relations: relations.and_then(|r| by_relations(found, &replay, &poses, &r)),
        figure: figure::draw(&found.name, &log, &replay, &poses.in_final_map, trajectory),
        firmness,
        reference: reference.map(|(scored, _)| scored),
    })
}

/// One figure of a replay, metres.
type MainMeasure<'a> = &'a (dyn Fn(&Replay) -> Option<f64> + Sync);

fn stamped(replay: &Replay, pose: impl Fn(&replay::Step) -> &nalgebra::Isometry2<f32>) -> Vec<StampedPose> {
    replay.steps.iter().map(|s| StampedPose::of_core(s.stamp_us, pose(s))).collect()
}

/// A file's content, or a remark on why it cannot be had.
fn said<T>(read: Result<T, ScoreError>, remarks: &mut Vec<String>) -> Option<T> {
    read.map_err(|error| remarks.push(whole(&error))).ok()
}

fn by_reference(
    log: &Log,
    replay: &Replay,
    poses: &Poses<Vec<StampedPose>>,
    reference: &[StampedPose],
) -> Option<ByReference> {
    Some(ByReference {
        ate_rmse_m: poses.try_map(|p| score::absolute_trajectory_error(p, reference))?,
        online_walls: walls(log, replay, &poses.online),
        final_walls: walls(log, replay, &poses.in_final_map),
        reference_walls: walls(log, replay, reference),
    })
}

fn by_relations(
    found: &Found,
    replay: &Replay,
    poses: &Poses<Vec<StampedPose>>,
    relations: &[Relation],
) -> Option<ByRelations> {
    let laser_m = laser_m(found, replay);
    let errors = poses.try_map(|p| score::relation_errors(&at_laser(p, laser_m), relations))?;
    // Other texts with these names have odometry that was made for them, or corrected.
    let is_clf = found.name.ends_with(".clf");
    let published = found.container == Container::Bag || is_clf;
    Some(ByRelations { laser_m, errors, published })
}

/// How far ahead of the robot's centre the frame of a log's relations is, metres.
fn laser_m(found: &Found, replay: &Replay) -> f64 {
    // Freiburg 079's relations are those of the laser; at the other places it sits at the robot's centre.
    let of_laser = found.log == "fr079";
    let laser_m = f64::from(replay.config.sensor.mounting.base_from_laser.translation.x);
    if of_laser { (laser_m * 1e6).round() * 1e-6 } else { 0.0 }
}

fn final_relation_error_m(found: &Found, replay: &Replay, relations: &[Relation]) -> Option<f64> {
    let poses = at_laser(&stamped(replay, |s| &s.pose_in_final_map), laser_m(found, replay));
    Some(score::relation_errors(&poses, relations)?.errors.trans_m)
}

/// The relations of the time of the log, of the files that may have them; a remark where there are only others.
fn fitting(
    files: &[PathBuf],
    trajectory: &[StampedPose],
    remarks: &mut Vec<String>,
) -> Option<Vec<Relation>> {
    let (first_s, last_s) = span_s(trajectory.iter().map(|p| p.stamp_s));
    let mut others = Vec::new();
    for path in files {
        let Some(relations) = said(read_relations(path), remarks) else { continue };
        let stamps = || relations.iter().flat_map(|r| r.stamps_s);
        // By chance a few of another clock's may be.
        if 2 * stamps().filter(|s| (first_s..=last_s).contains(s)).count() > stamps().count() {
            return Some(relations);
        }
        others.push(format!("{}: most of its stamps are of another time than the log", path.display()));
    }
    remarks.append(&mut others);
    None
}
