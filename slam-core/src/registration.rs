//! What was seen becomes map.
//!
//! In: observed segments in `base`, the corrected pose, the pairs. Out: a changed map. Unmatched segments are added,
//! matched ones joined with their pair.
//!
//! The paper (equation (10), Fig. 6) joins by the line through the four end points. The default adds up the sums behind
//! both segments, so that the map's line is the least-squares line of all points ever seen on it, and fuses map
//! segments that turn out to be one wall.

use heapless::{Vec, VecView};
use nalgebra::Isometry2;

use crate::association::{Pair, View};
use crate::extraction::MAX_SEGMENTS;
use crate::map::{MapSegment, SegmentMap};
use crate::pose::{cross, perpendicular};
use crate::residual::Residual;
use crate::segment::{Moments, Segment};

/// How segments enter the map.
#[derive(Clone, Copy, Debug, PartialEq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize), serde(rename_all = "snake_case"))]
pub enum RegistrationConfig {
    /// Fig. 6 of the paper.
    EndPoints,
    /// Sums are added, walls fused.
    Sums(SumsConfig),
}

/// Settings of the registration by sums.
#[derive(Clone, Copy, Debug, PartialEq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct SumsConfig {
    /// A pair that fits worse than this χ² after the correction changes nothing.
    pub max_chi2: f32,
    /// The pose's uncertainty lowers the weight of what is registered up to this much across a line, metres. More of it
    /// is common to all that is registered from there, and not an error among them.
    pub max_sigma_offset_m: f32,
    /// The same for the lines' directions, radians.
    pub max_sigma_direction_rad: f32,
    /// Two map segments with a larger angle between them are two walls, radians.
    pub fuse_max_angle_rad: f32,
    /// Two map segments of which an end lies farther than this off the other's line are two walls, metres.
    pub fuse_max_distance_m: f32,
    /// Two map segments with a wider gap between them, along, are two walls, metres, …
    pub fuse_gap_m: f32,
    /// … unless the gap is no longer than either, up to this, metres: a wall with a door in it.
    pub fuse_max_gap_m: f32,
    /// Within these bounds, worst χ² of two map segments that are one wall.
    pub fuse_chi2: f32,
    /// Overlapping map segments closer than this many standard deviations of a line's offset are one wall whatever
    /// their χ²: one would hide the other.
    pub fuse_sigmas: f32,
    /// Share of the shorter one that must overlap for that.
    pub fuse_overlap: f32,
}

/// When a scan was taken.
#[derive(Clone, Copy, Debug)]
pub struct Stamp {
    /// Number of the scan.
    pub scan: u32,
    /// Way the robot had driven, metres.
    pub way_m: f32,
}

/// What one scan did to the map.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct RegistrationReport {
    /// Segments joined with a map segment.
    pub matched: u32,
    /// Segments added.
    pub new: u32,
    /// Pairs that fitted too badly to be joined.
    pub doubtful: u32,
}

/// Registers the segments of a scan, seen through `view`.
///
/// Work: one step for each observed segment, and for fusing one for each map segment it changed and each map segment.
pub fn register<const N: usize>(
    observed: &[Segment],
    pairs: &[Pair],
    view: &View<'_>,
    stamp: &Stamp,
    config: &RegistrationConfig,
    map: &mut SegmentMap<N>,
) -> RegistrationReport {
    let mut report = RegistrationReport::default();
    let mut is_new: Vec<bool, MAX_SEGMENTS> = Vec::new();
    // As many observed segments as capacity: both come from the extraction.
    let _ = is_new.resize(observed.len().min(MAX_SEGMENTS), true);
    for pair in pairs {
        let (Some(seen), Some(entry)) = (observed.get(pair.observed), map.get_mut(pair.mapped)) else {
            continue;
        };
        if let Some(flag) = is_new.get_mut(pair.observed) {
            *flag = false;
        }
        let joined = match config {
            RegistrationConfig::EndPoints => {
                Some(joined_by_end_points(&entry.segment, &seen.transformed(view.pose)))
            }
            RegistrationConfig::Sums(config) => joined_by_sums(&entry.segment, seen, view, config),
        };
        let Some(joined) = joined.filter(Segment::is_finite) else {
            report.doubtful += 1;
            continue;
        };
        entry.segment = joined;
        entry.hits = entry.hits.saturating_add(1);
        entry.last_seen = stamp.scan;
        entry.seen_at_m = stamp.way_m;
        report.matched += 1;
    }
    for (seen, _) in observed.iter().zip(&is_new).filter(|(_, new)| **new) {
        let segment = match config {
            RegistrationConfig::EndPoints => seen.transformed(view.pose),
            RegistrationConfig::Sums(config) => with_pose_uncertainty(seen, view, config),
        };
        if segment.is_finite() && map.insert(segment, stamp.scan, stamp.way_m) {
            report.new += 1;
        }
    }
    if let RegistrationConfig::Sums(config) = config {
        fuse_walls(map, stamp.scan, view, config);
    }
    report
}

