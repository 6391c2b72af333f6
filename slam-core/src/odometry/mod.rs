//! Odometry of a differential drive: counters in, motion with covariance out.
//!
//! In: readings of two wrapping encoder counters, or the poses that some other odometry reports. Out: an
//! [`Increment`] in the frame of the base before the motion. Equation (1) of the paper is the Euler step; the arc
//! step is exact for constant wheel speeds.
//!
//! The paper treats the prediction as exact up to a search window. Here each increment carries a covariance whose
//! variances grow in proportion to the way travelled, so that it does not depend on how a path was cut into steps.

pub mod bias;
pub mod delay;
pub(crate) mod health;
pub mod monitor;
pub mod noise_learning;
pub mod track;
pub mod wheel_faults;

use nalgebra::{Isometry2, Matrix3, Vector3};

use crate::geometry::pose::{self, exp};

/// Difference of two readings of a free-running 16-bit counter, right as long as it moved less than half its range.
#[inline]
pub fn ticks_between_u16(before: u16, after: u16) -> i32 {
    i32::from(after.wrapping_sub(before) as i16)
}

/// Difference of two readings of a free-running 32-bit counter, right as long as it moved less than half its range.
#[inline]
pub fn ticks_between_u32(before: u32, after: u32) -> i32 {
    after.wrapping_sub(before) as i32
}

/// How a step of the wheels becomes a step of the pose.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize), serde(rename_all = "snake_case"))]
pub enum Integration {
    /// Eq. (1): straight along the heading at the start of the step, then the turn.
    Euler,
    /// Along the circular arc that constant wheel speeds describe.
    Arc,
}

/// No wheel of a robot of this kind turns faster, m/s, …
pub const MOST_SPEED_M_S: f32 = 5.0;
/// … and ways shorter than this are believed whatever their stamps, which jitter, metres.
pub const LEAST_JUMP_M: f32 = 0.5;

/// Odometry of unknown origin may be that of a car, m/s, …
pub const MOST_UNKNOWN_SPEED_M_S: f32 = 30.0;
/// … and may correct itself by this at once, metres.
pub const LEAST_UNKNOWN_JUMP_M: f32 = 1.0;

/// Geometry of the two wheels and their encoders.
#[derive(Clone, Copy, Debug, PartialEq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct DifferentialDrive {
    /// Radius of the left wheel, metres.
    pub left_wheel_radius_m: f32,
    /// Radius of the right wheel, metres.
    pub right_wheel_radius_m: f32,
    /// Distance between the wheels' contact points, metres.
    pub track_m: f32,
    /// Counter steps for one turn of a wheel, gear and quadrature included.
    pub ticks_per_turn: f32,
}

impl DifferentialDrive {
    /// The motion that a difference of both counters means; positive ticks drive forward.
    pub fn increment(&self, left_ticks: i32, right_ticks: i32, integration: Integration) -> Increment {
        self.increment_of_parts(left_ticks as f32, right_ticks as f32, integration)
    }

    /// Whether wheels can turn so far within a time: by [`MOST_SPEED_M_S`], and by [`LEAST_JUMP_M`] whatever the time.
    #[inline(never)]
    pub fn is_possible(&self, left_ticks: i32, right_ticks: i32, within_us: u64) -> bool {
        let metres = |ticks: i32, radius_m: f32| {
            (ticks as f32 * (2.0 * core::f32::consts::PI / self.ticks_per_turn) * radius_m).abs()
        };
        let most_m = LEAST_JUMP_M + MOST_SPEED_M_S * within_us as f32 * 1e-6;
        metres(left_ticks, self.left_wheel_radius_m) <= most_m
            && metres(right_ticks, self.right_wheel_radius_m) <= most_m
    }

    /// The same where ticks come in parts, as from the angles of wheels.
    pub fn increment_of_parts(
        &self,
        left_ticks: f32,
        right_ticks: f32,
        integration: Integration,
    ) -> Increment {
        let metres_per_tick_and_radius = 2.0 * core::f32::consts::PI / self.ticks_per_turn;
        let left_m = left_ticks * metres_per_tick_and_radius * self.left_wheel_radius_m;
        let right_m = right_ticks * metres_per_tick_and_radius * self.right_wheel_radius_m;
        let (distance_m, turn_rad) = (0.5 * (left_m + right_m), (right_m - left_m) / self.track_m);
        let before_from_after = match integration {
            Integration::Euler => pose::pose(distance_m, 0.0, turn_rad),
            Integration::Arc => exp(&Vector3::new(distance_m, 0.0, turn_rad)),
        };
        Increment { before_from_after, distance_m: distance_m.abs(), turn_rad: turn_rad.abs() }
    }
}

/// A motion of the base, with the way travelled on it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Increment {
    /// Pose of the base after the motion, in the base before it.
    pub before_from_after: Isometry2<f32>,
    /// Length of the path travelled, metres, ≥ 0; back and forth adds up.
    pub distance_m: f32,
    /// Sum of the turns' magnitudes, radians, ≥ 0.
    pub turn_rad: f32,
}

