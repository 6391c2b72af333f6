//! How many cycles a Cortex-M4F takes for each instruction: a model, made of what its maker and the part's state.
//!
//! **The core**, by the tables of its manual (ARM 100166, 3.3.1 and 7.2.3), at no wait states:
//! - data processing one cycle, `sdiv` and `udiv` 12, the most they take;
//! - a single load two, one where it follows another load or store whose result its address does not need; a store of a core
//!   register one, two with a register offset; `ldm`, `stm`, `push`, `pop`, `ldrd`, `strd` one and one for each register;
//! - one more for an address that the instruction before has only just computed;
//! - a branch that is taken one and refilling the pipeline: the manual says 1 to 3, by the target's alignment and width and by
//!   whether the address was known early. Here: 1, one more for a target of 32 bits that does not lie in one word, one more for
//!   an address from a register or from memory;
//! - floating point one, multiply and accumulate three, division and root 14, and one more where the next instruction needs
//!   the result;
//! - entering and leaving an exception 12 and 10.
//!
//! **The flash** with its accelerator, by the part's manual (ST RM0090, 3.5): lines of 16 bytes, 5 wait states at 180 MHz.
//! While a line runs, the next one is read ahead; a line that was neither read ahead nor kept costs the wait states, and is
//! kept: 64 lines of code and 8 of constants, the least recently used goes first.
//!
//! What it leaves out: constants that are not read relative to the program counter are taken to lie in RAM; conditional
//! instructions cost as if executed; DMA never stands in the core's way; a division is never overlapped.

use std::ops::Range;
use std::path::Path;
use std::sync::atomic::{AtomicU64, Ordering};

use anyhow::{Context, anyhow, ensure};
use capstone::arch::arm::{ArchExtraMode, ArchMode, ArmInsnDetail, ArmOperand, ArmOperandType, ArmReg};
use capstone::prelude::*;
use object::{Object, ObjectSection, ObjectSymbol, SectionKind};

/// Of the flash at 180 MHz and 3.3 V.
const WAIT_STATES: u64 = 5;
const LINE_BYTES: u32 = 16;
const CODE_LINES: usize = 64;
const CONSTANT_LINES: usize = 8;
/// Entering an exception and leaving it.
const EXCEPTION: u64 = 12 + 10;

/// Registers, a bit each: r0 to r15, then s0 to s31.
type Registers = u64;
const FIRST_SINGLE: u32 = 16;
const SINGLES: Registers = 0xFFFF_FFFF << FIRST_SINGLE;
const PC: Registers = 1 << 15;

/// What the model must know of one instruction.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Instruction {
    bytes: u32,
    cycles: u64,
    kind: Kind,
    /// Registers that make its address.
    addressing: Registers,
    read: Registers,
    written: Registers,
    /// Where it reads a constant beside the code.
    literal: Option<u32>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Kind {
    /// Data processing.
    Plain,
    /// Floating point, of which the result comes a cycle late.
    Arithmetic,
    /// A load or store of one value; its address and data phases overlap with its neighbours'.
    Single,
    /// Any other load or store.
    Multiple,
    /// A branch to an address that is known early.
    Direct,
    /// A branch to an address from a register or from memory.
    Indirect,
}

/// The instructions of an ELF by their addresses.
#[derive(Debug)]
pub struct Program {
    /// The address of the first.
    start: u32,
    /// One for each two bytes.
    instructions: Vec<Option<Instruction>>,
}

impl Program {
    /// Decodes all code.
    pub fn read(elf: &[u8], path: &Path) -> anyhow::Result<Self> {
        let file = object::File::parse(elf).with_context(|| path.display().to_string())?;
        let decoder = Decoder::new()?;
        let mut decoded = Vec::new();
        for section in file.sections().filter(|s| s.kind() == SectionKind::Text) {
            let bytes = section.data()?;
            let start = section.address();
            for range in code_ranges(&file, start..start + section.size()) {
                let inside = (range.start - start) as usize..(range.end - start) as usize;
                let bytes = bytes.get(inside).context("code beyond the end of its section")?;
                decoder.decode(bytes, range.start, &mut decoded)?;
            }
        }
        Self::of(&decoded).with_context(|| format!("{}: there is no code in it", path.display()))
    }

    fn of(decoded: &[(u32, Instruction)]) -> Option<Self> {
        let start = decoded.iter().map(|(address, _)| *address).min()?;
        let last = decoded.iter().map(|(address, _)| *address).max()?;
        let mut instructions = vec![None; ((last - start) / 2 + 1) as usize];
        for (address, instruction) in decoded {
            instructions[((address - start) / 2) as usize] = Some(*instruction);
        }
        Some(Self { start, instructions })
    }

