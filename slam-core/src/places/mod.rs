//! The building: places along the way, and the loops that tie them.
//!
//! In: where the front end says the robot is, how well that was supported, the lines of the local map. Out: corrected poses of all
//! places, swapped in at once, and how to move what was seen on the way between them.
//!
//! ```text
//! pose, support, lines ──► chain ──► finding ──► loops ──► solver ──► corrected anchors ──► map and pose are moved
//!                          anchors   matching              loop space
//! ```
//!
//! The front end goes on as if nothing had happened: what is around the robot moves as one, with the newest place. How the space of the
//! loops works, and what was tried instead, is in [`solver`].

mod chain;
mod factor;
mod finding;
mod lines;
mod matching;
mod recognition;
mod saved;
pub mod solver;
mod twist;

use heapless::Vec;
use nalgebra::{Isometry2, Point2};

use crate::config::{Checked, not_negative};
use crate::geometry::math::within;
use crate::geometry::pose::{heading, normalized, pose, turn};
use crate::map::MapSegment;
use crate::map::walls::WallConfig;
use crate::odometry::Increment;
use crate::tracking::correction::Verdict;
use chain::Support;
pub use chain::{Anchor, Chain};
pub use factor::LOOPS;
use finding::{Finder, Known};
pub use lines::{PLACE_LINES, PlaceLine};
pub(crate) use lines::{Ray, of_scan};
pub(crate) use recognition::SAME;
pub use solver::Loop;
use solver::{Progress, Solver};

/// Settings of places and loops.
#[derive(Clone, Copy, Debug, PartialEq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct PlacesConfig {
    /// A place begins after this way, metres, …
    pub way_m: f32,
    /// … or this turn, radians.
    pub turn_rad: f32,
    /// Its lines are those seen on so long a way around it, to each side, metres.
    pub seen_within_m: f32,
    /// Standard deviations of the way between places, times what is said of them where they are computed.
    pub sigma_scale: f32,
    /// A place may be an old one where at least this way lies between them, metres, …
    pub min_way_m: f32,
    /// … and they are not farther apart than this beyond what the chain may be off by, metres.
    pub reach_m: f32,
    /// χ² up to which the chain's covariance lets a loop pass.
    pub max_chi2: f32,
    /// Share of a place's lines that must be explained.
    pub min_share: f32,
    /// Another pose must not explain more than this share of what the best explains.
    pub max_runner_up: f32,
    /// Information that a match must have in all directions, 1/m².
    pub min_information: f32,
    /// Matches of places before that must ask for the same: 0 or 1.
    pub confirmations: u8,
    /// Matches that differ by less than this are the same, metres, …
    pub same_position_m: f32,
    /// … and radians.
    pub same_heading_rad: f32,
    /// A loop must tell so much, nats.
    pub min_gain: f32,
    /// What was seen on the last so long a way moves with the robot, metres.
    pub local_m: f32,
}

impl PlacesConfig {
    pub(crate) fn validate(&self) -> Checked {
        let fields = [
            ("places.way_m", self.way_m - 0.1),
            ("places.turn_rad", self.turn_rad - 0.1),
            ("places.seen_within_m", self.seen_within_m),
            ("places.sigma_scale", self.sigma_scale - 1e-3),
            ("places.min_way_m", self.min_way_m),
            ("places.reach_m", self.reach_m - 1e-3),
            ("places.max_chi2", self.max_chi2),
            ("places.min_share", self.min_share),
            ("places.max_runner_up", self.max_runner_up),
            ("places.min_information", self.min_information),
            ("places.same_position_m", self.same_position_m),
            ("places.same_heading_rad", self.same_heading_rad),
            ("places.min_gain", self.min_gain),
            ("places.local_m", self.local_m),
        ];
        fields.into_iter().try_for_each(|(field, value)| not_negative(field, value))
    }
}

/// What a scan told, once it is in the map.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Visit<'a> {
    /// Pose of `base` in `map`.
    pub pose: Isometry2<f32>,
    /// The motion that led here, by odometry.
    pub motion: Increment,
    /// Way driven until now, metres.
    pub way_m: f32,
    /// Directions that the scan fixed.
    pub verdict: Verdict,
    /// Share of it that the map explains.
    pub support: f32,
    /// The local map, …
    pub map: &'a [MapSegment],
    /// … and which of its lines are walls.
    pub walls: Option<&'a WallConfig>,
}

/// Loops were closed, and the places have moved.
#[derive(Clone, Copy, Debug)]
pub struct Closure {
    /// What the newest place and all around the robot moved by, in `map`.
    pub moved: Isometry2<f32>,
}

/// A robot whose scans lie far apart has the time for more steps: one more for this way between scans, metres, …
const STEP_M: f32 = 0.06;
/// … but not more than this.
const MOST_STEPS: u8 = 12;

/// A robot may stand so far from a place, metres.
const BESIDE_M: f32 = 2.0;
/// What stands nearer to a place than this has been seen from there, or on the way to the next, metres.
const KNOWN_M: f32 = 3.5;