/// Fig. 6: the least-squares line through the four end points, n = n_m + n_g.
fn joined_by_end_points(mapped: &Segment, seen: &Segment) -> Segment {
    let ends = [mapped.start, mapped.end, seen.start, seen.end];
    let inliers = mapped.moments.inliers.saturating_add(seen.moments.inliers);
    let weight = mapped.moments.weight + seen.moments.weight;
    let mut moments = Moments::from_points(ends.iter().map(|&p| (p, 0.25 * weight)));
    moments.inliers = inliers;
    // The map segment's free side is kept: a point just off its middle on that side.
    Segment::fitted(moments, &ends, mapped.midpoint() + mapped.normal())
}

/// The least-squares line of all points of both, if the pair fits.
fn joined_by_sums(mapped: &Segment, seen: &Segment, view: &View<'_>, config: &SumsConfig) -> Option<Segment> {
    let seen_in_map = with_pose_uncertainty(seen, view, config);
    let position = view.pose.translation.vector.into();
    let residual = Residual::new(&seen_in_map, mapped, position, view.line_noise)?;
    let fits = residual.chi2(view.covariance) <= config.max_chi2;
    fits.then(|| mapped.merged(&seen_in_map))
}

/// The segment in `map`, with offset and direction as uncertain as the pose and the wall's own crookedness make them.
fn with_pose_uncertainty(seen: &Segment, view: &View<'_>, config: &SumsConfig) -> Segment {
    let mut segment = seen.transformed(view.pose);
    let normal = segment.normal();
    let lever = normal.dot(&perpendicular(segment.moments.centroid.coords - view.pose.translation.vector));
    let across = nalgebra::Vector3::new(normal.x, normal.y, lever);
    let cap = |variance: f32, sigma: f32| variance.min(sigma * sigma);
    let var_offset = cap(across.dot(&(view.covariance * across)), config.max_sigma_offset_m)
        + view.line_noise.var_offset();
    let var_direction = cap(view.covariance.m33, config.max_sigma_direction_rad)
        + view.line_noise.var_direction(segment.length_m());
    let scatter = segment.moments.scatter_along(segment.direction);
    segment.moments = segment
        .moments
        .loosened(1.0 / (1.0 + segment.moments.weight * var_offset), 1.0 / (1.0 + scatter * var_direction));
    segment
}

/// Fuses each map segment that this scan changed with those that are the same wall.
fn fuse_walls<const N: usize>(
    map: &mut SegmentMap<N>,
    scan_number: u32,
    view: &View<'_>,
    config: &SumsConfig,
) {
    let mut index = 0;
    while let Some(changed) = map.segments().get(index).copied() {
        let twin = (changed.last_seen == scan_number)
            .then(|| {
                map.segments()
                    .iter()
                    .enumerate()
                    .find(|(i, s)| *i != index && one_wall(&changed, s, view, config))
            })
            .flatten()
            .map(|(i, _)| i);
        match twin {
            // The grown segment is looked at again, wherever it went.
            Some(twin) => {
                let (kept, gone) = (index.min(twin), index.max(twin));
                map.fuse(kept, gone);
                index = kept;
            }
            None => index += 1,
        }
    }
}

