//! Offset, skew and delay, from what arrives: a Kalman filter of three numbers.
//!
//! The state is the offset between the clocks (host minus sensor), its rate, and what lies between a scan's stamp and its
//! arrival. An exchange sees the offset, an arrival the sum of offset and delay; that the delay is constant and the offset runs
//! away tells the two apart. Units are microseconds and seconds, so a skew of 1 part in a million is 1 µs/s.

/// Standard deviation of an exchange: half the round trip may lie on either side, and the stamp is cut to milliseconds.
const EXCHANGE_US: f32 = 700.0;
/// Standard deviation of an arrival: the cut stamp, and when the end of a scan is read.
const ARRIVAL_US: f32 = 1_000.0;
/// Arrivals farther off than this weigh less, by the square.
const PLAIN_US: f32 = 3_000.0;
/// Standard deviation of the skew before anything is known: an RC oscillator is good to 1 %, a quartz to 100 ppm.
const SKEW_US_PER_S: f32 = 5_000.0;
/// How the skew wanders, µs/s per square root of a second: an RC oscillator that warms up by 30 K in some minutes.
const WANDER: f32 = 30.0;
/// Standard deviation of what the sensor adds to the least delay.
const DELAY_US: f32 = 10_000.0;
/// No sensor adds more, microseconds.
const MOST_MORE_US: i64 = 500_000;
/// Standard deviation of an offset that was set anew from an arrival.
const ANEW_US: f32 = 3_000.0;

/// Offset, skew and delay, and how well they are known.
#[derive(Clone, Copy, Debug)]
pub(super) struct Filter {
    /// Whole microseconds of the offset, so that the rest keeps its digits.
    whole_us: i64,
    offset_us: f32,
    skew: f32,
    delay_us: f32,
    /// Covariance: of offset, skew and delay, its upper half.
    oo: f32,
    os: f32,
    od: f32,
    ss: f32,
    sd: f32,
    dd: f32,
    at_us: u64,
}

impl Filter {
    /// From an exchange. The delay is thought to be a little more than the least.
    pub(super) fn from_exchange(offset_us: i64, at_us: u64) -> Self {
        let dd = DELAY_US * DELAY_US;
        Self { oo: EXCHANGE_US * EXCHANGE_US, dd, ..Self::from_arrival(offset_us, 0, at_us) }
    }

    /// From an arrival alone: the delay is taken to be the least there is, for good.
    pub(super) fn from_arrival(offset_us: i64, delay_us: i64, at_us: u64) -> Self {
        Self {
            whole_us: offset_us,
            offset_us: 0.0,
            skew: 0.0,
            delay_us: delay_us as f32,
            oo: ANEW_US * ANEW_US,
            os: 0.0,
            od: 0.0,
            ss: SKEW_US_PER_S * SKEW_US_PER_S,
            sd: 0.0,
            dd: 0.0,
            at_us,
        }
    }

    /// The first arrival after an exchange: the delay is what it says, if that can be. Over USB it is far less than the bit rate has
    /// one think.
    pub(super) fn expect_delay(&mut self, least_us: i64, difference_us: i64) {
        let seen_us = difference_us - self.offset_us();
        let can_be = (0..least_us + MOST_MORE_US).contains(&seen_us);
        self.delay_us = if can_be { seen_us as f32 } else { least_us as f32 + 0.5 * DELAY_US };
    }

    pub(super) fn offset_us(&self) -> i64 {
        self.whole_us + self.offset_us as i64
    }

    /// How much faster than the sensor's clock the host's runs, parts per million.
    pub(super) fn skew_ppm(&self) -> f32 {
        self.skew
    }

    /// On to an instant on the host's clock.
    pub(super) fn predict(&mut self, at_us: u64) {
        let dt = at_us.saturating_sub(self.at_us) as f32 * 1e-6;
        self.at_us = self.at_us.max(at_us);
        self.offset_us += self.skew * dt;
        self.settle();
        self.oo += dt * (2.0 * self.os + dt * self.ss);
        self.os += dt * self.ss;
        self.od += dt * self.sd;
        self.ss += dt * WANDER * WANDER;
    }

    /// What is left of an arrival minus stamp when offset and delay are taken off, and its standard deviation.
    pub(super) fn surprise(&self, difference_us: i64) -> (f32, f32) {
        let left = (difference_us - self.whole_us) as f32 - self.offset_us - self.delay_us;
        let variance = self.oo + 2.0 * self.od + self.dd + ARRIVAL_US * ARRIVAL_US;
        (left, root(variance))
    }

    /// Takes an arrival with this surprise in.
    pub(super) fn take(&mut self, surprise_us: f32) {
        let far = (surprise_us / PLAIN_US).abs().max(1.0);
        let noise = ARRIVAL_US * ARRIVAL_US * far * far;
        let (o, s, d) = (self.oo + self.od, self.os + self.sd, self.od + self.dd);
        let inverse = 1.0 / (o + d + noise);
        self.offset_us += o * inverse * surprise_us;
        self.skew += s * inverse * surprise_us;
        self.delay_us += d * inverse * surprise_us;
        self.settle();
        self.oo = (self.oo - o * o * inverse).max(1.0);
        self.os -= o * s * inverse;
        self.od -= o * d * inverse;
        self.ss = (self.ss - s * s * inverse).max(1e-2);
        self.sd -= s * d * inverse;
        self.dd = (self.dd - d * d * inverse).max(0.0);
    }

    /// The sensor's clock was set: the offset is another, what else is known stays.
    pub(super) fn step_offset(&mut self, by_us: i64) {
        self.whole_us += by_us;
        self.oo += ANEW_US * ANEW_US;
    }

    /// The way of scans to here has become longer or shorter.
    pub(super) fn step_delay(&mut self, by_us: f32) {
        self.delay_us += by_us;
        self.oo += ANEW_US * ANEW_US;
    }

    fn settle(&mut self) {
        let whole = self.offset_us as i64;
        self.whole_us += whole;
        self.offset_us -= whole as f32;
    }
}

/// Square root to a few parts in a thousand; there is none in `core`.
fn root(x: f32) -> f32 {
    if x <= 0.0 {
        return 0.0;
    }
    // Half the exponent, then twice Newton's step.
    let mut y = f32::from_bits((x.to_bits() >> 1) + 0x1FBD_1DF5);
    for _ in 0..2 {
        y = 0.5 * (y + x / y);
    }
    y
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_root_is_one() {
        for x in [1e-3, 1.0, 2.0, 1e6, 2.25e8, 3.7e15] {
            assert!((root(x) / x.sqrt() - 1.0).abs() < 1e-3, "{x}");
        }
        assert_eq!((root(0.0), root(-1.0)), (0.0, 0.0));
    }
}
