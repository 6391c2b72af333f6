//! The chain of anchors: where the places are, how the robot went from each to the next, and how sure that is.
//!
//! How sure goes by what supported the front end on the way, not by its own covariance: that knows nothing of walls taken for
//! others, and is too small by an order of magnitude (with it loops are refused that are right).

use heapless::Vec;
use nalgebra::{Isometry2, Matrix3};

use super::lines::PlaceLines;
use super::twist::adjoint;
use crate::geometry::pose::{normalized, turn};
use crate::odometry::Increment;
use crate::tracking::correction::Verdict;

/// A place: an anchor in `map`, the edge that leads to it, and what is seen there.
#[derive(Clone, Debug)]
pub struct Anchor {
    /// Pose in `map`, as corrected by now.
    pub(crate) pose: Isometry2<f32>,
    /// From the anchor before, as the front end drove.
    pub(crate) from_previous: Isometry2<f32>,
    /// Variances of that motion (along m², across m², heading rad²) in the frame of this anchor.
    pub(crate) variances: [f32; 3],
    /// Way driven until here, metres.
    pub(crate) way_m: f32,
    /// Its lines.
    pub(crate) lines: PlaceLines,
}

impl Anchor {
    /// Pose in `map`.
    pub fn pose(&self) -> Isometry2<f32> {
        self.pose
    }

    /// Way driven until here, metres.
    pub fn way_m(&self) -> f32 {
        self.way_m
    }

    /// What it adds to the prefix sum, seen from a pose: Ad·Q·Adᵀ.
    pub(super) fn spread(&self, at: &Isometry2<f32>) -> Matrix3<f64> {
        let ad = adjoint(at);
        let [along, across, heading] = self.variances.map(f64::from);
        let (u, v, w) = (ad.column(0), ad.column(1), ad.column(2));
        u * u.transpose() * along + v * v.transpose() * across + w * w.transpose() * heading
    }
}

/// How well the front end was supported since the last anchor.
#[derive(Clone, Copy, Debug)]
pub struct Support {
    /// Way driven, metres, …
    way_m: f32,
    /// … turned, radians, …
    turn_rad: f32,
    /// … driven where scans fixed heading and one direction only, …
    corridor_m: f32,
    /// … and where they fixed nothing.
    blind_m: f32,
    /// Whether a scan was hardly explained.
    is_low: bool,
}

/// A motion that is no number counts as this way unseen, metres.
const UNKNOWN_M: f32 = 1.0;
/// Less explained than this is hardly explained.
const LOW_SUPPORT: f32 = 0.7;

impl Support {
    /// Nothing driven.
    pub const NONE: Self = Self { way_m: 0.0, turn_rad: 0.0, corridor_m: 0.0, blind_m: 0.0, is_low: false };

    /// Takes in a motion, and what the scan after it made of the pose.
    pub fn add(&mut self, motion: &Increment, verdict: Verdict, support: f32) {
        if !motion.is_finite() {
            self.lose();
            return;
        }
        self.way_m += motion.distance_m;
        self.turn_rad += motion.turn_rad.abs();
        match verdict {
            Verdict::Full => {}
            Verdict::Corridor => self.corridor_m += motion.distance_m,
            Verdict::Blind => self.blind_m += motion.distance_m,
        }
        self.is_low |= support < LOW_SUPPORT || verdict == Verdict::Blind;
    }

    /// The motion since is not known, but for what the map says of it.
    pub fn lose(&mut self) {
        self.blind_m += UNKNOWN_M;
        self.is_low = true;
    }

    /// Variances of the motion (along, across, heading), standard deviations times `scale`. For 4 m of way that is well supported 1 cm
    /// and 0.15°; in a corridor 6 cm for each √m along it; where nothing was seen 10 cm and 3° for each √m, once more 5 cm and 1.5°
    /// where a scan was not recognised. Chosen on aces, mit-csail and fr079, see `lineslam benchmark`.
    pub fn variances(&self, scale: f32) -> [f32; 3] {
        const RAD: f32 = core::f32::consts::PI / 180.0;
        let square = |v: f32| v * v;
        let low = if self.is_low { 1.0 } else { 0.0 };
        let pieces = 1.0 + self.way_m / 4.0;
        let across = square(0.01) * pieces + square(0.1) * self.blind_m + square(0.05) * low;
        let along = across + square(0.06) * self.corridor_m;
        let heading = square(0.15 * RAD) * (pieces + self.turn_rad / core::f32::consts::FRAC_PI_2)
            + square(3.0 * RAD) * self.blind_m
            + square(1.5 * RAD) * low;
        [along, across, heading].map(|v| v * square(scale))
    }
}

/// Up to `P` anchors, in the order in which the robot came to them.
#[derive(Clone, Debug)]
pub struct Chain<const P: usize> {
    pub(super) anchors: Vec<Anchor, P>,
}

impl<const P: usize> Chain<P> {
    pub(crate) const fn new() -> Self {
        Self { anchors: Vec::new() }
    }

    /// The anchors.
    pub fn anchors(&self) -> &[Anchor] {
        &self.anchors
    }

    pub(super) fn get(&self, index: usize) -> Option<&Anchor> {
        self.anchors.get(index)
    }

    /// Adds an anchor at a pose; false where there is no room.
    pub(super) fn push(&mut self, pose: Isometry2<f32>, way_m: f32, variances: [f32; 3]) -> bool {
        let from_previous =
            self.anchors.last().map_or_else(Isometry2::identity, |last| last.pose.inv_mul(&pose));
        let lines = PlaceLines::default();
        self.anchors.push(Anchor { pose, from_previous, variances, way_m, lines }).is_ok()
    }

