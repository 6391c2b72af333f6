//! What is counted across resets, from one power-up to the next, in RAM that the start-up code leaves alone.

use core::sync::atomic::{AtomicU32, Ordering};

use crate::board::ResetCause;

/// A kept map that the firmware fails early with so often, running, is given up.
pub const GIVE_UP_AFTER: u32 = 3;
/// The firmware has started well when it has run for so long, seconds.
pub const WELL_S: u64 = 10;

/// What is counted.
#[derive(Clone, Copy)]
pub enum Count {
    /// Resets by the watchdog.
    Watchdog,
    /// Panics and faults.
    Failure,
    /// Times that the ST-LINK's clock stopped.
    ClockLost,
    /// Starts, running, that failed before the firmware had started well.
    Early,
    /// One until the firmware has started well.
    Unproven,
}

const COUNTS: usize = 5;

// Power-up leaves noise here, which the check does not fit.
#[unsafe(link_section = ".uninit.RESETS")]
static VALUES: [AtomicU32; COUNTS] = [const { AtomicU32::new(0) }; COUNTS];
#[unsafe(link_section = ".uninit.RESETS_CHECK")]
static CHECK: AtomicU32 = AtomicU32::new(0);

impl Count {
    /// How often so far.
    pub fn read(self) -> u32 {
        VALUES.get(self as usize).map_or(0, |value| value.load(Ordering::Relaxed))
    }

    /// Once more.
    pub fn add(self) {
        self.set(self.read().saturating_add(1));
    }

    /// Sets it. A reset between the two stores has all counts begin anew.
    pub fn set(self, value: u32) {
        if let Some(place) = VALUES.get(self as usize) {
            place.store(value, Ordering::SeqCst);
            CHECK.store(check(), Ordering::SeqCst);
        }
    }
}

fn check() -> u32 {
    let mix = |sum: u32, value: &AtomicU32| sum.rotate_left(7) ^ value.load(Ordering::Relaxed);
    VALUES.iter().fold(0x5245_5345, mix)
}

/// Takes up the counts, all zero after a power-up. To be called once, before anything else here.
pub fn begin(cause: ResetCause) {
    if cause == ResetCause::Power || CHECK.load(Ordering::SeqCst) != check() {
        VALUES.iter().for_each(|value| value.store(0, Ordering::SeqCst));
        CHECK.store(check(), Ordering::SeqCst);
    }
    if cause == ResetCause::Watchdog {
        Count::Watchdog.add();
    }
    // A person who presses the reset button twice is no failure.
    let failed = matches!(cause, ResetCause::Watchdog | ResetCause::Software);
    Count::Early.set(if failed && Count::Unproven.read() != 0 { Count::Early.read() + 1 } else { 0 });
    Count::Unproven.set(1);
}

/// The firmware has started well.
pub fn ran_well() {
    if Count::Unproven.read() != 0 {
        Count::Unproven.set(0);
    }
}
