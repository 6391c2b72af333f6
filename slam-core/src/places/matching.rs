//! One place's lines among those of another: where would the robot have stood?
//!
//! In: the lines of both, and what the chain says of their poses. Out: the pose of the one in the other's frame, how much of its lines
//! that explains, and how much the second best does. Two lines that are not parallel fix a pose: each pair of the one's lines and each of
//! the other's that meet at the same angle propose one, and those that the chain allows are voted for in cells. The best cells are
//! refined by what lies on each other, with a gate that narrows and a Cauchy kernel.
//!
//! Tracking proposes turns and shifts from parallel lines, around a prior of a few decimetres; here it is metres, so that poses come
//! whole, from corners.

use heapless::Vec;
use nalgebra::{Isometry2, Matrix3, Point2, Vector2, Vector3};

use super::lines::Ray;
use crate::geometry::math::{max, min, sort_few, sqrt, within, wrap_angle};
use crate::geometry::pose::{components, cross, heading, pose};

/// Lines at a smaller angle fix no pose together, as a sine.
const LEAST_SINE: f32 = 0.5;
/// Nor do lines with a larger gap between them, metres.
const MOST_GAP_M: f32 = 8.0;
/// Pairs of lines meet at the same angle within this, radians.
const SAME_ANGLE_RAD: f32 = 0.07;
/// Lines that propose a pose must overlap then; more than this adds nothing, metres.
const MOST_OVERLAP_M: f32 = 4.0;
/// And the product of the overlaps of both be more than this, m².
const LEAST_OVERLAP_M2: f32 = 0.04;
/// Size of a cell, metres and radians.
const CELL: [f32; 2] = [1.0, 0.175];
/// Cells that are counted, and those that are refined.
const CELLS: usize = 48;
const REFINED: usize = 6;
/// Rounds of the refinement: gates on the distance (m) and the angle (as a sine) of lines that lie on each other.
const ROUNDS: [[f32; 2]; 8] = [
    [0.8, 0.25],
    [0.57, 0.208],
    [0.41, 0.173],
    [0.29, 0.144],
    [0.21, 0.12],
    [0.15, 0.1],
    [0.15, 0.1],
    [0.15, 0.1],
];
/// Lines that lie on each other overlap by this, metres.
const LEAST_OVERLAP_M: f32 = 0.2;
/// Standard deviation of a line, metres, at least a quarter of the gate.
const SIGMA_M: f32 = 0.03;
/// A refinement is held back by this information on x, y (1/m²) and θ (1/rad²): 1 m and 0.18 rad.
const HELD: [f32; 3] = [1.0, 1.0, 30.0];
/// Poses farther apart than this, metres or radians, are others.
const OTHER: [f32; 2] = [1.0, 0.175];

/// Where nothing is known: poses that are kept of those proposed, …
pub(super) const PROPOSED: usize = 4;
/// … lines of the query whose ends propose some, …
const BY_ENDS: usize = 3;
/// … what a line must have of the length of what is seen of it, …
const LEAST_SHARE_OF_LENGTH: f32 = 0.7;
/// … how near lines must lie, metres and radians, …
const NEAR_M: f32 = 0.25;
const NEAR_RAD: f32 = 0.12;
/// … what share of the query must do so, …
const LEAST_EXPLAINED: f32 = 0.5;
/// … and what is nearly the same, metres and radians.
const SAME_M: f32 = 0.5;
const SAME_RAD: f32 = 0.26;

/// What the chain allows.
#[derive(Clone, Copy, Debug)]
pub(super) struct Gate {
    /// The one's pose in the other's frame.
    pub predicted: Isometry2<f32>,
    /// Information on that in the one's frame.
    pub information: Matrix3<f32>,
    /// Squared Mahalanobis distance up to which a pose is believed.
    pub max_chi2: f32,
}

impl Gate {
    pub fn chi2(&self, at: &Isometry2<f32>) -> f32 {
        let off = components(&self.predicted.inv_mul(at));
        off.dot(&(self.information * off))
    }

    fn admits(&self, at: &Isometry2<f32>) -> bool {
        self.chi2(at) <= self.max_chi2
    }
}

/// Where one place lies by another's lines.
#[derive(Clone, Copy, Debug)]
pub(super) struct Match {
    /// In the other's frame.
    pub pose: Isometry2<f32>,
    /// Share of its lines' length that is explained.
    pub share: f32,
    /// The same of the best pose that is another.
    pub runner_up: f32,
    /// Normal matrix of the lines over (x, y, θ), in its own frame.
    pub information: Matrix3<f32>,
}

