//! The state vector: pose (x, y, θ), three systematic errors of the odometry, then offset and direction of each line.

use core::ops::Range;

use crate::ekf::packed::{PackedSymmetric, packed_len};

/// Most lines in the state: 48.
pub const LINES: usize = 48;
const _: () = assert!(LINES <= u64::BITS as usize, "a bit for each");
/// First state of the pose (x, y, θ).
pub(crate) const POSE: usize = 0;
/// First state of the odometry's errors.
pub(crate) const ODOMETRY: usize = 3;
/// First state of the line in slot 0.
pub(crate) const FIRST_LINE: usize = 6;
/// Length of the state vector.
pub(crate) const STATES: usize = FIRST_LINE + 2 * LINES;

/// Covariance of the state vector.
pub(crate) type Covariance = PackedSymmetric<STATES, { packed_len(STATES) }>;

/// States of the line in a slot: offset (m) along the normal at the centroid, direction (rad).
pub(crate) fn line_states(slot: usize) -> [usize; 2] {
    [FIRST_LINE + 2 * slot, FIRST_LINE + 2 * slot + 1]
}

/// Which states a measurement updates.
///
/// The others are "considered", as in the Schmidt–Kalman filter (Schmidt 1966): their gain is zero, so that estimate and
/// covariance of theirs stay, and only their covariance with the states in scope is updated. The result is consistent, less
/// sure than the full update, and costs O(n) instead of O(n²).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum UpdateScope {
    /// All states.
    All,
    /// The pose, the odometry's errors and the line in this slot.
    RobotAndLine(usize),
    /// The line in this slot.
    Line(usize),
}

impl UpdateScope {
    /// The states in scope, ascending; the second range may be empty.
    pub fn states(self) -> [Range<usize>; 2] {
        let line = |slot| {
            let [first, last] = line_states(slot);
            first..last + 1
        };
        match self {
            Self::All => [0..STATES, 0..0],
            Self::RobotAndLine(slot) => [0..FIRST_LINE, line(slot)],
            Self::Line(slot) => [0..0, line(slot)],
        }
    }
}
