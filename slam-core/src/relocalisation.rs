//! Finding a robot in its map, wherever it is: after it was lifted, or where it takes up a map without knowing where it stands.
//!
//! The global localisation and kidnapped robot problems. In: scans, the motions between them, places and map. Out: the pose, or that it is
//! not known. Each scan is laid on the map's lines around the next place, by the ends of its longest segments; what fits is refined in the
//! map, and judged by the segments that it explains and by the lines that it sees through. What holds is kept as one of a few hypotheses,
//! which move with the odometry and are held against the scans that follow. One wins when all places have been asked, when it has
//! explained the scans on some way, and when no other explains them nearly as well: in two rooms alike there are two, until the robot
//! has seen what tells them apart.
//!
//! Reference: Jensfelt and Kristensen, "Active global localization for a mobile robot using multiple hypothesis tracking", IEEE
//! Transactions on Robotics and Automation 17(5), 2001.

use heapless::Vec;
use nalgebra::{Isometry2, Matrix3};

use crate::config::{Checked, check, not_negative};
use crate::few::keep_most;
use crate::frontend::extraction::MAX_SEGMENTS;
use crate::geometry::math::{max, min};
use crate::geometry::pose::{are_close, diagonal};
use crate::geometry::segment::Segment;
use crate::odometry::Increment;
use crate::places::{Places, SAME, of_scan};
use crate::sensor::scan::Scan;
use crate::slam::Stage;
use crate::tracking::correction::Prior;
use crate::tracking::tracker::Scene;
use crate::tracking::{Hypothesis, Tracker};

/// Settings of relocalisation. Chosen on simulated lifts in hall, office, flat, lab and twins (real kind, seeds 1 to 8), checked on seeds 11
/// to 15 and 301 to 303. Recorded logs have no lifts; exp1, exp3, csail, fr079, fr101 and seattle, each begun anywhere in its own map
/// (`lineslam replay --map map.json --localise`), are found in the right place.
#[derive(Clone, Copy, Debug, PartialEq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct RelocalisationConfig {
    /// Places that each scan is compared with.
    pub places_per_scan: u8,
    /// Hypotheses that are looked at with each scan; they take turns.
    pub hypotheses_per_scan: u8,
    /// Poses that are refined in the map with each scan, these and those that places propose.
    pub poses_per_scan: u8,
    /// Scans with fewer segments say nothing.
    pub least_segments: u8,
    /// A pose stays a hypothesis as long as it explains this share of the scans, …
    pub least_support: f32,
    /// … and is where the robot is, where it explains this share, on the mean, …
    pub min_support: f32,
    /// … and any other pose not more than this share of that, …
    pub max_runner_up: f32,
    /// … or leaves so many times as much of them unexplained.
    pub min_odds: f32,
    /// Scans that it must have explained.
    pub scans: u8,
    /// Its lead, by the mean share of the scans, times their number, but not more than one for so much of the way since it was proposed,
    /// metres (a radian counts as a metre), …
    pub apart_m: f32,
    /// … must be this.
    pub min_lead: f32,
    /// Way on which nothing in the map explains what is seen, metres, from which on a robot goes on from where it is thought to be: it is
    /// where nothing has been mapped.
    pub give_up_m: f32,
}

impl RelocalisationConfig {
    pub(crate) fn validate(&self) -> Checked {
        check("relocalisation.places_per_scan", self.places_per_scan > 0)?;
        check("relocalisation.hypotheses_per_scan", self.hypotheses_per_scan > 0)?;
        check("relocalisation.poses_per_scan", self.poses_per_scan > self.hypotheses_per_scan)?;
        let fields = [
            ("relocalisation.least_support", self.least_support),
            ("relocalisation.min_support", self.min_support),
            ("relocalisation.max_runner_up", self.max_runner_up),
            ("relocalisation.min_odds", self.min_odds),
            ("relocalisation.apart_m", self.apart_m - 1e-3),
            ("relocalisation.min_lead", self.min_lead),
            ("relocalisation.give_up_m", self.give_up_m),
        ];
        fields.into_iter().try_for_each(|(field, value)| not_negative(field, value))
    }
}

