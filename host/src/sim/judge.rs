//! How good a simulated robot's map and trajectory are, measured against the world and the truth.

mod corners;

use nalgebra::{Isometry2, Matrix3, Point2, Similarity2, Vector2, Vector3};
use slam_core::{MapSegment, Segment};

use super::Drive;
use super::world::{Disc, Edge, World};
use crate::replay::{ESTABLISHED_HITS, Replay, Step};
use crate::score::{lay, lay_with_scale};
use corners::Corners;
pub use corners::LaidCorners;

/// A segment farther than this from everything that stands still is spurious, metres.
const SPURIOUS_M: f64 = 0.15;
/// Pieces of a segment that are looked at, metres.
const PIECE_M: f64 = 0.05;

/// Instants of a drive at which the pose's error is held against its covariance.
pub const NEES_INSTANTS: usize = 50;

/// The measures of one simulated drive.
#[derive(Clone, Debug, serde::Serialize)]
pub struct Judgement {
    /// Equation (11): mean distance between the blueprint's corners and the crossings of the map's lines there, metres, in
    /// the frame of the start.
    /// `None` where the world names no corner or the map has none of them.
    pub corner_error_m: Option<f64>,
    /// Corners of the blueprint that the map has.
    pub corners_found: usize,
    /// Corners of the blueprint.
    pub corners: usize,
    /// Equation (11) with the map laid over the blueprint by a rotation and a translation, as the paper lays it.
    pub laid: LaidCorners,
    /// The same by a scale, too: a scanner whose ranges are all too long cannot be told from wheels that are too small.
    pub laid_with_scale: LaidCorners,
    /// Errors of the trajectory.
    #[serde(flatten)]
    pub trajectory: TrajectoryErrors,
    /// Largest distance of a pose from the truth, metres, in the frame of the start.
    pub worst_position_error_m: f64,
    /// Largest error of a heading, degrees.
    pub worst_heading_error_deg: f64,
    /// Largest error of a position across the robot's heading, metres.
    pub worst_across_error_m: f64,
    /// Share of the poses whose error along the robot's heading is within two of its reported standard deviations.
    pub along_within_two_sigma: f64,
    /// Mean of the normalised estimation error squared of the pose (3 is honest).
    pub mean_nees: f64,
    /// The same at [`NEES_INSTANTS`] instants, equally far apart.
    #[serde(skip)]
    pub nees: Vec<f64>,
    /// Map segments seen in at least three scans.
    pub established_segments: usize,
    /// Those of them that are far from everything that stands still.
    pub spurious_segments: usize,
}

/// Position errors of a trajectory.
#[derive(Clone, Copy, Debug, serde::Serialize)]
pub struct TrajectoryErrors {
    /// Root mean square position error after one SE(2) alignment, metres.
    pub ate_rmse_m: f64,
    /// The same in the frame of the start, without any alignment.
    pub unaligned_rmse_m: f64,
    /// The same after one alignment with scale.
    pub scaled_rmse_m: f64,
    /// By what that alignment scales the trajectory.
    pub scale: f64,
    /// Distance of the last pose from the truth, metres, in the frame of the start as all below.
    pub final_position_error_m: f64,
    /// Error of the last heading, degrees.
    pub final_heading_error_deg: f64,
    /// Error of the last position along the robot's heading, metres.
    pub final_along_error_m: f64,
}

/// Errors of poses that begin at the truth's start.
pub fn trajectory_errors(truth: &[Isometry2<f64>], poses: &[Isometry2<f64>]) -> TrajectoryErrors {
    let [onto, from] = [truth, poses].map(positions);
    let rmse = |laid: Option<Similarity2<f64>>| {
        let square = |(p, t): (&Vector2<f64>, &Vector2<f64>)| {
            Some((laid? * Point2::from(*p) - Point2::from(*t)).norm_squared())
        };
        let squares: Option<Vec<f64>> = from.iter().zip(&onto).map(square).collect();
        squares.map_or(f64::NAN, |s| (s.iter().sum::<f64>() / s.len() as f64).sqrt())
    };
    let scaled = lay_with_scale(&from, &onto);
    let last = truth.last().zip(poses.last()).map(|(truth, pose)| truth.inv_mul(pose));
    TrajectoryErrors {
        ate_rmse_m: rmse(lay(&from, &onto).map(rigid)),
        unaligned_rmse_m: rmse(Some(Similarity2::identity())),
        scaled_rmse_m: rmse(scaled),
        scale: scaled.map_or(f64::NAN, |s| s.scaling()),
        final_position_error_m: last.map_or(f64::NAN, |off| off.translation.vector.norm()),
        final_heading_error_deg: last.map_or(f64::NAN, |off| off.rotation.angle().abs().to_degrees()),
        final_along_error_m: last.map_or(f64::NAN, |off| off.translation.x.abs()),
    }
}

