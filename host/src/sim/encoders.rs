//! The counters of the wheels, and what may be wrong with them.

use crate::robot::Wheels;

use super::config::FaultModel;

/// Two encoders and their counters.
#[derive(Clone, Debug)]
pub struct Encoders {
    wheels: Wheels,
    fault: FaultModel,
    /// Turn that each counter has counted, radians.
    angle: [f64; 2],
    /// What the counters said before they began again.
    before_restart: [i64; 2],
    restarted: bool,
}

impl Encoders {
    /// Counters at zero.
    pub fn new(wheels: Wheels, fault: &FaultModel) -> Self {
        Self { wheels, fault: *fault, angle: [0.0; 2], before_restart: [0; 2], restarted: false }
    }

    /// The wheels turn by so much, radians.
    pub fn turn(&mut self, time_s: f64, wheels_rad: [f64; 2]) {
        let f = &self.fault;
        let [left, right] = wheels_rad;
        let seen = if time_s >= f.swap_at_s { [right, left] } else { [left, right] };
        let reversed = [time_s >= f.reverse_left_at_s, time_s >= f.reverse_right_at_s];
        let dead = [time_s >= f.dead_left_at_s, time_s >= f.dead_right_at_s];
        for side in [0, 1] {
            if !dead[side] {
                self.angle[side] += if reversed[side] { -seen[side] } else { seen[side] };
            }
        }
        if !self.restarted && time_s >= f.restart_at_s {
            self.restarted = true;
            self.before_restart = self.counts();
        }
    }

    /// Counters of the left and right wheel, as wide as the robot's.
    pub fn ticks(&self) -> [i64; 2] {
        let counts = self.counts();
        [0, 1].map(|side| {
            let ticks = counts[side] - self.before_restart[side];
            if self.wheels.counter_bits == 16 { ticks.rem_euclid(1 << 16) } else { ticks }
        })
    }

    fn counts(&self) -> [i64; 2] {
        self.angle.map(|angle| {
            (angle / (2.0 * std::f64::consts::PI) * f64::from(self.wheels.ticks_per_turn)).floor() as i64
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Ticks of each second: the left wheel turns once a second, the right one twice.
    fn seconds(fault: FaultModel, counter_bits: u8) -> Vec<[i64; 2]> {
        let wheels = Wheels {
            left_radius_m: 0.05,
            right_radius_m: 0.05,
            track_m: 0.3,
            ticks_per_turn: 1000.0,
            counter_bits,
        };
        let mut encoders = Encoders::new(wheels, &fault);
        let turn = std::f64::consts::TAU;
        (0..40)
            .map(|k| {
                for tenth in 0..10 {
                    encoders.turn(f64::from(k) + 0.1 * f64::from(tenth), [0.1 * turn, 0.2 * turn]);
                }
                encoders.ticks()
            })
            .collect()
    }

    fn near(ticks: [i64; 2], expected: [i64; 2]) {
        assert!((0..2).all(|side| (ticks[side] - expected[side]).abs() <= 1), "{ticks:?}, not {expected:?}");
    }

    #[test]
    fn counters_wrap_at_their_width_and_begin_again_at_zero() {
        near(seconds(FaultModel::default(), 32)[35], [36_000, 72_000]);
        near(seconds(FaultModel::default(), 16)[35], [36_000, 72_000 - 65_536]);
        let all = seconds(FaultModel { restart_at_s: 10.0, ..FaultModel::default() }, 32);
        near(all[9], [10_000, 20_000]);
        near(all[10], [900, 1800]);
        near(all[19], [9900, 19_800]);
    }

    #[test]
    fn encoders_are_swapped_reversed_and_dead_from_their_time_on() {
        let fault = FaultModel::default();
        near(seconds(FaultModel { swap_at_s: 10.0, ..fault }, 32)[19], [30_000, 30_000]);
        near(seconds(FaultModel { reverse_left_at_s: 10.0, ..fault }, 32)[29], [-10_000, 60_000]);
        near(seconds(FaultModel { reverse_right_at_s: 0.0, ..fault }, 32)[9], [10_000, -20_000]);
        near(seconds(FaultModel { dead_right_at_s: 10.0, ..fault }, 32)[29], [30_000, 20_000]);
        near(seconds(FaultModel { dead_left_at_s: 10.0, ..fault }, 32)[29], [10_000, 60_000]);
    }
}
