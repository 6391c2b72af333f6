//! A run as ROS 2 messages in an MCAP file, as rosbag2 records them: for `ros2 bag play`, RViz and Foxglove.
//!
//! | topic | what |
//! |---|---|
//! | `/scan` | every scan, stamped with the instant of its first beam |
//! | `/joint_states` | how far the wheels have turned, where the log tells |
//! | `/odom` | dead reckoning |
//! | `/pose` | the pose as the robot knew it then, with its covariance |
//! | `/tf`, `/tf_static` | `map` → `odom` → `base_link` → `laser` |
//! | `/path`, `/map`, `/segments` | at the end: path, occupancy grid and segments of the final map |
//!
//! Frames follow REP 105, ranges REP 117: +∞ where nothing was in range, NaN where nothing could be measured.

mod definitions;
pub(crate) mod file;
pub(crate) mod messages;
pub(crate) mod scan;

use std::f64::consts::PI;
use std::io::Cursor;

use nalgebra::{Isometry2, Point2};
use slam_core::MapSegment;

use super::grid::Grid;
use crate::log::{self, Log};
use crate::replay::{ESTABLISHED_HITS, Replay, Step};
pub use file::RecordingError;
use file::{File, Seeks, header, nanoseconds};
use messages::{
    Colour, Covariance, JointState, Marker, MarkerArray, OccupancyGrid, Odometry, Path, Pose, PoseStamped,
    PoseWithCovariance, PoseWithCovarianceStamped, TfMessage, Time, TransformStamped, Vector3,
};
use scan::{Frames, first_beam_ns, scan};

pub(crate) const MAP: &str = "map";
const ODOM: &str = "odom";
pub(crate) const BASE: &str = "base_link";
pub(crate) const WHEELS: [&str; 2] = ["wheel_left_joint", "wheel_right_joint"];

const SEGMENT_WIDTH_M: f64 = 0.04;
const SURE: Colour = Colour { r: 0.16, g: 0.47, b: 0.71, a: 1.0 };
const TENTATIVE: Colour = Colour { a: 0.3, ..SURE };

/// What is written at an instant.
#[derive(Clone, Copy)]
enum Event {
    Scan(usize),
    Wheels([f64; 2]),
    Step(usize),
}

/// Renders the recording of a replayed log.
pub fn render(log: &Log, replay: &Replay, grid: &Grid) -> Result<Vec<u8>, RecordingError> {
    let frames = Frames::of(log, replay);
    let mut events: Vec<(u64, Event)> = Vec::new();
    for (k, step) in replay.steps.iter().enumerate() {
        events.push((first_beam_ns(log, replay, k), Event::Scan(k)));
        events.push((nanoseconds(step.stamp_us), Event::Step(k)));
    }
    events.extend(wheel_angles(log, replay).map(|(stamp_us, at)| (nanoseconds(stamp_us), Event::Wheels(at))));
    events.sort_by_key(|(ns, _)| *ns);
    let mut recording = File::new(Cursor::new(Vec::new()), Seeks::Back)?;
    if let Some((ns, _)) = events.first() {
        recording.write("/tf_static", *ns, &frames.message(*ns))?;
    }
    for &(ns, event) in &events {
        match event {
            Event::Scan(k) => recording.write("/scan", ns, &scan(log, replay, &frames, k, ns))?,
            Event::Wheels(position) => {
                let header = header(ns, "");
                let message =
                    JointState { header, name: &WHEELS, position: &position, velocity: &[], effort: &[] };
                recording.write("/joint_states", ns, &message)?;
            }
            Event::Step(k) => {
                let (step, before) = (&replay.steps[k], k.checked_sub(1).map(|k| &replay.steps[k]));
                recording.write("/odom", ns, &odometry(step, before, ns))?;
                recording.write("/tf", ns, &transforms(step, ns))?;
                recording.write("/pose", ns, &pose(step, ns))?;
            }
        }
    }
    if let Some((ns, _)) = events.last() {
        recording.write("/path", *ns, &path(replay, *ns))?;
        recording.write("/map", *ns, &occupancy(grid, *ns))?;
        recording.write("/segments", *ns, &segments(replay, *ns))?;
    }
    Ok(recording.finish()?.into_inner())
}

/// Stamps and angles of the left and right wheel, radians; none where the log has poses.
fn wheel_angles(log: &Log, replay: &Replay) -> impl Iterator<Item = (u64, [f64; 2])> {
    let wheels = replay.robot.wheels;
    let mut before = None;
    let mut total = [0i64; 2];
    log.odometry.iter().filter_map(move |(stamp_us, odometry)| match odometry {
        log::Odometry::Ticks(ticks) => {
            let wheels = wheels?;
            let moved = before.map_or([0; 2], |before| wheels.ticks_between(before, *ticks));
            before = Some(*ticks);
            total = [0, 1].map(|side| total[side] + i64::from(moved[side]));
            Some((*stamp_us, total.map(|ticks| ticks as f64 * 2.0 * PI / f64::from(wheels.ticks_per_turn))))
        }
        log::Odometry::Angles(angles) => Some((*stamp_us, *angles)),
        log::Odometry::Pose(_) => None,
    })
}