impl Match {
    /// Information on the direction of the position that is fixed worst, 1/m².
    pub fn weakest(&self) -> f32 {
        let a = &self.information;
        let (half, off) = (0.5 * (a.m11 + a.m22), 0.5 * (a.m11 - a.m22));
        half - sqrt(off * off + a.m12 * a.m12)
    }
}

/// Votes for poses that lie together.
#[derive(Clone, Copy, Debug)]
struct Cell {
    key: [i16; 3],
    weight: f32,
    /// Of positions and of headings off the prediction, weighted.
    sum: Vector3<f32>,
}

/// The best pose of `query` among the lines of `place`, if there is one that the gate admits.
///
/// Work: one step for each pair of pairs, 8712 at most, of which some hundred make a vote, in 48 cells; then 8 rounds of 144 steps for each of 6
/// cells.
pub(super) fn matched(query: &[Ray], place: &[Ray], gate: &Gate) -> Option<Match> {
    let mut cells: Vec<Cell, CELLS> = Vec::new();
    propose(query, place, gate, &mut cells);
    sort_few(&mut cells, |cell| -cell.weight);
    let mut found: Vec<Match, REFINED> = Vec::new();
    for cell in cells.iter().take(REFINED) {
        let mean = cell.sum / cell.weight;
        let start = pose(mean.x, mean.y, heading(&gate.predicted) + mean.z);
        let refined = refined(query, place, start);
        if refined.share > 0.0 && gate.admits(&refined.pose) {
            let _ = found.push(refined);
        }
    }
    let best = *found.iter().max_by(|a, b| a.share.total_cmp(&b.share))?;
    let is_other = |m: &&Match| {
        let off = components(&best.pose.inv_mul(&m.pose));
        off.xy().norm() >= OTHER[0] || off.z.abs() >= OTHER[1]
    };
    let runner_up = found.iter().filter(is_other).map(|m| m.share).fold(0.0, max);
    Some(Match { runner_up, ..best })
}

/// All pairs of the one against all of the other.
fn propose(query: &[Ray], place: &[Ray], gate: &Gate, cells: &mut Vec<Cell, CELLS>) {
    for (i, p) in place.iter().enumerate() {
        for (j, q) in place.iter().enumerate() {
            if i == j || !is_corner(p, q) {
                continue;
            }
            let angle = q.angle_rad - p.angle_rad;
            for (k, a) in query.iter().enumerate() {
                for b in query.iter().skip(k + 1) {
                    let off = wrap_angle(b.angle_rad - a.angle_rad - angle);
                    if off.abs() <= SAME_ANGLE_RAD && is_corner(a, b) {
                        vote([p, q], [a, b], gate, cells);
                    }
                }
            }
        }
    }
}

fn is_corner(a: &Ray, b: &Ray) -> bool {
    let gap = (a.middle - b.middle).norm() - 0.5 * (a.length_m + b.length_m);
    cross(a.direction, b.direction).abs() > LEAST_SINE && gap < MOST_GAP_M
}

/// Where two lines meet.
fn crossing(a: &Ray, b: &Ray) -> Vector2<f32> {
    let det = cross(a.normal, b.normal);
    let x = (a.offset_m * b.normal.y - b.offset_m * a.normal.y) / det;
    let y = (a.normal.x * b.offset_m - b.normal.x * a.offset_m) / det;
    Vector2::new(x, y)
}

/// The pose that lays a corner on a corner gets a vote if its lines overlap then and the chain allows it.
fn vote([p, q]: [&Ray; 2], [a, b]: [&Ray; 2], gate: &Gate, cells: &mut Vec<Cell, CELLS>) {
    let turn = wrap_angle(p.angle_rad - a.angle_rad);
    let turn = turn + 0.5 * wrap_angle(q.angle_rad - b.angle_rad - turn);
    let turned = pose(0.0, 0.0, turn);
    let shift = crossing(p, q) - turned.rotation * crossing(a, b);
    let at = Isometry2::from_parts(shift.into(), turned.rotation);
    let overlap = |seen: &Ray, there: &Ray| {
        let along = (at * seen.middle - there.middle).dot(&there.direction).abs();
        let shared = 0.5 * (seen.length_m + there.length_m) - along;
        within(min(shared, min(seen.length_m, there.length_m)), 0.0, MOST_OVERLAP_M)
    };
    let product = overlap(a, p) * overlap(b, q);
    if product <= LEAST_OVERLAP_M2 || !gate.admits(&at) {
        return;
    }
    let off = wrap_angle(turn - heading(&gate.predicted));
    let from_predicted = shift - gate.predicted.translation.vector;
    let floor = |v: f32, size: f32| libm::floorf(v / size) as i16;
    let key = [floor(from_predicted.x, CELL[0]), floor(from_predicted.y, CELL[0]), floor(off, CELL[1])];
    let weight = sqrt(product);
    let sum = Vector3::new(shift.x, shift.y, off) * weight;
    if let Some(cell) = cells.iter_mut().find(|cell| cell.key == key) {
        cell.weight += weight;
        cell.sum += sum;
    } else if let Err(cell) = cells.push(Cell { key, weight, sum })
        && let Some(least) = cells.iter_mut().min_by(|a, b| a.weight.total_cmp(&b.weight))
        && least.weight < weight
    {
        *least = cell;
    }
}

