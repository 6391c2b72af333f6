//! A URG-04LX, beam by beam, each at its own instant.

use nalgebra::{Isometry2, Point2, Vector2};
use rand::RngExt;
use rand_distr::{Distribution, Normal};
use rand_pcg::Pcg64;
use slam_core::scan::ScanGeometry;

use super::SensorModel;
use super::world::{Disc, Edge, World};

/// Farthest distance the sensor reports, metres.
pub const REACH_M: f64 = 5.6;
/// Codes of the sensor for readings that went wrong: weak return, neighbours in error, two waves differ, not measurable.
const ERROR_CODES: [u16; 4] = [1, 7, 8, 19];
/// Neighbouring ranges farther apart than this have an edge between them, metres.
const EDGE_M: f64 = 0.1;

/// The simulated scanner.
pub struct Scanner {
    model: SensorModel,
    geometry: ScanGeometry,
    edges: Vec<Edge>,
    discs: Vec<Disc>,
    rng: Pcg64,
}

/// What a ray met.
pub struct Hit {
    /// Distance, metres.
    pub range_m: f64,
    /// Cosine of the angle between beam and surface normal.
    pub incidence: f64,
    /// Whether it gives no echo.
    pub glass: bool,
}

impl Scanner {
    /// A scanner in a world. `rng` decides all its noise.
    pub fn new(world: &World, model: SensorModel, geometry: ScanGeometry, rng: Pcg64) -> Self {
        Self { model, geometry, edges: world.edges(), discs: world.discs(), rng }
    }

    /// One scan. `world_from_laser` gives the sensor's pose at a beam, `people` those who walk, at the middle beam.
    pub fn scan(&mut self, world_from_laser: impl Fn(usize) -> Isometry2<f64>, people: &[Disc]) -> Vec<u16> {
        let beams = self.geometry.beams();
        let middle = Point2::from(world_from_laser(beams / 2).translation.vector);
        // What no beam can reach is left out beforehand.
        let near_edge = |e: &&Edge| distance_to(e, middle) < REACH_M + 0.5;
        let near_disc = |d: &&Disc| (d.centre - middle).norm() < REACH_M + 0.5 + d.radius;
        let edges: Vec<Edge> = self.edges.iter().filter(near_edge).copied().collect();
        let discs: Vec<Disc> = self.discs.iter().chain(people).filter(near_disc).copied().collect();
        let hits: Vec<Option<Hit>> = (0..beams)
            .map(|beam| {
                let pose = world_from_laser(beam);
                let bearing = f64::from(self.geometry.bearing(beam));
                let direction = pose.rotation * Vector2::new(libm::cos(bearing), libm::sin(bearing));
                cast(pose.translation.vector.into(), direction, &edges, &discs)
            })
            .collect();
        (0..beams).map(|beam| self.reading(&hits, beam)).collect()
    }

    fn reading(&mut self, hits: &[Option<Hit>], beam: usize) -> u16 {
        // Drawn for every beam, so that a change of one model does not move the noise of the others.
        let noise: f64 = Normal::new(0.0, 1.0).map_or(0.0, |n| n.sample(&mut self.rng));
        let uniform: f64 = self.rng.random_range(-1.0..1.0);
        let (lost, mixed, share): (f64, f64, f64) = (self.rng.random(), self.rng.random(), self.rng.random());
        let code = ERROR_CODES[self.rng.random_range(0..ERROR_CODES.len())];
        let Some(hit) = hits[beam].as_ref().filter(|h| !h.glass) else { return 0 };
        if lost < self.model.dropout {
            return code;
        }
        // A surface almost along the beam returns too little.
        if hit.incidence < self.model.least_incidence {
            return code;
        }
        let mut range_m = hit.range_m;
        if mixed < self.model.mixed_pixels
            && let Some(Some(next)) = hits.get(beam + 1)
            && (next.range_m - hit.range_m).abs() > EDGE_M
            && !next.glass
        {
            range_m += share * (next.range_m - hit.range_m);
        }
        let sigma_m = self.model.sigma_m.max(self.model.sigma_per_m * range_m);
        range_m += sigma_m * noise + self.model.uniform_m * uniform;
        if range_m > REACH_M {
            return 0;
        }
        (range_m * 1000.0).round().clamp(20.0, 5600.0) as u16
    }
}

/// Distance of a point from an edge, metres.
pub fn distance_to(edge: &Edge, point: Point2<f64>) -> f64 {
    let along = edge.to - edge.from;
    let share = ((point - edge.from).dot(&along) / along.norm_squared().max(1e-12)).clamp(0.0, 1.0);
    (edge.from + along * share - point).norm()
}

/// The first surface a ray meets.
pub fn cast(from: Point2<f64>, direction: Vector2<f64>, edges: &[Edge], discs: &[Disc]) -> Option<Hit> {
    let mut best: Option<Hit> = None;
    let mut offer = |range_m: f64, incidence: f64, glass: bool| {
        if range_m > 1e-3 && best.as_ref().is_none_or(|b| range_m < b.range_m) {
            best = Some(Hit { range_m, incidence, glass });
        }
    };
    for edge in edges {
        let (along, to_edge) = (edge.to - edge.from, edge.from - from);
        let denominator = direction.perp(&along);
        let share = to_edge.perp(&direction) / denominator;
        if (0.0..=1.0).contains(&share) {
            offer(to_edge.perp(&along) / denominator, denominator.abs() / along.norm(), edge.glass);
        }
    }
    for disc in discs {
        let to_centre = disc.centre - from;
        let (ahead, aside) = (to_centre.dot(&direction), to_centre.perp(&direction));
        let half2 = disc.radius * disc.radius - aside * aside;
        if half2 > 0.0 {
            let half = half2.sqrt();
            offer(ahead - half, half / disc.radius, false);
        }
    }
    best
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
