//! MCAP files (<https://mcap.dev/spec>): between two magics, records of
//!
//! ```text
//!  opcode u8 │ length u64 │ data
//! ```
//!
//! The records of a chunk are walked as they are decompressed, so that of a file that was cut even the chunk that was cut is
//! used. The summary at the end is not needed.
//!
//! What is in a record is read by the crate `mcap`. Its `LinearReader` is not used: of a chunk that is not compressed and
//! whose record is longer than itself it subtracts the lengths unchecked, it makes room for a record by the length that
//! the record claims, and of a chunk that was cut it gives nothing.

use std::collections::HashMap;
use std::io::Read;

use flate2::Crc;
use mcap::MAGIC;
use mcap::records::{ChunkHeader, Record, op};

use super::collect::{Collector, TopicId};
use super::input::Input;
use super::messages::Encoding;
use crate::log::LogError;

/// Before a record's data.
const HEAD: usize = 9;
/// A message's channel, number and two times.
const MESSAGE_HEAD: usize = 22;
/// No scan and no schema is longer than this.
const MOST_RECORD: u64 = 64 << 20;
/// No chunk is decompressed to more than this.
const MOST_CHUNK: u64 = 1 << 30;
/// From a chunk's begin to the name of its compression, and on to its data.
const BEFORE_NAME: usize = HEAD + 28;
const LONGEST_CHUNK_HEAD: usize = BEFORE_NAME + 4 + 64 + 8;

/// Walks a file of `total` bytes.
pub fn walk<R: Read>(file: R, total: u64, collector: &mut Collector<'_>) -> Result<(), LogError> {
    let mut input = Input::new(file);
    if input.peek(MAGIC.len()) != MAGIC {
        let what = "not an MCAP file: it does not begin with MCAP's magic".into();
        return Err(LogError::NotALog { path: collector.path.to_owned(), what });
    }
    input.advance(MAGIC.len());
    let mut walk = Walk { collector, schemas: HashMap::new(), channels: HashMap::new(), record: Vec::new() };
    walk.records(&mut input, Some(total), None)?;
    if let Some(error) = input.take_error() {
        collector.unreadable(input.position(), error)?;
    }
    Ok(())
}

/// Where the next chunk begins whose compression's name stands at `from` or later. A chunk that is not compressed is known by
/// its three lengths, which must agree.
fn recognise(window: &[u8], from: usize) -> Option<usize> {
    (from.max(BEFORE_NAME)..window.len().saturating_sub(12)).find_map(|at| {
        let start = at - BEFORE_NAME;
        if window[start] != op::CHUNK {
            return None;
        }
        let number = |at: usize| window.get(at..)?.first_chunk::<8>().map(|l| u64::from_le_bytes(*l));
        let (length, whole) = (number(start + 1)?, number(start + HEAD + 16)?);
        let is_plain = || {
            let size = number(at + 4);
            size == Some(whole) && size == length.checked_sub(40) && whole > 0
        };
        let is_chunk = match window[at..].first_chunk::<4>()? {
            [0, 0, 0, 0] => is_plain(),
            [4, 0, 0, 0] => window[at + 4..].starts_with(b"zstd"),
            [3, 0, 0, 0] => window[at + 4..].starts_with(b"lz4"),
            _ => false,
        };
        (is_chunk && length < u64::from(u32::MAX)).then_some(start)
    })
}

struct Walk<'c, 'o> {
    collector: &'c mut Collector<'o>,
    /// Names of types.
    schemas: HashMap<u16, String>,
    channels: HashMap<u16, TopicId>,
    /// The record at hand.
    record: Vec<u8>,
}

/// How walking ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum End {
    /// By the record that ends a file, or at the end of a chunk.
    Regular,
    /// Otherwise, which was said.
    Early,
}

