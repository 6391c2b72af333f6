//! `cargo xtask board-setup`: sets the board's option bytes, once, with probe-rs.
//!
//! Brown-out reset is off as the part is shipped: below 2.7 V the flash cannot be read at 180 MHz, and the core runs wild before the
//! power-down reset at 1.7 V comes. At level 3 the part is held in reset below some 2.8 V (RM0090, 3.9.10; DS9405, table 22).

use anyhow::{Context, bail, ensure};

use crate::firmware::CHIP;
use crate::run::{is_installed, program};

/// Registers of the flash interface.
const OPTKEYR: u32 = 0x4002_3C08;
const OPTCR: u32 = 0x4002_3C14;
/// What opens the option bytes, in this order.
const OPTION_KEYS: [u32; 2] = [0x0819_2A3B, 0x4C5D_6E7F];
const OPTLOCK: u32 = 1 << 0;
const OPTSTRT: u32 = 1 << 1;
/// Brown-out level: 3 is 0, and all ones is off.
const BOR_LEVEL: u32 = 0b11 << 2;
/// Read protection: none. Any other value is left alone, for the wrong one locks the part for ever.
const UNPROTECTED: u32 = 0xAA;
/// Programming them takes up to two seconds; so often it is asked whether it is done.
const TRIES: usize = 20;

/// What is to be done with option bytes that read so.
#[derive(Debug, PartialEq, Eq)]
enum Step {
    /// They are as they should be.
    Done,
    /// They are to be these.
    Program(u32),
}

/// The step from the control register as it reads.
fn step(optcr: u32) -> anyhow::Result<Step> {
    let protection = optcr >> 8 & 0xFF;
    ensure!(
        protection == UNPROTECTED,
        "the part's read protection is {protection:#04x}, not {UNPROTECTED:#04x}: its option bytes are left as they are"
    );
    Ok(match optcr & BOR_LEVEL {
        0 => Step::Done,
        _ => Step::Program(optcr & !(BOR_LEVEL | OPTLOCK | OPTSTRT)),
    })
}

/// Sets brown-out reset to level 3 and leaves all else as it is.
pub fn run() -> anyhow::Result<()> {
    if !is_installed("probe-rs") {
        bail!("probe-rs is not installed; `cargo install --locked probe-rs-tools` gets it");
    }
    let before = read(OPTCR)?;
    let Step::Program(options) = step(before)? else {
        println!("brown-out reset is at level 3 already; nothing is to be done");
        return Ok(());
    };
    println!("option bytes: {before:#010x}; brown-out reset goes to level 3");
    for key in OPTION_KEYS {
        write(OPTKEYR, key)?;
    }
    ensure!(read(OPTCR)? & OPTLOCK == 0, "the option bytes do not open; they are as they were");
    write(OPTCR, options)?;
    write(OPTCR, options | OPTSTRT)?;
    let programmed =
        (0..TRIES).find_map(|_| read(OPTCR).map(|now| (now & OPTSTRT == 0).then_some(now)).transpose());
    let now = programmed.context("the option bytes take too long to program")??;
    write(OPTCR, now | OPTLOCK)?;
    probe_rs(&["reset", "--chip", CHIP])?;
    let after = read(OPTCR)?;
    ensure!(
        step(after)? == Step::Done,
        "the option bytes read {after:#010x}: brown-out reset is not at level 3"
    );
    println!("option bytes: {after:#010x}; brown-out reset is at level 3");
    Ok(())
}

fn read(address: u32) -> anyhow::Result<u32> {
    let said = probe_rs(&["read", "--chip", CHIP, "b32", &format!("{address:#x}"), "1"])?;
    let word = said.trim();
    u32::from_str_radix(word, 16).with_context(|| format!("probe-rs read {address:#x} as '{word}'"))
}

fn write(address: u32, word: u32) -> anyhow::Result<()> {
    probe_rs(&["write", "--chip", CHIP, "b32", &format!("{address:#x}"), &format!("{word:#x}")]).map(drop)
}

fn probe_rs(arguments: &[&str]) -> anyhow::Result<String> {
    let output = program("probe-rs").args(arguments).output().context("cannot run probe-rs")?;
    if !output.status.success() {
        bail!("probe-rs {}: {}", arguments.join(" "), String::from_utf8_lossy(&output.stderr).trim());
    }
    String::from_utf8(output.stdout).context("what probe-rs prints")
}

#[cfg(test)]
mod tests {
    use super::*;

    /// As the part is shipped (RM0090, 3.9.10: 0x0FFF AAED).
    const SHIPPED: u32 = 0x0FFF_AAED;

    #[test]
    fn only_the_brown_out_level_changes() {
        assert_eq!(step(SHIPPED).unwrap(), Step::Program(0x0FFF_AAE0));
        assert_eq!(step(SHIPPED & !BOR_LEVEL).unwrap(), Step::Done);
        let dual_bank = SHIPPED | 1 << 30;
        assert_eq!(step(dual_bank).unwrap(), Step::Program(0x4FFF_AAE0));
    }

    #[test]
    fn a_protected_part_is_left_alone() {
        for protection in [0x00, 0x55, 0xCC] {
            let said = step(SHIPPED & !0xFF00 | protection << 8).unwrap_err().to_string();
            assert!(said.contains("left as they are"), "{said}");
        }
    }
}
