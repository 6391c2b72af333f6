//! What a robot said over its link, as a log: scans and ticks for whoever reads any log, and the course of what was done to its map.

use crate::link::FromRobot;
use crate::link::from_robot::Hello;
use crate::log::records::{Records, ScanRecord, Source};
use crate::log::{Odometry, Warning};
use crate::recording::body_of;
use crate::recording::course::{Act, Gatherer, Missing, Step};
use crate::recording::ros::{geometry, wheels};
use crate::robot::StatedGeometry;

/// The name of the format.
pub(super) const FORMAT: &str = "robot";

/// What was done to a robot's map while it was recorded.
#[derive(Clone, Debug, Default)]
pub struct Course {
    /// Who it is, if it said so.
    pub hello: Option<Hello>,
    /// One after the other, each with the message of the file that completed it.
    pub steps: Vec<(usize, Step)>,
    /// What never came, in all.
    pub missing: Missing,
    /// The robot had driven before the recording began.
    pub joined: bool,
    /// Times that it was reset.
    pub resets: u32,
}

/// What is read of a recording.
#[derive(Debug, Default)]
pub(super) struct RobotLog {
    gatherer: Gatherer,
    course: Course,
    runs: u32,
    /// Of this run's first scan: a revolution that varies would make each scan one of another scanner.
    geometry: Option<StatedGeometry>,
}

impl RobotLog {
    /// Takes a message that was recorded at this instant.
    pub fn take(&mut self, place: usize, recorded_ns: i64, bytes: &[u8], records: &mut Records) {
        let Some(message) = body_of(bytes).and_then(FromRobot::decode) else {
            // Of a firmware that says more than is known here.
            records.skip("unknown_message");
            return;
        };
        let received_us = u64::try_from(recorded_ns).unwrap_or(0) / 1000;
        for step in self.gatherer.take(&message, received_us) {
            match &step {
                Step::Began { joined, .. } => {
                    self.course.joined |= joined;
                    self.runs += 1;
                    self.geometry = None;
                }
                Step::Missing(missing) => self.course.missing.add(*missing),
                Step::Done(act) => self.done(act, place, records),
            }
            self.course.steps.push((place, step));
        }
        if let FromRobot::Hello(hello) = message {
            records.wheels = wheels(&hello).or(records.wheels);
            self.course.hello = Some(hello);
        }
    }

    fn done(&mut self, act: &Act, place: usize, records: &mut Records) {
        let stamp = |robot_us: u64| i64::try_from(act.epoch_us.saturating_add(robot_us)).unwrap_or(i64::MAX);
        for sample in &act.samples {
            let ticks = Odometry::Ticks([sample.left, sample.right].map(i64::from));
            records.odometry(place, stamp(sample.stamp_us), Source::Own, ticks);
        }
        let Some(scan) = &act.scan else { return };
        let scanner = self.gatherer.hello().map(|hello| hello.scanner);
        let stated =
            scanner.map(|of| *self.geometry.get_or_insert_with(|| geometry(&of, scan.revolution_us)));
        // As its sensor had it: what the robot took off, its robot file says.
        let late_us = scanner.map_or(0, |of| i64::from(of.late_us));
        let stamp_us = stamp(scan.middle_us).saturating_add(late_us);
        let geometry = stated.map(|stated| records.geometry(stated));
        records.scans.push(ScanRecord { place, stamp_us, ranges_mm: scan.ranges_mm.clone(), geometry });
    }

    /// Hands over the course, and says what is missing.
    pub fn finish(mut self, records: &mut Records) {
        self.course.resets = self.runs.saturating_sub(1);
        let missing = self.course.missing;
        if !missing.is_none() {
            let message = format!(
                "{} missing from the recording: replay will not be bit for bit what the robot did",
                missing.words()
            );
            records.warnings.push(Warning::new("missing_from_recording", message));
        }
        if self.course.joined {
            let message = "the robot had driven before the recording began: replay begins a new map there, and will not be bit for \
                           bit what the robot did (record --forget begins one on the robot too)";
            records.warnings.push(Warning::new("recording_begins_in_drive", message));
        }
        records.course = Some(self.course);
    }
}
