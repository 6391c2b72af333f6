//! `[encoders]`: how the microcontroller takes in the encoders' lines.

use serde::Deserialize;

use crate::toml_file::{Impossible, not_negative};

/// The longest filter of the board's timers: eight samples, 128 cycles of 90 MHz apart.
pub const LONGEST_FILTER_US: f32 = 11.3;

/// `[encoders]`. Logs know nothing of it, so a file may leave it out, or any of its keys.
#[derive(Clone, Copy, Debug, Deserialize, PartialEq)]
#[serde(deny_unknown_fields, default)]
pub struct EncoderInputs {
    /// Resistors of the microcontroller on both lines.
    pub pull: Pull,
    /// A pulse shorter than this does not count, microseconds. The board takes the next longer filter that it has. Each line must
    /// stand for longer between two of its edges, or ticks are lost: at `ticks_per_turn` N and n turns a second it stands
    /// for 2 / (N n).
    pub filter_us: f32,
}

impl Default for EncoderInputs {
    /// For open collectors, which pull down and leave the rest to a resistor: 40 kΩ in the microcontroller. The edge that
    /// it makes is slow, and noise on a slow edge is many edges.
    fn default() -> Self {
        Self { pull: Pull::Up, filter_us: 5.0 }
    }
}

/// Resistors on the lines. The numbers are those of the firmware's build.
#[derive(Clone, Copy, Debug, Deserialize, PartialEq, Eq)]
#[serde(rename_all = "lowercase")]
pub enum Pull {
    /// To ground.
    Down = -1,
    /// None: for encoders that drive both levels.
    None = 0,
    /// To the supply: for open collectors, and harmless where both levels are driven.
    Up = 1,
}

impl EncoderInputs {
    pub(crate) fn check(&self) -> Result<(), Impossible> {
        not_negative("encoders.filter_us", self.filter_us)?;
        if self.filter_us > LONGEST_FILTER_US {
            let reason =
                format!("{} is above {LONGEST_FILTER_US}, the longest that there is", self.filter_us);
            return Err(("encoders.filter_us".into(), reason));
        }
        Ok(())
    }
}
