//! What goes wrong in a run, on request.

use std::str::FromStr;

use rigless::emulator::{Host, Stop};
use rigless::session::Session;
use scip::sim::Quirks;

use crate::board::{Nucleo, Shared};
use crate::board_fault::BoardFault;
use crate::room::Room;

/// One fault. From the command line, seconds after `@` (when) and `+` (how long): `unplug@20+5` (plugged in again it powers up),
/// `garble=10000` (one byte in so many), `line=20` (noise and framing errors, so many in a million bytes each), `noise=1000` (noise
/// on one byte in so many, all of which are right), `start-noise=1000` (the same where the port cannot be told to overlook it),
/// `streaming=750000` (found so, at that bit rate), `good-to=115200` (above that bit rate the line spoils bytes), `reset@30` (by
/// pin), `dma-held@20+0.06` (the DMA that receives is), `held@20+0.06` (the core is, and the DMA goes on), `stamp-wrap` (its stamps
/// wrap after 20 s), `clock@20=-600000` (the sensor's clock is set ahead by so many milliseconds), `skew=10000` (it is so many parts
/// in a million fast), `slow=30000` (its revolutions take so many parts in a million longer), `quirk=cr-lf` (see
/// [`Quirks::EACH`]), `vcp-noise@20+5` (from the PC on the virtual COM port, as fast as it takes bytes).
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
    /// Noise on bytes that are right.
    Noise {
        /// One in so many.
        one_in: u32,
        /// Whether the port raises its flag even with one sample for a bit.
        always: bool,
    },
    /// Above a bit rate the line spoils bytes.
    GoodTo {
        /// The bit rate.
        baud_rate: u32,
    },
    /// The DMA that receives, or the core, stands still.
    Held {
        /// When, microseconds.
        at_us: u64,
        /// How long, microseconds.
        for_us: u64,
        /// Whether the core, and not the DMA.
        core: bool,
    },
    /// The sensor's clock is set.
    Clock {
        /// When, microseconds.
        at_us: u64,
        /// Ahead by so many milliseconds.
        by_ms: i64,
    },
    /// The sensor's clock is fast.
    Skew {
        /// Parts per million.
        ppm: i32,
    },
    /// The sensor's motor is slow.
    Slow {
        /// Parts per million.
        ppm: i32,
    },
    /// The sensor departs from the specification.
    Quirk(Quirks),
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
    /// The PC sends noise on the virtual COM port, as fast as it takes bytes.
    VcpNoise {
        /// When, microseconds.
        at_us: u64,
        /// How long, microseconds.
        for_us: u64,
    },
    /// Stamps of the sensor wrap soon.
    StampWrap,
    /// Something of the board's own.
    Board(BoardFault),
}

impl FromStr for Fault {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let Some((name, value)) = text.split_once(['@', '=']) else {
            return if text == "stamp-wrap" { Ok(Self::StampWrap) } else { board_fault(text) };
        };
        let value = Value(value);
        Ok(match name {
            "unplug" => value.span().map(|(at_us, for_us)| Self::Unplug { at_us, for_us })?,
            "dma-held" => value.span().map(|(at_us, for_us)| Self::Held { at_us, for_us, core: false })?,
            "held" => value.span().map(|(at_us, for_us)| Self::Held { at_us, for_us, core: true })?,
            "vcp-noise" => value.span().map(|(at_us, for_us)| Self::VcpNoise { at_us, for_us })?,
            "reset" => Self::Reset { at_us: value.micros()? },
            "clock" => value
                .split('=')
                .and_then(|(at, by)| Ok(Self::Clock { at_us: at.micros()?, by_ms: by.number()? }))?,
            "garble" => Self::Garble { one_in: value.number()? },
            "line" => Self::Line { per_million: value.number()? },
            "noise" => Self::Noise { one_in: value.number()?, always: false },
            "start-noise" => Self::Noise { one_in: value.number()?, always: true },
            "streaming" => Self::Streaming { baud_rate: value.number()? },
            "good-to" => Self::GoodTo { baud_rate: value.number()? },
            "skew" => Self::Skew { ppm: value.number()? },
            "slow" => Self::Slow { ppm: value.number()? },
            "quirk" => Self::Quirk(value.quirk()?),
            _ => return board_fault(text),
        })
    }
}

