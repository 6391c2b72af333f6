//! What a PC asks of the robot.

use serde::{Deserialize, Serialize};

/// A request. It is answered with its number, and applied once: the robot remembers the number of the last one, and where it comes again
/// it gives the same answer and does nothing. So whoever hears no answer sends it again. Numbers begin anywhere, best at random.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Request {
    /// Its number.
    pub id: u32,
    /// What is to be done.
    pub command: Command,
}

impl Request {
    /// Of the body of a frame. `Err` has the number of one that this side does not know, if there is one.
    pub fn decode(body: &[u8]) -> Result<Self, Option<u32>> {
        postcard::from_bytes(body).map_err(|_| postcard::take_from_bytes(body).ok().map(|(id, _)| id))
    }
}

/// What the robot can be told. Later versions add commands at the end: those that store, set parameters, or drive.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Command {
    /// 0: say who is there.
    Hello,
    /// 1: send these streams from now on, and no others.
    Subscribe(Streams),
    /// 2: forget the map and begin a new one here.
    Forget,
    /// 3: the robot stands here: x, y (m), θ (rad) in `map`, within some 20 cm and 6°.
    SetPose([f32; 3]),
    /// 4: whether the map learns; frozen, the robot only finds its way in it.
    SetMapping(bool),
    /// 5: the robot may be anywhere in its map; it looks for itself.
    Relocalise,
    /// 6: send these blocks of the map again (bit 0 is block 0), and all places.
    SendMap {
        /// Blocks.
        blocks: u32,
        /// Whether the places too.
        places: bool,
    },
    /// 7: reset the board. The map is kept.
    Restart,
}

/// Streams, as bits.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Streams(pub u16);

impl Streams {
    /// [`Pose`](crate::from_robot::Pose).
    pub const POSES: Self = Self(1);
    /// [`Status`](crate::from_robot::Status) and [`Health`](crate::from_robot::Health).
    pub const STATUS: Self = Self(2);
    /// [`Event`](crate::from_robot::Event).
    pub const EVENTS: Self = Self(4);
    /// [`Ticks`](crate::from_robot::Ticks).
    pub const TICKS: Self = Self(8);
    /// [`Ranges`](crate::from_robot::Ranges).
    pub const SCANS: Self = Self(16);
    /// [`Lines`](crate::from_robot::Lines), [`Block`](crate::from_robot::Block), [`Places`](crate::from_robot::Places) and
    /// [`PlacesEnd`](crate::from_robot::PlacesEnd).
    pub const MAP: Self = Self(32);
    /// All of them.
    pub const ALL: Self = Self(63);
    /// What the robot sends until it is told otherwise.
    pub const DEFAULT: Self = Self(1 | 2 | 4);

    /// Both.
    pub const fn with(self, other: Self) -> Self {
        Self(self.0 | other.0)
    }

    /// Whether any of these is among them.
    pub const fn has(self, other: Self) -> bool {
        self.0 & other.0 != 0
    }
}
