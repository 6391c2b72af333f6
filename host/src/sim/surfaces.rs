//! The building as it was built: walls that are not straight, and skirting. The blueprint stays what it is.

use nalgebra::{Point2, Vector2};
use rand::RngExt;
use rand_pcg::Pcg64;

use super::config::WallModel;
use super::streams::{Stream, stream};
use super::world::{Disc, Edge, Finish, World};

/// Walls shorter than this are straight and have no skirting, metres.
const SHORT_M: f64 = 0.8;
/// A wall that is bent is made of straight pieces of about this length, metres.
const PIECE_M: f64 = 0.35;
/// A wall this long is bent as far as walls are; shorter ones less.
const FULL_BOW_M: f64 = 3.0;
/// Share of the walls' length with skirting, and lengths of its runs, metres.
const SKIRTED: f64 = 0.6;
const RUN_M: [f64; 2] = [0.8, 3.0];

/// A straight surface as the scanner meets it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Surface {
    /// Where it is.
    pub edge: Edge,
    /// What it is like.
    pub finish: Finish,
}

/// A round surface as the scanner meets it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RoundSurface {
    /// Where it is.
    pub disc: Disc,
    /// What it is like.
    pub finish: Finish,
}

/// Every straight surface of a building as it was built.
pub fn as_built(world: &World, model: &WallModel, seed: u64) -> Vec<Surface> {
    let surface = |(edge, finish)| Surface { edge, finish };
    let mut edges = world.finished_edges();
    if model.bow_m == 0.0 && model.skirting_m == 0.0 {
        return edges.into_iter().map(surface).collect();
    }
    let things = edges.split_off(world.wall_edges().len());
    let (mut bow, mut skirting) = (stream(seed, Stream::Bow), stream(seed, Stream::Skirting));
    let mut built = Vec::new();
    for (edge, finish) in edges {
        let bent = Bent::new(&edge, model.bow_m, &mut bow);
        let runs = runs(bent.length, &mut skirting);
        if finish == Finish::Glass || bent.length < SHORT_M {
            built.push(Surface { edge, finish });
            continue;
        }
        let inward = model.skirting_m * inner_side(&edge, world);
        built.extend(bent.pieces(&runs, inward).into_iter().map(|edge| Surface { edge, finish }));
    }
    built.extend(things.into_iter().map(surface));
    built
}

/// Every round surface.
pub fn round(world: &World) -> Vec<RoundSurface> {
    world.finished_discs().into_iter().map(|(disc, finish)| RoundSurface { disc, finish }).collect()
}

/// A wall that leaves its straight line between its ends.
struct Bent {
    from: Point2<f64>,
    along: Vector2<f64>,
    normal: Vector2<f64>,
    length: f64,
    bow_m: f64,
    wave_m: f64,
    waves: f64,
}

impl Bent {
    fn new(edge: &Edge, bow_m: f64, rng: &mut Pcg64) -> Self {
        let length = (edge.to - edge.from).norm().max(1e-9);
        let along = (edge.to - edge.from) / length;
        let most_m = bow_m * (length / FULL_BOW_M).min(1.0);
        let (bow, wave): (f64, f64) = (rng.random_range(-1.0..1.0), rng.random_range(-1.0..1.0));
        // A wave every three to five metres, whole ones so that the ends stay.
        let waves = (length / rng.random_range(3.0..5.0)).ceil();
        Self {
            from: edge.from,
            along,
            normal: Vector2::new(-along.y, along.x),
            length,
            bow_m: 0.6 * bow * most_m,
            wave_m: 0.4 * wave * most_m,
            waves,
        }
    }

    /// Distance from the straight line, metres.
    fn off(&self, way: f64) -> f64 {
        let turn = std::f64::consts::PI * way / self.length;
        self.bow_m * libm::sin(turn) + self.wave_m * libm::sin(2.0 * self.waves * turn)
    }

    fn point(&self, way: f64, before: f64) -> Point2<f64> {
        self.from + self.along * way + self.normal * (self.off(way) + before)
    }

