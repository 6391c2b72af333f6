#![doc = include_str!("../README.md")]
#![cfg_attr(not(test), no_std)]
#![forbid(unsafe_code)]
#![warn(missing_docs)]
#![cfg_attr(
    not(test),
    deny(clippy::indexing_slicing, clippy::unwrap_used, clippy::expect_used, clippy::panic)
)]

pub mod client;
pub mod codec;
pub mod command;
pub mod decoder;
pub mod info;
pub mod rate;
pub mod reply;
#[cfg(feature = "sim")]
pub mod sim;
pub mod time;

pub use client::{Client, ClientConfig, ClientError, Clock, Scan, SerialPort};
pub use command::{Command, Request, Steps, Stream, Width};
pub use decoder::{Counters, Decoder, Event, Field, ScanHead};
pub use info::{InfoError, SensorInfo};
pub use reply::{Status, Writer};