/// Whether two map segments are one wall: either they agree within their uncertainty, or they lie so close behind each
/// other that one would hide the other.
fn one_wall(a: &MapSegment, b: &MapSegment, view: &View<'_>, config: &SumsConfig) -> bool {
    let (a, b) = (&a.segment, &b.segment);
    let facing = a.direction.dot(&b.direction) > 0.0;
    // The shorter one is judged by the longer one's line.
    let (long, short) = if a.length_m() >= b.length_m() { (a, b) } else { (b, a) };
    let (angle, distance, overlap_m) =
        (cross(long.direction, short.direction).abs(), distance_m(long, short), long.overlap_m(short));
    if !facing || angle > config.fuse_max_angle_rad || distance > config.fuse_max_distance_m {
        return false;
    }
    let hides = overlap_m >= config.fuse_overlap * short.length_m()
        && distance <= config.fuse_sigmas * view.line_noise.sigma_offset_m;
    let agrees = || {
        Residual::new(short, long, view.pose.translation.vector.into(), view.line_noise)
            .is_some_and(|r| r.chi2(&nalgebra::Matrix3::zeros()) <= config.fuse_chi2)
    };
    // A long wall goes on behind a door; a short thing beside another is another thing.
    let gap_m = config.fuse_gap_m.max(short.length_m().min(config.fuse_max_gap_m));
    hides || overlap_m >= -gap_m && agrees()
}

/// Distance of the farther end of `short` from the line of `long`, metres.
fn distance_m(long: &Segment, short: &Segment) -> f32 {
    let line = long.line();
    line.signed_distance(short.start).abs().max(line.signed_distance(short.end).abs())
}

