//! Equation (11): the map's corners against the blueprint's, in the frame of the start and with the map laid over the
//! blueprint.

use nalgebra::{Isometry2, Point2, Similarity2, Vector2};
use slam_core::{MapSegment, Segment};

use crate::score::{lay, lay_with_scale};
use crate::sim::world::{Edge, World};
use crate::sim::{Drive, scanner};

/// A map line stands for a blueprint wall when it passes this close to the corner, metres, …
const WALL_DISTANCE_M: f64 = 0.35;
/// … is this parallel to the wall, as the sine of the angle, …
const WALL_SINE: f64 = 0.17;
/// … and ends this close to the corner or beyond it, metres.
const WALL_REACH_M: f64 = 1.0;
/// Where a wall's side is looked at: this far along the wall from its corner and this far off it, metres.
const SIDE_PROBE_M: [f64; 2] = [0.2, 0.02];
/// Every so-manieth pose is asked what it saw.
const SIGHTING_STEP: usize = 5;
/// A map is laid by its corners where it has so many; two would fit whatever they are.
const LEAST_CORNERS: usize = 3;
/// Rounds of finding corners and laying the map by them.
const ROUNDS: usize = 8;
/// No scanner and no wheel is off by a larger scale; three corners of a map that is wrong would fit any.
const MOST_SCALE_ERROR: f64 = 0.05;

/// What a map over its blueprint has of the blueprint's corners.
#[derive(Clone, Copy, Debug, serde::Serialize)]
pub struct LaidCorners {
    /// Mean distance of the corners found from the blueprint's, metres.
    pub corner_error_m: Option<f64>,
    /// Corners of the blueprint that the map has then.
    pub corners_found: usize,
    /// By what the map was scaled.
    pub scale: f64,
}

/// The blueprint's corners whose walls the robot has seen.
pub(super) struct Corners(Vec<Corner>);

struct Corner {
    at: Point2<f64>,
    /// Of each of the two walls its direction from the corner, and its unit normal on the side from which it was seen.
    walls: [[Vector2<f64>; 2]; 2],
}

/// A corner of the blueprint, and the crossing of the map's lines that stand for its walls.
pub(super) struct Found {
    blueprint: Point2<f64>,
    map: Point2<f64>,
}

impl Found {
    pub(super) fn error_m(&self) -> f64 {
        (self.map - self.blueprint).norm()
    }
}

/// Mean distance; `None` of none.
pub(super) fn mean_error_m(found: &[Found]) -> Option<f64> {
    (!found.is_empty()).then(|| found.iter().map(Found::error_m).sum::<f64>() / found.len() as f64)
}

impl Corners {
    /// Work: for each corner and every so-manieth pose one beam through the world.
    pub(super) fn seen(world: &World, drive: &Drive) -> Self {
        let edges = world.edges();
        let seen = |at: Point2<f64>| {
            let walls = world.directions_at(at);
            let wall = |index: usize| {
                let wall: &Vector2<f64> = walls.get(index)?;
                Some([*wall, seen_side(at, wall, &edges, drive)?])
            };
            Some(Corner { at, walls: [wall(0)?, wall(1)?] })
        };
        Self(world.corners.iter().filter_map(|corner| seen(corner.at.into())).collect())
    }

    /// Those that a map in the blueprint's frame has.
    pub(super) fn find(&self, map: &[MapSegment]) -> Vec<Found> {
        self.0.iter().filter_map(|corner| corner.find(map)).collect()
    }

    /// Lays a map over the blueprint, as the paper lays its maps: so that most corners are found, and these with the least error.
    /// From each of the `starts` it is laid by the corners found, anew until that finds no more.
    pub(super) fn lay(
        &self,
        map: &[MapSegment],
        starts: impl IntoIterator<Item = Similarity2<f64>>,
        with_scale: bool,
    ) -> LaidCorners {
        let mut best = LaidCorners { corner_error_m: None, corners_found: 0, scale: 1.0 };
        let is_likely = |laid: &Similarity2<f64>| (laid.scaling() - 1.0).abs() <= MOST_SCALE_ERROR;
        for start in starts.into_iter().filter(is_likely) {
            let mut laid = start;
            for _ in 0..ROUNDS {
                let found = self.find(&carried(map, &laid));
                let error_m = mean_error_m(&found);
                let better = found.len() > best.corners_found
                    || found.len() == best.corners_found && error_m < best.corner_error_m;
                if better {
                    let (corners_found, scale) = (found.len(), laid.scaling());
                    best = LaidCorners { corner_error_m: error_m, corners_found, scale };
                }
                if found.len() < LEAST_CORNERS {
                    break;
                }
                let Some(again) = laid_by(&found, &laid, with_scale).filter(is_likely) else { break };
                laid = again;
            }
        }
        best
    }
}

