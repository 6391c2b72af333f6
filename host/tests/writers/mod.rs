//! Small writers of bags: messages byte by byte, and the containers around them.
#![allow(dead_code)] // Each user needs its part.

use std::collections::BTreeMap;
use std::io::{Cursor, Write};
use std::path::Path;

/// How a message is encoded.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Coding {
    Ros1,
    Cdr,
}

/// A message in the making. CDR aligns each number to its size; ROS 1 does not.
pub struct Bytes {
    coding: Coding,
    bytes: Vec<u8>,
}

impl Bytes {
    pub fn new(coding: Coding) -> Self {
        let bytes = if coding == Coding::Cdr { vec![0, 1, 0, 0] } else { Vec::new() };
        Self { coding, bytes }
    }

    fn put(mut self, number: &[u8]) -> Self {
        while self.coding == Coding::Cdr && !(self.bytes.len() - 4).is_multiple_of(number.len()) {
            self.bytes.push(0);
        }
        self.bytes.extend_from_slice(number);
        self
    }

    fn u32(self, value: u32) -> Self {
        self.put(&value.to_le_bytes())
    }

    fn f32s(mut self, values: &[f32]) -> Self {
        for value in values {
            self = self.put(&value.to_le_bytes());
        }
        self
    }

    fn f64s(mut self, values: &[f64]) -> Self {
        for value in values {
            self = self.put(&value.to_le_bytes());
        }
        self
    }

    fn text(mut self, text: &str) -> Self {
        let terminated = if self.coding == Coding::Cdr { format!("{text}\0") } else { text.into() };
        self = self.u32(terminated.len() as u32);
        self.bytes.extend_from_slice(terminated.as_bytes());
        self
    }

    fn header(mut self, stamp_ns: u64, frame: &str) -> Self {
        if self.coding == Coding::Ros1 {
            self = self.u32(7);
        }
        self.u32((stamp_ns / 1_000_000_000) as u32).u32((stamp_ns % 1_000_000_000) as u32).text(frame)
    }
}

/// A LaserScan.
#[derive(Clone, Debug)]
pub struct Scan {
    pub stamp_ns: u64,
    pub frame: &'static str,
    pub angles: [f32; 3],
    pub time_increment: f32,
    pub limits: [f32; 2],
    pub ranges: Vec<f32>,
}

impl Scan {
    pub fn bytes(&self, coding: Coding) -> Vec<u8> {
        let [from, to, step] = self.angles;
        let [least, most] = self.limits;
        Bytes::new(coding)
            .header(self.stamp_ns, self.frame)
            .f32s(&[from, to, step, self.time_increment, 0.1, least, most])
            .u32(self.ranges.len() as u32)
            .f32s(&self.ranges)
            .u32(0)
            .bytes
    }
}

/// A rotation about x, then about z, as x, y, z, w.
pub fn quaternion(roll: f64, yaw: f64) -> [f64; 4] {
    let ((sr, cr), (sy, cy)) = ((0.5 * roll).sin_cos(), (0.5 * yaw).sin_cos());
    [cy * sr, sy * sr, sy * cr, cy * cr]
}

pub fn odometry(coding: Coding, stamp_ns: u64, child: &str, [x, y, yaw]: [f64; 3]) -> Vec<u8> {
    Bytes::new(coding)
        .header(stamp_ns, "odom")
        .text(child)
        .f64s(&[x, y, 0.0])
        .f64s(&quaternion(0.0, yaw))
        .f64s(&[0.0; 36 + 6 + 36])
        .bytes
}

/// A transform of a TFMessage: parent, child, x y z, rotation.
pub type Link<'a> = (&'a str, &'a str, [f64; 3], [f64; 4]);

pub fn transforms(coding: Coding, stamp_ns: u64, links: &[Link]) -> Vec<u8> {
    let mut bytes = Bytes::new(coding).u32(links.len() as u32);
    for (parent, child, at, rotation) in links {
        bytes = bytes.header(stamp_ns, parent).text(child).f64s(at).f64s(rotation);
    }
    bytes.bytes
}

pub fn joints(coding: Coding, stamp_ns: u64, named: &[(&str, f64)]) -> Vec<u8> {
    let mut bytes = Bytes::new(coding).header(stamp_ns, "").u32(named.len() as u32);
    for (name, _) in named {
        bytes = bytes.text(name);
    }
    bytes = bytes.u32(named.len() as u32);
    for (_, position) in named {
        bytes = bytes.f64s(&[*position]);
    }
    bytes.u32(0).u32(0).bytes
}

/// A message of a bag.
#[derive(Clone, Debug)]
pub struct Recorded {
    pub topic: &'static str,
    /// Its type, without ROS 2's `msg/`.
    pub kind: &'static str,
    pub time_ns: u64,
    pub bytes: Vec<u8>,
}

