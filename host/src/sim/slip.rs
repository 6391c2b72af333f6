//! Wheels that do not do what the ground does: slip in turns and at starts, wheels that spin, casters that kick.

use rand::RngExt;
use rand_pcg::Pcg64;

use super::config::{FaultModel, WheelModel};
use super::streams::{Stream, Wandering, exponential, gauss, stream};

/// A slip at a start lasts so long, seconds.
const START_SLIP_S: f64 = 0.25;
/// A wheel spins for a moment, seconds.
const SPIN_S: f64 = 0.2;
/// A caster swivels within, seconds.
const KICK_S: f64 = 0.2;
/// Slip in turns changes within, seconds.
const TURN_SLIP_S: f64 = 1.0;
/// Slower than the first the base stands, faster than the second it has started: m/s, and rad/s.
const STARTS: [[f64; 2]; 2] = [[0.05, 0.1], [0.1, 0.3]];

/// What one step adds.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Slipped {
    /// Way that the left and the right wheel turn in vain, metres.
    pub wheels_m: [f64; 2],
    /// Turn of the base that no wheel takes part in, radians.
    pub kick_rad: f64,
}

/// Slip of a base.
#[derive(Clone, Debug)]
pub struct Slip {
    model: WheelModel,
    fault: FaultModel,
    track_m: f64,
    turning: Wandering,
    starts: Pcg64,
    spins: Pcg64,
    caster: Pcg64,
    /// Whether the base drives, and whether it turns.
    moves: [bool; 2],
    bursts: [Burst; 2],
    kick: Burst,
}

/// A short motion.
#[derive(Clone, Copy, Debug, Default)]
struct Burst {
    side: usize,
    /// Per second.
    rate: f64,
    left_s: f64,
}

impl Burst {
    fn step(&mut self, dt_s: f64) -> f64 {
        if self.left_s <= 0.0 {
            return 0.0;
        }
        self.left_s -= dt_s;
        self.rate * dt_s
    }
}

impl Slip {
    /// A base that has not moved.
    pub fn new(model: &WheelModel, fault: &FaultModel, track_m: f64, seed: u64) -> Self {
        Self {
            model: *model,
            fault: *fault,
            track_m,
            turning: Wandering::new(stream(seed, Stream::TurnSlip), TURN_SLIP_S),
            starts: stream(seed, Stream::StartSlip),
            spins: stream(seed, Stream::Spins),
            caster: stream(seed, Stream::Caster),
            moves: [false; 2],
            bursts: [Burst::default(); 2],
            kick: Burst::default(),
        }
    }

    /// A step at this speed (m/s) and turn (rad/s).
    pub fn step(&mut self, time_s: f64, dt_s: f64, [speed, turn]: [f64; 2]) -> Slipped {
        self.start([speed.abs(), turn.abs()], [speed, turn]);
        self.spin(dt_s, [speed, turn]);
        let mut slipped = Slipped { kick_rad: self.kick.step(dt_s), ..Slipped::default() };
        for burst in &mut self.bursts {
            slipped.wheels_m[burst.side] += burst.step(dt_s);
        }
        if self.model.turn_slip > 0.0 {
            let share = self.model.turn_slip * turn.abs() * self.turning.after(dt_s);
            let vain_m = 0.5 * self.track_m * share * turn * dt_s;
            slipped.wheels_m[0] -= vain_m;
            slipped.wheels_m[1] += vain_m;
        }
        for (side, at_s) in [self.fault.spin_left_at_s, self.fault.spin_right_at_s].into_iter().enumerate() {
            if (at_s..at_s + self.fault.spin_s).contains(&time_s) {
                slipped.wheels_m[side] += self.fault.spin_m_s * dt_s;
            }
        }
        slipped
    }

    /// Starts, at which a wheel may slip and the caster swivels.
    fn start(&mut self, size: [f64; 2], twist: [f64; 2]) {
        for (moves, (size, [stands, started])) in self.moves.iter_mut().zip(size.into_iter().zip(STARTS)) {
            if *moves {
                *moves = size > stands;
                continue;
            }
            if size < started {
                continue;
            }
            *moves = true;
            // All is drawn at each start, so that one error does not move another.
            let (slips, size, side): (f64, f64, f64) =
                (self.starts.random(), exponential(&mut self.starts), self.starts.random());
            if slips < self.model.start_slip_share {
                let side = usize::from(side < 0.5);
                let vain_m = size * self.model.start_slip_deg.to_radians() * self.track_m;
                let rate = direction(side, twist, self.track_m) * vain_m / START_SLIP_S;
                self.bursts[0] = Burst { side, rate, left_s: START_SLIP_S };
            }
            let turn_rad = gauss(&mut self.caster) * self.model.caster_kick_deg.to_radians();
            self.kick = Burst { side: 0, rate: turn_rad / KICK_S, left_s: KICK_S };
        }
    }

    fn spin(&mut self, dt_s: f64, twist: [f64; 2]) {
        if self.model.spins_per_min <= 0.0 || !self.moves[0] {
            return;
        }
        if self.spins.random::<f64>() < self.model.spins_per_min / 60.0 * dt_s {
            let (side, size) = (usize::from(self.spins.random::<f64>() < 0.5), exponential(&mut self.spins));
            let rate = direction(side, twist, self.track_m) * size * self.model.spin_m / SPIN_S;
            self.bursts[1] = Burst { side, rate, left_s: SPIN_S };
        }
    }
}