    /// The least informative anchor of those in the inside of the chain that are not `needed`: the one between the two that lie closest
    /// together along the way, or half as far where another place lies close by.
    pub(super) fn least_informative(&self, needed: impl Fn(usize) -> bool) -> Option<usize> {
        let inside = 1..self.anchors.len().saturating_sub(2);
        let cost = |index: usize| {
            let (before, own, after) =
                (self.get(index.checked_sub(1)?)?, self.get(index)?, self.get(index + 1)?);
            let is_near = |(other, anchor): (usize, &Anchor)| {
                other.abs_diff(index) > 2
                    && (anchor.pose.translation.vector - own.pose.translation.vector).norm_squared() < NEAR_M2
                    && turn(&anchor.pose, &own.pose).abs() < NEAR_RAD
            };
            let double = self.anchors.iter().enumerate().any(is_near);
            Some((after.way_m - before.way_m) * if double { 0.5 } else { 1.0 })
        };
        inside
            .filter(|index| !needed(*index))
            .filter_map(|index| Some((index, cost(index)?)))
            .min_by(|a, b| a.1.total_cmp(&b.1))
            .map(|(index, _)| index)
    }

    /// Removes an anchor; the edges on both sides become one.
    pub(super) fn remove(&mut self, index: usize) {
        if index >= self.anchors.len() {
            return;
        }
        let gone = self.anchors.remove(index);
        let Some(next) = self.anchors.get_mut(index) else { return };
        // The first edge's heading swings what comes after it; off-diagonal elements are left out.
        let later_from_gone = next.from_previous;
        let lever = later_from_gone.inverse().translation.vector;
        let (c2, s2) = (
            later_from_gone.rotation.re * later_from_gone.rotation.re,
            later_from_gone.rotation.im * later_from_gone.rotation.im,
        );
        let [along, across, heading] = gone.variances;
        let [a, b, h] = &mut next.variances;
        *a += c2 * along + s2 * across + lever.y * lever.y * heading;
        *b += s2 * along + c2 * across + lever.x * lever.x * heading;
        *h += heading;
        next.from_previous = normalized(&(gone.from_previous * later_from_gone));
    }

    /// Prefix sum of the variances of the edges up to an anchor, about the origin.
    pub(super) fn prefix_sum(&self, index: usize) -> Matrix3<f64> {
        self.prefix_sums([index, index])[1]
    }

    /// The same up to two anchors, the earlier one first, in one pass.
    pub(super) fn prefix_sums(&self, [first, second]: [usize; 2]) -> [Matrix3<f64>; 2] {
        let edges = |from: usize, to: usize| self.anchors.iter().take(to + 1).skip(from.saturating_add(1));
        let sum = |start, from, to| {
            edges(from, to).fold(start, |sum, anchor: &Anchor| sum + anchor.spread(&anchor.pose))
        };
        let before = sum(Matrix3::zeros(), 0, first);
        [before, sum(before, first, second)]
    }
}

/// Places as close as this, and as alike in heading, show the same.
const NEAR_M2: f32 = 9.0;
const NEAR_RAD: f32 = 0.8;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::pose::{components, pose};

    #[test]
    fn what_was_not_seen_makes_the_chain_unsure() {
        let motion = Increment::from_motion(pose(0.5, 0.0, 0.1));
        let of = |verdict, score| {
            let mut support = Support::NONE;
            (0..8).for_each(|_| support.add(&motion, verdict, score));
            support.variances(1.0)
        };
        let [along, across, heading] = of(Verdict::Full, 0.9);
        assert!((along - 2e-4).abs() < 1e-6 && along == across && heading < 3e-5, "{along} {heading}");
        let corridor = of(Verdict::Corridor, 0.9);
        assert!(corridor[0] > 0.014 && corridor[1] == across && corridor[2] == heading);
        let low = of(Verdict::Full, 0.5);
        assert!(low[2] > 20.0 * heading && low[0] > along);
        let blind = of(Verdict::Blind, 0.0);
        assert!(blind[2] > 10.0 * low[2] && blind[1] > low[1]);
    }

    #[test]
    fn an_anchor_that_is_removed_leaves_the_way_and_the_sums() {
        let mut chain = Chain::<8>::new();
        let variances = [1e-3, 2e-3, 1e-4];
        for k in 0..5 {
            assert!(chain.push(
                pose(4.0 * k as f32, 0.1 * k as f32, 0.3 * k as f32),
                4.0 * k as f32,
                variances
            ));
        }
        let (sum, last) = (chain.prefix_sum(4), chain.anchors[4].pose);
        let way = |chain: &Chain<8>| {
            chain.anchors[1..].iter().fold(chain.anchors[0].pose, |p, a| p * a.from_previous)
        };
        chain.remove(2);
        assert_eq!(chain.anchors.len(), 4);
        assert!((components(&way(&chain)) - components(&last)).norm() < 1e-4);
        let after = chain.prefix_sum(3);
        let apart = (after - sum).amax() / sum.amax();
        assert!(apart < 0.2, "{apart}: {after} {sum}");
        assert_eq!(chain.least_informative(|_| false), Some(1), "ways of 12 m against 16 m");
        assert_eq!(chain.least_informative(|_| true), None);
    }
}
