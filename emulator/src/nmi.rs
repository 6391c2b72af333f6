//! A core with a line for the non-maskable interrupt, which rigless' part leaves out: its models reach interrupts only.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use rigless::emulator::{
    BitAlias, CoreBus, CoreSpec, DataModel, Error, Exit, HaltReason, HostCall, Processor, Queued,
};
use rigless::soc::{Endian, Width};
use rigless::time::VirtualNanos;

use crate::paced::pass_on;

/// `ICSR`, and its bit that pends the interrupt.
const ICSR: (u64, u64) = (0xE000_ED04, 1 << 31);

/// Gives a core the line. It is raised by a store to the flag, which the core takes back, and seen before the core's next
/// instruction.
pub fn wire(mut core: CoreSpec, line: Arc<AtomicBool>) -> CoreSpec {
    let make = core.processor;
    core.processor = Arc::new(move |endian| Ok(Box::new(Wired { inner: make(endian)?, line: line.clone() })));
    core
}

#[derive(Debug)]
struct Wired {
    inner: Box<dyn Processor>,
    line: Arc<AtomicBool>,
}

impl Processor for Wired {
    fn run(&mut self, budget: u32, bus: &mut dyn CoreBus) -> (Exit, u64) {
        if self.line.swap(false, Ordering::Relaxed) {
            let now = bus.time(self.inner.retired());
            self.inner.debugger_access(Some(ICSR.1), ICSR.0, Width::W32, now);
        }
        self.inner.run(budget, bus)
    }

    fn retired(&self) -> u64 {
        self.inner.retired()
    }

    fn load(&mut self, bytes: &[u8]) -> Result<(), Error> {
        self.inner.load(bytes)
    }

    unsafe fn map(&mut self, start: u64, length: u64, host: *mut u8, writable: bool) {
        // SAFETY: what the caller promises is what is asked for.
        unsafe { self.inner.map(start, length, host, writable) }
    }

    pass_on!();
}
