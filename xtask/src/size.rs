//! `cargo xtask size`: flash and RAM on the microcontroller, read from what the linker made, against a budget.

use std::collections::BTreeMap;
use std::path::Path;

use anyhow::{Context, bail};
use object::{File, Object, ObjectSection, ObjectSymbol, SectionKind, SymbolKind};

use crate::TARGET;
use crate::firmware::{self, Build};
use crate::run::{announce, cargo, step, target_folder};

/// Flash that the firmware may take: code, constants, and what variables begin with. The part has 2048 KiB; the budget is there to
/// have growth noticed.
const FLASH_BUDGET: u64 = 244 * 1024;
/// RAM that it may take, the map among it, less the stack, which is measured as it runs: a test of the emulated board holds both together
/// to 190 KiB of 192.
const RAM_BUDGET: u64 = (190 - STACK_KIB) * 1024;
/// The same of the firmware for parts with 128 KiB.
const SMALL_RAM_BUDGET: u64 = (112 - STACK_KIB) * 1024;
const STACK_KIB: u64 = 12;

/// What a report prints of an ELF file.
struct Sizes {
    /// Bytes of code by the crate that its symbol names.
    code_by_crate: BTreeMap<String, u64>,
    /// Sections that take flash or RAM: name, bytes, and whether flash holds them, and RAM.
    sections: Vec<(String, u64, bool, bool)>,
    /// Statics named `RAM_…`.
    ram: BTreeMap<String, u64>,
}

impl Sizes {
    /// Bytes of the sections that count.
    fn sum(&self, counts: fn(&(String, u64, bool, bool)) -> bool) -> u64 {
        self.sections.iter().filter(|section| counts(section)).map(|section| section.1).sum()
    }
}

/// Prints the firmware's size and that of the driver alone, and fails over the budget.
pub fn report() -> anyhow::Result<()> {
    let small = read(&firmware::build(Build::Small)?)?.sum(|s| s.3);
    // Last, so that it is the one that lies where cargo puts it.
    let firmware = read(&firmware::build(Build::Flashed)?)?;
    announce("size of the firmware, bytes");
    println!("{:<14} {:>9} {:>9}", "section", "flash", "RAM");
    let shown = |there: bool, bytes: u64| if there { bytes.to_string() } else { String::new() };
    for (name, bytes, flash, ram) in &firmware.sections {
        println!("{name:<14} {:>9} {:>9}", shown(*flash, *bytes), shown(*ram, *bytes));
    }
    let (flash, ram) = (firmware.sum(|s| s.2), firmware.sum(|s| s.3));
    println!("{:<14} {flash:>9} {ram:>9}", "sum");
    println!("{:<14} {FLASH_BUDGET:>9} {RAM_BUDGET:>9}", "budget");
    println!("RAM with `--features small`: {small}, budget {SMALL_RAM_BUDGET}");
    println!("\ncode by crate:");
    for (name, bytes) in largest(&firmware.code_by_crate) {
        println!("{bytes:>9} {name}");
    }

    let command = format!("build --quiet --release -p footprint --target {TARGET}");
    step("size of the sensor's driver alone, bytes", &mut cargo(&command))?;
    let driver = read(&target_folder().join(TARGET).join("release/footprint"))?;
    for (name, bytes) in largest(&driver.code_by_crate) {
        println!("{bytes:>9} of code in {name}");
    }
    for (name, bytes) in &driver.ram {
        println!("{bytes:>9} of RAM: {}", what(name));
    }
    if flash > FLASH_BUDGET || ram > RAM_BUDGET || small > SMALL_RAM_BUDGET {
        bail!("the firmware is over its budget");
    }
    Ok(())
}

