//! The supply: watched by the programmable voltage detector (PVD), which is above the level where brown-out resets.

use core::sync::atomic::{AtomicU32, Ordering};

use embassy_stm32::interrupt;
use embassy_stm32::interrupt::InterruptExt;
use embassy_stm32::pac;

/// Level 6: the supply has fallen below 2.93 V, and is well again above 3.03 V (DS9405, table 22). At 180 MHz the flash needs 2.7 V.
const LEVEL: u8 = 6;
/// The detector's line among the external interrupts.
const LINE: usize = 16;

static DIPS: AtomicU32 = AtomicU32::new(0);

/// Begins to watch.
pub fn watch() {
    pac::PWR.cr1().modify(|w| {
        w.set_pls(LEVEL);
        w.set_pvde(true);
    });
    pac::EXTI.rtsr(0).modify(|w| w.set_line(LINE, true));
    pac::EXTI.imr(0).modify(|w| w.set_line(LINE, true));
    // SAFETY: its handler counts and nothing else, at any time.
    unsafe { interrupt::PVD.enable() };
}

/// Whether the supply is too low now: power may go any moment.
pub fn is_low() -> bool {
    pac::PWR.csr1().read().pvdo()
}

/// Times that it fell since the board started.
pub fn dips() -> u32 {
    DIPS.load(Ordering::Relaxed)
}

#[interrupt]
fn PVD() {
    pac::EXTI.pr(0).write(|w| w.set_line(LINE, true));
    DIPS.fetch_add(1, Ordering::Relaxed);
}
