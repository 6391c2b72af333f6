//! The commands, one a file.

pub mod calibrate;
pub mod common;
pub mod experiments;
pub mod replay;
pub mod scan;
pub mod simulate;
