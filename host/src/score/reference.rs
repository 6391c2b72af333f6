//! A trajectory against a reference: the absolute trajectory error of Sturm et al., "A Benchmark for the Evaluation of RGB-D
//! SLAM Systems", IROS 2012, with one alignment in the plane.

use nalgebra::{Isometry2, Vector2};
use serde::{Serialize, Serializer};

use super::matching::at_stamps;
use super::relative::{PairErrors, pair_errors, ways_m};
use super::{Spread, StampedPose};

/// A rotation and a translation that lay one trajectory on another, and how well they do.
#[derive(Clone, Copy, Debug)]
pub struct Alignment {
    /// Carries the estimate onto the reference.
    pub reference_from_estimate: Isometry2<f64>,
    /// Root mean square distance after that, metres: the absolute trajectory error.
    pub rmse_m: f64,
}

/// Lays an estimate on a reference as well as a rotation and a translation can, at the reference's stamps. Those at which the
/// estimate has no pose count as standing still. `None` when they have no instant in common.
pub fn align(estimate: &[StampedPose], reference: &[StampedPose]) -> Option<Alignment> {
    let stamps_s: Vec<f64> = reference.iter().map(|r| r.stamp_s).collect();
    let poses = at_stamps(estimate, &stamps_s)?.poses;
    let reference_from_estimate = lay(&poses, reference)?;
    let square = |(e, r): (&Isometry2<f64>, &StampedPose)| {
        ((reference_from_estimate * e).translation.vector - r.position()).norm_squared()
    };
    let sum: f64 = poses.iter().zip(reference).map(square).sum();
    Some(Alignment { reference_from_estimate, rmse_m: (sum / poses.len() as f64).sqrt() })
}

/// Root mean square distance, metres, after [`align`].
pub fn absolute_trajectory_error(estimate: &[StampedPose], reference: &[StampedPose]) -> Option<f64> {
    align(estimate, reference).map(|a| a.rmse_m)
}

/// [`lay`](super::lay) of positions that belong together.
fn lay(estimate: &[Isometry2<f64>], reference: &[StampedPose]) -> Option<Isometry2<f64>> {
    let estimate: Vec<Vector2<f64>> = estimate.iter().map(|e| e.translation.vector).collect();
    let reference: Vec<Vector2<f64>> = reference.iter().map(StampedPose::position).collect();
    super::lay(&estimate, &reference)
}

/// All that a reference tells of a trajectory. Names and units in JSON are these, too.
#[derive(Clone, Debug, Serialize)]
pub struct AgainstReference {
    /// Poses of the reference.
    pub poses: usize,
    /// Share of them at whose stamps the trajectory has a pose; at the others the robot counts as standing still.
    pub coverage: f64,
    /// Share of them at whose very stamp the trajectory has a pose; between these it is interpolated.
    pub exact: f64,
    /// Absolute trajectory error: root mean square distance after the alignment, metres.
    pub ate_rmse_m: f64,
    /// Median of the same distances, metres.
    pub ate_med_m: f64,
    /// Largest of the same distances, metres.
    pub ate_max_m: f64,
    /// Root mean square error of the heading after the same alignment, degrees.
    pub rot_rmse_deg: f64,
    /// Length of the reference's path, metres.
    pub path_ref_m: f64,
    /// Length of the trajectory's path, metres.
    pub path_est_m: f64,
    /// Errors between pairs of poses: one step apart, some way apart, and back at a place.
    #[serde(serialize_with = "as_map")]
    pub rpe: Vec<(String, PairErrors)>,
}

fn as_map<S: Serializer>(pairs: &[(String, PairErrors)], serializer: S) -> Result<S::Ok, S::Error> {
    serializer.collect_map(pairs.iter().map(|(name, errors)| (name, errors)))
}

