//! What a robot says as ROS 2 messages, for RViz, Foxglove and whoever reads bags.

use std::f64::consts::PI;

use nalgebra::Isometry2;
use slam_core::geometry::pose::pose;
use slam_core::sensor::scan::{Mounting, RangeCodes};

use super::course::RobotScan;
use crate::link::from_robot::{Hello, Pose as Said, Scanner};
use crate::output::mcap::file::header;
use crate::output::mcap::messages::{
    Covariance, LaserScan, Pose, PoseWithCovariance, PoseWithCovarianceStamped, TfMessage, TransformStamped,
};
use crate::output::mcap::scan::{LASER, base_from_laser, metres, range_m};
use crate::output::mcap::{BASE, MAP};
use crate::robot::{StatedGeometry, Wheels};

/// How the robot's beams lie, with a revolution of this long.
pub fn geometry(scanner: &Scanner, revolution_us: u32) -> StatedGeometry {
    let limit_m = |mm: u16| metres(mm.into());
    StatedGeometry {
        first_bearing_rad: scanner.first_bearing_rad,
        step_rad: scanner.step_rad,
        revolution_s: revolution_us as f32 * 1e-6,
        // What is at the greatest or beyond met nothing.
        limits_m: Some([limit_m(scanner.min_mm), limit_m(scanner.max_mm.saturating_add(1))]),
        base_from_laser: Some(scanner.base_from_laser),
        upside_down: scanner.upside_down,
    }
}

/// The robot's wheels, if it has said that it has any.
pub fn wheels(hello: &Hello) -> Option<Wheels> {
    let said = hello.wheels;
    let [left_radius_m, right_radius_m] = said.radii_m;
    (said.ticks_per_turn > 0.0).then_some(Wheels {
        left_radius_m,
        right_radius_m,
        track_m: said.track_m,
        ticks_per_turn: said.ticks_per_turn,
        counter_bits: 32,
    })
}

/// From the first beam of a scan to its middle one, nanoseconds.
pub fn to_middle_ns(scanner: &Scanner, scan: &RobotScan) -> u64 {
    let beams = scan.ranges_mm.len().saturating_sub(1) as f64;
    (f64::from(time_increment(scanner, scan)) * beams * 0.5e9).round() as u64
}

/// Time from beam to beam, seconds.
fn time_increment(scanner: &Scanner, scan: &RobotScan) -> f32 {
    (f64::from(scan.revolution_us) * 1e-6 * f64::from(scanner.step_rad.abs()) / (2.0 * PI)) as f32
}

/// A scan whose first beam was taken at `ns`.
pub fn scan<'a>(scanner: &Scanner, scan: &RobotScan, ns: u64) -> LaserScan<'a> {
    let codes = RangeCodes { min_mm: scanner.min_mm, max_mm: scanner.max_mm, ..RangeCodes::URG_04LX };
    let beams = scan.ranges_mm.len().saturating_sub(1) as f32;
    LaserScan {
        header: header(ns, LASER),
        angle_min: scanner.first_bearing_rad,
        angle_max: scanner.first_bearing_rad + beams * scanner.step_rad,
        angle_increment: scanner.step_rad,
        time_increment: time_increment(scanner, scan),
        scan_time: scan.revolution_us as f32 * 1e-6,
        range_min: metres(codes.min_mm.into()),
        range_max: metres(u32::from(codes.max_mm) + 1),
        ranges: scan.ranges_mm.iter().map(|&mm| range_m(codes.read(mm), mm)).collect(),
        intensities: &[],
    }
}

/// Where the scanner is on the robot.
pub fn mounting<'a>(scanner: &Scanner, ns: u64) -> TfMessage<'a> {
    let [x, y, heading] = scanner.base_from_laser;
    let mounting = Mounting { base_from_laser: pose(x, y, heading), upside_down: scanner.upside_down };
    TfMessage { transforms: vec![base_from_laser(&mounting, LASER, ns)] }
}

fn map_from_base(said: &Said) -> Isometry2<f64> {
    let [x, y, heading] = said.pose.map(f64::from);
    Isometry2::new([x, y].into(), heading)
}

/// Where the robot is.
pub fn transform<'a>(said: &Said, ns: u64) -> TfMessage<'a> {
    let transform = Pose::of(&map_from_base(said));
    TfMessage {
        transforms: vec![TransformStamped { header: header(ns, MAP), child_frame_id: BASE, transform }],
    }
}

/// The same with its covariance.
pub fn pose_message<'a>(said: &Said, ns: u64) -> PoseWithCovarianceStamped<'a> {
    // x, y and θ are the first, second and last of six.
    const AXES: [usize; 3] = [0, 1, 5];
    let [xx, xy, xt, yy, yt, tt] = said.covariance.map(f64::from);
    let mut covariance = Covariance::default();
    for (row, values) in AXES.into_iter().zip([[xx, xy, xt], [xy, yy, yt], [xt, yt, tt]]) {
        for (column, value) in AXES.into_iter().zip(values) {
            covariance[row][column] = value;
        }
    }
    let pose = PoseWithCovariance { pose: Pose::of(&map_from_base(said)), covariance };
    PoseWithCovarianceStamped { header: header(ns, MAP), pose }
}

/// How far the wheels have turned, radians.
pub fn angles(ticks: [i32; 2], ticks_per_turn: f32) -> [f64; 2] {
    ticks.map(|ticks| f64::from(ticks) * 2.0 * PI / f64::from(ticks_per_turn))
}
