//! One guess at where the robot is, and how well it explains the scan.

use nalgebra::{Isometry2, Matrix2, Matrix3};

use crate::geometry::line_noise::LineNoise;
use crate::geometry::line_observation::Residual;
use crate::geometry::math::{max, within};
use crate::geometry::segment::Segment;
use crate::map::MapSegment;
use crate::tracking::association::Pair;
use crate::tracking::correction::{Observability, Prior};

/// A pair whose χ² is this large says nothing for a hypothesis: the 99.9 % point for two degrees of freedom.
const MAX_CHI2: f32 = 13.8;
/// What a line may be off by in a score beyond what it states, m² and rad²: 2 cm and 0.01 rad. Chosen on the recorded logs of
/// `lineslam benchmark`.
const SLACK: [f32; 2] = [4e-4, 1e-4];

/// One guess at where the robot is.
#[derive(Clone, Debug)]
pub struct Hypothesis {
    /// Pose of `base` in `map`.
    pub pose: Isometry2<f32>,
    /// Its covariance (x, y, θ) in `map`, the errors of the lines aside.
    pub covariance: Matrix3<f32>,
    /// Observed segments that have a pair in the map; which, the tracker knows of the last.
    pub paired: u8,
    /// Share of the scan that it explains, 0 to 1; see [`tight_score`].
    pub score: f32,
    /// Segments that it explains, each by its share.
    pub explained: f32,
    /// Directions of the pose that the pairs fix.
    pub observability: Observability,
    /// Whether pairs had a say in the pose.
    pub corrected: bool,
}

impl Hypothesis {
    /// The prior, before anything was looked at.
    pub fn of_prior(prior: &Prior) -> Self {
        Self::at(prior.pose, prior.covariance)
    }

    /// A start of the rounds of association and correction.
    pub fn at(pose: Isometry2<f32>, covariance: Matrix3<f32>) -> Self {
        let observability = Observability::BLIND;
        Self { pose, covariance, paired: 0, score: 0.0, explained: 0.0, observability, corrected: false }
    }
}

/// Share of the observed inliers that the pairs explain: each segment counts by how well it lies on its map line,
/// 1 − χ²/13.8, and, by half, by the share of it that lies within the map segment.
///
/// Segments that do not count, by their index, are left out, explained or not. χ² has the lines' variances and a fixed slack in it and
/// nothing of the pose's: a pose that is less sure does not fit better.
pub fn tight_score(
    observed: &[Segment],
    pairs: &[Pair],
    map: &[MapSegment],
    pose: &Isometry2<f32>,
    line_noise: &LineNoise,
    counts: impl Fn(usize) -> bool,
) -> (f32, f32) {
    let all: f32 =
        observed.iter().enumerate().filter(|(k, _)| counts(*k)).map(|(_, s)| s.moments.inliers as f32).sum();
    let explained = |pair: &Pair| {
        let (seen, entry) =
            (observed.get(pair.observed).filter(|_| counts(pair.observed))?, map.get(pair.mapped)?);
        let in_map = seen.transformed(pose);
        let mapped = entry.segment();
        let residual = Residual::new(&in_map, &mapped, pose.translation.vector.into(), line_noise)?;
        let covariance = residual.covariance + Matrix2::new(SLACK[0], 0.0, 0.0, SLACK[1]);
        let chi2 = residual.error.dot(&(covariance.try_inverse()? * residual.error));
        let overlap = within(mapped.overlap_m(&in_map) / max(in_map.length_m(), 0.01), 0.0, 1.0);
        let share = max(1.0 - chi2 / MAX_CHI2, 0.0) * (0.5 + 0.5 * overlap);
        Some((seen.moments.inliers as f32 * share, share))
    };
    let (sum, count) = pairs.iter().filter_map(explained).fold((0.0, 0.0), |a, b| (a.0 + b.0, a.1 + b.1));
    (if all > 0.0 { sum / all } else { 0.0 }, count)
}
