//! Finding loops: which old places may the robot be at, and is it?
//!
//! In: chain, loops, the last solution's factor. Out: loops that are to be believed. For each new place the old ones that it may be are
//! sieved out by the covariance of the chain between them, given the loops there are, and compared with it one by one. A match is
//! believed when it explains most of the place's lines, when no other pose explains nearly as much, when a match of one of the places
//! just before asks for the same, and when the chain does not speak against it. A wrong loop is worse than none.

use heapless::Vec;
use nalgebra::{Isometry2, Matrix3};

use super::PlacesConfig;
use super::chain::{Anchor, Chain};
use super::factor::{LOOPS, ROWS, set_three};
use super::lines::unpacked;
use super::matching::{Gate, Match, matched};
use super::solver::{Loop, Solver};
use super::twist::{Packed, inverse_adjoint};
use crate::few::sort_few;
use crate::geometry::math::sqrt;
use crate::geometry::pose::{components, diagonal};

/// Old places looked at for each new one.
const CANDIDATES: usize = 8;
/// Places sieved in one step.
const SIEVED: usize = 8;
/// Matches that wait to be confirmed.
const PENDING: usize = 12;
/// Loops judged, and taken, at once.
const AT_ONCE: usize = 3;
/// Places after which a match that was not confirmed is dropped.
const WAIT: u16 = 3;
/// What places and lines are off by beyond the chain: standard deviations in metres and radians.
const SLACK: [f32; 3] = [0.1, 0.1, 0.035];
/// Covariance of a match: beside what its lines say, which are not independent along their length, …
const DEPENDENT: f32 = 0.25;
/// … at most these, …
const PRIOR: [f32; 3] = [1.0, 1.0, 0.2];
/// … and at least these standard deviations.
const FLOOR: [f32; 3] = [0.02, 0.02, 0.005];

/// A match that waits, or is to be believed.
#[derive(Clone, Copy, Debug)]
pub(super) struct Found {
    pub edge: Loop,
    share: f32,
    taken: bool,
}

/// A new place on its way through the old ones.
#[derive(Clone, Copy, Debug)]
struct Query {
    place: u16,
    /// Its prefix sum.
    spread: Packed,
    /// The next to be sieved, and the prefix sum before it; none when all are.
    next: Option<(u16, Packed)>,
}

/// An old place that the new one may be: its prefix sum, and how likely that is, the less the likelier.
#[derive(Clone, Copy, Debug)]
struct Candidate {
    place: u16,
    spread: Packed,
    rank: f32,
}

/// The search. RAM: 2.5 KiB.
#[derive(Clone, Debug)]
pub(super) struct Finder {
    query: Option<Query>,
    candidates: Vec<Candidate, CANDIDATES>,
    found: Vec<Found, CANDIDATES>,
    pending: Vec<Found, PENDING>,
}

/// What the search works with.
pub(super) struct Known<'a, const P: usize> {
    pub chain: &'a Chain<P>,
    pub loops: &'a [Loop],
    pub solver: &'a Solver<P>,
    pub config: &'a PlacesConfig,
}

