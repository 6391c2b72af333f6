//! `cargo xtask size`: flash and RAM on the microcontroller, read from what the linker made.

use std::collections::BTreeMap;
use std::path::Path;

use anyhow::Context;
use object::{File, Object, ObjectSection, ObjectSymbol, SectionKind, SymbolKind};

use crate::TARGET;
use crate::run::{cargo, ensure_target, root, step};

/// What a report prints of an ELF file.
struct Sizes {
    /// Bytes of code by the crate that its symbol names.
    code_by_crate: BTreeMap<String, u64>,
    code: u64,
    constants: u64,
    /// Statics named `RAM_…`.
    ram: BTreeMap<String, u64>,
}

/// Links the driver alone and prints its size.
pub fn report() -> anyhow::Result<()> {
    ensure_target()?;
    let command = format!("build --quiet --release -p footprint --target {TARGET}");
    step("size of the driver alone", &mut cargo(&command))?;
    let elf = root().join("target").join(TARGET).join("release/footprint");
    let sizes = read(&elf)?;
    println!("{:>8} bytes of code, the compiler's own functions and the probe included", sizes.code);
    for (name, bytes) in &sizes.code_by_crate {
        println!("{bytes:>8}   in {name}");
    }
    println!("{:>8} bytes of constants, the RAM below not counted", sizes.constants);
    for (name, bytes) in &sizes.ram {
        println!("{bytes:>8} bytes of RAM: {}", what(name));
    }
    Ok(())
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
    let of_kinds = |kinds: &[SectionKind]| {
        file.sections().filter(|s| kinds.contains(&s.kind())).map(|s| s.size()).sum::<u64>()
    };
    let mut sizes = Sizes {
        code_by_crate: BTreeMap::new(),
        code: of_kinds(&[SectionKind::Text]),
        constants: of_kinds(&[SectionKind::ReadOnlyData, SectionKind::ReadOnlyString]),
        ram: BTreeMap::new(),
    };
    for symbol in file.symbols().filter(|s| s.size() > 0) {
        let name = symbol.name().unwrap_or("?");
        match symbol.kind() {
            SymbolKind::Text => {
                *sizes.code_by_crate.entry(crate_of(name)).or_default() += symbol.size();
            }
            SymbolKind::Data if name.starts_with("RAM_") => {
                sizes.ram.insert(name.to_owned(), symbol.size());
                // It lies among the constants, for it is never written.
                sizes.constants = sizes.constants.saturating_sub(symbol.size());
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
