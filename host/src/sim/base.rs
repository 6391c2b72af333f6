//! A two-wheeled base that follows a path: what it does, and what its encoders say it does.

use nalgebra::{Isometry2, Point2, Vector2};
use rand_pcg::Pcg64;

use super::config::{FaultModel, SimConfig};
use super::encoders::Encoders;
use super::slip::{Slip, Slipped};
use super::streams::{Stream, gauss, stream};
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
    /// Radii and track as they really are, metres.
    true_radius: [f64; 2],
    true_track: f64,
    slip_sigma: f64,
    rng: Pcg64,
    slip: Slip,
    encoders: Encoders,
    waypoints: Vec<Point2<f64>>,
    speed: f64,
    next: usize,
    /// Time to stand before driving, seconds.
    pause_s: f64,
    time_s: f64,
    fault: FaultModel,
    carried: Option<Carried>,
    /// Pose of `base` in the world.
    pub pose: Isometry2<f64>,
    /// Forward speed, m/s, and turn, rad/s.
    twist: [f64; 2],
}

/// A robot in somebody's hands.
struct Carried {
    from: Isometry2<f64>,
    to: Isometry2<f64>,
    since_s: f64,
}

impl Base {
    /// A base at the start of its path. The seed decides its errors and its slip.
    pub fn new(path: &DrivenPath, wheels: Wheels, sim: &SimConfig, seed: u64) -> Self {
        let (model, mut rng) = (&sim.wheel, stream(seed, Stream::Base));
        // The sizes of the systematic errors are given, their signs are the seed's.
        let [both, one_sided, track] = [gauss(&mut rng), gauss(&mut rng), gauss(&mut rng)].map(f64::signum);
        let scale = 1.0 + both * model.radius_error;
        let difference = 0.5 * one_sided * model.radius_difference;
        let waypoints: Vec<Point2<f64>> = path.points.iter().map(|&p| p.into()).collect();
        let true_track = f64::from(wheels.track_m) * (1.0 + track * model.track_error);
        Self {
            true_radius: [
                f64::from(wheels.left_radius_m) * scale * (1.0 - difference),
                f64::from(wheels.right_radius_m) * scale * (1.0 + difference),
            ],
            true_track,
            slip_sigma: model.slip_m_per_sqrt_m,
            rng,
            slip: Slip::new(model, &sim.fault, true_track, seed),
            encoders: Encoders::new(wheels, &sim.fault),
            pose: path.start(),
            waypoints,
            speed: path.speed,
            next: 1,
            pause_s: path.pause_s,
            time_s: 0.0,
            fault: sim.fault,
            carried: None,
            twist: [0.0; 2],
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

    /// Whether it is in somebody's hands.
    pub fn is_carried(&self) -> bool {
        self.carried.is_some()
    }

    /// Drives on for a short while.
    pub fn step(&mut self, dt_s: f64) {
        self.time_s += dt_s;
        if self.carry(dt_s) {
            return;
        }
        if self.pause_s > 0.0 {
            self.pause_s -= dt_s;
            let vain_m = self.slip.step(self.time_s, dt_s, [0.0; 2]).wheels_m;
            self.encoders.turn(self.time_s, [0, 1].map(|side| vain_m[side] / self.true_radius[side]));
            return;
        }
        let [speed, turn] = self.wanted();
        let towards =
            |now: f64, wanted: f64, most: f64| now + (wanted - now).clamp(-most * dt_s, most * dt_s);
        self.twist[0] = towards(self.twist[0], speed, MOST_ACCELERATION_M_S2);
        self.twist[1] = towards(self.twist[1], turn, MOST_TURN_ACCELERATION_RAD_S2);
        let slipped = self.slip.step(self.time_s, dt_s, self.twist);
        let [v, w] = self.twist;
        let (half, way) = (0.5 * (w * dt_s + slipped.kick_rad), v * dt_s);
        let heading = self.pose.rotation.angle() + half;
        let moved = Vector2::new(libm::cos(heading) * way, libm::sin(heading) * way);
        self.pose = Isometry2::new(self.pose.translation.vector + moved, heading + half);
        let travelled = [-1.0, 1.0].map(|sign| (v + sign * 0.5 * w * self.true_track) * dt_s);
        self.roll(travelled, slipped);
    }

    /// The wheels turn by the way that the base made, and by what slips.
    fn roll(&mut self, travelled: [f64; 2], slipped: Slipped) {
        let mut turned = [0.0; 2];
        for side in [0, 1] {
            let sigma = self.slip_sigma * travelled[side].abs().sqrt();
            let slip = sigma * gauss(&mut self.rng);
            turned[side] = (travelled[side] + slip + slipped.wheels_m[side]) / self.true_radius[side];
        }
        self.encoders.turn(self.time_s, turned);
    }

    /// Whether the robot is in somebody's hands; the wheels stand still meanwhile.
    fn carry(&mut self, dt_s: f64) -> bool {
        let f = self.fault;
        if self.carried.is_none() && (self.time_s - dt_s..self.time_s).contains(&f.lift_at_s) {
            let (to, next) = self.put_down();
            self.carried = Some(Carried { from: self.pose, to, since_s: self.time_s });
            self.next = next;
            self.twist = [0.0; 2];
        }
        let Some(carried) = &self.carried else { return false };
        let share = ((self.time_s - carried.since_s) / f.lift_s).min(1.0);
        self.pose = carried.from.lerp_slerp(&carried.to, share);
        self.encoders.turn(self.time_s, [0.0; 2]);
        if share >= 1.0 {
            self.carried = None;
        }
        true
    }

    /// Where the robot is put down, and the way point that it drives to from there.
    fn put_down(&self) -> (Isometry2<f64>, usize) {
        let length = |k: usize| (self.waypoints[k] - self.waypoints[k - 1]).norm();
        let here = Point2::from(self.pose.translation.vector);
        let last = self.waypoints.len() - 1;
        let next = self.next.min(last);
        let before: f64 = (1..=next).map(length).sum();
        let mut along = (before - (self.waypoints[next] - here).norm() + self.fault.lift_by_m).max(0.0);
        let mut leg = 1;
        while leg < last && along > length(leg) {
            along -= length(leg);
            leg += 1;
        }
        let direction = (self.waypoints[leg] - self.waypoints[leg - 1]).normalize();
        let at = self.waypoints[leg - 1] + direction * along.min(length(leg));
        let heading = libm::atan2(direction.y, direction.x) + self.fault.lift_turn_deg.to_radians();
        (Isometry2::new(at.coords, heading), leg)
    }

    /// Counters of the left and right wheel, as wide as the robot's.
    pub fn ticks(&self) -> [i64; 2] {
        self.encoders.ticks()
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
