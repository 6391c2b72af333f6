//! Corrections of a known pose, what pairs see of it, and numbers that are none.

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
            let step = maximum_a_posteriori(&observed, &all_pairs(5), &map, &prior, &from, &NOISE, &config())
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
                maximum_a_posteriori(&observed, &all_pairs(4), &map, &prior, &from, &noise, &config).unwrap();
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
