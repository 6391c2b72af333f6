//! Is the odometry to be believed: what the wheels report against what the scanner saw.
//!
//! In: after each scan that fixed the pose, the motion since the scan before as the odometry and as the scanner have it. Out:
//! whether the odometry is of any use, and what to expect of the next motion where it is not.
//!
//! Both are compared by energy: the mean square of their difference over the mean square of the scanner's motion, over the last
//! metres. Good wheels are at some percent, a frozen counter at 1, swapped wheels in turns at 4. Single wild increments are the
//! tracker's to find; see [`Tracker`](crate::tracking::Tracker).

use nalgebra::{Isometry2, Matrix3, Vector3};

use crate::geometry::math::{max, sqrt};
use crate::geometry::pose::{exp, log, normalized};
use crate::odometry::Increment;

/// Settings of the monitor.
#[derive(Clone, Copy, Debug, PartialEq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct MonitorConfig {
    /// A scan explained to this share or more says how the robot moved.
    pub min_score: f32,
    /// The odometry is useless from this ratio of energies on, …
    pub useless_ratio: f32,
    /// … and of use again below this.
    pub useful_ratio: f32,
    /// What happened so far back counts by 1/e, metres; a radian counts as [`RADIAN_M`].
    pub memory_m: f32,
    /// Standard deviations of the motion that is expected without odometry, as a share of the last motions' size.
    pub unknown_share: f32,
    /// At the least, metres and radians.
    pub unknown_floor: [f32; 2],
}

/// A radian counts as much as this way, metres: half the width of a small robot.
pub const RADIAN_M: f32 = 0.3;
/// The way is compared in pieces of this length, metres: stamps of wheels and scans that do not quite fit cancel out over them.
const PIECE_M: f32 = 0.3;
/// Scans the motions of which say how fast the robot is.
const SPEED_SCANS: f32 = 5.0;
/// The monitor says nothing before this way, metres.
const LEAST_WAY_M: f32 = 0.5;
/// An increment makes up for what was not reported where that brings it so much nearer to the last motion, as a share of the
/// squared difference. Chosen on mit-csail, whose base reports late; looked at on fr079, aces, exp1, exp3 and csail too.
const LATE_SHARE: f32 = 0.25;

/// The judgement and what it stands on.
#[derive(Clone, Copy, Debug)]
pub struct OdometryMonitor {
    useless: bool,
    /// Energies of the difference and of the scanner's motion, m², both forgotten alike.
    difference: f32,
    motion: f32,
    way_m: f32,
    /// The piece at hand, by odometry and by the scanner.
    piece: [Isometry2<f32>; 2],
    /// The last motion by the scanner.
    last: Isometry2<f32>,
    /// Mean square of the last motions, m² and rad².
    speed: [f32; 2],
    /// Way (m, signed) and turn (rad) that the odometry has reported more than the scanner has seen, since both agreed last.
    ahead: [f32; 2],
}

impl Default for OdometryMonitor {
    fn default() -> Self {
        let last = Isometry2::identity();
        Self {
            useless: false,
            difference: 0.0,
            motion: 0.0,
            way_m: 0.0,
            piece: [last; 2],
            last,
            speed: [0.0; 2],
            ahead: [0.0; 2],
        }
    }
}

impl OdometryMonitor {
    /// Whether the odometry is of no use, and the scanner is to be followed alone.
    pub fn is_useless(&self) -> bool {
        self.useless
    }

    /// Mean square of the difference between odometry and scanner over that of the motion; 0 before any way was driven.
    pub fn ratio(&self) -> f32 {
        if self.motion > 0.0 { self.difference / self.motion } else { 0.0 }
    }

    /// Takes in the motion since the scan before, by the odometry and as it came out, whether a scan fixed it or not, and whether
    /// both agree.
    pub fn account(&mut self, by_odometry: &Increment, moved: &Isometry2<f32>, agree: bool) {
        let (said, moved) = (log(&by_odometry.before_from_after), log(moved));
        let [way, turn] = [self.ahead[0] + said.x - moved.x, self.ahead[1] + said.z - moved.z];
        self.ahead = if agree || !(way + turn).is_finite() { [0.0; 2] } else { [way, turn] };
    }

