//! From bytes to events: the sensor's side of the conversation, read in whatever pieces it arrives.
//!
//! A reply is read line by line. Lines that lie whole in the bytes given are read where they are; one that is cut goes
//! into a buffer of [`LINE`] bytes. The values of a scan go straight into the caller's slice. Whatever does not fit is
//! dropped whole, counted by reason, and the next empty line or echo is a new beginning.
//!
//! A scan counts only when its empty line has come and all its sums were right. What a sum cannot see, bits 6 and 7 of
//! a byte, the alphabet and the length of lines do. Lines may end with LF or with CR LF.
//!
//! Lines of `VV`, `PP` and `II` are taken as sensors send them: the sum covers `KEY:value`, or the `;` too, or leaves out the
//! last character (see [`FieldSum`]), for a whole reply in the same way. A line with a sum that fits none is left out and
//! counted, and the reply goes on: some sensors have such a line in `VV` always. What is missing then is for
//! [`InfoBuilder`](crate::info::InfoBuilder) to say.

use crate::codec::{self, DATA_CHARS, FieldSum, six_bits, without_sum};
use crate::command::{Command, Request, Steps, Width};
use crate::reply::Status;

/// Longest line that is read. The longest of the URG series, product lines of `VV`, stay below 80.
pub const LINE: usize = 128;

/// A whole scan.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct ScanHead {
    /// The echo: for `MD` and `MS` it counts down the scans to come.
    pub request: Request,
    /// Steps it covers.
    pub steps: Steps,
    /// Number of values that went into the caller's slice.
    pub values: usize,
    /// The sensor's clock at step 0, milliseconds, 24 bits.
    pub stamp_ms: u32,
}

/// A line `KEY:value` of `VV`, `PP` or `II`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Field<'a> {
    /// `MODL`.
    pub key: &'a str,
    /// `URG-04LX(Hokuyo Automatic Co.,Ltd.)`.
    pub value: &'a str,
}

/// What the bytes said.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Event<'a> {
    /// A reply has ended that has nothing but a status; or the fields before it are complete.
    Reply {
        /// What was asked.
        request: Request,
        /// What the sensor says to it.
        status: Status,
    },
    /// The answer to `TM1`.
    Time {
        /// What was asked.
        request: Request,
        /// The sensor's clock, milliseconds, 24 bits.
        stamp_ms: u32,
    },
    /// A line of `VV`, `PP` or `II`; their [`Event::Reply`] follows.
    Field {
        /// What was asked.
        request: Request,
        /// The line.
        field: Field<'a>,
    },
    /// A scan; its values are in the caller's slice.
    Scan(ScanHead),
    /// A line `E` without an echo: SCIP 1.1 does not know what it was sent.
    Scip11,
}

/// How much was read and what was dropped, since the decoder was made. All wrap.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Counters {
    /// Scans decoded.
    pub scans: u32,
    /// Other replies decoded.
    pub replies: u32,
    /// Scans begun and dropped, for whatever reason.
    pub scans_dropped: u32,
    /// Lines whose sum is wrong.
    pub bad_sum: u32,
    /// Data lines with a character outside the alphabet.
    pub bad_character: u32,
    /// Lines of another form than their place in the reply asks for: cut, too long, or not expected.
    pub bad_form: u32,
    /// Lines where an echo should be.
    pub bad_echo: u32,
    /// Lines longer than [`LINE`].
    pub long_line: u32,
    /// Scans for which the caller's slice is too short.
    pub no_room: u32,
    /// Data lines with a right sum while out of step: somebody streams, at this bit rate.
    pub stray_data: u32,
}

/// Why a line was not taken.
#[derive(Clone, Copy)]
enum Wrong {
    Sum,
    Character,
    Form,
    Echo,
    Room,
}

/// Bytes in, events out. About 250 bytes of memory; it holds no scan.
///
/// ```
/// use scip::{Decoder, Event, Status};
///
/// let mut decoder = Decoder::new();
/// let mut ranges_mm = [0; 682];
/// let bytes = b"BM\n00P\n\n";
/// let (used, event) = decoder.feed(bytes, &mut ranges_mm);
/// assert_eq!(used, bytes.len());
/// assert!(matches!(event, Some(Event::Reply { status: Status::OK, .. })));
/// ```
#[derive(Debug)]
pub struct Decoder {
    line: [u8; LINE],
    len: usize,
    parser: Parser,
}

impl Default for Decoder {
    fn default() -> Self {
        Self::new()
    }
}

impl Decoder {
    /// Out of nothing: expects an echo.
    pub const fn new() -> Self {
        let parser = Parser { state: State::Echo, sure: true, counters: Counters::ZERO };
        Self { line: [0; LINE], len: 0, parser }
    }

