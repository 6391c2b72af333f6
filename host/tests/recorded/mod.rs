//! A robot on a simulated drive, with all that it says over its link: its mapper is the firmware's.
#![allow(dead_code)] // Each test file uses its part.

use std::path::{Path, PathBuf};
use std::sync::OnceLock;

use lineslam::log::{Log, Odometry};
use lineslam::robot::Robot;
use lineslam::sim::world::World;
use lineslam::sim::{SimConfig, drive};
use link::from_robot::*;
use link::ranges::{Packed, RANGES};
use link::{FromRobot, Streams};
use slam_core::capacity::{PLACES, SAMPLES, SEGMENTS};
use slam_core::geometry::pose::{components, pose};
use slam_core::tracking::TrackingState;
use slam_core::{Mapper, WheelTicks};

/// The firmware's.
type Firmware = Mapper<SEGMENTS, SAMPLES, 682, PLACES>;

pub fn robot_file() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../robots/paper.toml")
}

pub fn robot() -> Robot {
    Robot::load(&robot_file()).unwrap()
}

fn log() -> &'static Log {
    static LOG: OnceLock<Log> = OnceLock::new();
    LOG.get_or_init(|| {
        let hall = Path::new(env!("CARGO_MANIFEST_DIR")).join("../worlds/hall.toml");
        drive(&World::load(&hall).unwrap(), &robot(), &SimConfig::default(), 5).unwrap().log
    })
}

/// A robot that drives, and what it has said so far.
pub struct Driven {
    pub said: Vec<FromRobot>,
    mapper: Box<Firmware>,
    robot: Robot,
    odometry: usize,
    /// Counters as wide as the firmware's.
    ticks: [i32; 2],
    before: Option<[i64; 2]>,
    number: u32,
    samples: u32,
    waiting: Vec<WheelTicks>,
    /// Zero of its clock on that of the drive.
    began_us: u64,
    now_us: u64,
}

impl Driven {
    pub fn new() -> Self {
        let robot = robot();
        let mapper = mapper(&robot);
        let mut driven = Self {
            said: Vec::new(),
            mapper,
            robot,
            odometry: 0,
            ticks: [0; 2],
            before: None,
            number: 0,
            samples: 0,
            waiting: Vec::new(),
            began_us: 0,
            now_us: 0,
        };
        driven.hello(KeptMap::None);
        driven
    }

    /// Drives on for scans of these numbers.
    pub fn scans(&mut self, scans: std::ops::Range<usize>) {
        for number in scans {
            let scan = &log().scans[number];
            let middle_us = scan.stamp_us - self.began_us;
            self.take_samples(scan.stamp_us + 60_000);
            let revolution_us = 99_990 + (number % 23) as u32;
            self.mapper.set_revolution_us(revolution_us);
            let _ = self.mapper.scan(middle_us, &scan.ranges_mm);
            self.say_pose(Cause::Scan, middle_us);
            for (k, some) in scan.ranges_mm.chunks(RANGES).enumerate() {
                self.said.push(FromRobot::Ranges(Ranges {
                    number: self.number,
                    at_us: middle_us,
                    revolution_us,
                    beams: scan.ranges_mm.len() as u16,
                    first: (k * RANGES) as u16,
                    ranges: Packed::of(some),
                }));
            }
        }
    }

    /// Goes on by odometry to this instant of the drive.
    pub fn coast(&mut self, until_us: u64) {
        self.take_samples(until_us + 230_000);
        self.mapper.coast(until_us - self.began_us);
        self.say_pose(Cause::Coasted, until_us - self.began_us);
    }

    /// Does as it is told.
    pub fn told(&mut self, cause: Cause) {
        match cause {
            Cause::PoseSet([x, y, heading]) => self.mapper.set_pose(pose(x, y, heading)),
            Cause::Frozen => self.mapper.set_mapping(false),
            Cause::Unfrozen => self.mapper.set_mapping(true),
            Cause::Relocalising => self.mapper.relocalise(),
            Cause::Forgotten => self.mapper = mapper(&self.robot),
            other => panic!("{other:?}"),
        }
        self.say_pose(cause, self.now_us);
    }

    /// Is reset, and takes its map up again.
    pub fn reset(&mut self) {
        // Somewhat later its clock begins.
        self.began_us += self.now_us + 40_000;
        (self.number, self.samples, self.now_us) = (0, 0, 30_000);
        self.hello(KeptMap::Whole);
        self.mapper.resume();
        self.say_pose(Cause::Resumed, 0);
    }

    /// The instant of a scan of the drive, microseconds.
    pub fn at_us(&self, scan: usize) -> u64 {
        log().scans[scan].stamp_us
    }

