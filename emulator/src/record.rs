//! The firmware's own record of what it did, read from its memory (`src/trace.rs` writes it).

use nalgebra::{Isometry2, Vector3};
use rigless::emulator::Host;
use rigless::soc::Width;
use slam_core::WheelTicks;
use slam_core::geometry::pose::pose;
use slam_core::tracking::TrackingState;

/// The layout that is understood.
const LAYOUT: u64 = 3;
/// Samples in the record's ring.
const RING: u64 = 64;

/// What was done to the map.
#[derive(Clone, Debug, PartialEq)]
pub enum Event {
    /// A kept map was taken up.
    Resumed,
    /// A kept map was taken up that a reset had left half done.
    Recovered,
    /// A scan was taken in.
    Scan {
        /// Its middle beam on the firmware's clock.
        middle_us: u64,
        /// Its ranges.
        ranges_mm: Vec<u16>,
        /// What the work took.
        took_us: u32,
        /// One revolution of the scanner, as the firmware measured it.
        revolution_us: u32,
    },
    /// On by odometry alone.
    Coasted {
        /// Where it was to end, on the firmware's clock.
        until_us: u64,
    },
    /// The map was forgotten.
    Forgotten,
    /// The pose was set to these x, y and θ.
    PoseSet([f32; 3]),
    /// The map was frozen.
    Frozen,
    /// The map learns again.
    Unfrozen,
    /// The robot has begun to look for itself.
    Relocalising,
}

/// An event with what led to it and what came of it.
#[derive(Clone, Debug)]
pub struct Entry {
    /// Virtual time at which it was read, at most a millisecond after it happened.
    pub read_us: u64,
    /// Samples of the wheels since the entry before.
    pub samples: Vec<WheelTicks>,
    /// What was done.
    pub event: Event,
    /// x, y, θ after it, as the firmware has them.
    pub pose: Vector3<f32>,
    /// Standard deviations of them.
    pub sigmas: Vector3<f32>,
    /// Segments of the map.
    pub segments: u32,
    /// How far the firmware relies on the pose.
    pub state: TrackingState,
}

impl Entry {
    /// The pose as a transform.
    pub fn map_from_base(&self) -> Isometry2<f32> {
        pose(self.pose.x, self.pose.y, self.pose.z)
    }
}

/// Reads the record as it grows.
pub struct Recorder {
    trace: u64,
    events: u64,
    samples_taken: u64,
    /// Set by a reset, until the start-up code has cleared the record.
    stale: bool,
    /// All so far.
    pub entries: Vec<Entry>,
}

impl Recorder {
    /// Of the record at this address.
    pub fn new(trace: u64) -> Self {
        Self { trace, events: 0, samples_taken: 0, stale: false, entries: Vec::new() }
    }

    /// The firmware has been reset: its record begins anew.
    pub fn restarted(&mut self) {
        (self.events, self.samples_taken, self.stale) = (0, 0, true);
    }

    /// Looks for a new event.
    pub fn look(&mut self, host: &mut dyn Host, now_us: u64) -> anyhow::Result<bool> {
        let events = host.read(self.trace + 4, Width::W32)?;
        self.stale &= events != 0;
        if events == self.events || self.stale {
            return Ok(false);
        }
        anyhow::ensure!(
            host.read(self.trace, Width::W32)? == LAYOUT,
            "the firmware's record has another layout"
        );
        anyhow::ensure!(events == self.events + 1, "{} events at once", events.wrapping_sub(self.events));
        self.events = events;
        let kind = host.read(self.trace + 8, Width::W32)?;
        let taken = host.read(self.trace + 12, Width::W32)?;
        anyhow::ensure!(taken - self.samples_taken <= RING, "{} samples at once", taken - self.samples_taken);
        let mut samples = Vec::new();
        for number in self.samples_taken..taken {
            let at = self.trace + 16 + number % RING * 16;
            samples.push(WheelTicks {
                stamp_us: read_u64(host, at)?,
                left: host.read(at + 8, Width::W32)? as i32,
                right: host.read(at + 12, Width::W32)? as i32,
            });
        }
        self.samples_taken = taken;
        let rest = self.trace + 16 + RING * 16;
        let at_us = read_u64(host, rest)?;
        let word = |host: &mut dyn Host, k: u64| host.read(rest + 8 + 4 * k, Width::W32).map(|w| w as u32);
        let float = |host: &mut dyn Host, k: u64| word(host, k).map(f32::from_bits);
        let ranges = [word(host, 0)?, word(host, 1)?];
        let event = match kind {
            1 => Event::Resumed,
            4 => Event::Recovered,
            2 => {
                let ranges_mm = halves(host, ranges)?;
                let (took_us, revolution_us) = (word(host, 9)?, word(host, 11)?);
                Event::Scan { middle_us: at_us, ranges_mm, took_us, revolution_us }
            }
            5 => Event::Forgotten,
            6 => {
                let halves = halves(host, ranges)?;
                let [a, b, c, d, e, f] = halves[..] else {
                    anyhow::bail!("a pose of {} halves", halves.len())
                };
                let float = |low, high| f32::from_bits(u32::from(low) | u32::from(high) << 16);
                Event::PoseSet([float(a, b), float(c, d), float(e, f)])
            }
            7 => Event::Frozen,
            8 => Event::Unfrozen,
            9 => Event::Relocalising,
            3 => Event::Coasted { until_us: at_us },
            other => anyhow::bail!("an event of kind {other}"),
        };
        self.entries.push(Entry {
            read_us: now_us,
            samples,
            event,
            pose: Vector3::new(float(host, 2)?, float(host, 3)?, float(host, 4)?),
            sigmas: Vector3::new(float(host, 5)?, float(host, 6)?, float(host, 7)?),
            segments: word(host, 8)?,
            state: state(word(host, 10)?)?,
        });
        Ok(true)
    }
}

/// Halves of words from an address on, so many of them.
fn halves(host: &mut dyn Host, [from, len]: [u32; 2]) -> anyhow::Result<Vec<u16>> {
    let mut halves = Vec::new();
    for k in 0..u64::from(len) {
        halves.push(host.read(u64::from(from) + 2 * k, Width::W16)? as u16);
    }
    Ok(halves)
}

/// The state that the firmware wrote as a number.
fn state(number: u32) -> anyhow::Result<TrackingState> {
    [TrackingState::Tracking, TrackingState::Uncertain, TrackingState::Lost]
        .into_iter()
        .find(|state| *state as u32 == number)
        .ok_or_else(|| anyhow::anyhow!("a tracking state of number {number}"))
}

fn read_u64(host: &mut dyn Host, at: u64) -> anyhow::Result<u64> {
    Ok(host.read(at, Width::W32)? | host.read(at + 4, Width::W32)? << 32)
}