/// Flash and RAM of the firmware as a table in Markdown.
pub fn summary() -> anyhow::Result<String> {
    let [small, sizes] = [Build::Small, Build::Flashed].map(|build| read(&firmware::build(build)?));
    let (small, sizes) = (small?, sizes?);
    let kib = |bytes: u64| bytes as f64 / 1024.0;
    Ok(format!(
        "| firmware | KiB | budget |\n|---|---|---|\n| flash | {:.1} | {} |\n\
         | variables, a map for 1024 segments and 256 places among them | {:.1} | {} |\n\
         | the same for 448 segments and 96 places (`--features small`) | {:.1} | {} |\n",
        kib(sizes.sum(|s| s.2)),
        FLASH_BUDGET / 1024,
        kib(sizes.sum(|s| s.3)),
        RAM_BUDGET / 1024,
        kib(small.sum(|s| s.3)),
        SMALL_RAM_BUDGET / 1024
    ))
}

/// The largest first.
fn largest(by_crate: &BTreeMap<String, u64>) -> Vec<(&String, &u64)> {
    let mut all: Vec<_> = by_crate.iter().collect();
    all.sort_by_key(|(_, bytes)| std::cmp::Reverse(**bytes));
    all.truncate(14);
    all
}

fn what(name: &str) -> &str {
    match name {
        "RAM_DECODER" => "a decoder",
        "RAM_CLIENT" => "a client, its decoder included, the port not",
        "RAM_NEXT_SCAN" => "a call of next_scan while it waits",
        other => other,
    }
}

fn read(elf: &Path) -> anyhow::Result<Sizes> {
    let bytes = std::fs::read(elf).with_context(|| elf.display().to_string())?;
    let file = File::parse(&*bytes).with_context(|| elf.display().to_string())?;
    let mut sizes = Sizes { code_by_crate: BTreeMap::new(), sections: Vec::new(), ram: BTreeMap::new() };
    for section in file.sections().filter(|s| s.size() > 0) {
        let (flash, ram) = match section.kind() {
            SectionKind::Text | SectionKind::ReadOnlyData | SectionKind::ReadOnlyString => (true, false),
            // Variables that begin with a value have it in flash.
            SectionKind::Data => (true, true),
            SectionKind::UninitializedData => (false, true),
            _ => continue,
        };
        sizes.sections.push((section.name().unwrap_or("?").to_owned(), section.size(), flash, ram));
    }
    for symbol in file.symbols().filter(|s| s.size() > 0) {
        let name = symbol.name().unwrap_or("?");
        match symbol.kind() {
            SymbolKind::Text => {
                *sizes.code_by_crate.entry(crate_of(name)).or_default() += symbol.size();
            }
            SymbolKind::Data if name.starts_with("RAM_") => {
                sizes.ram.insert(name.to_owned(), symbol.size());
            }
            _ => {}
        }
    }
    Ok(sizes)
}

/// The crate whose code a function is.
fn crate_of(symbol: &str) -> String {
    first_crate(&format!("{:#}", rustc_demangle::demangle(symbol))).to_owned()
}

/// The first crate in a path such as `<scip::Field as core::fmt::Debug>::fmt`.
fn first_crate(path: &str) -> &str {
    let path = path.trim_start_matches(|c: char| !c.is_ascii_alphabetic() && c != '_');
    let Some((first, _)) = path.split_once("::") else { return "the compiler" };
    // `<u32 as core::fmt::Display>::fmt` is core's.
    first.rsplit(' ').next().unwrap_or(first)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn code_is_its_crate_s() {
        assert_eq!(crate_of("_ZN4scip7decoder7Decoder4feed17h0123456789abcdefE"), "scip");
        assert_eq!(crate_of("__aeabi_memcpy"), "the compiler");
        assert_eq!(first_crate("<scip::Field as core::fmt::Debug>::fmt"), "scip");
        assert_eq!(first_crate("<&mut scip::Field as core::fmt::Debug>::fmt"), "scip");
        assert_eq!(first_crate("<u32 as core::fmt::Display>::fmt"), "core");
    }
}
