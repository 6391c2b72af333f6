//! A core that takes as many cycles as the model says: one instruction at a time, each followed by the cycles it still owes.

use std::sync::Arc;

use delegate::delegate;
use rigless::emulator::{
    Access, BitAlias, Checked, CoreBus, CoreSpec, DataModel, Error, Exit, HaltReason, HostCall,
    InterruptLine, Processor, Queued,
};
use rigless::soc::{Endian, Width};
use rigless::time::VirtualNanos;

use crate::cycles::{Model, Program, Tally};

/// What a wrapper of a core passes on to its `inner` one as it is.
macro_rules! pass_on {
    () => {
        delegate::delegate! {
            to self.inner {
                fn ask(&mut self, queued: Queued);
                fn maps(&self, start: u64, length: u64) -> bool;
                fn page_size(&self) -> u64;
                fn boot(&mut self, table: u64, read: &dyn Fn(u64, Width) -> Option<u64>);
                fn reset(&mut self);
                fn take_reset_request(&mut self) -> bool;
                fn next_event(&self) -> Option<VirtualNanos>;
                fn on_event(&mut self, now: VirtualNanos);
                fn waiting(&self) -> bool;
                fn pc(&self) -> u64;
                fn add_breakpoint(&mut self, address: u64) -> bool;
                fn remove_breakpoint(&mut self, address: u64);
                fn pass_breakpoint(&mut self, address: u64);
                fn attach_debugger(&mut self, attached: bool);
                fn hold_interrupts(&mut self, held: bool);
                fn gdb_register(&self, number: usize) -> Option<Vec<u8>>;
                fn set_gdb_register(&mut self, number: usize, bytes: &[u8]) -> bool;
                fn debugger_access(
                    &mut self,
                    write: Option<u64>,
                    address: u64,
                    width: Width,
                    now: VirtualNanos,
                ) -> Option<u64>;
                fn take_debugger_trace(&mut self) -> Vec<u8>;
                fn target_xml(&self) -> &'static str;
                fn data_model(&self) -> DataModel;
                fn byte_order(&self, address: u64) -> Endian;
                fn save(&self) -> Vec<u8>;
                fn monitor_command(&mut self, command: &str) -> Option<String>;
                fn debugger_halted(&mut self, why: HaltReason) -> bool;
                fn bit_alias(&self, address: u64, width: Width) -> Option<BitAlias>;
                fn own_ranges(&self) -> Vec<std::ops::Range<u64>>;
                fn check_reads(&mut self, every: bool);
                fn check_words(&mut self, words: &[u64]);
                fn host_call(&self, read: &mut dyn FnMut(u64, Width) -> Option<u64>) -> Option<HostCall>;
                fn answer_host_call(&mut self, answer: Option<u64>);
            }
        }
    };
}
pub(crate) use pass_on;

/// The program that such a core runs, and what its cycles went into.
#[derive(Clone, Debug)]
pub struct Pace {
    /// The code.
    pub program: Arc<Program>,
    /// The counts.
    pub tally: Arc<Tally>,
}

impl Pace {
    /// Of a program.
    pub fn new(program: Program) -> Self {
        Self { program: Arc::new(program), tally: Arc::default() }
    }

    /// Has the core of a target take its time.
    pub fn apply(&self, mut core: CoreSpec) -> CoreSpec {
        let (pace, make) = (self.clone(), core.processor);
        core.processor = Arc::new(move |endian| {
            let inner = make(endian)?;
            let passed = inner.retired();
            Ok(Box::new(Paced { inner, pace: pace.clone(), model: Model::default(), owed: 0, passed }))
        });
        core
    }
}

/// The core; what the runner takes for instructions are cycles.
#[derive(Debug)]
struct Paced {
    inner: Box<dyn Processor>,
    pace: Pace,
    model: Model,
    /// Cycles that the last instruction still takes.
    owed: u64,
    passed: u64,
}

impl Paced {
    /// One instruction, or none. An exception that is taken first counts to its first one.
    fn step(&mut self, bus: &mut dyn CoreBus) -> (Exit, u64) {
        let mut bus = Clocked { bus, ahead: self.passed - self.inner.retired() };
        let before = self.inner.pc();
        let (exit, _) = self.inner.run(0, &mut bus);
        if exit != Exit::Budget {
            return (exit, 0);
        }
        let address = self.inner.pc();
        let (exit, ran) = self.inner.run(1, &mut bus);
        if ran > 0 {
            let tally = &self.pace.tally;
            if address != before {
                self.owed += self.model.exception(tally);
            }
            let next = self.inner.pc();
            self.owed += self.model.step(&self.pace.program, tally, address as u32, next as u32) - 1;
        }
        (exit, ran)
    }
}

impl Processor for Paced {
    fn run(&mut self, budget: u32, bus: &mut dyn CoreBus) -> (Exit, u64) {
        let before = self.passed;
        let end = before + u64::from(budget);
        loop {
            let paid = self.owed.min(end - self.passed);
            self.owed -= paid;
            self.passed += paid;
            if self.passed == end {
                return (Exit::Budget, self.passed - before);
            }
            let (exit, ran) = self.step(bus);
            self.passed += ran;
            if exit != Exit::Budget {
                return (exit, self.passed - before);
            }
        }
    }

    fn retired(&self) -> u64 {
        self.passed
    }

    /// Refused: what is owed is not saved.
    fn load(&mut self, _: &[u8]) -> Result<(), Error> {
        Err(Error::State)
    }

    unsafe fn map(&mut self, start: u64, length: u64, host: *mut u8, writable: bool) {
        // SAFETY: what the caller promises is what is asked for.
        unsafe { self.inner.map(start, length, host, writable) }
    }

    pass_on!();
}

/// The bus, on which the inner core's instructions are so many cycles behind. It goes back to the runner after each access.
struct Clocked<'a> {
    bus: &'a mut dyn CoreBus,
    ahead: u64,
}

impl CoreBus for Clocked<'_> {
    fn access(&mut self, mut access: Access, from_code: bool) -> Option<u64> {
        access.instruction_count += self.ahead;
        self.bus.access(access, from_code)
    }

    fn time(&self, instructions: u64) -> VirtualNanos {
        self.bus.time(instructions + self.ahead)
    }

    fn acknowledge(&mut self, line: InterruptLine, instructions: u64) -> Option<u64> {
        self.bus.acknowledge(line, instructions + self.ahead)
    }

    delegate! {
        to self.bus {
            fn queued(&mut self) -> Vec<Queued>;
            fn read_checked(&mut self, access: Access, report: bool) -> Option<Checked>;
            fn write_checked(&mut self, access: Access) -> Option<bool>;
            fn stops_before(&mut self, access: &Access) -> bool;
            fn send_trace(&mut self, bytes: &[u8]);
        }
    }
}
