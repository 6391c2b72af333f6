//! Messages on their way into an MCAP file, a channel for each topic.

use std::collections::{BTreeMap, HashMap};
use std::io::{Seek, Write};

use byteorder::LittleEndian;
use mcap::records::MessageHeader;

use super::definitions::definition;
use super::messages::{Header, Message, Time};

/// Topics whose last message whoever comes late gets too.
const KEPT: [&str; 4] = ["/tf_static", "/path", "/map", "/segments"];

/// The recording could not be made.
#[derive(Debug, thiserror::Error)]
pub enum RecordingError {
    /// A message has no CDR.
    #[error(transparent)]
    Message(#[from] cdr_encoding::Error),
    /// The file has no room for it.
    #[error(transparent)]
    File(#[from] mcap::McapError),
}

/// Whether the writer goes back to fill in a chunk's lengths.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Seeks {
    /// It does.
    Back,
    /// Chunks are made in memory and written whole, so that what is on disk is good at any instant.
    Never,
}

/// A file that is being written.
pub struct File<W: Write + Seek> {
    writer: mcap::Writer<W>,
    /// Number of each topic's channel, and its messages so far.
    channels: HashMap<&'static str, (u16, u32)>,
}

impl<W: Write + Seek> File<W> {
    pub fn new(to: W, seeks: Seeks) -> Result<Self, RecordingError> {
        let options = mcap::WriteOptions::new()
            .profile("ros2")
            .library(concat!("lineslam ", env!("CARGO_PKG_VERSION")))
            .disable_seeking(seeks == Seeks::Never)
            // The file shall not hang on the number of processors.
            .compression_threads(0);
        Ok(Self { writer: options.create(to)?, channels: HashMap::new() })
    }

    /// Writes a message, recorded at `ns`.
    pub fn write<M: Message>(
        &mut self,
        topic: &'static str,
        ns: u64,
        message: &M,
    ) -> Result<(), RecordingError> {
        if !self.channels.contains_key(topic) {
            let channel = self.open::<M>(topic)?;
            self.channels.insert(topic, (channel, 0));
        }
        // Little-endian CDR says so in four bytes, from behind which fields are aligned.
        let mut bytes = vec![0, 1, 0, 0];
        bytes.extend(cdr_encoding::to_vec::<_, LittleEndian>(message)?);
        let (channel_id, count) = self.channels.entry(topic).or_default();
        let header =
            MessageHeader { channel_id: *channel_id, sequence: *count, log_time: ns, publish_time: ns };
        *count += 1;
        Ok(self.writer.write_to_known_channel(&header, &bytes)?)
    }

    fn open<M: Message>(&mut self, topic: &str) -> Result<u16, RecordingError> {
        let name = M::TYPE.replacen('/', "/msg/", 1);
        let schema = self.writer.add_schema(&name, "ros2msg", definition(M::TYPE).as_bytes())?;
        let profile = [("offered_qos_profiles".to_owned(), quality_of_service(topic))];
        Ok(self.writer.add_channel(schema, topic, "cdr", &BTreeMap::from(profile))?)
    }

    /// Ends the chunk at hand and hands it to the system: what was written so far outlives this process.
    pub fn flush(&mut self) -> Result<(), RecordingError> {
        Ok(self.writer.flush()?)
    }

    /// Writes names and values that describe the file.
    pub fn describe(&mut self, name: &str, values: BTreeMap<String, String>) -> Result<(), RecordingError> {
        Ok(self.writer.write_metadata(&mcap::records::Metadata { name: name.into(), metadata: values })?)
    }

    pub fn finish(mut self) -> Result<W, RecordingError> {
        self.writer.finish()?;
        Ok(self.writer.into_inner())
    }
}

/// A topic's quality of service in the words of rosbag2, with the numbers that all its versions read: reliable, the last
/// messages kept, for latecomers too (1) or not (2), without limits in time.
fn quality_of_service(topic: &str) -> String {
    let (depth, durability) = if KEPT.contains(&topic) { (1, 1) } else { (10, 2) };
    let forever = "\n    sec: 9223372036\n    nsec: 854775807";
    format!(
        "- history: 1\n  depth: {depth}\n  reliability: 1\n  durability: {durability}\n  deadline:{forever}\n  \
         lifespan:{forever}\n  liveliness: 1\n  liveliness_lease_duration:{forever}\n  \
         avoid_ros_namespace_conventions: false"
    )
}

/// Stamps of logs whose unit was mistaken may be too large; they stay at the largest.
pub fn nanoseconds(stamp_us: u64) -> u64 {
    stamp_us.saturating_mul(1000)
}

pub fn header(ns: u64, frame_id: &str) -> Header<'_> {
    Header { stamp: Time::of_ns(ns), frame_id }
}
