//! Correction, equations (3)–(9) of the paper.
//!
//! In: observed segments in `base`, their pairs in the map, the predicted pose. Out: the corrected pose. With p the ends of a
//! segment seen through the prediction, c the predicted position, u and b the normal and distance of its map line, n its
//! inliers, and M the turn by 90°, the sum of
//!
//! ```text
//!  (3)      n {(q_s·u − b)² + (q_e·u − b)²},   q = R(Δθ)(p − c) + c + T
//! ```
//!
//! is made least, with R(Δθ) ≈ 1 + Δθ·M. That is linear in (T, Δθ) and solved once:
//!
//! ```text
//!  (9)      [A  B] [T ]   [E]      A = Σ n·u·uᵀ       B = Σ n (M(p − c)·u) u    D = Σ n (M(p − c)·u)²
//!           [Bᵀ D] [Δθ] = [F]      E = Σ n (b − p·u) u     F = Σ n (b − p·u)(M(p − c)·u)
//! ```
//!
//! with the sums over both ends of each segment. "Singular: the pose is not updated", says the paper, and not when it calls a
//! system so. Walls that are parallel but for the noise of their directions would fix the position along them, if only a
//! determinant of zero were singular; here the eigenvalues decide, see [`LeastSquaresConfig`].
//!
//! [`Singular::CorrectObserved`] is no longer the paper: see [`SlamConfig::paper_partial`](crate::SlamConfig::paper_partial).

use nalgebra::{Matrix3, SymmetricEigen, Vector3};

use crate::geometry::math::max;
use crate::geometry::pose::{components, perpendicular, pose};
use crate::geometry::segment::Segment;
use crate::map::MapSegment;
use crate::tracking::association::Pair;
use crate::tracking::correction::{Correction, Prior, Verdict, finite, judge, largest};

/// Settings of the paper's correction.
#[derive(Clone, Copy, Debug, PartialEq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct LeastSquaresConfig {
    /// A direction of the pose (x, y, θ·1 m) is not observed when its eigenvalue is this share of the largest, or less; with one
    /// such direction the system is singular.
    pub singular_share: f32,
    /// What becomes of the pose then.
    pub singular: Singular,
}

/// What a singular system does to the pose.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize), serde(rename_all = "snake_case"))]
pub enum Singular {
    /// Nothing, as the paper says.
    KeepPose,
    /// The directions that are observed are corrected, the others stay as predicted.
    CorrectObserved,
}

/// Equation (9): one linear least-squares step from the prediction, which is no prior.
///
/// `None` when the system is singular, or with [`Singular::CorrectObserved`] when no direction is observed. The paper gives no
/// covariance; here it is that of points of variance `variance_m2`, n of them for each segment, and in directions that are not
/// observed that of the prediction. Work: one step for each pair.
pub fn least_squares(
    observed: &[Segment],
    pairs: &[Pair],
    map: &[MapSegment],
    predicted: &Prior,
    variance_m2: f32,
    config: &LeastSquaresConfig,
) -> Option<Correction> {
    let (normal_matrix, right) = normal_equations(observed, pairs, map, predicted);
    let solution = solve(&normal_matrix, config)?;
    let step = solution.inverse * right;
    let c = components(&predicted.pose);
    let corrected = pose(c.x + step.x, c.y + step.y, c.z + step.z);
    // Each point was counted at both ends.
    let mut observability = judge(&(normal_matrix / (2.0 * variance_m2)), 0.0, f32::INFINITY);
    let mut covariance = solution.inverse * (2.0 * variance_m2);
    if let Some(unobserved) = solution.unobserved {
        observability.verdict = Verdict::Corridor;
        covariance += unobserved * predicted.covariance * unobserved;
    }
    finite(Correction { pose: corrected, covariance, step: largest(&step), observability })
}

