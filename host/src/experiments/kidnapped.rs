//! A robot that somebody lifts while it drives and puts down elsewhere: whether it notices, and whether it finds itself again.

use std::ops::Range;

use comfy_table::Table;
use rayon::prelude::*;
use slam_core::SlamConfig;
use slam_core::tracking::TrackingState;

use super::document::{mean, paragraph, per_100, table};
use super::{ExperimentError, LOST_M, Options, Results};
use crate::replay::{self, Replay, ReplayError};
use crate::robot::Robot;
use crate::score::Spread;
use crate::sim::world::World;
use crate::sim::{self, Drive, SimConfig, SimKind, judge};

/// Where the robot is lifted: name of the world, and when, seconds from the start; most of the way is behind it.
const LIFTED_AT_S: [(&str, f64); 4] = [("hall", 90.0), ("office", 60.0), ("flat", 120.0), ("lab", 60.0)];

/// Drives of each world and of each place where the robot is put down.
pub const DRIVES: u64 = 5;

/// A scan that ends when the robot is put down was still taken in somebody's hands: the first that counts comes so much later,
/// seconds.
const SCAN_S: f64 = 0.1;
/// A robot whose heading is wrong by more than this is not found either, degrees.
const TURNED_DEG: f64 = 15.0;

/// Where the robot is put down.
#[derive(Clone, Copy, Debug)]
pub struct Place {
    /// What it is called in the table.
    pub name: &'static str,
    /// So much farther along its path, metres; below zero it has been there before.
    pub by_m: f64,
    /// Turned by so much from the path's direction, degrees.
    pub turn_deg: f64,
}

/// Both are places that the map has.
pub const PLACES: [Place; 2] = [
    Place { name: "1 m back, turned by 30°", by_m: -1.0, turn_deg: 30.0 },
    Place { name: "8 m back, turned by 120°", by_m: -8.0, turn_deg: 120.0 },
];

/// One drive in which the robot was lifted. Times are since it was put down, seconds.
#[derive(Clone, Copy, Debug)]
pub struct Kidnapped {
    /// Name of the world.
    pub world: &'static str,
    /// Index in [`PLACES`].
    pub place: usize,
    /// When the state first said that the robot is lost; zero where it already did in somebody's hands.
    pub said_lost_s: Option<f64>,
    /// From when on, to the end of the drive, the robot was within [`LOST_M`] and 15° of where it thought it was.
    pub found_s: Option<f64>,
    /// Time during which it was not, and the state said that it was tracking.
    pub wrong_and_sure_s: f64,
    /// Time from there to the end of the drive.
    pub rest_s: f64,
    /// Established segments of the map, and those of them that are far from everything that stands still.
    pub segments: [usize; 2],
}

/// What a scan after the robot was put down says.
#[derive(Clone, Copy, Debug)]
pub struct Moment {
    /// When, seconds since then; below zero in somebody's hands.
    pub since_s: f64,
    /// Whether the robot is elsewhere than it thinks.
    pub is_wrong: bool,
    /// What the robot says of it.
    pub state: TrackingState,
}

/// Sums up what was said from the lift on.
pub fn summed_up(world: &'static str, place: usize, moments: &[Moment], segments: [usize; 2]) -> Kidnapped {
    let down: Vec<&Moment> = moments.iter().filter(|m| m.since_s >= 0.0).collect();
    let last_wrong = down.iter().rposition(|m| m.is_wrong);
    let found = down.get(last_wrong.map_or(0, |k| k + 1));
    let rest_s = down.last().map_or(0.0, |m| m.since_s);
    let sure = down.iter().filter(|m| m.is_wrong && m.state == TrackingState::Tracking).count();
    Kidnapped {
        world,
        place,
        said_lost_s: moments.iter().find(|m| m.state == TrackingState::Lost).map(|m| m.since_s.max(0.0)),
        found_s: found.map(|m| m.since_s),
        wrong_and_sure_s: sure as f64 * rest_s / down.len().max(1) as f64,
        rest_s,
        segments,
    }
}

fn cases(options: &Options) -> impl Iterator<Item = (&'static str, f64, usize, u64)> {
    let Range { start, end } = options.seeds;
    let seeds = start..end.min(start.saturating_add(DRIVES));
    let placed = move |(world, at_s)| {
        let seeds = seeds.clone();
        (0..PLACES.len()).flat_map(move |place| seeds.clone().map(move |seed| (world, at_s, place, seed)))
    };
    LIFTED_AT_S.into_iter().flat_map(placed)
}

/// Number of drives that [`run`] reports.
pub(super) fn steps(options: &Options) -> usize {
    cases(options).count()
}

