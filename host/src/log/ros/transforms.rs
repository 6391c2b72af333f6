//! Where the scanner sits on the robot, from the transforms of the log.

use std::collections::HashMap;

use nalgebra::{Isometry3, Quaternion, Translation3, UnitQuaternion, Vector3};

use super::messages::Pose;

/// Frames that robots usually have, the most telling first.
pub const BASES: [&str; 3] = ["base_footprint", "base_link", "base"];
/// Frames between two that are followed.
const LONGEST_CHAIN: usize = 64;
/// Tilt of a scanner from which on its plane is no longer taken as level, degrees.
const TILT_DEG: f64 = 5.0;

/// Where frames are in their parents, by the name of the child. The first value of each is kept: what holds a scanner does
/// not move.
#[derive(Debug, Default)]
pub struct Tree {
    parents: HashMap<String, (String, Isometry3<f64>)>,
}

/// How a scanner is mounted.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Mounted {
    /// x, y, yaw on the robot, metres and radians.
    pub base_from_laser: [f32; 3],
    /// Whether its z axis points down.
    pub upside_down: bool,
    /// Angle between its axis and the vertical, degrees, where that is too much to be level.
    pub tilt_deg: Option<f64>,
}

/// A pose as a transform; `None` if it is none.
pub fn isometry(pose: &Pose) -> Option<Isometry3<f64>> {
    let [x, y, z] = pose.position;
    let [i, j, k, w] = pose.orientation;
    let quaternion = Quaternion::new(w, i, j, k);
    let norm = quaternion.norm();
    let possible =
        pose.position.iter().all(|v| v.is_finite() && v.abs() < 1e9) && (1e-3..1e3).contains(&norm);
    possible.then(|| {
        Isometry3::from_parts(Translation3::new(x, y, z), UnitQuaternion::from_quaternion(quaternion))
    })
}

/// x, y and the direction of the x axis seen from above.
pub fn planar(transform: &Isometry3<f64>) -> [f64; 3] {
    let ahead = transform.rotation * Vector3::x();
    [transform.translation.x, transform.translation.y, ahead.y.atan2(ahead.x)]
}

/// The last part of a frame's name.
pub fn last_part(frame: &str) -> &str {
    frame.rsplit('/').next().unwrap_or(frame)
}

/// Whether a frame is one in which the robot moves about.
fn is_fixed(frame: &str) -> bool {
    matches!(last_part(frame), "odom" | "map" | "world" | "earth")
}

impl Tree {
    /// Keeps where `child` is in `parent`, if it holds still there.
    pub fn add(&mut self, parent: &str, child: &str, parent_from_child: Isometry3<f64>) {
        if !is_fixed(parent) && parent != child && !self.parents.contains_key(child) {
            self.parents.insert(child.into(), (parent.into(), parent_from_child));
        }
    }

    /// The frames from this one up, and where it is in each.
    fn up_from(&self, frame: &str) -> Vec<(String, Isometry3<f64>)> {
        let mut chain = vec![(frame.to_string(), Isometry3::identity())];
        while let Some((parent, parent_from_child)) =
            chain.last().and_then(|(frame, _)| self.parents.get(frame))
        {
            if chain.len() == LONGEST_CHAIN {
                break;
            }
            let from_frame = parent_from_child * chain[chain.len() - 1].1;
            chain.push((parent.clone(), from_frame));
        }
        chain
    }

    /// Where `laser` is in `base`; `None` if no chain of transforms joins them.
    pub fn mounted(&self, base: &str, laser: &str) -> Option<Mounted> {
        let from_laser = self.up_from(laser);
        // Some robots have the frame on the ground as a child of the one in the axle.
        let (base_from_common, at) = self.up_from(base).into_iter().find_map(|(frame, from_base)| {
            Some((from_base.inverse(), from_laser.iter().position(|f| f.0 == frame)?))
        })?;
        Some(Mounted::of(&(base_from_common * from_laser[at].1)))
    }
}

impl Mounted {
    fn of(base_from_laser: &Isometry3<f64>) -> Self {
        let up = (base_from_laser.rotation * Vector3::z()).z;
        let tilt_deg = up.abs().min(1.0).acos().to_degrees();
        Self {
            base_from_laser: planar(base_from_laser).map(|v| v as f32),
            upside_down: up < 0.0,
            tilt_deg: (tilt_deg > TILT_DEG).then_some(tilt_deg),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::{FRAC_PI_2, PI};

    fn at(x: f64, y: f64, rpy: [f64; 3]) -> Isometry3<f64> {
        let rotation = UnitQuaternion::from_euler_angles(rpy[0], rpy[1], rpy[2]);
        Isometry3::from_parts(Translation3::new(x, y, 0.1), rotation)
    }

    fn close(mounted: Mounted, expected: [f32; 3], upside_down: bool) {
        for (actual, expected) in mounted.base_from_laser.iter().zip(expected) {
            assert!((actual - expected).abs() < 1e-6, "{mounted:?}");
        }
        assert_eq!(mounted.upside_down, upside_down);
    }

    #[test]
    fn chains_compose_from_either_side() {
        let mut tree = Tree::default();
        tree.add("odom", "base_footprint", at(9.0, 9.0, [0.0; 3]));
        tree.add("base_footprint", "base_link", at(0.1, 0.0, [0.0, 0.0, FRAC_PI_2]));
        tree.add("base_link", "laser", at(0.2, 0.0, [PI, 0.0, 0.0]));
        tree.add("base_link", "ground", at(0.0, 0.5, [0.0; 3]));
        close(tree.mounted("base_footprint", "laser").unwrap(), [0.1, 0.2, FRAC_PI_2 as f32], true);
        close(tree.mounted("ground", "laser").unwrap(), [0.2, -0.5, 0.0], true);
        close(tree.mounted("laser", "laser").unwrap(), [0.0; 3], false);
        assert_eq!(tree.mounted("odom", "laser"), None);
        assert_eq!(tree.mounted("base_link", "camera"), None);
    }

    #[test]
    fn upside_down_and_tilt_are_told_apart() {
        let mounted = |rpy| {
            let mut tree = Tree::default();
            tree.add("base", "laser", at(0.0, 0.0, rpy));
            tree.mounted("base", "laser").unwrap()
        };
        close(mounted([PI, 0.0, 0.5]), [0.0, 0.0, 0.5], true);
        close(mounted([0.0, PI, 0.0]), [0.0, 0.0, PI as f32], true);
        assert_eq!(mounted([0.0, 0.08, 1.0]).tilt_deg, None);
        let tilted = mounted([0.0, 0.1, 1.0]).tilt_deg.unwrap();
        assert!((tilted - 0.1f64.to_degrees()).abs() < 1e-9);
    }

    #[test]
    fn a_circle_of_frames_ends() {
        let mut tree = Tree::default();
        tree.add("a", "b", at(1.0, 0.0, [0.0; 3]));
        tree.add("b", "a", at(1.0, 0.0, [0.0; 3]));
        assert_eq!(tree.mounted("base", "a"), None);
    }

    #[test]
    fn what_is_no_rotation_is_no_transform() {
        let pose = |orientation| Pose { position: [0.0; 3], orientation };
        assert!(isometry(&pose([0.0; 4])).is_none());
        assert!(isometry(&pose([f64::NAN, 0.0, 0.0, 1.0])).is_none());
        assert!(
            isometry(&Pose { position: [f64::INFINITY, 0.0, 0.0], orientation: [0.0, 0.0, 0.0, 1.0] })
                .is_none()
        );
        assert!(isometry(&pose([0.0, 0.0, 0.0, 1.1])).is_some());
    }
}
