//! What is wrong with the wheels, in words: swapped, reversed, dead.
//!
//! In: the way of each wheel since the last scan, as the odometry and as the scanner have it. Out: the fault that explains the
//! difference, if one does. Each fault maps what the wheels did to what the counters say; the one of least square error is
//! taken, where it explains the counters well and no fault does not.

use nalgebra::Isometry2;

use crate::geometry::math::max;
use crate::geometry::pose::log;
use crate::odometry::Increment;

/// A fault of wheels or encoders.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize), serde(rename_all = "snake_case"))]
pub enum WheelFault {
    /// Left is right and right is left.
    Swapped,
    /// The left encoder counts backward.
    LeftReversed,
    /// The right encoder counts backward.
    RightReversed,
    /// Both encoders count backward.
    BothReversed,
    /// Swapped, and both count backward.
    SwappedAndReversed,
    /// The left encoder does not count.
    LeftDead,
    /// The right encoder does not count.
    RightDead,
    /// Neither counts.
    BothDead,
}

impl WheelFault {
    /// All of them.
    pub const ALL: [Self; 8] = [
        Self::Swapped,
        Self::LeftReversed,
        Self::RightReversed,
        Self::BothReversed,
        Self::SwappedAndReversed,
        Self::LeftDead,
        Self::RightDead,
        Self::BothDead,
    ];

    /// In words.
    pub fn message(self) -> &'static str {
        match self {
            Self::Swapped => "the wheels seem swapped",
            Self::LeftReversed => "the left encoder counts backward",
            Self::RightReversed => "the right encoder counts backward",
            Self::BothReversed => "both encoders count backward",
            Self::SwappedAndReversed => "the wheels seem swapped, and both encoders count backward",
            Self::LeftDead => "the left encoder is dead",
            Self::RightDead => "the right encoder is dead",
            Self::BothDead => "both encoders are dead",
        }
    }

    /// What the counters say of the ways that the wheels went, left and right.
    fn counted(self, [left, right]: [f32; 2]) -> [f32; 2] {
        match self {
            Self::Swapped => [right, left],
            Self::LeftReversed => [-left, right],
            Self::RightReversed => [left, -right],
            Self::BothReversed => [-left, -right],
            Self::SwappedAndReversed => [-right, -left],
            Self::LeftDead => [0.0, right],
            Self::RightDead => [left, 0.0],
            Self::BothDead => [0.0, 0.0],
        }
    }
}

/// Pieces over which ways are compared, metres of the wheel that went farther: stamps of wheels and scans that do not quite fit
/// cancel out over them.
const PIECE_M: f32 = 0.1;
/// What happened so far back counts by 1/e, metres.
const MEMORY_M: f32 = 2.0;
/// Nothing is said before this way, metres.
const LEAST_WAY_M: f32 = 1.0;
/// A fault leaves less than this share of the square error that is there without it, …
const OF_NO_FAULT: f32 = 0.3;
/// … and of the square of the ways.
const OF_WAY: f32 = 0.2;

/// The square errors of each fault, and what they say.
#[derive(Clone, Copy, Debug, Default)]
pub struct WheelMonitor {
    errors: [f32; WheelFault::ALL.len()],
    without_fault: f32,
    ways: f32,
    way_m: f32,
    /// The piece at hand, by the counters and by the scanner.
    piece: [[f32; 2]; 2],
    fault: Option<WheelFault>,
}

impl WheelMonitor {
    /// What is wrong, if anything is known to be.
    pub fn fault(&self) -> Option<WheelFault> {
        self.fault
    }

    /// Takes in the motion since the scan before of a base with this track (metres), by the odometry and by the scanner.
    pub fn update(&mut self, by_odometry: &Increment, by_scanner: &Isometry2<f32>, track_m: f32) {
        let ways = |motion: &Isometry2<f32>| {
            let twist = log(motion);
            [twist.x - 0.5 * track_m * twist.z, twist.x + 0.5 * track_m * twist.z]
        };
        let now = [ways(&by_odometry.before_from_after), ways(by_scanner)];
        if !now.iter().flatten().all(|way| way.is_finite()) {
            return;
        }
        self.piece.iter_mut().flatten().zip(now.iter().flatten()).for_each(|(sum, way)| *sum += way);
        let [counted, went] = self.piece;
        let way_m = max(went[0].abs(), went[1].abs());
        if way_m < PIECE_M {
            return;
        }
        self.piece = [[0.0; 2]; 2];
        self.way_m += way_m;
        let error = |expected: [f32; 2]| {
            let [left, right] = [counted[0] - expected[0], counted[1] - expected[1]];
            left * left + right * right
        };
        let kept = max(1.0 - way_m / MEMORY_M, 0.0);
        for (sum, fault) in self.errors.iter_mut().zip(WheelFault::ALL) {
            *sum = kept * *sum + error(fault.counted(went));
        }
        self.without_fault = kept * self.without_fault + error(went);
        self.ways = kept * self.ways + error([counted[0] - went[0], counted[1] - went[1]]);
        if self.way_m >= LEAST_WAY_M {
            self.fault = self.likeliest();
        }
    }

    fn likeliest(&self) -> Option<WheelFault> {
        let all = self.errors.iter().zip(WheelFault::ALL);
        let (error, fault) = all.min_by(|a, b| a.0.total_cmp(b.0))?;
        (*error < OF_NO_FAULT * self.without_fault && *error < OF_WAY * self.ways).then_some(fault)
    }

    /// A scan did not fix the pose: the piece at hand is not known.
    pub fn interrupt(&mut self) {
        self.piece = [[0.0; 2]; 2];
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::pose::exp;
    use nalgebra::Vector3;

    const TRACK_M: f32 = 0.3;

    /// A winding drive of so many scans, with wheels that slip a little, whose counters have the fault.
    fn driven(monitor: &mut WheelMonitor, fault: Option<WheelFault>, scans: usize) {
        for k in 0..scans {
            let turn = 0.1 * libm::sinf(0.3 * k as f32);
            let went = [0.04 - 0.5 * TRACK_M * turn, 0.04 + 0.5 * TRACK_M * turn];
            let counted = fault.map_or(went, |fault| fault.counted(went)).map(|way| 1.03 * way);
            let twist = |[left, right]: [f32; 2]| {
                exp(&Vector3::new(0.5 * (left + right), 0.0, (right - left) / TRACK_M))
            };
            monitor.update(&Increment::from_motion(twist(counted)), &twist(went), TRACK_M);
        }
    }

    #[test]
    fn each_fault_is_named_and_good_wheels_have_none() {
        for fault in WheelFault::ALL.into_iter().map(Some).chain([None]) {
            let mut monitor = WheelMonitor::default();
            driven(&mut monitor, fault, 20);
            assert_eq!(monitor.fault(), None, "not after 0.8 m");
            driven(&mut monitor, fault, 60);
            assert_eq!(monitor.fault(), fault);
        }
    }

    #[test]
    fn a_fault_that_comes_later_is_found_and_one_that_is_mended_is_dropped() {
        let mut monitor = WheelMonitor::default();
        driven(&mut monitor, None, 200);
        driven(&mut monitor, Some(WheelFault::LeftDead), 150);
        assert_eq!(monitor.fault(), Some(WheelFault::LeftDead));
        driven(&mut monitor, None, 150);
        assert_eq!(monitor.fault(), None);
    }
}
