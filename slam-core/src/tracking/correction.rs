//! The pose that makes pairs of segments agree.
//!
//! In: observed segments in `base`, their pairs in the map, the predicted pose with its covariance. Out: the corrected
//! pose with covariance, and how well each direction of the pose is seen.
//!
//! The paper's is in [`least_squares`](mod@crate::paper::least_squares): solved once, no prior.
//! [`maximum_a_posteriori`] is one Gauss-Newton step of the default: the odometry is a prior, each pair weighs by its
//! lines' covariances, a robust kernel turns down pairs that do not fit, and information that is only an artefact of
//! uncertain line directions is taken out (see [`Observability`]).

use nalgebra::{Isometry2, Matrix2, Matrix3, Vector2, Vector3};

use crate::geometry::line_noise::LineNoise;
use crate::geometry::line_observation::Residual;
use crate::geometry::math::{max, min, sqrt};
use crate::geometry::pose::{components, perpendicular, pose};
use crate::geometry::segment::Segment;
use crate::map::MapSegment;
use crate::paper::least_squares::LeastSquaresConfig;
use crate::tracking::SearchConfig;
use crate::tracking::association::Pair;

/// How the pose is corrected.
#[derive(Clone, Copy, Debug, PartialEq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize), serde(rename_all = "snake_case"))]
pub enum CorrectionConfig {
    /// Equations (3)–(9) of the paper.
    LeastSquares(LeastSquaresConfig),
    /// Maximum a posteriori, iterated with re-association.
    MaximumAPosteriori(GaussNewtonConfig),
}

/// Settings of the maximum-a-posteriori correction.
#[derive(Clone, Copy, Debug, PartialEq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct GaussNewtonConfig {
    /// Most rounds of association and step.
    pub max_iterations: u8,
    /// A step shorter than this ends the rounds, metres and radians alike.
    pub converged_step: f32,
    /// Scale of the Cauchy kernel: a pair of this χ² keeps half its weight.
    pub kernel_chi2: f32,
    /// A prediction surer of its heading than this, standard deviation in radians, is close: few pairs are wrong, so that
    /// the kernel forgives them what the prediction may be off by. Farther off, pairs that agree with it lead.
    pub close_heading_rad: f32,
    /// Directions of lines are not trusted beyond this, radians: translation information across nearly parallel
    /// lines that so small an error would explain is not used.
    pub direction_trust_rad: f32,
    /// A direction is called observable when the lines alone fix it better than this, metres.
    pub observable_sigma_m: f32,
    /// Search for a better start.
    pub search: SearchConfig,
}

/// Which directions of the pose the pairs fix.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Observability {
    /// Normal matrix of the pairs over (x, y, θ·1 m), 1/m². The prior is not in it.
    pub information: Matrix3<f32>,
    /// Unit direction in `map` along which translation is seen worst.
    pub weak_direction: Vector2<f32>,
    /// Standard deviation along that direction from the pairs alone, metres; infinite when they say nothing.
    pub weak_sigma_m: f32,
    /// Share of the information along that direction that uncertain line directions do not explain, 0 to 1.
    pub trusted_share: f32,
    /// The judgement.
    pub verdict: Verdict,
}

/// Judgement of an [`Observability`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Verdict {
    /// Position and heading are fixed by the pairs.
    Full,
    /// Heading and one direction are; along the other the odometry decides.
    Corridor,
    /// No pair: the odometry decides everything.
    Blind,
}

impl Observability {
    /// Nothing seen.
    pub const BLIND: Self = Self {
        information: Matrix3::new(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
        weak_direction: Vector2::new(1.0, 0.0),
        weak_sigma_m: f32::INFINITY,
        trusted_share: 0.0,
        verdict: Verdict::Blind,
    };

    /// Eigenvalues of the normal matrix, ascending, 1/m²: how much is known of each direction of the pose.
    pub fn eigenvalues(&self) -> [f32; 3] {
        sorted_eigenvalues(&self.information)
    }

    /// The matrix T that turns a derivative J by the position into J·T, so that the weak direction keeps its trusted
    /// information only.
    pub fn trusted(&self) -> Matrix2<f32> {
        let v = self.weak_direction;
        Matrix2::identity() - v * v.transpose() * (1.0 - sqrt(self.trusted_share))
    }
}

/// Outcome of one correction step.
#[derive(Clone, Copy, Debug)]
pub struct Correction {
    /// Corrected pose of `base` in `map`.
    pub pose: Isometry2<f32>,
    /// Its covariance (x, y, θ) in `map`.
    pub covariance: Matrix3<f32>,
    /// Larger of the steps in position (m) and heading (rad).
    pub step: f32,
    /// Directions the pairs fix.
    pub observability: Observability,
}

/// Predicted pose and covariance: where the correction starts and what it is drawn to.
#[derive(Clone, Copy, Debug)]
pub struct Prior {
    /// Pose of `base` in `map`.
    pub pose: Isometry2<f32>,
    /// Covariance (x, y, θ) in `map`.
    pub covariance: Matrix3<f32>,
}

/// Where a step towards the posterior is made from.
#[derive(Clone, Copy, Debug)]
pub struct Standpoint<'a> {
    /// Pose of `base` in `map`.
    pub pose: &'a Isometry2<f32>,
    /// Covariance (x, y, θ) of that pose, in `map`: the kernel forgives pairs the misfit that it explains. Without, none.
    pub forgiven: Option<&'a Matrix3<f32>>,
}