/// Poses of `query`, longest lines first, among lines sorted by direction, whatever is known of where it is: those that explain most. Its
/// longest lines propose them, by their ends.
///
/// Work: for each of [`BY_ENDS`] lines and each of the others two poses, most of which a look at some of the lines that run alike rules out.
pub(super) fn anywhere(query: &[Ray], lines: &[Ray]) -> Vec<Isometry2<f32>, PROPOSED> {
    let mut best: Vec<(Isometry2<f32>, f32), PROPOSED> = Vec::new();
    let all_m: f32 = query.iter().map(|ray| ray.length_m).sum();
    for seen in query.iter().take(BY_ENDS) {
        // What is seen of a line is not longer than the line.
        for there in lines.iter().filter(|there| there.length_m > LEAST_SHARE_OF_LENGTH * seen.length_m) {
            let turn = wrap_angle(there.angle_rad - seen.angle_rad);
            let rotation = pose(0.0, 0.0, turn).rotation;
            for [to, from] in [[there.start, seen.start], [there.end, seen.end]] {
                let at = Isometry2::from_parts((to - rotation * from).into(), rotation);
                let worst = best.iter().map(|(_, explained_m)| *explained_m).fold(f32::INFINITY, min);
                let least_m = max(LEAST_EXPLAINED * all_m, if best.is_full() { worst } else { 0.0 });
                if let Some(explained_m) = explained_m(query, lines, &at, turn, least_m, all_m) {
                    keep(at, explained_m, &mut best);
                }
            }
        }
    }
    best.iter().map(|(pose, _)| *pose).collect()
}

/// Keeps a pose, of those that are nearly the same only the best, and of too many those that explain most.
fn keep(at: Isometry2<f32>, explained_m: f32, best: &mut Vec<(Isometry2<f32>, f32), PROPOSED>) {
    let is_same = |(other, _): &&mut (Isometry2<f32>, f32)| {
        let off = components(&other.inv_mul(&at));
        off.xy().norm_squared() < SAME_M * SAME_M && off.z.abs() < SAME_RAD
    };
    if let Some(same) = best.iter_mut().find(is_same) {
        if same.1 < explained_m {
            *same = (at, explained_m);
        }
    } else if best.push((at, explained_m)).is_err()
        && let Some(least) = best.iter_mut().min_by(|a, b| a.1.total_cmp(&b.1))
    {
        *least = (at, explained_m);
    }
}

/// Length of the lines of `query` that lie on some of `lines`, metres, if it is not less than `least_m`.
fn explained_m(
    query: &[Ray],
    lines: &[Ray],
    at: &Isometry2<f32>,
    turn: f32,
    least_m: f32,
    all_m: f32,
) -> Option<f32> {
    let (mut explained_m, mut possible_m) = (0.0, all_m);
    for seen in query {
        let (a, b) = (at * seen.start, at * seen.end);
        let mut sum = 0.0;
        for there in alike(lines, wrap_angle(seen.angle_rad + turn)) {
            let across = there.normal.dot(&(a.coords + b.coords)) - 2.0 * there.offset_m;
            if across.abs() <= 2.0 * NEAR_M
                && let Some(part) = shared(a, b, there)
            {
                sum += part.length_m;
            }
        }
        let own_m = min(sum, seen.length_m);
        explained_m += own_m;
        possible_m -= seen.length_m - own_m;
        if possible_m < least_m {
            return None;
        }
    }
    Some(explained_m)
}

