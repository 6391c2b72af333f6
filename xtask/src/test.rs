//! `cargo xtask test`: everything CI runs.

use std::io::{BufRead, BufReader, Write};
use std::path::PathBuf;
use std::process::{Command, Stdio};

use anyhow::{Context, bail};

use crate::firmware::EMULATOR;
use crate::run::{announce, cargo, debian_package, ensure_target, is_installed, program, root, step};
use crate::{TARGET, bench, firmware, size};

/// Runs every check, cheapest first; the tests come last and close with their sum.
pub fn everything() -> anyhow::Result<()> {
    ensure_target()?;
    step("format", &mut cargo("fmt --all --check"))?;
    step("clippy, host", &mut cargo("clippy --workspace --exclude emulator --all-targets -- -D warnings"))?;
    let emulator = "clippy -p emulator --ignore-rust-version --all-targets -- -D warnings";
    step("clippy, emulator", &mut cargo(emulator))?;
    for arguments in [
        "-p slam-core",
        "-p slam-core --features defmt,serde",
        "-p scip",
        "-p scip --all-features",
        "-p link --features defmt",
        "-p footprint",
        // As it is built: it makes its scans with the whole command, which is not to be built twice.
        "--release -p bench-target",
        "-p firmware",
        "-p firmware --features misbehaves,sleeps",
    ] {
        let command = format!("clippy {arguments} --target {TARGET} -- -D warnings");
        step(&format!("clippy for {TARGET}: {arguments}"), &mut cargo(&command))?;
    }
    let features =
        "slam-core/defmt,slam-core/serde,scip/defmt,scip/embassy-time,scip/sim,scip/slam-core,link/defmt";
    let mut docs = cargo(&format!(
        "doc --workspace --exclude emulator --exclude firmware --no-deps --features {features}"
    ));
    step("docs", docs.env("RUSTDOCFLAGS", "-D warnings"))?;
    // The firmware that is flashed is built last of these, so that its size needs no build of its own.
    let elves = firmware::for_tests()?;
    size::report()?;
    bench::report()?;
    firmware::bench()?;
    let python = python_with_readers();
    browser();
    tests(python, &elves)
}

/// Runs all tests and adds up what the test runner says. The emulated runs are built with optimisations, the others are not.
fn tests(python: Option<PathBuf>, elves: &[(&str, PathBuf)]) -> anyhow::Result<()> {
    let mut sum = Sum::default();
    announce("tests");
    let mut command = cargo("test --workspace --exclude emulator --no-fail-fast");
    if let Some(python) = python {
        command.env("LINESLAM_PYTHON", python);
    }
    let on_the_pc = run_tests(&mut command, &mut sum)?;
    announce("tests on the emulated board");
    let mut command = cargo(&format!("test {EMULATOR} --no-fail-fast"));
    command.envs(elves.iter().map(|(name, path)| (name, path)));
    let emulated = run_tests(&mut command, &mut sum)?;
    println!();
    for skipped in &sum.skipped {
        println!("{skipped}");
    }
    println!("{} passed, {} failed, {} skipped", sum.passed, sum.failed, sum.skipped.len());
    if !on_the_pc || !emulated || sum.failed > 0 {
        bail!("tests failed");
    }
    if sum.passed == 0 {
        bail!("no test ran");
    }
    Ok(())
}

/// Shows what a test run prints and takes its sums. True if it succeeded.
fn run_tests(command: &mut Command, sum: &mut Sum) -> anyhow::Result<bool> {
    let mut child = command.stdout(Stdio::piped()).spawn().context("cannot run cargo test")?;
    let mut out = std::io::stdout();
    for line in BufReader::new(child.stdout.take().context("the tests' output")?).lines() {
        let line = line.context("the tests' output")?;
        writeln!(out, "{line}")?;
        sum.take(&line);
    }
    Ok(child.wait()?.success())
}

#[derive(Default)]
struct Sum {
    passed: usize,
    failed: usize,
    skipped: Vec<String>,
}

impl Sum {
    fn take(&mut self, line: &str) {
        if line.starts_with("SKIPPED ") {
            self.skipped.push(line.to_owned());
        }
        // test result: ok. 14 passed; 0 failed; …
        let Some(counts) =
            line.strip_prefix("test result: ").and_then(|l| l.split_once(". ")).map(|(_, c)| c)
        else {
            return;
        };
        for part in counts.split("; ") {
            match part.split_once(' ') {
                Some((n, "passed")) => self.passed += n.parse().unwrap_or(0),
                Some((n, "failed")) => self.failed += n.parse().unwrap_or(0),
                _ => {}
            }
        }
    }
}

/// What the tests ask of a Python: numbers for the referee beside the recorded logs, and readers of what we write that
/// know nothing of us.
const PYTHON_PACKAGES: [&str; 6] = ["numpy", "scipy", "mcap", "mcap-ros2-support", "rosbags", "ezdxf"];

/// A Python with those packages, made once in the target folder. Where it cannot be made, `None`: the tests that need it
/// then say that they were skipped.
pub(crate) fn python_with_readers() -> Option<PathBuf> {
    let folder = root().join("target/python");
    let python = folder.join("bin/python3");
    let works = |python: &PathBuf| {
        Command::new(python)
            .args(["-c", "import numpy, scipy, mcap, mcap_ros2, rosbags, ezdxf"])
            .stderr(Stdio::null())
            .status()
            .is_ok_and(|s| s.success())
    };
    if works(&python) {
        return Some(python);
    }
    let made =
        step("Python for the tests", program("python3").args(["-m", "venv"]).arg(&folder)).and_then(|()| {
            let mut install = program(&python);
            step("its packages", install.args(["-m", "pip", "install", "--quiet"]).args(PYTHON_PACKAGES))
        });
    match made {
        Ok(()) if works(&python) => Some(python),
        Ok(()) => None,
        Err(error) => {
            eprintln!("{error:#}");
            None
        }
    }
}

/// A browser for the tests of `lineslam live`, from Debian's packages where it is missing and they are at hand. Where it cannot be
/// installed, those tests say that they were skipped.
fn browser() {
    for (package, command) in [("chromium", "chromium"), ("chromium-driver", "chromedriver")] {
        if !is_installed(command)
            && is_installed("apt-get")
            && let Err(error) = debian_package(package, command)
        {
            eprintln!("{error:#}");
        }
    }
}