/// Every drive. `progress` is called after each, from any thread.
pub(super) fn run(options: &Options, progress: impl Fn() + Sync) -> Result<Vec<Kidnapped>, ExperimentError> {
    let jobs: Vec<_> = cases(options).collect();
    jobs.par_iter()
        .map(|(name, at_s, place, seed)| {
            let kidnapped = lifted(name, &options.world(name)?, *at_s, *place, *seed)?;
            progress();
            Ok(kidnapped)
        })
        .collect()
}

/// One drive, of the real kind.
pub fn lifted(
    name: &'static str,
    world: &World,
    at_s: f64,
    place: usize,
    seed: u64,
) -> Result<Kidnapped, ReplayError> {
    let robot = Robot::usual_for("simulated");
    let mut errors = SimConfig::of(SimKind::Real);
    let Place { by_m, turn_deg, .. } = PLACES[place];
    (errors.fault.lift_at_s, errors.fault.lift_by_m, errors.fault.lift_turn_deg) = (at_s, by_m, turn_deg);
    let drive = sim::drive(world, &robot, &errors, seed)?;
    let replay = replay::run(&drive.log, &robot, SlamConfig::default(), || {})?;
    let judgement = judge::judge(world, &drive, &replay);
    let segments = [judgement.established_segments, judgement.spurious_segments];
    let moments = moments(&drive, &replay, at_s, at_s + errors.fault.lift_s + SCAN_S);
    Ok(summed_up(name, place, &moments, segments))
}

/// From the lift on.
fn moments(drive: &Drive, replay: &Replay, lifted_s: f64, down_s: f64) -> Vec<Moment> {
    let begin_us = drive.log.scans.first().map_or(0, |s| s.stamp_us);
    let poses = judge::in_world(drive, replay.steps.iter().map(|s| s.pose));
    let all = replay.steps.iter().zip(poses.iter().zip(&drive.truth)).map(|(step, (pose, truth))| {
        let off = truth.inv_mul(pose);
        let is_wrong =
            off.translation.vector.norm() > LOST_M || off.rotation.angle().abs() > TURNED_DEG.to_radians();
        let since_s = step.stamp_us.saturating_sub(begin_us) as f64 * 1e-6 - down_s;
        Moment { since_s, is_wrong, state: step.update.state }
    });
    all.filter(|m| m.since_s >= lifted_s - down_s).collect()
}

/// What became of them.
pub fn fates(results: &Results) -> Table {
    let mut table = table([
        "building",
        "put down",
        "said to be lost",
        "after: median",
        "worst",
        "found again",
        "after: median",
        "worst",
        "wrong and yet sure",
        "of the rest of the drive",
        "spurious segments per 100 others",
    ]);
    for (world, _) in LIFTED_AT_S {
        for (index, place) in PLACES.iter().enumerate() {
            let all = || results.kidnapped.iter().filter(|k| k.world == world && k.place == index);
            let of = |time: fn(&Kidnapped) -> Option<f64>| {
                let n = format!("{} of {}", all().filter_map(time).count(), all().count());
                let spread = Spread::of(all().filter_map(time));
                let shown = |value: fn(&Spread) -> f64| {
                    spread.as_ref().map_or_else(|| "–".into(), |s| format!("{:.1} s", value(s)))
                };
                [n, shown(|s| s.median), shown(|s| s.worst)]
            };
            let [lost, lost_median, lost_worst] = of(|k| k.said_lost_s);
            let [found, found_median, found_worst] = of(|k| k.found_s);
            let sum = |which: usize| all().map(|k| k.segments[which]).sum::<usize>();
            let (established, spurious) = (sum(0), sum(1));
            table.add_row([
                world.to_owned(),
                place.name.into(),
                lost,
                lost_median,
                lost_worst,
                found,
                found_median,
                found_worst,
                format!("{:.0} s", mean(all().map(|k| k.wrong_and_sure_s))),
                format!("{:.0} s", mean(all().map(|k| k.rest_s))),
                per_100(spurious, established),
            ]);
        }
    }
    table
}

/// Paragraphs and the table, in the order of the page.
pub(super) fn section(results: &Results) -> Vec<String> {
    let lifted: Vec<String> =
        LIFTED_AT_S.iter().map(|(world, at_s)| format!("{world} {at_s:.0} s")).collect();
    let about = format!(
        "Somebody lifts the robot ({} after it started), carries it for three seconds, in which its wheels stand still, and puts it
        down where it has been before, so that the map has the place; errors of the real kind, {DRIVES} seeds at most. Lost is what the state says
        (`tracking`, `uncertain`, `lost`). The robot has found itself when from then on, to the end of the drive, it is within
        {LOST_M} m and {TURNED_DEG}° of where it thinks it is. Times are since it was put down. Wrong and yet sure is how long it was
        not, and the state said `tracking`: the worst that can happen, as what is seen meanwhile becomes map. Means over the
        drives where nothing else is said.",
        lifted.join(", ")
    );
    vec!["## Lifted and put down elsewhere".into(), paragraph(&about), fates(results).to_string()]
}
