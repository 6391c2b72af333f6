//! The encoders: timers that count every edge of both lines, behind pull-ups and filters as the robot file asks.

use embassy_stm32::gpio::Pull;
use embassy_stm32::pac::timer::TimGp16;
use embassy_stm32::pac::timer::vals::{Ckd, FilterValue};
use embassy_stm32::timer::qei::{self, Qei};
use embassy_stm32::{Peri, pac, peripherals};

use crate::robot;

/// Pins and timers of the encoders.
pub struct EncoderPins {
    pub(super) left: Peri<'static, peripherals::TIM4>,
    pub(super) left_a: Peri<'static, peripherals::PD12>,
    pub(super) left_b: Peri<'static, peripherals::PD13>,
    pub(super) right: Peri<'static, peripherals::TIM3>,
    pub(super) right_a: Peri<'static, peripherals::PC6>,
    pub(super) right_b: Peri<'static, peripherals::PC7>,
}

/// Both encoders, counted by timers.
pub struct Encoders {
    left: Qei<'static, peripherals::TIM4>,
    right: Qei<'static, peripherals::TIM3>,
}

/// What the timers run at, on APB1.
const TIMER_HZ: u64 = 90_000_000;

/// The timers' input filters: a level counts once it has been sampled so often in a row, so many cycles apart; the second number of
/// `Some` is multiplied by the divider of the sampling clock. RM0090, 18.4.7.
const FILTERS: [(FilterValue, u64, bool); 15] = [
    (FilterValue::FCK_INT_N2, 2, false),
    (FilterValue::FCK_INT_N4, 4, false),
    (FilterValue::FCK_INT_N8, 8, false),
    (FilterValue::FDTS_DIV2_N6, 2 * 6, true),
    (FilterValue::FDTS_DIV2_N8, 2 * 8, true),
    (FilterValue::FDTS_DIV4_N6, 4 * 6, true),
    (FilterValue::FDTS_DIV4_N8, 4 * 8, true),
    (FilterValue::FDTS_DIV8_N6, 8 * 6, true),
    (FilterValue::FDTS_DIV8_N8, 8 * 8, true),
    (FilterValue::FDTS_DIV16_N5, 16 * 5, true),
    (FilterValue::FDTS_DIV16_N6, 16 * 6, true),
    (FilterValue::FDTS_DIV16_N8, 16 * 8, true),
    (FilterValue::FDTS_DIV32_N5, 32 * 5, true),
    (FilterValue::FDTS_DIV32_N6, 32 * 6, true),
    (FilterValue::FDTS_DIV32_N8, 32 * 8, true),
];

impl EncoderPins {
    /// Starts counting, from zero.
    pub fn start(self) -> Encoders {
        let pull = match robot::ENCODER_PULL {
            1 => Pull::Up,
            -1 => Pull::Down,
            _ => Pull::None,
        };
        let config = || {
            let mut config = qei::Config::default();
            (config.ch1_pull, config.ch2_pull) = (pull, pull);
            config
        };
        let encoders = Encoders {
            left: Qei::new(self.left, self.left_a, self.left_b, config()),
            right: Qei::new(self.right, self.right_a, self.right_b, config()),
        };
        filter(pac::TIM4);
        filter(pac::TIM3);
        encoders
    }
}

impl Encoders {
    /// Counters of the left and right wheel, which wrap.
    pub fn counts(&self) -> [u16; 2] {
        [self.left.count(), self.right.count()]
    }
}

/// Filters the timer's inputs by the shortest filter that is as long as the robot file asks, or the longest there is.
fn filter(timer: TimGp16) {
    let wanted = u64::from(robot::ENCODER_FILTER_NS) * TIMER_HZ / 1_000_000_000;
    if wanted == 0 {
        return;
    }
    let dividers = [(Ckd::DIV1, 1), (Ckd::DIV2, 2), (Ckd::DIV4, 4)];
    let mut best = (Ckd::DIV4, FilterValue::FDTS_DIV32_N8, u64::MAX);
    for (divider, by) in dividers {
        for (filter, cycles, divided) in FILTERS {
            let cycles = if divided { cycles * by } else { cycles };
            if (wanted..best.2).contains(&cycles) {
                best = (divider, filter, cycles);
            }
        }
    }
    timer.cr1().modify(|w| w.set_ckd(best.0));
    timer.ccmr_input(0).modify(|w| {
        w.set_icf(0, best.1);
        w.set_icf(1, best.1);
    });
}
