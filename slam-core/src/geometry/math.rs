//! Every transcendental function of the crate, in one place.
//!
//! They are `libm`'s or written out here, on the PC as on the microcontroller, so that the same input gives the same bits on
//! both; the square root is the FPU's, which is rounded correctly everywhere, as `libm`'s is. nalgebra reaches `libm`
//! through its `libm-force` feature.

use core::f32::consts::PI;

/// Least variance that is kept: beneath it `f32` has no digits left beside the variances of metres and radians.
pub const VARIANCE_FLOOR: f32 = 1e-12;
/// Up to this angle, radians, the reduction to one quarter loses no digits.
const REDUCED_RAD: f32 = 100.0;

/// Sine and cosine of an angle in radians, to 2·10⁻⁷ within ±100. Beyond it is wrapped first, by a 2π that is 2·10⁻⁷ too long.
///
/// Not `libm`'s, which compute in double precision: 1262 instructions each on a Cortex-M4F, which has none in hardware;
/// 40 for both here (`cargo xtask bench-target`). The polynomials are the minimax ones of Cephes' `sinf` and `cosf`.
#[inline]
pub fn sin_cos(angle_rad: f32) -> (f32, f32) {
    // π/2 in three parts, of which the first two have so few digits that small multiples of them are exact.
    const PARTS: [f32; 3] = [1.570_312_5, 4.837_513e-4, 7.549_79e-8];
    let angle_rad = if angle_rad.abs() < REDUCED_RAD { angle_rad } else { wrap_angle(angle_rad) };
    if angle_rad.is_nan() {
        return (angle_rad, angle_rad);
    }
    let quarters =
        (angle_rad * core::f32::consts::FRAC_2_PI + if angle_rad < 0.0 { -0.5 } else { 0.5 }) as i32;
    let k = quarters as f32;
    let x = PARTS.iter().fold(angle_rad, |rest, part| rest - k * part);
    let x2 = x * x;
    let sin = x + x * x2 * (-0.166_666_55 + x2 * (8.332_161e-3 + x2 * -1.951_529_6e-4));
    let cos = 1.0 - 0.5 * x2 + x2 * x2 * (4.166_664_6e-2 + x2 * (-1.388_731_6e-3 + x2 * 2.443_315_7e-5));
    match quarters & 3 {
        0 => (sin, cos),
        1 => (cos, -sin),
        2 => (-sin, -cos),
        _ => (-cos, sin),
    }
}

/// Four-quadrant arc tangent of `y / x`, in radians, within [-π, π].
#[inline]
pub fn atan2(y: f32, x: f32) -> f32 {
    libm::atan2f(y, x)
}

/// Square root; negative arguments, which only rounding can produce here, give zero. NaN stays NaN.
#[inline]
pub fn sqrt(value: f32) -> f32 {
    if value < 0.0 { 0.0 } else { vsqrt::sqrt(value) }
}

/// A value kept within limits; NaN gives the upper one, and where they are in the wrong order the lower wins. `f32::clamp`
/// panics then, and its message brings the printing of floats with it: 15 kB of flash.
#[inline]
pub fn within(value: f32, low: f32, high: f32) -> f32 {
    max(min(value, high), low)
}

/// The larger of two values; the second where the first is NaN. In line; `f32::max` is a call into a library on a Cortex-M4F.
#[inline]
pub fn max(a: f32, b: f32) -> f32 {
    if a > b { a } else { b }
}

/// The smaller of two values; the second where the first is NaN.
#[inline]
pub fn min(a: f32, b: f32) -> f32 {
    if a < b { a } else { b }
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
    fn sine_and_cosine_at_the_corners() {
        assert_eq!(sin_cos(0.0), (0.0, 1.0));
        let (s, c) = sin_cos(f32::NAN);
        assert!(s.is_nan() && c.is_nan());
        assert!(sin_cos(f32::INFINITY).0.is_nan());
        assert!((sin_cos(1000.0).0 - 1000.0f64.sin() as f32).abs() < 1e-4);
        for quarter in -8..=8 {
            let (s, c) = sin_cos(quarter as f32 * core::f32::consts::FRAC_PI_2);
            assert!((s * s + c * c - 1.0).abs() < 3e-7 && s.abs().min(c.abs()) < 2e-6, "{quarter}");
        }
    }

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
        fn sine_and_cosine_are_right(angle in -100.0f32..100.0) {
            let (s, c) = sin_cos(angle);
            let exact = f64::from(angle).sin_cos();
            proptest::prop_assert!((f64::from(s) - exact.0).abs() < 2e-7, "{} {}", s, exact.0);
            proptest::prop_assert!((f64::from(c) - exact.1).abs() < 2e-7, "{} {}", c, exact.1);
        }

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
