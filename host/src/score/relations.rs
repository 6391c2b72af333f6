//! Kümmerle's measure: how far a trajectory is from relations between poses that were checked by hand (Kümmerle et al., "On
//! Measuring the Accuracy of SLAM Algorithms", Autonomous Robots 27, 2009).

use nalgebra::{Isometry2, Vector2};
use serde::Serialize;

use super::matching::between;
use super::relative::PairErrors;
use super::{StampedPose, content, numbers, span_s};

/// Relations may reach this far beyond a trajectory's ends, seconds; the pose there is that of the end.
const BEYOND_S: f64 = 0.01;

/// Where one pose of a log lies as seen from another, checked by hand.
#[derive(Clone, Copy, Debug)]
pub struct Relation {
    /// Stamps of both poses, seconds.
    pub stamps_s: [f64; 2],
    /// The second pose in the first one's frame.
    pub first_from_second: Isometry2<f64>,
}

/// A relation file that is not one: the line, from 1.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("line {line} is not a relation (t1 t2 x y z roll pitch yaw, or t1 t2 x y yaw)")]
pub struct NotRelation {
    /// Line, from 1.
    pub line: usize,
}

/// Reads relations: two stamps, then x, y, z, roll, pitch and yaw of the second pose in the first, or only x, y and yaw.
pub fn parse_relations(text: &str) -> Result<Vec<Relation>, NotRelation> {
    let mut relations = Vec::new();
    for (index, line) in text.lines().enumerate() {
        let Some(line) = content(line) else { continue };
        let (stamps_s, x, y, yaw) = match numbers(line).as_deref() {
            Some([from_s, to_s, x, y, yaw]) => ([*from_s, *to_s], *x, *y, *yaw),
            Some([from_s, to_s, x, y, _z, _roll, _pitch, yaw]) => ([*from_s, *to_s], *x, *y, *yaw),
            _ => return Err(NotRelation { line: index + 1 }),
        };
        relations.push(Relation { stamps_s, first_from_second: Isometry2::new(Vector2::new(x, y), yaw) });
    }
    Ok(relations)
}

/// A trajectory by its relations.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct RelationErrors {
    /// Relations in the file; those between poses of the trajectory are counted in the errors.
    pub of: usize,
    /// Their errors.
    #[serde(flatten)]
    pub errors: PairErrors,
}

/// A trajectory moved ahead, as a scanner's that sits there, metres before the robot's centre.
pub fn at_laser(trajectory: &[StampedPose], laser_m: f64) -> Vec<StampedPose> {
    let base_from_laser = Isometry2::translation(laser_m, 0.0);
    trajectory.iter().map(|p| StampedPose { pose: p.pose * base_from_laser, ..*p }).collect()
}

/// Judges a trajectory by relations, linear between its poses. Relations that reach beyond it are left out. `None` when all do.
///
/// Work: for each relation the logarithm of the trajectory's length.
pub fn relation_errors(trajectory: &[StampedPose], relations: &[Relation]) -> Option<RelationErrors> {
    let (first_s, last_s) = span_s(trajectory.iter().map(|p| p.stamp_s));
    let span_s = first_s - BEYOND_S..=last_s + BEYOND_S;
    let at = |stamp_s: f64| {
        if !span_s.contains(&stamp_s) {
            return None;
        }
        let after = trajectory.partition_point(|p| p.stamp_s < stamp_s);
        let b = trajectory.get(after).or(trajectory.last())?;
        let a = trajectory.get(after.wrapping_sub(1)).unwrap_or(b);
        let gap_s = b.stamp_s - a.stamp_s;
        let share = if gap_s > 0.0 { ((stamp_s - a.stamp_s) / gap_s).clamp(0.0, 1.0) } else { 1.0 };
        Some(between(&a.pose, &b.pose, share))
    };
    let errors: Vec<(f64, f64)> = relations
        .iter()
        .filter_map(|relation| {
            let [first, second] = relation.stamps_s.map(at);
            let said = first?.inv_mul(&second?);
            // The distance is that of the second poses as seen from the first.
            let off = said.translation.vector - relation.first_from_second.translation.vector;
            let turn = relation.first_from_second.rotation.rotation_to(&said.rotation).angle();
            Some((off.norm(), turn.abs().to_degrees()))
        })
        .collect();
    Some(RelationErrors { of: relations.len(), errors: PairErrors::of(&errors)? })
}

