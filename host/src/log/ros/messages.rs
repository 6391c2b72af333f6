//! The four kinds of ROS messages that are read, as bytes of ROS 1 and as CDR of ROS 2.
//!
//! Only the fields up to the last wanted one are named here; what follows them in a message is not looked at. Both decoders
//! check every length against the bytes that there are before they use it, and serde reserves no more than 1 MiB for a
//! sequence before its elements have been seen.

use roslibrust_serde_rosmsg::Deserializer;
use serde::Deserialize;
use serde::de::DeserializeOwned;

/// How the bytes of a message are laid out.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Encoding {
    /// ROS 1.
    Ros1,
    /// The Common Data Representation of ROS 2.
    Cdr,
    /// Another one; such messages are counted only.
    Other,
}

impl Encoding {
    /// By its name in MCAP and in SQLite bags.
    pub fn named(name: &str) -> Self {
        match name {
            "ros1" => Self::Ros1,
            "cdr" => Self::Cdr,
            _ => Self::Other,
        }
    }
}

/// std_msgs/Header.
#[derive(Clone, Debug)]
pub struct Header {
    /// Stamp, nanoseconds; zero where the sender left it out.
    pub stamp_ns: i64,
    /// The frame, without leading slashes.
    pub frame: String,
}

#[derive(Deserialize)]
struct Header1 {
    #[allow(dead_code)] // It stands before the stamp.
    seq: u32,
    sec: u32,
    nsec: u32,
    frame_id: String,
}

#[derive(Deserialize)]
struct Header2 {
    sec: i32,
    nanosec: u32,
    frame_id: String,
}

impl From<Header1> for Header {
    fn from(h: Header1) -> Self {
        Self::new(i64::from(h.sec), h.nsec, &h.frame_id)
    }
}

impl From<Header2> for Header {
    fn from(h: Header2) -> Self {
        Self::new(i64::from(h.sec), h.nanosec, &h.frame_id)
    }
}

impl Header {
    fn new(sec: i64, nsec: u32, frame: &str) -> Self {
        Self { stamp_ns: sec * 1_000_000_000 + i64::from(nsec), frame: bare(frame).into() }
    }
}

/// A name of a frame or topic without its leading slashes.
pub fn bare(name: &str) -> &str {
    name.trim_start_matches('/')
}

/// sensor_msgs/LaserScan.
#[derive(Debug, Deserialize)]
pub struct LaserScan<H> {
    pub header: H,
    pub angle_min: f32,
    pub angle_max: f32,
    pub angle_increment: f32,
    pub time_increment: f32,
    #[allow(dead_code)] // It stands before the limits.
    pub scan_time: f32,
    pub range_min: f32,
    pub range_max: f32,
    pub ranges: Vec<f32>,
}

/// nav_msgs/Odometry.
#[derive(Debug, Deserialize)]
pub struct OdometryMessage<H> {
    pub header: H,
    pub child_frame_id: String,
    pub pose: Pose,
}

/// geometry_msgs/Pose and Transform: metres and a quaternion.
#[derive(Clone, Copy, Debug, Deserialize)]
pub struct Pose {
    /// x, y, z.
    pub position: [f64; 3],
    /// x, y, z, w.
    pub orientation: [f64; 4],
}

/// tf2_msgs/TFMessage.
#[derive(Debug, Deserialize)]
pub struct Transforms<H> {
    pub transforms: Vec<TransformStamped<H>>,
}

/// geometry_msgs/TransformStamped: where the child frame is in the header's.
#[derive(Debug, Deserialize)]
pub struct TransformStamped<H> {
    pub header: H,
    pub child_frame_id: String,
    pub transform: Pose,
}

/// sensor_msgs/JointState.
#[derive(Debug, Deserialize)]
pub struct JointState<H> {
    pub header: H,
    pub name: Vec<String>,
    pub position: Vec<f64>,
}

/// A kind of message, whatever its header.
pub trait Message: Sized {
    /// It from bytes; the error says what is wrong with them.
    fn decode(encoding: Encoding, bytes: &[u8]) -> Result<Self, String>;
}

