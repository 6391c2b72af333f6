//! 180 MHz from the 8 MHz that the ST-LINK gives, or, where that is silent, from the part's own oscillator.
//!
//! The ST-LINK has no power where the robot feeds the board at VIN or E5V alone, and its clock may stop when its USB
//! plug is pulled. So the clock is waited for, but not for ever, and the clock security system watches it from then on.
//! A clock that stopped once is not taken again before the next power-up.

use cortex_m::peripheral::DWT;
use cortex_m_rt::exception;
use embassy_stm32::{Config, pac, rcc, time};

use crate::faults;

/// What the ST-LINK gives.
const EXTERNAL: time::Hertz = time::Hertz(8_000_000);
/// It is waited for so long: 100 ms, in cycles of the part's own oscillator, from which everything starts.
const WAIT_CYCLES: u32 = rcc::HSI_FREQ.0 / 10;
/// Of the core, whatever it is made from.
pub const CORE_HZ: u32 = 180_000_000;

/// What the 180 MHz are made from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ClockSource {
    /// The ST-LINK's 8 MHz (HSE, bypassed), made by a crystal.
    External,
    /// The part's own RC oscillator (HSI): off by 1 % at 25 °C and by up to 4 % from -10 to 85 °C (DS9405, table 41).
    Internal,
}

impl ClockSource {
    /// For the boot banner.
    pub fn name(self) -> &'static str {
        match self {
            Self::External => "the ST-LINK's 8 MHz",
            Self::Internal => "the part's own oscillator",
        }
    }

    /// Finds out what there is. `trusted` says whether the ST-LINK's clock has not yet stopped since power-up. To be called
    /// after a reset, before the clocks are set.
    pub fn choose(trusted: bool) -> Self {
        if trusted && external_comes() { Self::External } else { Self::Internal }
    }

    /// The configuration that makes 180 MHz of it. Both give the PLL 2 MHz.
    pub fn config(self) -> Config {
        use rcc::{
            AHBPrescaler, APBPrescaler, Hse, HseMode, Pll, PllMul, PllPDiv, PllPreDiv, PllSource, Sysclk,
        };
        let mut config = Config::default();
        let (hse, pll_src, prediv) = match self {
            Self::External => {
                (Some(Hse { freq: EXTERNAL, mode: HseMode::Bypass }), PllSource::HSE, PllPreDiv::DIV4)
            }
            Self::Internal => (None, PllSource::HSI, PllPreDiv::DIV8),
        };
        config.rcc.hse = hse;
        config.rcc.pll_src = pll_src;
        config.rcc.pll =
            Some(Pll { prediv, mul: PllMul::MUL180, divp: Some(PllPDiv::DIV2), divq: None, divr: None });
        config.rcc.sys = Sysclk::PLL1_P;
        config.rcc.ahb_pre = AHBPrescaler::DIV1;
        config.rcc.apb1_pre = APBPrescaler::DIV4;
        config.rcc.apb2_pre = APBPrescaler::DIV2;
        config
    }

    /// Has the clock security system watch it: a clock that stops is the non-maskable interrupt.
    pub fn guard(self) {
        if self == Self::External {
            pac::RCC.cr().modify(|w| w.set_csson(true));
        }
    }
}

/// Turns the ST-LINK's clock on and waits for it; off again if it does not come. The HAL would wait for ever.
fn external_comes() -> bool {
    // Bypass can be chosen only while it is off.
    pac::RCC.cr().modify(|w| w.set_hsebyp(true));
    pac::RCC.cr().modify(|w| w.set_hseon(true));
    let begin = DWT::cycle_count();
    while !pac::RCC.cr().read().hserdy() {
        if DWT::cycle_count().wrapping_sub(begin) > WAIT_CYCLES {
            pac::RCC.cr().modify(|w| w.set_hseon(false));
            pac::RCC.cr().modify(|w| w.set_hsebyp(false));
            return false;
        }
    }
    true
}

/// The ST-LINK's clock has stopped in mid-drive, and the hardware has gone over to 16 MHz. Every divider is wrong now: the
/// board starts anew, on its own oscillator, with the map that it has.
#[exception]
unsafe fn NonMaskableInt() {
    if pac::RCC.cir().read().cssf() {
        faults::clock_lost();
    }
}
