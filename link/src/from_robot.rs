//! What the robot says.
//!
//! The first byte of a body is the number of the message, in the order in which they stand here. Later versions of the same [`VERSION`]
//! add messages, events and refusals at the end of their lists and fields at the end of messages: who does not know them passes over them.
//!
//! [`VERSION`]: crate::VERSION

use heapless::{String, Vec};
use serde::{Deserialize, Serialize};

use crate::frame::BODY;
use crate::map::{LINES, LOOPS, Line, PLACES};
use crate::ranges::Packed;
use crate::to_robot::Streams;

/// A message.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[allow(clippy::large_enum_variant, reason = "there is no heap, and one at a time on the stack")]
pub enum FromRobot {
    /// 0: who is there. At the start, and when asked.
    Hello(Hello),
    /// 1: after each scan, and after all else that moves the pose.
    Pose(Pose),
    /// 2: counters of the mapping, once a second.
    Status(Status),
    /// 3: the processor, the stack and the link itself, once a second.
    Health(Health),
    /// 4: something has happened.
    Event(Happened),
    /// 5: to a [`Request`](crate::Request).
    Answer(Answer),
    /// 6: samples of the wheels.
    Ticks(Ticks),
    /// 7: a part of a scan.
    Ranges(Ranges),
    /// 8: lines that have changed.
    Lines(Lines),
    /// 9: a block of the map is complete.
    Block(Block),
    /// 10: places, a part of them.
    Places(Places),
    /// 11: the places are complete.
    PlacesEnd(PlacesEnd),
}

impl FromRobot {
    /// Of the body of a frame. None where it is a message that this side does not know. What a later version has added to the end of
    /// one is passed over.
    pub fn decode(body: &[u8]) -> Option<Self> {
        postcard::from_bytes(body).ok()
    }

    /// The body of its frame. None would be a message that does not fit into one; there is none.
    pub fn encode<'a>(&self, body: &'a mut [u8; BODY]) -> Option<&'a [u8]> {
        postcard::to_slice(self, body).ok().map(|body| &*body)
    }
}

/// Why the board started.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum ResetCause {
    /// Power came, or had fallen too low.
    Power,
    /// The independent watchdog was not fed.
    Watchdog,
    /// The firmware asked for it: a panic, a fault, or a [`Restart`](crate::Command::Restart).
    Software,
    /// The reset pin.
    Pin,
    /// Anything else.
    Other,
}

/// What became of the map that the run before had left.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum KeptMap {
    /// It is as it was.
    Whole,
    /// There was none.
    None,
    /// The reset came in the middle of a scan; what was whole of it is there.
    HalfDone,
    /// It was damaged: a new one has begun.
    Damaged,
    /// The robot failed with it again and again: a new one has begun.
    GivenUp,
}

/// How beams lie.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Scanner {
    /// Ranges of a scan.
    pub beams: u16,
    /// Bearing of the first in the scanner's frame, radians.
    pub first_bearing_rad: f32,
    /// From one to the next, radians, counter-clockwise.
    pub step_rad: f32,
    /// Least range that is one, millimetres; less is a code.
    pub min_mm: u16,
    /// Largest range that is one, millimetres.
    pub max_mm: u16,
    /// The scanner in `base`: x, y (m), θ (rad).
    pub base_from_laser: [f32; 3],
    /// Whether it hangs head down.
    pub upside_down: bool,
    /// What was taken off the stamps of scans because they are late, microseconds.
    pub late_us: i32,
}

/// What the wheels' ticks are worth.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Wheels {
    /// Radii of the left and the right one, metres.
    pub radii_m: [f32; 2],
    /// Distance between them, metres.
    pub track_m: f32,
    /// Ticks of one turn.
    pub ticks_per_turn: f32,
}

/// Who is there.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Hello {
    /// Since the reset, microseconds.
    pub uptime_us: u64,
    /// Version of the firmware.
    pub firmware: String<16>,
    /// The board.
    pub board: String<24>,
    /// Name of the robot file's robot.
    pub robot: String<32>,
    /// Lines that the map has room for, …
    pub lines: u16,
    /// … and places.
    pub places: u16,
    /// Why it started.
    pub reset: ResetCause,
    /// The map it started with.
    pub kept: KeptMap,
    /// The scanner.
    pub scanner: Scanner,
    /// The wheels.
    pub wheels: Wheels,
    /// What is subscribed to.
    pub streams: Streams,
}

/// What was done to the map.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub enum Cause {
    /// A kept map was taken up.
    Resumed,
    /// A kept map was taken up that a reset had left half done.
    Recovered,
    /// A scan was taken in.
    Scan,
    /// The robot went on by odometry alone, to `at_us` or the newest sample before it.
    Coasted,
    /// The map was forgotten.
    Forgotten,
    /// The pose was set to this one (x, y, θ); the scans to come correct it.
    PoseSet([f32; 3]),
    /// The map was frozen.
    Frozen,
    /// The map learns again.
    Unfrozen,
    /// The robot has begun to look for itself.
    Relocalising,
}

