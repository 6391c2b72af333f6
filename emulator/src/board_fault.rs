//! What goes wrong on the board itself: clock, supply, probe, button, and a firmware that is told to misbehave.

use std::str::FromStr;

use rand_core::Rng;
use rand_pcg::Pcg64;
use rigless::device::{Level, ResetCause};
use rigless::emulator::{Host, InterruptLine, Stop};
use rigless::session::Session;
use rigless::soc::Width;
use rigless::soc::stm32f427::generated::rcc::{Register as Rcc, csr};

use crate::board::{Nucleo, Shared};
use crate::room::Edge;

/// One fault. From the command line: `hse-dead` (the ST-LINK's clock never comes), `hse-dies@20` (it stops), `power@20=5` (power is
/// away; of a thousand bits of RAM, 5 are others afterwards), `sag@20+0.5` (the supply falls to 2.8 V and rises again),
/// `probe-gone@20+10` (nobody reads the log), `hold@20+4` (the button is held), `order@20=3` (the firmware of `misbehaves` is told
/// to), `glitch=1000` (pulses of so many nanoseconds beside one in 20 edges of the left encoder).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum BoardFault {
    /// The ST-LINK's clock never comes.
    HseDead,
    /// It stops.
    HseDies {
        /// When, microseconds.
        at_us: u64,
    },
    /// Power is away for a moment, at the sensor too.
    Power {
        /// When, microseconds.
        at_us: u64,
        /// Of a thousand bits of RAM, so many are others afterwards.
        flipped_permille: u32,
    },
    /// The supply falls to 2.8 V: no reset, but near it.
    Sag {
        /// When, microseconds.
        at_us: u64,
        /// How long, microseconds.
        for_us: u64,
    },
    /// Nobody reads the log, as where the probe is pulled.
    ProbeGone {
        /// When, microseconds.
        at_us: u64,
        /// How long, microseconds.
        for_us: u64,
    },
    /// The button is held.
    Hold {
        /// When, microseconds.
        at_us: u64,
        /// How long, microseconds.
        for_us: u64,
    },
    /// The firmware of the feature `misbehaves` is told to: `src/orders.rs` has the numbers.
    Order {
        /// When, microseconds.
        at_us: u64,
        /// What.
        order: u32,
    },
    /// Beside one in [`GLITCH_EVERY`] edges of the left encoder, the other line has a short pulse.
    Glitch {
        /// Its length, nanoseconds.
        width_ns: u64,
    },
}

/// One in so many edges has a glitch beside it.
const GLITCH_EVERY: usize = 20;
/// In the upper half of an order.
const ORDER_MAGIC: u64 = 0x4F52 << 16;
/// RAM that the firmware has.
const RAM: std::ops::Range<u64> = 0x2000_0000..0x2003_0000;
/// The supply, millivolts: as it should be, and above brown-out at level 3, where it stops.
const SUPPLY_MV: [u32; 2] = [3300, 2850];
/// Of the voltage detector.
const PVD: u16 = 1;

impl FromStr for BoardFault {
    type Err = ();

    fn from_str(text: &str) -> Result<Self, ()> {
        let us = |s: &str| s.parse::<f64>().map(|s| (s * 1e6) as u64).map_err(drop);
        let number = |s: &str| s.parse::<u32>().map_err(drop);
        let (name, rest) = text.split_once(['@', '=']).unwrap_or((text, ""));
        let span = || rest.split_once('+').ok_or(()).and_then(|(at, long)| Ok((us(at)?, us(long)?)));
        let valued = || rest.split_once('=').ok_or(()).and_then(|(at, value)| Ok((us(at)?, number(value)?)));
        Ok(match name {
            "hse-dead" => Self::HseDead,
            "hse-dies" => Self::HseDies { at_us: us(rest)? },
            "power" => valued().map(|(at_us, flipped_permille)| Self::Power { at_us, flipped_permille })?,
            "sag" => span().map(|(at_us, for_us)| Self::Sag { at_us, for_us })?,
            "probe-gone" => span().map(|(at_us, for_us)| Self::ProbeGone { at_us, for_us })?,
            "hold" => span().map(|(at_us, for_us)| Self::Hold { at_us, for_us })?,
            "order" => valued().map(|(at_us, order)| Self::Order { at_us, order })?,
            "glitch" => Self::Glitch { width_ns: u64::from(number(rest)?) },
            _ => return Err(()),
        })
    }
}

impl BoardFault {
    /// What it is from the beginning.
    pub fn prepare(self, board: &mut Nucleo) {
        if self == Self::HseDead {
            board.kill_hse();
        }
    }

    /// Whether the probe is away now.
    pub fn hides_log(self, now_us: u64) -> bool {
        matches!(self, Self::ProbeGone { at_us, for_us } if (at_us..at_us + for_us).contains(&now_us))
    }