    /// Reads bytes until an event or until they are used up. Returns how many were used and the event; call again with
    /// the rest. The values of a scan go into `ranges_mm`, first step first, which must be the same slice until the
    /// scan's event. They are codes below the sensor's least range; above 65 535 mm they stay there.
    ///
    /// Work: linear in the bytes.
    pub fn feed<'a>(&'a mut self, bytes: &'a [u8], ranges_mm: &mut [u16]) -> (usize, Option<Event<'a>>) {
        let mut used = 0;
        while let Some(rest) = bytes.get(used..)
            && !rest.is_empty()
        {
            let window = rest.get(..LINE - self.len).unwrap_or(rest);
            let end = window.iter().position(|&b| b == b'\n');
            let part = end.and_then(|n| window.get(..n)).unwrap_or(window);
            used += part.len() + usize::from(end.is_some());
            let direct = end.is_some() && self.len == 0;
            if !direct {
                self.append(part);
            }
            if end.is_none() {
                if self.len == LINE {
                    self.len = 0;
                    self.parser.overrun();
                }
                continue;
            }
            let whole = if direct { part } else { self.line.get(..self.len).unwrap_or(&[]) };
            let whole = whole.strip_suffix(b"\r").unwrap_or(whole);
            self.len = 0;
            match self.parser.take(whole, ranges_mm) {
                None => {}
                Some(Taken::Field(request)) => {
                    let len = whole.len();
                    let whole = if direct { part } else { &self.line };
                    let whole = whole.get(..len).unwrap_or(&[]);
                    // The parser has seen that the line has this form.
                    let event = field(whole).map(|field| Event::Field { request, field });
                    return (used, event);
                }
                Some(Taken::Reply(request, status)) => {
                    return (used, Some(Event::Reply { request, status }));
                }
                Some(Taken::Time(request, stamp_ms)) => {
                    return (used, Some(Event::Time { request, stamp_ms }));
                }
                Some(Taken::Scan(head)) => return (used, Some(Event::Scan(head))),
                Some(Taken::Scip11) => return (used, Some(Event::Scip11)),
            }
        }
        (used, None)
    }

    /// What was read and dropped so far.
    pub fn counters(&self) -> &Counters {
        &self.parser.counters
    }

    /// Forgets the reply that is being read, if any; what remains of it will be dropped. To be called where another
    /// slice will take the values, or the bit rate has changed.
    pub fn abandon(&mut self) {
        self.len = 0;
        self.parser.lost_scan();
        self.parser.state = State::Skip;
    }

    /// Whether values of a scan have gone into the caller's slice whose event is still to come.
    pub fn is_within_scan(&self) -> bool {
        matches!(self.parser.state, State::Data(_) | State::End(Ending::Scan(_)))
    }

    fn append(&mut self, part: &[u8]) {
        if let Some(room) = self.line.get_mut(self.len..self.len + part.len()) {
            room.copy_from_slice(part);
            self.len += part.len();
        }
    }
}

impl Counters {
    const ZERO: Self = Self {
        scans: 0,
        replies: 0,
        scans_dropped: 0,
        bad_sum: 0,
        bad_character: 0,
        bad_form: 0,
        bad_echo: 0,
        long_line: 0,
        no_room: 0,
        stray_data: 0,
    };
}

/// Some of the [`FieldSum`]s, a bit for each.
type FieldSums = u8;
/// All of them.
const ANY_SUM: FieldSums = FieldSums::MAX;

/// What line comes next.
#[derive(Clone, Copy, Debug)]
enum State {
    Echo,
    Status(Request),
    Stamp(Request),
    /// And which sums fitted all lines so far.
    Fields(Request, FieldSums),
    Data(Data),
    End(Ending),
    /// Out of step: until an empty line or an echo.
    Skip,
}

/// How a reply ends when the empty line comes.
#[derive(Clone, Copy, Debug)]
enum Ending {
    Reply(Request, Status),
    Time(Request, u32),
    Scan(ScanHead),
}

/// A scan whose values come in.
#[derive(Clone, Copy, Debug)]
struct Data {
    head: ScanHead,
    width: Width,
    /// Values written.
    filled: usize,
    /// A value cut by a line end: its bits, and how many characters are missing.
    partial: u32,
    missing: usize,
    /// Characters still to come, sums not counted.
    chars_left: usize,
    /// Length of the echo.
    echo: usize,
}

enum Taken {
    Reply(Request, Status),
    Time(Request, u32),
    Field(Request),
    Scan(ScanHead),
    Scip11,
}

