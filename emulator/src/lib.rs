//! The board in emulation: the ELF that is flashed, a URG on its UART, two encoders on its timers, a building around it.
//!
//! [`run::run`] runs a firmware; [`report`] judges what it left. Nothing of the map is computed here: trajectory and map
//! are read from the firmware.

pub mod bench;
pub mod board;
pub mod board_fault;
pub mod cycles;
pub mod fault;
pub mod firmware;
pub mod nmi;
pub mod paced;
pub mod record;
pub mod report;
pub mod room;
pub mod run;
pub mod vcp;
