//! What the sensor answers: statuses, and replies written byte by byte. What reads them is the
//! [`Decoder`](crate::Decoder).

use crate::codec::{DATA_CHARS, FieldSum, encode, sum};
use crate::command::{BadCommand, Command, Request, Width};

/// The status of a reply: two characters, or one where SCIP 1.1 is spoken or left.
#[derive(Clone, Copy, PartialEq, Eq)]
pub struct Status {
    chars: [u8; 2],
    len: u8,
}

impl Status {
    /// `00`: done.
    pub const OK: Self = Self::new(*b"00");
    /// `99`: a scan follows.
    pub const SCAN: Self = Self::new(*b"99");
    /// `98`: measuring again after an error was verified.
    pub const RESUMED: Self = Self::new(*b"98");
    /// `10` of `GD` and `GS`: the laser is off.
    pub const LASER_OFF: Self = Self::new(*b"10");
    /// `0E`: undefined, or not now: what `QT` gets in clock adjustment.
    pub const UNDEFINED: Self = Self::new(*b"0E");
    /// `0` of `SCIP2.0`.
    pub const SCIP20: Self = Self { chars: *b"0 ", len: 1 };
    /// `E`: SCIP 1.1 does not know the command.
    pub const SCIP11_UNKNOWN: Self = Self { chars: *b"E ", len: 1 };

    /// A status of two characters.
    pub const fn new(chars: [u8; 2]) -> Self {
        Self { chars, len: 2 }
    }

    /// What a sensor answers to a line that is no command.
    pub fn of(bad: BadCommand) -> Self {
        match bad {
            BadCommand::Undefined => Self::UNDEFINED,
            BadCommand::TooShort => Self::new(*b"0C"),
            BadCommand::LongText => Self::new(*b"0G"),
            BadCommand::BadText => Self::new(*b"0H"),
            BadCommand::Parameter(number) => Self::new([b'0', b'0' + number.min(9)]),
        }
    }

    /// Reads a status line, sum included.
    pub fn parse(line: &[u8]) -> Option<Self> {
        match line {
            b"0" => Some(Self::SCIP20),
            b"E" => Some(Self::SCIP11_UNKNOWN),
            [a, b, s] if a.is_ascii_alphanumeric() && b.is_ascii_alphanumeric() && sum(&[*a, *b]) == *s => {
                Some(Self::new([*a, *b]))
            }
            _ => None,
        }
    }

    /// Its characters, without the sum.
    pub fn as_bytes(&self) -> &[u8] {
        self.chars.get(..usize::from(self.len)).unwrap_or(&self.chars)
    }

    /// As text: `00`.
    pub fn as_str(&self) -> &str {
        core::str::from_utf8(self.as_bytes()).unwrap_or("??")
    }

    /// Whether a command with this status did what it should, "already so" included.
    pub fn is_fine_for(&self, command: &Command) -> bool {
        matches!(
            (command, self.as_bytes()),
            (_, b"00")
                | (Command::Scip20, b"0")
                | (Command::Bm | Command::Tm0 | Command::Hs(_), b"02")
                | (Command::Ss(_) | Command::Cr(_) | Command::Tm2, b"03")
        )
    }
}

impl core::fmt::Debug for Status {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        write!(f, "Status({})", self.as_str())
    }
}

impl core::fmt::Display for Status {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str(self.as_str())
    }
}

#[cfg(feature = "defmt")]
impl defmt::Format for Status {
    fn format(&self, f: defmt::Formatter<'_>) {
        defmt::write!(f, "{=str}", self.as_str());
    }
}

/// Writes replies, a byte at a time, to wherever they go. A reply is a [`head`](Self::head), what belongs to its
/// command, and the [`end`](Self::end).
pub struct Writer<F: FnMut(u8)> {
    out: F,
}

impl<F: FnMut(u8)> Writer<F> {
    /// Every byte goes to `out`.
    pub fn new(out: F) -> Self {
        Self { out }
    }

    /// Echo and status.
    pub fn head(&mut self, request: &Request, status: Status) -> &mut Self {
        self.raw(&request.line()).status(status)
    }

    /// Echo of a line that is no command, and status.
    pub fn head_of_bad(&mut self, line: &[u8], status: Status) -> &mut Self {
        self.raw(line).raw(b"\n").status(status)
    }

    fn status(&mut self, status: Status) -> &mut Self {
        match status.as_bytes() {
            [one] => self.raw(&[*one, b'\n']),
            two => self.summed(two),
        }
    }

