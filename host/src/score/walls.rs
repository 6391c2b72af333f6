//! How thick a trajectory makes the walls: what is seen twice from poses that disagree lies side by side.

use std::collections::HashMap;

use nalgebra::{Matrix2, Point2, Vector2};

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

#[cfg(test)]
mod tests {
    use nalgebra::UnitComplex;

    use super::super::Spread;
    use super::*;

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
}