macro_rules! message {
    ($kind:ident, $message:ident => $same:expr) => {
        impl Message for $kind<Header> {
            fn decode(encoding: Encoding, bytes: &[u8]) -> Result<Self, String> {
                fn same<H: Into<Header>>($message: $kind<H>) -> $kind<Header> {
                    $same
                }
                match encoding {
                    Encoding::Ros1 => ros1::<$kind<Header1>>(bytes).map(same),
                    Encoding::Cdr => cdr::<$kind<Header2>>(bytes).map(same),
                    Encoding::Other => Err("the message is neither in ROS 1's encoding nor in CDR".into()),
                }
            }
        }
    };
}

message!(LaserScan, m => LaserScan {
    header: m.header.into(),
    angle_min: m.angle_min,
    angle_max: m.angle_max,
    angle_increment: m.angle_increment,
    time_increment: m.time_increment,
    scan_time: m.scan_time,
    range_min: m.range_min,
    range_max: m.range_max,
    ranges: m.ranges,
});
message!(OdometryMessage, m => OdometryMessage {
    header: m.header.into(),
    child_frame_id: m.child_frame_id,
    pose: m.pose,
});
message!(Transforms, m => Transforms {
    transforms: m.transforms.into_iter().map(|t| TransformStamped {
        header: t.header.into(),
        child_frame_id: t.child_frame_id,
        transform: t.transform,
    }).collect(),
});
message!(JointState, m => JointState { header: m.header.into(), name: m.name, position: m.position });

fn ros1<T: DeserializeOwned>(bytes: &[u8]) -> Result<T, String> {
    let length = u32::try_from(bytes.len()).map_err(|_| "the message is too long".to_string())?;
    T::deserialize(&mut Deserializer::new(bytes, length)).map_err(|_| too_short(bytes))
}

fn cdr<T: DeserializeOwned>(bytes: &[u8]) -> Result<T, String> {
    use byteorder::{BigEndian, LittleEndian};
    // The first four bytes say how the rest is encoded.
    let (head, body) = bytes.split_first_chunk::<4>().ok_or_else(|| too_short(bytes))?;
    let decoded = match head {
        [0, 1, ..] => cdr_encoding::from_bytes::<T, LittleEndian>(body),
        [0, 0, ..] => cdr_encoding::from_bytes::<T, BigEndian>(body),
        [a, b, ..] => return Err(format!("the message begins with {a:02x} {b:02x}, which is not plain CDR")),
    };
    decoded.map(|(message, _)| message).map_err(|_| too_short(bytes))
}

fn too_short(bytes: &[u8]) -> String {
    format!("{} bytes are not a whole message of this type", bytes.len())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_claimed_length_is_not_believed() {
        // Header of ROS 1 with an empty frame, seven numbers, and four billion ranges.
        let mut bytes = vec![0; 16 + 28];
        bytes.extend([0xff; 4]);
        assert!(LaserScan::<Header>::decode(Encoding::Ros1, &bytes).is_err());
        let mut bytes = vec![0, 1, 0, 0];
        bytes.extend([0; 12 + 28]);
        bytes.extend([0xff; 4]);
        assert!(LaserScan::<Header>::decode(Encoding::Cdr, &bytes).is_err());
        assert!(Transforms::<Header>::decode(Encoding::Cdr, &[0, 1, 0, 0, 0xff, 0xff, 0xff, 0x7f]).is_err());
        assert!(Transforms::<Header>::decode(Encoding::Cdr, &[0, 7, 0, 0]).is_err());
    }

    #[test]
    fn big_endian_is_read() {
        let mut bytes = vec![0, 0, 0, 0, 0, 0, 0, 5, 0, 0, 0, 9, 0, 0, 0, 2, b'l', 0, 0, 0];
        for value in [-1.0f32, 1.0, 0.5, 0.0, 0.1, 0.2, 8.0] {
            bytes.extend(value.to_be_bytes());
        }
        bytes.extend([0, 0, 0, 1]);
        bytes.extend(3.5f32.to_be_bytes());
        let scan = LaserScan::<Header>::decode(Encoding::Cdr, &bytes).unwrap();
        assert_eq!((scan.header.stamp_ns, scan.header.frame.as_str()), (5_000_000_009, "l"));
        assert_eq!((scan.angle_increment, scan.range_max, scan.ranges), (0.5, 8.0, vec![3.5]));
    }
}
