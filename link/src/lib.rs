//! What robot and PC say to each other on the virtual COM port: messages, and the frames that carry them.
//!
//! ```text
//! robot: FromRobot ──► Sender ──► bytes on the wire ──► Receiver ──► FromRobot::decode :PC
//! PC:    Request   ──► Sender ──► bytes on the wire ──► Receiver ──► Request::decode   :robot
//! ```
//!
//! README.md says what the bytes are. Nothing here knows a port, a clock or a task; both ends are the same code. Poses are of `base` in
//! `map` (x and y in metres, heading in radians), stamps are microseconds on the robot's clock, which begins at its reset.
//!
//! To read: [`frame`], [`from_robot`], [`to_robot`], then [`ranges`] and [`map`], which two of the messages are made of.
#![no_std]
#![forbid(unsafe_code)]
#![deny(missing_docs)]

pub mod frame;
pub mod from_robot;
pub mod map;
pub mod ranges;
pub mod to_robot;

pub use frame::{BODY, FRAME, Receiver, Sender};
pub use from_robot::FromRobot;
pub use to_robot::{Command, Request, Streams};

/// Version of frames and messages. A frame of another version is counted and passed over.
pub const VERSION: u8 = 1;

/// Bit rate of the virtual COM port, bit/s; a byte is ten bits.
pub const BIT_RATE: u32 = 921_600;
