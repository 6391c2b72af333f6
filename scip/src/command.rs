//! What the host asks: every command, written as a line and read from one.
//!
//! The same lines come back as the echo that opens each reply, so the [`Decoder`](crate::Decoder) reads them too.

use heapless::Vec;

/// Longest optional text after a command.
pub const MAX_TEXT: usize = 16;
/// Longest line of a command: 15 characters of `MD`, `;`, the text, the line end.
pub const MAX_LINE: usize = 15 + 1 + MAX_TEXT + 1;

/// A command's line, line end included.
pub type Line = Vec<u8, MAX_LINE>;

/// Which steps a scan covers, and how they are grouped.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Steps {
    /// First step, 0 to 9999.
    pub first: u16,
    /// Last step, inclusive, not before the first.
    pub last: u16,
    /// So many neighbours become one value, the least of them, 0 to 99; 0 and 1 both leave every step its own.
    pub cluster: u8,
}

impl Steps {
    /// Number of values in the scan. Zero when the last step lies before the first.
    pub fn values(&self) -> usize {
        let steps = (usize::from(self.last) + 1).saturating_sub(usize::from(self.first));
        steps.div_ceil(usize::from(self.cluster.max(1)))
    }
}

/// A request for a stream of scans.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Stream {
    /// Which steps.
    pub steps: Steps,
    /// So many scans are left out between two, 0 to 9.
    pub interval: u8,
    /// How many scans, 0 to 99, 0 for "until `QT`". In the echo of a scan: how many are still to come.
    pub scans: u8,
}

/// Characters of one value.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Width {
    /// `MS` and `GS`: up to 4095 mm.
    Two,
    /// `MD` and `GD`: up to 262 143 mm.
    Three,
}

impl Width {
    /// As a number.
    pub const fn chars(self) -> usize {
        match self {
            Self::Two => 2,
            Self::Three => 3,
        }
    }
}

/// A command of SCIP 2.0. Names are the specification's.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Command {
    /// `SCIP2.0`: leave SCIP 1.1.
    Scip20,
    /// `BM`: laser on.
    Bm,
    /// `QT`: stop streaming, laser off.
    Qt,
    /// `RS`: laser off; motor speed, bit rate and timer as at power-up.
    Rs,
    /// `SS`: bit rate, in bit/s, up to 999 999.
    Ss(u32),
    /// `MD` and `MS`: a stream of new scans.
    M(Width, Stream),
    /// `GD` and `GS`: the newest scan, once.
    G(Width, Steps),
    /// `TM0`: into clock adjustment; scans stop.
    Tm0,
    /// `TM1`: what time is it?
    Tm1,
    /// `TM2`: out of clock adjustment.
    Tm2,
    /// `CR`: motor speed, 0 for the default, 1 to 10 for slower and slower, 99 for as at power-up.
    Cr(u8),
    /// `HS`: high sensitivity off and on.
    Hs(bool),
    /// `VV`: who are you?
    Vv,
    /// `PP`: geometry.
    Pp,
    /// `II`: how are you?
    Ii,
}

/// Optional text after a command: letters, digits, space, `.`, `_`, `+`, `@`, at most 16. The sensor echoes it.
#[derive(Clone, Copy, Default, PartialEq, Eq)]
pub struct Text {
    bytes: [u8; MAX_TEXT],
    len: u8,
}

impl Text {
    /// No text.
    pub const NONE: Self = Self { bytes: [0; MAX_TEXT], len: 0 };

    /// `None` if it is too long or has a character that is not allowed.
    pub fn new(text: &[u8]) -> Option<Self> {
        let mut this = Self { len: u8::try_from(text.len()).ok()?, ..Self::NONE };
        this.bytes.get_mut(..text.len())?.copy_from_slice(text);
        text.iter().all(|c| Self::allows(*c)).then_some(this)
    }

    fn allows(character: u8) -> bool {
        character.is_ascii_alphanumeric() || b" ._+@".contains(&character)
    }

    /// Its characters.
    pub fn as_bytes(&self) -> &[u8] {
        self.bytes.get(..usize::from(self.len)).unwrap_or(&[])
    }
}

impl core::fmt::Debug for Text {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        core::fmt::Debug::fmt(core::str::from_utf8(self.as_bytes()).unwrap_or(""), f)
    }
}

#[cfg(feature = "defmt")]
impl defmt::Format for Text {
    fn format(&self, f: defmt::Formatter<'_>) {
        defmt::write!(f, "{=[u8]:a}", self.as_bytes());
    }
}

/// A command with its text: a whole line.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Request {
    /// What is asked.
    pub command: Command,
    /// What the sensor shall echo.
    pub text: Text,
}

