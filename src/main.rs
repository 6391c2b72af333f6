//! The robot's firmware: a laser scanner and two wheel encoders go in, a map of line segments and the pose come out.
//!
//! `main` starts the board and hands its parts to the tasks. The lidar and the encoders run on an interrupt executor,
//! above everything in thread mode, where the map is made.
#![cfg_attr(target_os = "none", no_std, no_main)]

#[cfg(target_os = "none")]
mod board;
#[cfg(target_os = "none")]
mod encoders;
#[cfg(target_os = "none")]
mod faults;
#[cfg(target_os = "none")]
mod kept;
#[cfg(target_os = "none")]
mod lidar;
#[cfg(target_os = "none")]
mod link;
#[cfg(target_os = "none")]
mod liveness;
#[cfg(target_os = "none")]
mod mapping;
#[cfg(target_os = "none")]
mod measure;
#[cfg(all(target_os = "none", feature = "misbehaves"))]
mod orders;
#[cfg(target_os = "none")]
mod resets;
#[cfg(target_os = "none")]
mod robot;
#[cfg(target_os = "none")]
mod rtt;
#[cfg(target_os = "none")]
mod signs;
#[cfg(target_os = "none")]
mod stack;
#[cfg(target_os = "none")]
mod start;
#[cfg(target_os = "none")]
mod trace;

#[cfg(not(target_os = "none"))]
fn main() {
    eprintln!("error: this is the firmware; run `cargo xtask flash`, or `cargo xtask demo` without a board");
    std::process::exit(1);
}
