//! The poses of all anchors by chain and loops, in the space of the loops.
//!
//! In: the chain and the loops. Out: corrected poses. Written as twists about one origin the errors ξ of the chain's edges add: a loop
//! from place i to place j sees Σ ξ_k over the edges between. With C_n the prefix sum of the edges' covariances Ad·Q·Adᵀ, the
//! covariance of loops a and b is that of the edges both span,
//!
//! ```text
//! S_ab = C[min(j_a, j_b)] − C[max(i_a, i_b)] (zero where that is empty) + R_a on the diagonal,
//! S·λ = e,    d_n = Σ_a (C[min(n, j_a)] − C[i_a])·λ_a over the loops with i_a < n,
//! ```
//!
//! which is the information form of a pose graph by the matrix inversion lemma: three unknowns for each loop, none for places, and
//! without loops nothing to solve. A round linearizes at the poses of the last, with the chain's own deviation from what was measured put
//! back into e: the minimum is that of Gauss-Newton over all poses, to which it is compared in tests.
//!
//! Sums are `f64`, each loop's rows of S are written in the frame of its own end, the factor is `f32`.

use heapless::Vec;
use nalgebra::{Isometry2, Matrix3, Vector3};

use super::chain::{Anchor, Chain};
use super::factor::{Column, Factor, LOOPS, ROWS, set_three, three};
use super::twist::{Packed, adjoint, inverse_adjoint, to_f32, to_f64};
use crate::geometry::math::max;
use crate::geometry::pose::{exp, is_finite, log, normalized};

/// Rounds of a solution.
const ROUNDS: u8 = 4;
/// Fewest rounds, where the last one has moved no place by more than [`CONVERGED`], metres and radians alike.
const LEAST_ROUNDS: u8 = 3;
const CONVERGED: f32 = 1e-3;
/// Loops whose rows are made in one step.
const LOOPS_PER_STEP: usize = 4;

/// Two places are one: a measurement.
#[derive(Clone, Copy, Debug)]
pub struct Loop {
    /// Index of the older place.
    pub from: u16,
    /// Index of the younger place.
    pub to: u16,
    /// Pose of the younger place in the older one's frame.
    pub measured: Isometry2<f32>,
    /// Covariance (x, y, θ) of that in the younger one's frame.
    pub covariance: Matrix3<f32>,
}

/// Where a solution stands.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Step {
    Idle,
    /// The prefix sums at the loops' ends, and the errors, come next.
    Sums,
    /// The rows of this loop come next.
    Rows(usize),
    /// The poses come next.
    Poses,
}

/// What a step came to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Progress {
    /// There is more to do.
    Going,
    /// The solution is ready.
    Done,
    /// There is none: S is not positive definite, or a number is not finite.
    Failed,
}

/// A solution on its way. RAM: 16·`P` bytes and 7 KiB.
#[derive(Clone, Debug)]
pub struct Solver<const P: usize> {
    /// On the way those of the solution, afterwards those it replaced.
    poses: Vec<Isometry2<f32>, P>,
    step: Step,
    round: u8,
    factor: Factor,
    right: Column,
    /// Prefix sums at both ends of each loop.
    ends: [[Packed; 2]; LOOPS],
}

impl<const P: usize> Solver<P> {
    pub(super) const fn new() -> Self {
        Self {
            poses: Vec::new(),
            step: Step::Idle,
            round: 0,
            factor: Factor::new(),
            right: [0.0; ROWS],
            ends: [[Packed::ZERO; 2]; LOOPS],
        }
    }

    /// Whether a solution is on its way.
    pub fn is_busy(&self) -> bool {
        self.step != Step::Idle
    }

    /// The factor of the last solution, and prefix sums at the loops' ends.
    pub(super) fn posterior(&self) -> (&Factor, &[[Packed; 2]; LOOPS]) {
        (&self.factor, &self.ends)
    }

