//! Planar poses: `nalgebra::Isometry2<f32>`, metres and radians, and the SE(2) maps that odometry needs.
//!
//! A pose is named after its frames as a transform is: `map_from_base`. `pose` alone means `map_from_base`.

use nalgebra::{Complex, Isometry2, Matrix3, Translation2, UnitComplex, Vector2, Vector3};

use crate::geometry::math::{atan2, sin_cos, wrap_angle};

/// The pose `(x, y, θ)` as an isometry; metres, radians.
#[inline]
pub fn pose(x_m: f32, y_m: f32, theta_rad: f32) -> Isometry2<f32> {
    turned(x_m, y_m, sin_cos(theta_rad))
}

/// Not `Isometry2::new`, whose sine and cosine are `libm`'s, see [`sin_cos`].
fn turned(x_m: f32, y_m: f32, (s, c): (f32, f32)) -> Isometry2<f32> {
    Isometry2::from_parts(Translation2::new(x_m, y_m), UnitComplex::new_unchecked(Complex::new(c, s)))
}

/// Heading of a pose, in (-π, π].
#[inline]
pub fn heading(pose: &Isometry2<f32>) -> f32 {
    wrap_angle(atan2(pose.rotation.im, pose.rotation.re))
}

/// `(x, y, θ)` of a pose; θ in (-π, π].
#[inline]
pub fn components(pose: &Isometry2<f32>) -> Vector3<f32> {
    Vector3::new(pose.translation.x, pose.translation.y, heading(pose))
}

/// Whether every number of the pose is finite.
#[inline]
pub fn is_finite(pose: &Isometry2<f32>) -> bool {
    pose.translation.x.is_finite()
        && pose.translation.y.is_finite()
        && pose.rotation.re.is_finite()
        && pose.rotation.im.is_finite()
}

/// The pose rebuilt from its components, so that the rotation stays a rotation however many were multiplied.
// Not inlined: on the microcontroller that is a kilobyte of flash less.
#[inline(never)]
pub fn normalized(pose: &Isometry2<f32>) -> Isometry2<f32> {
    let c = components(pose);
    self::pose(c.x, c.y, c.z)
}

/// `(x, y, θ)` of one pose less that of another; θ in (-π, π].
#[inline]
pub fn difference(to: &Isometry2<f32>, from: &Isometry2<f32>) -> Vector3<f32> {
    let mut off = components(to) - components(from);
    off.z = wrap_angle(off.z);
    off
}

/// Turn from one pose to another, in [-π, π].
#[inline(never)]
pub fn turn(from: &Isometry2<f32>, to: &Isometry2<f32>) -> f32 {
    let turn = from.rotation.conjugate() * to.rotation;
    atan2(turn.im, turn.re)
}

/// A vector turned by +90°: M·v with M = [[0, -1], [1, 0]] of the paper.
#[inline]
pub fn perpendicular(v: Vector2<f32>) -> Vector2<f32> {
    Vector2::new(-v.y, v.x)
}

/// z component of the cross product of two plane vectors.
#[inline]
pub fn cross(a: Vector2<f32>, b: Vector2<f32>) -> f32 {
    a.x * b.y - a.y * b.x
}

/// The motion reached by following a constant twist for one unit of time: exponential map of SE(2).
///
/// `twist` is (forward m, left m, turn rad).
pub fn exp(twist: &Vector3<f32>) -> Isometry2<f32> {
    let angle = twist.z;
    let (s, c) = sin_cos(angle);
    // sin(a)/a and (1-cos a)/a, by their series where the quotients lose digits.
    let (sinc, cosc) = if angle.abs() < 1e-2 {
        (1.0 - angle * angle / 6.0, angle * (0.5 - angle * angle / 24.0))
    } else {
        (s / angle, (1.0 - c) / angle)
    };
    turned(sinc * twist.x - cosc * twist.y, cosc * twist.x + sinc * twist.y, (s, c))
}

/// The constant twist that leads to a motion in one unit of time: logarithm of SE(2), inverse of [`exp`].
///
/// At a turn of exactly ±π the twist with +π is returned.
pub fn log(motion: &Isometry2<f32>) -> Vector3<f32> {
    let angle = heading(motion);
    let half = 0.5 * angle;
    let (s, c) = sin_cos(half);
    // half·cot(half), by its series near zero.
    let half_cot = if half.abs() < 1e-2 { 1.0 - half * half / 3.0 } else { half * c / s };
    let t = motion.translation.vector;
    Vector3::new(half_cot * t.x + half * t.y, half_cot * t.y - half * t.x, angle)
}

/// Carries a covariance of (x, y, θ), given in the frame of `rotation`'s source, to its target frame.
pub fn rotate_covariance(rotation: &Isometry2<f32>, covariance: &Matrix3<f32>) -> Matrix3<f32> {
    let (c, s) = (rotation.rotation.re, rotation.rotation.im);
    let turn = Matrix3::new(c, -s, 0.0, s, c, 0.0, 0.0, 0.0, 1.0);
    turn * covariance * turn.transpose()
}

/// Covariance (x, y, θ) of independent errors, by their standard deviations (m, m, rad).
pub(crate) fn diagonal(sigmas: [f32; 3]) -> Matrix3<f32> {
    Matrix3::from_diagonal(&Vector3::from(sigmas.map(|sigma| sigma * sigma)))
}

/// Whether two poses lie closer together than this, metres, and are turned by less from each other, radians.
pub(crate) fn are_close(a: &Isometry2<f32>, b: &Isometry2<f32>, [position_m, heading_rad]: [f32; 2]) -> bool {
    let off = components(&a.inv_mul(b));
    off.xy().norm() < position_m && off.z.abs() < heading_rad
}

#[cfg(test)]
mod tests {
    use super::*;
    use core::f32::consts::PI;
    use proptest::prelude::*;

    #[test]
    fn quarter_circle_has_the_closed_form() {
        // Radius 2 m, a quarter turn to the left: the end is at (2, 2).
        let motion = exp(&Vector3::new(PI, 0.0, PI / 2.0));
        assert!((motion.translation.x - 2.0).abs() < 1e-5);
        assert!((motion.translation.y - 2.0).abs() < 1e-5);
    }

    proptest! {
        #[test]
        fn log_inverts_exp(x in -3.0f32..3.0, y in -3.0f32..3.0, a in -3.1f32..3.1) {
            let twist = Vector3::new(x, y, a);
            let back = log(&exp(&twist));
            prop_assert!((back - twist).norm() < 2e-4, "{twist:?} {back:?}");
        }

        #[test]
        fn exp_agrees_with_many_small_euler_steps(x in -1.0f64..1.0, y in -1.0f64..1.0, a in -3.0f64..3.0) {
            let (mut px, mut py, mut pa) = (0.0, 0.0, 0.0f64);
            let steps = 20_000;
            for _ in 0..steps {
                let (s, c) = (pa + 0.5 * a / f64::from(steps)).sin_cos();
                px += (c * x - s * y) / f64::from(steps);
                py += (s * x + c * y) / f64::from(steps);
                pa += a / f64::from(steps);
            }
            let motion = exp(&Vector3::new(x as f32, y as f32, a as f32));
            prop_assert!((f64::from(motion.translation.x) - px).abs() < 1e-5);
            prop_assert!((f64::from(motion.translation.y) - py).abs() < 1e-5);
        }
    }
}