/// Indices of the map segments within `reach_m` of the pose: those a scan from there can touch.
pub fn within_reach(map: &[MapSegment], pose: &Isometry2<f32>, reach_m: f32, candidates: &mut VecView<u16>) {
    candidates.clear();
    for (index, entry) in map.iter().enumerate() {
        let to_middle = entry.segment.midpoint().coords - pose.translation.vector;
        let radius = reach_m + 0.5 * entry.segment.length_m();
        if to_middle.norm_squared() <= radius * radius {
            // At most as many as the map holds, which is the capacity.
            let _ = candidates.push(index as u16);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pose::pose;
    use crate::residual::LineNoise;
    use nalgebra::{Matrix3, Point2};
    use std::vec::Vec as StdVec;

    const NOISE: LineNoise = LineNoise { sigma_offset_m: 0.005, sigma_direction_rad: 0.002 };

    fn wall(from: (f32, f32), to: (f32, f32)) -> Segment {
        let (from, to) = (Point2::new(from.0, from.1), Point2::new(to.0, to.1));
        let left = nalgebra::center(&from, &to) + perpendicular(to - from);
        let points = (0..40).map(|i| (from + (to - from) * (i as f32 / 39.0), 1e4));
        Segment::fitted(Moments::from_points(points), &[from, to], left)
    }

    fn sums() -> RegistrationConfig {
        crate::SlamConfig::default().registration
    }

    fn run(
        map: &mut SegmentMap<8>,
        observed: &[Segment],
        pairs: &[Pair],
        scan: u32,
        config: &RegistrationConfig,
    ) -> RegistrationReport {
        let covariance = Matrix3::identity() * 1e-6;
        let view = View { pose: &pose(0.0, 0.0, 0.0), covariance: &covariance, line_noise: &NOISE };
        register(observed, pairs, &view, &Stamp { scan, way_m: 1.0 }, config, map)
    }

    #[test]
    fn unmatched_segments_are_added_and_matched_ones_joined() {
        for config in [RegistrationConfig::EndPoints, sums()] {
            let mut map = SegmentMap::new();
            let first = run(&mut map, &[wall((0.0, 1.0), (2.0, 1.0))], &[], 1, &config);
            assert_eq!((first.new, first.matched), (1, 0));
            let seen = [wall((1.0, 1.0), (3.0, 1.0)), wall((3.0, 1.0), (3.0, -1.0))];
            let second = run(&mut map, &seen, &[Pair { observed: 0, mapped: 0 }], 2, &config);
            assert_eq!((second.new, second.matched), (1, 1));
            let joined = &map.segments()[0];
            assert_eq!((joined.hits, joined.segment.moments.inliers), (2, 80));
            assert!((joined.segment.length_m() - 3.0).abs() < 1e-4, "ends are the farthest feet");
        }
    }

    #[test]
    fn paper_merge_is_the_line_through_four_end_points() {
        let mapped = wall((0.0, 1.0), (2.0, 1.0));
        let seen = wall((0.0, 1.1), (2.0, 1.2));
        let joined = joined_by_end_points(&mapped, &seen);
        // Closed form: total least squares of (0, 1), (2, 1), (0, 1.1), (2, 1.2).
        let (mean_y, xx, xy, yy) = (1.075f64, 4.0f64, 0.1f64, 0.0275f64);
        let angle = 0.5 * (2.0 * xy).atan2(xx - yy);
        assert!((f64::from(joined.direction.y.atan2(joined.direction.x)) - angle).abs() < 1e-5);
        assert!((f64::from(joined.moments.centroid.y) - mean_y).abs() < 1e-6);
        assert_eq!(joined.moments.inliers, 80);
    }

    #[test]
    fn one_wall_seen_in_pieces_becomes_one_segment() {
        let mut map = SegmentMap::new();
        let pieces =
            [wall((0.0, 1.0), (1.0, 1.0)), wall((2.5, 1.002), (3.5, 1.0)), wall((7.0, 1.0), (8.0, 1.0))];
        run(&mut map, &pieces, &[], 1, &sums());
        assert_eq!(map.segments().len(), 3);
        // A look at the middle closes the first gap, not the second.
        run(&mut map, &[wall((0.5, 1.0), (3.0, 1.0))], &[Pair { observed: 0, mapped: 0 }], 2, &sums());
        let mut lengths: StdVec<f32> = map.segments().iter().map(|s| s.segment.length_m()).collect();
        lengths.sort_by(f32::total_cmp);
        assert_eq!(lengths.len(), 2);
        assert!((lengths[1] - 3.5).abs() < 1e-3);
        assert_eq!(map.counters().fused, 1);
    }

    #[test]
    fn a_wall_goes_on_behind_a_door_no_wider_than_it_is_long() {
        let mut map = SegmentMap::new();
        run(&mut map, &[wall((0.0, 1.0), (2.0, 1.0)), wall((2.9, 1.0), (5.0, 1.0))], &[], 1, &sums());
        assert_eq!(map.segments().len(), 1);
        let mut map = SegmentMap::new();
        run(&mut map, &[wall((0.0, 1.0), (2.0, 1.0)), wall((2.9, 1.0), (3.2, 1.0))], &[], 1, &sums());
        assert_eq!(map.segments().len(), 2, "a short thing behind the door is another thing");
    }

    #[test]
    fn walls_that_differ_stay_apart() {
        let mut map = SegmentMap::new();
        let walls = [
            wall((0.0, 1.0), (2.0, 1.0)),
            wall((2.0, 1.02), (0.0, 1.02)), // its other face
            wall((2.1, 1.15), (3.0, 1.15)), // the back of a recess beside it
            wall((0.0, 1.3), (2.0, 1.3)),   // behind it
            wall((2.0, 1.0), (2.0, 3.0)),   // round the corner
        ];
        run(&mut map, &walls, &[], 1, &sums());
        assert_eq!(map.segments().len(), 5);
        assert_eq!(map.counters().fused, 0);
    }

    #[test]
    fn a_pair_that_does_not_fit_changes_nothing() {
        let mut map = SegmentMap::new();
        run(&mut map, &[wall((0.0, 1.0), (2.0, 1.0))], &[], 1, &sums());
        let before = map.segments()[0];
        let report =
            run(&mut map, &[wall((0.0, 1.3), (2.0, 1.3))], &[Pair { observed: 0, mapped: 0 }], 2, &sums());
        assert_eq!((report.doubtful, report.new), (1, 0));
        assert_eq!(map.segments(), [before]);
    }

    #[test]
    fn segments_out_of_reach_are_no_candidates() {
        let mut map = SegmentMap::<8>::new();
        for wall in
            [wall((4.0, 0.0), (4.0, 1.0)), wall((9.0, 0.0), (9.0, 1.0)), wall((-20.0, 1.0), (20.0, 1.0))]
        {
            map.insert(wall, 1, 0.0);
        }
        let mut candidates: Vec<u16, 8> = Vec::new();
        within_reach(map.segments(), &pose(0.0, 0.0, 0.0), 5.6, &mut candidates);
        assert_eq!(candidates, [0, 2]);
    }
}