/// The same pose with digits enough to be taken apart and put together again.
pub(crate) fn exact(pose: &Isometry2<f32>) -> Isometry2<f64> {
    let (re, im) = (f64::from(pose.rotation.re), f64::from(pose.rotation.im));
    Isometry2::new(pose.translation.vector.map(f64::from), im.atan2(re))
}

fn odometry(step: &Step, before: Option<&Step>, ns: u64) -> Odometry<'static> {
    let since_s = before.map_or(0.0, |before| (step.stamp_us - before.stamp_us) as f64 * 1e-6);
    let per_second = |moved: f32| if since_s > 0.0 { f64::from(moved) / since_s } else { 0.0 };
    let moved = &step.motion.since_previous;
    let way = moved.before_from_after.translation.vector;
    Odometry {
        header: header(ns, ODOM),
        child_frame_id: BASE,
        pose: PoseWithCovariance {
            pose: Pose::of(&exact(&step.odometry)),
            covariance: Covariance::default(),
        },
        twist_linear: Vector3 { x: per_second(way.x), y: per_second(way.y), z: 0.0 },
        twist_angular: Vector3 {
            z: per_second(moved.before_from_after.rotation.angle()),
            ..Vector3::default()
        },
        twist_covariance: Covariance::default(),
    }
}

/// `map` → `odom` → `base_link`, which together are the pose.
fn transforms(step: &Step, ns: u64) -> TfMessage<'static> {
    let odom_from_base = exact(&step.odometry);
    let map_from_odom = exact(&step.pose) * odom_from_base.inverse();
    let stamped = |frame: &'static str, child: &'static str, transform: &Isometry2<f64>| TransformStamped {
        header: header(ns, frame),
        child_frame_id: child,
        transform: Pose::of(transform),
    };
    TfMessage { transforms: vec![stamped(MAP, ODOM, &map_from_odom), stamped(ODOM, BASE, &odom_from_base)] }
}

fn pose(step: &Step, ns: u64) -> PoseWithCovarianceStamped<'static> {
    // x, y and θ are the first, second and last of six.
    const AXES: [usize; 3] = [0, 1, 5];
    let mut covariance = Covariance::default();
    for (row, &to_row) in AXES.iter().enumerate() {
        for (column, &to_column) in AXES.iter().enumerate() {
            covariance[to_row][to_column] = step.update.covariance[(row, column)].into();
        }
    }
    let pose = PoseWithCovariance { pose: Pose::of(&exact(&step.pose)), covariance };
    PoseWithCovarianceStamped { header: header(ns, MAP), pose }
}

fn path(replay: &Replay, ns: u64) -> Path<'static> {
    let poses = replay.steps.iter().map(|step| PoseStamped {
        header: header(nanoseconds(step.stamp_us), MAP),
        pose: Pose::of(&exact(&step.pose_in_final_map)),
    });
    Path { header: header(ns, MAP), poses: poses.collect() }
}

fn occupancy(grid: &Grid, ns: u64) -> OccupancyGrid<'_> {
    let position = Vector3 { x: grid.origin.x, y: grid.origin.y, z: 0.0 };
    OccupancyGrid {
        header: header(ns, MAP),
        map_load_time: Time::of_ns(ns),
        resolution: grid.cell_m as f32,
        width: grid.width,
        height: grid.height,
        origin: Pose { position, ..Pose::IDENTITY },
        data: &grid.cells,
    }
}

/// Two bundles of lines: the established segments, and faintly the others.
fn segments(replay: &Replay, ns: u64) -> MarkerArray<'static> {
    let corner = |point: Point2<f32>| Vector3 { x: point.x.into(), y: point.y.into(), z: 0.0 };
    let (sure, tentative): (Vec<&MapSegment>, Vec<&MapSegment>) =
        replay.map.iter().partition(|entry| entry.hits >= ESTABLISHED_HITS);
    let markers = [(sure, SURE), (tentative, TENTATIVE)].into_iter().zip(0..);
    // RViz complains about lines without points.
    let markers = markers.filter(|((entries, _), _)| !entries.is_empty()).map(|((entries, colour), id)| {
        let points = entries.iter().flat_map(|e| [e.segment().start, e.segment().end]).map(corner);
        Marker::lines(header(ns, MAP), id, SEGMENT_WIDTH_M, colour, points.collect())
    });
    MarkerArray { markers: markers.collect() }
}