/// How far the pose is to be relied on.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum State {
    /// It is.
    Tracking,
    /// What is seen has been explained badly for a while.
    Uncertain,
    /// Not at all; the robot looks for itself, and nothing enters the map.
    Lost,
}

/// The pose after something was done to the map. With all of them, the scans and the ticks, a PC computes the same bits.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Pose {
    /// Of what was done, counted from 1 at each reset.
    pub number: u32,
    /// The scan's middle beam, or where coasting was to end, or now; microseconds.
    pub at_us: u64,
    /// Samples of the wheels taken in by then, since the reset.
    pub samples: u32,
    /// x, y (m), θ (rad) of `base` in `map`.
    pub pose: [f32; 3],
    /// Covariance of that: xx, xy, xθ, yy, yθ, θθ.
    pub covariance: [f32; 6],
    /// How far it is to be relied on.
    pub state: State,
    /// Lines of the map, tentative ones too.
    pub lines: u16,
    /// What the work took, microseconds.
    pub took_us: u32,
    /// What was done.
    pub cause: Cause,
}

/// What has been counted of the mapping since the reset, and how it stands.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Status {
    /// Since the reset, microseconds.
    pub uptime_us: u64,
    /// Way driven, metres.
    pub way_m: f32,
    /// Whether scans come.
    pub sensor: bool,
    /// Whether the map learns.
    pub mapping: bool,
    /// What is wrong with the wheels, see [`WheelFault`].
    pub wheel_fault: Option<WheelFault>,
    /// By how much scans are stamped late, its standard deviation (seconds), and whether that is used.
    pub delay: Option<(f32, f32, bool)>,
    /// Scans handed out by the sensor's driver, …
    pub sensor_scans: u32,
    /// … missing by their stamps, …
    pub sensor_missed: u32,
    /// … and begun and dropped.
    pub sensor_dropped: u32,
    /// Errors of the sensor's port.
    pub port_errors: u32,
    /// Times that the sensor was lost.
    pub sensor_losses: u32,
    /// Samples of the wheels that found no room.
    pub samples_dropped: u32,
    /// Samples whose stamp did not increase.
    pub stamps_refused: u32,
    /// Scans without odometry, or late.
    pub scans_without_odometry: u32,
    /// Steps of the wheels that no robot can make.
    pub impossible_steps: u32,
    /// Times that the wheels' counters began anew.
    pub counters_restarted: u32,
    /// Scans processed.
    pub scans: u32,
    /// Scans of another number of beams.
    pub wrong_beam_count: u32,
    /// Scans without a line.
    pub without_segments: u32,
    /// Scans that left the pose to the odometry.
    pub uncorrected: u32,
    /// Moves by odometry alone.
    pub coasted: u32,
    /// Loops closed.
    pub loops_closed: u32,
    /// Lines that one scan had too many.
    pub crowded_out: u32,
    /// Scans that overruled the odometry.
    pub odometry_left_out: u32,
    /// Scans for which poses were searched.
    pub searched: u32,
    /// Scans at which the robot was lost.
    pub lost: u32,
    /// Times that the robot found itself, …
    pub relocalised: u32,
    /// … and that it gave up.
    pub gave_up: u32,
    /// Lines added to the map, …
    pub lines_added: u32,
    /// … dropped for others, …
    pub lines_evicted: u32,
    /// … that found no room, …
    pub lines_refused: u32,
    /// … that became one with another, …
    pub lines_fused: u32,
    /// … that were forgotten, …
    pub lines_forgotten: u32,
    /// … and that were opened.
    pub lines_opened: u32,
    /// Places.
    pub places: u16,
}

/// A fault of wheels or encoders.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum WheelFault {
    /// Left is right and right is left.
    Swapped,
    /// The left encoder counts backward.
    LeftReversed,
    /// The right encoder counts backward.
    RightReversed,
    /// Both encoders count backward.
    BothReversed,
    /// Swapped, and both count backward.
    SwappedAndReversed,
    /// The left encoder does not count.
    LeftDead,
    /// The right encoder does not count.
    RightDead,
    /// Neither counts.
    BothDead,
}