impl Walk<'_, '_> {
    /// Walks records up to the end. `end` is where that must be, if it is known; `chunk`, where the chunk stands in the file
    /// that they are in.
    fn records<R: Read>(
        &mut self,
        input: &mut Input<R>,
        end: Option<u64>,
        chunk: Option<u64>,
    ) -> Result<End, LogError> {
        loop {
            let position = input.position();
            let place = chunk.unwrap_or(position);
            let head = input.peek(HEAD);
            let Some((&[opcode], &length)) =
                head.split_first_chunk().and_then(|(o, l)| Some((o, l.first_chunk()?)))
            else {
                return Ok(self.at_end(place, head.is_empty(), chunk.is_some()));
            };
            let length = u64::from_le_bytes(length);
            let left = end.map(|end| end.saturating_sub(position + HEAD as u64));
            let too_long = left.is_some_and(|left| length > left);
            match opcode {
                op::CHUNK if chunk.is_none() => {
                    self.chunk(input, length, left, position)?;
                    continue;
                }
                0 => self.collector.damaged(place, "no record begins here"),
                _ if too_long => {
                    self.collector.damaged(place, "a record is longer than the rest of the file")
                }
                op::FOOTER if chunk.is_none() => return Ok(End::Regular),
                _ => {
                    input.advance(HEAD);
                    if !self.record(input, opcode, length)? {
                        self.collector.damaged(place, "the file ends in the middle of a record");
                        return Ok(End::Early);
                    }
                    continue;
                }
            }
            input.advance(1);
            input.search(BEFORE_NAME, LONGEST_CHUNK_HEAD, recognise);
        }
    }

    fn at_end(&mut self, place: u64, is_between: bool, in_chunk: bool) -> End {
        if in_chunk && is_between {
            return End::Regular;
        }
        if is_between {
            self.collector
                .note("the recorder was stopped before it finished the file, or its end was cut off");
        } else {
            self.collector.damaged(place, "the file ends in the middle of a record");
        }
        End::Early
    }

    /// Takes in a record; `false` if it ends too soon.
    fn record<R: Read>(&mut self, input: &mut Input<R>, opcode: u8, length: u64) -> Result<bool, LogError> {
        match opcode {
            op::MESSAGE => self.message(input, length),
            op::SCHEMA | op::CHANNEL if length <= MOST_RECORD => {
                if !input.take_into(length, &mut self.record) {
                    return Ok(false);
                }
                match mcap::parse_record(opcode, &self.record) {
                    Ok(Record::Schema { header, .. }) => {
                        self.schemas.insert(header.id, header.name);
                    }
                    Ok(Record::Channel(channel)) => {
                        let kind = self.schemas.get(&channel.schema_id).map_or("unknown", String::as_str);
                        let encoding = Encoding::named(&channel.message_encoding);
                        let id = self.collector.topic(&channel.topic, kind, encoding);
                        self.channels.insert(channel.id, id);
                    }
                    _ => self.collector.records.skip("damaged"),
                }
                Ok(true)
            }
            _ => Ok(input.skip(length)),
        }
    }

    fn message<R: Read>(&mut self, input: &mut Input<R>, length: u64) -> Result<bool, LogError> {
        let channel = input.peek(2).first_chunk::<2>().map(|c| u16::from_le_bytes(*c));
        let Some(&id) = channel.and_then(|channel| self.channels.get(&channel)) else {
            // Its channel was in a part that is lost.
            self.collector.records.skip("damaged");
            return Ok(input.skip(length));
        };
        if !self.collector.wants(id) || length > MOST_RECORD {
            let whole = input.skip(length);
            self.collector.pass_over(id, usize::from(whole));
            return Ok(whole);
        }
        if !input.take_into(length, &mut self.record) {
            return Ok(false);
        }
        let Ok(Record::Message { header, .. }) = mcap::parse_record(op::MESSAGE, &self.record) else {
            self.collector.records.skip("damaged");
            return Ok(true);
        };
        let recorded_ns = i64::try_from(header.log_time).unwrap_or(i64::MAX);
        self.collector.message(id, recorded_ns, &self.record[MESSAGE_HEAD.min(self.record.len())..])?;
        Ok(true)
    }

