//! Every transcendental function of the crate, in one place.
//!
//! All of them are `libm`'s, on the PC as on the microcontroller, so that the same input gives the same bits on
//! both. nalgebra reaches the same functions through its `libm-force` feature.

use core::f32::consts::PI;

/// Sine and cosine of an angle in radians.
#[inline]
pub fn sin_cos(angle_rad: f32) -> (f32, f32) {
    (libm::sinf(angle_rad), libm::cosf(angle_rad))
}

/// Four-quadrant arc tangent of `y / x`, in radians, within [-π, π].
#[inline]
pub fn atan2(y: f32, x: f32) -> f32 {
    libm::atan2f(y, x)
}

/// Square root; negative arguments, which only rounding can produce here, give zero. NaN stays NaN.
#[inline]
pub fn sqrt(value: f32) -> f32 {
    if value < 0.0 { 0.0 } else { libm::sqrtf(value) }
}

/// A value kept within limits; NaN gives the upper one, and where they are in the wrong order the lower wins. `f32::clamp`
/// panics then, and its message brings the printing of floats with it: 15 kB of flash.
#[inline]
pub fn within(value: f32, low: f32, high: f32) -> f32 {
    value.min(high).max(low)
}

/// Wraps an angle in radians to (-π, π]. NaN and infinities give NaN.
#[inline]
pub fn wrap_angle(angle_rad: f32) -> f32 {
    if angle_rad > -PI && angle_rad <= PI {
        return angle_rad;
    }
    let wrapped = libm::remainderf(angle_rad, 2.0 * PI);
    // The remainder by the rounded 2π may lie a rounding error outside.
    if wrapped <= -PI || wrapped > PI { PI } else { wrapped }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn wraps_to_the_half_open_interval() {
        assert_eq!(wrap_angle(PI), PI);
        assert_eq!(wrap_angle(-PI), PI);
        assert!((wrap_angle(3.0 * PI / 2.0) + PI / 2.0).abs() < 1e-6);
        assert!((wrap_angle(-3.0 * PI / 2.0) - PI / 2.0).abs() < 1e-6);
        assert!(wrap_angle(f32::NAN).is_nan());
        assert!(wrap_angle(f32::INFINITY).is_nan());
    }

    proptest::proptest! {
        #[test]
        fn wrapped_angle_is_in_range_and_names_the_same_direction(angle in -1.0e4f32..1.0e4) {
            let wrapped = wrap_angle(angle);
            proptest::prop_assert!(wrapped > -PI && wrapped <= PI);
            let difference = f64::from(angle) - f64::from(wrapped);
            let turns = difference / f64::from(2.0 * PI);
            proptest::prop_assert!((turns - turns.round()).abs() < 1e-3);
        }
    }
}
