//! What was done to a robot's map, in its order, from what the robot says of it.
//!
//! In: the robot's messages as they came. Out: [`Step`]s. With all of them a PC computes the bits that the robot computed: each act comes
//! with the samples of the wheels that were taken in before it. What the numbers of poses and samples show to be missing is a step too,
//! since from there on a PC computes something else.
//!
//! A robot says the pose first, then the samples, then the scan's parts; so a pose waits here until all that belongs to it has come, or a
//! later scan shows that it never will.

use std::collections::VecDeque;

use slam_core::WheelTicks;

use crate::link::FromRobot;
use crate::link::from_robot::{Cause, Hello, KeptMap, Pose, Ranges, Ticks};

/// A scan as the robot took it in.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RobotScan {
    /// Instant of its middle beam on the robot's clock, microseconds.
    pub middle_us: u64,
    /// A revolution of the scanner, as the robot measured it, microseconds.
    pub revolution_us: u32,
    /// Millimetres or codes.
    pub ranges_mm: Vec<u16>,
}

/// Something that was done to the robot's map.
#[derive(Clone, Debug, PartialEq)]
pub struct Act {
    /// Samples of the wheels that were taken in since the act before, on the robot's clock.
    pub samples: Vec<WheelTicks>,
    /// What it was, and the pose after it.
    pub pose: Pose,
    /// The scan, where it was one.
    pub scan: Option<RobotScan>,
    /// Zero of the robot's clock, microseconds of the recorder's.
    pub epoch_us: u64,
}

/// What never came.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Missing {
    /// Scans whose pose was said.
    pub scans: u32,
    /// Poses: each of a scan, or of something else that was done to the map.
    pub poses: u32,
    /// Samples of the wheels.
    pub samples: u32,
}

impl Missing {
    /// Whether all came.
    pub fn is_none(&self) -> bool {
        *self == Self::default()
    }

    /// Adds others.
    pub fn add(&mut self, more: Self) {
        self.scans = self.scans.saturating_add(more.scans);
        self.poses = self.poses.saturating_add(more.poses);
        self.samples = self.samples.saturating_add(more.samples);
    }

    /// In words, such as "2 scans, 1 pose and 40 samples of the wheels".
    pub fn words(&self) -> String {
        let counted = |count: u32, what: &str| match count {
            0 => None,
            1 => Some(format!("1 {what}")),
            _ => Some(format!("{count} {what}s")),
        };
        let samples = match self.samples {
            0 => None,
            1 => Some("1 sample of the wheels".to_owned()),
            count => Some(format!("{count} samples of the wheels")),
        };
        let parts: Vec<_> = [counted(self.scans, "scan"), counted(self.poses, "pose"), samples]
            .into_iter()
            .flatten()
            .collect();
        match &parts[..] {
            [] => "nothing".into(),
            [rest @ .., last] if !rest.is_empty() => format!("{} and {last}", rest.join(", ")),
            [all, ..] => all.clone(),
        }
    }
}

/// What is followed, one after the other.
#[derive(Clone, Debug, PartialEq)]
pub enum Step {
    /// The robot's clock has begun anew, as it does after a reset, or the recording begins.
    Began {
        /// The robot had done something before the recording began, so that its map is not known.
        joined: bool,
        /// The map that it began with, if it said so.
        kept: Option<KeptMap>,
    },
    /// Something is missing here.
    Missing(Missing),
    /// Something was done.
    Done(Act),
}

/// The scan whose parts are coming.
#[derive(Debug, Default)]
struct Parts {
    number: u32,
    middle_us: u64,
    revolution_us: u32,
    ranges_mm: Vec<Option<u16>>,
}

impl Parts {
    fn take(&mut self, part: &Ranges) {
        if self.number != part.number || self.ranges_mm.len() != usize::from(part.beams) {
            let ranges_mm = vec![None; part.beams.into()];
            let (number, middle_us, revolution_us) = (part.number, part.at_us, part.revolution_us);
            *self = Self { number, middle_us, revolution_us, ranges_mm };
        }
        let Some(ranges) = part.ranges.ranges_mm() else { return };
        for (place, range) in self.ranges_mm.iter_mut().skip(part.first.into()).zip(&ranges) {
            *place = Some(*range);
        }
    }

    fn whole(&self, number: u32) -> Option<RobotScan> {
        let ranges_mm =
            self.ranges_mm.iter().copied().collect::<Option<_>>().filter(|_| self.number == number)?;
        Some(RobotScan { middle_us: self.middle_us, revolution_us: self.revolution_us, ranges_mm })
    }
}

/// Puts the steps together.
#[derive(Debug, Default)]
pub struct Gatherer {
    hello: Option<Hello>,
    /// Zero of the robot's clock, microseconds of the recorder's; none before the first message.
    epoch_us: Option<u64>,
    /// The latest instant that was heard of, on the robot's clock.
    newest_us: u64,
    /// Whether the robot was reset while it was recorded.
    was_reset: bool,
    /// Whether [`Step::Began`] was given out for this run of the robot.
    has_begun: bool,
    joined: bool,
    /// The number of the last pose that was taken in.
    number: u32,
    waiting: VecDeque<Pose>,
    parts: Parts,
    /// Samples with their numbers, and the number that the next one has.
    samples: VecDeque<(u32, WheelTicks)>,
    next_sample: Option<u32>,
    missing: Missing,
    steps: Vec<Step>,
}

