//! A two-wheeled base that follows a path: what it does, and what its encoders say it does.

use nalgebra::{Isometry2, Point2, Vector2};
use rand_distr::{Distribution, Normal};
use rand_pcg::Pcg64;

use super::WheelModel;
use super::world::DrivenPath;
use crate::robot::Wheels;

/// The path is followed by steering for a point this far ahead, metres.
const LOOK_AHEAD_M: f64 = 0.45;
/// A way point is reached within this distance, metres.
const REACHED_M: f64 = 0.12;
const MOST_TURN_RAD_S: f64 = 1.2;
const MOST_ACCELERATION_M_S2: f64 = 0.8;
const MOST_TURN_ACCELERATION_RAD_S2: f64 = 4.0;

/// The simulated base.
pub struct Base {
    wheels: Wheels,
    /// Radii and track as they really are, metres.
    true_radius: [f64; 2],
    true_track: f64,
    slip_sigma: f64,
    rng: Pcg64,
    waypoints: Vec<Point2<f64>>,
    speed: f64,
    next: usize,
    /// Time to stand before driving, seconds.
    pause_s: f64,
    /// Pose of `base` in the world.
    pub pose: Isometry2<f64>,
    /// Forward speed, m/s, and turn, rad/s.
    twist: [f64; 2],
    /// Turn of each wheel since the start, radians.
    angle: [f64; 2],
}

impl Base {
    /// A base at the start of its path. `rng` decides its errors and its slip.
    pub fn new(path: &DrivenPath, wheels: Wheels, model: &WheelModel, mut rng: Pcg64) -> Self {
        let mut gauss = || Normal::new(0.0, 1.0).map_or(0.0, |n: Normal<f64>| n.sample(&mut rng));
        // The sizes of the systematic errors are given, their signs are the seed's.
        let [both, one_sided, track] = [gauss(), gauss(), gauss()].map(f64::signum);
        let scale = 1.0 + both * model.radius_error;
        let difference = 0.5 * one_sided * model.radius_difference;
        let waypoints: Vec<Point2<f64>> = path.points.iter().map(|&p| p.into()).collect();
        let start = Vector2::new(waypoints[0].x, waypoints[0].y);
        Self {
            wheels,
            true_radius: [
                f64::from(wheels.left_radius_m) * scale * (1.0 - difference),
                f64::from(wheels.right_radius_m) * scale * (1.0 + difference),
            ],
            true_track: f64::from(wheels.track_m) * (1.0 + track * model.track_error),
            slip_sigma: model.slip_m_per_sqrt_m,
            rng,
            pose: Isometry2::new(start, path.heading_deg.to_radians()),
            waypoints,
            speed: path.speed,
            next: 1,
            pause_s: path.pause_s,
            twist: [0.0; 2],
            angle: [0.0; 2],
        }
    }

    /// Radii (left, right) and track as they really are, metres.
    pub fn truth(&self) -> ([f64; 2], f64) {
        (self.true_radius, self.true_track)
    }

    /// Whether the end of the path is reached and the base stands.
    pub fn arrived(&self) -> bool {
        self.next >= self.waypoints.len() && self.twist[0].abs() < 1e-3
    }

    /// Drives on for a short while.
    pub fn step(&mut self, dt_s: f64) {
        if self.pause_s > 0.0 {
            self.pause_s -= dt_s;
            return;
        }
        let [speed, turn] = self.wanted();
        let towards =
            |now: f64, wanted: f64, most: f64| now + (wanted - now).clamp(-most * dt_s, most * dt_s);
        self.twist[0] = towards(self.twist[0], speed, MOST_ACCELERATION_M_S2);
        self.twist[1] = towards(self.twist[1], turn, MOST_TURN_ACCELERATION_RAD_S2);
        let [v, w] = self.twist;
        let (half, way) = (0.5 * w * dt_s, v * dt_s);
        let heading = self.pose.rotation.angle() + half;
        let moved = Vector2::new(libm::cos(heading) * way, libm::sin(heading) * way);
        self.pose = Isometry2::new(self.pose.translation.vector + moved, heading + half);
        for (side, sign) in [-1.0, 1.0].into_iter().enumerate() {
            let travelled = (v + sign * 0.5 * w * self.true_track) * dt_s;
            let sigma = self.slip_sigma * travelled.abs().sqrt();
            let slip = Normal::new(0.0, sigma).map_or(0.0, |n| n.sample(&mut self.rng));
            self.angle[side] += (travelled + slip) / self.true_radius[side];
        }
    }

    /// Counters of the left and right wheel, as wide as the robot's.
    pub fn ticks(&self) -> [i64; 2] {
        self.angle.map(|angle| {
            let ticks =
                (angle / (2.0 * std::f64::consts::PI) * f64::from(self.wheels.ticks_per_turn)).floor() as i64;
            if self.wheels.counter_bits == 16 { ticks.rem_euclid(1 << 16) } else { ticks }
        })
    }

    /// Speed and turn that lead along the path: pure pursuit, turning on the spot where the path bends sharply.
    fn wanted(&mut self) -> [f64; 2] {
        let here = Point2::from(self.pose.translation.vector);
        while self.next < self.waypoints.len() && (self.waypoints[self.next] - here).norm() < REACHED_M {
            self.next += 1;
        }
        let Some(&goal) = self.waypoints.get(self.next) else { return [0.0, 0.0] };
        let from = self.waypoints[self.next - 1];
        let leg = goal - from;
        let done = ((here - from).dot(&leg) / leg.norm_squared().max(1e-9)).clamp(0.0, 1.0);
        let ahead = (done * leg.norm() + LOOK_AHEAD_M).min(leg.norm());
        let target = from + leg.normalize() * ahead;
        let local = self.pose.inverse() * target;
        let off = libm::atan2(local.y, local.x);
        let turn = (2.5 * off).clamp(-MOST_TURN_RAD_S, MOST_TURN_RAD_S);
        let slow = (1.0 - off.abs() / 0.6).max(0.0);
        let remaining = (goal - here).norm();
        [(self.speed * slow).min(0.1 + remaining), turn]
    }
}
