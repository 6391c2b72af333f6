//! The wheels: counters sampled on a steady beat, unwrapped, stamped, and kept across a reset.

use core::sync::atomic::{AtomicU32, Ordering};

use embassy_sync::blocking_mutex::raw::CriticalSectionRawMutex;
use embassy_sync::channel::Channel;
use embassy_time::{Duration, Instant, Ticker};
use slam_core::WheelTicks;
use slam_core::odometry::ticks_between_u16;

use crate::board::EncoderPins;
use crate::kept::KeptTicks;
use crate::liveness::{self, Task};

/// Samples a second.
pub const HZ: u64 = 200;

/// Samples on their way to the map. A queue; where it is full the newest is dropped and counted, and its ticks come with
/// the next one.
pub static SAMPLES: Channel<CriticalSectionRawMutex, WheelTicks, 64> = Channel::new();
/// Samples dropped.
pub static DROPPED: AtomicU32 = AtomicU32::new(0);

/// Samples the counters for ever.
#[embassy_executor::task]
pub async fn run(pins: EncoderPins, mut kept: KeptTicks) {
    let encoders = pins.start();
    let mut before = encoders.counts();
    let mut totals = kept.read();
    let mut ticker = Ticker::every(Duration::from_hz(HZ));
    loop {
        liveness::here(Task::Encoders).await;
        let now = encoders.counts();
        let stamp_us = Instant::now().as_micros();
        for ((total, before), now) in totals.iter_mut().zip(before).zip(now) {
            *total = total.wrapping_add(ticks_between_u16(before, now));
        }
        before = now;
        kept.write(totals);
        let [left, right] = totals;
        if SAMPLES.try_send(WheelTicks { stamp_us, left, right }).is_err() {
            DROPPED.fetch_add(1, Ordering::Relaxed);
        }
        ticker.next().await;
    }
}