    /// Takes in the motion since the scan before, by the odometry and by the scanner, where the scans fixed both poses.
    pub fn update(&mut self, by_odometry: &Increment, by_scanner: &Isometry2<f32>, config: &MonitorConfig) {
        if !(by_odometry.is_finite() && crate::geometry::pose::is_finite(by_scanner)) {
            return;
        }
        self.last = *by_scanner;
        let seen = log(by_scanner);
        let [position, heading] = [seen.x * seen.x + seen.y * seen.y, seen.z * seen.z];
        for (mean, now) in self.speed.iter_mut().zip([position, heading]) {
            *mean += (now - *mean) / SPEED_SCANS;
        }
        let [said, seen] = &mut self.piece;
        *said = normalized(&(*said * by_odometry.before_from_after));
        *seen = normalized(&(*seen * by_scanner));
        let (said, seen) = (log(said), log(seen));
        let (difference, motion) = (square(said - seen), square(seen));
        // Wheels that spin while the robot stands are a difference without a motion.
        let way_m = sqrt(max(motion, difference));
        if way_m < PIECE_M {
            return;
        }
        self.piece = [Isometry2::identity(); 2];
        let kept = max(1.0 - way_m / config.memory_m, 0.0);
        self.difference = kept * self.difference + difference;
        self.motion = kept * self.motion + motion;
        self.way_m += way_m;
        let limit = if self.useless { config.useful_ratio } else { config.useless_ratio };
        self.useless = self.way_m >= LEAST_WAY_M && self.difference > limit * self.motion;
    }

    /// The scan before did not fix the pose: nothing is known of the motion.
    pub fn lost_sight(&mut self) {
        self.last = Isometry2::identity();
        self.piece = [Isometry2::identity(); 2];
    }

    /// What remains of an increment that makes up for motion which was not reported, and which the scanner has seen since: an
    /// arc, as two wheels drive it. `None` where the increment as it stands is more like the last motion.
    pub fn late_remainder(&self, by_odometry: &Increment) -> Option<Increment> {
        let (said, last) = (log(&by_odometry.before_from_after), log(&self.last));
        let [way, turn] = self.ahead;
        // As an arc, too, so that both are compared by the same measure.
        let arc = Vector3::new(said.x, 0.0, said.z);
        let rest = arc + Vector3::new(way, 0.0, turn);
        let is_late = square(rest - last) < LATE_SHARE * square(arc - last);
        is_late.then(|| Increment::from_motion(exp(&rest)))
    }

    /// What to expect of the motion to the next scan without odometry: the last motion goes on.
    pub fn expected(&self) -> Increment {
        Increment::from_motion(self.last)
    }

    /// Covariance (x, y, θ) of that, in `base` before it.
    pub fn expected_covariance(&self, config: &MonitorConfig) -> Matrix3<f32> {
        let share = config.unknown_share * config.unknown_share;
        let [position, heading] = self.speed.map(|mean| share * mean);
        let [floor_m, floor_rad] = config.unknown_floor.map(|floor| floor * floor);
        let position = max(position, floor_m);
        Matrix3::from_diagonal(&Vector3::new(position, position, max(heading, floor_rad)))
    }
}

