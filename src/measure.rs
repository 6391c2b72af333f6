//! What the firmware measures of itself with the core's cycle counter, which stands while the core sleeps.

use core::sync::atomic::{AtomicU32, Ordering};

use cortex_m::peripheral::DWT;
use heapless::Vec;

/// Scans of which the cycles are kept: more than come in a second.
const SCANS: usize = 16;

/// Cycles of the core so far, which wrap after 24 s.
pub fn cycles() -> u32 {
    DWT::cycle_count()
}

/// Cycles of the scans since they were asked for last. The newest is dropped where there are too many.
#[derive(Default)]
pub struct ScanCycles {
    cycles: Vec<u32, SCANS>,
}

impl ScanCycles {
    /// Of one more.
    pub fn add(&mut self, cycles: u32) {
        let _ = self.cycles.push(cycles);
    }

    /// Median and maximum, zero without any; begins anew.
    pub fn take(&mut self) -> [u32; 2] {
        // By counting what is less: the standard library's sort takes 2 kB of flash.
        let rank = |own: u32| self.cycles.iter().filter(|other| **other < own).count();
        let lower_half = self.cycles.iter().copied().filter(|own| rank(*own) <= self.cycles.len() / 2);
        let median = lower_half.max().unwrap_or(0);
        let most = self.cycles.iter().copied().max().unwrap_or(0);
        self.cycles.clear();
        [median, most]
    }
}

static URGENT: AtomicU32 = AtomicU32::new(0);

/// Does the urgent executor's work and counts its cycles, those of interrupts above it included.
pub fn urgent(work: impl FnOnce()) {
    let begin = cycles();
    work();
    URGENT.fetch_add(cycles().wrapping_sub(begin), Ordering::Relaxed);
}

/// Cycles of the urgent executor since they were asked for last.
pub fn take_urgent() -> u32 {
    URGENT.swap(0, Ordering::Relaxed)
}
