//! What the tests on the emulated board share.
#![allow(dead_code)] // Each test file uses its part.

use std::path::{Path, PathBuf};

use emulator::fault::Fault;
use emulator::record::{Entry, Event};
use emulator::report::{self, Judged};
use emulator::run::{Outcome, Plan, run_with};
use emulator::vcp::{FarEnd, Nobody};
use lineslam::robot::Robot;
use lineslam::sim::SimConfig;
use lineslam::sim::world::World;

pub fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..")
}

/// A build of the firmware, which `cargo xtask test` makes and names by these variables.
pub fn elf(build: &str) -> PathBuf {
    let variable = match build {
        "lineslam" => "LINESLAM_FIRMWARE".to_owned(),
        other => format!("LINESLAM_FIRMWARE_{}", other.to_uppercase()),
    };
    let usual = root().join("target/firmware").join(format!("{build}.elf"));
    let elf = std::env::var_os(variable).map_or(usual, PathBuf::from);
    assert!(elf.exists(), "{} is not there: `cargo xtask test` builds it", elf.display());
    elf
}

pub fn robot() -> Robot {
    Robot::load(&root().join("robots/paper.toml")).expect("the robot file")
}

pub fn world(name: &str) -> World {
    World::load(&root().join(format!("worlds/{name}.toml"))).expect("the world")
}

/// Runs the hall for a while, with these faults.
pub fn hall(seconds: Option<u64>, faults: &[&str]) -> (Outcome, Judged) {
    run_in("lineslam", seconds, faults)
}

/// Runs a build of the firmware in the hall.
pub fn run_in(build: &str, seconds: Option<u64>, faults: &[&str]) -> (Outcome, Judged) {
    let faults = faults.iter().map(|f| f.parse::<Fault>().expect("a fault")).collect();
    run_at(build, seconds, faults, false)
}

/// Runs the firmware that is flashed in the hall, on a core that takes its time.
pub fn hall_in_cycles(seconds: Option<u64>) -> (Outcome, Judged) {
    run_at("lineslam", seconds, Vec::new(), true)
}

/// Runs the firmware that is flashed in the hall, with somebody at the virtual COM port.
pub fn hall_with(vcp: impl FarEnd + 'static, seconds: Option<u64>, faults: &[&str]) -> (Outcome, Judged) {
    let faults = faults.iter().map(|f| f.parse::<Fault>().expect("a fault")).collect();
    run_with_far_end("lineslam", vcp, seconds, faults, false)
}

fn run_at(build: &str, seconds: Option<u64>, faults: Vec<Fault>, cycles: bool) -> (Outcome, Judged) {
    run_with_far_end(build, Nobody, seconds, faults, cycles)
}

fn run_with_far_end(
    build: &str,
    vcp: impl FarEnd + 'static,
    seconds: Option<u64>,
    faults: Vec<Fault>,
    cycles: bool,
) -> (Outcome, Judged) {
    let (world, robot, seed) = (world("hall"), robot(), 11);
    let (elf, sim) = (elf(build), SimConfig::default());
    let plan = Plan { elf: &elf, world: &world, robot: &robot, sim, seed, seconds, faults, cycles };
    let outcome = run_with(&plan, vcp, |_| ()).unwrap_or_else(|error| panic!("{error:#}"));
    let judged = report::judge(&world, seed, &outcome).expect("a run that can be judged");
    (outcome, judged)
}

/// Whether a line of the log has this text in it.
pub fn says(outcome: &Outcome, level: &str, text: &str) -> bool {
    outcome.log.iter().any(|line| line.level == level && line.text.contains(text))
}

/// Whether the last status line counts nothing lost.
pub fn nothing_lost(outcome: &Outcome) -> bool {
    let last = outcome.log.iter().rev().find(|line| line.text.starts_with("lidar: missed "));
    last.is_some_and(|line| line.text.starts_with("lidar: missed 0, dropped 0, port errors 0, losses 0;"))
}

/// The error of the last pose, metres.
pub fn last_error_m(judged: &Judged) -> f64 {
    judged.report.trajectory.final_position_error_m
}

pub fn scans(entries: &[Entry]) -> impl Iterator<Item = &Entry> {
    entries.iter().filter(|e| matches!(e.event, Event::Scan { .. }))
}