/// Up to `P` places. RAM: 172·`P` bytes and 10 KiB.
#[derive(Clone, Debug)]
pub struct Places<const P: usize> {
    chain: Chain<P>,
    loops: Vec<Loop, LOOPS>,
    solver: Solver<P>,
    finder: Finder,
    support: Support,
    /// Loops have changed since the last solution began.
    is_stale: bool,
    /// Of the newest places so many wait for their lines.
    without_lines: u8,
    /// The last scan was a keyframe that left no step.
    rested: bool,
    /// A solution is being swapped in, and what was seen moves with it.
    is_moving: bool,
    /// The robot is elsewhere than on the way from the last place: a place begins at once.
    has_jumped: bool,
}

impl<const P: usize> Places<P> {
    /// Size in RAM.
    pub const BYTES: usize = core::mem::size_of::<Self>();

    const HAS_ROOM: () = assert!(P > 2 * LOOPS + 8 && P < u16::MAX as usize, "more places than loops need");

    /// None. Inlined, so that it is built in its place.
    #[inline(always)]
    pub(crate) const fn new() -> Self {
        let () = Self::HAS_ROOM;
        Self {
            chain: Chain::new(),
            loops: Vec::new(),
            solver: Solver::new(),
            finder: Finder::new(),
            support: Support::NONE,
            is_stale: false,
            without_lines: 0,
            rested: false,
            is_moving: false,
            has_jumped: false,
        }
    }

    /// Forgets all.
    pub(crate) fn clear(&mut self) {
        self.chain.anchors.clear();
        self.loops.clear();
        self.solver.clear();
        self.finder = Finder::new();
        (self.support, self.is_stale, self.without_lines) = (Support::NONE, false, 0);
        (self.is_moving, self.has_jumped) = (false, false);
    }

    /// All that was to move with a [`Closure`] has.
    pub(crate) fn moved_all(&mut self) {
        self.is_moving = false;
    }

    /// The places.
    pub fn anchors(&self) -> &[Anchor] {
        self.chain.anchors()
    }

    /// The loops that tie them.
    pub fn loops(&self) -> &[Loop] {
        &self.loops
    }

    /// Takes in a scan: a new place begins where the last lies far enough back. Its lines, and once more those of the last, are chosen by
    /// the next steps.
    ///
    /// Work: a few steps; where a full chain has to give up a place, half the square of the places.
    pub(crate) fn visit(&mut self, visit: &Visit<'_>, config: &PlacesConfig) {
        self.support.add(&visit.motion, visit.verdict, visit.support);
        let is_due = self.chain.anchors.last().is_none_or(|last| {
            self.has_jumped
                || visit.way_m - last.way_m >= config.way_m
                || turn(&last.pose, &visit.pose).abs() >= config.turn_rad
        });
        if !is_due {
            return;
        }
        while self.without_lines > 0 {
            self.choose_lines(visit, config);
        }
        if self.chain.anchors.is_full() {
            self.make_room();
        }
        if !self.chain.push(visit.pose, visit.way_m, self.support.variances(config.sigma_scale)) {
            return;
        }
        (self.support, self.has_jumped) = (Support::NONE, false);
        self.without_lines = self.chain.anchors.len().min(2) as u8;
    }

    /// Chooses the lines of the oldest place that waits for them; with those of the newest the search for loops begins.
    ///
    /// Work: one pass over the map, and one for each of 48 lines at most that are asked whether they are walls.
    fn choose_lines(&mut self, visit: &Visit<'_>, config: &PlacesConfig) {
        let places = self.chain.anchors.len();
        let index = places.saturating_sub(usize::from(self.without_lines));
        self.without_lines = self.without_lines.saturating_sub(1);
        let Some(anchor) = self.chain.anchors.get_mut(index) else { return };
        let way_m = anchor.way_m;
        let seen_there = |entry: &MapSegment| (entry.seen_at_m - way_m).abs() <= config.seen_within_m;
        let is_wall = |index: usize| visit.walls.is_none_or(|walls| walls.is_wall(index, visit.map));
        anchor.lines = lines::chosen(visit.map, &anchor.pose, seen_there, is_wall);
        if self.without_lines == 0 {
            self.finder.begin(places as u16 - 1, &self.chain);
        }
    }

    /// Gives up the least informative place.
    fn make_room(&mut self) {
        if self.solver.is_busy() {
            self.solver.clear();
            self.is_stale = true;
        }
        let (loops, finder) = (&self.loops, &self.finder);
        let is_end =
            |index: usize| loops.iter().any(|l| usize::from(l.from) == index || usize::from(l.to) == index);
        let Some(gone) = self.chain.least_informative(|index| is_end(index) || finder.needs(index)) else {
            // Next time there is one.
            self.finder.drop_pending();
            return;
        };
        self.chain.remove(gone);
        self.loops.iter_mut().for_each(|l| l.removed(gone as u16));
        self.finder.removed(gone as u16);
    }

