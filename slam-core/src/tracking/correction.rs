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
        let Some(residual) = Residual::new(&seen, &entry.segment, position, line_noise) else { continue };
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
mod tests {
    use super::*;
    use crate::geometry::segment::Moments;
    use crate::paper::fixtures::{all_pairs, entries, room, wall};
    use nalgebra::Point2;
    use proptest::prelude::*;
    use std::vec::Vec;

    const NOISE: LineNoise = LineNoise { sigma_offset_m: 0.005, sigma_direction_rad: 0.002 };

    fn config() -> GaussNewtonConfig {
        match crate::SlamConfig::default().correction {
            CorrectionConfig::MaximumAPosteriori(config) => config,
            CorrectionConfig::LeastSquares(_) => unreachable!("the default is maximum a posteriori"),
        }
    }

    /// A step that forgives nothing.
    fn strict_step(
        observed: &[Segment],
        pairs: &[Pair],
        map: &[MapSegment],
        prior: &Prior,
        at: &Isometry2<f32>,
    ) -> Option<Correction> {
        let from = Standpoint { pose: at, forgiven: None };
        maximum_a_posteriori(observed, pairs, map, prior, &from, &NOISE, &config())
    }

    proptest! {
        #[test]
        fn map_steps_lead_to_the_true_pose(
            x in -0.2f32..0.2, y in -0.2f32..0.2, a in -0.2f32..0.2, px in -50.0f32..50.0, pa in -3.1f32..3.1
        ) {
            let truth = pose(px, 1.0, pa);
            let observed = room();
            let map = entries(&observed.iter().map(|s| s.transformed(&truth)).collect::<Vec<_>>());
            let c = components(&truth);
            let prior = Prior {
                pose: pose(c.x + x, c.y + y, c.z + a),
                covariance: Matrix3::from_diagonal(&Vector3::new(10.0, 10.0, 10.0)),
            };
            let mut at = prior.pose;
            for _ in 0..15 {
                at = strict_step(&observed, &all_pairs(4), &map, &prior, &at).unwrap().pose;
            }
            let off = truth.inverse() * at;
            prop_assert!(off.translation.vector.norm() < 2e-3, "{}", off);
            prop_assert!(crate::geometry::pose::heading(&off).abs() < 1e-3);
        }
    }

    #[test]
    fn no_pair_leaves_the_prior_as_it_is() {
        let prior = Prior { pose: pose(1.0, 2.0, 3.0), covariance: Matrix3::identity() * 0.01 };
        let got = strict_step(&[], &[], &[], &prior, &prior.pose).unwrap();
        assert_eq!(got.observability.verdict, Verdict::Blind);
        assert!((got.covariance - prior.covariance).norm() < 1e-6);
        assert!((components(&got.pose) - components(&prior.pose)).norm() < 1e-6);
    }

    #[test]
    fn in_a_corridor_the_odometry_keeps_the_direction_along_it() {
        // The walls' directions are a little off, as they are after any fit: a naive solver reads a position from that.
        let observed = [wall((-3.0, 1.0), (3.0, 1.01), 50), wall((-3.0, -1.0), (3.0, -1.02), 50)];
        let map = entries(&[wall((-3.0, 1.0), (3.0, 1.0), 50), wall((-3.0, -1.0), (3.0, -1.0), 50)]);
        let prior = Prior {
            pose: pose(0.30, 0.05, 0.02),
            covariance: Matrix3::from_diagonal(&Vector3::new(0.04, 0.04, 0.01)),
        };
        let mut at = prior.pose;
        let mut last = None;
        for _ in 0..8 {
            let step = strict_step(&observed, &all_pairs(2), &map, &prior, &at).unwrap();
            (at, last) = (step.pose, Some(step));
        }
        let (c, last) = (components(&at), last.unwrap());
        assert_eq!(last.observability.verdict, Verdict::Corridor);
        assert!(last.observability.weak_direction.x.abs() > 0.99);
        assert!((c.x - 0.30).abs() < 0.01, "along the corridor the odometry decides, {c}");
        assert!(c.y.abs() < 0.02 && c.z.abs() < 0.01, "across and in heading the walls do, {c}");
        assert!(last.covariance.m11 > 0.9 * 0.04, "and the uncertainty says so");
        assert!(last.covariance.m22 < 0.01 * 0.04);
    }