/// Of lines sorted by direction those that run within [`NEAR_RAD`] of one.
fn alike(lines: &[Ray], angle_rad: f32) -> impl Iterator<Item = &Ray> {
    let range = |from: f32, to: f32| {
        let begin = lines.partition_point(|ray| ray.angle_rad < from);
        let end = lines.partition_point(|ray| ray.angle_rad <= to);
        lines.get(begin..end).unwrap_or_default()
    };
    const TURN: f32 = 2.0 * core::f32::consts::PI;
    let (from, to) = (angle_rad - NEAR_RAD, angle_rad + NEAR_RAD);
    let around = if from < -core::f32::consts::PI {
        range(from + TURN, f32::INFINITY)
    } else if to > core::f32::consts::PI {
        range(f32::NEG_INFINITY, to - TURN)
    } else {
        &[]
    };
    range(from, to).iter().chain(around)
}

/// The part of two lines that lies side by side: both ends of it on the first, their distances from the second, and its length.
struct Shared {
    ends: [Point2<f32>; 2],
    distances: [f32; 2],
    length_m: f32,
}

fn shared(start: Point2<f32>, end: Point2<f32>, there: &Ray) -> Option<Shared> {
    let along = |point: Point2<f32>| there.direction.dot(&(point - there.start));
    let across = |point: Point2<f32>| there.normal.dot(&point.coords) - there.offset_m;
    let (from, to) = (along(start), along(end));
    let (low, high) = (max(min(from, to), 0.0), min(max(from, to), there.length_m));
    let span = to - from;
    if high - low < LEAST_OVERLAP_M || span.abs() < 1e-6 {
        return None;
    }
    let ends = [low, high].map(|at| start + (end - start) * ((at - from) / span));
    Some(Shared { ends, distances: ends.map(across), length_m: high - low })
}

