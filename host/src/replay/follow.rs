//! A recording of a robot through the core, in the order in which the robot did it, so that the same bits come out.
//!
//! A replay of any other log hands odometry over as far as it is needed, and knows nothing but scans; a robot takes in what has come by
//! then, coasts where scans stay away, is reset, and does as it is told. All of that is in the [`Course`], and done again here.

use std::time::Instant;

use serde::Serialize;
use slam_core::capacity::{PLACES, SEGMENTS};
use slam_core::geometry::pose::{components, pose};
use slam_core::{Mapper, ScanMotion, SlamUpdate};

use crate::link::from_robot::{Cause, KeptMap, Pose};
use crate::link::words;
use crate::log::Course;
use crate::recording::course::{Act, Step};

/// How the poses that were computed here compare with those that the robot said, to the last bit.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Agreement {
    /// The same.
    pub same: usize,
    /// Another, though all that it comes from is in the recording.
    pub different: usize,
    /// The first of these: the robot's number of it.
    pub first_different: Option<u32>,
    /// After something that is missing, which leaves nothing to compare.
    pub unknown: usize,
}

/// What came of a scan that the robot had taken in.
pub(super) struct Followed {
    /// The message of the file that completed it.
    pub place: usize,
    pub motion: ScanMotion,
    pub update: SlamUpdate,
    pub took: std::time::Duration,
}

/// A course on its way through a mapper.
pub(super) struct Follower<'a> {
    course: &'a Course,
    next: usize,
    /// Whether all that the robot's map comes from has been done here.
    is_known: bool,
    /// Of a robot that has begun, how: its first act says the rest.
    began: Option<(bool, Option<KeptMap>)>,
    agreement: Agreement,
}

impl<'a> Follower<'a> {
    pub fn new(course: &'a Course) -> Self {
        Self { course, next: 0, is_known: false, began: None, agreement: Agreement::default() }
    }

    pub fn agreement(&self) -> Agreement {
        self.agreement
    }

    /// Goes on to the next scan that gave a pose. `anew` makes a mapper that knows nothing.
    pub fn step<const K: usize, const BEAMS: usize, E>(
        &mut self,
        mapper: &mut Box<Mapper<SEGMENTS, K, BEAMS, PLACES>>,
        anew: impl Fn() -> Result<Box<Mapper<SEGMENTS, K, BEAMS, PLACES>>, E>,
    ) -> Result<Option<Followed>, E> {
        while let Some((place, step)) = self.course.steps.get(self.next) {
            self.next += 1;
            match step {
                Step::Began { joined, kept } => self.began = Some((*joined, *kept)),
                Step::Missing(_) => self.is_known = false,
                Step::Done(act) => {
                    if let Some((joined, kept)) = self.began.take() {
                        self.begin(mapper, act, joined, kept, &anew)?;
                    }
                    let followed = self.act(mapper, act, &anew)?;
                    self.compare(mapper, &act.pose);
                    if let Some((motion, update, took)) = followed {
                        return Ok(Some(Followed { place: *place, motion, update, took }));
                    }
                }
            }
        }
        Ok(None)
    }

    /// The robot has started. With its kept map it says so in its first act; without one it knows nothing.
    fn begin<const K: usize, const BEAMS: usize, E>(
        &mut self,
        mapper: &mut Box<Mapper<SEGMENTS, K, BEAMS, PLACES>>,
        act: &Act,
        joined: bool,
        kept: Option<KeptMap>,
        anew: impl Fn() -> Result<Box<Mapper<SEGMENTS, K, BEAMS, PLACES>>, E>,
    ) -> Result<(), E> {
        let is_first = act.pose.number == 1;
        if is_first && !matches!(act.pose.cause, Cause::Resumed | Cause::Recovered) {
            *mapper = anew()?;
            self.is_known = !joined;
        } else if !is_first {
            // What it did at first did not come.
            self.is_known = false;
            match kept {
                Some(KeptMap::Whole | KeptMap::HalfDone) => mapper.resume(),
                _ => *mapper = anew()?,
            }
        }
        Ok(())
    }

    /// Does what the robot did. What came of it, if it was a scan.
    #[allow(clippy::type_complexity, reason = "three things that belong together for one call")]
    fn act<const K: usize, const BEAMS: usize, E>(
        &mut self,
        mapper: &mut Box<Mapper<SEGMENTS, K, BEAMS, PLACES>>,
        act: &Act,
        anew: impl Fn() -> Result<Box<Mapper<SEGMENTS, K, BEAMS, PLACES>>, E>,
    ) -> Result<Option<(ScanMotion, SlamUpdate, std::time::Duration)>, E> {
        if act.pose.cause == Cause::Resumed {
            mapper.resume();
        }
        act.samples.iter().for_each(|sample| mapper.push(*sample));
        match act.pose.cause {
            Cause::Resumed => {}
            // What was half done when the reset came is known to the robot alone.
            Cause::Recovered => {
                mapper.recover();
                self.is_known = false;
            }
            Cause::Scan => {
                let Some(scan) = &act.scan else { return Ok(None) };
                mapper.set_revolution_us(scan.revolution_us);
                let motion = mapper.motion(scan.middle_us);
                let started = Instant::now();
                let update = mapper.scan(scan.middle_us, &scan.ranges_mm);
                let took = started.elapsed();
                return Ok(motion.zip(update).map(|(motion, update)| (motion, update, took)));
            }
            Cause::Coasted => drop(mapper.coast(act.pose.at_us)),
            Cause::Forgotten => {
                *mapper = anew()?;
                self.is_known = true;
            }
            Cause::PoseSet([x, y, heading]) => mapper.set_pose(pose(x, y, heading)),
            Cause::Frozen => mapper.set_mapping(false),
            Cause::Unfrozen => mapper.set_mapping(true),
            Cause::Relocalising => mapper.relocalise(),
        }
        Ok(None)
    }

    fn compare<const K: usize, const BEAMS: usize>(
        &mut self,
        mapper: &Mapper<SEGMENTS, K, BEAMS, PLACES>,
        said: &Pose,
    ) {
        if !self.is_known {
            self.agreement.unknown += 1;
            return;
        }
        let slam = mapper.slam();
        let here: [f32; 3] = components(&slam.pose()).into();
        let is_same = here.map(f32::to_bits) == said.pose.map(f32::to_bits)
            && slam.map().segments().len() == usize::from(said.lines)
            && slam.state() == words::state_of(said.state);
        if is_same {
            self.agreement.same += 1;
        } else {
            self.agreement.different += 1;
            self.agreement.first_different.get_or_insert(said.number);
        }
    }
}
