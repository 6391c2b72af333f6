//! Walls for tests.

use nalgebra::Point2;
use std::vec::Vec;

use crate::geometry::segment::{Moments, Segment};
use crate::map::MapSegment;
use crate::tracking::association::Pair;

/// A wall of so many points, seen from the origin.
pub fn wall(from: (f32, f32), to: (f32, f32), points: usize) -> Segment {
    let at = |i: usize| {
        let share = i as f32 / (points - 1) as f32;
        Point2::new(from.0 + share * (to.0 - from.0), from.1 + share * (to.1 - from.1))
    };
    let moments = Moments::from_points((0..points).map(|i| (at(i), 1e4)));
    Segment::fitted(moments, &[at(0), at(points - 1)], Point2::origin())
}

/// A room around the origin: every wall faces it.
pub fn room() -> Vec<Segment> {
    [
        wall((3.0, -2.0), (3.0, 2.5), 60),
        wall((3.0, 2.5), (-2.0, 2.5), 70),
        wall((-2.0, 2.5), (-2.0, -2.0), 50),
        wall((-2.0, -2.0), (1.0, -2.0), 40),
    ]
    .to_vec()
}

/// As the map holds them.
pub fn entries(walls: &[Segment]) -> Vec<MapSegment> {
    walls.iter().map(|segment| MapSegment::new(segment, 5, 1, 0.0)).collect()
}

/// Each with the one of its number.
pub fn all_pairs(n: usize) -> Vec<Pair> {
    (0..n).map(|i| Pair { observed: i, mapped: i }).collect()
}