#[derive(Debug)]
struct Parser {
    state: State,
    /// False where the echo was found behind garbage, so that it may be none.
    sure: bool,
    counters: Counters,
}

impl Parser {
    fn take(&mut self, line: &[u8], ranges_mm: &mut [u16]) -> Option<Taken> {
        // Data first: almost all lines are.
        if let State::Data(data) = &mut self.state {
            return match data.take(line, ranges_mm) {
                Ok(false) => None,
                Ok(true) => {
                    self.state = State::End(Ending::Scan(data.head));
                    None
                }
                Err(wrong) => self.fail(wrong, line),
            };
        }
        match self.state {
            State::Skip => self.resynchronise(line),
            State::Echo if line.is_empty() => None,
            State::Echo if line == b"E" => Some(Taken::Scip11),
            State::Echo => match Request::parse(line) {
                Ok(request) => self.go_on(State::Status(request)),
                Err(_) => self.fail(Wrong::Echo, line),
            },
            State::Status(request) => match Status::parse(line) {
                Some(status) => {
                    self.sure = true;
                    self.go_on(after_status(request, status))
                }
                None => self.fail(if line.len() == 3 { Wrong::Sum } else { Wrong::Form }, line),
            },
            State::Stamp(request) => match stamp(line) {
                Ok(stamp_ms) => match after_stamp(request, stamp_ms, ranges_mm.len()) {
                    Ok(next) => self.go_on(next),
                    Err(wrong) => self.fail(wrong, line),
                },
                Err(wrong) => self.fail(wrong, line),
            },
            State::Fields(request, _) if line.is_empty() => self.end(Ending::Reply(request, Status::OK)),
            State::Fields(request, sums) => match field_sums(line).map(|fitting| fitting & sums) {
                Ok(0) => {
                    self.counters.bad_sum = self.counters.bad_sum.wrapping_add(1);
                    None
                }
                Ok(fitting) => {
                    self.state = State::Fields(request, fitting);
                    Some(Taken::Field(request))
                }
                Err(wrong) => self.fail(wrong, line),
            },
            State::End(ending) if line.is_empty() => self.end(ending),
            State::End(_) => self.fail(Wrong::Form, line),
            State::Data(_) => None,
        }
    }

    fn go_on(&mut self, state: State) -> Option<Taken> {
        self.state = state;
        None
    }

    fn end(&mut self, ending: Ending) -> Option<Taken> {
        self.state = State::Echo;
        let (counter, taken) = match ending {
            Ending::Reply(request, status) => (&mut self.counters.replies, Taken::Reply(request, status)),
            Ending::Time(request, stamp) => (&mut self.counters.replies, Taken::Time(request, stamp)),
            Ending::Scan(head) => (&mut self.counters.scans, Taken::Scan(head)),
        };
        *counter = counter.wrapping_add(1);
        Some(taken)
    }

    /// Drops the reply; the line that was wrong may be the beginning of the next.
    fn fail(&mut self, wrong: Wrong, line: &[u8]) -> Option<Taken> {
        if self.sure {
            let counter = match wrong {
                Wrong::Sum => &mut self.counters.bad_sum,
                Wrong::Character => &mut self.counters.bad_character,
                Wrong::Form => &mut self.counters.bad_form,
                Wrong::Echo => &mut self.counters.bad_echo,
                Wrong::Room => &mut self.counters.no_room,
            };
            *counter = counter.wrapping_add(1);
        }
        self.lost_scan();
        self.resynchronise(line)
    }

    fn lost_scan(&mut self) {
        let scan = match self.state {
            State::Data(_) | State::End(Ending::Scan(_)) => true,
            State::Stamp(request) => is_for_scans(&request),
            _ => false,
        };
        self.counters.scans_dropped = self.counters.scans_dropped.wrapping_add(scan.into());
    }

    fn overrun(&mut self) {
        self.counters.long_line = self.counters.long_line.wrapping_add(1);
        self.lost_scan();
        self.state = State::Skip;
    }

    /// An empty line, or an echo at the end of a line whose beginning is garbage, begins anew.
    fn resynchronise(&mut self, line: &[u8]) -> Option<Taken> {
        self.sure = true;
        self.state = State::Skip;
        if line.is_empty() {
            self.state = State::Echo;
            return None;
        }
        let echo = (0..line.len()).find_map(|n| Request::parse(line.get(n..).unwrap_or(&[])).ok());
        if is_data(line) && !echo.is_some_and(|r| is_for_scans(&r)) {
            self.counters.stray_data = self.counters.stray_data.wrapping_add(1);
        } else if let Some(request) = echo {
            self.sure = false;
            self.state = State::Status(request);
        }
        None
    }
}

