//! Frames: a body between zeros, with version, sequence number and check.
//!
//! ```text
//! 00 │ COBS of: version (1) │ sequence number (2) │ body (1 ..= 240) │ CRC-32 (4) │ 00
//! ```
//!
//! In: a message or bytes, in pieces of any size. Out: bytes, or the body of the next whole frame. Numbers are little-endian. The zero
//! before a frame ends what noise has left on the line.

use crc::{CRC_32_ISO_HDLC, Crc, Table};
use serde::Serialize;

use crate::VERSION;

/// Most bytes of a body.
pub const BODY: usize = 240;
/// Version and sequence number.
const HEADER: usize = 3;
const CHECK: usize = 4;
const RAW: usize = HEADER + BODY + CHECK;
/// Most bytes of a frame: what COBS adds to fewer than 254 bytes is one, and there are two zeros.
pub const FRAME: usize = RAW + 3;

/// That of Ethernet and zlib.
pub(crate) static CRC: Crc<u32, Table<1>> = Crc::<u32, Table<1>>::new(&CRC_32_ISO_HDLC);

/// A message does not fit into a frame; none of this crate is so large.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct TooLarge;

/// Makes frames and numbers them.
#[derive(Clone, Debug, Default)]
pub struct Sender {
    sequence: u16,
}

impl Sender {
    /// Writes the frame of a message. Returns its length, at most [`FRAME`]; where the message is too large nothing is sent and no
    /// number used.
    pub fn frame(&mut self, message: &impl Serialize, frame: &mut [u8; FRAME]) -> Result<usize, TooLarge> {
        let mut raw = [0; RAW];
        let (head, rest) = raw.split_at_mut(HEADER);
        let [low, high] = self.sequence.to_le_bytes();
        head.copy_from_slice(&[VERSION, low, high]);
        let room = rest.get_mut(..BODY).ok_or(TooLarge)?;
        let body = postcard::to_slice(message, room).map_err(|_| TooLarge)?.len();
        let (checked, rest) = raw.split_at_mut(HEADER + body);
        let check = rest.get_mut(..CHECK).ok_or(TooLarge)?;
        check.copy_from_slice(&CRC.checksum(checked).to_le_bytes());
        frame.fill(0);
        let (Some(source), Some(coded)) = (raw.get(..HEADER + body + CHECK), frame.get_mut(1..FRAME - 1))
        else {
            return Err(TooLarge);
        };
        let coded = cobs::try_encode(source, coded).map_err(|_| TooLarge)?;
        self.sequence = self.sequence.wrapping_add(1);
        Ok(coded + 2)
    }

    /// The number that the next frame gets.
    pub fn sequence(&self) -> u16 {
        self.sequence
    }
}

/// What came of the bytes received.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct ReceiveCounters {
    /// Whole frames.
    pub frames: u32,
    /// Pieces between zeros that are none: noise, or frames that were damaged.
    pub damaged: u32,
    /// Whole frames of another version.
    pub other_versions: u32,
    /// Frames that the sequence numbers show to be missing, damaged ones among them. A sender that begins anew shows none.
    pub missing: u32,
}

/// Finds frames in bytes. `N` is the largest that is expected, at most [`FRAME`]; longer ones count as damaged.
#[derive(Clone, Debug)]
pub struct Receiver<const N: usize = FRAME> {
    bytes: [u8; N],
    len: usize,
    too_long: bool,
    next: Option<u16>,
    counters: ReceiveCounters,
}

impl<const N: usize> Default for Receiver<N> {
    fn default() -> Self {
        Self { bytes: [0; N], len: 0, too_long: false, next: None, counters: ReceiveCounters::default() }
    }
}

impl<const N: usize> Receiver<N> {
    /// Counters since the start.
    pub fn counters(&self) -> ReceiveCounters {
        self.counters
    }

    /// Takes a byte; the body of the frame that it ends, if it ends one. Work: `N` steps at the most.
    pub fn push(&mut self, byte: u8) -> Option<&[u8]> {
        if byte != 0 {
            match self.bytes.get_mut(self.len) {
                Some(place) => {
                    *place = byte;
                    self.len += 1;
                }
                None => self.too_long = true,
            }
            return None;
        }
        let (len, too_long) = (core::mem::take(&mut self.len), core::mem::take(&mut self.too_long));
        if len == 0 && !too_long {
            return None;
        }
        let raw = self.bytes.get_mut(..len).filter(|_| !too_long).and_then(uncoded);
        let Some((version, sequence, body)) = raw else {
            self.counters.damaged = self.counters.damaged.wrapping_add(1);
            return None;
        };
        if version != VERSION {
            self.counters.other_versions = self.counters.other_versions.wrapping_add(1);
            return None;
        }
        self.counters.frames = self.counters.frames.wrapping_add(1);
        // Number 0 is that of a sender that has begun anew, or one in 65 536.
        if let Some(next) = self.next.filter(|_| sequence != 0) {
            let missing = u32::from(sequence.wrapping_sub(next));
            self.counters.missing = self.counters.missing.wrapping_add(missing);
        }
        self.next = Some(sequence.wrapping_add(1));
        Some(body)
    }
}

/// Version, sequence number and body of what stood between two zeros, if it is whole.
fn uncoded(bytes: &mut [u8]) -> Option<(u8, u16, &[u8])> {
    let report = cobs::decode_in_place(bytes).ok()?;
    let raw = bytes.get(..report)?;
    let (checked, check) = raw.split_last_chunk::<CHECK>()?;
    if CRC.checksum(checked) != u32::from_le_bytes(*check) {
        return None;
    }
    let ([version, low, high], body) = checked.split_first_chunk::<HEADER>()?;
    Some((*version, u16::from_le_bytes([*low, *high]), body))
}