impl Increment {
    /// No motion.
    pub fn identity() -> Self {
        Self { before_from_after: Isometry2::identity(), distance_m: 0.0, turn_rad: 0.0 }
    }

    /// A motion of which only the end is known: the way is taken as the direct one.
    pub fn from_motion(before_from_after: Isometry2<f32>) -> Self {
        let way = pose::log(&before_from_after);
        Self {
            before_from_after,
            distance_m: crate::geometry::math::sqrt(way.x * way.x + way.y * way.y),
            turn_rad: way.z.abs(),
        }
    }

    /// This motion followed by another.
    #[must_use]
    pub fn then(&self, next: &Self) -> Self {
        Self {
            before_from_after: self.before_from_after * next.before_from_after,
            distance_m: self.distance_m + next.distance_m,
            turn_rad: self.turn_rad + next.turn_rad,
        }
    }

    /// Whether a robot can move so far within a time: by [`MOST_UNKNOWN_SPEED_M_S`], and by [`LEAST_UNKNOWN_JUMP_M`] whatever the
    /// time.
    pub fn is_possible(&self, within_us: u64) -> bool {
        self.distance_m <= LEAST_UNKNOWN_JUMP_M + MOST_UNKNOWN_SPEED_M_S * within_us as f32 * 1e-6
    }

    /// Whether every number is finite.
    pub fn is_finite(&self) -> bool {
        pose::is_finite(&self.before_from_after) && self.distance_m.is_finite() && self.turn_rad.is_finite()
    }
}

/// Share of the floors that is left when nothing moved.
const AT_REST: f32 = 0.1;

/// How fast odometry grows uncertain. Each figure is a standard deviation that grows with the square root of the way.
#[derive(Clone, Copy, Debug, PartialEq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize), serde(deny_unknown_fields))]
pub struct OdometryNoise {
    /// Along the path, metres for each √metre driven.
    pub sigma_along_m_per_sqrt_m: f32,
    /// Across the path, metres for each √metre driven (side slip).
    pub sigma_across_m_per_sqrt_m: f32,
    /// Heading, radians for each √metre driven.
    pub sigma_heading_rad_per_sqrt_m: f32,
    /// Heading, radians for each √radian turned.
    pub sigma_heading_rad_per_sqrt_rad: f32,
    /// Floor of the position's standard deviation for one increment, metres: in part at rest too, as wheels may slip.
    pub sigma_position_floor_m: f32,
    /// Floor of the heading's standard deviation for one increment, radians.
    pub sigma_heading_floor_rad: f32,
}