/// Lays the one's lines on those of the other that they lie near to.
fn refined(query: &[Ray], place: &[Ray], start: Isometry2<f32>) -> Match {
    let mut at = start;
    let mut information = Matrix3::zeros();
    let mut explained = 0.0;
    for (round, [gate_m, gate_sine]) in ROUNDS.into_iter().enumerate() {
        let mut pull = Vector3::zeros();
        (information, explained) = (Matrix3::zeros(), 0.0);
        let sigma = max(SIGMA_M, 0.25 * gate_m);
        for seen in query {
            let (a, b, direction) = (at * seen.start, at * seen.end, at.rotation * seen.direction);
            let mut length_m = 0.0;
            for there in place {
                if direction.dot(&there.direction) <= 0.0
                    || cross(direction, there.direction).abs() > gate_sine
                {
                    continue;
                }
                let Some(part) = shared(a, b, there) else { continue };
                if (0.5 * (part.distances[0] + part.distances[1])).abs() > gate_m {
                    continue;
                }
                length_m += part.length_m;
                for (point, distance) in part.ends.iter().zip(part.distances) {
                    let kernel = distance / (2.0 * sigma);
                    let weight = 0.5 * part.length_m / (1.0 + kernel * kernel) / (sigma * sigma);
                    let arm = point.coords - at.translation.vector;
                    let jacobian = Vector3::new(there.normal.x, there.normal.y, cross(arm, there.normal));
                    information += jacobian * jacobian.transpose() * weight;
                    pull += jacobian * (weight * distance);
                }
            }
            explained += min(length_m, seen.length_m);
        }
        let held = information + Matrix3::from_diagonal(&Vector3::from(HELD));
        let Some(step) = held.try_inverse().map(|inverse| -(inverse * pull)) else { break };
        if round + 1 < ROUNDS.len() {
            let step = step.map(|v| within(v, -1.0, 1.0));
            let c = components(&at) + step;
            at = pose(c.x, c.y, c.z);
        }
    }
    let all: f32 = query.iter().map(|ray| ray.length_m).sum();
    let turn = at.rotation.to_rotation_matrix().to_homogeneous();
    let share = if all > 0.0 { explained / all } else { 0.0 };
    Match { pose: at, share, runner_up: 0.0, information: turn.transpose() * information * turn }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::map::MapSegment;
    use crate::map::fixtures::line;
    use crate::places::chain::diagonal;
    use crate::places::lines::{chosen, unpacked};

    fn wall(from: (f32, f32), to: (f32, f32)) -> MapSegment {
        line(from, to, 9)
    }

    /// A room with a recess, a pillar and a table that stands askew.
    fn room() -> std::vec::Vec<MapSegment> {
        let corners: [(f32, f32); 8] =
            [(0.0, 0.0), (6.0, 0.0), (6.0, 4.0), (4.0, 4.0), (4.0, 5.5), (2.5, 5.5), (2.5, 4.0), (0.0, 4.0)];
        let mut walls: std::vec::Vec<_> = (0..8).map(|k| wall(corners[k], corners[(k + 1) % 8])).collect();
        walls.push(wall((1.0, 1.0), (1.7, 1.5)));
        walls
    }

    fn gate(predicted: Isometry2<f32>, sigmas: [f32; 3]) -> Gate {
        Gate { predicted, information: diagonal(sigmas).try_inverse().unwrap(), max_chi2: 16.0 }
    }

    #[test]
    fn a_room_is_recognised_from_metres_off() {
        let map = room();
        let there = pose(3.0, 2.0, 0.3);
        for here in [pose(2.0, 2.5, 0.3), pose(4.0, 1.0, -2.5), pose(1.5, 3.0, 1.2)] {
            let (query, place) =
                (chosen(&map, &here, |_| true, |_| true), chosen(&map, &there, |_| true, |_| true));
            let truth = there.inv_mul(&here);
            let drifted = pose(1.5, -1.0, 0.2) * truth;
            let found =
                matched(&unpacked(&query), &unpacked(&place), &gate(drifted, [1.0, 1.0, 0.2])).unwrap();
            let off = components(&truth.inv_mul(&found.pose));
            assert!(off.xy().norm() < 0.02 && off.z.abs() < 0.01, "{off}");
            assert!(found.share > 0.95 && found.runner_up < 0.8 * found.share, "{found:?}");
            assert!(found.weakest() > 200.0);
        }
    }

    #[test]
    fn nothing_beyond_the_gate_is_found() {
        let map = room();
        let at = pose(3.0, 2.0, 0.3);
        let lines = unpacked(&chosen(&map, &at, |_| true, |_| true));
        assert!(matched(&lines, &lines, &gate(pose(9.0, 0.0, 0.0), [0.3, 0.3, 0.05])).is_none());
        assert!(matched(&lines, &[], &gate(pose(0.0, 0.0, 0.0), [0.3, 0.3, 0.05])).is_none());
        assert!(matched(&[], &lines, &gate(pose(0.0, 0.0, 0.0), [0.3, 0.3, 0.05])).is_none());
    }

    #[test]
    fn one_of_many_doors_alike_is_told_to_be_ambiguous() {
        let mut map = std::vec::Vec::new();
        for k in 0..8 {
            let x = 2.0 * k as f32;
            map.push(wall((x, 0.0), (x + 1.2, 0.0)));
            map.push(wall((x + 1.2, 0.0), (x + 1.2, -0.6)));
        }
        let (query, place) = (
            unpacked(&chosen(&map, &pose(8.0, 1.0, 0.0), |_| true, |_| true)),
            unpacked(&chosen(&map, &pose(8.0, 1.0, 0.0), |_| true, |_| true)),
        );
        let found = matched(&query, &place, &gate(pose(0.0, 0.0, 0.0), [2.0, 2.0, 0.1])).unwrap();
        assert!(found.runner_up > 0.8 * found.share, "{found:?}");
    }
    #[test]
    fn without_a_gate_the_true_pose_is_among_those_proposed() {
        let map = room();
        let there = pose(3.0, 2.0, 0.3);
        let lines = crate::places::lines::around(&map, &there, 10.0);
        assert_eq!(lines.len(), map.len());
        assert!(lines.is_sorted_by(|a, b| a.angle_rad <= b.angle_rad));
        for here in [pose(2.0, 2.5, 0.3), pose(4.0, 1.0, -2.5), pose(1.5, 3.0, 1.2), pose(5.0, 2.0, 3.1)] {
            let seen: std::vec::Vec<_> = map.iter().map(|e| e.segment.transformed(&here.inverse())).collect();
            let proposed = anywhere(&crate::places::of_scan(&seen), &lines);
            let truth = there.inv_mul(&here);
            let off = |at: &Isometry2<f32>| components(&truth.inv_mul(at)).norm();
            assert!(proposed.iter().any(|at| off(at) < 0.01), "{here} {proposed:?}");
        }
        assert!(anywhere(&[], &lines).is_empty());
        let short = crate::places::of_scan(&[map[4].segment.transformed(&there.inverse())]);
        assert!(!anywhere(&short, &lines).is_empty() && anywhere(&short, &[]).is_empty());
    }
}
