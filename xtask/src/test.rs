//! `cargo xtask test`: everything CI runs.

use std::io::{BufRead, BufReader, Write};
use std::path::PathBuf;
use std::process::{Command, Stdio};

use anyhow::{Context, bail};

use crate::firmware::FIXED_SET;
use crate::run::{announce, cargo, debian_package, ensure_target, is_installed, program, root, step};
use crate::{TARGET, bench, firmware, size};

/// All tests, in one profile, so that what they and the emulator share is built once.
const TESTS: &str = "--workspace --profile checked --ignore-rust-version";

/// Runs every check, cheapest first; the tests come last and close with their sum.
pub fn everything() -> anyhow::Result<()> {
    ensure_target()?;
    step("format", &mut cargo("fmt --all --check"))?;
    let all = "--workspace --ignore-rust-version --all-targets";
    step("clippy, host", &mut cargo(&format!("clippy {all} -- -D warnings")))?;
    for arguments in [
        "-p slam-core",
        "-p slam-core --features defmt,serde",
        "-p scip",
        "-p scip --all-features",
        "-p link --features defmt",
        "-p footprint",
        "-p firmware",
        "-p firmware --features misbehaves,sleeps",
    ] {
        step(&format!("clippy for {TARGET}: {arguments}"), &mut clippy_for_target(arguments))?;
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
    // With all their tests: the emulator alone would be built with fewer features of what it shares with others, and again here.
    step("build the tests", &mut cargo(&format!("test {TESTS} --no-run")))?;
    let mut clippy = clippy_for_target("-p bench-target");
    step(&format!("clippy for {TARGET}: -p bench-target"), clippy.env(FIXED_SET, firmware::fixed_set()?))?;
    firmware::bench_when_built()?;
    let python = python_with_readers();
    browser();
    tests(python, &elves)
}

fn clippy_for_target(arguments: &str) -> Command {
    cargo(&format!("clippy {arguments} --target {TARGET} -- -D warnings"))
}

/// Runs all tests, those on the emulated board among them, and adds up what the test runner says.
fn tests(python: Option<PathBuf>, elves: &[(&str, PathBuf)]) -> anyhow::Result<()> {
    announce("tests");
    let mut command = cargo(&format!("test {TESTS} --no-fail-fast"));
    command.envs(elves.iter().map(|(name, path)| (name, path)));
    if let Some(python) = python {
        command.env("LINESLAM_PYTHON", python);
    }
    let mut sum = Sum::default();
    let succeeded = run_tests(&mut command, &mut sum)?;
    println!();
    for skipped in &sum.skipped {
        println!("{skipped}");
    }
    println!("{} passed, {} failed, {} skipped", sum.passed, sum.failed, sum.skipped.len());
    if !succeeded || sum.failed > 0 {
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