/// Most hypotheses.
pub const HYPOTHESES: usize = 16;
/// Scans that the mean of what a hypothesis explains goes back, about.
const MEMORY: f32 = 20.0;
/// A hypothesis that has explained fewer scans is no rival yet.
const RIVAL_SCANS: u8 = 3;
/// Of two that are the same, one that explains so much more shows where the other should be.
const BETTER: f32 = 0.1;
/// How far off a pose may be that is proposed by a place: standard deviations of x, y (m) and θ (rad).
const PROPOSED: [f32; 3] = [0.2, 0.2, 0.1];
/// Share of a scan that must lie where the map knows what stands, or it says nothing of a hypothesis.
const LEAST_KNOWN: f32 = 0.33;

/// Where the robot may be.
#[derive(Clone, Copy, Debug)]
pub struct PoseHypothesis {
    /// Pose of `base` in `map`, …
    pub pose: Isometry2<f32>,
    /// … and its covariance (x, y, θ).
    pub covariance: Matrix3<f32>,
    /// Share of the scans that it explains, less what it says should be seen and is seen through: 0 to 1, the mean over the last ones.
    pub support: f32,
    /// Scans that it was held against, …
    pub scans: u8,
    /// … and the way since it was proposed, metres; a radian counts as a metre.
    pub way_m: f32,
}

/// What is known of where a robot is that looks for itself.
#[derive(Clone, Copy, Debug)]
pub struct Relocalisation {
    /// The best hypothesis, if there is one.
    pub best: Option<PoseHypothesis>,
    /// Support of the best one that is elsewhere.
    pub runner_up: f32,
    /// Whether every place has been asked.
    pub complete: bool,
    /// How the search stands.
    pub state: SearchState,
}

/// How the search stands.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum SearchState {
    /// It is not known where the robot is.
    Searching,
    /// The best hypothesis is where it is.
    Found,
    /// Nothing in the map explains what is seen: the robot goes on from where it is thought to be.
    GivenUp,
}

/// What a hypothesis is held against.
pub(crate) struct Evidence<'a, const P: usize> {
    pub scene: Scene<'a>,
    pub scan: &'a Scan<'a>,
    pub places: &'a Places<P>,
    /// The motion since the scan before, by odometry.
    pub motion: &'a Increment,
}

/// The hypotheses, and which places come next. RAM: 1 KiB.
#[derive(Clone, Debug)]
pub(crate) struct Relocaliser {
    hypotheses: Vec<PoseHypothesis, HYPOTHESES>,
    /// The hypothesis that is held against the next scan first.
    next: u8,
    /// Places that have been asked since it began, from the newest to the oldest and again.
    asked: u16,
    /// Way on which nothing explained the scans, metres; a radian counts as a metre.
    unexplained_m: f32,
    /// Whether there is a pose to go on from where nothing does.
    may_give_up: bool,
}

impl Relocaliser {
    pub const fn new() -> Self {
        Self { hypotheses: Vec::new(), next: 0, asked: 0, unexplained_m: 0.0, may_give_up: false }
    }

    /// Begins anew: the robot may be anywhere, as well as where it is thought to be.
    pub fn begin(&mut self, thought: Option<Prior>) {
        *self = Self { may_give_up: thought.is_some(), ..Self::new() };
        if let Some(at) = thought {
            let _ = self.hypotheses.push(PoseHypothesis::at(at));
        }
    }

    /// Where the robot may be.
    pub fn hypotheses(&self) -> &[PoseHypothesis] {
        &self.hypotheses
    }

