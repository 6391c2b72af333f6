//! Points laid on those they belong to, by least squares and in closed form: Umeyama, "Least-Squares Estimation of
//! Transformation Parameters Between Two Point Patterns", PAMI 1991, in the plane and without reflections.

use nalgebra::{Isometry2, Similarity2, UnitComplex, Vector2};

/// The rotation and the translation that carry points onto those of the same number. `None` of none.
pub fn lay(points: &[Vector2<f64>], onto: &[Vector2<f64>]) -> Option<Isometry2<f64>> {
    let Sums { means: [from, to], cos, sin, .. } = sums(points, onto)?;
    let rotation = UnitComplex::new(sin.atan2(cos));
    Some(Isometry2::from_parts((to - rotation * from).into(), rotation))
}

/// The same with a scale. `None` where all points are one.
pub fn lay_with_scale(points: &[Vector2<f64>], onto: &[Vector2<f64>]) -> Option<Similarity2<f64>> {
    let Sums { means: [from, to], cos, sin, extent } = sums(points, onto)?;
    let rotation = UnitComplex::new(sin.atan2(cos));
    let scale = cos.hypot(sin) / extent;
    (scale > 0.0 && scale.is_finite())
        .then(|| Similarity2::from_parts((to - rotation * from * scale).into(), rotation, scale))
}

/// Sums over pairs of points, about their means.
struct Sums {
    means: [Vector2<f64>; 2],
    /// Σ a·b and Σ a×b.
    cos: f64,
    sin: f64,
    /// Σ a·a.
    extent: f64,
}

fn sums(points: &[Vector2<f64>], onto: &[Vector2<f64>]) -> Option<Sums> {
    let pairs = || points.iter().zip(onto);
    let n = pairs().count();
    if n == 0 {
        return None;
    }
    let from = pairs().map(|p| p.0).sum::<Vector2<f64>>() / n as f64;
    let to = pairs().map(|p| p.1).sum::<Vector2<f64>>() / n as f64;
    let (mut cos, mut sin, mut extent) = (0.0, 0.0, 0.0);
    for (a, b) in pairs() {
        let (a, b) = (a - from, b - to);
        cos += a.dot(&b);
        sin += a.x * b.y - a.y * b.x;
        extent += a.norm_squared();
    }
    Some(Sums { means: [from, to], cos, sin, extent })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_was_turned_moved_and_scaled_is_found() {
        let points: Vec<Vector2<f64>> =
            (0..9).map(|k| Vector2::new(f64::from(k), f64::from(k * k) * 0.3)).collect();
        let truth = Similarity2::new(Vector2::new(3.0, -7.0), 2.8, 1.02);
        let carry = |p: &Vector2<f64>| (truth * nalgebra::Point2::from(*p)).coords;
        let onto: Vec<Vector2<f64>> = points.iter().map(carry).collect();
        let found = lay_with_scale(&points, &onto).unwrap();
        assert!((found.scaling() - 1.02).abs() < 1e-12);
        assert!((found.isometry.translation.vector - truth.isometry.translation.vector).norm() < 1e-9);
        assert!(found.isometry.rotation.rotation_to(&truth.isometry.rotation).angle().abs() < 1e-12);
        let rigid = lay(&points, &onto).unwrap();
        assert!(rigid.rotation.rotation_to(&truth.isometry.rotation).angle().abs() < 1e-12);
        assert!(lay(&[], &[]).is_none());
        assert!(lay_with_scale(&points[..1], &onto[..1]).is_none(), "one point has no extent");
    }
}
