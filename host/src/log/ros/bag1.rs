//! ROS 1 bags, version 2.0 (<http://wiki.ros.org/Bags/Format/2.0>): after a line with the version, records of
//!
//! ```text
//!  header length u32 │ fields: length u32, name=value │ data length u32 │ data
//! ```
//!
//! The records are walked in their order. Those in a chunk that is not compressed are walked as if there were no chunk, so
//! that nothing depends on its size; a compressed one is decompressed as it is walked. The index at the end is passed over.
//!
//! The crate `rosbag` maps the file and slices it by offsets that the file states, which panics where a recorder was killed,
//! and cannot go on behind damage; so the walk is written here.

use std::collections::HashMap;
use std::io::Read;

use super::collect::{Collector, TopicId};
use super::input::Input;
use super::messages::Encoding;
use crate::log::LogError;

const VERSION: &[u8] = b"#ROSBAG V2.0\n";
/// Headers are a few numbers and a name.
const MOST_HEADER: usize = 64 * 1024;
/// No scan and no list of transforms is longer than this.
const MOST_MESSAGE: u32 = 64 << 20;
/// No chunk is decompressed to more than this.
const MOST_CHUNK: u64 = 1 << 30;
/// Most bytes between the begin of a record and its field `op` by which it is found again.
const BEFORE_OP: usize = 512;

mod op {
    pub const MESSAGE: u8 = 2;
    pub const BAG: u8 = 3;
    pub const INDEX: u8 = 4;
    pub const CHUNK: u8 = 5;
    pub const CHUNK_INFO: u8 = 6;
    pub const CONNECTION: u8 = 7;
}

/// The fields of a record's header that matter.
#[derive(Debug, Default)]
struct Header {
    op: u8,
    connection: Option<u32>,
    time_ns: Option<i64>,
    topic: Option<String>,
    compression: Option<String>,
    /// Length of a chunk's data when decompressed.
    size: Option<u32>,
    index_at: Option<u64>,
}

impl Header {
    /// The fields, if that is what the bytes are.
    fn parse(mut bytes: &[u8]) -> Option<Self> {
        let mut header = Self::default();
        while !bytes.is_empty() {
            let (length, rest) = bytes.split_first_chunk::<4>()?;
            let (field, rest) = rest.split_at_checked(u32::from_le_bytes(*length) as usize)?;
            let equals = field.iter().position(|byte| *byte == b'=')?;
            header.set(&field[..equals], &field[equals + 1..])?;
            bytes = rest;
        }
        header.is_whole().then_some(header)
    }

    fn set(&mut self, name: &[u8], value: &[u8]) -> Option<()> {
        let number = || Some(u32::from_le_bytes(value.try_into().ok()?));
        let text = || Some(String::from_utf8_lossy(value).into_owned());
        match name {
            b"op" => self.op = *value.first()?,
            b"conn" => self.connection = Some(number()?),
            b"time" => {
                let (sec, nsec) = value.split_first_chunk::<4>()?;
                let nsec = u32::from_le_bytes(nsec.try_into().ok()?);
                self.time_ns = Some(i64::from(u32::from_le_bytes(*sec)) * 1_000_000_000 + i64::from(nsec));
            }
            b"topic" => self.topic = Some(text()?),
            b"compression" => self.compression = Some(text()?),
            b"size" => self.size = Some(number()?),
            b"index_pos" => self.index_at = Some(u64::from_le_bytes(value.try_into().ok()?)),
            _ => {}
        }
        Some(())
    }

    fn is_whole(&self) -> bool {
        match self.op {
            op::MESSAGE => self.connection.is_some() && self.time_ns.is_some(),
            op::CONNECTION => self.connection.is_some() && self.topic.is_some(),
            op::CHUNK => self.compression.is_some() && self.size.is_some(),
            op::BAG | op::INDEX | op::CHUNK_INFO => true,
            _ => false,
        }
    }
}

/// What comes next.
enum Next {
    /// A record; its data follow.
    Record(Header, u32),
    /// Bytes that are no record.
    Nonsense,
    /// A record that is not there to its end.
    Cut,
    /// Nothing.
    End,
}

