//! Which observed segment is which map segment.
//!
//! In: observed segments in `base`, the pose they are seen through, map segments. Out: at most one [`Pair`] for each
//! observed segment; an observed segment without a pair is new.
//!
//! The paper (section 2.2) takes the nearest along the perpendicular bisector. The default gates on side, direction,
//! distance and overlap and takes the likeliest, with the covariance of pose and lines allowed for.

use heapless::{Vec, VecView};
use nalgebra::{Isometry2, Matrix3, Point2, Vector2};

use crate::frontend::extraction::MAX_SEGMENTS;
use crate::geometry::line_noise::LineNoise;
use crate::geometry::line_observation::Residual;
use crate::geometry::math::{min, sqrt};
use crate::geometry::pose::cross;
use crate::geometry::segment::Segment;
use crate::map::MapSegment;
use crate::map::nearby::Nearby;
use crate::paper::bisector::{BisectorConfig, bisector_distance};

/// How pairs are found.
#[derive(Clone, Copy, Debug, PartialEq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize), serde(rename_all = "snake_case"))]
pub enum AssociationConfig {
    /// Section 2.2 of the paper.
    Bisector(BisectorConfig),
    /// Gates on direction, distance and overlap; the likeliest of those within.
    Gated(GateConfig),
}

/// Settings of the gated association.
#[derive(Clone, Copy, Debug, PartialEq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct GateConfig {
    /// Largest angle between the segments, radians. Opposite faces never pair.
    pub max_angle_rad: f32,
    /// Largest distance of the observed centroid from the map's line, metres.
    pub max_distance_m: f32,
    /// Largest squared Mahalanobis distance; the 99 % point for two degrees of freedom is 9.2.
    pub max_chi2: f32,
    /// Least overlap along the map segment, as a share of the shorter of both.
    pub min_overlap: f32,
    /// Widest gap along the map segment across which the pose's own uncertainty may make up for overlap, metres.
    pub max_overlap_slack_m: f32,
}

/// An observed segment and the map segment it is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pair {
    /// Index of the observed segment.
    pub observed: usize,
    /// Index of the map segment.
    pub mapped: usize,
}

/// What is known of the pose the segments are seen through.
#[derive(Clone, Copy, Debug)]
pub struct View<'a> {
    /// Pose of `base` in `map`.
    pub pose: &'a Isometry2<f32>,
    /// Its covariance (x, y, θ), in `map`.
    pub covariance: &'a Matrix3<f32>,
    /// Errors of lines beyond their points' noise.
    pub line_noise: &'a LineNoise,
}

/// Pairs near enough to be looked at again while the pose is being corrected.
#[derive(Clone, Debug, Default)]
pub struct Shortlist {
    pairs: Vec<(u8, u16), SHORTLISTED>,
    /// The pose they were found through.
    at: Option<Isometry2<f32>>,
    /// Observed segments whose map segments all found room.
    complete: usize,
}

/// Most pairs of a shortlist: four for each observed segment, 1 KiB.
const SHORTLISTED: usize = 4 * MAX_SEGMENTS;
/// A shortlist serves within this distance of the pose it was made for, metres, …
const SERVES_M: f32 = 0.15;
/// … and this angle, radians. It holds what is within the gates widened by what both can move the segment by.
const SERVES_RAD: f32 = 0.05;

impl Shortlist {
    /// Nothing.
    pub const fn new() -> Self {
        Self { pairs: Vec::new(), at: None, complete: 0 }
    }

    /// Nothing; to be called before each scan.
    pub fn clear(&mut self) {
        self.at = None;
    }

    fn serves(&self, pose: &Isometry2<f32>) -> bool {
        self.at.as_ref().is_some_and(|at| {
            let moved = pose.translation.vector - at.translation.vector;
            // Sine of the angle between both.
            let turned = at.rotation.re * pose.rotation.im - at.rotation.im * pose.rotation.re;
            moved.norm_squared() <= SERVES_M * SERVES_M
                && turned.abs() <= SERVES_RAD
                && at.rotation.re * pose.rotation.re + at.rotation.im * pose.rotation.im > 0.0
        })
    }

