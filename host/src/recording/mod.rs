//! What a robot says, kept: as an MCAP file from which a PC computes the bits that the robot computed, and as a plain log.
//!
//! ```text
//! robot ─► link::Client ─► [Recorder] ─► MCAP: each message as it came, and beside it what ROS 2 has messages for
//!                              │    └──► plain log: ticks and ranges
//!                              └─ [course]: what is missing          the reader of logs: [course] again
//! ```
//!
//! | topic | what |
//! |---|---|
//! | `/lineslam/link/v1` | the body of each of the robot's frames, see `link/README.md`; all that `replay` needs |
//! | `/scan`, `/joint_states`, `/pose`, `/tf`, `/tf_static` | scans, angles of the wheels, poses with covariance, `map` → `base_link` → `laser` |
//! | `/rosout` | events, and what was lost |
//!
//! A file is good at any instant: chunks are made in memory and written whole, twice a second.

pub mod course;
mod plain;
pub mod ros;

use std::collections::BTreeMap;
use std::fs::{File, OpenOptions};
use std::io::BufWriter;
use std::path::{Path, PathBuf};

use ::link::BODY;
use mcap::write::NoSeek;

use crate::link::from_robot::{Event, Hello, Pose, Ticks};
use crate::link::{Command, FromRobot, Streams, words};
use crate::output::mcap::file::{self, RecordingError, Seeks, nanoseconds};
use crate::output::mcap::messages::{Bytes, JointState, Log, Message};
use crate::output::mcap::{WHEELS, file::header};
use course::{Act, Gatherer, Missing, Step};
use plain::Plain;

/// The topic of what the robot said, in this version of the link; of this type, so that tools of ROS can play and convert it.
pub const LINK_TOPIC: &str = "/lineslam/link/v1";
/// Its type.
pub const LINK_TYPE: &str = Bytes::TYPE;
/// What is before the bytes of such a message: how it is encoded, no dimensions, no offset, and how many bytes there are.
const BEFORE_BODY: [u8; 12] = [0, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0];
/// What is recorded.
pub const STREAMS: Streams = Streams::DEFAULT.with(Streams::TICKS).with(Streams::SCANS);
/// A chunk is closed this often, microseconds: a kill costs no more.
const CHUNK_US: u64 = 500_000;
/// Room for a chunk, so that it goes out in one piece.
const CHUNK_BYTES: usize = 1 << 20;

/// Why a recording cannot be made, or not gone on with.
#[derive(Debug, thiserror::Error)]
pub enum RecordError {
    /// The file is there already.
    #[error("{} is there already; --force overwrites it", path.display())]
    Exists {
        /// Which.
        path: PathBuf,
    },
    /// The file cannot be made or written.
    #[error("{}", path.display())]
    Io {
        /// Which.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The MCAP file cannot be written.
    #[error("{}", path.display())]
    Mcap {
        /// Which.
        path: PathBuf,
        /// Why.
        source: RecordingError,
    },
}

/// What has been recorded so far.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Summary {
    /// Scans that came whole.
    pub scans: u64,
    /// Samples of the wheels.
    pub samples: u64,
    /// Poses.
    pub poses: u64,
    /// Runs of the robot: one, and one more for each reset.
    pub runs: u32,
    /// What did not come.
    pub missing: Missing,
    /// The robot had driven before the recording began, and its map of then is not in it.
    pub joined: bool,
    /// From the first message to the last, microseconds.
    pub span_us: u64,
}

/// A recording that is being made.
pub struct Recorder {
    path: PathBuf,
    mcap: file::File<NoSeek<BufWriter<File>>>,
    plain: Option<Plain>,
    gatherer: Gatherer,
    summary: Summary,
    first_us: Option<u64>,
    last_us: u64,
    flushed_us: u64,
}

