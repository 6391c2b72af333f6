//! Robot files, for whoever needs to know the robot: the command on a PC, the emulator, and the firmware when it is built.
#![cfg(not(target_os = "none"))]
#![forbid(unsafe_code)]
#![deny(missing_docs)]

pub mod encoders;
pub mod odometry;
pub mod profile;
pub mod robot;
pub mod sensor;
pub mod toml_file;
