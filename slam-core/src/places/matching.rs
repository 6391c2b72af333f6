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
use crate::few::{keep_most, sort_few};
use crate::geometry::math::{max, min, sqrt, within, wrap_angle};
use crate::geometry::pose::{are_close, components, cross, heading, pose};

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
    let is_other = |m: &&Match| !are_close(&best.pose, &m.pose, OTHER);
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
    } else {
        keep_most(cells, Cell { key, weight, sum }, |cell| cell.weight);
    }
}

/// The part of two lines that lies side by side: both ends of it on the first, their distances from the second, and its length.
pub(super) struct Shared {
    ends: [Point2<f32>; 2],
    distances: [f32; 2],
    pub length_m: f32,
}

pub(super) fn shared(start: Point2<f32>, end: Point2<f32>, there: &Ray) -> Option<Shared> {
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
pub(super) mod tests {
    use super::*;
    use crate::geometry::pose::diagonal;
    use crate::map::MapSegment;
    use crate::map::fixtures::line;
    use crate::places::lines::{chosen, unpacked};

    fn wall(from: (f32, f32), to: (f32, f32)) -> MapSegment {
        line(from, to, 9)
    }

    /// A room with a recess, a pillar and a table that stands askew.
    pub fn room() -> std::vec::Vec<MapSegment> {
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
}
