//! LED and button: a short flash a second while scans come and the pose is to be relied on, two a second while it is uncertain,
//! fast blinking while the robot is lost, a slow blink while no scans come. A short press of the button prints the map; held for
//! three seconds it has the map forgotten. The LED is lit while the button is down, and flickers once the map is forgotten.

use core::sync::atomic::Ordering;

use embassy_stm32::gpio::{Input, Output};
use embassy_time::Timer;

use slam_core::tracking::TrackingState;

use crate::lidar::STATE;
use crate::mapping::{FORGET_MAP, PRINT_MAP, TRACKING};

/// The button is looked at so often; it is quiet by then.
const LOOK_MS: u64 = 20;

/// Held for so many looks, 3 s, the button has the map forgotten.
const FORGET_AFTER: u32 = 150;

/// Blinks and looks for ever.
#[embassy_executor::task]
pub async fn run(mut led: Output<'static>, button: Input<'static>) {
    // Looks for which the button has been down.
    let mut held = 0u32;
    for step in (0u32..).cycle() {
        if button.is_high() {
            held = held.saturating_add(1);
            if held == FORGET_AFTER {
                FORGET_MAP.store(true, Ordering::Relaxed);
            }
        } else {
            if (1..FORGET_AFTER).contains(&held) {
                PRINT_MAP.store(true, Ordering::Relaxed);
            }
            held = 0;
        }
        led.set_level(lit(step, held).into());
        Timer::after_millis(LOOK_MS).await;
    }
}

fn lit(step: u32, held: u32) -> bool {
    let state = TRACKING.load(Ordering::Relaxed);
    let (period, on) = match STATE.present.load(Ordering::Relaxed) {
        _ if held >= FORGET_AFTER => (4, 2),
        _ if held > 0 => (1, 1),
        false => (100, 50),
        true if state == TrackingState::Lost as u8 => (10, 5),
        true if state == TrackingState::Uncertain as u8 => (25, 3),
        true => (50, 3),
    };
    step % period < on
}