/// One Gauss-Newton step towards the pose of largest posterior probability.
///
/// `None` when the numbers do not allow a step (a prior that is not positive definite, infinities). Work: one step
/// for each pair.
pub fn maximum_a_posteriori(
    observed: &[Segment],
    pairs: &[Pair],
    map: &[MapSegment],
    prior: &Prior,
    from: &Standpoint<'_>,
    line_noise: &LineNoise,
    config: &GaussNewtonConfig,
) -> Option<Correction> {
    let (information, gradient) = pair_sums(observed, pairs, map, from, line_noise, config);
    let observability = judge(&information, config.direction_trust_rad, config.observable_sigma_m);
    let mut trust = Matrix3::identity();
    trust.fixed_view_mut::<2, 2>(0, 0).copy_from(&observability.trusted());
    let prior_information = prior.covariance.cholesky()?.inverse();
    let (at, to) = (components(from.pose), components(&prior.pose));
    let mut drawn = to - at;
    drawn.z = crate::geometry::math::wrap_angle(drawn.z);
    let total = trust * information * trust + prior_information;
    let covariance = total.cholesky()?.inverse();
    let step = covariance * (trust * gradient + prior_information * drawn);
    let corrected = pose(at.x + step.x, at.y + step.y, at.z + step.z);
    finite(Correction { pose: corrected, covariance, step: largest(&step), observability })
}

/// Normal matrix and right-hand side of the pairs, each weighed by its lines' covariance and the Cauchy kernel.
fn pair_sums(
    observed: &[Segment],
    pairs: &[Pair],
    map: &[MapSegment],
    from: &Standpoint<'_>,
    line_noise: &LineNoise,
    config: &GaussNewtonConfig,
) -> (Matrix3<f32>, Vector3<f32>) {
    let (mut information, mut gradient) = (Matrix3::zeros(), Vector3::zeros());
    let position = from.pose.translation.vector.into();
    for pair in pairs {
        let (Some(seen), Some(entry)) = (observed.get(pair.observed), map.get(pair.mapped)) else { continue };
        let seen = seen.transformed(from.pose);
        let Some(residual) = Residual::new(&seen, &entry.segment(), position, line_noise) else { continue };
        let Some(weight) = residual.information() else { continue };
        let chi2 = match from.forgiven {
            Some(covariance) => residual.chi2(covariance),
            None => residual.error.dot(&(weight * residual.error)),
        };
        let kept = weight / (1.0 + chi2 / config.kernel_chi2);
        let weighed = residual.jacobian.transpose() * kept;
        information += weighed * residual.jacobian;
        gradient -= weighed * residual.error;
    }
    (information, gradient)
}

/// Information about translation once the heading is free: Schur complement of the normal matrix.
fn translation_information(information: &Matrix3<f32>) -> Matrix2<f32> {
    let coupling = Vector2::new(information.m13, information.m23);
    let translation = information.fixed_view::<2, 2>(0, 0).into_owned();
    if information.m33 > 0.0 {
        translation - coupling * coupling.transpose() / information.m33
    } else {
        translation
    }
}

/// What a normal matrix says of each direction; see [`GaussNewtonConfig`] for the two limits.
pub(crate) fn judge(
    information: &Matrix3<f32>,
    direction_trust_rad: f32,
    observable_sigma_m: f32,
) -> Observability {
    let trace = information.trace();
    if !(trace > 0.0 && trace.is_finite()) {
        return Observability::BLIND;
    }
    let [(strong, _), (weak, weak_direction)] = eigen2(&translation_information(information));
    let usable = usable_information(weak, strong, direction_trust_rad);
    let trusted_share = if weak > 0.0 { usable / weak } else { 0.0 };
    let weak_sigma_m = if usable > 0.0 { 1.0 / sqrt(usable) } else { f32::INFINITY };
    let verdict = if weak_sigma_m <= observable_sigma_m { Verdict::Full } else { Verdict::Corridor };
    Observability { information: *information, weak_direction, weak_sigma_m, trusted_share, verdict }
}

/// What remains of the weak direction's information when that which uncertain line directions explain is taken out.
fn usable_information(weak: f32, strong: f32, direction_trust_rad: f32) -> f32 {
    max(weak - direction_trust_rad * direction_trust_rad * strong, 0.0)
}

/// Eigenvalues and unit eigenvectors of a symmetric matrix, the larger first.
fn eigen2(m: &Matrix2<f32>) -> [(f32, Vector2<f32>); 2] {
    let scatter = crate::geometry::segment::Moments {
        scatter: [m.m11, m.m12, m.m22],
        ..crate::geometry::segment::Moments::EMPTY
    };
    let strong = scatter.direction();
    let weak = perpendicular(strong);
    [(scatter.scatter_along(strong), strong), (scatter.scatter_along(weak), weak)]
}

fn sorted_eigenvalues(m: &Matrix3<f32>) -> [f32; 3] {
    if !m.iter().all(|v| v.is_finite()) {
        return [0.0; 3];
    }
    let values = nalgebra::SymmetricEigen::try_new(*m, f32::EPSILON, 50).map(|e| e.eigenvalues);
    let [a, b, c] = values.map_or([0.0; 3], |v| [v.x, v.y, v.z]);
    let (a, b) = (min(a, b), max(a, b));
    let (b, c) = (min(b, c), max(b, c));
    [min(a, b), max(a, b), c]
}

pub(crate) fn largest(step: &Vector3<f32>) -> f32 {
    max(max(step.x.abs(), step.y.abs()), step.z.abs())
}

pub(crate) fn finite(correction: Correction) -> Option<Correction> {
    let covariance_is_finite = correction.covariance.iter().all(|v| v.is_finite());
    (crate::geometry::pose::is_finite(&correction.pose) && covariance_is_finite).then_some(correction)
}

#[cfg(test)]
mod tests;
