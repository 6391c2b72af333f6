//! From the sensor's clock to the host's.
//!
//! A scan's stamp is the low 24 bits of a millisecond counter, which wraps every 4.66 hours and runs on the sensor's own
//! quartz. [`Unwrapper`] makes it 64 bits; [`SensorClock`] finds when a stamp was on the host's clock.
//!
//! The offset between the clocks comes from an exchange (`TM1`, half the round trip) where there was one; from then on,
//! and without one, from arrival: a scan arrives a while after its stamp, never earlier than the sensor can send it, so the least
//! of all differences is the best one. It may rise as fast as quartzes differ, so that drift is followed.

/// Stamps wrap here, milliseconds.
const WRAP_MS: u64 = 1 << 24;
/// How fast two quartzes may differ, as 1/x.
const DRIFT: u64 = 5_000;
/// A stamp this far from where the clock says it should be is not believed, microseconds.
const BELIEVED_US: i64 = 500_000;
/// After so many unbelievable stamps in a row the sensor's timer has been set anew.
const STUBBORN: u8 = 3;
/// The scan's delay is learnt over so many scans after an exchange.
const LEARN_SCANS: u16 = 20;

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

/// When the sensor's stamps were, on the host's clock.
#[derive(Clone, Copy, Debug, Default)]
pub struct SensorClock {
    unwrapper: Unwrapper,
    /// Host minus sensor, microseconds, and when it was last touched on the host's clock.
    offset: Option<(i64, u64)>,
    /// Time from stamp to arrival, microseconds.
    delay: Delay,
    unbelievable: u8,
    rejected: u32,
}

#[derive(Clone, Copy, Debug, Default)]
enum Delay {
    /// What the geometry and the line allow at best.
    #[default]
    Least,
    /// Learnt while the offset of an exchange is fresh.
    Learning { least_us: i64, scans: u16 },
    /// Learnt.
    Known(i64),
}

impl SensorClock {
    /// Takes an answer to `TM1`: asked and answered on the host's clock, and the stamp. False, and nothing is changed, where
    /// the round trip is longer than 100 ms or an earlier answer says otherwise by more than half a second.
    pub fn exchange(&mut self, asked_us: u64, answered_us: u64, stamp_ms: u32) -> bool {
        let round_us = answered_us.saturating_sub(asked_us);
        let host_us = asked_us + round_us / 2;
        let sensor_ms = self.unwrapper.unwrap(stamp_ms, host_us);
        // The stamp is cut to milliseconds: half of one is its mean error.
        let offset = host_us as i64 - (sensor_ms * 1000 + 500) as i64;
        let contradicts = self.offset.is_some_and(|(known, _)| (offset - known).abs() > BELIEVED_US);
        if round_us > 100_000 || contradicts {
            self.rejected = self.rejected.wrapping_add(1);
            return false;
        }
        self.offset = Some((offset, host_us));
        self.delay = Delay::Learning { least_us: i64::MAX, scans: 0 };
        true
    }

    /// When a scan's step 0 was, on the host's clock, microseconds.
    ///
    /// `arrived_us` is when its end was read, `least_delay_us` what lies between stamp and arrival at least: the sweep,
    /// and the bytes on the line. The result never lies behind the arrival.
    pub fn scan(&mut self, stamp_ms: u32, arrived_us: u64, least_delay_us: u64) -> u64 {
        let sensor_us = (self.unwrapper.unwrap(stamp_ms, arrived_us) * 1000) as i64;
        let arrived = arrived_us as i64;
        let least_delay = least_delay_us as i64;
        let Some((offset, then_us)) = self.offset else {
            self.offset = Some((arrived - least_delay - sensor_us, arrived_us));
            self.delay = Delay::Least;
            return clamp(arrived - least_delay, arrived);
        };
        let delay_now = arrived - sensor_us - offset;
        let plausible = -BELIEVED_US / 10..BELIEVED_US + least_delay;
        if !plausible.contains(&delay_now) {
            return self.disbelieve(sensor_us, arrived, least_delay);
        }
        self.unbelievable = 0;
        let mut offset = offset;
        match &mut self.delay {
            Delay::Learning { least_us, scans } => {
                *least_us = delay_now.min(*least_us);
                *scans += 1;
                if *scans >= LEARN_SCANS {
                    self.delay = Delay::Known(*least_us);
                }
            }
            Delay::Least | Delay::Known(_) => {
                let delay = if let Delay::Known(known) = self.delay { known } else { least_delay };
                let seen = arrived - delay - sensor_us;
                let allowed = (arrived_us.saturating_sub(then_us) / DRIFT) as i64;
                offset = seen.min(offset + allowed);
            }
        }
        self.offset = Some((offset, arrived_us));
        clamp(sensor_us + offset, arrived)
    }

    /// Stamps and exchanges that were not believed.
    pub fn rejected(&self) -> u32 {
        self.rejected
    }

