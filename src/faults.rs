//! Last words: a panic, a fault or a lost clock is kept across the reset that follows, and logged after it; where the log can still be
//! written, at once too.
//!
//! What failed may be the log itself: a `defmt::Format` that panics leaves it taken, and writing to it again would be another
//! panic. So the words are kept first, and whatever fails after that is the reset.

use core::mem::MaybeUninit;
use core::panic::PanicInfo;
use core::ptr::addr_of_mut;
use core::sync::atomic::{AtomicBool, Ordering};

use cortex_m::peripheral::SCB;
use cortex_m_rt::{ExceptionFrame, exception};

use crate::resets::Count;
use crate::rtt;

const MAGIC: u32 = 0x4C41_5354;
const PANIC: u32 = 1;
const HARD_FAULT: u32 = 2;
const CLOCK_LOST: u32 = 3;
/// Bytes of a file's name that are kept: its end.
const NAME: usize = 24;

#[repr(C)]
#[derive(Clone, Copy)]
struct Words {
    magic: u32,
    kind: u32,
    /// Line of a panic, program counter of a fault.
    place: u32,
    /// File of a panic, filled up with zeros.
    file: [u8; NAME],
    check: u32,
}

impl Words {
    fn new(kind: u32, place: u32, file: &str) -> Self {
        let mut words = Self { magic: MAGIC, kind, place, file: [0; NAME], check: 0 };
        let bytes = file.as_bytes();
        let end = bytes.get(bytes.len().saturating_sub(NAME)..).unwrap_or(bytes);
        words.file.iter_mut().zip(end).for_each(|(to, from)| *to = *from);
        words.check = words.sum();
        words
    }

    fn sum(&self) -> u32 {
        let of_file = self.file.iter().fold(0u32, |sum, byte| sum.rotate_left(5) ^ u32::from(*byte));
        self.magic ^ self.kind.rotate_left(3) ^ self.place.rotate_left(11) ^ of_file
    }

    fn file(&self) -> &str {
        let end = self.file.iter().position(|byte| *byte == 0).unwrap_or(NAME);
        self.file.get(..end).and_then(|bytes| core::str::from_utf8(bytes).ok()).unwrap_or("?")
    }
}

#[unsafe(link_section = ".uninit.LAST_WORDS")]
static mut LAST_WORDS: MaybeUninit<Words> = MaybeUninit::uninit();
/// The firmware is about to end.
static ENDING: AtomicBool = AtomicBool::new(false);

/// Logs what the last run said before it ended, once.
pub fn report() {
    // SAFETY: numbers, of which any bits are valid; nothing else runs yet.
    let words = unsafe { (*addr_of_mut!(LAST_WORDS)).assume_init_mut() };
    if words.magic == MAGIC && words.check == words.sum() {
        match words.kind {
            PANIC => {
                defmt::error!("the last run panicked, at line {=u32} of {=str}", words.place, words.file())
            }
            HARD_FAULT => defmt::error!("the last run faulted, at {=u32:#x}", words.place),
            CLOCK_LOST => defmt::error!("the last run lost the ST-LINK's clock"),
            _ => {}
        }
    }
    words.magic = 0;
}

/// Keeps the words, has them logged if that is possible, and resets the board.
fn end(words: Words, count: Count, log: impl FnOnce()) -> ! {
    cortex_m::interrupt::disable();
    // A failure while the first one is told says nothing new.
    if !ENDING.swap(true, Ordering::SeqCst) {
        // SAFETY: nothing else runs any more.
        unsafe { (*addr_of_mut!(LAST_WORDS)).write(words) };
        count.add();
        log();
        rtt::drain();
    }
    SCB::sys_reset()
}

#[panic_handler]
fn panic(info: &PanicInfo<'_>) -> ! {
    let (file, line) = info.location().map_or(("?", 0), |l| (l.file(), l.line()));
    end(Words::new(PANIC, line, file), Count::Failure, || defmt::error!("panic at {=str}:{=u32}", file, line))
}

#[exception]
unsafe fn HardFault(frame: &ExceptionFrame) -> ! {
    end(Words::new(HARD_FAULT, frame.pc(), ""), Count::Failure, || {
        defmt::error!("hard fault at {=u32:#x}, called from {=u32:#x}", frame.pc(), frame.lr())
    })
}

#[defmt::panic_handler]
fn defmt_panic() -> ! {
    end(Words::new(PANIC, 0, "defmt"), Count::Failure, || ())
}

/// Ends the run because its clock has stopped. Says nothing now: any task may hold the log, and its port runs no more.
pub fn clock_lost() -> ! {
    end(Words::new(CLOCK_LOST, 0, ""), Count::ClockLost, || ())
}
