//! Rays and what they meet.

use nalgebra::{Point2, Vector2};

use super::world::{Disc, Edge};

/// What a ray met.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Hit {
    /// Distance, metres.
    pub range_m: f64,
    /// Cosine of the angle between beam and surface normal.
    pub incidence: f64,
    /// Whether it is glass.
    pub glass: bool,
}

/// Distance of a point from an edge, metres.
pub fn distance_to(edge: &Edge, point: Point2<f64>) -> f64 {
    let along = edge.to - edge.from;
    let share = ((point - edge.from).dot(&along) / along.norm_squared().max(1e-12)).clamp(0.0, 1.0);
    (edge.from + along * share - point).norm()
}

/// The first surface a ray meets.
pub fn cast(from: Point2<f64>, direction: Vector2<f64>, edges: &[Edge], discs: &[Disc]) -> Option<Hit> {
    let of_edge = |e: &Edge| Some((meet_edge(from, direction, e)?, e.glass));
    let of_disc = |d: &Disc| Some((meet_disc(from, direction, d)?, false));
    edges
        .iter()
        .filter_map(of_edge)
        .chain(discs.iter().filter_map(of_disc))
        .map(|((range_m, incidence), glass)| Hit { range_m, incidence, glass })
        .filter(|hit| hit.range_m > 1e-3)
        .min_by(|a, b| a.range_m.total_cmp(&b.range_m))
}

/// Range and cosine of the incidence at which a ray's line meets an edge; a range below zero lies behind.
pub(super) fn meet_edge(from: Point2<f64>, direction: Vector2<f64>, edge: &Edge) -> Option<(f64, f64)> {
    let (along, to_edge) = (edge.to - edge.from, edge.from - from);
    let denominator = direction.perp(&along);
    let share = to_edge.perp(&direction) / denominator;
    (0.0..=1.0)
        .contains(&share)
        .then(|| (to_edge.perp(&along) / denominator, denominator.abs() / along.norm()))
}

/// The same of a disc, where the ray enters it.
pub(super) fn meet_disc(from: Point2<f64>, direction: Vector2<f64>, disc: &Disc) -> Option<(f64, f64)> {
    let to_centre = disc.centre - from;
    let (ahead, aside) = (to_centre.dot(&direction), to_centre.perp(&direction));
    let half2 = disc.radius * disc.radius - aside * aside;
    (half2 > 0.0).then(|| (ahead - half2.sqrt(), half2.sqrt() / disc.radius))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_ray_meets_the_nearest_surface() {
        let edge = Edge { from: Point2::new(3.0, -1.0), to: Point2::new(3.0, 1.0), glass: false };
        let disc = Disc { centre: Point2::new(2.0, 0.0), radius: 0.25 };
        let from = Point2::new(0.0, 0.0);
        let hit = |direction: Vector2<f64>, discs: &[Disc]| cast(from, direction.normalize(), &[edge], discs);
        assert!((hit(Vector2::x(), &[disc]).unwrap().range_m - 1.75).abs() < 1e-12);
        assert!((hit(Vector2::x(), &[]).unwrap().range_m - 3.0).abs() < 1e-12);
        let slanted = hit(Vector2::new(3.0, 0.9), &[]).unwrap();
        assert!((slanted.incidence - 3.0 / 9.81f64.sqrt()).abs() < 1e-12);
        assert!(hit(-Vector2::x(), &[disc]).is_none());
        assert!(hit(Vector2::y(), &[disc]).is_none());
    }
}
