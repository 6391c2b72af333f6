//! When scans are taken and stamped: a motor that wanders, a host that stamps late.

use rand::RngExt;
use rand_pcg::Pcg64;

use super::config::ClockModel;
use super::streams::{Stream, Wandering, exponential, stream};

/// The motor's speed changes within, seconds.
const WANDERS_S: f64 = 20.0;
/// A hiccup of the host is up to so long, microseconds.
const HICCUP_US: f64 = 150_000.0;
/// Two stamps are at least so far apart, microseconds; exp1's least is 4.8 ms.
const APART_US: u64 = 4000;

/// The scanner's motor and the host's clock.
#[derive(Clone, Debug)]
pub struct Clock {
    model: ClockModel,
    motor: Wandering,
    stamps: Pcg64,
    /// Offset of this unit's stamps, microseconds.
    offset_us: f64,
    last_us: Option<u64>,
}

impl Clock {
    /// A clock whose offset the seed draws.
    pub fn new(model: &ClockModel, seed: u64) -> Self {
        let drawn: f64 = stream(seed, Stream::Offset).random_range(-1.0..1.0);
        Self {
            model: *model,
            motor: Wandering::new(stream(seed, Stream::Motor), WANDERS_S),
            stamps: stream(seed, Stream::Stamps),
            offset_us: drawn * model.offset_s * 1e6,
            last_us: None,
        }
    }

    /// Length of the next revolution, as a share of the nominal one.
    pub fn revolution(&mut self, nominal_s: f64) -> f64 {
        if self.model.revolution > 0.0 {
            1.0 + self.model.revolution * self.motor.after(nominal_s)
        } else {
            1.0
        }
    }

    /// How much later than it should be the next scan is stamped, microseconds; below zero if before.
    pub fn late_us(&mut self) -> f64 {
        let (jitter, hiccup, length): (f64, f64, f64) =
            (exponential(&mut self.stamps), self.stamps.random(), self.stamps.random());
        let hiccup_us = if hiccup < self.model.hiccups { length * HICCUP_US } else { 0.0 };
        self.offset_us + jitter * self.model.jitter_s * 1e6 + hiccup_us
    }

    /// The same on average, seconds.
    pub fn mean_late_s(&self) -> f64 {
        self.offset_us * 1e-6 + self.model.jitter_s + self.model.hiccups * 0.5 * HICCUP_US * 1e-6
    }

    /// A stamp, after that before it.
    pub fn ordered(&mut self, stamp_us: u64) -> u64 {
        let stamp_us = self.last_us.map_or(stamp_us, |last| stamp_us.max(last + APART_US));
        self.last_us = Some(stamp_us);
        stamp_us
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_motor_wanders_by_what_it_is_told_to() {
        let mut clock = Clock::new(&ClockModel { revolution: 0.02, ..ClockModel::default() }, 4);
        let all: Vec<f64> = (0..20_000).map(|_| clock.revolution(0.1) - 1.0).collect();
        let sigma = (all.iter().map(|v| v * v).sum::<f64>() / all.len() as f64).sqrt();
        assert!((0.014..0.026).contains(&sigma), "{sigma}");
        // It wanders: from turn to turn it hardly changes.
        assert!(all.windows(2).all(|w| (w[1] - w[0]).abs() < 0.012));
        assert_eq!(Clock::new(&ClockModel::default(), 4).revolution(0.1), 1.0);
    }

    #[test]
    fn stamps_are_late_by_offset_and_jitter_and_stay_in_order() {
        let model = ClockModel { jitter_s: 0.01, hiccups: 0.01, offset_s: 0.02, ..ClockModel::default() };
        let (mut all, mut offsets) = (0.0, Vec::new());
        for seed in 0..50 {
            let mut clock = Clock::new(&model, seed);
            let late: Vec<f64> = (0..400).map(|_| clock.late_us() * 1e-6).collect();
            let mean = late.iter().sum::<f64>() / 400.0;
            assert!((mean - clock.mean_late_s()).abs() < 0.003, "{mean} {}", clock.mean_late_s());
            offsets.push(clock.offset_us * 1e-6);
            all += mean;
            let before = clock.ordered(1000);
            assert!(clock.ordered(500) > before);
        }
        assert!(offsets.iter().all(|o| o.abs() <= 0.02));
        assert!(offsets.iter().any(|o| *o > 0.01) && offsets.iter().any(|o| *o < -0.01));
        assert!((all / 50.0 - 0.01075).abs() < 0.005);
        assert_eq!(Clock::new(&ClockModel::default(), 3).late_us(), 0.0);
    }
}