pub const SCAN: &str = "sensor_msgs/LaserScan";
pub const ODOMETRY: &str = "nav_msgs/Odometry";
pub const TF: &str = "tf2_msgs/TFMessage";
pub const JOINTS: &str = "sensor_msgs/JointState";

pub fn recorded(topic: &'static str, kind: &'static str, time_ns: u64, bytes: Vec<u8>) -> Recorded {
    Recorded { topic, kind, time_ns, bytes }
}

/// How a ROS 1 bag is written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Chunks {
    None,
    Bz2,
    Lz4,
}

pub fn record(fields: &[(&str, &[u8])], data: &[u8]) -> Vec<u8> {
    let mut header = Vec::new();
    for (name, value) in fields {
        header.extend_from_slice(&((name.len() + 1 + value.len()) as u32).to_le_bytes());
        header.extend_from_slice(name.as_bytes());
        header.push(b'=');
        header.extend_from_slice(value);
    }
    let mut record = (header.len() as u32).to_le_bytes().to_vec();
    record.extend_from_slice(&header);
    record.extend_from_slice(&(data.len() as u32).to_le_bytes());
    record.extend_from_slice(data);
    record
}

pub fn connection(number: usize, message: &Recorded) -> Vec<u8> {
    let number = (number as u32).to_le_bytes();
    let data = record(&[("topic", message.topic.as_bytes()), ("type", message.kind.as_bytes())], &[]);
    let fields: [(&str, &[u8]); 3] = [("conn", &number), ("op", &[7]), ("topic", message.topic.as_bytes())];
    // Of the inner record only the fields are data.
    record(&fields, &data[4..data.len() - 4])
}

pub fn message_record(number: usize, message: &Recorded) -> Vec<u8> {
    let number = (number as u32).to_le_bytes();
    let mut time = ((message.time_ns / 1_000_000_000) as u32).to_le_bytes().to_vec();
    time.extend_from_slice(&((message.time_ns % 1_000_000_000) as u32).to_le_bytes());
    record(&[("conn", &number), ("op", &[2]), ("time", &time)], &message.bytes)
}

pub fn chunk(chunks: Chunks, data: &[u8]) -> Vec<u8> {
    let (name, compressed): (&[u8], Vec<u8>) = match chunks {
        Chunks::None => (b"none", data.to_vec()),
        Chunks::Bz2 => {
            let mut encoder = bzip2::write::BzEncoder::new(Vec::new(), bzip2::Compression::default());
            encoder.write_all(data).unwrap();
            (b"bz2", encoder.finish().unwrap())
        }
        Chunks::Lz4 => {
            let mut encoder = lz4_flex::frame::FrameEncoder::new(Vec::new());
            encoder.write_all(data).unwrap();
            (b"lz4", encoder.finish().unwrap())
        }
    };
    let size = (data.len() as u32).to_le_bytes();
    record(&[("compression", name), ("op", &[5]), ("size", &size)], &compressed)
}

/// The version and the bag's header.
pub fn bag_header(index_at: u64) -> Vec<u8> {
    let mut bag = b"#ROSBAG V2.0\n".to_vec();
    let index_at = index_at.to_le_bytes();
    bag.extend(record(&[("op", &[3]), ("index_pos", &index_at)], &[b' '; 200]));
    bag
}

/// A ROS 1 bag of so many messages a chunk, with an index after each chunk and at the end.
pub fn ros1(messages: &[Recorded], chunks: Chunks, per_chunk: usize) -> Vec<u8> {
    let mut connections: Vec<&Recorded> = Vec::new();
    let mut parts = Vec::new();
    for messages in messages.chunks(per_chunk) {
        let mut data = Vec::new();
        for message in messages {
            let number = connections.iter().position(|c| c.topic == message.topic).unwrap_or_else(|| {
                data.extend(connection(connections.len(), message));
                connections.push(message);
                connections.len() - 1
            });
            data.extend(message_record(number, message));
        }
        parts.extend(chunk(chunks, &data));
        parts.extend(record(&[("op", &[4]), ("ver", &[1, 0, 0, 0]), ("count", &[1, 0, 0, 0])], &[0; 12]));
    }
    let index_at = (bag_header(0).len() + parts.len()) as u64;
    let mut bag = bag_header(index_at);
    bag.extend(parts);
    for (number, message) in connections.iter().enumerate() {
        bag.extend(connection(number, message));
    }
    bag.extend(record(&[("op", &[6]), ("ver", &[1, 0, 0, 0])], &[0; 8]));
    bag
}

