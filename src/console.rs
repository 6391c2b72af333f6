//! The virtual COM port: the trajectory, a line of TUM format for each scan, for any terminal or `evo`.

use core::fmt::Write as _;

use embassy_stm32::mode::Async;
use embassy_stm32::usart::UartTx;
use embassy_sync::blocking_mutex::raw::CriticalSectionRawMutex;
use embassy_sync::signal::Signal;
use heapless::String;
use nalgebra::Isometry2;
use slam_core::geometry::math::sin_cos;
use slam_core::geometry::pose::heading;

/// The newest pose. Latest wins.
pub static CONSOLE: Signal<CriticalSectionRawMutex, PoseLine> = Signal::new();

/// A pose at an instant, in whole micrometres and millionths: `core`'s printing of floats is large.
#[derive(Clone, Copy)]
pub struct PoseLine {
    stamp_us: u64,
    x_um: i32,
    y_um: i32,
    /// z and w of the quaternion.
    rotation_millionths: [i32; 2],
}

impl PoseLine {
    /// Of a pose in `map`.
    pub fn new(stamp_us: u64, pose: &Isometry2<f32>) -> Self {
        let (z, w) = sin_cos(0.5 * heading(pose));
        let millionths = |v: f32| (v * 1e6) as i32;
        Self {
            stamp_us,
            x_um: millionths(pose.translation.x),
            y_um: millionths(pose.translation.y),
            rotation_millionths: [millionths(z), millionths(w)],
        }
    }

    /// `stamp x y z qx qy qz qw`, seconds and metres.
    fn text(&self) -> String<112> {
        let mut text = String::new();
        // It has room for the longest numbers.
        let _ = write!(text, "{}.{:06}", self.stamp_us / 1_000_000, self.stamp_us % 1_000_000);
        let [z, w] = self.rotation_millionths;
        for (value, before) in [(self.x_um, " "), (self.y_um, " "), (z, " 0 0 0 "), (w, " ")] {
            let sign = if value < 0 { "-" } else { "" };
            let value = value.unsigned_abs();
            let _ = write!(text, "{before}{sign}{}.{:06}", value / 1_000_000, value % 1_000_000);
        }
        let _ = text.push_str("\r\n");
        text
    }
}

/// Writes poses for ever.
#[embassy_executor::task]
pub async fn run(mut port: UartTx<'static, Async>) {
    loop {
        let line = CONSOLE.wait().await.text();
        if let Err(error) = port.write(line.as_bytes()).await {
            defmt::warn!("console: {}", error);
        }
    }
}