impl<const P: usize> Known<'_, P> {
    /// Covariance of a place seen from an older one, in its own frame, given the loops; by the prefix sums of both.
    ///
    /// Work: 54 steps in `f32` for each loop, and half the square of the factor's rows, three times.
    fn covariance(&self, from: u16, before: &Packed, to: u16, until: &Packed) -> Matrix3<f32> {
        let Some(anchor) = self.chain.get(usize::from(to)) else { return Matrix3::identity() };
        let to_own = inverse_adjoint(&anchor.pose);
        let chain = (to_own * until.minus(before) * to_own.transpose()).map(|v| v as f32);
        let (factor, ends) = self.solver.posterior();
        let to_own = to_own.map(|v| v as f32).transpose();
        let mut columns = [[0.0; ROWS]; 3];
        for (index, (l, [loop_from, loop_to])) in self.loops.iter().zip(ends).enumerate().take(factor.loops())
        {
            let begin = if l.from >= from { loop_from } else { before };
            let end = if l.to <= to { loop_to } else { until };
            if l.from.max(from) >= l.to.min(to) {
                continue;
            }
            let Some(at) = self.chain.get(usize::from(l.to)) else { continue };
            let block =
                inverse_adjoint(&at.pose).map(|v| v as f32) * end.minus(begin).map(|v| v as f32) * to_own;
            for (c, column) in columns.iter_mut().enumerate() {
                set_three(column, index, &block.column(c).into_owned());
            }
        }
        columns.iter_mut().for_each(|column| factor.forward(column));
        let rows = 3 * factor.loops();
        let told = Matrix3::from_fn(|r, c| match (columns.get(r), columns.get(c)) {
            (Some(a), Some(b)) => a.iter().zip(b).take(rows).map(|(a, b)| a * b).sum(),
            _ => 0.0,
        });
        // Rounding must not take a variance below zero.
        let left = chain - told;
        if left.diagonal().min() > 0.0 { left } else { Matrix3::zeros() }
    }

    fn pose(&self, index: u16) -> Isometry2<f32> {
        self.chain.get(usize::from(index)).map_or_else(Isometry2::identity, Anchor::pose)
    }

    fn way_m(&self, index: u16) -> f32 {
        self.chain.get(usize::from(index)).map_or(0.0, Anchor::way_m)
    }

    /// Whether two matches ask for the same.
    fn agree(&self, a: &Loop, b: &Loop) -> bool {
        let expected = self.pose(a.from).inv_mul(&self.pose(b.from))
            * b.measured
            * self.pose(b.to).inv_mul(&self.pose(a.to));
        let off = components(&a.measured.inv_mul(&expected));
        let way_m =
            (self.way_m(a.from) - self.way_m(b.from)).abs() + (self.way_m(a.to) - self.way_m(b.to)).abs();
        off.xy().norm() <= self.config.same_position_m + 0.02 * way_m
            && off.z.abs() <= self.config.same_heading_rad
    }

    /// Whether the chain has nothing against a loop, and how much it learns from it, nats. Work: one pass over the chain in `f64`.
    fn gain(&self, edge: &Loop) -> Option<f32> {
        let [before, until] =
            self.chain.prefix_sums([edge.from, edge.to].map(usize::from)).map(|s| Packed::of(&s));
        let innovation = self.covariance(edge.from, &before, edge.to, &until) + edge.covariance;
        let off = components(&self.pose(edge.from).inv_mul(&self.pose(edge.to)).inv_mul(&edge.measured));
        let chi2 = off.dot(&(innovation.try_inverse()? * off));
        (chi2 <= self.config.max_chi2)
            .then(|| 0.5 * libm::logf(innovation.determinant() / edge.covariance.determinant()))
    }

    /// The least informative loop, and how much it tells, nats. Work: 3 solutions for each loop.
    fn least_informative(&self) -> Option<(usize, f32)> {
        let (factor, _) = self.solver.posterior();
        let gain = |(index, l): (usize, &Loop)| {
            let given = factor.inverse_block(index).determinant() * l.covariance.determinant();
            (index, -0.5 * libm::logf(given))
        };
        let known = self.loops.iter().enumerate().take(factor.loops());
        known.map(gain).min_by(|a, b| a.1.total_cmp(&b.1))
    }
}

impl Finder {
    pub const fn new() -> Self {
        Self { query: None, candidates: Vec::new(), found: Vec::new(), pending: Vec::new() }
    }

    /// Begins with a new place; one that is on its way is given up.
    pub fn begin<const P: usize>(&mut self, place: u16, chain: &Chain<P>) {
        self.candidates.clear();
        self.found.clear();
        self.pending.retain(|p| place.saturating_sub(p.edge.to) <= WAIT);
        let spread = Packed::of(&chain.prefix_sum(place.into()));
        self.query = Some(Query { place, spread, next: Some((0, Packed::ZERO)) });
    }

    /// The places have moved: what is under way begins anew.
    pub fn begin_anew<const P: usize>(&mut self, chain: &Chain<P>) {
        if let Some(query) = self.query {
            self.begin(query.place, chain);
        }
    }

    /// Gives up waiting for confirmation.
    pub fn drop_pending(&mut self) {
        self.pending.clear();
    }

    /// Whether an anchor is needed.
    pub fn needs(&self, index: usize) -> bool {
        let is_end = |f: &Found| usize::from(f.edge.from) == index || usize::from(f.edge.to) == index;
        self.pending.iter().chain(&self.found).any(is_end)
            || self.query.is_some_and(|q| usize::from(q.place) == index)
    }

    /// An anchor is gone, and those after it have moved up. The place on its way is given up.
    pub fn removed(&mut self, index: u16) {
        for found in &mut self.pending {
            found.edge.removed(index);
        }
        self.query = None;
        self.candidates.clear();
        self.found.clear();
    }

    /// Some of the work: sieves [`SIEVED`] places, or compares one, or decides. Returns the loops to be taken, and one that gives way.
    pub fn step<const P: usize>(&mut self, known: &Known<'_, P>) -> (Vec<Loop, AT_ONCE>, Option<usize>) {
        let Some(mut query) = self.query else { return Default::default() };
        if query.next.is_some() {
            self.sieve(&mut query, known);
            self.query = Some(query);
        } else if let Some(candidate) = self.candidates.pop() {
            if let Some(found) = compare(&query, &candidate, known) {
                let _ = self.found.push(found);
            }
        } else {
            self.query = None;
            return self.decide(known);
        }
        Default::default()
    }

