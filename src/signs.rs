//! LED and button: a short flash while scans come, a slow blink while they do not; the button prints the map.

use core::sync::atomic::Ordering;

use embassy_stm32::gpio::{Input, Output};
use embassy_time::Timer;

use crate::lidar::STATE;
use crate::mapping::PRINT_MAP;

/// The button is looked at so often; it is quiet by then.
const LOOK_MS: u64 = 20;

/// Blinks and looks for ever.
#[embassy_executor::task]
pub async fn run(mut led: Output<'static>, button: Input<'static>) {
    let mut was_pressed = false;
    for step in (0u32..).cycle() {
        let (period, on) = if STATE.present.load(Ordering::Relaxed) { (50, 3) } else { (100, 50) };
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
