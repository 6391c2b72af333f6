//! How a trajectory is judged against a reference: absolute trajectory error after one SE(2) alignment, and relations
//! between poses that somebody has checked.

use nalgebra::{Isometry2, UnitComplex, Vector2};

/// A stamped planar position, seconds and metres.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StampedPosition {
    /// Stamp, seconds.
    pub stamp_s: f64,
    /// Position, metres.
    pub position: Vector2<f64>,
}

/// A trajectory file that is not one: the line, from 1.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("line {line} is not a TUM pose (timestamp x y z qx qy qz qw)")]
pub struct NotTum {
    /// Line, from 1.
    pub line: usize,
}

/// Reads the positions of a TUM trajectory.
pub fn parse_tum(text: &str) -> Result<Vec<StampedPosition>, NotTum> {
    let mut poses = Vec::new();
    for (index, line) in text.lines().enumerate() {
        if line.trim().is_empty() || line.starts_with('#') {
            continue;
        }
        let numbers: Vec<f64> = line.split_whitespace().filter_map(|w| w.parse().ok()).collect();
        let [stamp_s, x, y, _, _, _, _, _] = numbers[..] else { return Err(NotTum { line: index + 1 }) };
        poses.push(StampedPosition { stamp_s, position: Vector2::new(x, y) });
    }
    Ok(poses)
}

/// A rotation and a translation that lay one trajectory on another, and how well they do.
#[derive(Clone, Copy, Debug)]
pub struct Alignment {
    /// Carries the estimate onto the reference.
    pub reference_from_estimate: Isometry2<f64>,
    /// Root mean square distance after that, metres: the absolute trajectory error.
    pub rmse_m: f64,
}

/// Lays an estimate on a reference with the same stamps (to 2 ms) as well as a rotation and a translation can. Reference
/// poses without an estimate are scored as standing still since the last one. `None` when nothing agrees.
pub fn align(estimate: &[StampedPosition], reference: &[StampedPosition]) -> Option<Alignment> {
    let mut pairs: Vec<(Vector2<f64>, Vector2<f64>)> = Vec::new();
    let mut rest = estimate.iter().peekable();
    let mut last = None;
    for truth in reference {
        while let Some(e) = rest.next_if(|e| e.stamp_s <= truth.stamp_s + 2e-3) {
            last = Some(e.position);
        }
        if let Some(position) = last {
            pairs.push((position, truth.position));
        }
    }
    if pairs.is_empty() {
        return None;
    }
    let n = pairs.len() as f64;
    let mean_e = pairs.iter().map(|p| p.0).sum::<Vector2<f64>>() / n;
    let mean_r = pairs.iter().map(|p| p.1).sum::<Vector2<f64>>() / n;
    let (mut cos, mut sin) = (0.0, 0.0);
    for (e, r) in &pairs {
        let (e, r) = (e - mean_e, r - mean_r);
        cos += e.dot(&r);
        sin += e.x * r.y - e.y * r.x;
    }
    let rotation = UnitComplex::new(sin.atan2(cos));
    let reference_from_estimate = Isometry2::from_parts((mean_r - rotation * mean_e).into(), rotation);
    let square =
        |(e, r): &(Vector2<f64>, Vector2<f64>)| (rotation * (e - mean_e) - (r - mean_r)).norm_squared();
    let rmse_m = (pairs.iter().map(square).sum::<f64>() / n).sqrt();
    Some(Alignment { reference_from_estimate, rmse_m })
}

/// Root mean square distance, metres, after [`align`].
pub fn absolute_trajectory_error(estimate: &[StampedPosition], reference: &[StampedPosition]) -> Option<f64> {
    align(estimate, reference).map(|a| a.rmse_m)
}

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
#[error("line {line} is not a relation (stamp stamp x y theta)")]
pub struct NotRelation {
    /// Line, from 1.
    pub line: usize,
}

