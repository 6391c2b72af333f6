//! The ROS 2 messages that a recording holds. Fields stand in the order of their definitions, as CDR has no names.

use nalgebra::Isometry2;
use serde::Serialize;

/// A message with a type name of its own on a topic.
pub trait Message: Serialize {
    /// Such as `sensor_msgs/LaserScan`.
    const TYPE: &'static str;
}

macro_rules! message {
    ($name:ident, $type:literal) => {
        impl Message for $name<'_> {
            const TYPE: &'static str = $type;
        }
    };
}

message!(LaserScan, "sensor_msgs/LaserScan");
message!(JointState, "sensor_msgs/JointState");
message!(Odometry, "nav_msgs/Odometry");
message!(Path, "nav_msgs/Path");
message!(OccupancyGrid, "nav_msgs/OccupancyGrid");
message!(PoseWithCovarianceStamped, "geometry_msgs/PoseWithCovarianceStamped");
message!(TfMessage, "tf2_msgs/TFMessage");
message!(MarkerArray, "visualization_msgs/MarkerArray");
message!(Log, "rcl_interfaces/Log");
message!(Bytes, "std_msgs/UInt8MultiArray");

#[derive(Clone, Copy, Serialize)]
pub struct Time {
    sec: i32,
    nanosec: u32,
}

impl Time {
    pub fn of_ns(ns: u64) -> Self {
        let sec = i32::try_from(ns / 1_000_000_000).unwrap_or(i32::MAX);
        Self { sec, nanosec: (ns % 1_000_000_000) as u32 }
    }
}

#[derive(Clone, Copy, Serialize)]
pub struct Header<'a> {
    pub stamp: Time,
    pub frame_id: &'a str,
}

#[derive(Clone, Copy, Default, Serialize)]
pub struct Vector3 {
    pub x: f64,
    pub y: f64,
    pub z: f64,
}

#[derive(Clone, Copy, Serialize)]
pub struct Quaternion {
    pub x: f64,
    pub y: f64,
    pub z: f64,
    pub w: f64,
}

/// A pose; a transform has the same bytes.
#[derive(Clone, Copy, Serialize)]
pub struct Pose {
    pub position: Vector3,
    pub orientation: Quaternion,
}

impl Pose {
    pub const IDENTITY: Self = Self {
        position: Vector3 { x: 0.0, y: 0.0, z: 0.0 },
        orientation: Quaternion { x: 0.0, y: 0.0, z: 0.0, w: 1.0 },
    };

    pub fn of(pose: &Isometry2<f64>) -> Self {
        let half = 0.5 * pose.rotation.angle();
        Self {
            position: Vector3 { x: pose.translation.x, y: pose.translation.y, z: 0.0 },
            orientation: Quaternion { x: 0.0, y: 0.0, z: half.sin(), w: half.cos() },
        }
    }

    /// The same place, turned by half a turn about its own x.
    pub fn head_down(self) -> Self {
        let Quaternion { z, w, .. } = self.orientation;
        Self { orientation: Quaternion { x: w, y: z, z: 0.0, w: 0.0 }, ..self }
    }
}

/// Covariance of (x, y, z, roll, pitch, yaw), row by row.
pub type Covariance = [[f64; 6]; 6];

#[derive(Serialize)]
pub struct LaserScan<'a> {
    pub header: Header<'a>,
    pub angle_min: f32,
    pub angle_max: f32,
    pub angle_increment: f32,
    pub time_increment: f32,
    pub scan_time: f32,
    pub range_min: f32,
    pub range_max: f32,
    pub ranges: Vec<f32>,
    pub intensities: &'a [f32],
}

#[derive(Serialize)]
pub struct JointState<'a> {
    pub header: Header<'a>,
    pub name: &'a [&'a str],
    pub position: &'a [f64],
    pub velocity: &'a [f64],
    pub effort: &'a [f64],
}

/// Bytes of which ROS knows nothing.
#[derive(Serialize)]
pub struct Bytes<'a> {
    /// None: labels are strings.
    dimensions: &'a [&'a str],
    data_offset: u32,
    data: &'a [u8],
}

impl<'a> Bytes<'a> {
    pub fn new(data: &'a [u8]) -> Self {
        Self { dimensions: &[], data_offset: 0, data }
    }
}

/// A line of a log, as `/rosout` has it.
#[derive(Serialize)]
pub struct Log<'a> {
    pub stamp: Time,
    pub level: u8,
    pub name: &'a str,
    pub msg: &'a str,
    pub file: &'a str,
    pub function: &'a str,
    pub line: u32,
}

impl<'a> Log<'a> {
    pub const INFO: u8 = 20;
    pub const WARN: u8 = 30;

    pub fn new(ns: u64, level: u8, msg: &'a str) -> Self {
        Self { stamp: Time::of_ns(ns), level, name: "lineslam", msg, file: "", function: "", line: 0 }
    }
}