    /// Which of the next places the new one may be.
    fn sieve<const P: usize>(&mut self, query: &mut Query, known: &Known<'_, P>) {
        let Some((first, spread)) = query.next.take() else { return };
        let after = first.saturating_add(SIEVED as u16);
        let mut is_last = after >= query.place;
        let (own, own_way_m) = (known.pose(query.place), known.way_m(query.place));
        let mut sum = spread.matrix();
        for place in (first..query.place).take(SIEVED) {
            let Some(anchor) = known.chain.get(place.into()) else { return };
            if own_way_m - anchor.way_m < known.config.min_way_m {
                // Those that follow are younger still.
                is_last = true;
                break;
            }
            if place > 0 {
                sum += anchor.spread(&anchor.pose);
            }
            let spread = Packed::of(&sum);
            let apart = (own.translation.vector - anchor.pose.translation.vector).norm();
            let covariance = known.covariance(place, &spread, query.place, &query.spread);
            let sigma = sqrt(covariance.m11 + covariance.m22);
            let rank = apart / (known.config.reach_m + 3.0 * sigma);
            if rank > 1.0 || anchor.lines.len() < 2 {
                continue;
            }
            if self.candidates.is_full() {
                let worst = self.candidates.iter().enumerate().max_by(|a, b| a.1.rank.total_cmp(&b.1.rank));
                let Some((index, _)) = worst.filter(|(_, worst)| worst.rank > rank) else { continue };
                self.candidates.swap_remove(index);
            }
            let _ = self.candidates.push(Candidate { place, spread, rank });
        }
        if is_last {
            sort_few(&mut self.candidates, |candidate| -candidate.rank);
        } else {
            query.next = Some((after, Packed::of(&sum)));
        }
    }

    /// Which matches of the place that is through are to be believed, with those they confirm.
    ///
    /// Work: [`AT_ONCE`] loops judged, and where there is no more room, the least informative one looked for.
    fn decide<const P: usize>(&mut self, known: &Known<'_, P>) -> (Vec<Loop, AT_ONCE>, Option<usize>) {
        let confirmed = |m: &Found| {
            known.config.confirmations == 0
                || self.pending.iter().any(|p| p.edge.to < m.edge.to && known.agree(&m.edge, &p.edge))
        };
        let new: Vec<Found, CANDIDATES> = self.found.iter().copied().filter(|m| confirmed(m)).collect();
        let mut taken: Vec<Loop, AT_ONCE> = Vec::new();
        let mut gives_way = None;
        let agrees = |p: &Found| new.iter().any(|m| m.edge.to > p.edge.to && known.agree(&m.edge, &p.edge));
        for found in &self.found {
            if self.pending.is_full() {
                self.pending.remove(0);
            }
            let _ = self.pending.push(*found);
        }
        let mut order: Vec<u8, PENDING> = (0..self.pending.len() as u8).collect();
        let share = |k: &u8| self.pending.get(usize::from(*k)).map_or(0.0, |p| p.share);
        sort_few(&mut order, |k| -share(k));
        let mut judged = 0;
        let mut least_informative = None;
        for k in order {
            let Some(found) = self.pending.get_mut(usize::from(k)) else { continue };
            let is_new = new.iter().any(|m| m.edge.to == found.edge.to && m.edge.from == found.edge.from);
            if found.taken || !(is_new || agrees(found)) {
                continue;
            }
            if judged == AT_ONCE {
                break;
            }
            judged += 1;
            let Some(gain) = known.gain(&found.edge).filter(|gain| *gain >= known.config.min_gain) else {
                continue;
            };
            if known.loops.len() + taken.len() >= LOOPS {
                // One at a time: the factor knows the loops as they are.
                if !taken.is_empty() {
                    break;
                }
                least_informative = least_informative.or_else(|| known.least_informative());
                let Some((index, least)) = least_informative else { break };
                if least >= gain {
                    continue;
                }
                gives_way = Some(index);
            }
            found.taken = true;
            let _ = taken.push(found.edge);
            if gives_way.is_some() {
                break;
            }
        }
        self.found.clear();
        (taken, gives_way)
    }
}

/// A new place among the lines of an old one.
fn compare<const P: usize>(query: &Query, candidate: &Candidate, known: &Known<'_, P>) -> Option<Found> {
    let (own, other) = (known.chain.get(query.place.into())?, known.chain.get(candidate.place.into())?);
    let covariance = known.covariance(candidate.place, &candidate.spread, query.place, &query.spread);
    let gate = Gate {
        predicted: other.pose.inv_mul(&own.pose),
        information: (covariance + diagonal(SLACK)).try_inverse()?,
        max_chi2: known.config.max_chi2,
    };
    let found = matched(&unpacked(&own.lines), &unpacked(&other.lines), &gate)?;
    let is_seen = found.share >= known.config.min_share
        && found.runner_up <= known.config.max_runner_up * found.share
        && found.weakest() >= known.config.min_information;
    let edge = Loop {
        from: candidate.place,
        to: query.place,
        measured: found.pose,
        covariance: covariance_of(&found)?,
    };
    is_seen.then_some(Found { edge, share: found.share, taken: false })
}

/// Covariance of a match in its own frame.
fn covariance_of(found: &Match) -> Option<Matrix3<f32>> {
    let information = found.information * DEPENDENT + diagonal(PRIOR.map(|s| 1.0 / s));
    Some(information.try_inverse()? + diagonal(FLOOR))
}

impl Loop {
    /// An anchor that is none of its ends is gone, and those after it have moved up.
    pub(super) fn removed(&mut self, index: u16) {
        for end in [&mut self.from, &mut self.to] {
            if *end > index {
                *end -= 1;
            }
        }
    }
}