    fn gather<const N: usize>(
        &mut self,
        observed: &[Segment],
        pose: &Isometry2<f32>,
        map: &[MapSegment],
        nearby: &Nearby<N>,
        config: &GateConfig,
    ) {
        self.pairs.clear();
        (self.at, self.complete) = (Some(*pose), 0);
        for (index, in_base) in observed.iter().enumerate() {
            let direction = pose.rotation * in_base.direction;
            let centroid = pose * in_base.moments.centroid;
            // A turn moves what is far by more.
            let lever_m = sqrt(in_base.moments.centroid.coords.norm_squared());
            let wide = GateConfig {
                max_angle_rad: config.max_angle_rad + SERVES_RAD,
                max_distance_m: config.max_distance_m + SERVES_M + SERVES_RAD * lever_m,
                ..*config
            };
            for mapped in nearby.along(direction, wide.max_angle_rad) {
                let Some(entry) = map.get(usize::from(mapped)) else { continue };
                if may_be(&direction, &centroid, entry, &wide)
                    && self.pairs.push((index as u8, mapped)).is_err()
                {
                    return;
                }
            }
            self.complete = index + 1;
        }
    }
}

/// Finds the pairs among the map segments `nearby`. The shortlist saves looking at all of them again from a pose close to the last.
///
/// Work: one step for each observed segment and each map segment nearby that runs like it.
pub fn associate<const N: usize>(
    observed: &[Segment],
    view: &View<'_>,
    map: &[MapSegment],
    nearby: &Nearby<N>,
    config: &AssociationConfig,
    shortlist: &mut Shortlist,
    pairs: &mut VecView<Pair>,
) {
    pairs.clear();
    let config = match config {
        AssociationConfig::Bisector(config) => {
            for (index, in_base) in observed.iter().enumerate() {
                let in_map = in_base.transformed(view.pose);
                let score = |mapped: &MapSegment| bisector_distance(&in_map, &mapped.segment(), config);
                pair_with_best(index, nearby.all().iter().copied(), map, score, pairs);
            }
            return;
        }
        AssociationConfig::Gated(config) => config,
    };
    if !shortlist.serves(view.pose) {
        shortlist.gather(observed, view.pose, map, nearby, config);
    }
    let mut rest = shortlist.pairs.as_slice();
    for (index, in_base) in observed.iter().enumerate() {
        let count = rest.iter().take_while(|(observed, _)| usize::from(*observed) == index).count();
        let (own, others) = rest.split_at(count.min(rest.len()));
        rest = others;
        let is_complete = index < shortlist.complete;
        if is_complete && own.is_empty() {
            continue;
        }
        let in_map = in_base.transformed(view.pose);
        let score = |mapped: &MapSegment| gated_chi2(&in_map, mapped, view, config);
        if is_complete {
            pair_with_best(index, own.iter().map(|(_, mapped)| *mapped), map, score, pairs);
        } else {
            let like_it = nearby.along(in_map.direction, config.max_angle_rad);
            pair_with_best(index, like_it, map, score, pairs);
        }
    }
}

/// Adds the pair of an observed segment and the map segment of the least score, if any has one.
fn pair_with_best(
    observed: usize,
    candidates: impl Iterator<Item = u16>,
    map: &[MapSegment],
    score: impl Fn(&MapSegment) -> Option<f32>,
    pairs: &mut VecView<Pair>,
) {
    let mut best: Option<(f32, usize)> = None;
    for mapped in candidates.map(usize::from) {
        if let Some(score) = map.get(mapped).and_then(&score)
            && best.is_none_or(|(least, _)| score < least)
        {
            best = Some((score, mapped));
        }
    }
    if let Some((_, mapped)) = best {
        // One pair for each observed segment: the caller's capacities are the same.
        let _ = pairs.push(Pair { observed, mapped });
    }
}

/// Whether a segment with this direction and centroid passes the gates on direction and distance.
fn may_be(
    direction: &Vector2<f32>,
    centroid: &Point2<f32>,
    mapped: &MapSegment,
    config: &GateConfig,
) -> bool {
    direction.dot(&mapped.direction()) > 0.0
        && cross(mapped.direction(), *direction).abs() <= config.max_angle_rad
        && mapped.signed_distance(*centroid).abs() <= config.max_distance_m
}