    /// Begins a solution. Chain and loops must stay as they are until it is done, but for anchors that are added.
    pub(super) fn begin(&mut self, chain: &Chain<P>) {
        self.poses.clear();
        self.poses.extend(chain.anchors().iter().map(Anchor::pose));
        (self.step, self.round) = (Step::Sums, 0);
    }

    /// Drops what is on its way, and what of the last solution is known.
    pub(super) fn clear(&mut self) {
        self.step = Step::Idle;
        self.poses.clear();
        self.factor.clear();
    }

    /// Some of the work. Work: the sums and the poses pass over the chain, with 60 steps in `f64` for each anchor; else the rows of
    /// [`LOOPS_PER_STEP`] loops, 54 steps in `f64` and 13 ·[`LOOPS`] in `f32` for each pair of loops at most. A solution with `n` loops takes
    /// ⌈n / 4⌉ + 2 steps for each of 3 or 4 rounds.
    pub(super) fn step(&mut self, chain: &Chain<P>, loops: &[Loop]) -> Progress {
        let progress = match self.step {
            Step::Idle => Progress::Done,
            Step::Sums => self.sums(chain, loops),
            Step::Rows(next) => self.rows(next, loops),
            Step::Poses => self.correct(chain, loops),
        };
        if progress != Progress::Going {
            self.step = Step::Idle;
        }
        progress
    }

    /// Puts the solution into the chain. Anchors added since it began move with the last that it knew. The poses it replaces take its place.
    pub(super) fn swap_in(&mut self, chain: &mut Chain<P>) {
        let mut moved = Isometry2::identity();
        let known = self.poses.len();
        for (anchor, solved) in chain.anchors.iter_mut().zip(self.poses.iter_mut()) {
            moved = *solved * anchor.pose.inverse();
            core::mem::swap(&mut anchor.pose, solved);
        }
        let moved = normalized(&moved);
        for anchor in chain.anchors.iter_mut().skip(known) {
            let _ = self.poses.push(anchor.pose);
            anchor.pose = normalized(&(moved * anchor.pose));
        }
    }

    /// The poses before [`Self::swap_in`], as many as the chain had anchors then; until the next solution begins.
    pub(super) fn replaced(&self) -> &[Isometry2<f32>] {
        &self.poses
    }

    fn pose(&self, index: u16) -> Isometry2<f32> {
        self.poses.get(usize::from(index)).copied().unwrap_or_else(Isometry2::identity)
    }

    /// Passes along the chain: the prefix sums at the loops' ends, and what each loop is off by, with the chain's own deviation put back.
    fn sums(&mut self, chain: &Chain<P>, loops: &[Loop]) -> Progress {
        let mut deviations = [[Vector3::<f64>::zeros(); 2]; LOOPS];
        let mut pass = Pass::default();
        for (index, (anchor, pose)) in chain.anchors().iter().zip(&self.poses).enumerate() {
            pass.go_on(anchor, pose);
            let slots = self.ends.iter_mut().flatten().zip(deviations.iter_mut().flatten());
            for (end, (sum, deviation)) in loops.iter().flat_map(|l| [l.from, l.to]).zip(slots) {
                if usize::from(end) == index {
                    (*sum, *deviation) = (Packed::of(&pass.spread), pass.deviation);
                }
            }
        }
        for (index, (l, [from, to])) in loops.iter().zip(deviations).enumerate() {
            let (own, other) = (self.pose(l.to), self.pose(l.from));
            let error = log(&own.inv_mul(&(other * l.measured)));
            let put_back = inverse_adjoint(&own) * (to - from);
            set_three(&mut self.right, index, &(error + to_f32(&put_back)));
        }
        self.factor.clear();
        self.step = Step::Rows(0);
        Progress::Going
    }