    #[test]
    fn one_wrong_pair_hardly_moves_the_pose() {
        let observed = room();
        let mut walls = room();
        // A wall mistaken for one half a metre behind it.
        walls[0] = wall((3.5, -2.0), (3.5, 2.5), 60);
        let map = entries(&walls);
        let prior = Prior { pose: pose(0.0, 0.0, 0.0), covariance: Matrix3::identity() * 0.01 };
        let mut at = prior.pose;
        for _ in 0..8 {
            at = strict_step(&observed, &all_pairs(4), &map, &prior, &at).unwrap().pose;
        }
        assert!(at.translation.vector.norm() < 0.03, "{at}");
    }

    /// The prediction is off, and a short far wall mistaken for another agrees with it: the many that do not are right.
    #[test]
    fn what_the_prediction_may_be_off_by_is_not_held_against_the_pairs() {
        let truth = pose(0.0, 0.0, 0.06);
        let mut walls = room();
        walls.push(wall((-2.0, -6.0), (-1.4, -6.0), 8));
        let observed: Vec<Segment> = walls.iter().map(|s| s.transformed(&truth.inverse())).collect();
        walls[4] = observed[4];
        let map = entries(&walls);
        let prior = Prior {
            pose: pose(0.0, 0.0, 0.0),
            covariance: Matrix3::from_diagonal(&Vector3::new(1e-5, 1e-5, 9e-4)),
        };
        let heading_after = |forgives: bool| {
            let (mut at, mut covariance) = (prior.pose, prior.covariance);
            for _ in 0..8 {
                let from = Standpoint { pose: &at, forgiven: forgives.then_some(&covariance) };
                let step =
                    maximum_a_posteriori(&observed, &all_pairs(5), &map, &prior, &from, &NOISE, &config())
                        .unwrap();
                (at, covariance) = (step.pose, step.covariance);
            }
            crate::geometry::pose::heading(&at)
        };
        let (strict, forgiving) = (heading_after(false), heading_after(true));
        assert!((forgiving - 0.06).abs() < 0.005, "{forgiving}");
        assert!((strict - 0.06).abs() > 2.0 * (forgiving - 0.06).abs(), "{strict}");
    }

    /// The reported covariance is that of the estimates' scatter over random noise.
    #[test]
    fn covariance_matches_the_scatter() {
        use rand_core::{Rng, SeedableRng};
        let mut rng = rand_pcg::Pcg32::seed_from_u64(7);
        let mut gauss = || (0..12).map(|_| rng.next_u32() as f32 / u32::MAX as f32).sum::<f32>() - 6.0;
        let noise = LineNoise { sigma_offset_m: 0.0, sigma_direction_rad: 0.0 };
        let map = entries(
            &room()
                .iter()
                .map(|s| crate::geometry::line_noise::with_variances(s, 1e-12, 1e-12))
                .collect::<Vec<_>>(),
        );
        let prior = Prior { pose: pose(0.0, 0.0, 0.0), covariance: Matrix3::identity() };
        let config = GaussNewtonConfig { kernel_chi2: 1e9, direction_trust_rad: 0.0, ..config() };
        let (mut sums, mut reported, runs) = ([0.0f32; 3], Matrix3::zeros(), 600);
        for _ in 0..runs {
            let observed: Vec<Segment> = room()
                .iter()
                .map(|s| {
                    let n = s.moments.inliers as usize;
                    let points: Vec<Point2<f32>> = (0..n)
                        .map(|i| {
                            s.start
                                + (s.end - s.start) * (i as f32 / (n - 1) as f32)
                                + s.normal() * (0.01 * gauss())
                        })
                        .collect();
                    let moments = Moments::from_points(points.iter().map(|&p| (p, 1e4)));
                    Segment::fitted(moments, &[points[0], points[n - 1]], Point2::origin())
                })
                .collect();
            let mut at = prior.pose;
            for _ in 0..4 {
                let from = Standpoint { pose: &at, forgiven: None };
                let step =
                    maximum_a_posteriori(&observed, &all_pairs(4), &map, &prior, &from, &noise, &config)
                        .unwrap();
                (at, reported) = (step.pose, step.covariance);
            }
            let c = components(&at);
            for (sum, v) in sums.iter_mut().zip(c.iter()) {
                *sum += v * v / runs as f32;
            }
        }
        for (scatter, said) in sums.into_iter().zip([reported.m11, reported.m22, reported.m33]) {
            assert!((0.8..1.25).contains(&(scatter / said)), "scatter {scatter}, reported {said}");
        }
    }
}