/// Mean translational error of [`relation_errors`], metres.
pub fn mean_relation_error_m(trajectory: &[StampedPose], relations: &[Relation]) -> Option<f64> {
    relation_errors(trajectory, relations).map(|r| r.errors.trans_m)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn trajectory() -> Vec<StampedPose> {
        let at = |t: f64| StampedPose { stamp_s: t, pose: Isometry2::new(Vector2::new(t, t * t), t) };
        (0..50).map(|k| f64::from(k) * 0.1).map(at).collect()
    }

    fn line(from: usize, to: usize, dx: f64, turn: f64, long: bool) -> String {
        let trajectory = trajectory();
        let said = trajectory[from].pose.inv_mul(&trajectory[to].pose);
        let (x, y, yaw) = (said.translation.x + dx, said.translation.y, said.rotation.angle() + turn);
        let stamps = format!("{} {}", trajectory[from].stamp_s, trajectory[to].stamp_s);
        if long { format!("{stamps} {x} {y} 0 0 0 {yaw}\n") } else { format!("{stamps} {x} {y} {yaw}\n") }
    }

    #[test]
    fn relations_of_both_kinds_are_read_and_measured() {
        let text = format!("# checked\n{}\n{}", line(10, 30, 0.0, 0.0, false), line(5, 45, -0.2, 0.1, true));
        let found = relation_errors(&trajectory(), &parse_relations(&text).unwrap()).unwrap();
        let e = found.errors;
        assert_eq!((found.of, e.n), (2, 2));
        for (got, want) in [
            (e.trans_m, 0.1),
            (e.trans_std, 0.1),
            (e.trans_med, 0.1),
            (e.rot_deg, 0.05_f64.to_degrees()),
            (e.rot_std, 0.05_f64.to_degrees()),
        ] {
            assert!((got - want).abs() < 1e-9, "{got} {want}");
        }
    }

    #[test]
    fn a_line_that_is_no_relation_is_named() {
        for bad in ["1 2 3", "1 2 3 4 5 6", "1 2 3 x 5", "1 2 3 4 5 6 7 nan", "1 2 3 4 5 6 7 8 9"] {
            assert_eq!(parse_relations(&format!("1 2 3 4 5\n{bad}\n")).unwrap_err().line, 2, "{bad}");
        }
    }

    #[test]
    fn what_reaches_beyond_the_trajectory_is_left_out_and_counted() {
        let text = line(0, 49, 0.0, 0.0, true) + "-0.009 1 0 0 0\n-0.011 1 0 0 0\n80 90 0 0 0\n";
        let found = relation_errors(&trajectory(), &parse_relations(&text).unwrap()).unwrap();
        assert_eq!((found.of, found.errors.n), (4, 2), "up to 10 ms beyond the ends count");
        assert!(relation_errors(&trajectory(), &parse_relations("80 90 0 0 0").unwrap()).is_none());
        assert!(relation_errors(&[], &parse_relations("0 0 0 0 0").unwrap()).is_none());
    }

    #[test]
    fn relations_of_the_laser_are_met_by_the_poses_of_the_laser() {
        let laser = at_laser(&trajectory(), 0.3);
        let said = laser[3].pose.inv_mul(&laser[40].pose);
        let relation = Relation { stamps_s: [laser[3].stamp_s, laser[40].stamp_s], first_from_second: said };
        let error = |trajectory: &[StampedPose]| mean_relation_error_m(trajectory, &[relation]).unwrap();
        assert!(error(&laser) < 1e-12 && error(&trajectory()) > 0.1);
    }
}