impl Recorder {
    /// Makes the files. One that is there is an error, unless it may be overwritten.
    pub fn create(path: &Path, plain: Option<&Path>, overwrite: bool) -> Result<Self, RecordError> {
        let file = new_file(path, overwrite)?;
        let plain = plain.map(|path| Ok(Plain::new(path, new_file(path, overwrite)?))).transpose()?;
        let mcap_error = |source| RecordError::Mcap { path: path.to_owned(), source };
        let to = NoSeek::new(BufWriter::with_capacity(CHUNK_BYTES, file));
        let mut mcap = file::File::new(to, Seeks::Never).map_err(mcap_error)?;
        mcap.flush().map_err(mcap_error)?;
        Ok(Self {
            path: path.to_owned(),
            mcap,
            plain,
            gatherer: Gatherer::default(),
            summary: Summary::default(),
            first_us: None,
            last_us: 0,
            flushed_us: 0,
        })
    }

    /// Takes a message that has come at this instant, microseconds since 1970. What the robot is to be asked for then: after a reset it
    /// has forgotten what it was to send.
    pub fn take(&mut self, message: &FromRobot, now_us: u64) -> Result<Option<Command>, RecordError> {
        // A clock that is set back does not set the recording back.
        let now_us = now_us.max(self.last_us);
        (self.last_us, self.summary.span_us) = (now_us, now_us - *self.first_us.get_or_insert(now_us));
        if let Some(body) = message.encode(&mut [0; BODY]) {
            let written = self.mcap.write(LINK_TOPIC, nanoseconds(now_us), &Bytes::new(body));
            written.map_err(|e| self.failed(e))?;
        }
        let steps = self.gatherer.take(message, now_us);
        for step in &steps {
            self.step(step, now_us)?;
        }
        match message {
            FromRobot::Hello(hello) => self.hello(hello, now_us)?,
            FromRobot::Pose(pose) => self.pose(pose, now_us)?,
            FromRobot::Ticks(ticks) => self.ticks(ticks, now_us)?,
            FromRobot::Event(happened) => {
                let level = match happened.event {
                    Event::SensorLost | Event::Wheels(Some(_)) | Event::MapFull => Log::WARN,
                    _ => Log::INFO,
                };
                self.note(now_us, level, &words::of_event(&happened.event))?;
            }
            _ => {}
        }
        if now_us >= self.flushed_us + CHUNK_US {
            self.flush(now_us)?;
        }
        let is_asked = |hello: &Hello| hello.streams.0 & STREAMS.0 == STREAMS.0;
        Ok(match message {
            FromRobot::Hello(hello) if !is_asked(hello) => Some(Command::Subscribe(STREAMS)),
            _ => None,
        })
    }

    /// Something about the recording itself.
    pub fn note(&mut self, now_us: u64, level: u8, text: &str) -> Result<(), RecordError> {
        let ns = nanoseconds(now_us.max(self.last_us));
        self.mcap.write("/rosout", ns, &Log::new(ns, level, text)).map_err(|e| self.failed(e))
    }

    /// The port is gone, or there again.
    pub fn port(&mut self, now_us: u64, text: &str) -> Result<(), RecordError> {
        self.note(now_us, Log::WARN, text)?;
        self.flush(now_us)
    }

    /// What has been recorded so far.
    pub fn summary(&self) -> Summary {
        self.summary
    }

    /// Hands the system what has come so far.
    pub fn flush(&mut self, now_us: u64) -> Result<(), RecordError> {
        self.flushed_us = now_us;
        self.mcap.flush().map_err(|e| self.failed(e))
    }

    /// Ends the files.
    pub fn finish(mut self) -> Result<Summary, RecordError> {
        let Summary { scans, samples, poses, runs, missing, joined, .. } = self.summary;
        let values = [
            ("scans", scans.to_string()),
            ("wheel_samples", samples.to_string()),
            ("poses", poses.to_string()),
            ("runs_of_the_robot", runs.to_string()),
            ("missing_scans", missing.scans.to_string()),
            ("missing_poses", missing.poses.to_string()),
            ("missing_wheel_samples", missing.samples.to_string()),
            ("begins_in_a_drive", joined.to_string()),
        ];
        let values: BTreeMap<String, String> =
            values.into_iter().map(|(name, value)| (name.to_owned(), value)).collect();
        let path = self.path.clone();
        let failed = |source| RecordError::Mcap { path: path.clone(), source };
        self.mcap.describe("lineslam.recording", values).map_err(failed)?;
        let buffered = self.mcap.finish().map_err(failed)?.into_inner();
        let file = buffered
            .into_inner()
            .map_err(|error| RecordError::Io { path: path.clone(), source: error.into_error() })?;
        file.sync_all().map_err(|source| RecordError::Io { path, source })?;
        self.plain.map(Plain::finish).transpose()?;
        Ok(self.summary)
    }

