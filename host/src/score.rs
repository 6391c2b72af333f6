//! How a trajectory is judged against a reference: absolute trajectory error after one SE(2) alignment, relations
//! between poses that somebody has checked, and how thick it makes the walls.

use std::collections::HashMap;

use nalgebra::{Isometry2, Matrix2, Point2, UnitComplex, UnitQuaternion, Vector2};

/// A stamped planar pose, seconds and metres.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StampedPose {
    /// Stamp, seconds.
    pub stamp_s: f64,
    /// The pose.
    pub pose: Isometry2<f64>,
}

impl StampedPose {
    /// From a stamp in microseconds and a pose of the core's.
    pub fn of_core(stamp_us: u64, pose: &Isometry2<f32>) -> Self {
        Self { stamp_s: stamp_us as f64 * 1e-6, pose: nalgebra::convert(*pose) }
    }

    fn position(&self) -> Vector2<f64> {
        self.pose.translation.vector
    }
}

/// A trajectory file that is not one: the line, from 1.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("line {line} is not a TUM pose (timestamp x y z qx qy qz qw)")]
pub struct NotTum {
    /// Line, from 1.
    pub line: usize,
}

/// Reads a TUM trajectory: of each orientation the turn about the vertical.
pub fn parse_tum(text: &str) -> Result<Vec<StampedPose>, NotTum> {
    let mut poses = Vec::new();
    for (index, line) in text.lines().enumerate() {
        if line.trim().is_empty() || line.starts_with('#') {
            continue;
        }
        let numbers: Vec<f64> = line.split_whitespace().filter_map(|w| w.parse().ok()).collect();
        let [stamp_s, x, y, _, qx, qy, qz, qw] = numbers[..] else { return Err(NotTum { line: index + 1 }) };
        let (_, _, heading) =
            UnitQuaternion::from_quaternion(nalgebra::Quaternion::new(qw, qx, qy, qz)).euler_angles();
        poses.push(StampedPose { stamp_s, pose: Isometry2::new(Vector2::new(x, y), heading) });
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
pub fn align(estimate: &[StampedPose], reference: &[StampedPose]) -> Option<Alignment> {
    let truths = reference.iter().map(StampedPose::position);
    let pairs: Vec<(Vector2<f64>, Vector2<f64>)> = at_stamps(estimate, reference.iter().map(|r| r.stamp_s))
        .zip(truths)
        .filter_map(|(found, truth)| Some((found?.translation.vector, truth)))
        .collect();
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

/// The pose of a trajectory at each of some rising stamps (seconds, to 2 ms), or the last one before; none before its first.
pub fn at_stamps(
    trajectory: &[StampedPose],
    stamps_s: impl Iterator<Item = f64>,
) -> impl Iterator<Item = Option<Isometry2<f64>>> {
    let mut rest = trajectory.iter().peekable();
    let mut last = None;
    stamps_s.map(move |stamp_s| {
        while let Some(next) = rest.next_if(|next| next.stamp_s <= stamp_s + 2e-3) {
            last = Some(next.pose);
        }
        last
    })
}

/// Root mean square distance, metres, after [`align`].
pub fn absolute_trajectory_error(estimate: &[StampedPose], reference: &[StampedPose]) -> Option<f64> {
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

/// Mean distance, metres, between relations and what a trajectory says, linear between its stamps. Relations outside it
/// are left out. `None` when all are.
pub fn mean_relation_error_m(trajectory: &[StampedPose], relations: &[Relation]) -> Option<f64> {
    let at = |stamp_s: f64| {
        let after = trajectory.partition_point(|pose| pose.stamp_s < stamp_s);
        let (first, last) = (trajectory.get(after.saturating_sub(1))?, trajectory.get(after)?);
        let span_s = last.stamp_s - first.stamp_s;
        let share = if span_s > 0.0 { (stamp_s - first.stamp_s) / span_s } else { 1.0 };
        (0.0..=1.0).contains(&share).then(|| first.pose.lerp_slerp(&last.pose, share))
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

/// Points around one within this distance are its wall, metres; found by cells of [`CELL_M`].
const WALL_RADIUS_M: f64 = 0.3;
const CELL_M: f64 = 0.05;
/// A point with fewer around it says nothing.
const LEAST_POINTS: f64 = 10.0;

/// Number, sum and sum of squares of some points.
#[derive(Clone, Copy, Default)]
struct Sums {
    n: f64,
    sum: Vector2<f64>,
    squares: Matrix2<f64>,
}

impl Sums {
    fn add(&mut self, other: &Self) {
        self.n += other.n;
        self.sum += other.sum;
        self.squares += other.squares;
    }

    /// Standard deviation across the direction in which they are spread most.
    fn thickness_m(&self) -> f64 {
        let mean = self.sum / self.n;
        let [a, b] = (self.squares / self.n - mean * mean.transpose()).symmetric_eigenvalues().into();
        f64::min(a, b).max(0.0).sqrt()
    }
}

/// How thick each point's wall is: the standard deviation of the points around it, across, metres. Points that stand
/// alone are left out.
///
/// Work: for each occupied cell some hundred steps.
pub fn wall_thicknesses_m(points: &[Point2<f64>]) -> Vec<f64> {
    let Some(first) = points.first() else { return Vec::new() };
    let mut cells: HashMap<(i64, i64), Sums> = HashMap::new();
    for point in points {
        // Squares keep their digits where all points are far from the origin.
        let at = point - first;
        let key = ((at.x / CELL_M).floor() as i64, (at.y / CELL_M).floor() as i64);
        cells.entry(key).or_default().add(&Sums { n: 1.0, sum: at, squares: at * at.transpose() });
    }
    let reach = (WALL_RADIUS_M / CELL_M).round() as i64;
    let disc: Vec<(i64, i64)> = (-reach..=reach)
        .flat_map(|x| (-reach..=reach).map(move |y| (x, y)))
        .filter(|(x, y)| x * x + y * y <= reach * reach)
        .collect();
    let mut thicknesses = Vec::with_capacity(points.len());
    for ((x, y), own) in &cells {
        let mut around = Sums::default();
        disc.iter().filter_map(|(dx, dy)| cells.get(&(x + dx, y + dy))).for_each(|cell| around.add(cell));
        if around.n >= LEAST_POINTS {
            thicknesses.extend(std::iter::repeat_n(around.thickness_m(), own.n as usize));
        }
    }
    thicknesses
}

/// Mean, median and largest of some numbers.
#[derive(Clone, Copy, Debug)]
pub struct Spread {
    /// Their mean.
    pub mean: f64,
    /// The middle one, of an even number the mean of both.
    pub median: f64,
    /// The largest.
    pub worst: f64,
}

impl Spread {
    /// `None` of none.
    pub fn of(values: impl Iterator<Item = f64>) -> Option<Self> {
        let mut sorted: Vec<f64> = values.collect();
        sorted.sort_unstable_by(f64::total_cmp);
        let n = sorted.len();
        let median = 0.5 * (sorted.get(n.checked_sub(1)? / 2)? + sorted.get(n / 2)?);
        Some(Self { mean: sorted.iter().sum::<f64>() / n as f64, median, worst: *sorted.last()? })
    }
}

#[cfg(test)]
mod tests {
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
    fn relations_are_read_and_measured() {
        let trajectory = trajectory(Isometry2::identity());
        let said = trajectory[10].pose.inv_mul(&trajectory[30].pose);
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

    #[test]
    fn a_trajectory_file_is_read_with_its_headings() {
        let text = "# stamp x y z qx qy qz qw\n\n1.5 2 -3 0 0 0 0.6 0.8\n";
        let want = StampedPose {
            stamp_s: 1.5,
            pose: Isometry2::new(Vector2::new(2.0, -3.0), 2.0 * 0.6_f64.atan2(0.8)),
        };
        let [read] = parse_tum(text).unwrap()[..] else { panic!("one pose") };
        assert_eq!(read.stamp_s, want.stamp_s);
        assert!(read.pose.inv_mul(&want.pose).to_homogeneous().is_identity(1e-12), "{read:?}");
        assert_eq!(parse_tum("1 2 3 4 5 6 7 8\n1 2 3\n").unwrap_err().line, 2);
    }

    /// A wall seen twice, the second time shifted: its points lie half the shift to either side.
    #[test]
    fn a_wall_is_as_thick_as_what_was_seen_of_it_lies_apart() {
        let turn = UnitComplex::new(0.4);
        let wall = |shift: f64| (0..500).map(move |k| turn * Point2::new(f64::from(k) * 0.01 + 1e3, shift));
        for shift in [0.0, 0.02, 0.1] {
            let mut points: Vec<_> = wall(0.0).chain(wall(shift)).collect();
            let expected = shift / 2.0;
            let all = wall_thicknesses_m(&points);
            assert_eq!(all.len(), 1000);
            let got = Spread::of(all.into_iter()).unwrap().median;
            assert!((got - expected).abs() < 1e-3, "{got}, shifted by {shift}");
            points.push(Point2::new(0.0, 0.0));
            assert_eq!(wall_thicknesses_m(&points).len(), 1000, "one alone is no wall");
        }
        assert!(wall_thicknesses_m(&[]).is_empty());
    }

    #[test]
    fn a_spread_is_mean_median_and_worst() {
        let spread = Spread::of([4.0, 1.0, 2.0, 9.0].into_iter()).unwrap();
        assert_eq!((spread.mean, spread.median, spread.worst), (4.0, 3.0, 9.0));
        assert!(Spread::of(std::iter::empty()).is_none());
    }
}