    /// Takes in a scan. `predicted` moves a pose by the odometry.
    ///
    /// Work: some hypotheses, and for a few places those of [`Places::poses_of`], each refined in the map.
    pub fn step<const N: usize, const P: usize>(
        &mut self,
        evidence: &Evidence<'_, P>,
        tracker: &mut Tracker<N>,
        predicted: impl Fn(&Prior) -> Prior,
        config: &RelocalisationConfig,
        watch: &mut impl FnMut(Stage),
    ) -> Relocalisation {
        self.go_on(evidence.motion, predicted);
        let says_something = evidence.scene.observed.len() >= usize::from(config.least_segments);
        if says_something {
            let held = self.hold_hypotheses(evidence, tracker, config, watch);
            let most = usize::from(config.poses_per_scan).saturating_sub(held);
            self.ask_places(evidence, tracker, config, most, watch);
            self.merge();
        }
        let complete = usize::from(self.asked) >= evidence.places.anchors().len();
        let outcome = self.judge(complete, config);
        if says_something { outcome } else { Relocalisation { state: SearchState::Searching, ..outcome } }
    }

    /// Moves the hypotheses by the odometry. After a motion that is no number the robot may be anywhere.
    pub fn go_on(&mut self, motion: &Increment, predicted: impl Fn(&Prior) -> Prior) {
        if !motion.is_finite() {
            self.begin(None);
            return;
        }
        let way_m = motion.distance_m + motion.turn_rad.abs();
        self.unexplained_m += way_m;
        for candidate in &mut self.hypotheses {
            let prior = predicted(&candidate.prior());
            (candidate.pose, candidate.covariance) = (prior.pose, prior.covariance);
            candidate.way_m += way_m;
        }
    }

    /// Holds the scan against those of the hypotheses whose turn it is. How many they are.
    fn hold_hypotheses<const N: usize, const P: usize>(
        &mut self,
        evidence: &Evidence<'_, P>,
        tracker: &mut Tracker<N>,
        config: &RelocalisationConfig,
        watch: &mut impl FnMut(Stage),
    ) -> usize {
        let count = self.hypotheses.len();
        let held = count.min(config.hypotheses_per_scan.into());
        for _ in 0..held {
            let index = usize::from(self.next) % count;
            self.next = (index + 1) as u8;
            if let Some(candidate) = self.hypotheses.get_mut(index)
                && let Some((hypothesis, support)) =
                    held_against(evidence, &candidate.prior(), 0.0, tracker, watch)
            {
                candidate.take(&hypothesis, support);
            }
        }
        self.hypotheses.retain(|candidate| candidate.scans == 0 || candidate.support >= config.least_support);
        held
    }

    /// Compares the scan with the next places, and refines the best `most` of what they propose.
    fn ask_places<const N: usize, const P: usize>(
        &mut self,
        evidence: &Evidence<'_, P>,
        tracker: &mut Tracker<N>,
        config: &RelocalisationConfig,
        mut most: usize,
        watch: &mut impl FnMut(Stage),
    ) {
        let seen = of_scan(evidence.scene.observed);
        let places = evidence.places.anchors().len();
        for _ in 0..usize::from(config.places_per_scan).min(places) {
            let place = places - 1 - usize::from(self.asked) % places;
            self.asked = self.asked.saturating_add(1);
            let (map, sensor) = (evidence.scene.map, &evidence.scene.config.sensor);
            let poses = evidence.places.poses_of(place, &seen, map, sensor.reach_m());
            for pose in poses.into_iter().take(most) {
                most -= 1;
                let proposed = Prior { pose, covariance: diagonal(PROPOSED) };
                let laid = held_against(evidence, &proposed, config.least_support, tracker, watch);
                if let Some((hypothesis, support)) = laid {
                    let mut candidate = PoseHypothesis::at(proposed);
                    candidate.take(&hypothesis, support);
                    self.add(candidate);
                }
            }
        }
    }

    fn add(&mut self, new: PoseHypothesis) {
        match self.hypotheses.iter_mut().find(|own| own.is_same(&new)) {
            Some(same) if new.support > same.support + BETTER => {
                (same.pose, same.covariance) = (new.pose, new.covariance);
            }
            Some(_) => {}
            None => keep_most(&mut self.hypotheses, new, |own| own.support),
        }
    }

