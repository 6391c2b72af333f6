//! For tests: the firmware misbehaves as a word in its memory says, which the emulator writes.

use core::sync::atomic::{AtomicU32, Ordering};

use crate::liveness::Task;

/// In the upper half where the word is an order and not what power-up left.
const MAGIC: u32 = 0x4F52 << 16;

/// The order. It outlasts a reset, and is carried out once where nothing else is said.
#[unsafe(no_mangle)]
#[unsafe(link_section = ".uninit.ORDER")]
static ORDER: AtomicU32 = AtomicU32::new(0);

/// A task waits for ever, by the number of its [`Task`].
const HANG: u32 = 1;
/// The task of the encoders never gives its executor back.
const SPIN_IN_ENCODERS: u32 = 5;
/// Mapping never gives its executor back.
const SPIN_IN_MAPPING: u32 = 6;
/// A log call panics.
const PANIC_IN_LOG: u32 = 7;
/// A log call faults.
const FAULT_IN_LOG: u32 = 8;
/// Panics three seconds after each start with a kept map.
const FAIL_WITH_MAP: u32 = 9;

fn given(order: u32) -> bool {
    ORDER.load(Ordering::Relaxed) == MAGIC | order
}

fn taken(order: u32) -> bool {
    ORDER.compare_exchange(MAGIC | order, 0, Ordering::Relaxed, Ordering::Relaxed).is_ok()
}

/// What a task does when it comes by.
pub async fn obey(task: Task) {
    if taken(HANG + task as u32) {
        core::future::pending::<()>().await;
    }
    let spins = match task {
        Task::Encoders => taken(SPIN_IN_ENCODERS),
        Task::Mapping => taken(SPIN_IN_MAPPING),
        _ => false,
    };
    if spins {
        loop {
            cortex_m::asm::nop();
        }
    }
}

/// What is done once the watchdog has been looked after.
pub fn obey_in_thread_mode() {
    if taken(PANIC_IN_LOG) {
        defmt::info!("{}", Fails { by_fault: false });
    }
    if taken(FAULT_IN_LOG) {
        defmt::info!("{}", Fails { by_fault: true });
    }
}

/// What is done with a kept map.
#[embassy_executor::task]
pub async fn fail_with_map() {
    if given(FAIL_WITH_MAP) {
        embassy_time::Timer::after_secs(3).await;
        panic!("as it is told");
    }
}

struct Fails {
    by_fault: bool,
}

impl defmt::Format for Fails {
    fn format(&self, _: defmt::Formatter<'_>) {
        if self.by_fault {
            cortex_m::asm::udf();
        }
        panic!("as it is told");
    }
}
