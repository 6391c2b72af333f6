//! Ranges of a scan, packed: as many bits for each as the largest of its frame needs.

use heapless::Vec;
use serde::{Deserialize, Serialize};

/// Ranges in one frame at the most; a scan of 682 beams takes seven frames.
pub const RANGES: usize = 98;
const BYTES: usize = RANGES * 2;

/// Some ranges, exactly as the scanner gave them.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Packed {
    count: u8,
    bits: u8,
    /// The first range in the lowest bits of the first byte; what is left of the last byte is zero.
    bytes: Vec<u8, BYTES>,
}

impl Packed {
    /// Packs ranges, no more than [`RANGES`] of them.
    pub fn of(ranges_mm: &[u16]) -> Self {
        let ranges_mm = ranges_mm.get(..RANGES).unwrap_or(ranges_mm);
        let bits = u16::BITS - ranges_mm.iter().fold(0, |all, range| all | range).leading_zeros();
        let mut packed = Self { count: ranges_mm.len() as u8, bits: bits as u8, bytes: Vec::new() };
        let (mut waiting, mut held) = (0u32, 0);
        for &range in ranges_mm {
            waiting |= u32::from(range) << held;
            held += bits;
            while held >= 8 {
                // There is room for 16 bits of each.
                let _ = packed.bytes.push(waiting as u8);
                (waiting, held) = (waiting >> 8, held - 8);
            }
        }
        if held > 0 {
            let _ = packed.bytes.push(waiting as u8);
        }
        packed
    }

    /// How many there are.
    pub fn len(&self) -> usize {
        usize::from(self.count)
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.count == 0
    }

    /// The ranges, millimetres or codes. None where the bytes are not those of so many ranges.
    pub fn ranges_mm(&self) -> Option<Vec<u16, RANGES>> {
        let bits = u32::from(self.bits);
        if bits > u16::BITS || self.bytes.len() != (self.len() * bits as usize).div_ceil(8) {
            return None;
        }
        let (mut waiting, mut held) = (0u32, 0);
        let mut bytes = self.bytes.iter();
        let mut ranges = Vec::new();
        for _ in 0..self.count {
            while held < bits {
                waiting |= u32::from(*bytes.next()?) << held;
                held += 8;
            }
            ranges.push((waiting & ((1 << bits) - 1)) as u16).ok()?;
            (waiting, held) = (waiting >> bits, held - bits);
        }
        Some(ranges)
    }
}