/// Size of a motion or of a difference between two, m².
fn square(twist: Vector3<f32>) -> f32 {
    twist.x * twist.x + twist.y * twist.y + RADIAN_M * RADIAN_M * twist.z * twist.z
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::pose::pose;

    const CONFIG: MonitorConfig = MonitorConfig {
        min_score: 0.5,
        useless_ratio: 0.6,
        useful_ratio: 0.2,
        memory_m: 2.0,
        unknown_share: 1.0,
        unknown_floor: [0.02, 0.02],
    };

    fn drive(monitor: &mut OdometryMonitor, said: [f32; 3], seen: [f32; 3], scans: usize) {
        let increment = Increment::from_motion(pose(said[0], said[1], said[2]));
        (0..scans).for_each(|_| monitor.update(&increment, &pose(seen[0], seen[1], seen[2]), &CONFIG));
    }

    #[test]
    fn frozen_and_swapped_wheels_are_useless_and_good_ones_are_not() {
        for (said, useless) in [
            ([0.05, 0.0, 0.1], false),
            ([0.052, 0.0, 0.08], false),
            ([0.0, 0.0, 0.0], true),
            ([0.05, 0.0, -0.1], true),
        ] {
            let mut monitor = OdometryMonitor::default();
            drive(&mut monitor, said, [0.05, 0.0, 0.1], 30);
            assert_eq!(monitor.is_useless(), useless, "{said:?}: {}", monitor.ratio());
        }
    }

    #[test]
    fn it_is_believed_again_once_it_agrees_for_some_metres() {
        let mut monitor = OdometryMonitor::default();
        drive(&mut monitor, [0.0; 3], [0.05, 0.0, 0.0], 40);
        assert!(monitor.is_useless());
        drive(&mut monitor, [0.05, 0.0, 0.0], [0.05, 0.0, 0.0], 20);
        assert!(monitor.is_useless(), "not after one metre");
        drive(&mut monitor, [0.05, 0.0, 0.0], [0.05, 0.0, 0.0], 80);
        assert!(!monitor.is_useless());
    }

    #[test]
    fn without_odometry_the_last_motion_is_expected_to_go_on() {
        let mut monitor = OdometryMonitor::default();
        drive(&mut monitor, [0.0; 3], [0.06, 0.0, 0.2], 30);
        assert!((monitor.expected().distance_m - 0.06).abs() < 1e-3);
        let p = monitor.expected_covariance(&CONFIG);
        assert!((p.m33 - 0.04).abs() < 4e-3, "{p}");
        assert!((0.05f32.powi(2)..0.07f32.powi(2)).contains(&p.m11), "{p}");
    }

    #[test]
    fn motion_that_is_reported_late_is_not_taken_twice() {
        let mut monitor = OdometryMonitor::default();
        let (step, still) = (exp(&Vector3::new(0.15, 0.0, 0.2)), Increment::identity());
        drive(&mut monitor, [0.15, 0.0, 0.2], [0.15, 0.0, 0.2], 5);
        assert_eq!(monitor.late_remainder(&Increment::from_motion(step)), None);
        let mut late = step;
        for _ in 0..4 {
            assert_eq!(monitor.late_remainder(&still), None);
            monitor.update(&still, &step, &CONFIG);
            monitor.account(&still, &step, false);
            late *= step;
        }
        // Four steps that were not reported and the one at hand.
        let rest = monitor.late_remainder(&Increment::from_motion(late)).unwrap();
        assert!((rest.before_from_after.inverse() * step).translation.vector.norm() < 1e-5);
        assert!((rest.distance_m - 0.15).abs() < 2e-3 && (rest.turn_rad - 0.2).abs() < 1e-5);
        // Nothing is made up for where nothing is owed, however far the motion.
        let far = Increment::from_motion(pose(0.0, 39.0, 0.0));
        assert_eq!(OdometryMonitor::default().late_remainder(&far), None);
        // A wheel that spun while the robot stood makes up for nothing.
        let mut monitor = OdometryMonitor::default();
        let spin = Increment::from_motion(pose(0.2, 0.0, 0.0));
        for _ in 0..4 {
            monitor.update(&spin, &Isometry2::identity(), &CONFIG);
            monitor.account(&spin, &Isometry2::identity(), false);
        }
        assert_eq!(monitor.late_remainder(&still), None);
        assert_eq!(monitor.late_remainder(&Increment::from_motion(pose(0.05, 0.0, 0.0))), None);
    }
}