    fn failed(&self, source: RecordingError) -> RecordError {
        RecordError::Mcap { path: self.path.clone(), source }
    }

    fn step(&mut self, step: &Step, now_us: u64) -> Result<(), RecordError> {
        match step {
            Step::Began { joined, .. } => {
                self.summary.runs += 1;
                self.summary.joined |= joined;
                Ok(())
            }
            Step::Missing(missing) => {
                self.summary.missing.add(*missing);
                let text = format!("missing: {}", missing.words());
                self.note(now_us, Log::WARN, &text)
            }
            Step::Done(act) => self.act(act, now_us),
        }
    }

    fn act(&mut self, act: &Act, now_us: u64) -> Result<(), RecordError> {
        let Some(scan) = &act.scan else { return Ok(()) };
        self.summary.scans += 1;
        let Some(hello) = self.gatherer.hello() else { return Ok(()) };
        if let Some(plain) = &mut self.plain {
            plain.scan(hello, scan, act.epoch_us)?;
        }
        let middle_ns = nanoseconds(act.epoch_us.saturating_add(scan.middle_us));
        let first_ns = middle_ns.saturating_sub(ros::to_middle_ns(&hello.scanner, scan));
        let message = ros::scan(&hello.scanner, scan, first_ns);
        self.mcap.write("/scan", nanoseconds(now_us), &message).map_err(|e| self.failed(e))
    }

    fn hello(&mut self, hello: &Hello, now_us: u64) -> Result<(), RecordError> {
        let ns = nanoseconds(now_us);
        self.mcap.write("/tf_static", ns, &ros::mounting(&hello.scanner, ns)).map_err(|e| self.failed(e))
    }

    fn pose(&mut self, pose: &Pose, now_us: u64) -> Result<(), RecordError> {
        self.summary.poses += 1;
        let at_ns = nanoseconds(self.gatherer.stamp_us(pose.at_us));
        self.mcap
            .write("/tf", nanoseconds(now_us), &ros::transform(pose, at_ns))
            .map_err(|e| self.failed(e))?;
        let message = ros::pose_message(pose, at_ns);
        self.mcap.write("/pose", nanoseconds(now_us), &message).map_err(|e| self.failed(e))
    }

    fn ticks(&mut self, ticks: &Ticks, now_us: u64) -> Result<(), RecordError> {
        for (robot_us, counters) in ticks.samples() {
            self.summary.samples += 1;
            let Some(hello) = self.gatherer.hello() else { continue };
            let stamp_us = self.gatherer.stamp_us(robot_us);
            if let Some(plain) = &mut self.plain {
                plain.ticks(hello, stamp_us, counters)?;
            }
            let position = ros::angles(counters, hello.wheels.ticks_per_turn);
            let message = JointState {
                header: header(nanoseconds(stamp_us), ""),
                name: &WHEELS,
                position: &position,
                velocity: &[],
                effort: &[],
            };
            let written = self.mcap.write("/joint_states", nanoseconds(now_us), &message);
            written.map_err(|e| self.failed(e))?;
        }
        Ok(())
    }
}

/// What the robot said, in a message of [`LINK_TOPIC`].
pub fn body_of(message: &[u8]) -> Option<&[u8]> {
    let (len, body) = message.strip_prefix(&BEFORE_BODY)?.split_first_chunk()?;
    body.get(..usize::try_from(u32::from_le_bytes(*len)).ok()?)
}

fn new_file(path: &Path, overwrite: bool) -> Result<File, RecordError> {
    let mut options = OpenOptions::new();
    options.write(true);
    if overwrite {
        options.create(true).truncate(true);
    } else {
        options.create_new(true);
    }
    options.open(path).map_err(|source| match source.kind() {
        std::io::ErrorKind::AlreadyExists => RecordError::Exists { path: path.to_owned() },
        _ => RecordError::Io { path: path.to_owned(), source },
    })
}