/// The processor, the stack and the link itself.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Health {
    /// Since the reset, microseconds.
    pub uptime_us: u64,
    /// What the last scan took, microseconds, …
    pub scan_us: u32,
    /// … and the longest since the reset.
    pub longest_scan_us: u32,
    /// The share of the last second that went into scans, …
    pub mapping_permille: u16,
    /// … and into what is said here.
    pub link_permille: u16,
    /// Most bytes of stack used since the reset: in all, in thread mode, in the urgent executor.
    pub stack: [u32; 3],
    /// Frames sent.
    pub sent: u32,
    /// Poses that a newer one replaced before they were sent.
    pub poses_replaced: u32,
    /// Scans that were not sent, or not to their end.
    pub scans_unsent: u32,
    /// Samples of the wheels that were not sent.
    pub samples_unsent: u32,
    /// Events that found no room.
    pub events_unsent: u32,
    /// Whole frames received.
    pub received: u32,
    /// Pieces received that were no frames.
    pub damaged: u32,
    /// Requests that were not understood.
    pub unknown: u32,
    /// Times that bytes received were lost: errors of the line, or more than there was room for.
    pub overruns: u32,
}

/// Something has happened.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Happened {
    /// When, microseconds.
    pub at_us: u64,
    /// What.
    pub event: Event,
}

/// What may happen.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Event {
    /// The board has started.
    Started(ResetCause),
    /// Scans have stayed away; the robot goes on by odometry.
    SensorLost,
    /// Scans come (again).
    SensorFound,
    /// A loop was closed: map and pose have moved.
    LoopClosed,
    /// Something is wrong with the wheels, or no longer.
    Wheels(Option<WheelFault>),
    /// A line found no room in the map, or one was dropped for it.
    MapFull,
    /// How far the pose is to be relied on has changed.
    State(State),
    /// Both counters of the wheels have begun anew.
    CountersRestarted,
    /// A scan had another number of beams.
    ScanRefused,
}

/// To a request.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Answer {
    /// The request's.
    pub id: u32,
    /// What came of it.
    pub outcome: Outcome,
}

/// What came of a request.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Outcome {
    /// It is done; a restart will be.
    Done,
    /// The robot does not know it.
    Unknown,
    /// It has a number that makes no sense.
    OutOfRange,
    /// This robot's configuration does not do it.
    NotConfigured,
}

/// Samples in one frame, after the first.
pub const STEPS: usize = 14;

/// Samples of the wheels, in order.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Ticks {
    /// How many samples were taken in before the first, since the reset.
    pub before: u32,
    /// When the first was taken, microseconds.
    pub stamp_us: u64,
    /// Ticks of the left and the right wheel by then; they wrap.
    pub ticks: [i32; 2],
    /// From each to the next: microseconds, and ticks of both wheels.
    pub steps: Vec<(u32, i32, i32), STEPS>,
}

impl Ticks {
    /// A first sample.
    pub fn new(before: u32, (stamp_us, ticks): (u64, [i32; 2])) -> Self {
        Self { before, stamp_us, ticks, steps: Vec::new() }
    }

    /// All samples: stamp and ticks of both wheels.
    pub fn samples(&self) -> impl Iterator<Item = (u64, [i32; 2])> {
        let first = (self.stamp_us, self.ticks);
        let rest = self.steps.iter().scan(first, |(stamp_us, [left, right]), step| {
            *stamp_us = stamp_us.wrapping_add(u64::from(step.0));
            (*left, *right) = (left.wrapping_add(step.1), right.wrapping_add(step.2));
            Some((*stamp_us, [*left, *right]))
        });
        core::iter::once(first).chain(rest)
    }
}

/// A part of a scan.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Ranges {
    /// The [`Pose::number`] of the scan.
    pub number: u32,
    /// Instant of its middle beam, microseconds.
    pub at_us: u64,
    /// One revolution of the scanner, as the robot measured it, microseconds: by it the motion within the scan is taken out.
    pub revolution_us: u32,
    /// Ranges of the whole scan.
    pub beams: u16,
    /// The beam that is the first of these.
    pub first: u16,
    /// These.
    pub ranges: Packed,
}

/// Lines that have changed, each with its slot.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Lines(pub Vec<(u16, Line), LINES>);

/// The lines of a block are all said, as they are now.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Block {
    /// Which; its first slot is that times [`BLOCK`](crate::map::BLOCK).
    pub block: u8,
    /// Lines of the whole map: slots from there on are empty.
    pub lines: u16,
    /// The [`block_check`](crate::map::block_check) of its lines.
    pub check: u32,
}

/// Poses of places, a part of them.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Places {
    /// Index of the first.
    pub first: u16,
    /// x, y (m), θ (rad) in `map`.
    pub poses: Vec<[f32; 3], PLACES>,
}

/// The places are all said, as they are now.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct PlacesEnd {
    /// How many there are.
    pub places: u16,
    /// Their [`places_check`](crate::map::places_check).
    pub check: u32,
    /// The loops between them: indices of the older and the younger place.
    pub loops: Vec<(u16, u16), LOOPS>,
}