impl From<Command> for Request {
    fn from(command: Command) -> Self {
        Self { command, text: Text::NONE }
    }
}

/// Why a line is no command. Each has the status that a sensor answers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[non_exhaustive]
pub enum BadCommand {
    /// No such command.
    Undefined,
    /// Too few characters.
    TooShort,
    /// The parameter with this number, from 1, is not numeric or not one of those allowed.
    Parameter(u8),
    /// The text is longer than 16 characters.
    LongText,
    /// What follows the parameters is not `;` and allowed characters.
    BadText,
}

impl Request {
    /// The line, line end included. Parameters that do not fit their digits are cut to the greatest that does.
    pub fn line(&self) -> Line {
        let mut writer = LineWriter(Line::new());
        let w = &mut writer;
        match self.command {
            Command::Scip20 => w.text(b"SCIP2.0"),
            Command::Bm => w.text(b"BM"),
            Command::Qt => w.text(b"QT"),
            Command::Rs => w.text(b"RS"),
            Command::Ss(rate) => w.text(b"SS").number(rate, 6),
            Command::M(width, stream) => w
                .text(if width == Width::Three { b"MD" } else { b"MS" })
                .steps(&stream.steps)
                .number(stream.interval.into(), 1)
                .number(stream.scans.into(), 2),
            Command::G(width, steps) => {
                w.text(if width == Width::Three { b"GD" } else { b"GS" }).steps(&steps)
            }
            Command::Tm0 => w.text(b"TM0"),
            Command::Tm1 => w.text(b"TM1"),
            Command::Tm2 => w.text(b"TM2"),
            Command::Cr(speed) => w.text(b"CR").number(speed.into(), 2),
            Command::Hs(on) => w.text(b"HS").number(on.into(), 1),
            Command::Vv => w.text(b"VV"),
            Command::Pp => w.text(b"PP"),
            Command::Ii => w.text(b"II"),
        };
        if !self.text.as_bytes().is_empty() {
            w.text(b";").text(self.text.as_bytes());
        }
        w.text(b"\n");
        writer.0
    }

    /// Reads a line, without its line end.
    pub fn parse(line: &[u8]) -> Result<Self, BadCommand> {
        if let Some(rest) = line.strip_prefix(b"SCIP2.0") {
            return Ok(Self { command: Command::Scip20, text: text(rest)? });
        }
        let Some((symbol, rest)) = line.split_at_checked(2) else { return Err(BadCommand::TooShort) };
        let mut p = Parameters { rest, taken: 0 };
        let command = match symbol {
            b"BM" => Command::Bm,
            b"QT" => Command::Qt,
            b"RS" => Command::Rs,
            b"SS" => Command::Ss(p.number(6)?),
            b"MD" => Command::M(Width::Three, p.stream()?),
            b"MS" => Command::M(Width::Two, p.stream()?),
            b"GD" => Command::G(Width::Three, p.steps()?),
            b"GS" => Command::G(Width::Two, p.steps()?),
            b"TM" => *p.one_of(&[Command::Tm0, Command::Tm1, Command::Tm2])?,
            b"CR" => Command::Cr(p.number(2)? as u8),
            b"HS" => Command::Hs(*p.one_of(&[false, true])?),
            b"VV" => Command::Vv,
            b"PP" => Command::Pp,
            b"II" => Command::Ii,
            _ => return Err(BadCommand::Undefined),
        };
        Ok(Self { command, text: text(p.rest)? })
    }
}

struct LineWriter(Line);

impl LineWriter {
    fn text(&mut self, text: &[u8]) -> &mut Self {
        // `MAX_LINE` is the longest line there is.
        let fits = self.0.extend_from_slice(text);
        debug_assert!(fits.is_ok());
        self
    }

    fn number(&mut self, value: u32, digits: u32) -> &mut Self {
        let value = value.min(10u32.pow(digits) - 1);
        for place in (0..digits).rev() {
            self.text(&[b'0' + (value / 10u32.pow(place) % 10) as u8]);
        }
        self
    }

    fn steps(&mut self, steps: &Steps) -> &mut Self {
        self.number(steps.first.into(), 4).number(steps.last.into(), 4).number(steps.cluster.into(), 2)
    }
}

/// What follows a command's two letters.
struct Parameters<'a> {
    rest: &'a [u8],
    taken: u8,
}

