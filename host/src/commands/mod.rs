//! The commands, one a file.

pub mod benchmark;
pub mod calibrate;
pub mod common;
pub mod connect;
pub mod experiments;
pub mod live;
pub mod log_args;
pub mod record;
pub mod replay;
pub mod scan;
pub mod score;
pub mod simulate;
pub mod start_args;