    /// What it does at an instant of the grid. `order` is where the firmware looks for orders, if it does.
    pub fn at(
        self,
        now_us: u64,
        grid_us: u64,
        session: &mut Session<Nucleo>,
        host: &mut dyn Host,
        around: &mut Around<'_>,
    ) -> anyhow::Result<()> {
        let is_now = |at_us: u64| (at_us..at_us + grid_us).contains(&now_us);
        match self {
            Self::HseDies { at_us } if is_now(at_us) => session.board_mut().stop_hse(around.stop.at),
            Self::Power { at_us, flipped_permille } if is_now(at_us) => {
                decay(flipped_permille, host, around.rng)?;
                session.reset_by_pin(around.stop.at, around.stop.instruction_count, host);
                let (rcc, registers) = session.board_mut().mcu.clocks();
                let power = csr::PORRSTF.mask() | csr::BORRSTF.mask();
                rcc.restarted(ResetCause::Pin, registers.get(Rcc::Csr) | power, registers);
                around
                    .shared
                    .lock()
                    .map_err(|_| anyhow::anyhow!("the simulation panicked"))?
                    .urg
                    .power_cycle(now_us);
            }
            Self::Sag { at_us, for_us } if is_now(at_us) || is_now(at_us + for_us) => {
                let low = is_now(at_us);
                session.board_mut().mcu.set_supply(SUPPLY_MV[usize::from(low)]);
                // The part's model has no external interrupts.
                if low
                    && session.board_mut().pvd_armed
                    && let Some(line) = InterruptLine::new(PVD)
                {
                    session.pulse(line, host);
                }
            }
            Self::Hold { at_us, for_us } if is_now(at_us) || is_now(at_us + for_us) => {
                session.board_mut().press(around.stop.at, is_now(at_us));
            }
            Self::Order { at_us, order } if is_now(at_us) => {
                let place = around.order.ok_or_else(|| anyhow::anyhow!("this firmware takes no orders"))?;
                host.write(place, Width::W32, ORDER_MAGIC | u64::from(order))?;
            }
            _ => {}
        }
        Ok(())
    }

    /// What it adds to the edges of the next millisecond, which come after the lines' levels `before`.
    pub fn disturb(self, edges: &mut Vec<Edge>, before: [[Level; 2]; 2], seen: &mut usize) {
        let Self::Glitch { width_ns } = self else { return };
        let mut levels = before;
        let mut glitches = Vec::new();
        for edge in edges.iter() {
            let [was, is] = [levels[edge.side], edge.levels];
            levels[edge.side] = is;
            *seen += usize::from(edge.side == 0);
            if edge.side != 0 || !seen.is_multiple_of(GLITCH_EVERY) {
                continue;
            }
            // The line that stands is pulled over while the other changes: two edges for the decoder before that one, and after it.
            let changed = usize::from(was[0] == is[0]);
            let pulled = |mut levels: [Level; 2]| {
                levels[1 - changed] =
                    if levels[1 - changed] == Level::High { Level::Low } else { Level::High };
                levels
            };
            let half_ns = width_ns / 2;
            glitches.push(Edge { at_ns: edge.at_ns.saturating_sub(half_ns), levels: pulled(was), ..*edge });
            glitches.push(Edge { levels: pulled(is), ..*edge });
            glitches.push(Edge { at_ns: edge.at_ns + half_ns, ..*edge });
        }
        edges.extend(glitches);
        // Those of one instant stay in this order: the edge itself, then the line pulled over with it.
        edges.sort_by_key(|edge| edge.at_ns);
    }
}

/// What a fault may need besides board and memory.
pub struct Around<'a> {
    /// The instant.
    pub stop: Stop,
    /// The sensor.
    pub shared: &'a Shared,
    /// Where the firmware looks for orders.
    pub order: Option<u64>,
    /// Of all noise.
    pub rng: &'a mut Pcg64,
}

/// Changes bits of RAM.
fn decay(flipped_permille: u32, host: &mut dyn Host, rng: &mut Pcg64) -> anyhow::Result<()> {
    if flipped_permille == 0 {
        return Ok(());
    }
    for address in RAM.step_by(4) {
        let flipped =
            (0..32).filter(|_| rng.next_u32() % 1000 < flipped_permille).fold(0, |word, bit| word | 1 << bit);
        let word = host.read(address, Width::W32)?;
        host.write(address, Width::W32, word ^ flipped)?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_written_on_the_command_line_is_understood() {
        let parsed = |text: &str| text.parse::<BoardFault>();
        assert_eq!(parsed("hse-dead"), Ok(BoardFault::HseDead));
        assert_eq!(parsed("power@20=5"), Ok(BoardFault::Power { at_us: 20_000_000, flipped_permille: 5 }));
        assert_eq!(parsed("sag@1+0.5"), Ok(BoardFault::Sag { at_us: 1_000_000, for_us: 500_000 }));
        assert_eq!(parsed("order@20=3"), Ok(BoardFault::Order { at_us: 20_000_000, order: 3 }));
        assert_eq!(parsed("glitch=1000"), Ok(BoardFault::Glitch { width_ns: 1000 }));
        for wrong in ["hse", "power@20", "power=5", "sag@1", "glitch", "order@x=3"] {
            assert_eq!(parsed(wrong), Err(()), "{wrong}");
        }
    }

    #[test]
    fn a_glitch_pulls_the_other_line_over_while_one_changes() {
        let (low, high) = (Level::Low, Level::High);
        let edge = |at_ns, levels| Edge { at_ns, side: 0, levels };
        let mut edges = vec![edge(10_000, [high, low])];
        BoardFault::Glitch { width_ns: 1000 }.disturb(&mut edges, [[low; 2]; 2], &mut (GLITCH_EVERY - 1));
        let seen: Vec<_> = edges.iter().map(|e| (e.at_ns, e.levels)).collect();
        assert_eq!(
            seen,
            [(9_500, [low, high]), (10_000, [high, low]), (10_000, [high, high]), (10_500, [high, low])]
        );
    }
}