impl OdometryNoise {
    /// Covariance of (x, y, θ) of the base after the increment, in the frame of the base before it.
    ///
    /// Heading errors are taken as spread evenly over the way: they move the end sideways, with the covariance
    /// d/2 and d²/3 of integrated white noise.
    // Not inlined: on the microcontroller that is less flash.
    #[inline(never)]
    pub fn covariance(&self, increment: &Increment) -> Matrix3<f32> {
        let (d, turn) = (increment.distance_m, increment.turn_rad);
        let square = |v: f32| v * v;
        let var_heading = square(self.sigma_heading_rad_per_sqrt_m) * d
            + square(self.sigma_heading_rad_per_sqrt_rad) * turn;
        let var_along = square(self.sigma_along_m_per_sqrt_m) * d;
        let var_across = square(self.sigma_across_m_per_sqrt_m) * d;
        // Axes of the chord travelled; at rest, those of the base.
        let chord = increment.before_from_after.translation.vector;
        let length = crate::geometry::math::sqrt(chord.norm_squared());
        let (c, s) = if length > 1e-6 { (chord.x / length, chord.y / length) } else { (1.0, 0.0) };
        // What a heading error does to the end of the chord.
        let lever = pose::perpendicular(chord);
        // Counters that did not move at all leave only what is finer than they are.
        let share = if d == 0.0 && turn == 0.0 { AT_REST } else { 1.0 };
        let floor = square(share * self.sigma_position_floor_m);
        let xx = c * c * var_along + s * s * var_across + lever.x * lever.x * var_heading / 3.0 + floor;
        let yy = s * s * var_along + c * c * var_across + lever.y * lever.y * var_heading / 3.0 + floor;
        let xy = c * s * (var_along - var_across) + lever.x * lever.y * var_heading / 3.0;
        let (xt, yt) = (0.5 * lever.x * var_heading, 0.5 * lever.y * var_heading);
        Matrix3::new(
            xx,
            xy,
            xt,
            xy,
            yy,
            yt,
            xt,
            yt,
            var_heading + square(share * self.sigma_heading_floor_rad),
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use approx::assert_relative_eq;
    use core::f32::consts::PI;
    use proptest::prelude::*;

    const DRIVE: DifferentialDrive = DifferentialDrive {
        left_wheel_radius_m: 0.05,
        right_wheel_radius_m: 0.05,
        track_m: 0.3,
        ticks_per_turn: 1000.0,
    };

    #[test]
    fn counters_wrap_both_ways() {
        assert_eq!(ticks_between_u16(65_530, 4), 10);
        assert_eq!(ticks_between_u16(4, 65_530), -10);
        assert_eq!(ticks_between_u32(u32::MAX - 1, 3), 5);
        assert_eq!(ticks_between_u32(3, u32::MAX - 1), -5);
    }

    #[test]
    fn equal_wheels_drive_straight_and_opposite_wheels_turn_on_the_spot() {
        let straight = DRIVE.increment(1000, 1000, Integration::Arc);
        assert_relative_eq!(straight.before_from_after.translation.x, 2.0 * PI * 0.05, epsilon = 1e-6);
        assert_eq!(straight.turn_rad, 0.0);
        let spot = DRIVE.increment(-100, 100, Integration::Arc);
        assert_eq!(spot.distance_m, 0.0);
        assert!(pose::heading(&spot.before_from_after) > 0.0, "right wheel forward turns left");
    }

    #[test]
    fn euler_is_equation_1() {
        let step = DRIVE.increment(100, 200, Integration::Euler);
        let (d, turn) = (PI * 0.1 * 0.15, PI * 0.1 * 0.1 / 0.3);
        assert_relative_eq!(step.before_from_after.translation.x, d, epsilon = 1e-6);
        assert_eq!(step.before_from_after.translation.y, 0.0);
        assert_relative_eq!(pose::heading(&step.before_from_after), turn, epsilon = 1e-6);
    }

    proptest! {
        /// The arc agrees with ten thousand Euler steps in f64.
        #[test]
        fn arc_is_the_limit_of_euler(left in -2000i32..2000, right in -2000i32..2000) {
            let arc = DRIVE.increment(left, right, Integration::Arc).before_from_after;
            let per_tick = 2.0 * std::f64::consts::PI * 0.05 / 1000.0;
            let (l, r) = (f64::from(left) * per_tick, f64::from(right) * per_tick);
            let (d, turn) = ((l + r) / 2.0, (r - l) / 0.3);
            let (mut x, mut y, mut a) = (0.0, 0.0, 0.0f64);
            for _ in 0..10_000 {
                x += (a + turn / 20_000.0).cos() * d / 10_000.0;
                y += (a + turn / 20_000.0).sin() * d / 10_000.0;
                a += turn / 10_000.0;
            }
            prop_assert!((f64::from(arc.translation.x) - x).abs() < 1e-5);
            prop_assert!((f64::from(arc.translation.y) - y).abs() < 1e-5);
        }
    }

    /// Monte Carlo of the stated model (white noise along the way) against the closed form.
    #[test]
    fn covariance_matches_the_scatter_of_simulated_paths() {
        use rand_core::{Rng, SeedableRng};
        let noise = OdometryNoise {
            sigma_along_m_per_sqrt_m: 0.03,
            sigma_across_m_per_sqrt_m: 0.01,
            sigma_heading_rad_per_sqrt_m: 0.05,
            sigma_heading_rad_per_sqrt_rad: 0.0,
            sigma_position_floor_m: 0.0,
            sigma_heading_floor_rad: 0.0,
        };
        let mut rng = rand_pcg::Pcg32::seed_from_u64(1);
        let mut gauss =
            || (0..12).map(|_| f64::from(rng.next_u32()) / f64::from(u32::MAX)).sum::<f64>() - 6.0;
        let (steps, runs, length) = (50, 4000, 2.0);
        let root = (length / f64::from(steps)).sqrt();
        let mut sums = [0.0f64; 4];
        for _ in 0..runs {
            let (mut x, mut y, mut a) = (0.0f64, 0.0f64, 0.0f64);
            for _ in 0..steps {
                let (along, across) =
                    (length / f64::from(steps) + 0.03 * root * gauss(), 0.01 * root * gauss());
                x += a.cos() * along - a.sin() * across;
                y += a.sin() * along + a.cos() * across;
                a += 0.05 * root * gauss();
            }
            for (sum, value) in sums.iter_mut().zip([(x - 2.0).powi(2), y * y, a * a, y * a]) {
                *sum += value / f64::from(runs);
            }
        }
        let p = noise.covariance(&Increment::from_motion(pose::pose(2.0, 0.0, 0.0)));
        for (got, want) in [p.m11, p.m22, p.m33, p.m23].into_iter().zip(sums) {
            assert_relative_eq!(f64::from(got), want, max_relative = 0.1);
        }
    }

    proptest! {
        #[test]
        fn covariance_is_symmetric_and_positive(x in -3.0f32..3.0, y in -3.0f32..3.0, a in -3.0f32..3.0) {
            let noise = OdometryNoise {
                sigma_along_m_per_sqrt_m: 0.03, sigma_across_m_per_sqrt_m: 0.01, sigma_heading_rad_per_sqrt_m: 0.05,
                sigma_heading_rad_per_sqrt_rad: 0.1, sigma_position_floor_m: 0.001, sigma_heading_floor_rad: 0.001,
            };
            let p = noise.covariance(&Increment::from_motion(pose::pose(x, y, a)));
            prop_assert_eq!(p, p.transpose());
            prop_assert!(p.cholesky().is_some());
        }
    }
}