    fn at(&self, address: u32) -> Option<&Instruction> {
        let place = address.checked_sub(self.start)? / 2;
        self.instructions.get(place as usize)?.as_ref()
    }
}

/// Where in such a section the mapping symbols say that code lies: from each `$t` to the next symbol of that kind.
fn code_ranges(file: &object::File<'_>, section: Range<u64>) -> Vec<Range<u64>> {
    let mut marks: Vec<(u64, bool)> = file
        .symbols()
        .filter(|s| section.contains(&s.address()))
        .filter_map(|s| match s.name().ok()?.split('.').next()? {
            "$t" => Some((s.address(), true)),
            "$d" => Some((s.address(), false)),
            _ => None,
        })
        .collect();
    marks.sort_unstable();
    let ends = marks.iter().skip(1).map(|(at, _)| *at).chain([section.end]);
    marks.iter().zip(ends).filter(|((_, code), _)| *code).map(|((at, _), end)| *at..end).collect()
}

/// Capstone, set to the core's instructions.
struct Decoder(Capstone);

impl Decoder {
    fn new() -> anyhow::Result<Self> {
        let builder = Capstone::new().arm().mode(ArchMode::Thumb);
        let capstone = builder.extra_mode([ArchExtraMode::MClass].into_iter()).detail(true).build();
        Ok(Self(capstone.map_err(|error| anyhow!("the disassembler: {error}"))?))
    }

    fn decode(&self, bytes: &[u8], address: u64, into: &mut Vec<(u32, Instruction)>) -> anyhow::Result<()> {
        let decoded =
            self.0.disasm_all(bytes, address).map_err(|error| anyhow!("code at {address:#x}: {error}"))?;
        for instruction in decoded.iter() {
            into.push((instruction.address() as u32, self.describe(instruction)?));
        }
        Ok(())
    }

    fn describe(&self, instruction: &capstone::Insn<'_>) -> anyhow::Result<Instruction> {
        let at = instruction.address() as u32;
        let detail =
            self.0.insn_detail(instruction).map_err(|error| anyhow!("instruction at {at:#x}: {error}"))?;
        let arch = detail.arch_detail();
        let arm = arch.arm().context("an instruction of another core")?;
        let registers = |list: &[RegId]| list.iter().fold(0, |all, register| all | bits(*register));
        let (read, written) = (registers(detail.regs_read()), registers(detail.regs_write()));
        let memory = arm.operands().find_map(|operand| match operand.op_type {
            ArmOperandType::Mem(memory) => Some(memory),
            _ => None,
        });
        let name = self.0.insn_name(instruction.id()).unwrap_or_default();
        let base = memory.map_or(0, |m| bits(m.base()));
        let index = memory.map_or(0, |m| bits(m.index()));
        let (kind, cycles) = classify(&name, arm, written, index != 0);
        let addressing = match kind {
            Kind::Multiple if memory.is_none() => first_register(arm),
            _ => (base | index) & !PC,
        };
        let literal = memory
            .filter(|_| base == PC && index == 0)
            .map(|m| ((at + 4) & !3).wrapping_add_signed(m.disp()));
        Ok(Instruction { bytes: instruction.len() as u32, cycles, kind, addressing, read, written, literal })
    }
}

/// The register that a list is loaded from or stored at; the stack pointer's changes are known early.
fn first_register(arm: &ArmInsnDetail<'_>) -> Registers {
    match arm.operands().next() {
        Some(ArmOperand { op_type: ArmOperandType::Reg(register), .. }) => bits(register),
        _ => 0,
    }
}

