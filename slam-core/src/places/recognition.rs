//! Recognising a place without knowing where the robot is: the poses from which it may see what it sees.
//!
//! In: the lines of a scan, and those of the map around a place. Out: a few poses, to be looked at in the map. Loops compare places
//! metres off, by corners that the chain's covariance admits ([`matching`](super::matching)); here nothing is ruled out, a scan may show no
//! corner, and an end of a wall with its direction fixes a pose as well.

use heapless::Vec;
use nalgebra::Isometry2;

use super::lines::Ray;
use super::matching::shared;
use crate::few::{keep_most, sort_few};
use crate::geometry::math::{max, min, wrap_angle};
use crate::geometry::pose::{are_close, pose};

/// Poses that are kept of those proposed, …
const PROPOSED: usize = 4;
/// … lines of the query whose ends propose some, …
const BY_ENDS: usize = 3;
/// … what a line must have of the length of what is seen of it, …
const LEAST_SHARE_OF_LENGTH: f32 = 0.7;
/// … how near lines must lie, metres and radians, …
const NEAR_M: f32 = 0.25;
const NEAR_RAD: f32 = 0.12;
/// … what share of the query must do so, …
const LEAST_EXPLAINED: f32 = 0.5;
/// … and what is nearly the same pose, metres and radians.
pub(crate) const SAME: [f32; 2] = [0.5, 0.26];

/// Poses of `query`, longest lines first, among lines sorted by direction, whatever is known of where it is: those that explain most, the
/// best first. Its longest lines propose them, by their ends.
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
    sort_few(&mut best, |(_, explained_m)| -explained_m);
    best.iter().map(|(pose, _)| *pose).collect()
}

/// Keeps a pose, of those that are nearly the same only the best, and of too many those that explain most.
fn keep(at: Isometry2<f32>, explained_m: f32, best: &mut Vec<(Isometry2<f32>, f32), PROPOSED>) {
    match best.iter_mut().find(|(other, _)| are_close(other, &at, SAME)) {
        Some(same) if same.1 < explained_m => *same = (at, explained_m),
        Some(_) => {}
        None => keep_most(best, (at, explained_m), |kept| kept.1),
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
    // So much would be if what is still to come lay on some.
    let mut possible_m = all_m;
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
        possible_m -= max(seen.length_m - sum, 0.0);
        if possible_m < least_m {
            return None;
        }
    }
    Some(possible_m)
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::pose::components;
    use crate::places::lines::{around, of_scan};
    use crate::places::matching::tests::room;

    #[test]
    fn without_a_gate_the_true_pose_is_among_those_proposed() {
        let map = room();
        let there = pose(3.0, 2.0, 0.3);
        let lines = around(&map, &there, 10.0);
        assert_eq!(lines.len(), map.len());
        assert!(lines.is_sorted_by(|a, b| a.angle_rad <= b.angle_rad));
        for here in [pose(2.0, 2.5, 0.3), pose(4.0, 1.0, -2.5), pose(1.5, 3.0, 1.2), pose(5.0, 2.0, 3.1)] {
            let seen: std::vec::Vec<_> =
                map.iter().map(|e| e.segment().transformed(&here.inverse())).collect();
            let proposed = anywhere(&of_scan(&seen), &lines);
            let truth = there.inv_mul(&here);
            let off = |at: &Isometry2<f32>| components(&truth.inv_mul(at)).norm();
            assert!(proposed.iter().any(|at| off(at) < 0.01), "{here} {proposed:?}");
        }
        assert!(anywhere(&[], &lines).is_empty());
        let short = of_scan(&[map[4].segment().transformed(&there.inverse())]);
        assert!(!anywhere(&short, &lines).is_empty() && anywhere(&short, &[]).is_empty());
    }
}
