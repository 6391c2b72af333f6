//! The building: places along the way, and the loops that tie them.
//!
//! In: where the front end says the robot is, how well that was supported, the lines of the local map. Out: corrected poses of all
//! places. The local map knows the last metres; what lies farther back belongs to places, and is moved with them.

#![allow(dead_code, reason = "wired in by the commits that follow")]

mod chain;
mod factor;
mod lines;
mod solver;
mod twist;

pub use chain::{Anchor, Chain, Support};
pub use factor::LOOPS;
pub use lines::{PLACE_LINES, PlaceLine};
pub use solver::{Loop, Progress, Solver};