    /// Walks the records of a chunk that begins at byte `at`, of `length` bytes after its head.
    fn chunk<R: Read>(
        &mut self,
        input: &mut Input<R>,
        length: u64,
        left: Option<u64>,
        at: u64,
    ) -> Result<(), LogError> {
        let Some((header, head)) = chunk_header(&input.peek(LONGEST_CHUNK_HEAD)[HEAD..]) else {
            self.collector.damaged(at, "a chunk's head makes no sense");
            input.advance(1);
            input.search(BEFORE_NAME, LONGEST_CHUNK_HEAD, recognise);
            return Ok(());
        };
        input.advance(HEAD + head);
        let begin = input.position();
        let too_long = left.is_some_and(|left| length > left);
        let compressed = (&mut *input).take(header.compressed_size);
        let failed = match header.compression.as_str() {
            "" => self.decompressed(compressed, &header, at)?,
            "lz4" => self.decompressed(lz4_flex::frame::FrameDecoder::new(compressed), &header, at)?,
            "zstd" => match zstd::stream::read::Decoder::with_buffer(compressed) {
                Ok(decoder) => self.decompressed(decoder, &header, at)?,
                Err(error) => Some(error.to_string()),
            },
            other => {
                Some(format!("a chunk is compressed as '{}', which cannot be read", other.escape_default()))
            }
        };
        if let Some(what) = failed {
            self.collector.damaged(at, what);
        }
        if too_long {
            // Where the next begins is not known.
            return Ok(());
        }
        let end = begin + length.saturating_sub(head as u64);
        input.skip(end.saturating_sub(input.position()));
        Ok(())
    }

    /// Walks what comes out of a decompressor; what is wrong with it, if it does not come to its end.
    fn decompressed(
        &mut self,
        decoder: impl Read,
        header: &ChunkHeader,
        at: u64,
    ) -> Result<Option<String>, LogError> {
        let mut crc = Crc::new();
        let most = header.uncompressed_size.min(MOST_CHUNK);
        let checked = Checked { inner: decoder.take(most), crc: &mut crc };
        // A decoder is a type of its own each; the walk is compiled once for all of them.
        let checked: Box<dyn Read + '_> = Box::new(checked);
        let mut inner = Input::new(checked);
        let damages = self.collector.damage.places;
        self.records(&mut inner, Some(most), Some(at))?;
        let (read, error) = (inner.position(), inner.take_error());
        drop(inner);
        if let Some(error) = error {
            return Ok(Some(format!("a chunk cannot be decompressed beyond {read} bytes: {error}")));
        }
        if self.collector.damage.places > damages {
            return Ok(None);
        }
        if read < header.uncompressed_size {
            return Ok(Some(format!("a chunk has {read} bytes of {}", header.uncompressed_size)));
        }
        let is_sound = header.uncompressed_crc == 0 || header.uncompressed_crc == crc.sum();
        Ok((!is_sound).then(|| "a chunk's checksum is wrong: its messages were used all the same".into()))
    }
}

/// A chunk's head and its length.
fn chunk_header(bytes: &[u8]) -> Option<(ChunkHeader, usize)> {
    let name_length = bytes.get(28..32)?.first_chunk::<4>().map(|l| u32::from_le_bytes(*l))?;
    let length = 28 + 4 + usize::try_from(name_length).ok()?.min(LONGEST_CHUNK_HEAD) + 8;
    // A record of a chunk without data.
    let mut head = bytes.get(..length)?.to_vec();
    let size = *head[length - 8..].first_chunk::<8>()?;
    head[length - 8..].fill(0);
    match mcap::parse_record(op::CHUNK, &head) {
        Ok(Record::Chunk { mut header, .. }) => {
            header.compressed_size = u64::from_le_bytes(size);
            Some((header, length))
        }
        _ => None,
    }
}

/// Bytes with a running checksum.
struct Checked<'a, R> {
    inner: R,
    crc: &'a mut Crc,
}

impl<R: Read> Read for Checked<'_, R> {
    fn read(&mut self, buffer: &mut [u8]) -> std::io::Result<usize> {
        let read = self.inner.read(buffer)?;
        self.crc.update(&buffer[..read]);
        Ok(read)
    }
}
