//! What waits to be sent, and in which order: nothing is made into a frame before the port has room for it.

use core::future::{pending, poll_fn};

use ::link::from_robot::{Answer, Event, Happened, Hello, KeptMap, Outcome, Pose, Ranges, ResetCause, Ticks};
use ::link::ranges::{Packed, RANGES};
use ::link::{FromRobot, Streams};
use embassy_sync::blocking_mutex::raw::CriticalSectionRawMutex;
use embassy_sync::zerocopy_channel;
use embassy_time::Instant;
use heapless::Deque;

use super::Frame;
use super::map::MapCursor;
use super::telemetry::{self, Load};
use crate::kept::{Mapper, SAMPLES};
use crate::lidar::ScanBuffer;
use crate::trace::Tracer;

/// Events that may wait.
const EVENTS: usize = 8;
/// Answers that may wait; who asks faster asks again.
const ANSWERS: usize = 4;

/// What messages are made of.
pub struct View<'a> {
    /// The map, the pose, the counters.
    pub mapper: &'a Mapper,
    /// The last samples of the wheels.
    pub tracer: &'a Tracer,
    /// The scan that was taken in last, while it is held.
    pub scan: Option<&'a ScanBuffer>,
    /// What the work takes.
    pub load: &'a Load,
}

/// What is counted here.
#[derive(Clone, Copy, Default)]
pub struct Unsent {
    pub frames: u32,
    pub poses: u32,
    pub scans: u32,
    pub samples: u32,
    pub events: u32,
    pub unknown: u32,
}

/// A scan on its way out.
#[derive(Clone, Copy)]
struct Sending {
    number: u32,
    next: usize,
}

/// Messages to be sent. The policy of each stream is its field's.
pub struct Outbox {
    frames: zerocopy_channel::Sender<'static, CriticalSectionRawMutex, Frame>,
    sender: ::link::Sender,
    pub(super) streams: Streams,
    started: (ResetCause, KeptMap),
    hello: bool,
    /// A queue; one that finds no room is dropped, and the PC asks again.
    answers: Deque<Answer, ANSWERS>,
    pub(super) answered: Option<Answer>,
    /// A queue; one that finds no room is dropped and counted.
    events: Deque<Happened, EVENTS>,
    /// Latest wins; those replaced are counted.
    pose: Option<Pose>,
    /// Made when they are sent.
    status: bool,
    health: bool,
    /// Samples that were sent, or counted as unsent: the record has the last ones.
    samples: u32,
    /// One at a time, read where the mapping has it.
    sending: Option<Sending>,
    /// Read from the map when there is room.
    pub(super) map: MapCursor,
    pub(super) unsent: Unsent,
}

impl Outbox {
    /// Nothing but who is there, and why it started.
    pub fn new(
        frames: zerocopy_channel::Sender<'static, CriticalSectionRawMutex, Frame>,
        reset: ResetCause,
        kept: KeptMap,
    ) -> Self {
        let mut outbox = Self {
            frames,
            sender: ::link::Sender::default(),
            streams: Streams::DEFAULT,
            started: (reset, kept),
            hello: true,
            answers: Deque::new(),
            answered: None,
            events: Deque::new(),
            pose: None,
            status: false,
            health: false,
            samples: 0,
            sending: None,
            map: MapCursor::new(),
            unsent: Unsent::default(),
        };
        outbox.event(Event::Started(reset));
        outbox
    }

    /// Something has happened.
    pub fn event(&mut self, event: Event) {
        if self.streams.has(Streams::EVENTS) {
            let happened = Happened { at_us: Instant::now().as_micros(), event };
            self.unsent.events += u32::from(self.events.push_back(happened).is_err());
        }
    }

    /// Something was done to the map.
    pub fn pose(&mut self, pose: Pose) {
        if self.streams.has(Streams::POSES) {
            self.unsent.poses += u32::from(self.pose.replace(pose).is_some());
        }
    }

    /// A scan was taken in, the event of this number. It is to be held until [`Self::is_sending`] is over.
    pub fn scan(&mut self, number: u32) {
        self.sending = self.streams.has(Streams::SCANS).then_some(Sending { number, next: 0 });
    }

    /// Whether a scan is on its way out.
    pub fn is_sending(&self) -> bool {
        self.sending.is_some()
    }

    /// The scan is needed no longer than this.
    pub fn cut_scan(&mut self) {
        self.unsent.scans += u32::from(self.sending.take().is_some());
    }

    /// A second has passed.
    pub fn second(&mut self) {
        (self.status, self.health) = (true, true);
    }

    /// A few lines of the map may be looked at.
    pub fn look_at_map(&mut self) {
        self.map.open(self.streams.has(Streams::MAP));
    }

    /// Says who is there.
    pub fn hello(&mut self) {
        self.hello = true;
    }

    pub(super) fn answer(&mut self, id: u32, outcome: Outcome) {
        let answer = Answer { id, outcome };
        self.answered = Some(answer);
        // Without room the PC asks again.
        let _ = self.answers.push_back(answer);
    }

