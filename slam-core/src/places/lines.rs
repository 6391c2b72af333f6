//! The lines of a place: a dozen, in its own frame, in millimetres.
//!
//! In: the lines of the local map that were seen around the place. Out: those that say most of where the robot is.

use heapless::Vec;
use nalgebra::{Isometry2, Point2, Vector2};

use crate::few::{keep_most, sort_few};
use crate::geometry::math::{atan2, max, min, sqrt};
use crate::geometry::pose::{cross, perpendicular};
use crate::geometry::segment::Segment;
use crate::map::MapSegment;

/// Most lines of a place.
pub const PLACE_LINES: usize = 12;
/// Lines farther from the place than this are not its, metres.
const REACH_M: f32 = 15.0;
/// Shorter lines do not count, metres, nor what fewer keyframes saw.
const LEAST_LENGTH_M: f32 = 0.4;
const LEAST_HITS: u16 = 2;
/// What one scan sees of a line may be shorter, metres.
const LEAST_SEEN_M: f32 = 0.25;
/// Longer lines, and lines seen more often, say no more.
const MOST_LENGTH_M: f32 = 5.0;
const MOST_HITS: u16 = 8;
/// Lines within this angle of each other say the same of the heading, as a sine.
const ALIKE_SINE: f32 = 0.35;

/// A line of a place: both ends, millimetres in the place's frame; walking from the first to the second, the free side is on the left.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct PlaceLine([i16; 4]);

/// Lines of a place.
pub type PlaceLines = Vec<PlaceLine, PLACE_LINES>;

impl PlaceLine {
    /// None where an end lies beyond 32 m.
    fn of(start: Point2<f32>, end: Point2<f32>) -> Option<Self> {
        let mut ends = [0; 4];
        for (slot, metres) in ends.iter_mut().zip([start.x, start.y, end.x, end.y]) {
            let mm = metres * 1000.0;
            if mm.is_nan() || mm.abs() > f32::from(i16::MAX) {
                return None;
            }
            *slot = (mm + if mm < 0.0 { -0.5 } else { 0.5 }) as i16;
        }
        Some(Self(ends))
    }

    /// x and y of both ends, millimetres.
    pub(crate) fn numbers(&self) -> [i16; 4] {
        self.0
    }

    /// The same from them.
    pub(crate) fn from_numbers(numbers: [i16; 4]) -> Self {
        Self(numbers)
    }

    /// Both ends, metres.
    pub fn ends(&self) -> [Point2<f32>; 2] {
        let [ax, ay, bx, by] = self.0.map(|mm| f32::from(mm) * 1e-3);
        [Point2::new(ax, ay), Point2::new(bx, by)]
    }
}

/// A line as matching wants it, in the frame of its place.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Ray {
    pub start: Point2<f32>,
    pub end: Point2<f32>,
    pub middle: Point2<f32>,
    pub direction: Vector2<f32>,
    pub normal: Vector2<f32>,
    /// Normal times any of its points.
    pub offset_m: f32,
    pub length_m: f32,
    pub angle_rad: f32,
}

/// The lines of a place, unpacked; those without a length are left out.
pub(super) fn unpacked(lines: &[PlaceLine]) -> Vec<Ray, PLACE_LINES> {
    lines.iter().map(PlaceLine::ends).filter_map(|[start, end]| ray(start, end)).take(PLACE_LINES).collect()
}

/// None without a length.
fn ray(start: Point2<f32>, end: Point2<f32>) -> Option<Ray> {
    let along = end - start;
    let length_m = sqrt(along.norm_squared());
    if length_m <= 0.0 {
        return None;
    }
    let direction = along / length_m;
    let normal = perpendicular(direction);
    Some(Ray {
        start,
        end,
        middle: nalgebra::center(&start, &end),
        direction,
        normal,
        offset_m: normal.dot(&start.coords),
        length_m,
        angle_rad: atan2(direction.y, direction.x),
    })
}

/// Lines of the map around a pose that are looked through for where a robot is.
const AROUND: usize = 48;

/// The longest lines of the map of which a point lies within `reach_m` of a pose, in its frame, sorted by direction. Work: a pass over the map.
pub(super) fn around(map: &[MapSegment], at: &Isometry2<f32>, reach_m: f32) -> Vec<Ray, AROUND> {
    let position = at.translation.vector.into();
    let is_known = |entry: &&MapSegment| entry.hits >= LEAST_HITS && entry.is_within(position, reach_m);
    let longest = longest::<_, AROUND>(map.iter().filter(is_known), |entry| entry.length_m());
    let place_from_map = at.inverse();
    let in_place = |entry: &&MapSegment| {
        let segment = entry.segment();
        ray(place_from_map * segment.start, place_from_map * segment.end)
    };
    let mut rays: Vec<Ray, AROUND> = longest.iter().filter_map(in_place).collect();
    sort_few(&mut rays, |ray| ray.angle_rad);
    rays
}

/// The longest of some items, in any order.
fn longest<T: Copy, const N: usize>(
    items: impl Iterator<Item = T>,
    length_m: impl Fn(&T) -> f32,
) -> Vec<T, N> {
    let mut longest: Vec<T, N> = Vec::new();
    let mut least_m = LEAST_SEEN_M;
    for item in items {
        if length_m(&item) < least_m {
            continue;
        }
        keep_most(&mut longest, item, &length_m);
        if longest.is_full() {
            least_m = longest.iter().map(&length_m).fold(f32::INFINITY, min);
        }
    }
    longest
}

