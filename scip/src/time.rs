//! From the sensor's clock to the host's.
//!
//! A scan's stamp is the low 24 bits of a millisecond counter, which wraps every 4.66 hours and runs on the sensor's own
//! quartz. [`Unwrapper`] makes it 64 bits; [`SensorClock`] finds when a stamp was on the host's clock, and how long a revolution
//! takes.
//!
//! The offset between the clocks comes from an exchange (`TM1`, half the round trip) where there was one. From then on arrivals
//! tell how it changes: the skew is estimated, for the host's clock may be an RC oscillator that is 1 % off. Two witnesses say
//! when the sensor's clock was set, or a scan read late: what lies between stamp and arrival, and the line on which the stamps of
//! one revolution after the other lie. No scan gets a stamp that can be more than 0.1 s off, or lies before the last one's.

mod filter;
mod revolution;
#[cfg(test)]
mod tests;

use filter::Filter;
use revolution::Revolution;

/// Stamps wrap here, milliseconds.
const WRAP_MS: u64 = 1 << 24;
/// An exchange this far from what earlier ones said is not believed, microseconds.
const BELIEVED_US: i64 = 500_000;
/// A longer round trip tells too little, microseconds.
const ROUND_TRIP_US: u64 = 100_000;
/// An arrival this far from where it is expected is doubted, microseconds. More than USB's latency timer, and well below the least
/// step of the clock that must be noticed.
const DOUBT_US: f32 = 12_000.0;
/// The same while the delay is not known yet.
const MOST_DOUBT_US: f32 = 60_000.0;
/// Standard deviations that make a doubt.
const DOUBT_SIGMAS: f32 = 4.0;
/// After so many doubtful scans in a row that agree the clock was set, or the way of scans has changed.
const STUBBORN: u8 = 3;
/// A scan that is read this late may be another revolution's, microseconds.
const MOST_LATE_US: f32 = 90_000.0;
/// The two witnesses of a clock that was set agree within this, microseconds.
const AGREED_US: f32 = 8_000.0;

/// Over more than this the line of the stamps is not known well enough to be a witness, microseconds.
const COUNTED_US: f32 = 2_000_000.0;

/// Makes 64 bits of 24.
#[derive(Clone, Copy, Debug, Default)]
pub struct Unwrapper {
    last: Option<(u64, u64)>,
}

impl Unwrapper {
    /// The stamp that ends in these 24 bits and lies nearest to what the host's clock leads to expect. The first is taken
    /// as it is. Gaps of any length are bridged, as long as the clocks differ by less than 2.3 hours over them.
    pub fn unwrap(&mut self, stamp_ms: u32, host_us: u64) -> u64 {
        let stamp = u64::from(stamp_ms) % WRAP_MS;
        let unwrapped = match self.last {
            None => stamp,
            Some((last, then_us)) => {
                let expected = last + host_us.saturating_sub(then_us) / 1000;
                // Nearest: the difference modulo the wrap, taken as signed.
                let ahead = stamp.wrapping_sub(expected) % WRAP_MS;
                if ahead < WRAP_MS / 2 {
                    expected + ahead
                } else {
                    (expected + ahead).checked_sub(WRAP_MS).unwrap_or(stamp)
                }
            }
        };
        self.last = Some((unwrapped, host_us));
        unwrapped
    }
}

/// A scan's place in time, on the host's clock.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Stamped {
    /// When step 0 was, microseconds. Never behind the arrival, and behind the scan before.
    pub at_us: u64,
    /// One revolution, microseconds: measured, or as the sensor states it while that is still being learnt.
    pub revolution_us: u32,
}

/// When the sensor's stamps were, on the host's clock.
#[derive(Clone, Copy, Debug, Default)]
pub struct SensorClock {
    unwrapper: Unwrapper,
    filter: Option<Filter>,
    /// Nothing has arrived since the exchange.
    fresh: bool,
    revolution: Option<Revolution>,
    doubt: Option<Doubt>,
    last_us: Option<u64>,
    rejected: u32,
    jumps: u32,
}

/// Scans in a row that arrived at another time than expected, all by about as much.
#[derive(Clone, Copy, Debug)]
struct Doubt {
    surprise_us: f32,
    scans: u8,
}

/// A scan's stamp and arrival, and what is odd about them.
#[derive(Clone, Copy)]
struct Seen {
    sensor_us: i64,
    /// How much later than expected it arrived.
    surprise_us: f32,
}

impl SensorClock {
    /// Takes an answer to `TM1`: asked and answered on the host's clock, and the stamp. False, and nothing is changed, where
    /// the round trip is longer than 100 ms or an earlier answer says otherwise by more than half a second.
    pub fn exchange(&mut self, asked_us: u64, answered_us: u64, stamp_ms: u32) -> bool {
        let round_us = answered_us.saturating_sub(asked_us);
        let host_us = asked_us + round_us / 2;
        let offset_us = host_us as i64 - self.sensor_us(stamp_ms, host_us);
        let contradicts = self.filter.is_some_and(|f| (offset_us - f.offset_us()).abs() > BELIEVED_US);
        if round_us > ROUND_TRIP_US || contradicts {
            self.rejected = self.rejected.wrapping_add(1);
            return false;
        }
        self.filter = Some(Filter::from_exchange(offset_us, host_us));
        self.fresh = true;
        true
    }

