//! Sums, lines and ends against f64, and what carrying them to another frame does.

use super::*;
use crate::geometry::pose::pose;
use proptest::prelude::*;
use std::vec::Vec;

fn reference_f64(points: &[(f32, f32)]) -> (f64, f64, [f64; 3]) {
    let n = points.len() as f64;
    let mx = points.iter().map(|p| f64::from(p.0)).sum::<f64>() / n;
    let my = points.iter().map(|p| f64::from(p.1)).sum::<f64>() / n;
    let mut s = [0.0; 3];
    for &(x, y) in points {
        let (dx, dy) = (f64::from(x) - mx, f64::from(y) - my);
        s[0] += dx * dx;
        s[1] += dx * dy;
        s[2] += dy * dy;
    }
    (mx, my, s)
}

fn moments(points: &[(f32, f32)]) -> Moments {
    Moments::from_points(points.iter().map(|&(x, y)| (Point2::new(x, y), 1.0)))
}

fn points_strategy() -> impl Strategy<Value = Vec<(f32, f32)>> {
    proptest::collection::vec((-8.0f32..8.0, -8.0f32..8.0), 2..60)
}

proptest! {
    #[test]
    fn sums_agree_with_f64(points in points_strategy()) {
        let (mx, my, s) = reference_f64(&points);
        let m = moments(&points);
        prop_assert!((f64::from(m.centroid.x) - mx).abs() < 1e-5);
        prop_assert!((f64::from(m.centroid.y) - my).abs() < 1e-5);
        for (got, want) in m.scatter.iter().zip(s) {
            prop_assert!((f64::from(*got) - want).abs() < 1e-5 * (1.0 + s[0] + s[2]));
        }
    }

    #[test]
    fn merging_is_the_fit_to_all_points(a in points_strategy(), b in points_strategy(), far in -1000.0f32..1000.0) {
        let shift = |points: &[(f32, f32)]| points.iter().map(|&(x, y)| (x + far, y - far)).collect::<Vec<_>>();
        let (a, b) = (shift(&a), shift(&b));
        let all = a.iter().chain(&b).copied().collect::<Vec<_>>();
        let (merged, direct) = (moments(&a).merged(&moments(&b)), moments(&all));
        prop_assert_eq!(merged.inliers, direct.inliers);
        prop_assert!((merged.centroid - direct.centroid).norm() < 1e-3);
        let scale = 1.0 + direct.scatter[0] + direct.scatter[2];
        for (got, want) in merged.scatter.iter().zip(direct.scatter) {
            prop_assert!((got - want).abs() < 1e-3 * scale, "{} {}", got, want);
        }
    }

    #[test]
    fn direction_is_the_principal_eigenvector(points in points_strategy()) {
        let m = moments(&points);
        let (_, _, [xx, xy, yy]) = reference_f64(&points);
        let angle = 0.5 * (2.0 * xy).atan2(xx - yy);
        let anisotropy = ((xx - yy).powi(2) + 4.0 * xy * xy).sqrt() / (xx + yy);
        prop_assume!(anisotropy > 1e-3);
        let d = m.direction();
        let off = f64::from(d.x) * angle.sin() - f64::from(d.y) * angle.cos();
        prop_assert!(off.abs() < 1e-3, "{}", off);
        prop_assert!((d.norm() - 1.0).abs() < 1e-5);
    }

    #[test]
    fn transforming_sums_is_summing_transformed_points(
        points in points_strategy(), x in -9.0f32..9.0, y in -9.0f32..9.0, a in -3.1f32..3.1
    ) {
        let to = pose(x, y, a);
        let carried = points
            .iter()
            .map(|&(px, py)| { let p = to * Point2::new(px, py); (p.x, p.y) })
            .collect::<Vec<_>>();
        let (direct, got) = (moments(&carried), moments(&points).transformed(&to));
        prop_assert!((got.centroid - direct.centroid).norm() < 1e-4);
        let scale = 1.0 + direct.scatter[0] + direct.scatter[2];
        for (g, w) in got.scatter.iter().zip(direct.scatter) {
            prop_assert!((g - w).abs() < 1e-4 * scale);
        }
    }
}

#[test]
fn vertical_lines_and_lines_through_the_origin_are_lines_like_others() {
    let vertical = moments(&[(2.0, -1.0), (2.0, 0.0), (2.0, 3.0)]);
    assert!(vertical.direction().x.abs() < 1e-6);
    let segment =
        Segment::fitted(vertical, &[Point2::new(2.0, -1.0), Point2::new(2.0, 3.0)], Point2::origin());
    assert!((segment.line().distance_m + 2.0).abs() < 1e-6, "the normal points to the viewpoint");
    assert!((segment.length_m() - 4.0).abs() < 1e-6);
    let through = moments(&[(-1.0, -1.0), (0.0, 0.0), (1.0, 1.0)]);
    let segment = Segment::fitted(through, &[Point2::new(1.0, 1.0)], Point2::new(0.0, 1.0));
    assert!(segment.line().distance_m.abs() < 1e-6);
    assert!(segment.line().signed_distance(Point2::new(0.0, 1.0)) > 0.0);
}

#[test]
fn no_points_and_one_point_have_a_direction_but_no_extent() {
    assert_eq!(Moments::from_points(core::iter::empty()), Moments::EMPTY);
    let one = moments(&[(3.0, 4.0)]);
    let segment = Segment::fitted(one, &[], Point2::origin());
    assert!(segment.is_finite());
    assert_eq!(segment.length_m(), 0.0);
}

#[test]
fn overlap_is_negative_across_a_gap() {
    let wall = |x0: f32, x1: f32| {
        Segment::from_ends(Point2::new(x0, 0.0), Point2::new(x1, 0.0), 10, 1e-4, Point2::new(0.0, 1.0))
    };
    assert!((wall(0.0, 2.0).overlap_m(&wall(1.5, 4.0)) - 0.5).abs() < 1e-6);
    assert!((wall(0.0, 2.0).overlap_m(&wall(3.0, 4.0)) + 1.0).abs() < 1e-6);
}