/// The longest of a scan's segments, in `base`, longest first.
pub(crate) fn of_scan(observed: &[Segment]) -> Vec<Ray, PLACE_LINES> {
    let mut rays: Vec<Ray, PLACE_LINES> = longest::<&Segment, PLACE_LINES>(observed.iter(), |s| s.length_m())
        .iter()
        .filter_map(|s| ray(s.start, s.end))
        .collect();
    sort_few(&mut rays, |ray| -ray.length_m);
    rays
}

/// Lines that are chosen from: those of most length and hits.
const CANDIDATES: usize = 4 * PLACE_LINES;

/// Chooses the lines of a place at `anchor` from those of the map that `counts` holds for: one after the other the one with most length
/// and hits, where a line loses by each that runs like it and is there already. One that `is_wall` does not hold for, by its index, is
/// passed over.
///
/// Work: a pass over the map, and a question for each of [`CANDIDATES`] lines at most.
pub(super) fn chosen(
    map: &[MapSegment],
    anchor: &Isometry2<f32>,
    counts: impl Fn(&MapSegment) -> bool,
    is_wall: impl Fn(usize) -> bool,
) -> PlaceLines {
    let mut candidates: Vec<(u16, f32), CANDIDATES> = Vec::new();
    for (index, entry) in map.iter().enumerate() {
        if !counts(entry) || !is_of(entry, anchor) {
            continue;
        }
        let worth = min(entry.length_m(), MOST_LENGTH_M) * f32::from(entry.hits.min(MOST_HITS));
        keep_most(&mut candidates, (index as u16, worth), |candidate| candidate.1);
    }
    let place_from_map = anchor.inverse();
    let mut taken: Vec<Vector2<f32>, PLACE_LINES> = Vec::new();
    let mut lines = PlaceLines::new();
    while !taken.is_full() {
        let alike = |direction: Vector2<f32>| {
            taken.iter().filter(|other| cross(**other, direction).abs() < ALIKE_SINE).count() as f32
        };
        let worth = |(index, worth): &(u16, f32)| {
            map.get(usize::from(*index)).map_or(0.0, |entry| worth / (1.0 + alike(entry.direction())))
        };
        let valued = candidates.iter().enumerate().map(|(rank, candidate)| (rank, worth(candidate)));
        let Some((rank, _)) = valued.min_by(|a, b| b.1.total_cmp(&a.1)) else { break };
        let index = usize::from(candidates.remove(rank).0);
        let Some(entry) = map.get(index).filter(|_| is_wall(index)) else { continue };
        let _ = taken.push(entry.direction());
        let ends = clipped(&entry.segment().transformed(&place_from_map));
        if let Some(line) = ends.and_then(|[start, end]| PlaceLine::of(start, end)) {
            let _ = lines.push(line);
        }
    }
    lines
}

/// Whether a line may be one of a place.
fn is_of(entry: &MapSegment, anchor: &Isometry2<f32>) -> bool {
    entry.hits >= LEAST_HITS
        && entry.length_m() >= LEAST_LENGTH_M
        && entry.is_within(anchor.translation.vector.into(), REACH_M)
}

/// The ends of a line in a place's frame, none farther along it from the place's foot than [`REACH_M`].
fn clipped(segment: &Segment) -> Option<[Point2<f32>; 2]> {
    let foot = segment.along_of(Point2::origin());
    let from = max(segment.along_of(segment.start), foot - REACH_M);
    let to = min(segment.along_of(segment.end), foot + REACH_M);
    let at = |along: f32| segment.moments.centroid + segment.direction * along;
    (to - from >= LEAST_LENGTH_M).then(|| [at(from), at(to)])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::pose::pose;
    use crate::map::fixtures::line;

    #[test]
    fn directions_are_spread_and_short_or_doubtful_lines_stay_out() {
        let mut map: std::vec::Vec<_> =
            (0..20).map(|k| line((0.0, 0.2 * k as f32), (4.0, 0.2 * k as f32), 9)).collect();
        map.push(line((1.0, 0.0), (1.0, 1.0), 9));
        map.push(line((2.0, 0.0), (2.0, 0.3), 9));
        map.push(line((3.0, 0.0), (3.0, 2.0), 1));
        map.push(line((40.0, 0.0), (40.0, 2.0), 9));
        let lines = chosen(&map, &pose(1.0, 0.5, 0.3), |_| true, |_| true);
        assert_eq!(lines.len(), PLACE_LINES);
        let across = unpacked(&lines)
            .iter()
            .filter(|r| (r.angle_rad - (core::f32::consts::FRAC_PI_2 - 0.3)).abs() < 0.01)
            .count();
        assert_eq!(across, 1);
        assert!(chosen(&map, &pose(1.0, 0.5, 0.3), |_| false, |_| true).is_empty());
    }

    #[test]
    fn a_line_comes_back_to_a_millimetre() {
        let anchor = pose(100.0, -50.0, 2.0);
        let map = [line((101.0, -49.0), (99.0, -46.5), 5)];
        let lines = chosen(&map, &anchor, |_| true, |_| true);
        let [start, end] = lines[0].ends();
        assert!((anchor * start - map[0].segment().start).norm() < 1e-3);
        assert!((anchor * end - map[0].segment().end).norm() < 1e-3);
    }

    #[test]
    fn a_long_wall_is_cut_and_one_beyond_the_numbers_left_out() {
        let map = [line((-80.0, 1.0), (90.0, 1.0), 5)];
        let lines = chosen(&map, &pose(0.0, 0.0, 0.0), |_| true, |_| true);
        assert!((unpacked(&lines)[0].length_m - 2.0 * REACH_M).abs() < 1e-2);
        assert_eq!(PlaceLine::of(Point2::new(33.0, 0.0), Point2::origin()), None);
        assert_eq!(PlaceLine::of(Point2::new(f32::NAN, 0.0), Point2::origin()), None);
    }
}