fn positions(poses: &[Isometry2<f64>]) -> Vec<Vector2<f64>> {
    poses.iter().map(|pose| pose.translation.vector).collect()
}

fn rigid(laid: Isometry2<f64>) -> Similarity2<f64> {
    Similarity2::from_isometry(laid, 1.0)
}

/// The estimated poses in the world: `map` begins where the robot did.
pub fn in_world(drive: &Drive, poses: impl Iterator<Item = Isometry2<f32>>) -> Vec<Isometry2<f64>> {
    let world_from_map = drive.truth.first().copied().unwrap_or_else(Isometry2::identity);
    poses.map(|pose| world_from_map * nalgebra::convert::<_, Isometry2<f64>>(pose)).collect()
}

/// Judges a replay of a simulated drive.
pub fn judge(world: &World, drive: &Drive, replay: &Replay) -> Judgement {
    let poses = in_world(drive, replay.steps.iter().map(|s| s.pose));
    let off: Vec<PoseError> = drive.truth.iter().zip(&poses).map(|(t, p)| PoseError::new(t, p)).collect();
    let worst = |size: fn(&PoseError) -> f64| off.iter().map(size).fold(0.0, f64::max);
    let covariances: Vec<Matrix3<f64>> = replay
        .steps
        .iter()
        .zip(&drive.truth)
        .map(|(step, truth)| covariance_in_base(drive, step, truth))
        .collect();
    let nees = |k: usize| off.get(k)?.normalised(covariances.get(k)?);
    let all_nees: Vec<f64> = (0..off.len()).filter_map(nees).collect();
    let last = off.len().saturating_sub(1);
    let map = map_in_world(drive, &replay.map);
    let corners = Corners::seen(world, drive);
    let found = corners.find(&map);
    let (from, onto) = (positions(&poses), positions(&drive.truth));
    let by_path = [lay(&from, &onto).map(rigid), lay_with_scale(&from, &onto)];
    let laid = |with_scale: bool| {
        let starts = [Some(Similarity2::identity()), by_path[0], by_path[1].filter(|_| with_scale)];
        corners.lay(&map, starts.into_iter().flatten(), with_scale)
    };
    let (edges, discs) = (world.edges(), world.discs());
    let established: Vec<Segment> =
        map.iter().filter(|s| s.hits >= ESTABLISHED_HITS).map(MapSegment::segment).collect();
    let covered = off.iter().zip(&covariances).filter(|(off, p)| off.along_m.powi(2) <= 4.0 * p.m11);
    Judgement {
        corner_error_m: corners::mean_error_m(&found),
        corners_found: found.len(),
        corners: world.corners.len(),
        laid: laid(false),
        laid_with_scale: laid(true),
        trajectory: trajectory_errors(&drive.truth, &poses),
        worst_position_error_m: worst(|off| off.along_m.hypot(off.across_m)),
        worst_heading_error_deg: worst(|off| off.heading_rad.abs()).to_degrees(),
        worst_across_error_m: worst(|off| off.across_m.abs()),
        along_within_two_sigma: covered.count() as f64 / off.len().max(1) as f64,
        mean_nees: all_nees.iter().sum::<f64>() / all_nees.len().max(1) as f64,
        nees: (1..=NEES_INSTANTS).filter_map(|i| nees(i * last / NEES_INSTANTS)).collect(),
        established_segments: established.len(),
        spurious_segments: established.iter().filter(|s| is_spurious(s, &edges, &discs)).count(),
    }
}

/// Equation (11), corner by corner, of those that the map has; metres, no alignment.
pub fn corner_errors(world: &World, drive: &Drive, map: &[MapSegment]) -> Vec<f64> {
    let found = Corners::seen(world, drive).find(&map_in_world(drive, map));
    found.iter().map(corners::Found::error_m).collect()
}

/// The map's segments in the blueprint's frame.
pub fn map_in_world(drive: &Drive, map: &[MapSegment]) -> Vec<MapSegment> {
    let world_from_map: Isometry2<f32> =
        drive.truth.first().map_or_else(Isometry2::identity, |t| nalgebra::convert_unchecked(*t));
    map.iter().map(|entry| entry.with_segment(&entry.segment().transformed(&world_from_map))).collect()
}