/// A map that lies as `laid` has it, laid by the corners found of it.
fn laid_by(found: &[Found], laid: &Similarity2<f64>, with_scale: bool) -> Option<Similarity2<f64>> {
    let map: Vec<Vector2<f64>> = found.iter().map(|f| laid.inverse_transform_point(&f.map).coords).collect();
    let blueprint: Vec<Vector2<f64>> = found.iter().map(|f| f.blueprint.coords).collect();
    if with_scale {
        return lay_with_scale(&map, &blueprint);
    }
    lay(&map, &blueprint).map(|laid| Similarity2::from_isometry(laid, 1.0))
}

/// The map's segments turned, moved and scaled. Their points' scatter, which nothing here looks at, stays as it was.
fn carried(map: &[MapSegment], by: &Similarity2<f64>) -> Vec<MapSegment> {
    let point = |p: Point2<f32>| -> Point2<f32> {
        nalgebra::convert_unchecked(by * nalgebra::convert::<_, Point2<f64>>(p))
    };
    let carry = |segment: &Segment| {
        let mut carried = *segment;
        carried.moments.centroid = point(segment.moments.centroid);
        (carried.start, carried.end) = (point(segment.start), point(segment.end));
        let direction: Vector2<f64> = nalgebra::convert(segment.direction);
        carried.direction = nalgebra::convert_unchecked(by.isometry.rotation * direction);
        carried
    };
    map.iter().map(|entry| entry.with_segment(&carry(&entry.segment()))).collect()
}

impl Corner {
    /// The crossing of the map's lines for the two walls that meet here.
    fn find(&self, map: &[MapSegment]) -> Option<Found> {
        let line = |[wall, side]: [Vector2<f64>; 2]| line_for(self.at, &wall, side, map);
        let (a, b) = (line(self.walls[0])?, line(self.walls[1])?);
        // n·p = d for both.
        let denominator = a.0.perp(&b.0);
        (denominator.abs() > 0.3).then(|| {
            let x = (a.1 * b.0.y - b.1 * a.0.y) / denominator;
            let y = (b.1 * a.0.x - a.1 * b.0.x) / denominator;
            Found { blueprint: self.at, map: Point2::new(x, y) }
        })
    }
}

/// Unit normal, on the side from which the robot saw it most, of the wall that leaves a corner in a direction. The two faces
/// of a thin wall are two lines. `None` where it was never seen.
fn seen_side(
    corner: Point2<f64>,
    wall: &Vector2<f64>,
    edges: &[Edge],
    drive: &Drive,
) -> Option<Vector2<f64>> {
    let normal = Vector2::new(-wall.y, wall.x);
    let sightings = |normal: Vector2<f64>| {
        let probe = corner + wall * SIDE_PROBE_M[0] + normal * SIDE_PROBE_M[1];
        let sees = |pose: &&Isometry2<f64>| {
            let to_probe = probe - Point2::from(pose.translation.vector);
            let distance_m = to_probe.norm();
            distance_m < scanner::REACH_M
                && scanner::cast(pose.translation.vector.into(), to_probe / distance_m, edges, &[])
                    .is_none_or(|hit| hit.range_m > distance_m)
        };
        drive.truth.iter().step_by(SIGHTING_STEP).filter(sees).count()
    };
    let (left, right) = (sightings(normal), sightings(-normal));
    (left + right > 0).then(|| if left >= right { normal } else { -normal })
}