/// What a status tells of the lines to come.
fn after_status(request: Request, status: Status) -> State {
    let scan = match request.command {
        Command::M(..) => status == Status::SCAN,
        Command::G(..) | Command::Tm1 => status == Status::OK,
        Command::Vv | Command::Pp | Command::Ii if status == Status::OK => {
            return State::Fields(request, ANY_SUM);
        }
        _ => false,
    };
    if scan { State::Stamp(request) } else { State::End(Ending::Reply(request, status)) }
}

/// What a time stamp's request tells of the lines to come.
fn after_stamp(request: Request, stamp_ms: u32, room: usize) -> Result<State, Wrong> {
    let (width, steps) = match request.command {
        Command::M(width, stream) => (width, stream.steps),
        Command::G(width, steps) => (width, steps),
        _ => return Ok(State::End(Ending::Time(request, stamp_ms))),
    };
    let values = steps.values();
    if values == 0 {
        return Err(Wrong::Form);
    }
    if values > room {
        return Err(Wrong::Room);
    }
    let head = ScanHead { request, steps, values, stamp_ms };
    let chars = width.chars();
    let echo = request.line().len() - 1;
    Ok(State::Data(Data {
        head,
        width,
        filled: 0,
        partial: 0,
        missing: chars,
        chars_left: values * chars,
        echo,
    }))
}

fn stamp(line: &[u8]) -> Result<u32, Wrong> {
    if line.len() != 5 {
        return Err(Wrong::Form);
    }
    codec::decode(without_sum(line).ok_or(Wrong::Sum)?).ok_or(Wrong::Character)
}

fn is_for_scans(request: &Request) -> bool {
    matches!(request.command, Command::M(..) | Command::G(..))
}

/// Whether a line is a full data line.
fn is_data(line: &[u8]) -> bool {
    line.len() == DATA_CHARS + 1
        && without_sum(line).is_some_and(|data| data.iter().all(|&c| six_bits(c).is_some()))
}

impl Data {
    /// Takes a line; true when the scan has all its values.
    fn take(&mut self, line: &[u8], ranges_mm: &mut [u16]) -> Result<bool, Wrong> {
        let expected = self.chars_left.min(DATA_CHARS);
        let Some((&sum, data)) = line.split_last().filter(|(_, data)| data.len() == expected) else {
            return Err(Wrong::Form);
        };
        let (mut added, mut outside) = (0u8, 0u8);
        let (mut partial, mut missing) = (self.partial, self.missing);
        let mut slots = ranges_mm.get_mut(self.filled..).unwrap_or_default().iter_mut();
        for &c in data {
            added = added.wrapping_add(c);
            let bits = c.wrapping_sub(b'0');
            outside |= bits;
            partial = partial << 6 | u32::from(bits);
            missing -= 1;
            if missing == 0 {
                if let Some(slot) = slots.next() {
                    *slot = u16::try_from(partial).unwrap_or(u16::MAX);
                }
                (partial, missing) = (0, self.width.chars());
                self.filled += 1;
            }
        }
        if codec::close_sum(added) != sum {
            return Err(Wrong::Sum);
        }
        if outside >= 64 {
            return Err(Wrong::Character);
        }
        (self.partial, self.missing) = (partial, missing);
        if self.hides_echo(line) {
            return Err(Wrong::Form);
        }
        self.chars_left -= expected;
        Ok(self.chars_left == 0)
    }

    /// Whether a line ends in the echo of a scan: this one was cut, and the joint has a right length and sum by chance.
    fn hides_echo(&self, line: &[u8]) -> bool {
        let echo = line.len().checked_sub(self.echo).and_then(|n| line.get(n..));
        echo.and_then(|e| Request::parse(e).ok()).is_some_and(|r| is_for_scans(&r))
    }
}

/// The [`FieldSum`]s that fit a `KEY:value;S` line.
fn field_sums(line: &[u8]) -> Result<FieldSums, Wrong> {
    let [body @ .., b';', last] = line else { return Err(Wrong::Form) };
    field(line).ok_or(Wrong::Form)?;
    let fitting = FieldSum::ALL.into_iter().filter(|kind| kind.of(body) == *last);
    Ok(fitting.fold(0, |sums, kind| sums | kind.bit()))
}

/// Key and value of a `KEY:value;S` line.
fn field(line: &[u8]) -> Option<Field<'_>> {
    let [body @ .., b';', _] = line else { return None };
    let text = core::str::from_utf8(body).ok().filter(|t| t.is_ascii())?;
    let (key, value) = text.split_once(':')?;
    Some(Field { key, value })
}