fn classify(name: &str, arm: &ArmInsnDetail<'_>, written: Registers, indexed: bool) -> (Kind, u64) {
    let jumps = written & PC != 0;
    // Of a list: single registers count one, double ones two.
    let list = arm.operands().filter_map(|operand| match operand.op_type {
        ArmOperandType::Reg(register) => Some(u64::from(bits(register).count_ones())),
        _ => None,
    });
    let wide = arm.operands().next().is_some_and(|operand| match operand.op_type {
        ArmOperandType::Reg(register) => bits(register).count_ones() == 2,
        _ => false,
    });
    match name {
        "b" | "bl" | "cbz" | "cbnz" => (Kind::Direct, 1),
        "bx" | "blx" => (Kind::Indirect, 1),
        "tbb" | "tbh" => (Kind::Indirect, 2),
        "pop" => (if jumps { Kind::Indirect } else { Kind::Multiple }, 1 + list.sum::<u64>()),
        "push" | "vpush" | "vpop" => (Kind::Multiple, 1 + list.sum::<u64>()),
        // The first register is the address.
        "ldm" | "ldmdb" => (if jumps { Kind::Indirect } else { Kind::Multiple }, list.sum()),
        "stm" | "stmdb" | "vldmia" | "vldmdb" | "vstmia" | "vstmdb" => (Kind::Multiple, list.sum()),
        "ldrd" | "strd" => (Kind::Multiple, 3),
        "vldr" | "vstr" => (Kind::Single, if wide { 3 } else { 2 }),
        _ if name.starts_with("ldr") => (if jumps { Kind::Indirect } else { Kind::Single }, 2),
        _ if name.starts_with("str") => (Kind::Single, if indexed { 2 } else { 1 }),
        "sdiv" | "udiv" => (Kind::Plain, 12),
        "vdiv" | "vsqrt" => (Kind::Arithmetic, 14),
        "vmla" | "vmls" | "vnmla" | "vnmls" | "vfma" | "vfms" | "vfnma" | "vfnms" => (Kind::Arithmetic, 3),
        "vadd" | "vsub" | "vmul" | "vnmul" => (Kind::Arithmetic, 1),
        _ if name.starts_with("vcvt") => (Kind::Arithmetic, 1),
        // Two at once.
        "vmov" if arm.operands().count() > 2 => (Kind::Plain, 2),
        "mrs" | "msr" => (Kind::Plain, 2),
        _ if jumps => (Kind::Indirect, 1),
        _ => (Kind::Plain, 1),
    }
}

fn bits(register: RegId) -> Registers {
    let number = u32::from(register.0);
    let within = |first: u32, last: u32| (first..=last).contains(&number).then(|| number - first);
    if let Some(core) = within(ArmReg::ARM_REG_R0, ArmReg::ARM_REG_R12) {
        1 << core
    } else if let Some(single) = within(ArmReg::ARM_REG_S0, ArmReg::ARM_REG_S31) {
        1 << (FIRST_SINGLE + single)
    } else if let Some(double) = within(ArmReg::ARM_REG_D0, ArmReg::ARM_REG_D15) {
        3 << (FIRST_SINGLE + 2 * double)
    } else {
        match number {
            ArmReg::ARM_REG_SP => 1 << 13,
            ArmReg::ARM_REG_LR => 1 << 14,
            ArmReg::ARM_REG_PC => PC,
            _ => 0,
        }
    }
}

/// What cycles went into, over all that ran.
#[derive(Debug, Default)]
pub struct Tally {
    counts: [AtomicU64; Cause::Exceptions as usize + 1],
}

/// What takes cycles, and how many instructions did.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Cause {
    /// Instructions, not cycles.
    Instructions,
    /// Those that are not in the decoded code: not cycles either.
    Unknown,
    /// What the core's tables say.
    Core,
    /// Refilling the pipeline after a branch.
    Refill,
    /// Waiting for what the instruction before computes.
    Dependency,
    /// Waiting for code.
    Code,
    /// Waiting for constants beside the code.
    Constants,
    /// Entering and leaving exceptions.
    Exceptions,
}

impl Cause {
    /// Those that are cycles.
    pub const CYCLES: [Self; 6] =
        [Self::Core, Self::Refill, Self::Dependency, Self::Code, Self::Constants, Self::Exceptions];
}

impl Tally {
    /// So much so far.
    pub fn of(&self, cause: Cause) -> u64 {
        self.counts[cause as usize].load(Ordering::Relaxed)
    }

    /// Of all instructions so far.
    pub fn cycles_per_instruction(&self) -> f64 {
        let cycles: u64 = Cause::CYCLES.iter().map(|cause| self.of(*cause)).sum();
        cycles as f64 / self.of(Cause::Instructions).max(1) as f64
    }

    /// Fails where instructions were executed that the model does not know: they counted for one cycle each.
    pub fn check_known(&self) -> anyhow::Result<()> {
        let unknown = self.of(Cause::Unknown);
        ensure!(unknown == 0, "{unknown} instructions are not in the disassembled code");
        Ok(())
    }

    fn add(&self, cause: Cause, number: u64) -> u64 {
        if number > 0 {
            self.counts[cause as usize].fetch_add(number, Ordering::Relaxed);
        }
        number
    }
}

/// The core and the flash while they run a program.
#[derive(Debug, Default)]
pub struct Model {
    previous: Option<Instruction>,
    flash: Flash,
    cycles: u64,
}