    /// The stamp cannot be: arrival alone tells when the scan was. If it goes on like this, the timer was set anew.
    fn disbelieve(&mut self, sensor_us: i64, arrived: i64, least_delay: i64) -> u64 {
        self.rejected = self.rejected.wrapping_add(1);
        self.unbelievable += 1;
        let delay = match self.delay {
            Delay::Known(known) => known,
            Delay::Learning { .. } | Delay::Least => least_delay,
        };
        if self.unbelievable >= STUBBORN {
            self.unbelievable = 0;
            self.offset = Some((arrived - delay - sensor_us, arrived as u64));
            if let Delay::Learning { .. } = self.delay {
                self.delay = Delay::Least;
            }
        }
        clamp(arrived - delay, arrived)
    }
}

fn clamp(at: i64, arrived: i64) -> u64 {
    at.min(arrived).max(0) as u64
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A scan's end arrives this long after its stamp.
    const DELAY_US: u64 = 113_500;

    /// A sensor whose clock is `drift_ppm` fast and was at `zero_ms` when the host's was at zero.
    struct Sensor {
        zero_ms: u64,
        drift_ppm: i64,
    }

    impl Sensor {
        fn stamp(&self, host_us: u64) -> u32 {
            let us = host_us as i64 + host_us as i64 / 1_000_000 * self.drift_ppm;
            ((us / 1000) as u64 + self.zero_ms) as u32 & 0xFF_FFFF
        }

        /// Largest error of a scan's stamp over a time, milliseconds, the first second left out.
        fn worst_us(&self, clock: &mut SensorClock, seconds: u64, jitter: impl Fn(u64) -> u64) -> i64 {
            let mut worst = 0;
            for k in 10..seconds * 10 {
                let begin = k * 100_000 + 500;
                let at = clock.scan(self.stamp(begin), begin + DELAY_US + jitter(k), 100_000);
                if k > 50 {
                    worst = worst.max((at as i64 - begin as i64).abs());
                }
            }
            worst
        }
    }

    fn jitter(k: u64) -> u64 {
        k * 7919 % 3000
    }

    #[test]
    fn stamps_go_on_past_the_wrap_and_over_long_gaps() {
        let mut unwrapper = Unwrapper::default();
        assert_eq!(unwrapper.unwrap(0xFF_FFF0, 0), 0xFF_FFF0);
        assert_eq!(unwrapper.unwrap(0x10, 32_000), 0x100_0010);
        // Two stamps out of order.
        assert_eq!(unwrapper.unwrap(0xFF_FFFE, 33_000), 0xFF_FFFE);
        // Ten hours later.
        let later = 0x100_0010 + 36_000_000u64;
        assert_eq!(unwrapper.unwrap((later & 0xFF_FFFF) as u32, 36_000_032_000), later);
    }

    #[test]
    fn an_exchange_gives_the_offset_and_drift_is_followed_for_an_hour() {
        for drift_ppm in [-100, 0, 100] {
            let sensor = Sensor { zero_ms: 16_000_000, drift_ppm };
            let mut clock = SensorClock::default();
            assert!(clock.exchange(500_000, 504_000, sensor.stamp(502_000)));
            let worst = sensor.worst_us(&mut clock, 3600, jitter);
            assert!(worst < 3_000, "{drift_ppm} ppm: {worst} µs");
            assert_eq!(clock.rejected(), 0);
        }
    }

    #[test]
    fn without_an_exchange_the_error_is_what_the_sensor_adds_to_the_least_delay() {
        let sensor = Sensor { zero_ms: 0, drift_ppm: 50 };
        let worst = sensor.worst_us(&mut SensorClock::default(), 600, jitter);
        assert!((13_000..17_000).contains(&worst), "{worst} µs");
    }

    #[test]
    fn a_wild_stamp_is_not_believed_and_a_timer_set_anew_is() {
        let sensor = Sensor { zero_ms: 1000, drift_ppm: 0 };
        let mut clock = SensorClock::default();
        assert!(clock.exchange(500_000, 504_000, sensor.stamp(502_000)));
        assert!(sensor.worst_us(&mut clock, 30, jitter) < 3_000);
        // Off by 402 s, once.
        let begin = 40_000_000;
        let at = clock.scan(sensor.stamp(begin) + 402_000, begin + DELAY_US, 100_000);
        assert!(at.abs_diff(begin) < 3_000, "{at}");
        assert_eq!(clock.rejected(), 1);
        assert!(clock.scan(sensor.stamp(begin + 100_000), begin + 100_000 + DELAY_US, 100_000) > begin);
        assert_eq!(clock.rejected(), 1);
        // Power gone and back.
        let anew = Sensor { zero_ms: 77, drift_ppm: 0 };
        for k in 0..50 {
            let begin = 50_000_000 + k * 100_000;
            let at = clock.scan(anew.stamp(begin), begin + DELAY_US, 100_000);
            assert!(at.abs_diff(begin) < 3_000, "{k}: {at}");
        }
        assert_eq!(clock.rejected(), 1 + u32::from(STUBBORN));
    }

    #[test]
    fn an_exchange_that_took_long_or_contradicts_is_not_used() {
        let mut clock = SensorClock::default();
        assert!(!clock.exchange(0, 100_001, 50));
        assert!(clock.exchange(200_000, 202_000, 201));
        assert!(!clock.exchange(300_000, 302_000, 301 + 402_000));
        assert_eq!(clock.rejected(), 2);
    }
}
