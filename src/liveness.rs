//! Feeds the watchdog as long as every task that must live says that it does.
//!
//! Each task sets a bit when it comes by. Once all bits are there the watchdog is fed and they are cleared. They lie in RAM that the
//! start-up code leaves alone, so that after a reset by the watchdog the bit that is missing tells which task hung.

use core::sync::atomic::{AtomicU32, Ordering};

use embassy_time::{Duration, Instant, Ticker};

use crate::board::{ResetCause, Watchdog};
use crate::console::CONSOLE;
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
    /// Sends the trajectory. Known by what it takes: it lives if no pose waits for it.
    Console,
}

impl Task {
    const ALL: [(Self, &str); 4] = [
        (Self::Encoders, "encoders"),
        (Self::Lidar, "lidar"),
        (Self::Mapping, "mapping"),
        (Self::Console, "console"),
    ];

    const fn bit(self) -> u32 {
        1 << self as u32
    }
}

const ALL: u32 = (1 << Task::ALL.len()) - 1;
/// The task that feeds the watchdog has looked.
const LOOKED: u32 = 1 << 8;
/// In the upper half where these are bits and not what power-up left.
const MAGIC: u32 = 0x4C49 << 16;

#[unsafe(link_section = ".uninit.SEEN")]
static SEEN: AtomicU32 = AtomicU32::new(0);

/// Says that a task lives. Each calls it wherever it may come by, and awaits it at once.
pub async fn here(task: Task) {
    #[cfg(feature = "misbehaves")]
    crate::orders::obey(task).await;
    SEEN.fetch_or(task.bit(), Ordering::Relaxed);
}

/// Logs which task hung in the last run, if the watchdog ended it, and begins to look anew. To be called before any task runs.
pub fn report(cause: ResetCause) {
    let seen = SEEN.swap(MAGIC, Ordering::Relaxed);
    if cause != ResetCause::Watchdog || seen & (0xFFFF << 16) != MAGIC {
        return;
    }
    let urgent = Task::Encoders.bit() | Task::Lidar.bit();
    let fed = seen & LOOKED != 0;
    match (fed, seen & urgent) {
        (false, 0) => defmt::error!("the last run hung: no task came by; the urgent executor is stuck"),
        (false, _) => defmt::error!("the last run hung: thread mode is stuck"),
        (true, _) if seen & ALL == ALL => defmt::error!("the last run hung: the watchdog was not fed"),
        (true, _) => {}
    }
    // Where nobody looked, nobody asked after the console.
    let asked = if fed { ALL } else { ALL & !Task::Console.bit() };
    for (task, name) in Task::ALL {
        if task.bit() & asked & !seen != 0 {
            defmt::error!("the last run hung: no word from the task {=str}", name);
        }
    }
}

/// Feeds the watchdog for ever, as long as all live.
#[embassy_executor::task]
pub async fn run(mut watchdog: Watchdog) {
    let mut ticker = Ticker::every(LOOK_EVERY);
    loop {
        if !CONSOLE.signaled() {
            SEEN.fetch_or(Task::Console.bit(), Ordering::Relaxed);
        }
        if SEEN.fetch_or(LOOKED, Ordering::Relaxed) & ALL == ALL {
            SEEN.store(MAGIC, Ordering::Relaxed);
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