/// The straight surfaces of the blueprint in the map's frame.
pub fn blueprint_in_map(world: &World, drive: &Drive) -> Vec<Edge> {
    blueprint_from(world, &drive.truth.first().copied().unwrap_or_else(Isometry2::identity))
}

/// The same for a map that begins where the robot stands there in the world.
pub fn blueprint_from(world: &World, world_from_map: &Isometry2<f64>) -> Vec<Edge> {
    let map_from_world = world_from_map.inverse();
    let carried = |e: Edge| Edge { from: map_from_world * e.from, to: map_from_world * e.to, ..e };
    world.edges().into_iter().map(carried).collect()
}

/// Error of one pose, in the true `base`.
struct PoseError {
    along_m: f64,
    across_m: f64,
    heading_rad: f64,
}

impl PoseError {
    fn new(truth: &Isometry2<f64>, pose: &Isometry2<f64>) -> Self {
        let off = truth.inv_mul(pose);
        Self { along_m: off.translation.x, across_m: off.translation.y, heading_rad: off.rotation.angle() }
    }

    /// Normalised estimation error squared eᵀP⁻¹e; `None` where P is singular, as at the first pose.
    fn normalised(&self, covariance: &Matrix3<f64>) -> Option<f64> {
        let error = Vector3::new(self.along_m, self.across_m, self.heading_rad);
        Some(error.dot(&(covariance.try_inverse()? * error)))
    }
}

/// The covariance that a step reported in `map`, in the true `base`.
fn covariance_in_base(drive: &Drive, step: &Step, truth: &Isometry2<f64>) -> Matrix3<f64> {
    let start = drive.truth.first().copied().unwrap_or_else(Isometry2::identity);
    let turn = (truth.rotation.inverse() * start.rotation).to_rotation_matrix().to_homogeneous();
    turn * nalgebra::convert::<_, Matrix3<f64>>(step.update.covariance) * turn.transpose()
}

/// Whether most of a segment lies far from everything that stands still. A wall that goes on behind a door is none, though its
/// middle may lie in the door.
fn is_spurious(segment: &Segment, edges: &[Edge], discs: &[Disc]) -> bool {
    let near = |point: Point2<f64>| {
        let near_edge = |e: &Edge| super::scanner::distance_to(e, point) <= SPURIOUS_M;
        let near_disc = |d: &Disc| ((d.centre - point).norm() - d.radius).abs() <= SPURIOUS_M;
        edges.iter().any(near_edge) || discs.iter().any(near_disc)
    };
    let [from, to]: [Point2<f64>; 2] = [segment.start, segment.end].map(nalgebra::convert);
    let pieces = ((to - from).norm() / PIECE_M).ceil().max(1.0) as usize;
    let middle = |piece: usize| from + (to - from) * ((piece as f64 + 0.5) / pieces as f64);
    2 * (0..pieces).filter(|piece| near(middle(*piece))).count() < pieces
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_stands_where_nothing_stands_is_spurious_and_a_wall_across_a_door_is_not() {
        let edge = |from: [f64; 2], to: [f64; 2]| Edge { from: from.into(), to: to.into(), glass: false };
        let edges = [edge([0.0, 0.0], [4.0, 0.0]), edge([5.0, 0.0], [9.0, 0.0])];
        let discs = [Disc { centre: Point2::new(4.5, 3.0), radius: 0.3 }];
        let is_spurious = |from: [f32; 2], to: [f32; 2]| {
            let segment = Segment::from_ends(from.into(), to.into(), 20, 1e-4, Point2::new(4.0, 1.0));
            super::is_spurious(&segment, &edges, &discs)
        };
        assert!(!is_spurious([0.0, 0.02], [9.0, -0.02]), "a wall across its door");
        assert!(!is_spurious([4.3, 2.7], [4.7, 2.7]), "the face of a pillar");
        assert!(is_spurious([4.2, 0.0], [4.8, 0.0]), "a person in the door");
        assert!(is_spurious([2.0, 1.0], [2.4, 1.0]), "a person in the room");
        assert!(is_spurious([3.7, 0.3], [7.0, 0.3]), "a wall that is none");
        assert!(is_spurious([3.0, 0.1], [3.0, 1.5]), "a wall that begins at one");
    }
}
