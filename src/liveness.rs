//! Feeds the watchdog as long as every task that must live says that it does.
//!
//! Each task sets a bit when it comes by. Once all bits are there the watchdog is fed and they are cleared. They lie in RAM that the
//! start-up code leaves alone, so that after a reset by the watchdog the bit that is missing tells which task hung. Where a task never gave
//! its executor back, no other of that executor came by either, and the urgent one stops thread mode as well: then it is said
//! which of the two was stuck.

use core::sync::atomic::{AtomicU32, Ordering};

use embassy_time::{Duration, Instant, Ticker};

use crate::board::{ResetCause, Watchdog};
use crate::resets;

/// Unfed for so long, the watchdog resets the board. Its oscillator of nominally 32 kHz runs at 17 to 47 (DS9405, table 42), so it
/// is 2 to 5.6 s.
pub const UNFED_US: u32 = 3_000_000;
/// The bits are looked at so often. The slowest task comes by every 500 ms.
const LOOK_EVERY: Duration = Duration::from_millis(100);

/// A task that must live.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u32)]
pub enum Task {
    /// Samples the wheels.
    Encoders,
    /// Talks to the scanner.
    Lidar,
    /// Makes the map.
    Mapping,
    /// Sends to a PC.
    Link,
}

impl Task {
    const ALL: [(Self, &str); 4] = [
        (Self::Encoders, "encoders"),
        (Self::Lidar, "lidar"),
        (Self::Mapping, "mapping"),
        (Self::Link, "link"),
    ];

    const fn bit(self) -> u32 {
        1 << self as u32
    }
}

const ALL: u32 = (1 << Task::ALL.len()) - 1;
/// In the upper half where these are bits and not what power-up left.
const MAGIC: u32 = 0x4C49 << 16;

#[unsafe(link_section = ".uninit.SEEN")]
static SEEN: AtomicU32 = AtomicU32::new(0);
/// Since the watchdog was fed last: times that the bits were looked at, in thread mode, and that the encoders' task came by, in the
/// urgent executor. Until it bites, 2 s at least, one that runs makes 20 looks or 400 visits; one that is stuck has made those of
/// half a second at most.
#[unsafe(link_section = ".uninit.LOOKS")]
static LOOKS: AtomicU32 = AtomicU32::new(0);
#[unsafe(link_section = ".uninit.VISITS")]
static VISITS: AtomicU32 = AtomicU32::new(0);
/// Fewer than these say that it was stuck.
const LEAST_LOOKS: u32 = 13;
const LEAST_VISITS: u32 = 250;

/// Says that a task lives. Each calls it wherever it may come by, and awaits it at once.
pub async fn here(task: Task) {
    #[cfg(feature = "misbehaves")]
    crate::orders::obey(task).await;
    SEEN.fetch_or(task.bit(), Ordering::Relaxed);
    if task == Task::Encoders {
        VISITS.fetch_add(1, Ordering::Relaxed);
    }
}

/// Logs which task hung in the last run, if the watchdog ended it, and begins to look anew. To be called before any task runs.
pub fn report(cause: ResetCause) {
    let seen = SEEN.swap(MAGIC, Ordering::Relaxed);
    let (looks, visits) = (LOOKS.swap(0, Ordering::Relaxed), VISITS.swap(0, Ordering::Relaxed));
    if cause != ResetCause::Watchdog || seen & (0xFFFF << 16) != MAGIC {
        return;
    }
    if looks < LEAST_LOOKS {
        match visits {
            ..LEAST_VISITS => defmt::error!("the last run hung: the urgent executor is stuck"),
            _ => defmt::error!("the last run hung: thread mode is stuck"),
        }
        return;
    }
    for (task, name) in Task::ALL {
        if seen & task.bit() == 0 {
            defmt::error!("the last run hung: no word from the task {=str}", name);
        }
    }
}

/// Feeds the watchdog for ever, as long as all live.
#[embassy_executor::task]
pub async fn run(mut watchdog: Watchdog) {
    let mut ticker = Ticker::every(LOOK_EVERY);
    loop {
        LOOKS.fetch_add(1, Ordering::Relaxed);
        if SEEN.load(Ordering::Relaxed) & ALL == ALL {
            SEEN.store(MAGIC, Ordering::Relaxed);
            LOOKS.store(0, Ordering::Relaxed);
            VISITS.store(0, Ordering::Relaxed);
            watchdog.pet();
        }
        if Instant::now().as_secs() >= resets::WELL_S {
            resets::ran_well();
        }
        #[cfg(feature = "misbehaves")]
        crate::orders::obey_in_thread_mode();
        ticker.next().await;
    }
}