impl Parameters<'_> {
    /// The next decimal number of so many digits.
    fn number(&mut self, digits: usize) -> Result<u32, BadCommand> {
        let (number, rest) = self.rest.split_at_checked(digits).ok_or(BadCommand::TooShort)?;
        self.taken += 1;
        self.rest = rest;
        number.iter().try_fold(0, |value, c| {
            if c.is_ascii_digit() {
                Ok(value * 10 + u32::from(c - b'0'))
            } else {
                Err(BadCommand::Parameter(self.taken))
            }
        })
    }

    fn one_of<'b, T>(&mut self, all: &'b [T]) -> Result<&'b T, BadCommand> {
        let index = self.number(1)?;
        all.get(index as usize).ok_or(BadCommand::Parameter(self.taken))
    }

    fn steps(&mut self) -> Result<Steps, BadCommand> {
        Ok(Steps {
            first: self.number(4)? as u16,
            last: self.number(4)? as u16,
            cluster: self.number(2)? as u8,
        })
    }

    fn stream(&mut self) -> Result<Stream, BadCommand> {
        // The numbers in the statuses skip 4 and 5, which are about steps out of range: interval is 6, scans 7.
        let steps = self.steps()?;
        self.taken = 5;
        Ok(Stream { steps, interval: self.number(1)? as u8, scans: self.number(2)? as u8 })
    }
}

/// The optional text at a line's end.
fn text(rest: &[u8]) -> Result<Text, BadCommand> {
    let text = match rest.split_first() {
        None => return Ok(Text::NONE),
        Some((b';', text)) => text,
        Some(_) => return Err(BadCommand::BadText),
    };
    if text.len() > MAX_TEXT {
        return Err(BadCommand::LongText);
    }
    Text::new(text).ok_or(BadCommand::BadText)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn all() -> impl Iterator<Item = Command> {
        let steps = Steps { first: 44, last: 725, cluster: 1 };
        let stream = Stream { steps, interval: 3, scans: 7 };
        [
            Command::Scip20,
            Command::Bm,
            Command::Qt,
            Command::Rs,
            Command::Ss(500_000),
            Command::M(Width::Three, stream),
            Command::M(Width::Two, stream),
            Command::G(Width::Three, steps),
            Command::G(Width::Two, steps),
            Command::Tm0,
            Command::Tm1,
            Command::Tm2,
            Command::Cr(99),
            Command::Hs(false),
            Command::Hs(true),
            Command::Vv,
            Command::Pp,
            Command::Ii,
        ]
        .into_iter()
    }

    #[test]
    fn lines_are_the_specification_s() {
        let lines: std::vec::Vec<_> = all()
            .map(|c| std::string::String::from_utf8(Request::from(c).line().to_vec()).unwrap())
            .collect();
        assert_eq!(
            lines.concat(),
            "SCIP2.0\nBM\nQT\nRS\nSS500000\nMD0044072501307\nMS0044072501307\nGD0044072501\nGS0044072501\n\
             TM0\nTM1\nTM2\nCR99\nHS0\nHS1\nVV\nPP\nII\n"
        );
    }

    #[test]
    fn what_is_written_is_read_with_and_without_text() {
        for command in all() {
            for text in [&b""[..], b"A b_.+@9", b"0123456789abcdef"] {
                let request = Request { command, text: Text::new(text).unwrap() };
                let line = request.line();
                assert_eq!(Request::parse(line.strip_suffix(b"\n").unwrap()), Ok(request));
            }
        }
    }

    #[test]
    fn what_is_wrong_with_a_line_is_said() {
        for (line, wrong) in [
            ("", BadCommand::TooShort),
            ("X", BadCommand::TooShort),
            ("XX", BadCommand::Undefined),
            ("MD", BadCommand::TooShort),
            ("MD00440725013", BadCommand::TooShort),
            ("MD004x072501307", BadCommand::Parameter(1)),
            ("MD0044 72501307", BadCommand::Parameter(2)),
            ("MD00440725-1307", BadCommand::Parameter(3)),
            ("MD0044072501x07", BadCommand::Parameter(6)),
            ("MD004407250130x", BadCommand::Parameter(7)),
            ("SS50000", BadCommand::TooShort),
            ("SS5000x0", BadCommand::Parameter(1)),
            ("TM3", BadCommand::Parameter(1)),
            ("HS2", BadCommand::Parameter(1)),
            ("BMx", BadCommand::BadText),
            ("BM;a-b", BadCommand::BadText),
            ("BM;0123456789abcdefg", BadCommand::LongText),
            ("SCIP2.0x", BadCommand::BadText),
        ] {
            assert_eq!(Request::parse(line.as_bytes()), Err(wrong), "{line}");
        }
    }

    #[test]
    fn groups_are_counted_as_the_sensor_sends_them() {
        let steps = |cluster| Steps { first: 44, last: 725, cluster };
        assert_eq!([0, 1, 2, 3, 99].map(|c| steps(c).values()), [682, 682, 341, 228, 7]);
        assert_eq!(Steps { first: 2, last: 1, cluster: 1 }.values(), 0);
    }
}