    /// A line `KEY:value;` of `VV`, `PP` and `II`. Its sum leaves out the `;`. What is beyond 128 characters is cut.
    pub fn field(&mut self, key: &str, value: &str) -> &mut Self {
        self.field_summed(key, value, FieldSum::Value)
    }

    /// The same, with a sum as some sensors make it.
    pub fn field_summed(&mut self, key: &str, value: &str, kind: FieldSum) -> &mut Self {
        let mut body = heapless::Vec::<u8, 128>::new();
        for &byte in key.as_bytes().iter().chain(b":").chain(value.as_bytes()) {
            if body.push(byte).is_err() {
                break;
            }
        }
        self.raw(&body).raw(&[b';', kind.of(&body), b'\n'])
    }

    /// A time stamp, of which the lowest 24 bits count, milliseconds.
    pub fn stamp(&mut self, stamp_ms: u32) -> &mut Self {
        self.summed(&encode::<4>(stamp_ms))
    }

    /// The values of a scan as data lines. What does not fit the width becomes the greatest that does.
    pub fn data(&mut self, values: impl Iterator<Item = u32>, width: Width) -> &mut Self {
        let mut line = [0; DATA_CHARS];
        let mut len = 0;
        for value in values {
            let value = value.min((1 << (6 * width.chars())) - 1);
            for &c in encode::<3>(value).iter().skip(3 - width.chars()) {
                if let Some(slot) = line.get_mut(len) {
                    *slot = c;
                }
                len += 1;
                if len == DATA_CHARS {
                    self.summed(&line);
                    len = 0;
                }
            }
        }
        match line.get(..len) {
            Some(rest) if !rest.is_empty() => self.summed(rest),
            _ => self,
        }
    }

    /// The empty line.
    pub fn end(&mut self) {
        self.raw(b"\n");
    }

    fn summed(&mut self, line: &[u8]) -> &mut Self {
        self.raw(line).raw(&[sum(line), b'\n'])
    }

    fn raw(&mut self, bytes: &[u8]) -> &mut Self {
        for &byte in bytes {
            (self.out)(byte);
        }
        self
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::command::{Steps, Stream};

    fn written(write: impl FnOnce(&mut Writer<&mut dyn FnMut(u8)>)) -> std::string::String {
        let mut bytes = std::vec::Vec::new();
        let mut push = |b| bytes.push(b);
        write(&mut Writer::new(&mut push));
        std::string::String::from_utf8(bytes).unwrap()
    }

    #[test]
    fn replies_are_the_specification_s() {
        let bm = Request::from(Command::Bm);
        assert_eq!(written(|w| w.head(&bm, Status::new(*b"02")).end()), "BM\n02R\n\n");
        assert_eq!(written(|w| w.head(&Command::Scip20.into(), Status::SCIP20).end()), "SCIP2.0\n0\n\n");
        assert_eq!(written(|w| w.head_of_bad(b"xy", Status::UNDEFINED).end()), "xy\n0Ee\n\n");
        let pp = written(|w| w.field("ARES", "1024").field("AMAX", "725").end());
        assert_eq!(pp, "ARES:1024;\\\nAMAX:725;o\n\n");
        let time = written(|w| w.head(&Command::Tm1.into(), Status::OK).stamp(6_968_830).end());
        assert_eq!(time, "TM1\n00P\nJUGnD\n\n");
    }

    #[test]
    fn a_full_scan_has_as_many_bytes_as_on_the_wire() {
        let bytes = |width, cluster| {
            let steps = Steps { first: 44, last: 725, cluster };
            let request = Command::M(width, Stream { steps, interval: 0, scans: 0 }).into();
            let values = (0..steps.values()).map(|i| i as u32);
            written(|w| w.head(&request, Status::SCAN).stamp(1).data(values, width).end()).len()
        };
        assert_eq!(
            [bytes(Width::Three, 1), bytes(Width::Two, 1), bytes(Width::Three, 2)],
            [2137, 1435, 1082]
        );
    }

    #[test]
    fn what_does_not_fit_becomes_the_greatest() {
        assert_eq!(written(|w| w.data([5000].into_iter(), Width::Two).end()), "ooN\n\n");
    }

    #[test]
    fn already_so_is_fine() {
        for (command, status) in
            [(Command::Bm, "02"), (Command::Cr(0), "03"), (Command::Ss(500_000), "03"), (Command::Qt, "00")]
        {
            assert!(
                Status::new(status.as_bytes().try_into().unwrap()).is_fine_for(&command),
                "{command:?} {status}"
            );
        }
        assert!(!Status::new(*b"01").is_fine_for(&Command::Bm));
        assert!(!Status::UNDEFINED.is_fine_for(&Command::Qt));
    }
}