/// Both sides of equation (9).
fn normal_equations(
    observed: &[Segment],
    pairs: &[Pair],
    map: &[MapSegment],
    predicted: &Prior,
) -> (Matrix3<f32>, Vector3<f32>) {
    let centre = predicted.pose.translation.vector;
    let (mut normal_matrix, mut right) = (Matrix3::<f32>::zeros(), Vector3::<f32>::zeros());
    for pair in pairs {
        let (Some(seen), Some(entry)) = (observed.get(pair.observed), map.get(pair.mapped)) else { continue };
        let seen = seen.transformed(&predicted.pose);
        let line = entry.segment().line();
        let (u, n) = (line.normal, seen.moments.inliers as f32);
        for p in [seen.start, seen.end] {
            let turned = perpendicular(p.coords - centre).dot(&u); // M(p − c)·u
            let gap = line.distance_m - p.coords.dot(&u); // b − p·u
            let row = Vector3::new(u.x, u.y, turned);
            normal_matrix += row * row.transpose() * n; // A, B, D
            right += row * (n * gap); // E, F
        }
    }
    (normal_matrix, right)
}

/// The normal matrix, inverted where it can be.
struct Solution {
    /// Its inverse; in directions that are not observed zero.
    inverse: Matrix3<f32>,
    /// The projection on the directions that are not observed, where there are any.
    unobserved: Option<Matrix3<f32>>,
}