    fn take_samples(&mut self, until_us: u64) {
        let wheels = self.robot.wheels.unwrap();
        while let Some((stamp_us, odometry)) =
            log().odometry.get(self.odometry).filter(|(at, _)| *at <= until_us)
        {
            self.odometry += 1;
            let Odometry::Ticks(counters) = odometry else { panic!("{odometry:?}") };
            let moved = self.before.map_or([0; 2], |before| wheels.ticks_between(before, *counters));
            self.before = Some(*counters);
            self.ticks = [0, 1].map(|side| self.ticks[side].wrapping_add(moved[side]));
            // What came while it was reset shows in the counters only.
            let Some(stamp_us) = stamp_us.checked_sub(self.began_us) else { continue };
            self.now_us = self.now_us.max(stamp_us);
            let [left, right] = self.ticks;
            let sample = WheelTicks { stamp_us, left, right };
            self.mapper.push(sample);
            self.waiting.push(sample);
        }
    }

    fn say_pose(&mut self, cause: Cause, at_us: u64) {
        self.number += 1;
        let before = self.samples;
        self.samples += self.waiting.len() as u32;
        let slam = self.mapper.slam();
        let c = slam.covariance();
        self.said.push(FromRobot::Pose(Pose {
            number: self.number,
            at_us,
            samples: self.samples,
            pose: components(&slam.pose()).into(),
            covariance: [c.m11, c.m12, c.m13, c.m22, c.m23, c.m33],
            state: match slam.state() {
                TrackingState::Tracking => State::Tracking,
                TrackingState::Uncertain => State::Uncertain,
                TrackingState::Lost => State::Lost,
            },
            lines: slam.map().segments().len() as u16,
            took_us: 4000,
            cause,
        }));
        for (k, some) in std::mem::take(&mut self.waiting).chunks(15).enumerate() {
            let first = (some[0].stamp_us, [some[0].left, some[0].right]);
            let mut ticks = Ticks::new(before + 15 * k as u32, first);
            for pair in some.windows(2) {
                let step = (
                    (pair[1].stamp_us - pair[0].stamp_us) as u32,
                    pair[1].left.wrapping_sub(pair[0].left),
                    pair[1].right.wrapping_sub(pair[0].right),
                );
                ticks.steps.push(step).unwrap();
            }
            self.said.push(FromRobot::Ticks(ticks));
        }
    }

    fn hello(&mut self, kept: KeptMap) {
        let config = self.robot.config();
        let (sensor, wheels) = (config.sensor, self.robot.wheels.unwrap());
        self.said.push(FromRobot::Hello(Hello {
            uptime_us: self.now_us,
            firmware: "0.1.0".try_into().unwrap(),
            board: "a test".try_into().unwrap(),
            robot: "paper".try_into().unwrap(),
            lines: SEGMENTS as u16,
            places: PLACES as u16,
            reset: ResetCause::Pin,
            kept,
            scanner: Scanner {
                beams: sensor.geometry.beams() as u16,
                first_bearing_rad: sensor.geometry.bearing(0),
                step_rad: sensor.geometry.step_rad(),
                min_mm: sensor.codes.min_mm,
                max_mm: sensor.codes.max_mm,
                base_from_laser: components(&sensor.mounting.base_from_laser).into(),
                upside_down: false,
                late_us: 0,
            },
            wheels: Wheels {
                radii_m: [wheels.left_radius_m, wheels.right_radius_m],
                track_m: wheels.track_m,
                ticks_per_turn: wheels.ticks_per_turn,
            },
            streams: Streams::DEFAULT,
        }));
    }

    /// Number of a pose, and the pose, of each scan that was said.
    pub fn scan_poses(&self) -> Vec<[u32; 3]> {
        let of_scan = |message: &FromRobot| match message {
            FromRobot::Pose(pose) if pose.cause == Cause::Scan => Some(pose.pose.map(f32::to_bits)),
            _ => None,
        };
        self.said.iter().filter_map(of_scan).collect()
    }
}

fn mapper(robot: &Robot) -> Box<Firmware> {
    Box::new(Mapper::new(robot.config(), robot.drive()).unwrap())
}

/// A drive on which everything happens that may be done to a robot.
pub fn eventful() -> Driven {
    let mut driven = Driven::new();
    driven.scans(0..60);
    // Scans stay away.
    for scan in 61..80 {
        driven.coast(driven.at_us(scan));
    }
    driven.scans(84..120);
    driven.told(Cause::Frozen);
    driven.scans(120..130);
    driven.told(Cause::Unfrozen);
    driven.scans(130..150);
    driven.reset();
    driven.scans(156..200);
    driven.told(Cause::PoseSet([0.1, -0.05, 0.02]));
    driven.scans(200..210);
    driven.told(Cause::Forgotten);
    driven.scans(210..240);
    driven
}