    /// When a scan's step 0 was. `None` where that may be more than 0.1 s off, or would lie before the last scan: the scan is of
    /// no use. At the latest the third one in a row is.
    ///
    /// `arrived_us` is when its end was read, `least_delay_us` what lies between stamp and arrival at least: the sweep,
    /// and the bytes on the line. `nominal_us` is one revolution, as the sensor states it.
    pub fn scan(
        &mut self,
        stamp_ms: u32,
        arrived_us: u64,
        least_delay_us: u64,
        nominal_us: u32,
    ) -> Option<Stamped> {
        let sensor_us = self.sensor_us(stamp_ms, arrived_us);
        let (arrived, least_us) = (arrived_us as i64, least_delay_us as i64);
        let mut revolution = self.revolution.unwrap_or_else(|| Revolution::new(sensor_us, nominal_us));
        let mut filter = self
            .filter
            .unwrap_or_else(|| Filter::from_arrival(arrived - least_us - sensor_us, least_us, arrived_us));
        filter.predict(arrived_us);
        if core::mem::take(&mut self.fresh) {
            filter.expect_delay(least_us, arrived - sensor_us);
        }
        let (surprise_us, sigma_us) = filter.surprise(arrived - sensor_us);
        let at_us = if surprise_us.abs() <= (DOUBT_SIGMAS * sigma_us).clamp(DOUBT_US, MOST_DOUBT_US) {
            // After a stamp that was wrong for certain, one right one may be a wrong one read late.
            let early = self.doubt.take().is_some_and(|doubt| doubt.surprise_us < -DOUBT_US);
            self.doubt = early.then_some(Doubt { surprise_us, scans: 1 });
            if !early {
                filter.take(surprise_us);
                revolution.take(sensor_us);
            }
            (!early).then(|| sensor_us + filter.offset_us())
        } else {
            self.rejected = self.rejected.wrapping_add(1);
            self.doubtful(Seen { sensor_us, surprise_us }, &mut filter, &mut revolution)
        };
        (self.filter, self.revolution) = (Some(filter), Some(revolution));
        let at_us = at_us?.min(arrived).max(0) as u64;
        if self.last_us.is_some_and(|last_us| at_us <= last_us) {
            self.rejected = self.rejected.wrapping_add(1);
            return None;
        }
        self.last_us = Some(at_us);
        Some(Stamped { at_us, revolution_us: host_length_us(&revolution, &filter, nominal_us) })
    }

    /// Stamps and exchanges that were not believed.
    pub fn rejected(&self) -> u32 {
        self.rejected
    }

    /// Times that the sensor's clock was found to have been set.
    pub fn jumps(&self) -> u32 {
        self.jumps
    }

    /// How much faster than the sensor's the host's clock runs, parts per million. Zero while nothing is known.
    pub fn skew_ppm(&self) -> f32 {
        self.filter.map_or(0.0, |filter| filter.skew_ppm())
    }

    /// A stamp as microseconds on the sensor's clock; it is cut to milliseconds, and half of one is the mean error.
    fn sensor_us(&mut self, stamp_ms: u32, host_us: u64) -> i64 {
        (self.unwrapper.unwrap(stamp_ms, host_us) * 1000 + 500) as i64
    }

    /// A scan arrived at another time than expected: the sensor's clock was set, or the scan was read late, or from now on all are.
    /// Where the stamps' line says by as much that the clock was set, it was; else the third scan decides.
    fn doubtful(&mut self, seen: Seen, filter: &mut Filter, revolution: &mut Revolution) -> Option<i64> {
        let Seen { sensor_us, surprise_us } = seen;
        let (off_us, _) = revolution.off_us(sensor_us);
        let on_line = revolution.is_learnt() && revolution.fits(off_us);
        let length_us = revolution.length_us();
        // A clock set ahead makes a scan seem to arrive early, and its stamp lie behind the line.
        let apart_us = within_half(off_us + surprise_us, length_us).abs();
        let same = self.doubt.filter(|doubt| (doubt.surprise_us - surprise_us).abs() < DOUBT_US);
        // They cannot tell a scan that was read whole revolutions late: not after another that was odd in another way.
        let plain = surprise_us.abs() < COUNTED_US && self.doubt.is_none() == same.is_none();
        let agreed = revolution.is_learnt() && plain && !on_line && apart_us < AGREED_US;
        let scans = same.map_or(1, |doubt| doubt.scans + 1);
        if agreed || scans >= STUBBORN {
            self.doubt = None;
            // At first more likely the one scan was late by which the delay is known.
            if (on_line || !revolution.is_learnt()) && surprise_us.abs() < 0.5 * length_us {
                filter.step_delay(surprise_us);
                revolution.take(sensor_us);
            } else {
                filter.step_offset(surprise_us as i64);
                revolution.begin(sensor_us);
                self.jumps = self.jumps.wrapping_add(1);
            }
            return Some(sensor_us + filter.offset_us());
        }
        let before = self.doubt.replace(Doubt { surprise_us, scans });
        // Earlier than can be, the stamp is wrong; off the line, very late, or after another doubtful one, it may be.
        if !(0.0..=MOST_LATE_US).contains(&surprise_us) || !on_line || before.is_some() {
            return None;
        }
        revolution.take(sensor_us);
        Some(sensor_us + filter.offset_us())
    }
}

/// A revolution on the host's clock.
fn host_length_us(revolution: &Revolution, filter: &Filter, nominal_us: u32) -> u32 {
    if !revolution.is_learnt() {
        return nominal_us;
    }
    (revolution.length_us() * (1.0 + 1e-6 * filter.skew_ppm()) + 0.5) as u32
}

/// The value modulo a length, within half of it either way.
fn within_half(value: f32, length: f32) -> f32 {
    let turns = value / length;
    value - (turns + if turns < 0.0 { -0.5 } else { 0.5 }) as i64 as f32 * length
}