    /// Straight pieces, with skirting that stands `inward` before the wall along every second run.
    fn pieces(&self, runs: &[(f64, bool)], inward: f64) -> Vec<Edge> {
        let count = (self.length / PIECE_M).ceil().max(1.0);
        let mut points = Vec::new();
        let mut begin = 0.0;
        for (end, skirted) in runs {
            let before = if *skirted { inward } else { 0.0 };
            points.push(self.point(begin, before));
            let cuts = (1..count as usize).map(|k| self.length * k as f64 / count);
            points.extend(cuts.filter(|w| *w > begin && *w < *end).map(|w| self.point(w, before)));
            points.push(self.point(*end, before));
            begin = *end;
        }
        let joined = points.windows(2).filter(|w| (w[1] - w[0]).norm() > 1e-9);
        joined.map(|w| Edge { from: w[0], to: w[1], glass: false }).collect()
    }
}

/// Ends of runs along a wall, and whether they have skirting.
fn runs(length: f64, rng: &mut Pcg64) -> Vec<(f64, bool)> {
    let (mut runs, mut end) = (Vec::new(), 0.0);
    while end < length {
        end = f64::min(length, end + rng.random_range(RUN_M[0]..RUN_M[1]));
        runs.push((end, rng.random::<f64>() < SKIRTED));
    }
    runs
}

/// The side of a wall, as the sign along its left normal, on which the robot's path is nearest.
fn inner_side(edge: &Edge, world: &World) -> f64 {
    let middle = nalgebra::center(&edge.from, &edge.to);
    let along = edge.to - edge.from;
    let points: Vec<Point2<f64>> = world.path.points.iter().map(|p| (*p).into()).collect();
    let nearest = |leg: &[Point2<f64>]| {
        let way = leg[1] - leg[0];
        let share = ((middle - leg[0]).dot(&way) / way.norm_squared().max(1e-12)).clamp(0.0, 1.0);
        leg[0] + way * share
    };
    let near = points.windows(2).map(nearest);
    let near = near.min_by(|a, b| (a - middle).norm().total_cmp(&(b - middle).norm()));
    near.map_or(1.0, |point| along.perp(&(point - middle)).signum())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::toml_file;
    use std::path::Path;

    fn world() -> World {
        let text = "name = \"room\"\n[[wall]]\nclosed = true\npoints = [[0, 0], [8, 0], [8, 5], [0, 5]]\n\
                    [path]\nheading_deg = 0\nspeed = 0.3\npoints = [[1, 1], [7, 4]]\n";
        toml_file::parse(text, Path::new("room.toml")).unwrap()
    }

    /// Largest and mean distance of a building from its blueprint, outward and inward of the room.
    fn off(model: WallModel, seed: u64) -> Vec<f64> {
        let built = as_built(&world(), &model, seed);
        let ends = built.iter().flat_map(|s| [s.edge.from, s.edge.to]);
        ends.map(|p| p.x.min(8.0 - p.x).min(p.y).min(5.0 - p.y)).collect()
    }

    #[test]
    fn walls_are_bent_by_millimetres_and_their_corners_stay() {
        let mut worst = 0.0f64;
        for seed in 0..20 {
            let off = off(WallModel { bow_m: 0.008, skirting_m: 0.0 }, seed);
            assert!(off.iter().all(|d| d.abs() <= 0.008 + 1e-12), "{off:?}");
            worst = off.iter().fold(worst, |worst, d| worst.max(d.abs()));
            let built = as_built(&world(), &WallModel { bow_m: 0.008, skirting_m: 0.0 }, seed);
            for corner in [[0.0, 0.0], [8.0, 0.0], [8.0, 5.0], [0.0, 5.0]] {
                let corner = Point2::from(corner);
                let at =
                    |s: &&Surface| (s.edge.from - corner).norm() < 1e-9 || (s.edge.to - corner).norm() < 1e-9;
                assert_eq!(built.iter().filter(at).count(), 2);
            }
        }
        assert!(worst > 0.004, "{worst}");
    }

    #[test]
    fn skirting_stands_before_the_wall_on_the_side_that_is_seen() {
        let off = off(WallModel { bow_m: 0.0, skirting_m: 0.012 }, 3);
        assert!(off.iter().all(|d| d.abs() < 1e-9 || (d - 0.012).abs() < 1e-9), "{off:?}");
        let before = off.iter().filter(|d| **d > 0.01).count();
        assert!(before > off.len() / 5 && before < off.len(), "{before} of {}", off.len());
    }

    #[test]
    fn an_ideal_building_is_its_blueprint() {
        let built = as_built(&world(), &WallModel::default(), 3);
        let edges: Vec<Edge> = built.iter().map(|s| s.edge).collect();
        assert_eq!(edges, world().edges());
    }
}
