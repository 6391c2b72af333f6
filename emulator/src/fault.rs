//! What goes wrong in a run, on request.

use std::str::FromStr;

use rigless::emulator::{Host, Stop};
use rigless::session::Session;

use crate::board::{Nucleo, Shared};
use crate::board_fault::BoardFault;
use crate::room::Room;

/// One fault. From the command line: `unplug@20+5` (seconds: when, how long; plugged in again it powers up),
/// `garble=10000` (one byte in so many), `line=20` (noise and framing errors, so many in a million bytes each),
/// `streaming=750000` (found so, at that bit rate), `reset@30` (by pin), `stamp-wrap` (its stamps wrap after 20 s).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Fault {
    /// The sensor's plug is pulled, and put in again after a while.
    Unplug {
        /// When, microseconds.
        at_us: u64,
        /// How long, microseconds.
        for_us: u64,
    },
    /// Bytes from the sensor have a bit flipped.
    Garble {
        /// One in so many.
        one_in: u32,
    },
    /// Noise and framing errors on the line.
    Line {
        /// So many in a million bytes, each.
        per_million: u32,
    },
    /// The sensor streams already when the board starts.
    Streaming {
        /// Its bit rate.
        baud_rate: u32,
    },
    /// The reset pin is pulled low.
    Reset {
        /// When, microseconds.
        at_us: u64,
    },
    /// Stamps of the sensor wrap soon.
    StampWrap,
    /// Something of the board's own.
    Board(BoardFault),
}

impl FromStr for Fault {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let seconds = |s: &str| s.parse::<f64>().map(|s| (s * 1e6) as u64).map_err(|e| format!("'{s}': {e}"));
        let number = |s: &str| s.parse::<u32>().map_err(|e| format!("'{s}': {e}"));
        if let Some((at, long)) = text.strip_prefix("unplug@").and_then(|t| t.split_once('+')) {
            return Ok(Self::Unplug { at_us: seconds(at)?, for_us: seconds(long)? });
        }
        if let Some(n) = text.strip_prefix("garble=") {
            return Ok(Self::Garble { one_in: number(n)? });
        }
        if let Some(n) = text.strip_prefix("line=") {
            return Ok(Self::Line { per_million: number(n)? });
        }
        if let Some(n) = text.strip_prefix("streaming=") {
            return Ok(Self::Streaming { baud_rate: number(n)? });
        }
        if let Some(at) = text.strip_prefix("reset@") {
            return Ok(Self::Reset { at_us: seconds(at)? });
        }
        if text == "stamp-wrap" {
            return Ok(Self::StampWrap);
        }
        if let Ok(fault) = text.parse() {
            return Ok(Self::Board(fault));
        }
        Err("expected unplug@S+S, garble=N, line=N, streaming=BIT/S, reset@S, stamp-wrap, hse-dead, hse-dies@S, power@S=PERMILLE, \
             sag@S+S, probe-gone@S+S, hold@S+S, order@S=N or glitch=NS"
            .into())
    }
}

impl Fault {
    /// The board's own, if it is one.
    pub fn of_board(&self) -> Option<BoardFault> {
        match *self {
            Self::Board(fault) => Some(fault),
            _ => None,
        }
    }

    /// What it is from the beginning.
    pub fn prepare(&self, room: &mut Room, seed: u64) {
        match *self {
            Self::Garble { one_in } => room.urg.faults.garbled_one_in = one_in,
            Self::Streaming { baud_rate } => room.already_streaming(baud_rate, seed),
            // 20 s before the 24 bits are full.
            Self::StampWrap => room.urg.set_timer_ms(0, 0xFF_FFFF - 20_000),
            Self::Unplug { .. } | Self::Line { .. } | Self::Reset { .. } | Self::Board(_) => {}
        }
    }

    /// What it is from the beginning, on the board.
    pub fn prepare_board(&self, board: &mut Nucleo, seed: u64) {
        match *self {
            Self::Line { per_million } => board.set_line_errors(per_million, per_million, seed),
            Self::Board(fault) => fault.prepare(board),
            _ => {}
        }
    }

    /// What it does at an instant of the grid.
    pub fn at(
        &self,
        now_us: u64,
        grid_us: u64,
        session: &mut Session<Nucleo>,
        shared: &Shared,
        stop: Stop,
        host: &mut dyn Host,
    ) -> anyhow::Result<()> {
        let is_now = |at_us: u64| (at_us..at_us + grid_us).contains(&now_us);
        match *self {
            Self::Unplug { at_us, for_us } if is_now(at_us) || is_now(at_us + for_us) => {
                let mut room = shared.lock().map_err(|_| anyhow::anyhow!("the simulation panicked"))?;
                room.plugged = !is_now(at_us);
                if room.plugged {
                    room.urg.power_cycle(now_us);
                }
            }
            Self::Reset { at_us } if is_now(at_us) => {
                session.reset_by_pin(stop.at, stop.instruction_count, host);
            }
            _ => {}
        }
        Ok(())
    }
}