/// Which way a wheel turns, as a sign.
fn direction(side: usize, [speed, turn]: [f64; 2], track_m: f64) -> f64 {
    let sign = if side == 0 { -1.0 } else { 1.0 };
    (speed + sign * 0.5 * turn * track_m).signum()
}

#[cfg(test)]
mod tests {
    use super::*;

    const QUIET: WheelModel = WheelModel {
        radius_error: 0.0,
        radius_difference: 0.0,
        track_error: 0.0,
        slip_m_per_sqrt_m: 0.0,
        turn_slip: 0.0,
        start_slip_share: 0.0,
        start_slip_deg: 0.0,
        spins_per_min: 0.0,
        spin_m: 0.0,
        caster_kick_deg: 0.0,
    };

    /// Slip of each second of a drive: three seconds of rest, seven of motion, over and over.
    fn seconds(model: WheelModel, fault: FaultModel, twist: [f64; 2], seed: u64) -> Vec<Slipped> {
        let mut slip = Slip::new(&model, &fault, 0.3, seed);
        let second = |k: usize| {
            let twist = if k % 10 < 3 { [0.0; 2] } else { twist };
            let mut sum = Slipped::default();
            for ms in 0..1000 {
                let step = slip.step(k as f64 + f64::from(ms) * 1e-3, 1e-3, twist);
                sum.wheels_m = [0, 1].map(|side| sum.wheels_m[side] + step.wheels_m[side]);
                sum.kick_rad += step.kick_rad;
            }
            sum
        };
        (0..1000).map(second).collect()
    }

    fn heading_deg(slipped: &Slipped) -> f64 {
        ((slipped.wheels_m[1] - slipped.wheels_m[0]) / 0.3).to_degrees()
    }

    #[test]
    fn wheels_slip_at_starts_and_then_alone() {
        let model = WheelModel { start_slip_share: 0.3, start_slip_deg: 5.0, ..QUIET };
        let all = seconds(model, FaultModel::default(), [0.4, 0.0], 7);
        let slips: Vec<usize> = (0..all.len()).filter(|k| all[*k].wheels_m != [0.0; 2]).collect();
        assert!(slips.iter().all(|k| k % 10 == 3), "{slips:?}");
        assert!((15..45).contains(&slips.len()), "{} of 100 starts", slips.len());
        let mean = slips.iter().map(|k| heading_deg(&all[*k]).abs()).sum::<f64>() / slips.len() as f64;
        assert!((3.0..8.0).contains(&mean), "{mean}°");
        // Forward is the way that the wheels turn.
        assert!(slips.iter().all(|k| all[*k].wheels_m.iter().all(|m| *m >= 0.0)));
    }

    #[test]
    fn slip_grows_in_turns() {
        let model = WheelModel { turn_slip: 0.05, ..QUIET };
        let rms = |twist: [f64; 2]| {
            let all = seconds(model, FaultModel::default(), twist, 3);
            (all.iter().map(|s| heading_deg(s).powi(2)).sum::<f64>() / 700.0).sqrt()
        };
        let (straight, slow, fast) = (rms([0.5, 0.0]), rms([0.0, 0.5]), rms([0.0, 1.0]));
        assert_eq!(straight, 0.0);
        assert!((fast / slow - 4.0).abs() < 1e-6, "slow {slow}°, fast {fast}°");
        // 5 % of 57°, wandering within a second.
        assert!((1.5..3.0).contains(&fast), "{fast}°");
    }

    #[test]
    fn the_caster_kicks_the_base_and_not_the_wheels() {
        let model = WheelModel { caster_kick_deg: 1.0, ..QUIET };
        let all = seconds(model, FaultModel::default(), [0.4, 0.0], 5);
        assert!(all.iter().all(|s| s.wheels_m == [0.0; 2]));
        let kicks: Vec<f64> = all.iter().map(|s| s.kick_rad.to_degrees()).filter(|k| *k != 0.0).collect();
        assert_eq!(kicks.len(), 100);
        let sigma = (kicks.iter().map(|k| k * k).sum::<f64>() / 100.0).sqrt();
        assert!((0.8..1.2).contains(&sigma), "{sigma}°");
    }

    #[test]
    fn one_error_does_not_move_another() {
        let model = WheelModel { start_slip_share: 0.3, start_slip_deg: 5.0, ..QUIET };
        let more =
            WheelModel { spins_per_min: 3.0, spin_m: 0.0, turn_slip: 0.05, caster_kick_deg: 2.0, ..model };
        let fault = FaultModel::default();
        let (few, many) = (seconds(model, fault, [0.4, 0.0], 9), seconds(more, fault, [0.4, 0.0], 9));
        assert!(few.iter().zip(&many).all(|(a, b)| a.wheels_m == b.wheels_m));
    }

    #[test]
    fn a_wheel_spins_when_it_is_told_to() {
        let fault = FaultModel { spin_left_at_s: 100.0, spin_s: 2.0, spin_m_s: 0.3, ..FaultModel::default() };
        let all = seconds(QUIET, fault, [0.4, 0.0], 1);
        for (k, slipped) in all.iter().enumerate() {
            let expected = if k == 100 || k == 101 { 0.3 } else { 0.0 };
            assert!((slipped.wheels_m[0] - expected).abs() < 0.001 && slipped.wheels_m[1] == 0.0, "{k}");
        }
    }
}
