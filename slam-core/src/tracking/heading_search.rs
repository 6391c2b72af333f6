//! Poses that the scan itself proposes: turns by the directions of its segments, shifts by votes.
//!
//! In: observed segments, the map lines nearby, a pose to look around. Out: turns and shifts worth refining. Nothing here asks
//! the wheels: the reach is fixed.
//!
//! Turns are the peaks of a histogram of the differences between directions of observed and of mapped lines, as in Weiss, Wetzler
//! and von Puttkamer, "Keeping track of position and orientation of moving indoor systems by correlation of range-finder scans"
//! (IROS 1994); shifts are voted for in the manner of a Hough transform: each pair of parallel lines votes for the strip of
//! shifts that lay one on the other.

use heapless::Vec;
use nalgebra::{Isometry2, Vector2};

use crate::geometry::math::{atan2, max, min, sqrt, wrap_angle};
use crate::geometry::pose::{cross, perpendicular};
use crate::geometry::segment::Segment;
use crate::map::MapSegment;
use crate::map::nearby::Nearby;

/// Turns that are looked into.
pub const MAX_PEAKS: usize = 4;
/// Width of a bin of the histogram, radians: 1°.
const BIN_RAD: f32 = 0.0175;
const MAX_BINS: usize = 128;
/// Bins on each side of a peak that belong to it.
const PEAK_BINS: usize = 3;
/// A neighbouring bin gets this share of a vote.
const BESIDE: f32 = 0.6;
/// Points of a segment beyond this add nothing to its vote on a turn, and on a shift.
const MOST_POINTS: [f32; 2] = [30.0, 40.0];
/// Shifts that are voted on: so many to each side, this far apart, metres.
const SHIFTS: usize = 5;
const SHIFT_M: f32 = 0.1;
const CELLS: usize = 2 * SHIFTS + 1;
/// A shift of a metre loses this share of its votes.
const LOSS_PER_M: f32 = 0.3;
/// Lines at a larger angle are not parallel, as a sine.
const PARALLEL_SINE: f32 = 0.06;
/// Lines must overlap by this share of the shorter one.
const MIN_OVERLAP: f32 = 0.3;
/// Observed segments that vote on shifts: those of the most points.
const MAX_VOTERS: usize = 16;

/// Turns (radians) by which directions seen from `from` fit those of the map lines nearby, most votes first.
///
/// Work: one step for each observed segment and each map segment nearby.
pub fn turns<const N: usize>(
    observed: &[Segment],
    from: &Isometry2<f32>,
    map: &[MapSegment],
    nearby: &Nearby<N>,
    reach_rad: f32,
) -> Vec<f32, MAX_PEAKS> {
    let bins = ((2.0 * reach_rad / BIN_RAD) as usize + 1).min(MAX_BINS);
    let mut votes = [0.0f32; MAX_BINS];
    for seen in observed {
        let direction = from.rotation * seen.direction;
        let weight = min(seen.moments.inliers as f32, MOST_POINTS[0]);
        // Several lines may run alike: a segment votes once for a turn.
        let mut own = [0.0f32; MAX_BINS];
        for mapped in nearby.along(direction, reach_rad) {
            let Some(entry) = map.get(usize::from(mapped)) else { continue };
            let to = entry.direction();
            let turn = atan2(cross(direction, to), direction.dot(&to));
            if turn.abs() > reach_rad {
                continue;
            }
            let bin = ((turn + reach_rad) / BIN_RAD) as usize;
            let beside = own
                .iter_mut()
                .enumerate()
                .take(bins)
                .skip(bin.saturating_sub(1))
                .take(if bin == 0 { 2 } else { 3 });
            for (k, vote) in beside {
                *vote = max(*vote, if k == bin { weight } else { BESIDE * weight });
            }
        }
        votes.iter_mut().zip(&own).for_each(|(sum, vote)| *sum += vote);
    }
    peaks(votes.get(..bins).unwrap_or_default(), reach_rad)
}

/// The highest peaks of the histogram, as turns.
fn peaks(votes: &[f32], reach_rad: f32) -> Vec<f32, MAX_PEAKS> {
    let mut found: Vec<f32, MAX_PEAKS> = Vec::new();
    let mut taken: Vec<usize, MAX_PEAKS> = Vec::new();
    while !found.is_full() {
        let free = |bin: &usize| taken.iter().all(|t| t.abs_diff(*bin) > PEAK_BINS);
        let mut best: Option<(usize, f32)> = None;
        for (bin, vote) in votes.iter().enumerate().filter(|(bin, _)| free(bin)) {
            if *vote > best.map_or(0.0, |(_, most)| most) {
                best = Some((bin, *vote));
            }
        }
        let Some((bin, _)) = best else { break };
        // The mean of the peak and its neighbours.
        let (mut moment, mut sum) = (0.0, 0.0);
        for k in bin.saturating_sub(1)..=bin + 1 {
            let vote = votes.get(k).copied().unwrap_or(0.0);
            moment += (k as f32 + 0.5) * BIN_RAD * vote;
            sum += vote;
        }
        let _ = (taken.push(bin), found.push(wrap_angle(moment / sum - reach_rad)));
    }
    found
}