#[derive(Serialize)]
pub struct PoseWithCovariance {
    pub pose: Pose,
    pub covariance: Covariance,
}

#[derive(Serialize)]
pub struct PoseWithCovarianceStamped<'a> {
    pub header: Header<'a>,
    pub pose: PoseWithCovariance,
}

#[derive(Serialize)]
pub struct Odometry<'a> {
    pub header: Header<'a>,
    pub child_frame_id: &'a str,
    pub pose: PoseWithCovariance,
    pub twist_linear: Vector3,
    pub twist_angular: Vector3,
    pub twist_covariance: Covariance,
}

#[derive(Serialize)]
pub struct PoseStamped<'a> {
    pub header: Header<'a>,
    pub pose: Pose,
}

#[derive(Serialize)]
pub struct Path<'a> {
    pub header: Header<'a>,
    pub poses: Vec<PoseStamped<'a>>,
}

#[derive(Serialize)]
pub struct TransformStamped<'a> {
    pub header: Header<'a>,
    pub child_frame_id: &'a str,
    pub transform: Pose,
}

#[derive(Serialize)]
pub struct TfMessage<'a> {
    pub transforms: Vec<TransformStamped<'a>>,
}

#[derive(Serialize)]
pub struct OccupancyGrid<'a> {
    pub header: Header<'a>,
    pub map_load_time: Time,
    pub resolution: f32,
    pub width: u32,
    pub height: u32,
    pub origin: Pose,
    pub data: &'a [i8],
}

#[derive(Clone, Copy, Serialize)]
pub struct Colour {
    pub r: f32,
    pub g: f32,
    pub b: f32,
    pub a: f32,
}

#[derive(Serialize)]
pub struct CompressedImage<'a> {
    pub header: Header<'a>,
    pub format: &'a str,
    pub data: &'a [u8],
}

#[derive(Serialize)]
pub struct MeshFile<'a> {
    pub filename: &'a str,
    pub data: &'a [u8],
}

#[derive(Serialize)]
pub struct Marker<'a> {
    pub header: Header<'a>,
    pub ns: &'a str,
    pub id: i32,
    pub kind: i32,
    pub action: i32,
    pub pose: Pose,
    pub scale: Vector3,
    pub color: Colour,
    /// Zero: until it is replaced.
    pub lifetime: Time,
    pub frame_locked: bool,
    pub points: Vec<Vector3>,
    pub colors: &'a [Colour],
    pub texture_resource: &'a str,
    pub texture: CompressedImage<'a>,
    pub uv_coordinates: &'a [[f32; 2]],
    pub text: &'a str,
    pub mesh_resource: &'a str,
    pub mesh_file: MeshFile<'a>,
    pub mesh_use_embedded_materials: bool,
}

impl<'a> Marker<'a> {
    const LINE_LIST: i32 = 5;
    const ADD: i32 = 0;

    /// Lines between each two points.
    pub fn lines(header: Header<'a>, id: i32, width_m: f64, color: Colour, points: Vec<Vector3>) -> Self {
        Self {
            header,
            ns: "segments",
            id,
            kind: Self::LINE_LIST,
            action: Self::ADD,
            pose: Pose::IDENTITY,
            scale: Vector3 { x: width_m, ..Vector3::default() },
            color,
            lifetime: Time::of_ns(0),
            frame_locked: false,
            points,
            colors: &[],
            texture_resource: "",
            texture: CompressedImage {
                header: Header { stamp: Time::of_ns(0), frame_id: "" },
                format: "",
                data: &[],
            },
            uv_coordinates: &[],
            text: "",
            mesh_resource: "",
            mesh_file: MeshFile { filename: "", data: &[] },
            mesh_use_embedded_materials: false,
        }
    }
}

#[derive(Serialize)]
pub struct MarkerArray<'a> {
    pub markers: Vec<Marker<'a>>,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn head_down_is_half_a_turn_about_x_of_the_sensor() {
        let upright = Pose::of(&Isometry2::new(nalgebra::Vector2::new(1.0, 2.0), 0.6));
        let turned = upright.head_down().orientation;
        // Rz(0.6) · Rx(π): x of the sensor stays where it was, its z points down.
        let expected = nalgebra::UnitQuaternion::from_euler_angles(std::f64::consts::PI, 0.0, 0.6);
        let turned = nalgebra::Quaternion::new(turned.w, turned.x, turned.y, turned.z);
        assert!((turned.dot(expected.quaternion()).abs() - 1.0).abs() < 1e-12);
    }

    #[test]
    fn stamps_are_split_into_seconds_and_nanoseconds() {
        let time = Time::of_ns(1_700_000_000_123_456_789);
        assert_eq!((time.sec, time.nanosec), (1_700_000_000, 123_456_789));
    }
}