    /// Steps for a scan after such a motion. A keyframe has enough to do and takes one of them, but not the only one twice in a row.
    pub(crate) fn steps(&mut self, motion: &Increment, is_keyframe: bool) -> u8 {
        let steps = (1.0 + within(motion.distance_m / STEP_M, 0.0, f32::from(MOST_STEPS - 1))) as u8;
        let rests = is_keyframe && (steps > 1 || !self.rested);
        self.rested = rests && steps == 1;
        steps - u8::from(rests)
    }

    /// The robot moved where no scan was taken in.
    pub(crate) fn pass_blindly(&mut self, motion: &Increment) {
        self.support.add(motion, Verdict::Blind, 0.0);
    }

    /// The robot was displaced, and found where the map says: how it came there is not known, and what it is off by from the places before.
    pub(crate) fn pass_lost(&mut self) {
        self.support.lose();
        self.has_jumped = true;
    }

    /// Does a bounded bit of work: the lines of a place, or one step of a solution that is on its way, or one of the search for loops.
    /// Returns what all around the robot is to be moved by, where a solution has been swapped in.
    ///
    /// Work: the lines of a place, or that of [`Solver`]'s step, or eight places sieved, or two places compared, or three loops judged.
    pub(crate) fn step(&mut self, visit: &Visit<'_>, config: &PlacesConfig) -> Option<Closure> {
        if self.without_lines > 0 {
            self.choose_lines(visit, config);
            return None;
        }
        if self.solver.is_busy() {
            return self.solve();
        }
        if self.is_stale {
            self.is_stale = false;
            self.solver.begin(&self.chain);
            return None;
        }
        let known = Known { chain: &self.chain, loops: &self.loops, solver: &self.solver, config };
        let (found, gives_way) = self.finder.step(&known);
        if let Some(index) = gives_way {
            self.loops.remove(index);
        }
        self.is_stale = !found.is_empty();
        for edge in found {
            let _ = self.loops.push(edge);
        }
        None
    }

    fn solve(&mut self) -> Option<Closure> {
        match self.solver.step(&self.chain, &self.loops) {
            Progress::Going => None,
            Progress::Failed => {
                // The last loop made it so.
                self.loops.pop();
                self.is_stale = !self.loops.is_empty();
                self.solver.clear();
                None
            }
            Progress::Done => {
                self.is_moving = true;
                self.solver.swap_in(&mut self.chain);
                self.finder.begin_anew(&self.chain);
                let (Some(old), Some(last)) = (self.solver.replaced().last(), self.chain.anchors.last())
                else {
                    self.is_moving = false;
                    return None;
                };
                let new = last.pose;
                Some(Closure { moved: normalized(&(new * old.inverse())) })
            }
        }
    }

    /// Whether the robot has been so close to a point that it would have seen what stands there.
    pub(crate) fn know(&self, point: Point2<f32>) -> bool {
        let is_near = |anchor: &Anchor| {
            (anchor.pose.translation.vector - point.coords).norm_squared() < KNOWN_M * KNOWN_M
        };
        self.chain.anchors().iter().any(is_near)
    }

    /// Poses in `map` from which a robot near a place may see these lines, longest first: the best few, whatever is known of where it
    /// is.
    ///
    /// Work: that of [`recognition::anywhere`].
    pub(crate) fn poses_of(
        &self,
        place: usize,
        seen: &[Ray],
        map: &[MapSegment],
        reach_m: f32,
    ) -> impl Iterator<Item = Isometry2<f32>> {
        let anchor = self.chain.get(place);
        let pose = anchor.map_or_else(Isometry2::identity, Anchor::pose);
        let found = anchor
            .map(|anchor| recognition::anywhere(seen, &lines::around(map, &anchor.pose, reach_m + BESIDE_M)));
        found.into_iter().flatten().map(move |found| normalized(&(pose * found)))
    }

    /// What the last solution moved a point by that was seen after a way of `way_m`: as the places before and after, each by its share.
    ///
    /// To be asked right after a [`Closure`].
    pub fn moved(&self, way_m: f32, point: &Point2<f32>) -> Isometry2<f32> {
        let anchors = self.chain.anchors();
        let after = anchors.partition_point(|anchor| anchor.way_m <= way_m);
        let by = |index: usize| match (anchors.get(index), self.solver.replaced().get(index)) {
            (Some(new), Some(old)) => new.pose * old.inverse(),
            _ => Isometry2::identity(),
        };
        let Some(before) = after.checked_sub(1) else { return by(0) };
        let (Some(own), Some(next)) = (anchors.get(before), anchors.get(after)) else { return by(before) };
        let share = within((way_m - own.way_m) / (next.way_m - own.way_m), 0.0, 1.0);
        let [from, to] = [by(before), by(after)];
        let position = (from * point).coords * (1.0 - share) + (to * point).coords * share;
        let rotation = pose(0.0, 0.0, heading(&from) + share * turn(&from, &to)).rotation;
        Isometry2::from_parts((position - rotation * point.coords).into(), rotation)
    }

    /// The same of a pose that the robot had.
    pub fn moved_pose(&self, way_m: f32, old: &Isometry2<f32>) -> Isometry2<f32> {
        self.moved(way_m, &old.translation.vector.into()) * old
    }
}

#[cfg(test)]
mod tests;