/// χ² of the pair if it passes every gate.
fn gated_chi2(observed: &Segment, mapped: &MapSegment, view: &View<'_>, config: &GateConfig) -> Option<f32> {
    if !may_be(&observed.direction, &observed.moments.centroid, mapped, config) {
        return None;
    }
    let mapped = &mapped.segment();
    // How far the pose may be off along this wall.
    let d = mapped.direction;
    let p = view.covariance;
    let var_along = d.x * d.x * p.m11 + 2.0 * d.x * d.y * p.m12 + d.y * d.y * p.m22;
    let slack = min(2.0 * sqrt(var_along), config.max_overlap_slack_m);
    let shorter = min(observed.length_m(), mapped.length_m());
    if mapped.overlap_m(observed) + slack < config.min_overlap * shorter {
        return None;
    }
    let residual = Residual::new(observed, mapped, view.pose.translation.vector.into(), view.line_noise)?;
    let chi2 = residual.chi2(view.covariance);
    (chi2 <= config.max_chi2).then_some(chi2)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::pose::pose;
    use proptest::prelude::*;

    const NOISE: LineNoise = LineNoise { sigma_offset_m: 0.005, sigma_direction_rad: 0.002 };

    /// A segment seen from a point on its left.
    fn wall(from: (f32, f32), to: (f32, f32)) -> Segment {
        let (from, to) = (Point2::new(from.0, from.1), Point2::new(to.0, to.1));
        let left = nalgebra::center(&from, &to) + crate::geometry::pose::perpendicular(to - from);
        let points = (0..40).map(|i| (from + (to - from) * (i as f32 / 39.0), 1e4));
        Segment::fitted(crate::geometry::segment::Moments::from_points(points), &[from, to], left)
    }

    fn pair(observed: &Segment, map: &[Segment], config: &AssociationConfig, sigma_m: f32) -> Option<usize> {
        let map: std::vec::Vec<MapSegment> =
            map.iter().map(|segment| MapSegment::new(segment, 3, 0, 0.0)).collect();
        let mut nearby = Nearby::<4>::new();
        nearby.gather(&map, &Isometry2::identity(), f32::INFINITY, |_| true);
        let covariance =
            Matrix3::from_diagonal(&nalgebra::Vector3::new(sigma_m.powi(2), sigma_m.powi(2), 1e-4));
        let view = View { pose: &pose(0.0, 0.0, 0.0), covariance: &covariance, line_noise: &NOISE };
        let mut pairs: Vec<Pair, 4> = Vec::new();
        associate(&[*observed], &view, &map, &nearby, config, &mut Shortlist::default(), &mut pairs);
        pairs.first().map(|p| p.mapped)
    }

    fn bisector() -> AssociationConfig {
        AssociationConfig::Bisector(BisectorConfig { max_distance_m: 0.3 })
    }

    fn gated() -> AssociationConfig {
        crate::SlamConfig::default().association
    }

    #[test]
    fn the_bisector_takes_the_nearest_crossing() {
        let seen = wall((0.0, 1.0), (2.0, 1.0));
        let near = wall((0.5, 1.1), (1.5, 1.12));
        let far = wall((0.0, 1.25), (2.0, 1.25));
        assert_eq!(pair(&seen, &[far, near], &bisector(), 0.1), Some(1));
        assert_eq!(pair(&seen, &[far], &bisector(), 0.1), Some(0));
    }

    #[test]
    fn the_bisector_must_cross_the_segment_within_the_threshold() {
        let seen = wall((0.0, 1.0), (2.0, 1.0));
        assert_eq!(pair(&seen, &[wall((1.2, 1.1), (3.0, 1.1))], &bisector(), 0.1), None, "beside it");
        assert_eq!(pair(&seen, &[wall((0.0, 1.4), (2.0, 1.4))], &bisector(), 0.1), None, "too far");
        assert_eq!(
            pair(&seen, &[wall((1.0, 1.2), (1.0, 3.0))], &bisector(), 0.1),
            None,
            "parallel to the bisector"
        );
        // The distance is measured along the bisector: 0.2 m here, though the nearest points are closer.
        assert_eq!(pair(&seen, &[wall((0.0, 1.1), (2.0, 1.3))], &bisector(), 0.1), Some(0));
    }

    #[test]
    fn opposite_faces_of_a_thin_wall_never_pair() {
        let face = wall((0.0, 1.0), (2.0, 1.0));
        let back = wall((2.0, 1.02), (0.0, 1.02));
        assert_eq!(pair(&face, &[back], &gated(), 0.1), None);
        assert_eq!(pair(&face, &[wall((0.0, 1.02), (2.0, 1.02))], &gated(), 0.1), Some(0));
    }

    #[test]
    fn gates_reject_by_angle_by_distance_and_by_overlap() {
        let seen = wall((0.0, 1.0), (2.0, 1.0));
        assert_eq!(pair(&seen, &[wall((0.0, 0.4), (2.0, 1.6))], &gated(), 0.3), None, "angle");
        assert_eq!(pair(&seen, &[wall((0.0, 1.65), (2.0, 1.65))], &gated(), 0.3), None, "distance");
        assert_eq!(pair(&seen, &[wall((0.0, 1.2), (2.0, 1.2))], &gated(), 0.01), None, "likelihood");
        assert_eq!(pair(&seen, &[wall((0.0, 1.2), (2.0, 1.2))], &gated(), 0.1), Some(0));
        assert_eq!(pair(&seen, &[wall((2.1, 1.0), (4.0, 1.0))], &gated(), 0.01), None, "overlap");
        assert_eq!(pair(&seen, &[wall((1.2, 1.0), (4.0, 1.0))], &gated(), 0.01), Some(0));
    }

    #[test]
    fn the_likelier_of_two_wins() {
        let seen = wall((0.0, 1.0), (2.0, 1.0));
        let map = [wall((0.0, 1.08), (2.0, 1.08)), wall((0.0, 0.97), (2.0, 0.97))];
        assert_eq!(pair(&seen, &map, &gated(), 0.1), Some(1));
        assert_eq!(pair(&seen, &[], &gated(), 0.1), None);
    }

    proptest! {
        /// Corrected by steps of any size, through one shortlist, the pairs are those found afresh.
        #[test]
        fn the_shortlist_changes_nothing(
            walls in proptest::collection::vec((-20.0f32..20.0, -20.0f32..20.0, -4.0f32..4.0, -4.0f32..4.0), 1..40),
            steps in proptest::collection::vec((-0.2f32..0.2, -0.2f32..0.2, -0.08f32..0.08), 1..6),
        ) {
            let walls: std::vec::Vec<Segment> = walls.iter().map(|&(x, y, dx, dy)| wall((x, y), (x + dx, y + dy))).collect();
            let entry = |segment: &Segment| MapSegment::new(segment, 3, 0, 0.0);
            let map: std::vec::Vec<MapSegment> = walls.iter().map(entry).collect();
            let mut nearby = Nearby::<64>::new();
            nearby.gather(&map, &Isometry2::identity(), 40.0, |_| true);
            let covariance = Matrix3::from_diagonal(&nalgebra::Vector3::new(0.01, 0.01, 0.01));
            let mut shortlist = Shortlist::default();
            let mut at = nalgebra::Vector3::zeros();
            for (x, y, turn) in steps {
                at += nalgebra::Vector3::new(x, y, turn);
                let view = View { pose: &pose(at.x, at.y, at.z), covariance: &covariance, line_noise: &NOISE };
                let (mut kept, mut fresh) = (Vec::<Pair, 64>::new(), Vec::<Pair, 64>::new());
                associate(&walls, &view, &map, &nearby, &gated(), &mut shortlist, &mut kept);
                associate(&walls, &view, &map, &nearby, &gated(), &mut Shortlist::default(), &mut fresh);
                prop_assert_eq!(kept, fresh);
            }
        }
    }
}
