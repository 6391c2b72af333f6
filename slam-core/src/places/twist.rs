//! Twists about one origin, in `f64`: there they add along a chain.
//!
//! The adjoint of a pose takes a twist (m, m, rad) of the body to the same motion about the map's origin. Far from it the lever
//! makes large numbers that cancel when the twist is taken back, which is what `f64` is for; poses themselves stay `f32`.

use nalgebra::{Isometry2, Matrix3, Vector3};

/// Ad(X), from twists of the body to twists about the origin.
pub(super) fn adjoint(pose: &Isometry2<f32>) -> Matrix3<f64> {
    let (c, s) = (f64::from(pose.rotation.re), f64::from(pose.rotation.im));
    let (x, y) = (f64::from(pose.translation.x), f64::from(pose.translation.y));
    Matrix3::new(c, -s, y, s, c, -x, 0.0, 0.0, 1.0)
}

/// Ad(X)⁻¹.
pub(super) fn inverse_adjoint(pose: &Isometry2<f32>) -> Matrix3<f64> {
    let (c, s) = (f64::from(pose.rotation.re), f64::from(pose.rotation.im));
    let (x, y) = (f64::from(pose.translation.x), f64::from(pose.translation.y));
    Matrix3::new(c, s, s * x - c * y, -s, c, c * x + s * y, 0.0, 0.0, 1.0)
}

/// A covariance as its six numbers.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Packed([f64; 6]);

impl Packed {
    pub const ZERO: Self = Self([0.0; 6]);

    pub fn of(m: &Matrix3<f64>) -> Self {
        Self([m.m11, m.m12, m.m13, m.m22, m.m23, m.m33])
    }

    pub fn matrix(&self) -> Matrix3<f64> {
        let [xx, xy, xt, yy, yt, tt] = self.0;
        Matrix3::new(xx, xy, xt, xy, yy, yt, xt, yt, tt)
    }

    /// The difference from a prefix sum before it.
    pub fn minus(&self, before: &Self) -> Matrix3<f64> {
        (Self(core::array::from_fn(|i| {
            self.0.get(i).copied().unwrap_or(0.0) - before.0.get(i).copied().unwrap_or(0.0)
        })))
        .matrix()
    }
}

pub(super) fn to_f64(v: &Vector3<f32>) -> Vector3<f64> {
    v.map(f64::from)
}

pub(super) fn to_f32(v: &Vector3<f64>) -> Vector3<f32> {
    v.map(|v| v as f32)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::pose::{exp, log, pose};

    #[test]
    fn the_adjoint_carries_a_motion_of_the_body_to_the_origin() {
        for at in [pose(3.0, -7.0, 0.4), pose(-40.0, 12.0, 3.0)] {
            let twist = Vector3::new(0.02, -0.01, 0.03);
            let about_origin = log(&(at * exp(&twist) * at.inverse()));
            let carried = to_f32(&(adjoint(&at) * to_f64(&twist)));
            assert!((carried - about_origin).norm() < 1e-4, "{carried} {about_origin}");
            let product = adjoint(&at) * inverse_adjoint(&at);
            assert!((product - Matrix3::identity()).amax() < 1e-5, "{product}");
        }
    }

    #[test]
    fn six_numbers_are_the_matrix() {
        let m = Matrix3::new(4.0, 1.0, 2.0, 1.0, 5.0, 3.0, 2.0, 3.0, 6.0);
        assert_eq!(Packed::of(&m).matrix(), m);
        assert_eq!(Packed::of(&(m * 2.0)).minus(&Packed::of(&m)), m);
    }
}