impl Gatherer {
    /// Takes a message that came at this instant of the recorder's clock, microseconds; the steps that are complete with it.
    pub fn take(&mut self, message: &FromRobot, received_us: u64) -> Vec<Step> {
        if let Some(now_us) = clock_of(message) {
            let is_another = match message {
                FromRobot::Hello(hello) => hello.uptime_us < self.newest_us,
                FromRobot::Pose(pose) => pose.number <= self.number,
                _ => false,
            };
            // Stamps do not go back.
            let after_us = if is_another { self.reset() } else { 0 };
            self.newest_us = self.newest_us.max(now_us);
            self.epoch_us.get_or_insert_with(|| received_us.saturating_sub(now_us).max(after_us));
        }
        match message {
            FromRobot::Hello(hello) => self.hello = Some(hello.clone()),
            FromRobot::Pose(pose) => self.pose(pose),
            FromRobot::Ticks(ticks) => self.ticks(ticks),
            FromRobot::Ranges(part) => {
                // Parts of a later scan: what is still waiting for an earlier one waits in vain.
                if part.number > self.parts.number {
                    self.release(Some(part.number));
                }
                self.parts.take(part);
            }
            _ => return std::mem::take(&mut self.steps),
        }
        self.release(None);
        std::mem::take(&mut self.steps)
    }

    /// Who the robot is, if it has said so.
    pub fn hello(&self) -> Option<&Hello> {
        self.hello.as_ref()
    }

    /// An instant of the robot's clock on the recorder's, microseconds.
    pub fn stamp_us(&self, robot_us: u64) -> u64 {
        self.epoch_us.unwrap_or(0).saturating_add(robot_us)
    }

    /// The robot was reset: its clock and its numbers begin anew. What was still to come never will. The first instant after it.
    fn reset(&mut self) -> u64 {
        if self.has_begun {
            self.missing.poses += self.waiting.len() as u32;
        }
        let after_us = self.stamp_us(self.newest_us).saturating_add(1);
        let (hello, missing) = (self.hello.take(), self.missing);
        *self = Self { hello, missing, was_reset: true, ..Self::default() };
        after_us
    }

    fn pose(&mut self, pose: &Pose) {
        let gap = pose.number.saturating_sub(self.number).saturating_sub(1);
        if gap > 0 {
            self.lose(Missing { poses: gap, ..Missing::default() });
        }
        self.number = pose.number;
        if pose.cause == Cause::Scan {
            self.release(Some(pose.number));
        }
        self.waiting.push_back(*pose);
    }

    fn ticks(&mut self, ticks: &Ticks) {
        let next = self.next_sample.unwrap_or(0);
        if let Some(gap) = ticks.before.checked_sub(next).filter(|gap| *gap > 0) {
            self.release(None);
            self.lose(Missing { samples: gap, ..Missing::default() });
        }
        for (number, (stamp_us, [left, right])) in (ticks.before..).zip(ticks.samples()) {
            if number >= next {
                self.samples.push_back((number, WheelTicks { stamp_us, left, right }));
                self.next_sample = Some(number + 1);
            }
        }
    }

    /// What a recording that begins while the robot runs does not have is not missing from it.
    fn lose(&mut self, missing: Missing) {
        if self.is_joining() {
            self.joined = true;
        } else {
            self.missing.add(missing);
        }
    }

    fn is_joining(&self) -> bool {
        !self.was_reset && !self.has_begun
    }

    /// Gives out what is complete. Scans before number `later` will not come any more.
    fn release(&mut self, later: Option<u32>) {
        while let Some(pose) = self.waiting.front().copied() {
            let has_samples = self.next_sample.is_some_and(|next| next >= pose.samples) || pose.samples == 0;
            let scan = (pose.cause == Cause::Scan).then(|| self.parts.whole(pose.number));
            let is_late = later.is_some_and(|later| pose.number < later);
            match (scan, has_samples) {
                (Some(None), _) if is_late => {
                    self.waiting.pop_front();
                    self.lose(Missing { scans: 1, ..Missing::default() });
                }
                (Some(None), _) | (_, false) => return,
                (scan, true) => {
                    self.waiting.pop_front();
                    self.done(pose, scan.flatten());
                }
            }
        }
    }

    fn done(&mut self, pose: Pose, scan: Option<RobotScan>) {
        // The samples before it were not recorded.
        let is_early = self.samples.front().is_some_and(|(first, _)| *first > pose.samples);
        if self.is_joining() && is_early {
            self.joined = true;
            return;
        }
        if !std::mem::replace(&mut self.has_begun, true) {
            let kept = self.hello.as_ref().map(|hello| hello.kept);
            // A robot that has just forgotten its map has nothing that would not be known.
            let joined = self.joined && pose.cause != Cause::Forgotten;
            self.steps.push(Step::Began { joined, kept });
        }
        if !self.missing.is_none() {
            self.steps.push(Step::Missing(std::mem::take(&mut self.missing)));
        }
        let count = self.samples.iter().take_while(|(number, _)| *number < pose.samples).count();
        let samples = self.samples.drain(..count).map(|(_, sample)| sample).collect();
        let epoch_us = self.epoch_us.unwrap_or(0);
        self.steps.push(Step::Done(Act { samples, pose, scan, epoch_us }));
    }
}

/// The latest instant of the robot's clock that a message tells, microseconds.
fn clock_of(message: &FromRobot) -> Option<u64> {
    match message {
        FromRobot::Hello(hello) => Some(hello.uptime_us),
        FromRobot::Pose(pose) => Some(pose.at_us),
        FromRobot::Status(status) => Some(status.uptime_us),
        FromRobot::Health(health) => Some(health.uptime_us),
        FromRobot::Event(happened) => Some(happened.at_us),
        FromRobot::Ticks(ticks) => ticks.samples().last().map(|(stamp_us, _)| stamp_us),
        _ => None,
    }
}