fn board_fault(text: &str) -> Result<Fault, String> {
    text.parse().map(Fault::Board).map_err(|_| EXPECTED.into())
}

const EXPECTED: &str = "expected unplug@S+S, garble=N, line=N, noise=N, start-noise=N, streaming=BIT/S, good-to=BIT/S, reset@S, \
     dma-held@S+S, held@S+S, clock@S=MS, skew=PPM, slow=PPM, quirk=NAME, stamp-wrap, hse-dead, hse-dies@S, power@S=PERMILLE, sag@S+S, \
     probe-gone@S+S, hold@S+S, order@S=N or glitch=NS";

/// What stands behind a fault's name.
#[derive(Clone, Copy)]
struct Value<'a>(&'a str);

impl<'a> Value<'a> {
    fn number<N: FromStr<Err: std::fmt::Display>>(self) -> Result<N, String> {
        self.0.parse().map_err(|error| format!("'{}': {error}", self.0))
    }

    /// Seconds, as microseconds.
    fn micros(self) -> Result<u64, String> {
        Ok((self.number::<f64>()? * 1e6) as u64)
    }

    fn split(self, at: char) -> Result<(Value<'a>, Value<'a>), String> {
        let (one, other) = self.0.split_once(at).ok_or_else(|| format!("'{}' has no '{at}'", self.0))?;
        Ok((Value(one), Value(other)))
    }

    /// When and how long.
    fn span(self) -> Result<(u64, u64), String> {
        let (at, long) = self.split('+')?;
        Ok((at.micros()?, long.micros()?))
    }

    fn quirk(self) -> Result<Quirks, String> {
        let known = Quirks::EACH.iter().find(|(name, _)| *name == self.0);
        known.map(|(_, quirk)| *quirk).ok_or_else(|| {
            let names: Vec<&str> = Quirks::EACH.iter().map(|(name, _)| *name).collect();
            format!("there is no quirk '{}', only {}", self.0, names.join(", "))
        })
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
            Self::GoodTo { baud_rate } => room.urg.faults.good_to = baud_rate,
            Self::Skew { ppm } => room.urg.faults.drift_ppm = ppm,
            Self::Slow { ppm } => room.urg.faults.slow_ppm = ppm,
            Self::Quirk(quirks) => room.urg.quirks = quirks,
            Self::Unplug { .. }
            | Self::Line { .. }
            | Self::Noise { .. }
            | Self::VcpNoise { .. }
            | Self::Reset { .. }
            | Self::Held { .. }
            | Self::Clock { .. }
            | Self::Board(_) => {}
        }
    }

    /// What it is from the beginning, on the board.
    pub fn prepare_board(&self, board: &mut Nucleo, shared: &Shared, seed: u64) {
        match *self {
            Self::Line { per_million } => board.set_line_errors(per_million, per_million, seed),
            Self::Noise { one_in, .. } => {
                let errors = board.set_noise(one_in, seed);
                if let Ok(mut room) = shared.lock() {
                    room.flagged = Some(errors);
                }
            }
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
            Self::VcpNoise { at_us, for_us } if (at_us..at_us + for_us).contains(&now_us) => {
                let mut room = shared.lock().map_err(|_| anyhow::anyhow!("the simulation panicked"))?;
                room.vcp.noise(now_us, grid_us);
            }
            Self::Reset { at_us } if is_now(at_us) => {
                session.reset_by_pin(stop.at, stop.instruction_count, host);
            }
            Self::Noise { always: true, .. } => session.board_mut().sample_three_times(),
            Self::Held { at_us, for_us, core: true } if is_now(at_us) || is_now(at_us + for_us) => {
                host.hold(is_now(at_us));
            }
            // Each time: the firmware may let it go on.
            Self::Held { at_us, for_us, core: false } if (at_us..at_us + for_us).contains(&now_us) => {
                session.board_mut().hold_dma(stop.at, true);
            }
            Self::Held { at_us, for_us, core: false } if is_now(at_us + for_us) => {
                session.board_mut().hold_dma(stop.at, false);
            }
            Self::Clock { at_us, by_ms } if is_now(at_us) => {
                let mut room = shared.lock().map_err(|_| anyhow::anyhow!("the simulation panicked"))?;
                room.urg.shift_timer_ms(by_ms);
            }
            _ => {}
        }
        Ok(())
    }
}