/// The shift (metres, in `map`) by which the segments seen from `from` lie on the map lines nearby best.
///
/// Work: for each of the 16 largest segments and each map line that runs like it, the cells of a strip.
pub fn shift<const N: usize>(
    observed: &[Segment],
    from: &Isometry2<f32>,
    map: &[MapSegment],
    nearby: &Nearby<N>,
) -> Vector2<f32> {
    let mut votes = [[0.0f32; CELLS]; CELLS];
    for seen in observed.iter().filter(|seen| is_voter(seen, observed)) {
        let mut own = [[0.0f32; CELLS]; CELLS];
        let in_map = seen.transformed(from);
        for mapped in nearby.along(in_map.direction, PARALLEL_SINE) {
            let Some(entry) = map.get(usize::from(mapped)) else { continue };
            vote(&in_map, entry, &mut own);
        }
        let weight = min(seen.moments.inliers as f32, MOST_POINTS[1]);
        for (sum, vote) in votes.iter_mut().flatten().zip(own.iter().flatten()) {
            *sum += weight * vote;
        }
    }
    let (mut best, mut at) = (0.0, Vector2::zeros());
    for (u, row) in votes.iter().enumerate() {
        for (v, vote) in row.iter().enumerate() {
            let shift = Vector2::new(of_cell(u), of_cell(v));
            let votes = vote * (1.0 - LOSS_PER_M * sqrt(shift.norm_squared()));
            if votes > best {
                (best, at) = (votes, shift);
            }
        }
    }
    at
}

fn of_cell(cell: usize) -> f32 {
    (cell as f32 - SHIFTS as f32) * SHIFT_M
}

/// Whether a segment is one of those of the most points, that vote on shifts.
fn is_voter(seen: &Segment, observed: &[Segment]) -> bool {
    let larger = observed.iter().filter(|other| other.moments.inliers > seen.moments.inliers);
    larger.count() < MAX_VOTERS
}

/// Votes for the strip of shifts that lay `seen` on `mapped` and let them overlap.
fn vote(seen: &Segment, mapped: &MapSegment, votes: &mut [[f32; CELLS]; CELLS]) {
    let direction = mapped.direction();
    if direction.dot(&seen.direction) < 0.0 || cross(direction, seen.direction).abs() > PARALLEL_SINE {
        return;
    }
    let normal = perpendicular(direction);
    let offset = mapped.signed_distance(seen.moments.centroid);
    // The corner of the grid is farthest away.
    const FARTHEST_M: f32 = (SHIFTS as f32 * 1.415 + 1.0) * SHIFT_M;
    if offset.abs() > FARTHEST_M {
        return;
    }
    let mapped = mapped.segment();
    let (middle, half) = (mapped.along_of(seen.midpoint()), 0.5 * seen.length_m());
    let (start, end) = (mapped.along_of(mapped.start), mapped.along_of(mapped.end));
    let least = MIN_OVERLAP * min(2.0 * half, end - start);
    for (u, row) in votes.iter_mut().enumerate() {
        let x = of_cell(u);
        for (v, cell) in row.iter_mut().enumerate() {
            let y = of_cell(v);
            let off = (offset + normal.x * x + normal.y * y).abs();
            if off < SHIFT_M {
                let centre = middle + mapped.direction.x * x + mapped.direction.y * y;
                if min(centre + half, end) - max(centre - half, start) > least {
                    *cell = max(*cell, 1.0 - off / SHIFT_M);
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::pose::{components, pose};
    use nalgebra::Point2;
    use proptest::prelude::*;

    fn wall(from: (f32, f32), to: (f32, f32)) -> Segment {
        let (from, to) = (Point2::new(from.0, from.1), Point2::new(to.0, to.1));
        let left = nalgebra::center(&from, &to) + perpendicular(to - from);
        let points = (0..30).map(|i| (from + (to - from) * (i as f32 / 29.0), 1e4));
        Segment::fitted(crate::geometry::segment::Moments::from_points(points), &[from, to], left)
    }

    /// A room that looks alike from no two sides, with a recess.
    fn room() -> std::vec::Vec<Segment> {
        [
            wall((3.0, -2.0), (3.0, 2.5)),
            wall((3.0, 2.5), (-1.0, 2.5)),
            wall((-1.0, 2.5), (-2.0, 1.0)),
            wall((-2.0, 1.0), (-2.0, -2.0)),
            wall((-2.0, -2.0), (1.0, -2.0)),
        ]
        .to_vec()
    }

    proptest! {
        /// Whatever the robot was thought to be off by within the reach, the scan proposes where it is.
        #[test]
        fn the_scan_proposes_the_pose(x in -0.45f32..0.45, y in -0.45f32..0.45, a in -0.55f32..0.55) {
            let truth = pose(0.3, 0.2, 0.4);
            let map: std::vec::Vec<MapSegment> = room()
                .into_iter()
                .map(|segment| MapSegment::new(&segment, 5, 1, 0.0))
                .collect();
            let observed: std::vec::Vec<Segment> =
                room().iter().map(|s| s.transformed(&truth.inverse())).collect();
            let mut nearby = Nearby::<8>::new();
            nearby.gather(&map, &truth, 6.0, |_| true);
            let c = components(&truth);
            let thought = pose(c.x + x, c.y + y, c.z + a);
            let turns = turns(&observed, &thought, &map, &nearby, 0.6);
            let best = turns.iter().map(|turn| (turn + a).abs()).fold(f32::INFINITY, f32::min);
            prop_assert!(best < 0.02, "{:?} for {}", turns, -a);
            let turned = pose(c.x + x, c.y + y, c.z);
            let shift = shift(&observed, &turned, &map, &nearby);
            prop_assert!((shift - Vector2::new(-x, -y)).amax() < 0.08, "{} for {} {}", shift, -x, -y);
        }
    }

    #[test]
    fn nothing_seen_or_nothing_known_proposes_nothing() {
        let nearby = Nearby::<8>::new();
        assert!(turns(&room(), &Isometry2::identity(), &[], &nearby, 0.6).is_empty());
        assert!(turns(&[], &Isometry2::identity(), &[], &nearby, 0.6).is_empty());
        assert!(shift(&room(), &Isometry2::identity(), &[], &nearby).norm() < 1e-6);
    }
}
