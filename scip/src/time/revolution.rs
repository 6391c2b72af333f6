//! How long a revolution takes, from the stamps: a phase-locked loop.
//!
//! A stamp is cut to milliseconds, and the motor wanders by some parts in a hundred. Stamps of one revolution after the other lie
//! on a line, so the loop knows better than any two of them; and a clock that was set is off the line.

/// A stamp may be so far off the line, microseconds: the millisecond it is cut to, and a motor that changes its speed.
const LOCKED_US: f32 = 6_000.0;
/// The same while the revolution is still being learnt.
const LEARNING_US: f32 = 12_000.0;
/// Revolutions until it is learnt.
const LEARNT: u16 = 20;
/// Share of a stamp's distance from the line that its place takes, and the length of a revolution.
const PLACE: f32 = 0.5;
const LENGTH: f32 = 0.1;
/// A revolution is within so much of what the sensor states.
const WITHIN: f32 = 0.15;
/// After more revolutions than this the line begins anew.
const MOST: i64 = 50;

/// The line on which the stamps lie.
#[derive(Clone, Copy, Debug)]
pub(super) struct Revolution {
    nominal_us: f32,
    length_us: f32,
    /// Where on the sensor's clock the last revolution began: whole microseconds, and the rest.
    whole_us: i64,
    rest_us: f32,
    taken: u16,
}

impl Revolution {
    /// The first.
    pub(super) fn new(sensor_us: i64, nominal_us: u32) -> Self {
        let nominal_us = nominal_us.max(1) as f32;
        Self { nominal_us, length_us: nominal_us, whole_us: sensor_us, rest_us: 0.0, taken: 0 }
    }

    /// One revolution on the sensor's clock, microseconds.
    pub(super) fn length_us(&self) -> f32 {
        self.length_us
    }

    pub(super) fn is_learnt(&self) -> bool {
        self.taken >= LEARNT
    }

    /// How far a stamp lies off the line, within half a revolution either way, and how many revolutions after the last.
    pub(super) fn off_us(&self, sensor_us: i64) -> (f32, i64) {
        let gap = (sensor_us - self.whole_us) as f32 - self.rest_us;
        let turns = (gap / self.length_us + if gap < 0.0 { -0.5 } else { 0.5 }) as i64;
        (gap - turns as f32 * self.length_us, turns)
    }

    /// Whether a stamp lies on the line.
    pub(super) fn fits(&self, off_us: f32) -> bool {
        off_us.abs() < if self.is_learnt() { LOCKED_US } else { LEARNING_US }
    }

    /// Takes a stamp in. One that is off the line begins another, as long a revolution.
    pub(super) fn take(&mut self, sensor_us: i64) {
        let (off_us, turns) = self.off_us(sensor_us);
        if !self.fits(off_us) || !(1..=MOST).contains(&turns) {
            self.begin(sensor_us);
            return;
        }
        // At first each stamp tells much.
        let learning = 1.0 / (f32::from(self.taken) + 2.0);
        self.rest_us += turns as f32 * self.length_us + off_us * PLACE.max(learning);
        self.length_us += off_us * LENGTH.max(learning) / turns as f32;
        let most = self.nominal_us * WITHIN;
        // Not `clamp`, whose panic would bring the printing of floating-point numbers along, 15 kB of a microcontroller's flash.
        self.length_us = self.length_us.max(self.nominal_us - most).min(self.nominal_us + most);
        let whole = self.rest_us as i64;
        self.whole_us += whole;
        self.rest_us -= whole as f32;
        self.taken = self.taken.saturating_add(1);
    }

    /// The line begins anew here.
    pub(super) fn begin(&mut self, sensor_us: i64) {
        (self.whole_us, self.rest_us) = (sensor_us, 0.0);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Largest error of the length over the second half of so many revolutions, parts per thousand of the length.
    fn worst(length_us: impl Fn(i64) -> f64, left_out: impl Fn(i64) -> bool) -> f64 {
        let mut begin_us = 12_345.0;
        let mut revolution = Revolution::new(12_000, 100_000);
        let mut worst = 0.0f64;
        for k in 0..1200 {
            begin_us += length_us(k);
            if left_out(k) {
                continue;
            }
            revolution.take((begin_us / 1000.0) as i64 * 1000);
            if k > 600 {
                worst = worst.max((f64::from(revolution.length_us()) / length_us(k) - 1.0).abs());
            }
        }
        worst * 1000.0
    }

    #[test]
    fn a_revolution_is_measured_to_a_part_in_a_thousand() {
        for length_us in [90_000.0, 97_300.0, 100_000.0, 100_123.0, 103_000.0, 110_000.0] {
            assert!(
                worst(|_| length_us, |_| false) < 1.5,
                "{length_us}: {}",
                worst(|_| length_us, |_| false)
            );
            let missing = |k: i64| k % 7 == 3 || k % 50 > 45;
            assert!(worst(|_| length_us, missing) < 1.5, "{length_us}: {}", worst(|_| length_us, missing));
        }
    }

    #[test]
    fn a_motor_that_wanders_is_followed() {
        // 1 % either way in half a minute.
        let wandering = |k: i64| 100_000.0 + 1000.0 * (k as f64 / 300.0 * std::f64::consts::TAU).sin();
        assert!(worst(wandering, |_| false) < 3.0, "{}", worst(wandering, |_| false));
    }
}
