//! Which bit rate to work at: the one asked for, and for good a lower one where that one fails.
//!
//! A level shifter or a cable that is not good for a bit rate does not get better by being tried again, and each trial costs
//! seconds of scans. So the choice only falls. What a plug that was pulled looks like, silence, says nothing against a rate.

/// Bit rates of the sensors, lowest first, bit/s.
pub const RATES: [u32; 6] = [19_200, 57_600, 115_200, 250_000, 500_000, 750_000];

/// No choice falls below this, bit/s: a full scan then takes two revolutions.
const LEAST: u32 = 115_200;
/// So many failures without [`STEADY`] good scans between them are the bit rate's.
const FAILURES: u8 = 2;
/// After so many good scans what failed before is forgotten: noise now and then is no rate's.
const STEADY: u16 = 30;
/// Scans are judged in groups of so many, good and dropped together.
const GROUP: u32 = 40;

/// The choice. See the [module's documentation](self).
#[derive(Clone, Copy, Debug)]
pub struct RateChoice {
    rate: u32,
    failures: u8,
    /// Good scans since the last failure.
    good_since: u16,
    good: u32,
    dropped: u32,
}

impl RateChoice {
    /// At first the rate that is asked for, bit/s.
    pub const fn new(asked: u32) -> Self {
        Self { rate: asked, failures: 0, good_since: 0, good: 0, dropped: 0 }
    }

    /// The rate to work at, bit/s.
    pub const fn rate(&self) -> u32 {
        self.rate
    }

    /// Commands were not understood, or bytes made no scan, while working at this rate. True where it falls.
    pub fn failed(&mut self) -> bool {
        self.failures += 1;
        (self.good, self.dropped, self.good_since) = (0, 0, 0);
        self.failures >= FAILURES && self.fall(LEAST)
    }

    /// A scan came, after so many that were dropped. `carrying` is the least rate that carries every scan, bit/s: for the sake of
    /// scans none below is chosen. True where the rate falls, because more than half of a group of scans was dropped.
    pub fn took(&mut self, dropped: u32, carrying: u32) -> bool {
        self.good += 1;
        self.dropped = self.dropped.saturating_add(dropped);
        self.good_since = self.good_since.saturating_add(1);
        if self.good_since >= STEADY {
            self.failures = 0;
        }
        if self.good.saturating_add(self.dropped) < GROUP {
            return false;
        }
        let bad = self.dropped > self.good;
        (self.good, self.dropped) = (0, 0);
        bad && self.fall(carrying.max(LEAST))
    }

    /// To the next lower rate that is not below `least`.
    fn fall(&mut self, least: u32) -> bool {
        let Some(&lower) = RATES.iter().rev().find(|&&rate| rate < self.rate && rate >= least) else {
            return false;
        };
        *self = Self::new(lower);
        true
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// What a full scan needs.
    const CARRYING: u32 = 213_700;

    #[test]
    fn two_failures_step_down_and_it_stays_there() {
        let mut choice = RateChoice::new(750_000);
        let mut rates = std::vec::Vec::new();
        for _ in 0..10 {
            choice.failed();
            rates.push(choice.rate());
        }
        assert_eq!(rates[..6], [750_000, 500_000, 500_000, 250_000, 250_000, 115_200]);
        assert!(rates[6..].iter().all(|r| *r == 115_200));
        (0..10_000).for_each(|_| assert!(!choice.took(0, CARRYING)));
        assert_eq!(choice.rate(), 115_200);
    }

    #[test]
    fn failures_far_apart_are_no_rate_s() {
        let mut choice = RateChoice::new(500_000);
        for _ in 0..10 {
            assert!(!choice.failed());
            (0..STEADY).for_each(|_| assert!(!choice.took(0, CARRYING)));
        }
        assert!(!choice.failed() && choice.failed());
    }

    #[test]
    fn scans_step_down_where_more_than_half_are_dropped_but_never_to_where_scans_do_not_fit() {
        let mut choice = RateChoice::new(500_000);
        (0..1000).for_each(|_| assert!(!choice.took(1, CARRYING), "half is no reason"));
        let steps: u32 = (0..1000).map(|_| u32::from(choice.took(2, CARRYING))).sum();
        assert_eq!((steps, choice.rate()), (1, 250_000));
    }

    #[test]
    fn a_rate_that_is_asked_for_is_kept_where_there_is_none_below() {
        let mut choice = RateChoice::new(19_200);
        (0..10).for_each(|_| assert!(!choice.failed()));
        assert_eq!(choice.rate(), 19_200);
    }
}
