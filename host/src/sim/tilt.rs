//! A robot that drives over a sill tilts, and its beams meet the floor.

use nalgebra::{Isometry2, Point2, Vector2};

use super::scanner::distance_to;
use super::world::{Edge, Sill};

/// Where the wheels and the caster stand, in `base`, metres.
const LEFT: [f64; 2] = [0.0, 0.15];
const RIGHT: [f64; 2] = [0.0, -0.15];
const CASTER: [f64; 2] = [-0.15, 0.0];
/// A wheel is on a sill within this distance, metres.
const ON_M: f64 = 0.05;
/// Farther than this from a sill the robot is level, metres.
const NEAR_M: f64 = 0.4;
/// Beams that rise more than this meet nothing, radians.
const OVER_RAD: f64 = 0.3;

/// How far nose and left side point down, radians.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Tilt {
    nose_down_rad: f64,
    left_down_rad: f64,
}

/// What the floor does to a beam.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Floor {
    /// Nothing.
    Beyond,
    /// It is met at this range, metres.
    At(f64),
    /// The beam goes over everything.
    Over,
}

impl Tilt {
    /// In somebody's hands.
    pub const CARRIED: Self = Self { nose_down_rad: 0.5, left_down_rad: 0.2 };

    /// Whether a robot there can be on a sill during a scan.
    pub fn possible(sills: &[Sill], base: &Isometry2<f64>) -> bool {
        let here = Point2::from(base.translation.vector);
        sills.iter().any(|sill| distance_to(&line(sill), here) < NEAR_M)
    }

    /// Of a robot there.
    pub fn on(sills: &[Sill], base: &Isometry2<f64>) -> Self {
        let height_m = |contact: [f64; 2]| {
            let at = base * Point2::from(contact);
            let of =
                |sill: &Sill| sill.height * (1.0 - (distance_to(&line(sill), at) / ON_M).powi(2)).max(0.0);
            sills.iter().map(of).fold(0.0, f64::max)
        };
        let [left, right, caster] = [LEFT, RIGHT, CASTER].map(height_m);
        Self {
            nose_down_rad: (caster - 0.5 * (left + right)) / -CASTER[0],
            left_down_rad: (right - left) / (LEFT[1] - RIGHT[1]),
        }
    }

    /// So many times as much.
    pub fn times(self, factor: f64) -> Self {
        Self { nose_down_rad: factor * self.nose_down_rad, left_down_rad: factor * self.left_down_rad }
    }

    /// Where a beam in this direction of `base` meets the floor, from so high above it.
    pub fn floor_m(&self, height_m: f64, direction: &Vector2<f64>) -> Floor {
        let down = self.nose_down_rad * direction.x + self.left_down_rad * direction.y;
        if down < -OVER_RAD {
            Floor::Over
        } else if down > 1e-6 {
            Floor::At(height_m / libm::sin(down))
        } else {
            Floor::Beyond
        }
    }
}

fn line(sill: &Sill) -> Edge {
    Edge { from: sill.from.into(), to: sill.to.into(), glass: false }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn wheels_lift_the_nose_and_the_caster_drops_it() {
        let sills = [Sill { from: [1.0, -1.0], to: [1.0, 1.0], height: 0.015 }];
        let at = |x: f64| Tilt::on(&sills, &Isometry2::new(Vector2::new(x, 0.0), 0.0));
        let ahead = |tilt: Tilt| tilt.floor_m(0.2, &Vector2::x());
        assert_eq!(ahead(at(1.0)), Floor::Beyond);
        assert!((at(1.0).nose_down_rad + 0.1).abs() < 1e-9);
        let Floor::At(range_m) = ahead(at(1.15)) else { panic!("{:?}", at(1.15)) };
        assert!((range_m - 2.0).abs() < 0.01, "{range_m}");
        assert_eq!(at(0.5), Tilt::default());
        // One wheel alone rolls the robot.
        let slanted = Tilt::on(&sills, &Isometry2::new(Vector2::new(0.9, 0.1), -0.8));
        assert!(slanted.left_down_rad < -0.01, "{slanted:?}");
    }
}
