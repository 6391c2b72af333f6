//! `lineslam` on a PC.
#![forbid(unsafe_code)]
#![deny(missing_docs)]

pub mod beams;
pub mod benchmark;
pub mod calibrate;
pub mod configuration;
pub mod emulated;
pub mod experiments;
pub mod link;
pub mod live;
pub mod log;
pub mod map_file;
pub mod output;
pub mod recording;
pub mod replay;
pub mod score;
pub mod serial;
pub mod sim;

pub use robot_file::{robot, toml_file};
