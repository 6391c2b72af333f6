//! LED and button: a short flash a second while scans come and the pose is to be relied on, two a second while it is uncertain,
//! fast blinking while the robot is lost, a slow blink while no scans come; the button prints the map.

use core::sync::atomic::Ordering;

use embassy_stm32::gpio::{Input, Output};
use embassy_time::Timer;

use slam_core::tracking::TrackingState;

use crate::lidar::STATE;
use crate::mapping::{PRINT_MAP, TRACKING};

/// The button is looked at so often; it is quiet by then.
const LOOK_MS: u64 = 20;

/// Blinks and looks for ever.
#[embassy_executor::task]
pub async fn run(mut led: Output<'static>, button: Input<'static>) {
    let mut was_pressed = false;
    for step in (0u32..).cycle() {
        let state = TRACKING.load(Ordering::Relaxed);
        let (period, on) = match STATE.present.load(Ordering::Relaxed) {
            false => (100, 50),
            true if state == TrackingState::Lost as u8 => (10, 5),
            true if state == TrackingState::Uncertain as u8 => (25, 3),
            true => (50, 3),
        };
        if step % period < on {
            led.set_high();
        } else {
            led.set_low();
        }
        let pressed = button.is_high();
        if pressed && !was_pressed {
            PRINT_MAP.store(true, Ordering::Relaxed);
        }
        was_pressed = pressed;
        Timer::after_millis(LOOK_MS).await;
    }
}