fn next<R: Read>(input: &mut Input<R>) -> Next {
    let Some(length) = input.peek(4).first_chunk::<4>().map(|l| u32::from_le_bytes(*l) as usize) else {
        return if input.peek(1).is_empty() { Next::End } else { Next::Cut };
    };
    if length > MOST_HEADER {
        return Next::Nonsense;
    }
    let record = input.peek(length + 8);
    let Some((header, data)) = record.get(4..).and_then(|record| record.split_at_checked(length)) else {
        return Next::Cut;
    };
    let Some(header) = Header::parse(header) else { return Next::Nonsense };
    let Some(length_of_data) = data.first_chunk::<4>().map(|l| u32::from_le_bytes(*l)) else {
        return Next::Cut;
    };
    input.advance(length + 8);
    Next::Record(header, length_of_data)
}

/// Where the next message, connection or chunk begins whose field `op` is at `from` or later.
fn recognise(window: &[u8], from: usize) -> Option<usize> {
    for at in from..window.len().saturating_sub(7) {
        let is_op = &window[at..at + 7] == b"\x04\0\0\0op="
            && matches!(window.get(at + 7), Some(&(op::MESSAGE | op::CHUNK | op::CONNECTION)));
        // The header begins before it, by a length that leads to a sound header.
        let begin = |start: &usize| {
            let length = window[*start..].first_chunk::<4>().map(|l| u32::from_le_bytes(*l) as usize)?;
            let header = window.get(start + 4..)?.get(..length.min(MOST_HEADER))?;
            (start + 4 + length > at && Header::parse(header).is_some()).then_some(*start)
        };
        if is_op
            && let Some(start) =
                (at.saturating_sub(BEFORE_OP)..=at.saturating_sub(4)).rev().find_map(|s| begin(&s))
        {
            return Some(start);
        }
    }
    None
}

/// Walks a bag of `total` bytes.
pub fn walk<R: Read>(file: R, total: u64, collector: &mut Collector<'_>) -> Result<(), LogError> {
    let mut input = Input::new(file);
    let version = input.peek(VERSION.len());
    if version != VERSION {
        let version: String = String::from_utf8_lossy(version).chars().filter(|c| !c.is_control()).collect();
        let what = if version.starts_with("#ROSBAG V1") {
            format!("'{version}' is an old ROS bag: `rosbag fix` makes one of version 2.0 of it")
        } else {
            "not a ROS 1 bag: it does not begin with #ROSBAG V2.0".into()
        };
        return Err(LogError::NotALog { path: collector.path.to_owned(), what });
    }
    input.advance(VERSION.len());
    let mut walk = Walk { collector, connections: HashMap::new(), message: Vec::new() };
    walk.records(&mut input, Some(total), None)?;
    if let Some(error) = input.take_error() {
        collector.unreadable(input.position(), error)?;
    }
    Ok(())
}

struct Walk<'c, 'o> {
    collector: &'c mut Collector<'o>,
    connections: HashMap<u32, TopicId>,
    /// The message at hand.
    message: Vec<u8>,
}

impl Walk<'_, '_> {
    /// Walks records up to the end. `end` is where that must be, if it is known; `chunk`, where the compressed chunk stands
    /// in the file that they are in.
    fn records<R: Read>(
        &mut self,
        input: &mut Input<R>,
        end: Option<u64>,
        chunk: Option<u64>,
    ) -> Result<(), LogError> {
        loop {
            let position = input.position();
            let place = chunk.unwrap_or(position);
            match next(input) {
                Next::End => return Ok(()),
                Next::Cut => {
                    self.collector.damaged(place, "the file ends in the middle of a record");
                    return Ok(());
                }
                Next::Nonsense => {
                    self.collector.damaged(place, "no record begins here");
                    input.advance(1);
                    input.search(BEFORE_OP + 4, MOST_HEADER, recognise);
                }
                Next::Record(header, length) => {
                    let left = end.map(|end| end.saturating_sub(input.position()));
                    if header.op == op::CHUNK && chunk.is_none() {
                        self.chunk(input, &header, length, left, position)?;
                    } else if left.is_some_and(|left| u64::from(length) > left) {
                        self.collector.damaged(place, "a record is longer than the rest of the file");
                        input.search(BEFORE_OP + 4, MOST_HEADER, recognise);
                    } else if !self.record(input, header, length, end.unwrap_or(u64::MAX))? {
                        self.collector.damaged(place, "the file ends in the middle of a record");
                        return Ok(());
                    }
                }
            }
        }
    }

