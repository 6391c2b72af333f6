//! What the map was made from and what came out, where a probe can read it: the emulator does, to compare every scan
//! with a PC. Written by the map's thread alone; a reader takes it between two writes, when `events` has changed.

use core::ptr::addr_of_mut;

use slam_core::WheelTicks;
use slam_core::geometry::pose::components;

use crate::kept::{Mapper, SAMPLES};

/// Changes with the layout.
const LAYOUT: u32 = 3;

/// What was done to the map.
#[repr(u32)]
#[derive(Clone, Copy, PartialEq, Eq)]
pub enum Event {
    /// The firmware took up a kept map.
    Resumed = 1,
    /// A scan was taken in.
    Scan = 2,
    /// The robot went on by odometry alone.
    Coasted = 3,
    /// The firmware took up a kept map that a reset had left half done; what came before is not to be had.
    Recovered = 4,
    /// The map was forgotten.
    Forgotten = 5,
    /// The pose was set; in place of ranges stand the halves, lower first, of the bits of x, y and θ as they were given.
    PoseSet = 6,
    /// The map was frozen.
    Frozen = 7,
    /// The map learns again.
    Unfrozen = 8,
    /// The robot has begun to look for itself.
    Relocalising = 9,
}

/// The record. Every field is of four or eight bytes, little-endian, without padding between them.
#[repr(C)]
pub struct Trace {
    layout: u32,
    /// Events so far.
    events: u32,
    /// The last one.
    event: u32,
    /// Samples of the wheels taken in so far; the last ones are in `samples`, each at its number modulo the length.
    samples_taken: u32,
    samples: [WheelTicks; SAMPLES],
    /// Instant of the event's pose: a scan's middle beam, or where coasting was to end.
    at_us: u64,
    /// Address of a scan's ranges, and how many there are.
    ranges: u32,
    ranges_len: u32,
    /// x, y, θ after the event.
    pose: [f32; 3],
    /// Standard deviations of x, y, θ.
    sigmas: [f32; 3],
    segments: u32,
    /// What the work took, microseconds.
    took_us: u32,
    /// The [`TrackingState`](slam_core::tracking::TrackingState) after the event.
    state: u32,
    /// One revolution of the scanner, microseconds.
    revolution_us: u32,
}

#[unsafe(no_mangle)]
static mut TRACE: Trace = Trace {
    layout: LAYOUT,
    events: 0,
    event: 0,
    samples_taken: 0,
    samples: [WheelTicks { stamp_us: 0, left: 0, right: 0 }; SAMPLES],
    at_us: 0,
    ranges: 0,
    ranges_len: 0,
    pose: [0.0; 3],
    sigmas: [0.0; 3],
    segments: 0,
    took_us: 0,
    state: 0,
    revolution_us: 0,
};

/// The one writer of the record.
pub struct Tracer {
    trace: &'static mut Trace,
}

impl Tracer {
    /// Takes it. To be called once.
    pub fn take() -> Self {
        // SAFETY: called once, before any task runs, so nothing else in the firmware refers to it.
        Self { trace: unsafe { &mut *addr_of_mut!(TRACE) } }
    }

    /// A sample of the wheels went in.
    pub fn sample(&mut self, ticks: WheelTicks) {
        let place = self.trace.samples_taken as usize % SAMPLES;
        if let Some(slot) = self.trace.samples.get_mut(place) {
            *slot = ticks;
        }
        self.trace.samples_taken = self.trace.samples_taken.wrapping_add(1);
    }

    /// Events so far.
    pub fn events(&self) -> u32 {
        self.trace.events
    }

    /// Samples of the wheels taken in so far.
    pub fn samples_taken(&self) -> u32 {
        self.trace.samples_taken
    }

    /// The sample of this number, which must be one of the last [`SAMPLES`].
    pub fn sample_of(&self, number: u32) -> WheelTicks {
        self.trace.samples.get(number as usize % SAMPLES).copied().unwrap_or_default()
    }

    /// Something was done to the map.
    pub fn event(&mut self, event: Event, at_us: u64, ranges_mm: &[u16], mapper: &Mapper, took_us: u32) {
        let t = &mut *self.trace;
        let covariance = mapper.slam().covariance();
        t.event = event as u32;
        t.at_us = at_us;
        (t.ranges, t.ranges_len) = (ranges_mm.as_ptr().addr() as u32, ranges_mm.len() as u32);
        t.pose = components(&mapper.slam().pose()).into();
        t.sigmas = [0, 1, 2].map(|i| sigma(covariance.get((i, i)).copied().unwrap_or(0.0)));
        t.segments = mapper.slam().map().segments().len() as u32;
        t.took_us = took_us;
        t.state = mapper.slam().state() as u32;
        t.revolution_us = mapper.slam().config().sensor.geometry.revolution_us;
        // Last, and seen so by whoever reads memory.
        core::sync::atomic::compiler_fence(core::sync::atomic::Ordering::SeqCst);
        // SAFETY: a field of a record that this alone refers to.
        unsafe { core::ptr::write_volatile(&mut t.events, t.events.wrapping_add(1)) };
    }
}

/// Standard deviation of a variance.
pub fn sigma(variance: f32) -> f32 {
    slam_core::geometry::math::sqrt(variance.max(0.0))
}
