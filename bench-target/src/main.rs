//! What each stage of the core costs on the microcontroller.
//!
//! Counts with the cycle counter of the core (DWT) and prints through defmt, a line for each scan. On the emulated board
//! of `cargo xtask bench-target` every instruction takes one cycle, so what is counted is instructions; on a board it is
//! cycles. The clock is left as it is after a reset: from 16 MHz flash needs no wait states.
#![cfg_attr(target_os = "none", no_std, no_main)]

#[cfg(target_os = "none")]
mod on_target;

#[cfg(not(target_os = "none"))]
fn main() {
    println!("this is for the microcontroller; see `cargo xtask bench-target`");
}