    pub(super) fn subscribe(&mut self, streams: Streams, samples: u32) {
        let begins = |stream| streams.has(stream) && !self.streams.has(stream);
        if begins(Streams::TICKS) {
            // With all that the record still has: who subscribes as soon as the robot has started misses none.
            self.samples = samples.saturating_sub(SAMPLES as u32);
        }
        if begins(Streams::MAP) {
            self.map = MapCursor::new();
        }
        if !streams.has(Streams::SCANS) {
            self.sending = None;
        }
        self.streams = streams;
    }

    /// Waits until something can be sent that could not be before.
    pub async fn room(&mut self, samples: u32) {
        if !self.is_waiting(samples) {
            pending::<()>().await;
        }
        poll_fn(|context| self.frames.poll_send(context).map(|_| ())).await;
    }

    /// Whether all that was to be sent is on its way, all answers at the least.
    pub fn is_answered(&self) -> bool {
        self.answers.is_empty() && self.frames.is_empty()
    }

    fn is_waiting(&self, samples: u32) -> bool {
        self.hello
            || self.status
            || self.health
            || self.pose.is_some()
            || self.sending.is_some()
            || self.map.is_open()
            || !self.answers.is_empty()
            || !self.events.is_empty()
            || (self.streams.has(Streams::TICKS) && self.samples != samples)
    }

    /// Makes frames as long as there is room for them.
    #[inline(never)]
    pub fn fill(&mut self, view: &View<'_>) {
        while self.frames.try_send().is_some() {
            let Some(message) = self.next(view) else { return };
            let Some(frame) = self.frames.try_send() else { return };
            match self.sender.frame(&message, &mut frame.bytes) {
                Ok(len) => {
                    frame.len = len;
                    self.frames.send_done();
                    self.unsent.frames = self.unsent.frames.wrapping_add(1);
                }
                // None of the messages is; a test of the package says so.
                Err(_) => defmt::error!("link: a message is too large"),
            }
        }
    }

    /// What is sent next: what is short and urgent before what is long.
    #[inline(never)]
    fn next(&mut self, view: &View<'_>) -> Option<FromRobot> {
        if core::mem::take(&mut self.hello) {
            return Some(FromRobot::Hello(self.who(view.mapper)));
        }
        if let Some(answer) = self.answers.pop_front() {
            return Some(FromRobot::Answer(answer));
        }
        if let Some(pose) = self.pose.take() {
            return Some(FromRobot::Pose(pose));
        }
        if let Some(happened) = self.events.pop_front() {
            return Some(FromRobot::Event(happened));
        }
        let wants_status = self.streams.has(Streams::STATUS);
        if core::mem::take(&mut self.status) && wants_status {
            return Some(FromRobot::Status(telemetry::status(view.mapper)));
        }
        if core::mem::take(&mut self.health) && wants_status {
            return Some(FromRobot::Health(telemetry::health(view.load, &self.unsent)));
        }
        if let Some(ticks) = self.next_ticks(view.tracer) {
            return Some(FromRobot::Ticks(ticks));
        }
        if let Some(ranges) = self.next_ranges(view.scan) {
            return Some(FromRobot::Ranges(ranges));
        }
        self.map.next(view.mapper)
    }

    fn who(&self, mapper: &Mapper) -> Hello {
        telemetry::hello(mapper, self.started, self.streams)
    }

    /// Samples that the record still has.
    fn next_ticks(&mut self, tracer: &Tracer) -> Option<Ticks> {
        let taken = tracer.samples_taken();
        if !self.streams.has(Streams::TICKS) || self.samples == taken {
            return None;
        }
        let lost = taken.wrapping_sub(self.samples).saturating_sub(SAMPLES as u32);
        self.unsent.samples = self.unsent.samples.wrapping_add(lost);
        self.samples = self.samples.wrapping_add(lost);
        let first = tracer.sample_of(self.samples);
        let mut ticks = Ticks::new(self.samples, (first.stamp_us, [first.left, first.right]));
        self.samples = self.samples.wrapping_add(1);
        let mut last = first;
        while self.samples != taken {
            let sample = tracer.sample_of(self.samples);
            let since_us = sample.stamp_us.wrapping_sub(last.stamp_us);
            let Ok(since_us) = u32::try_from(since_us) else { break };
            let step = (since_us, sample.left.wrapping_sub(last.left), sample.right.wrapping_sub(last.right));
            if ticks.steps.push(step).is_err() {
                break;
            }
            self.samples = self.samples.wrapping_add(1);
            last = sample;
        }
        Some(ticks)
    }

    fn next_ranges(&mut self, scan: Option<&ScanBuffer>) -> Option<Ranges> {
        let Sending { number, next } = self.sending?;
        let ranges_mm = scan.and_then(|scan| scan.ranges_mm.get(..scan.len)).unwrap_or(&[]);
        let rest = ranges_mm.get(next..).unwrap_or(&[]);
        let some = rest.get(..RANGES).unwrap_or(rest);
        let is_last = some.len() == rest.len();
        self.sending = (!is_last).then_some(Sending { number, next: next + some.len() });
        let (beams, first) = (ranges_mm.len() as u16, next as u16);
        let ScanBuffer { middle_us: at_us, revolution_us, .. } = *scan?;
        Some(Ranges { number, at_us, revolution_us, beams, first, ranges: Packed::of(some) })
    }
}
