//! Last words: a panic or a fault is logged, kept across the reset that follows, and logged again after it.

use core::mem::MaybeUninit;
use core::panic::PanicInfo;
use core::ptr::addr_of_mut;

use cortex_m::peripheral::SCB;
use cortex_m_rt::{ExceptionFrame, exception};

const MAGIC: u32 = 0x4C41_5354;
const PANIC: u32 = 1;
const HARD_FAULT: u32 = 2;

#[repr(C)]
#[derive(Clone, Copy)]
struct Words {
    magic: u32,
    kind: u32,
    /// Line of a panic, program counter of a fault.
    place: u32,
}

#[unsafe(link_section = ".uninit.LAST_WORDS")]
static mut LAST_WORDS: MaybeUninit<Words> = MaybeUninit::uninit();

/// Logs what the last run said before it ended, once.
pub fn report() {
    // SAFETY: three numbers, of which any bits are valid; nothing else runs yet.
    let words = unsafe { (*addr_of_mut!(LAST_WORDS)).assume_init_mut() };
    if words.magic == MAGIC {
        match words.kind {
            PANIC => defmt::error!("the last run panicked, at line {=u32}", words.place),
            HARD_FAULT => defmt::error!("the last run faulted, at {=u32:#x}", words.place),
            _ => {}
        }
    }
    words.magic = 0;
}

fn end(kind: u32, place: u32) -> ! {
    // SAFETY: nothing else runs any more.
    unsafe { (*addr_of_mut!(LAST_WORDS)).write(Words { magic: MAGIC, kind, place }) };
    defmt::flush();
    SCB::sys_reset()
}

#[panic_handler]
fn panic(info: &PanicInfo<'_>) -> ! {
    cortex_m::interrupt::disable();
    let (file, line) = info.location().map_or(("?", 0), |l| (l.file(), l.line()));
    defmt::error!("panic at {=str}:{=u32}", file, line);
    end(PANIC, line)
}

#[exception]
unsafe fn HardFault(frame: &ExceptionFrame) -> ! {
    defmt::error!("hard fault at {=u32:#x}, called from {=u32:#x}", frame.pc(), frame.lr());
    end(HARD_FAULT, frame.pc())
}

#[defmt::panic_handler]
fn defmt_panic() -> ! {
    end(PANIC, 0)
}
