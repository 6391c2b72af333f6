//! `cargo xtask bench`: what work costs, in instructions, counted by callgrind so that no other load matters.

use std::path::Path;

use anyhow::{Context, bail};

use crate::run::{announce, cargo, debian_package, program, step, target_folder};

/// Bytes of a full scan by `MD`.
const SCAN_BYTES: f64 = 2137.0;
/// Instructions that decoding may take for each byte.
const LIMIT: f64 = 40.0;

/// Counts, prints, and fails above the limit.
pub fn report() -> anyhow::Result<()> {
    debian_package("valgrind", "valgrind")?;
    step("build what is counted", &mut cargo("build --quiet --release -p scip --example decode"))?;
    announce("instructions to decode a scan of 682 points by MD (callgrind)");
    // The difference leaves out the start and end of the program.
    let (few, many) = (100, 1100);
    let example = target_folder().join("release/examples/decode");
    let scan =
        (instructions_of(&example, many)? - instructions_of(&example, few)?) as f64 / f64::from(many - few);
    println!("{scan:.0} for each scan, {:.1} for each byte; at most {LIMIT} are allowed", scan / SCAN_BYTES);
    if scan / SCAN_BYTES > LIMIT {
        bail!("decoding takes more than {LIMIT} instructions for each byte");
    }
    Ok(())
}

/// Instructions of an example that does its work so many times.
pub fn instructions_of(example: &Path, times: u32) -> anyhow::Result<u64> {
    let output = program("valgrind")
        .args(["--tool=callgrind", "--callgrind-out-file=/dev/null"])
        .arg(example)
        .arg(times.to_string())
        .output()
        .context("cannot run valgrind")?;
    let said = String::from_utf8_lossy(&output.stderr);
    if !output.status.success() {
        bail!("valgrind failed with {}:\n{said}", output.status);
    }
    said.lines()
        .find_map(|line| line.split_once("Collected : "))
        .and_then(|(_, count)| count.trim().parse().ok())
        .with_context(|| format!("valgrind gave no count:\n{said}"))
}
