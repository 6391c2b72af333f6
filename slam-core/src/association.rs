//! Which observed segment is which map segment.
//!
//! In: observed segments in `base`, the pose they are seen through, map segments. Out: at most one [`Pair`] for each
//! observed segment; an observed segment without a pair is new.
//!
//! The paper (section 2.2) takes the nearest along the perpendicular bisector. The default gates on side, direction,
//! distance and overlap and takes the likeliest, with the covariance of pose and lines allowed for.

use heapless::VecView;
use nalgebra::{Isometry2, Matrix3};

use crate::map::MapSegment;
use crate::math::sqrt;
use crate::pose::cross;
use crate::residual::{LineNoise, Residual};
use crate::segment::Segment;

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

/// Settings of the paper's association.
#[derive(Clone, Copy, Debug, PartialEq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct BisectorConfig {
    /// Largest distance between the two crossings of the bisector, metres.
    pub max_distance_m: f32,
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

/// Finds the pairs. `candidates` are the indices of the map segments worth looking at.
///
/// Work: one step for each observed segment and candidate.
pub fn associate(
    observed: &[Segment],
    view: &View<'_>,
    map: &[MapSegment],
    candidates: &[u16],
    config: &AssociationConfig,
    pairs: &mut VecView<Pair>,
) {
    pairs.clear();
    for (index, in_base) in observed.iter().enumerate() {
        let in_map = in_base.transformed(view.pose);
        let mut best: Option<(f32, usize)> = None;
        for &candidate in candidates {
            let mapped = usize::from(candidate);
            let Some(entry) = map.get(mapped) else { continue };
            let score = match config {
                AssociationConfig::Bisector(config) => bisector_distance(&in_map, &entry.segment, config),
                AssociationConfig::Gated(config) => gated_chi2(&in_map, &entry.segment, view, config),
            };
            if let Some(score) = score
                && best.is_none_or(|(least, _)| score < least)
            {
                best = Some((score, mapped));
            }
        }
        if let Some((_, mapped)) = best {
            // One pair for each observed segment: the caller's capacities are the same.
            let _ = pairs.push(Pair { observed: index, mapped });
        }
    }
}

/// Distance between the points in which the perpendicular bisector of `observed` crosses it and `mapped`, if it does
/// cross `mapped` and the distance is within the threshold.
fn bisector_distance(observed: &Segment, mapped: &Segment, config: &BisectorConfig) -> Option<f32> {
    let midpoint = observed.midpoint();
    let (bisector, along) = (observed.normal(), mapped.end - mapped.start);
    let denominator = cross(along, bisector);
    let from_start = midpoint - mapped.start;
    // start + t·along = midpoint + s·bisector.
    let t = cross(from_start, bisector) / denominator;
    let s = cross(from_start, along) / denominator;
    ((0.0..=1.0).contains(&t) && s.abs() <= config.max_distance_m).then_some(s.abs())
}

/// χ² of the pair if it passes every gate.
fn gated_chi2(observed: &Segment, mapped: &Segment, view: &View<'_>, config: &GateConfig) -> Option<f32> {
    let cos_angle = observed.direction.dot(&mapped.direction);
    let sin_angle = cross(mapped.direction, observed.direction);
    if cos_angle <= 0.0 || sin_angle.abs() > config.max_angle_rad {
        return None;
    }
    let offset = mapped.normal().dot(&(observed.moments.centroid - mapped.moments.centroid));
    if offset.abs() > config.max_distance_m {
        return None;
    }
    // How far the pose may be off along this wall.
    let d = mapped.direction;
    let p = view.covariance;
    let var_along = d.x * d.x * p.m11 + 2.0 * d.x * d.y * p.m12 + d.y * d.y * p.m22;
    let slack = (2.0 * sqrt(var_along)).min(config.max_overlap_slack_m);
    let shorter = observed.length_m().min(mapped.length_m());
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
    use crate::pose::pose;
    use heapless::Vec;
    use nalgebra::Point2;

    const NOISE: LineNoise = LineNoise { sigma_offset_m: 0.005, sigma_direction_rad: 0.002 };

    /// A segment seen from a point on its left.
    fn wall(from: (f32, f32), to: (f32, f32)) -> Segment {
        let (from, to) = (Point2::new(from.0, from.1), Point2::new(to.0, to.1));
        let left = nalgebra::center(&from, &to) + crate::pose::perpendicular(to - from);
        let points = (0..40).map(|i| (from + (to - from) * (i as f32 / 39.0), 1e4));
        Segment::fitted(crate::segment::Moments::from_points(points), &[from, to], left)
    }

    fn pair(observed: &Segment, map: &[Segment], config: &AssociationConfig, sigma_m: f32) -> Option<usize> {
        let map: std::vec::Vec<MapSegment> = map
            .iter()
            .map(|&segment| MapSegment { segment, hits: 3, seen_through: 0, last_seen: 0, seen_at_m: 0.0 })
            .collect();
        let candidates: std::vec::Vec<u16> = (0..map.len() as u16).collect();
        let covariance =
            Matrix3::from_diagonal(&nalgebra::Vector3::new(sigma_m.powi(2), sigma_m.powi(2), 1e-4));
        let view = View { pose: &pose(0.0, 0.0, 0.0), covariance: &covariance, line_noise: &NOISE };
        let mut pairs: Vec<Pair, 4> = Vec::new();
        associate(&[*observed], &view, &map, &candidates, config, &mut pairs);
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
}
