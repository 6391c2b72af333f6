//! How much stack has been used: it is painted before `main`, and what is no longer painted was used.
//!
//! Thread mode and interrupts share one stack. How deep thread mode is in it is looked up at each interrupt of the urgent
//! executor; what that executor takes beneath is measured by painting what lies there anew now and then.

use core::ptr::addr_of;
use core::sync::atomic::{AtomicU32, Ordering};

use cortex_m::register::msp;
use cortex_m_rt::STACK_PAINT_VALUE as PAINT;

unsafe extern "C" {
    static _stack_start: u32;
    static _stack_end: u32;
}

/// One in so many calls is measured.
const EVERY: u32 = 64;
/// Painted beneath it, bytes: more than it takes.
const DEPTH: usize = 6 * 1024;

static CALLS: AtomicU32 = AtomicU32::new(0);
static MOST_IN_THREAD: AtomicU32 = AtomicU32::new(0);
static MOST_IN_INTERRUPTS: AtomicU32 = AtomicU32::new(0);

/// Most bytes of stack used so far, interrupts included.
pub fn most() -> u32 {
    let (lowest, top) = (addr_of!(_stack_end) as usize, addr_of!(_stack_start) as usize);
    (top - first_used(lowest, top)) as u32
}

/// Most bytes that thread mode was seen to take, where the urgent executor interrupted it.
pub fn most_in_thread() -> u32 {
    MOST_IN_THREAD.load(Ordering::Relaxed)
}

/// Most bytes that the urgent executor was seen to take.
pub fn most_in_interrupts() -> u32 {
    MOST_IN_INTERRUPTS.load(Ordering::Relaxed)
}

/// Does the urgent executor's work, and looks now and then how much stack it takes.
pub fn watched(work: impl FnOnce()) {
    let here = msp::read() as usize & !3;
    MOST_IN_THREAD.fetch_max((addr_of!(_stack_start) as usize - here) as u32, Ordering::Relaxed);
    if !CALLS.fetch_add(1, Ordering::Relaxed).is_multiple_of(EVERY) {
        return work();
    }
    let lowest = here.saturating_sub(DEPTH).max(addr_of!(_stack_end) as usize);
    for address in (lowest..here).step_by(4) {
        // SAFETY: a word of the stack's memory beneath the stack pointer, which nothing holds.
        unsafe { (address as *mut u32).write_volatile(PAINT) };
    }
    work();
    MOST_IN_INTERRUPTS.fetch_max((here - first_used(lowest, here)) as u32, Ordering::Relaxed);
}

/// The first address from the lowest on that is not painted.
fn first_used(lowest: usize, end: usize) -> usize {
    // SAFETY: words of the stack's memory; no one changes what lies deepest while it is read but by using it.
    let painted = |address: &usize| unsafe { (*address as *const u32).read_volatile() } == PAINT;
    (lowest..end).step_by(4).find(|address| !painted(address)).unwrap_or(end)
}