/// Normal and distance of the best-supported map line for a wall that leaves a corner in a direction, seen from a side.
fn line_for(
    corner: Point2<f64>,
    wall: &Vector2<f64>,
    side: Vector2<f64>,
    map: &[MapSegment],
) -> Option<(Vector2<f64>, f64)> {
    let fits = |entry: &&MapSegment| {
        let segment = &entry.segment();
        let direction: Vector2<f64> = nalgebra::convert(segment.direction);
        let ends: [Point2<f64>; 2] = [segment.start, segment.end].map(nalgebra::convert);
        let ways = ends.map(|end| (end - corner).dot(wall));
        let off = (ends[0] - corner).perp(&direction).abs();
        direction.perp(wall).abs() < WALL_SINE
            && nalgebra::convert::<_, Vector2<f64>>(segment.normal()).dot(&side) > 0.0
            && off < WALL_DISTANCE_M
            && ways[0].min(ways[1]) < WALL_REACH_M
            && ways[0].max(ways[1]) > 0.1
    };
    let best = map.iter().filter(fits).max_by_key(|entry| entry.segment().moments.inliers)?;
    let line = best.segment().line();
    Some((nalgebra::convert(line.normal), f64::from(line.distance_m)))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A room whose four corners all are seen.
    fn room() -> (Corners, Vec<MapSegment>) {
        let corners = [[0.0f32, 0.0], [6.0, 0.0], [6.0, 4.0], [0.0, 4.0]];
        let inside = Point2::new(3.0f32, 2.0);
        let wall = |from: [f32; 2], to: [f32; 2]| {
            let segment = Segment::from_ends(from.into(), to.into(), 100, 1e-4, inside);
            MapSegment::new(&segment, 9, 1, 0.0)
        };
        let map: Vec<MapSegment> = (0..4).map(|k| wall(corners[k], corners[(k + 1) % 4])).collect();
        let corner = |k: usize| {
            let at: Point2<f64> = nalgebra::convert(Point2::from(corners[k]));
            let walls = [(k + 3) % 4, k].map(|wall| {
                let segment = &map[wall].segment();
                let middle: Point2<f64> = nalgebra::convert(segment.midpoint());
                [(middle - at).normalize(), nalgebra::convert(segment.normal())]
            });
            Corner { at, walls }
        };
        (Corners((0..4).map(corner).collect()), map)
    }

    fn moved(x: f64, y: f64, turn: f64, scale: f64) -> Similarity2<f64> {
        Similarity2::new(Vector2::new(x, y), turn, scale)
    }

    #[test]
    fn a_map_that_begins_elsewhere_is_laid_over_the_blueprint() {
        let (corners, map) = room();
        let off = carried(&map, &moved(0.2, -0.1, 0.02, 1.0));
        let as_it_lies = mean_error_m(&corners.find(&off)).unwrap();
        assert!((0.1..0.35).contains(&as_it_lies), "{as_it_lies}");
        let laid = corners.lay(&off, [Similarity2::identity()], false);
        assert_eq!((laid.corners_found, laid.scale), (4, 1.0));
        assert!(laid.corner_error_m.unwrap() < 1e-5, "{laid:?}");
    }

    #[test]
    fn only_with_a_scale_is_a_map_that_is_too_large_without_error() {
        let (corners, map) = room();
        let large = carried(&map, &moved(0.05, 0.0, 0.01, 1.02));
        let laid = [false, true].map(|scale| corners.lay(&large, [Similarity2::identity()], scale));
        // Half the diagonal, times 2 %.
        assert!((laid[0].corner_error_m.unwrap() - 0.02 * 13f64.sqrt()).abs() < 1e-3, "{laid:?}");
        assert!(
            laid[1].corner_error_m.unwrap() < 1e-5 && (laid[1].scale - 1.0 / 1.02).abs() < 1e-5,
            "{laid:?}"
        );
    }

    #[test]
    fn what_is_not_near_any_corner_needs_a_start() {
        let (corners, map) = room();
        let far = carried(&map, &moved(5.0, 3.0, 0.0, 1.0));
        let starts = |known: bool| {
            [Similarity2::identity()].into_iter().chain(known.then(|| moved(-4.9, -3.0, 0.0, 1.0)))
        };
        let lost = corners.lay(&far, starts(false), false);
        assert!(lost.corner_error_m.is_none() && lost.corners_found == 0, "{lost:?}");
        assert_eq!(corners.lay(&far, starts(true), false).corners_found, 4);
    }
}