/// Judges a trajectory by a reference, at the reference's stamps. `None` when they have no instant in common.
pub fn against_reference(estimate: &[StampedPose], reference: &[StampedPose]) -> Option<AgainstReference> {
    let stamps_s: Vec<f64> = reference.iter().map(|r| r.stamp_s).collect();
    let matched = at_stamps(estimate, &stamps_s)?;
    let reference_from_estimate = lay(&matched.poses, reference)?;
    let (distances, headings): (Vec<f64>, Vec<f64>) = matched
        .poses
        .iter()
        .zip(reference)
        .map(|(e, r)| {
            let laid = reference_from_estimate * e;
            let turn = r.pose.rotation.rotation_to(&laid.rotation).angle();
            ((laid.translation.vector - r.position()).norm(), turn.to_degrees())
        })
        .unzip();
    let rms = |values: &[f64]| (values.iter().map(|v| v * v).sum::<f64>() / values.len() as f64).sqrt();
    let spread = Spread::of(distances.iter().copied())?;
    let truths: Vec<Isometry2<f64>> = reference.iter().map(|r| r.pose).collect();
    let share = |n: usize| n as f64 / reference.len() as f64;
    Some(AgainstReference {
        poses: reference.len(),
        coverage: share(matched.found),
        exact: share(matched.exact),
        ate_rmse_m: rms(&distances),
        ate_med_m: spread.median,
        ate_max_m: spread.worst,
        rot_rmse_deg: rms(&headings),
        path_ref_m: ways_m(&truths).last().copied().unwrap_or(0.0),
        path_est_m: ways_m(&matched.poses).last().copied().unwrap_or(0.0),
        rpe: pair_errors(&matched.poses, &truths),
    })
}

#[cfg(test)]
mod tests {
    use nalgebra::UnitComplex;

    use super::*;

    fn trajectory(carry: Isometry2<f64>) -> Vec<StampedPose> {
        let at = |t: f64| StampedPose { stamp_s: t, pose: carry * Isometry2::new(Vector2::new(t, t * t), t) };
        (0..50).map(|k| f64::from(k) * 0.1).map(at).collect()
    }

    #[test]
    fn alignment_takes_out_where_a_map_begins_and_nothing_else() {
        let carry = Isometry2::new(Vector2::new(3.0, -4.0), 2.0);
        let found = align(&trajectory(Isometry2::identity()), &trajectory(carry)).unwrap();
        assert!(found.rmse_m < 1e-12);
        assert!((found.reference_from_estimate.inverse() * carry).translation.vector.norm() < 1e-12);
        let mut off = trajectory(carry);
        for (k, p) in off.iter_mut().enumerate() {
            p.pose.translation.x += if k % 2 == 0 { 0.1 } else { -0.1 };
        }
        let error = absolute_trajectory_error(&trajectory(Isometry2::identity()), &off).unwrap();
        assert!((error - 0.1).abs() < 1e-3, "{error}");
        assert!(absolute_trajectory_error(&[], &off).is_none());
    }

    #[test]
    fn a_trajectory_carried_elsewhere_is_without_error_in_every_measure() {
        let carry = Isometry2::new(Vector2::new(-30.0, 7.0), -3.0);
        let found = against_reference(&trajectory(carry), &trajectory(Isometry2::identity())).unwrap();
        assert_eq!((found.poses, found.coverage, found.exact), (50, 1.0, 1.0));
        assert!(found.ate_rmse_m.max(found.ate_max_m).max(found.rot_rmse_deg) < 1e-9, "{found:?}");
        assert!((found.path_ref_m - found.path_est_m).abs() < 1e-9);
        assert!(found.rpe.iter().any(|(name, _)| name == "5m"), "{found:?}");
        assert!(found.rpe.iter().all(|(_, e)| e.trans_m < 1e-9 && e.rot_deg < 1e-9), "{found:?}");
    }

    #[test]
    fn headings_off_by_the_same_angle_cost_nothing_but_heading() {
        let mut turned = trajectory(Isometry2::identity());
        turned.iter_mut().for_each(|p| p.pose.rotation *= UnitComplex::new(0.1));
        let found = against_reference(&turned, &trajectory(Isometry2::identity())).unwrap();
        assert!(found.ate_max_m < 1e-12);
        assert!((found.rot_rmse_deg - 0.1_f64.to_degrees()).abs() < 1e-9, "{found:?}");
    }
}