impl Model {
    /// Cycles of the instruction at `address`, after which the core is at `next`.
    pub fn step(&mut self, program: &Program, tally: &Tally, address: u32, next: u32) -> u64 {
        tally.add(Cause::Instructions, 1);
        let Some(instruction) = program.at(address).copied() else {
            tally.add(Cause::Unknown, 1);
            self.previous = None;
            return self.pass(1);
        };
        let mut cycles = tally.add(Cause::Code, self.flash.fetch(address, instruction.bytes, self.cycles));
        let previous = self.previous.replace(instruction);
        let needs = |kind, registers: Registers| {
            previous.is_some_and(|p| p.kind == kind && p.written & registers != 0)
        };
        let overlaps = instruction.kind == Kind::Single
            && instruction.cycles > 1
            && previous.is_some_and(|p| p.kind == Kind::Single)
            && !needs(Kind::Single, instruction.addressing);
        cycles += tally.add(Cause::Core, instruction.cycles - u64::from(overlaps));
        let late =
            needs(Kind::Plain, instruction.addressing) || needs(Kind::Arithmetic, instruction.read & SINGLES);
        cycles += tally.add(Cause::Dependency, u64::from(late));
        if let Some(constant) = instruction.literal {
            cycles += tally.add(Cause::Constants, self.flash.read(constant));
        }
        if next != address + instruction.bytes && matches!(instruction.kind, Kind::Direct | Kind::Indirect) {
            let target = program.at(next);
            let straddles = target.is_some_and(|t| t.bytes == 4 && !next.is_multiple_of(4));
            let refill = 1 + u64::from(straddles) + u64::from(instruction.kind == Kind::Indirect);
            cycles += tally.add(Cause::Refill, refill);
        }
        self.pass(cycles)
    }

    /// Cycles of entering an exception and leaving it.
    pub fn exception(&mut self, tally: &Tally) -> u64 {
        self.previous = None;
        self.pass(tally.add(Cause::Exceptions, EXCEPTION))
    }

    fn pass(&mut self, cycles: u64) -> u64 {
        self.cycles += cycles;
        cycles
    }
}

/// The flash and its accelerator.
#[derive(Debug, Default)]
struct Flash {
    /// The line the core runs in.
    line: Option<u32>,
    /// The line that is read ahead, and when it will be there.
    ahead: Option<(u32, u64)>,
    code: Kept<CODE_LINES>,
    constants: Kept<CONSTANT_LINES>,
}

impl Flash {
    /// Cycles that an instruction is waited for.
    fn fetch(&mut self, address: u32, bytes: u32, now: u64) -> u64 {
        let mut wait = 0;
        for line in address / LINE_BYTES..=(address + bytes - 1) / LINE_BYTES {
            if self.line == Some(line) {
                continue;
            }
            wait += match self.ahead {
                _ if self.code.has(line) => 0,
                Some((ahead, ready)) if ahead == line => ready.saturating_sub(now + wait),
                _ => {
                    self.code.keep(line);
                    WAIT_STATES
                }
            };
            self.line = Some(line);
            self.ahead = Some((line + 1, now + wait + WAIT_STATES + 1));
        }
        wait
    }

    /// Cycles that a constant is waited for.
    fn read(&mut self, address: u32) -> u64 {
        let line = address / LINE_BYTES;
        if self.constants.has(line) {
            return 0;
        }
        self.constants.keep(line);
        WAIT_STATES
    }
}

/// Lines that are kept, the one used last at the end.
#[derive(Debug, Default)]
struct Kept<const LINES: usize>(Vec<u32>);

impl<const LINES: usize> Kept<LINES> {
    fn has(&mut self, line: u32) -> bool {
        let Some(place) = self.0.iter().rposition(|kept| *kept == line) else { return false };
        self.0[place..].rotate_left(1);
        true
    }