fn solve(normal_matrix: &Matrix3<f32>, config: &LeastSquaresConfig) -> Option<Solution> {
    if !normal_matrix.iter().all(|v| v.is_finite()) {
        return None;
    }
    let eigen = SymmetricEigen::try_new(*normal_matrix, f32::EPSILON, 50)?;
    let values = eigen.eigenvalues;
    let least = config.singular_share * max(max(values.x, values.y), values.z);
    if values.iter().all(|value| *value > least) {
        return Some(Solution { inverse: normal_matrix.cholesky()?.inverse(), unobserved: None });
    }
    if config.singular == Singular::KeepPose {
        return None;
    }
    let (mut inverse, mut unobserved) = (Matrix3::zeros(), Matrix3::zeros());
    for (value, direction) in values.iter().zip(eigen.eigenvectors.column_iter()) {
        let projection = direction * direction.transpose();
        if *value > least {
            inverse += projection / *value;
        } else {
            unobserved += projection;
        }
    }
    (least > 0.0).then_some(Solution { inverse, unobserved: Some(unobserved) })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::paper::fixtures::{all_pairs, entries, room, wall};
    use nalgebra::Isometry2;
    use proptest::prelude::*;
    use std::vec::Vec;

    const PREDICTED_VARIANCE: f32 = 0.04;

    /// Each observed segment is the map segment of its number.
    fn corrected(
        observed: &[Segment],
        map: &[MapSegment],
        predicted: &Isometry2<f32>,
        singular: Singular,
    ) -> Option<Correction> {
        let predicted = Prior { pose: *predicted, covariance: Matrix3::identity() * PREDICTED_VARIANCE };
        let config = LeastSquaresConfig { singular_share: 1e-2, singular };
        least_squares(observed, &all_pairs(observed.len()), map, &predicted, 1e-4, &config)
    }

    /// The same least squares in f64 over the end points, by numeric differentiation of the cost of eq. (3).
    fn reference_step(observed: &[Segment], map: &[MapSegment], predicted: [f64; 3]) -> [f64; 3] {
        let residuals = |d: [f64; 3]| {
            let mut all = Vec::new();
            for (seen, entry) in observed.iter().zip(map) {
                let line = entry.segment().line();
                let (ux, uy, b) =
                    (f64::from(line.normal.x), f64::from(line.normal.y), f64::from(line.distance_m));
                for end in [seen.start, seen.end] {
                    let (s, c) = predicted[2].sin_cos();
                    let (ex, ey) = (f64::from(end.x), f64::from(end.y));
                    // p − c, then R(Δθ) made linear.
                    let (px, py) = (c * ex - s * ey, s * ex + c * ey);
                    let (qx, qy) =
                        (px - d[2] * py + predicted[0] + d[0], py + d[2] * px + predicted[1] + d[1]);
                    all.push(f64::from(seen.moments.inliers).sqrt() * (qx * ux + qy * uy - b));
                }
            }
            nalgebra::SVector::<f64, 8>::from_iterator(all)
        };
        let at = residuals([0.0; 3]);
        let h = 1e-4;
        let columns = [0, 1, 2].map(|k| {
            let mut d = [0.0; 3];
            d[k] = h;
            (residuals(d) - at) / h
        });
        let jacobian = nalgebra::SMatrix::<f64, 8, 3>::from_columns(&columns);
        let step = (jacobian.transpose() * jacobian).try_inverse().unwrap() * (jacobian.transpose() * -at);
        [step[0], step[1], step[2]]
    }

    proptest! {
        #[test]
        fn paper_step_is_the_least_squares_of_equation_3(
            x in -0.3f32..0.3, y in -0.3f32..0.3, a in -0.2f32..0.2, px in -5.0f32..5.0, pa in -3.1f32..3.1
        ) {
            // The robot stands at `truth` in a room that is carried along; the prediction is off by (x, y, a).
            let truth = pose(px, 1.0, pa);
            let observed = room();
            let map = entries(&observed.iter().map(|s| s.transformed(&truth)).collect::<Vec<_>>());
            let c = components(&truth);
            let predicted = pose(c.x + x, c.y + y, c.z + a);
            let got = corrected(&observed, &map, &predicted, Singular::KeepPose).unwrap();
            let p = components(&predicted);
            let want = reference_step(&observed, &map, [f64::from(p.x), f64::from(p.y), f64::from(p.z)]);
            let moved = components(&got.pose) - p;
            for (g, w) in [moved.x, moved.y, crate::geometry::math::wrap_angle(moved.z)].into_iter().zip(want) {
                prop_assert!((f64::from(g) - w).abs() < 2e-4, "{} {}", g, w);
            }
        }
    }

    #[test]
    fn one_wall_and_parallel_walls_are_singular_for_the_paper() {
        let corridor = [wall((-3.0, 1.0), (3.0, 1.0), 50), wall((-3.0, -1.0), (3.0, -1.0), 50)];
        let map = entries(&corridor);
        for n in [1, 2] {
            let predicted = pose(0.0, 0.1, 0.02);
            assert!(corrected(&corridor[..n], &map, &predicted, Singular::KeepPose).is_none());
        }
    }

    #[test]
    fn without_a_pair_nothing_is_corrected() {
        for singular in [Singular::KeepPose, Singular::CorrectObserved] {
            assert!(corrected(&[], &[], &pose(1.0, 2.0, 3.0), singular).is_none());
        }
    }

    #[test]
    fn of_a_corridor_the_observed_directions_are_corrected_and_no_other() {
        // However the corridor lies in `map`, and with walls whose directions are a little off.
        for (turn, tilt) in [(0.0, 0.0), (0.0, 0.02), (0.7, 0.0), (2.5, 0.02), (-1.6, -0.02)] {
            let observed =
                [wall((-3.0, 1.0), (3.0, 1.0 + tilt), 50), wall((-3.0, -1.0), (3.0, -1.0 - tilt), 50)];
            let straight = [wall((-3.0, 1.0), (3.0, 1.0), 50), wall((-3.0, -1.0), (3.0, -1.0), 50)];
            let map_from_corridor = pose(2.0, -4.0, turn);
            let map = entries(&straight.map(|s| s.transformed(&map_from_corridor)));
            let predicted = map_from_corridor * pose(0.3, 0.1, 0.02);
            let got = corrected(&observed, &map, &predicted, Singular::CorrectObserved).unwrap();
            let c = components(&(map_from_corridor.inverse() * got.pose));
            assert!((c.x - 0.3).abs() < 0.005, "along stays as predicted: {c}");
            assert!(c.y.abs() < 0.005 && c.z.abs() < 2e-3, "across and heading are the walls': {c}");
            assert_eq!(got.observability.verdict, Verdict::Corridor);
            let along = map_from_corridor.rotation * nalgebra::Vector2::x();
            let var = |d: nalgebra::Vector2<f32>| {
                let d = Vector3::new(d.x, d.y, 0.0);
                d.dot(&(got.covariance * d))
            };
            assert!((var(along) / PREDICTED_VARIANCE - 1.0).abs() < 0.02, "{}", got.covariance);
            assert!(var(perpendicular(along)) < 0.01 * PREDICTED_VARIANCE, "{}", got.covariance);
        }
    }

    #[test]
    fn what_is_fully_observed_is_corrected_alike() {
        let (map, predicted) = (entries(&room()), pose(0.1, -0.1, 0.05));
        let [a, b] = [Singular::KeepPose, Singular::CorrectObserved]
            .map(|singular| corrected(&room(), &map, &predicted, singular).unwrap());
        assert_eq!((a.pose, a.covariance), (b.pose, b.covariance));
        assert_eq!(b.observability.verdict, Verdict::Full);
    }
}
