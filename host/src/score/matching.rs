//! The poses of a trajectory at the stamps of another.

use nalgebra::Isometry2;

use super::{Spread, StampedPose};

/// Stamps this close are the same instant, seconds.
const SAME_S: f64 = 2e-3;

/// A trajectory at given stamps.
#[derive(Clone, Debug)]
pub struct Matched {
    /// A pose for each stamp. Where the trajectory has none, the last one before: the robot counts as standing still.
    pub poses: Vec<Isometry2<f64>>,
    /// Stamps at which the trajectory has a pose of its own, or two around it that are not far apart.
    pub found: usize,
    /// Of those, the stamps with a pose of their own.
    pub exact: usize,
}

/// The poses of a trajectory at given stamps, both rising: that within 2 ms of the stamp, or else what lies between the
/// two around it unless these are more than three stamps apart. `None` where no stamp has one.
///
/// Work: for each stamp the logarithm of the trajectory's length.
pub fn at_stamps(trajectory: &[StampedPose], stamps_s: &[f64]) -> Option<Matched> {
    let usual_s = Spread::of(stamps_s.windows(2).map(|w| w[1] - w[0])).map_or(0.0, |s| s.median);
    let longest_gap_s = 3.0 * usual_s.max(0.1);
    let (mut found, mut exact) = (0, 0);
    let mut at = |stamp_s: f64| -> Option<Isometry2<f64>> {
        let after = trajectory.partition_point(|p| p.stamp_s < stamp_s);
        let after = after.clamp(1, trajectory.len().max(2) - 1);
        let a = trajectory.get(after - 1)?;
        let b = trajectory.get(after).unwrap_or(a);
        let (to_a, to_b) = ((a.stamp_s - stamp_s).abs(), (b.stamp_s - stamp_s).abs());
        let (near, distance_s) = if to_a <= to_b { (a, to_a) } else { (b, to_b) };
        if distance_s < SAME_S {
            (found, exact) = (found + 1, exact + 1);
            return Some(near.pose);
        }
        let gap_s = b.stamp_s - a.stamp_s;
        if !(a.stamp_s..=b.stamp_s).contains(&stamp_s) || gap_s >= longest_gap_s {
            return None;
        }
        found += 1;
        Some(between(&a.pose, &b.pose, (stamp_s - a.stamp_s) / gap_s.max(1e-9)))
    };
    let poses: Vec<Option<Isometry2<f64>>> = stamps_s.iter().map(|s| at(*s)).collect();
    let mut last = *poses.iter().flatten().next()?;
    let standing = |pose: Option<Isometry2<f64>>| {
        last = pose.unwrap_or(last);
        last
    };
    Some(Matched { poses: poses.into_iter().map(standing).collect(), found, exact })
}

/// The pose a share of the way from one to another: position and heading each on its own, the heading the short way round.
pub(super) fn between(a: &Isometry2<f64>, b: &Isometry2<f64>, share: f64) -> Isometry2<f64> {
    let position = a.translation.vector.lerp(&b.translation.vector, share);
    let turn = a.rotation.rotation_to(&b.rotation).angle();
    Isometry2::new(position, a.rotation.angle() + share * turn)
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector2;

    use super::*;

    fn pose(stamp_s: f64, x: f64, heading: f64) -> StampedPose {
        StampedPose { stamp_s, pose: Isometry2::new(Vector2::new(x, 0.0), heading) }
    }

    #[test]
    fn a_pose_of_its_own_is_taken_before_what_lies_between_and_that_before_standing_still() {
        let trajectory = [pose(1.0, 1.0, 3.0), pose(1.2, 2.0, -3.0), pose(9.0, 3.0, 0.0)];
        let matched = at_stamps(&trajectory, &[0.8, 1.0015, 1.1, 1.2, 1.3, 9.0, 9.2]).unwrap();
        let x: Vec<f64> = matched.poses.iter().map(|p| (p.translation.x * 1e9).round() * 1e-9).collect();
        assert_eq!(x, [1.0, 1.0, 1.5, 2.0, 2.0, 3.0, 3.0]);
        assert_eq!((matched.found, matched.exact), (4, 3));
        let heading = matched.poses[2].rotation.angle();
        assert!((heading.abs() - std::f64::consts::PI).abs() < 1e-12, "the short way round: {heading}");
    }

    #[test]
    fn nothing_in_common_is_none() {
        assert!(at_stamps(&[pose(1.0, 0.0, 0.0), pose(2.0, 0.0, 0.0)], &[5.0, 6.0]).is_none());
        assert!(at_stamps(&[], &[5.0]).is_none());
        assert!(at_stamps(&[pose(1.0, 0.0, 0.0)], &[]).is_none());
        assert_eq!(at_stamps(&[pose(1.0, 0.0, 0.0)], &[1.0]).unwrap().exact, 1, "one pose is enough");
    }
}