/// Reads relations: two stamps, then x, y and θ of the second pose in the first.
pub fn parse_relations(text: &str) -> Result<Vec<Relation>, NotRelation> {
    let mut relations = Vec::new();
    for (index, line) in text.lines().enumerate().filter(|(_, l)| !l.trim().is_empty()) {
        let numbers: Vec<f64> = line.split_whitespace().filter_map(|w| w.parse().ok()).collect();
        let [from_s, to_s, x, y, theta] = numbers[..] else { return Err(NotRelation { line: index + 1 }) };
        let first_from_second = Isometry2::new(Vector2::new(x, y), theta);
        relations.push(Relation { stamps_s: [from_s, to_s], first_from_second });
    }
    Ok(relations)
}

/// Mean distance, metres, between relations and what a trajectory of stamps (s) and poses says, linear between its
/// stamps. Relations outside it are left out. `None` when all are.
pub fn mean_relation_error_m(trajectory: &[(f64, Isometry2<f64>)], relations: &[Relation]) -> Option<f64> {
    let at = |stamp_s: f64| {
        let after = trajectory.partition_point(|(s, _)| *s < stamp_s);
        let (first, last) = (trajectory.get(after.saturating_sub(1))?, trajectory.get(after)?);
        let span_s = last.0 - first.0;
        let share = if span_s > 0.0 { (stamp_s - first.0) / span_s } else { 1.0 };
        (0.0..=1.0).contains(&share).then(|| first.1.lerp_slerp(&last.1, share))
    };
    let errors: Vec<f64> = relations
        .iter()
        .filter_map(|relation| {
            let [first, second] = relation.stamps_s.map(at);
            let said = first?.inv_mul(&second?);
            Some(relation.first_from_second.inv_mul(&said).translation.vector.norm())
        })
        .collect();
    (!errors.is_empty()).then(|| errors.iter().sum::<f64>() / errors.len() as f64)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn trajectory() -> Vec<(f64, Isometry2<f64>)> {
        (0..50).map(|k| f64::from(k) * 0.1).map(|t| (t, Isometry2::new(Vector2::new(t, t * t), t))).collect()
    }

    fn positions(carry: Isometry2<f64>) -> Vec<StampedPosition> {
        let at = |(stamp_s, p): (f64, Isometry2<f64>)| StampedPosition {
            stamp_s,
            position: (carry * p).translation.vector,
        };
        trajectory().into_iter().map(at).collect()
    }

    #[test]
    fn alignment_takes_out_where_a_map_begins_and_nothing_else() {
        let carry = Isometry2::new(Vector2::new(3.0, -4.0), 2.0);
        let found = align(&positions(Isometry2::identity()), &positions(carry)).unwrap();
        assert!(found.rmse_m < 1e-12);
        assert!((found.reference_from_estimate.inverse() * carry).translation.vector.norm() < 1e-12);
        let mut off = positions(carry);
        for (k, p) in off.iter_mut().enumerate() {
            p.position.x += if k % 2 == 0 { 0.1 } else { -0.1 };
        }
        let error = absolute_trajectory_error(&positions(Isometry2::identity()), &off).unwrap();
        assert!((error - 0.1).abs() < 1e-3, "{error}");
        assert!(absolute_trajectory_error(&[], &off).is_none());
    }

    #[test]
    fn relations_are_read_and_measured() {
        let trajectory = trajectory();
        let said = trajectory[10].1.inv_mul(&trajectory[30].1);
        let line = |dx: f64| {
            format!("1.0 3.0 {} {} {}\n", said.translation.x + dx, said.translation.y, said.rotation.angle())
        };
        let relations = parse_relations(&(line(0.0) + &line(0.2))).unwrap();
        let error = mean_relation_error_m(&trajectory, &relations).unwrap();
        assert!((error - 0.1).abs() < 1e-9, "{error}");
        assert_eq!(parse_relations("1 2 3 4 5\n1 2 3\n").unwrap_err().line, 2);
        let outside = parse_relations("80 90 0 0 0").unwrap();
        assert!(mean_relation_error_m(&trajectory, &outside).is_none());
    }
}