    fn keep(&mut self, line: u32) {
        if self.0.len() == LINES {
            self.0.remove(0);
        }
        self.0.push(line);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn decoded(code: &[u16]) -> Vec<(u32, Instruction)> {
        let bytes: Vec<u8> = code.iter().flat_map(|half| half.to_le_bytes()).collect();
        let mut instructions = Vec::new();
        Decoder::new().unwrap().decode(&bytes, 0x0800_0000, &mut instructions).unwrap();
        instructions
    }

    #[test]
    fn instructions_are_what_the_manual_says_they_are() {
        let cases: &[(&[u16], Kind, u64)] = &[
            (&[0x3801], Kind::Plain, 1),               // subs r0, #1
            (&[0xfbb0, 0xf0f1], Kind::Plain, 12),      // udiv r0, r0, r1
            (&[0x6808], Kind::Single, 2),              // ldr r0, [r1]
            (&[0x6008], Kind::Single, 1),              // str r0, [r1]
            (&[0x5088], Kind::Single, 2),              // str r0, [r1, r2]
            (&[0xed91, 0x0a00], Kind::Single, 2),      // vldr s0, [r1]
            (&[0xed91, 0x0b00], Kind::Single, 3),      // vldr d0, [r1]
            (&[0xb4f0], Kind::Multiple, 5),            // push {r4-r7}
            (&[0xbdf0], Kind::Indirect, 6),            // pop {r4-r7, pc}
            (&[0xe891, 0x003c], Kind::Multiple, 5),    // ldm.w r1, {r2-r5}
            (&[0xecb1, 0x0b04], Kind::Multiple, 5),    // vldmia r1!, {d0, d1}
            (&[0xe9d1, 0x2300], Kind::Multiple, 3),    // ldrd r2, r3, [r1]
            (&[0xd1fe], Kind::Direct, 1),              // bne
            (&[0xb108], Kind::Direct, 1),              // cbz r0
            (&[0x4770], Kind::Indirect, 1),            // bx lr
            (&[0x4687], Kind::Indirect, 1),            // mov pc, r0
            (&[0xee30, 0x0a20], Kind::Arithmetic, 1),  // vadd.f32 s0, s0, s1
            (&[0xee00, 0x0a20], Kind::Arithmetic, 3),  // vmla.f32 s0, s0, s1
            (&[0xee80, 0x0a20], Kind::Arithmetic, 14), // vdiv.f32 s0, s0, s1
            (&[0xeeb1, 0x0ae0], Kind::Arithmetic, 14), // vsqrt.f32 s0, s1
            (&[0xeebd, 0x0ae0], Kind::Arithmetic, 1),  // vcvt.s32.f32 s0, s1
            (&[0xeeb4, 0x0a60], Kind::Plain, 1),       // vcmp.f32 s0, s1
            (&[0xec51, 0x0a10], Kind::Plain, 2),       // vmov r0, r1, s0, s1
        ];
        for (code, kind, cycles) in cases {
            let all = decoded(code);
            let [(_, instruction)] = all[..] else { panic!("{code:x?}: {all:?}") };
            assert_eq!((instruction.kind, instruction.cycles), (*kind, *cycles), "{code:x?}");
            assert_eq!(instruction.bytes as usize, 2 * code.len(), "{code:x?}");
        }
    }

    #[test]
    fn a_constant_beside_the_code_is_found() {
        // A nop, ldr r0, [pc, #8] and vldr s0, [pc, #8], the address of both taken from a whole word.
        let all = decoded(&[0xbf00, 0x4802, 0xed9f, 0x0a02]);
        assert_eq!(
            all.iter().map(|(_, i)| i.literal).collect::<Vec<_>>(),
            [None, Some(0x0800_000c), Some(0x0800_0010)]
        );
    }

    #[test]
    fn an_instruction_that_is_not_in_the_code_is_told_of() {
        let program = Program::of(&decoded(&[0xbf00, 0xbf00])).unwrap();
        let (mut model, tally) = (Model::default(), Tally::default());
        let start = program.start;
        model.step(&program, &tally, start, start + 2);
        assert!(tally.check_known().is_ok());
        model.step(&program, &tally, 0x2000_0000, start);
        assert!(tally.check_known().unwrap_err().to_string().starts_with("1 instructions"));
    }

    #[test]
    fn a_line_is_waited_for_unless_it_was_read_ahead_or_kept() {
        let mut flash = Flash::default();
        assert_eq!(flash.fetch(0, 2, 0), 5, "never seen");
        assert_eq!(flash.fetch(2, 2, 6), 0, "the same line");
        assert_eq!(flash.fetch(16, 2, 8), 3, "read ahead since cycle 5, there in cycle 11");
        assert_eq!(flash.fetch(32, 2, 30), 0, "read ahead long ago");
        assert_eq!(flash.fetch(0, 2, 31), 0, "kept");
        assert_eq!(flash.fetch(14, 4, 32), 5, "half of it in a line that is being read");
        assert_eq!(flash.fetch(160, 2, 40), 5);
        for line in 0..CODE_LINES as u32 {
            flash.fetch(1600 + 160 * line, 2, 1000);
        }
        assert_eq!(flash.fetch(0, 2, 2000), 5, "no longer kept");
        assert_eq!([flash.read(0), flash.read(12), flash.read(16), flash.read(0)], [5, 0, 5, 0]);
    }
}