    /// Hypotheses that have come together are one: the older.
    fn merge(&mut self) {
        for index in (1..self.hypotheses.len()).rev() {
            let (before, rest) = self.hypotheses.split_at(index);
            let is_double =
                rest.first().is_some_and(|candidate| before.iter().any(|other| other.is_same(candidate)));
            if is_double {
                self.hypotheses.remove(index);
            }
        }
    }

    fn judge(&mut self, complete: bool, config: &RelocalisationConfig) -> Relocalisation {
        let best = self.hypotheses.iter().max_by(|a, b| a.support.total_cmp(&b.support)).copied();
        let is_rival = |candidate: &&PoseHypothesis| {
            candidate.scans >= RIVAL_SCANS && best.is_some_and(|best| !best.is_same(candidate))
        };
        let runner_up = self.hypotheses.iter().filter(is_rival).map(|g| g.support).fold(0.0, max);
        let explains = best.is_some_and(|best| best.support >= config.min_support);
        if explains {
            self.unexplained_m = 0.0;
        }
        let gives_up = self.may_give_up && self.unexplained_m >= config.give_up_m;
        let state = match best {
            Some(best) if complete && explains && best.stands_out(runner_up, config) => SearchState::Found,
            _ if complete && gives_up => SearchState::GivenUp,
            _ => SearchState::Searching,
        };
        Relocalisation { best, runner_up, complete, state }
    }
}

impl PoseHypothesis {
    fn at(prior: Prior) -> Self {
        Self { pose: prior.pose, covariance: prior.covariance, support: 0.0, scans: 0, way_m: 0.0 }
    }

    /// As a prior.
    pub(crate) fn prior(&self) -> Prior {
        Prior { pose: self.pose, covariance: self.covariance }
    }

    fn take(&mut self, hypothesis: &Hypothesis, support: f32) {
        (self.pose, self.covariance) = (hypothesis.pose, hypothesis.covariance);
        self.scans = self.scans.saturating_add(1);
        self.support += max(1.0 / f32::from(self.scans), 1.0 / MEMORY) * (support - self.support);
    }

    fn is_same(&self, other: &PoseHypothesis) -> bool {
        are_close(&self.pose, &other.pose, SAME)
    }

    /// Whether it leaves no doubt.
    fn stands_out(&self, runner_up: f32, config: &RelocalisationConfig) -> bool {
        let is_far_better = runner_up <= config.max_runner_up * self.support
            || 1.0 - runner_up >= config.min_odds * (1.0 - self.support);
        // Scans from where the robot stands say the same.
        let scans = min(f32::from(self.scans), self.way_m / config.apart_m);
        is_far_better && self.scans >= config.scans && (self.support - runner_up) * scans >= config.min_lead
    }
}

/// Lays the scan on the map around a pose: the pose refined, and the share of the scan that speaks for it, of what lies where the map knows
/// what stands. None where that is little, or where a smaller share than `least` speaks for it.
fn held_against<const N: usize, const P: usize>(
    evidence: &Evidence<'_, P>,
    prior: &Prior,
    least: f32,
    tracker: &mut Tracker<N>,
    watch: &mut impl FnMut(Stage),
) -> Option<(Hypothesis, f32)> {
    let Evidence { scene, scan, places, .. } = evidence;
    let hypothesis = tracker.corrected_at(scene, prior, watch);
    let pose = hypothesis.pose;
    let segments = scene.observed.iter();
    let is_known: Vec<bool, MAX_SEGMENTS> =
        segments.clone().map(|s| places.know(pose * s.midpoint())).collect();
    let points = |segment: &Segment| segment.moments.inliers as f32;
    let all: f32 = segments.clone().map(points).sum();
    let known: f32 = segments.zip(&is_known).filter(|(_, known)| **known).map(|(s, _)| points(s)).sum();
    if known < LEAST_KNOWN * all {
        return None;
    }
    let counts = |k: usize| is_known.get(k).copied().unwrap_or(false);
    let score = tracker.score_of(scene, &pose, counts);
    if score < least {
        return None;
    }
    let support = score * (1.0 - tracker.contradicted_share(scene, scan, &pose));
    (support >= least).then_some((hypothesis, support))
}