    /// Takes in a record that is no chunk; `false` if its data end too soon.
    fn record<R: Read>(
        &mut self,
        input: &mut Input<R>,
        header: Header,
        length: u32,
        total: u64,
    ) -> Result<bool, LogError> {
        match header.op {
            op::MESSAGE => return self.take_message(input, &header, length),
            op::CONNECTION if length <= MOST_MESSAGE => {
                if !input.take_into(length.into(), &mut self.message) {
                    return Ok(false);
                }
                self.connection(header);
                return Ok(true);
            }
            op::BAG => match header.index_at {
                Some(0) => self.collector.note("the recorder was stopped before it finished the bag"),
                Some(at) if at > total => {
                    let what = format!(
                        "the bag is cut: it has {total} bytes and its index would begin at byte {at}"
                    );
                    self.collector.note(what);
                }
                _ => {}
            },
            _ => {}
        }
        Ok(input.skip(length.into()))
    }

    /// A connection: its number, its topic, and in its data its type.
    fn connection(&mut self, header: Header) {
        let (Some(number), Some(topic)) = (header.connection, header.topic) else { return };
        let mut kind = String::new();
        let mut fields = self.message.as_slice();
        while let Some((length, rest)) = fields.split_first_chunk::<4>() {
            let Some((field, rest)) = rest.split_at_checked(u32::from_le_bytes(*length) as usize) else {
                break;
            };
            if let Some(value) = field.strip_prefix(b"type=") {
                kind = String::from_utf8_lossy(value).into_owned();
            }
            fields = rest;
        }
        let id = self.collector.topic(&topic, &kind, Encoding::Ros1);
        self.connections.insert(number, id);
    }

    fn take_message<R: Read>(
        &mut self,
        input: &mut Input<R>,
        header: &Header,
        length: u32,
    ) -> Result<bool, LogError> {
        let known = header.connection.and_then(|number| self.connections.get(&number).copied());
        let Some(id) = known else {
            // Its connection was in a part that is lost.
            self.collector.records.skip("damaged");
            return Ok(input.skip(length.into()));
        };
        if !self.collector.wants(id) || length > MOST_MESSAGE {
            let whole = input.skip(length.into());
            self.collector.pass_over(id, usize::from(whole));
            return Ok(whole);
        }
        if !input.take_into(length.into(), &mut self.message) {
            return Ok(false);
        }
        self.collector.message(id, header.time_ns.unwrap_or(0), &self.message)?;
        Ok(true)
    }

    /// Walks the records of a chunk that begins at byte `at`.
    fn chunk<R: Read>(
        &mut self,
        input: &mut Input<R>,
        header: &Header,
        length: u32,
        left: Option<u64>,
        at: u64,
    ) -> Result<(), LogError> {
        let compression = header.compression.as_deref().unwrap_or("none");
        if compression == "none" {
            return Ok(());
        }
        let size = u64::from(header.size.unwrap_or(0));
        // The recorder writes both sizes when a chunk is full: of one that it was killed in they are zero.
        let unfinished = length == 0 && size == 0;
        let too_long = left.is_some_and(|left| u64::from(length) > left);
        let begin = input.position();
        let bounds = if unfinished || too_long { u64::MAX } else { u64::from(length) };
        let most = if unfinished { MOST_CHUNK } else { size.min(MOST_CHUNK) };
        let compressed = (&mut *input).take(bounds);
        let failed = match compression {
            "bz2" => self.decompressed(bzip2::bufread::BzDecoder::new(compressed), most, at)?,
            "lz4" => self.decompressed(lz4_flex::frame::FrameDecoder::new(compressed), most, at)?,
            other => Some(format!("a chunk is compressed as '{other}', which no bag of version 2.0 is")),
        };
        let is_broken = failed.is_some();
        if let Some(what) = failed {
            self.collector.damaged(at, what);
        } else if too_long {
            self.collector.damaged(at, "a chunk is longer than the rest of the file");
        }
        if unfinished || too_long {
            // Where it ends is known only if it was whole.
            if is_broken {
                input.search(BEFORE_OP + 4, MOST_HEADER, recognise);
            }
            return Ok(());
        }
        let rest = (begin + u64::from(length)).saturating_sub(input.position());
        input.skip(rest);
        Ok(())
    }

    /// Walks what comes out of a decompressor; what is wrong with it, if it does not come to its end.
    fn decompressed(&mut self, decoder: impl Read, most: u64, at: u64) -> Result<Option<String>, LogError> {
        // A decoder is a type of its own each; the walk is compiled once for all of them.
        let decoder: Box<dyn Read + '_> = Box::new(decoder.take(most));
        let mut inner = Input::new(decoder);
        self.records(&mut inner, None, Some(at))?;
        Ok(inner.take_error().map(|error| {
            format!("a chunk cannot be decompressed beyond {} bytes: {error}", inner.position())
        }))
    }
}
