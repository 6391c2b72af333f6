//! The firmware: built, flashed, and run on the emulated board.

use std::path::{Path, PathBuf};

use anyhow::{Context, bail};

use crate::TARGET;
use crate::run::{cargo, ensure_target, is_installed, program, step, target_folder};

/// What probe-rs calls the default board's chip.
pub const CHIP: &str = "STM32F429ZITx";
/// What to build for the emulator, and how. The emulated part asks for a newer compiler than it needs.
const EMULATOR: &str = "--profile checked -p emulator --ignore-rust-version";
/// Says where the scans are that the benchmark firmware is built with.
pub const FIXED_SET: &str = "LINESLAM_FIXED_SET";
/// Where finished ELF files are put, under the target folder.
const ELF_FOLDER: &str = "firmware";

/// A build of the firmware.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Build {
    /// The one that is flashed.
    Flashed,
    /// The same for parts with 128 KiB of RAM.
    Small,
    /// Hangs, panics or faults when it is told to, for the tests of watchdog and last words.
    Misbehaving,
    /// Sleeps a thousand times, says how late it woke and panics, for the tests of the emulated time driver and of last words.
    Sleeping,
}

impl Build {
    fn name(self) -> &'static str {
        match self {
            Self::Flashed => "lineslam",
            Self::Small => "small",
            Self::Misbehaving => "misbehaves",
            Self::Sleeping => "sleeps",
        }
    }

    fn features(self) -> &'static str {
        match self {
            Self::Flashed => "",
            Self::Small => "--features small",
            Self::Misbehaving => "--features misbehaves",
            Self::Sleeping => "--features sleeps",
        }
    }
}

/// Builds the firmware and returns its ELF file. The robot file is `robots/paper.toml` unless `LINESLAM_ROBOT` names one.
pub fn build(build: Build) -> anyhow::Result<PathBuf> {
    ensure_target()?;
    let mut command =
        cargo(&format!("build --quiet --release -p firmware --target {TARGET} {}", build.features()));
    if is_installed("flip-link") {
        // A stack that overflows then faults instead of writing over statics.
        command.args(["--config", &format!("target.{TARGET}.linker=\"flip-link\"")]);
    }
    step(&format!("firmware {}", build.name()), &mut command)?;
    let made = target_folder().join(TARGET).join("release/firmware");
    let kept = target_folder().join(ELF_FOLDER).join(format!("{}.elf", build.name()));
    std::fs::create_dir_all(target_folder().join(ELF_FOLDER)).context("the folder for ELF files")?;
    std::fs::copy(&made, &kept).with_context(|| made.display().to_string())?;
    Ok(kept)
}

/// Flashes the firmware and shows its log.
pub fn flash() -> anyhow::Result<()> {
    let elf = build(Build::Flashed)?;
    probe_rs("run", &elf)
}

/// Shows the log of the firmware that runs.
pub fn attach() -> anyhow::Result<()> {
    let elf = build(Build::Flashed)?;
    probe_rs("attach", &elf)
}

fn probe_rs(what: &str, elf: &Path) -> anyhow::Result<()> {
    if !is_installed("probe-rs") {
        bail!("probe-rs is not installed; `cargo install --locked probe-rs-tools` gets it");
    }
    step(&format!("probe-rs {what}"), program("probe-rs").args([what, "--chip", CHIP]).arg(elf))
}

/// Runs the firmware on the emulated board.
pub fn emulate(arguments: &[String]) -> anyhow::Result<()> {
    let elf = build(Build::Flashed)?;
    build_emulator()?;
    let mut command = program(target_folder().join("checked/emulator"));
    command.arg("--firmware").arg(elf).args(arguments);
    let status = command.status().context("cannot run the emulator")?;
    if !status.success() {
        bail!("the emulated run failed");
    }
    Ok(())
}

/// The main job, without any hardware: the hall, mapped by the firmware on the emulated board, on a page while it drives.
pub fn demo(no_open: bool) -> anyhow::Result<()> {
    let no_open = no_open.then_some("--no-open");
    let arguments = ["--world", "hall", "--out", "out/demo", "--page"].into_iter().chain(no_open);
    emulate(&arguments.map(String::from).collect::<Vec<_>>())
}

/// Counts what each stage of the core takes, on the emulated core.
pub fn bench() -> anyhow::Result<()> {
    build_emulator()?;
    bench_when_built()
}

/// The same, where the emulator has been built.
pub fn bench_when_built() -> anyhow::Result<()> {
    let mut command = bench_command()?;
    step("instructions on the emulated core", &mut command)
}

/// The same, with what it prints.
pub fn bench_output() -> anyhow::Result<String> {
    build_emulator()?;
    let output = bench_command()?.output().context("cannot run the benchmark")?;
    if !output.status.success() {
        bail!("the benchmark failed:\n{}", String::from_utf8_lossy(&output.stderr));
    }
    String::from_utf8(output.stdout).context("the benchmark's output")
}

fn bench_command() -> anyhow::Result<std::process::Command> {
    ensure_target()?;
    let set = fixed_set()?;
    let command = format!("build --quiet --release -p bench-target --target {TARGET}");
    step("benchmark firmware", cargo(&command).env(FIXED_SET, set))?;
    let mut command = program(target_folder().join("checked/bench"));
    command.arg("--firmware").arg(target_folder().join(TARGET).join("release/bench-target"));
    Ok(command)
}

/// Makes the scans that the benchmark firmware is built with, by an emulator that has been built, and says where they are.
pub fn fixed_set() -> anyhow::Result<PathBuf> {
    std::fs::create_dir_all(target_folder().join(ELF_FOLDER)).context("the folder for ELF files")?;
    let set = target_folder().join(ELF_FOLDER).join("fixed_set.rs");
    let mut command = program(target_folder().join("checked/fixed-set"));
    command.args(["--world", "worlds/office.toml", "--robot", "robots/paper.toml", "--out"]).arg(&set);
    step("scans of the benchmark", &mut command)?;
    Ok(set)
}

fn build_emulator() -> anyhow::Result<()> {
    step("emulator", &mut cargo(&format!("build {EMULATOR}")))
}

/// Builds what the tests of the emulated board need, and says where it is.
pub fn for_tests() -> anyhow::Result<[(&'static str, PathBuf); 3]> {
    Ok([
        ("LINESLAM_FIRMWARE_MISBEHAVES", build(Build::Misbehaving)?),
        ("LINESLAM_FIRMWARE_SLEEPS", build(Build::Sleeping)?),
        // Last, so that it is the one that lies where cargo puts it.
        ("LINESLAM_FIRMWARE", build(Build::Flashed)?),
    ])
}