    /// The next rows of S, and of its factor.
    fn rows(&mut self, next: usize, loops: &[Loop]) -> Progress {
        let last = (next + LOOPS_PER_STEP).min(loops.len());
        for a in next..last {
            let Some(own) = loops.get(a) else { return Progress::Failed };
            let Self { poses, ends, factor, .. } = self;
            let to_end =
                |l: &Loop| poses.get(usize::from(l.to)).map_or_else(Matrix3::identity, inverse_adjoint);
            let to_own = to_end(own);
            let block = |b: usize| {
                let Some(other) = loops.get(b) else { return Matrix3::zeros() };
                let shared = overlap(ends, (a, own), (b, other)).map_or_else(Matrix3::zeros, |c| {
                    (to_own * c * to_end(other).transpose()).map(|v| v as f32)
                });
                if a == b { shared + own.covariance } else { shared }
            };
            if !factor.append(block) {
                return Progress::Failed;
            }
        }
        self.step = if last < loops.len() { Step::Rows(last) } else { Step::Poses };
        Progress::Going
    }

    /// Solves, and moves the poses.
    fn correct(&mut self, chain: &Chain<P>, loops: &[Loop]) -> Progress {
        let mut lambda = self.right;
        self.factor.forward(&mut lambda);
        self.factor.backward(&mut lambda);
        let about_origin = |(index, l): (usize, &Loop)| {
            inverse_adjoint(&self.pose(l.to)).transpose() * to_f64(&three(&lambda, index))
        };
        let lambdas: Vec<Vector3<f64>, LOOPS> =
            loops.iter().enumerate().map(about_origin).take(LOOPS).collect();
        let (mut pass, mut pull, mut sum) = (Pass::default(), Vector3::zeros(), Vector3::zeros());
        let mut largest = 0.0f32;
        for (index, (anchor, pose)) in chain.anchors().iter().zip(&mut self.poses).enumerate() {
            let before = pass.spread;
            pass.go_on(anchor, pose);
            sum += (pass.spread - before) * pull;
            for (l, lambda) in loops.iter().zip(&lambdas) {
                if usize::from(l.from) == index {
                    pull += lambda;
                }
                if usize::from(l.to) == index {
                    pull -= lambda;
                }
            }
            let step = to_f32(&(inverse_adjoint(pose) * (sum - pass.deviation)));
            largest = max(largest, step.amax());
            *pose = normalized(&(*pose * exp(&step)));
            if !is_finite(pose) {
                return Progress::Failed;
            }
        }
        self.round += 1;
        if self.round >= ROUNDS || self.round >= LEAST_ROUNDS && largest < CONVERGED {
            return Progress::Done;
        }
        self.step = Step::Sums;
        Progress::Going
    }
}

/// Covariance about the origin of the edges that two loops have in common.
fn overlap(
    ends: &[[Packed; 2]; LOOPS],
    (a, own): (usize, &Loop),
    (b, other): (usize, &Loop),
) -> Option<Matrix3<f64>> {
    let ([own_from, own_to], [other_from, other_to]) = (ends.get(a)?, ends.get(b)?);
    let (from, begin) = if own.from >= other.from { (own.from, own_from) } else { (other.from, other_from) };
    let (to, end) = if own.to <= other.to { (own.to, own_to) } else { (other.to, other_to) };
    (from < to).then(|| end.minus(begin))
}

/// A pass along the chain.
struct Pass {
    /// Prefix sum of the edges' covariances, about the origin.
    spread: Matrix3<f64>,
    /// Of what the poses deviate from the edges by.
    deviation: Vector3<f64>,
    before: Option<Isometry2<f32>>,
}

impl Default for Pass {
    fn default() -> Self {
        Self { spread: Matrix3::zeros(), deviation: Vector3::zeros(), before: None }
    }
}

impl Pass {
    fn go_on(&mut self, anchor: &Anchor, pose: &Isometry2<f32>) {
        if let Some(before) = self.before {
            self.spread += anchor.spread(pose);
            let off = log(&(before * anchor.from_previous).inv_mul(pose));
            self.deviation += adjoint(pose) * to_f64(&off);
        }
        self.before = Some(*pose);
    }
}

#[cfg(test)]
mod tests;