/// The type as ROS 2 names it.
fn kind2(kind: &str) -> String {
    kind.replace('/', "/msg/")
}

/// An MCAP file.
pub fn mcap_file(messages: &[Recorded], compression: Option<mcap::Compression>, coding: Coding) -> Vec<u8> {
    let mut file = Cursor::new(Vec::new());
    let options = mcap::WriteOptions::new().compression(compression).chunk_size(Some(2000));
    let mut writer = options.create(&mut file).unwrap();
    let mut channels = BTreeMap::new();
    for (sequence, message) in messages.iter().enumerate() {
        let channel_id = *channels.entry(message.topic).or_insert_with(|| {
            let (kind, schema, encoding) = match coding {
                Coding::Cdr => (kind2(message.kind), "ros2msg", "cdr"),
                Coding::Ros1 => (message.kind.to_string(), "ros1msg", "ros1"),
            };
            let schema = writer.add_schema(&kind, schema, b"").unwrap();
            writer.add_channel(schema, message.topic, encoding, &BTreeMap::new()).unwrap()
        });
        let (log_time, publish_time) = (message.time_ns, message.time_ns);
        let header =
            mcap::records::MessageHeader { channel_id, sequence: sequence as u32, log_time, publish_time };
        writer.write_to_known_channel(&header, &message.bytes).unwrap();
    }
    writer.finish().unwrap();
    drop(writer);
    file.into_inner()
}

/// An SQLite file at `path`. Its rows stand in the order of `messages`, which need not be that of time.
pub fn db3(path: &Path, messages: &[Recorded], compressed: bool) {
    let database = rusqlite::Connection::open(path).unwrap();
    database
        .execute_batch(
            "PRAGMA page_size = 1024; CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL, \
             serialization_format TEXT NOT NULL, offered_qos_profiles TEXT NOT NULL); \
             CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL, timestamp INTEGER NOT NULL, \
             data BLOB NOT NULL); CREATE INDEX timestamp_idx ON messages (timestamp ASC); BEGIN",
        )
        .unwrap();
    let mut topics = Vec::new();
    for message in messages {
        let topic = topics.iter().position(|t| *t == message.topic).unwrap_or_else(|| {
            topics.push(message.topic);
            let row = (topics.len() as i64, message.topic, kind2(message.kind));
            database.execute("INSERT INTO topics VALUES (?, ?, ?, 'cdr', '')", row).unwrap();
            topics.len() - 1
        });
        let data = match compressed {
            true => zstd::stream::encode_all(message.bytes.as_slice(), 0).unwrap(),
            false => message.bytes.clone(),
        };
        let row = (topic as i64 + 1, message.time_ns as i64, data);
        database.execute("INSERT INTO messages (topic_id, timestamp, data) VALUES (?, ?, ?)", row).unwrap();
    }
    database.execute_batch("COMMIT").unwrap();
}

pub const SECOND: u64 = 1_000_000_000;
pub const START: u64 = 1_600_000_000 * SECOND;

/// Scan `k` of the drive.
pub fn scan(k: u64) -> Scan {
    Scan {
        stamp_ns: START + k * SECOND / 10,
        frame: "laser",
        angles: [-1.0, 1.0, 0.1],
        time_increment: 0.001,
        limits: [0.05, 8.0],
        ranges: (0..21).map(|i| 1.0 + 0.1 * i as f32 + 0.01 * k as f32).collect(),
    }
}

/// Where the laser is in the tree: upside down, a step to the left of the base link, which is ahead of the footprint.
pub fn links() -> [Link<'static>; 2] {
    [
        ("/base_footprint", "base_link", [0.1, 0.0, 0.0], quaternion(0.0, 0.0)),
        ("base_link", "/laser", [0.2, 0.05, 0.3], quaternion(std::f64::consts::PI, 0.5)),
    ]
}

/// A drive of so many scans with an odometry pose after each, and one topic that is of no use.
pub fn drive(coding: Coding, scans: u64) -> Vec<Recorded> {
    let mut messages =
        vec![recorded("/chatter", "std_msgs/String", START, Bytes::new(coding).text("hello").bytes)];
    for k in 0..scans {
        let at = START + k * SECOND / 10;
        messages.push(recorded("/scan", SCAN, at + 5_000_000, scan(k).bytes(coding)));
        let pose = [0.1 * k as f64, -0.2, 0.01 * k as f64];
        messages.push(recorded(
            "/odom",
            ODOMETRY,
            at + 6_000_000,
            odometry(coding, at + 1_000, "base_footprint", pose),
        ));
        if k == 1 {
            // After the first scans: what holds them is put in at the end.
            messages.push(recorded("/tf_static", TF, at + 7_000_000, transforms(coding, at, &links())));
        }
    }
    messages
}
