//! The log's way out: RTT, a ring in RAM that a probe empties.
//!
//! defmt-rtt is built so that it never waits (`disable-blocking-mode`: a probe that asks for waiting and is then pulled would stop
//! the robot) and drops whole frames (`drop-on-contention`: where the ring is full, or where another task is just writing). It
//! does not say how many, so they are counted here: a frame that is not lost moves the ring's write offset.

use core::sync::atomic::{AtomicU32, Ordering};

use cortex_m::peripheral::DWT;
use defmt_rtt as _;
use embassy_time::Instant;

use crate::board::CORE_HZ;

/// The control block that defmt-rtt makes: that of SEGGER's RTT, with one channel up.
#[repr(C)]
struct ControlBlock {
    id: [u8; 16],
    channels: [u32; 2],
    name: u32,
    buffer: u32,
    size: u32,
    write: AtomicU32,
    read: AtomicU32,
    flags: AtomicU32,
}

unsafe extern "C" {
    #[link_name = "_SEGGER_RTT"]
    static RTT: ControlBlock;
}

fn offsets() -> [u32; 2] {
    // SAFETY: it is there, of this layout, and these two are only ever accessed as atomics.
    unsafe { [RTT.write.load(Ordering::Acquire), RTT.read.load(Ordering::Relaxed)] }
}

/// Where the ring was written to when the last frame began.
static LAST: AtomicU32 = AtomicU32::new(u32::MAX);
static LOST: AtomicU32 = AtomicU32::new(0);

/// Frames lost since the board started, but for the last one.
pub fn lost() -> u32 {
    LOST.load(Ordering::Relaxed)
}

// Asked for once in each frame, at its beginning: whatever came before has been written by now, or it is lost. Between two of
// these one frame at the most is written, since a frame begun while another is written is dropped.
defmt::timestamp!("{=u64:us}", stamp_us());

fn stamp_us() -> u64 {
    let [write, _] = offsets();
    if LAST.swap(write, Ordering::Relaxed) == write {
        LOST.fetch_add(1, Ordering::Relaxed);
    }
    Instant::now().as_micros()
}

/// Gives a probe time to read what is there: 20 ms at the most.
pub fn drain() {
    let begin = DWT::cycle_count();
    while DWT::cycle_count().wrapping_sub(begin) < CORE_HZ / 50 {
        let [write, read] = offsets();
        if write == read {
            return;
        }
    }
}
