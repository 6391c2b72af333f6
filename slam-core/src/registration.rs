//! What was seen becomes map.
//!
//! In: observed segments in `base`, the corrected pose, the pairs. Out: a changed map. Unmatched segments are added,
//! matched ones joined with their pair.
//!
//! The paper (equation (10), Fig. 6) joins by the line through the four end points. The default hands the pairs to the
//! [`Joint`] estimate, which moves pose and lines together, and fuses map segments that turn out to be one wall.

use heapless::{Vec, VecView};
use nalgebra::{Isometry2, Point2};

use crate::association::Pair;
use crate::extraction::MAX_SEGMENTS;
use crate::joint::{Joint, Measurement, variances, with_variances};
use crate::keyframe::KeyframeConfig;
use crate::map::{MapSegment, SegmentMap};
use crate::math::wrap_angle;
use crate::pose::{components, cross};
use crate::residual::{LineNoise, Residual};
use crate::segment::{Moments, Segment};

/// How segments enter the map.
#[derive(Clone, Copy, Debug, PartialEq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize), serde(rename_all = "snake_case"))]
pub enum RegistrationConfig {
    /// Fig. 6 of the paper.
    EndPoints,
    /// Lines are estimated together with the pose, walls fused.
    Joint(JointConfig),
}

/// Settings of the joint estimate.
#[derive(Clone, Copy, Debug, PartialEq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct JointConfig {
    /// Which scans are taken in.
    pub keyframes: KeyframeConfig,
    /// A pair that fits worse than this χ² changes nothing.
    pub max_chi2: f32,
    /// A pair that fits worse than this χ² counts for less: its variance grows with its χ².
    pub kernel_chi2: f32,
    /// A segment seen in fewer scans than this is young. A young one that is seen only now and then may be walking, or nothing:
    /// the pose learns nothing from it.
    pub young_hits: u16,
    /// Now and then: in fewer than one of so many scans since it was first seen.
    pub young_scans_per_hit: f32,
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
    /// Whether the scan was taken into the map; the default takes in keyframes only.
    pub keyframe: bool,
}

/// What the registration is given of a scan.
#[derive(Clone, Copy, Debug)]
pub struct Observed<'a> {
    /// Segments in `base`.
    pub segments: &'a [Segment],
    /// Those that are known.
    pub pairs: &'a [Pair],
    /// When they were seen.
    pub stamp: Stamp,
    /// Errors of lines beyond their points' noise.
    pub line_noise: &'a LineNoise,
}

impl Observed<'_> {
    /// The segments without a pair.
    fn unknown(&self) -> impl Iterator<Item = &Segment> {
        let known = |index: usize| self.pairs.iter().any(|p| p.observed == index);
        self.segments.iter().enumerate().filter(move |(index, _)| !known(*index)).map(|(_, s)| s)
    }
}

/// Fig. 6 of the paper: the map by the corrected pose.
///
/// Work: one step for each observed segment.
pub fn register_end_points<const N: usize>(
    seen: &Observed<'_>,
    pose: &Isometry2<f32>,
    map: &mut SegmentMap<N>,
) -> RegistrationReport {
    let mut report = RegistrationReport { keyframe: true, ..RegistrationReport::default() };
    for pair in seen.pairs {
        let (Some(segment), Some(entry)) = (seen.segments.get(pair.observed), map.get_mut(pair.mapped))
        else {
            continue;
        };
        let joined = joined_by_end_points(&entry.segment, &segment.transformed(pose));
        if !joined.is_finite() {
            report.doubtful += 1;
            continue;
        }
        entry.segment = joined;
        mark_seen(entry, &seen.stamp);
        report.matched += 1;
    }
    for segment in seen.unknown() {
        let segment = segment.transformed(pose);
        if segment.is_finite() && map.insert(segment, seen.stamp.scan, seen.stamp.way_m).is_some() {
            report.new += 1;
        }
    }
    report
}

fn mark_seen(entry: &mut MapSegment, stamp: &Stamp) {
    entry.hits = entry.hits.saturating_add(1);
    entry.last_seen = stamp.scan;
    entry.seen_at_m = stamp.way_m;
}

/// Where the joint estimate is taken on from.
#[derive(Clone, Copy, Debug)]
pub struct Start<'a> {
    /// The predicted pose, whose covariance the joint estimate has.
    pub prior: &'a Isometry2<f32>,
    /// The pose through which the pairs were found: the measurements are made linear there.
    pub pose: &'a Isometry2<f32>,
}

/// Joint estimate of the pose, the odometry's errors and the lines, from the pairs of a scan; what is not known is added.
/// Returns the pose.
///
/// Work: for each pair, the square of the number of states tracked; for fusing, one step for each map segment that was
/// seen and each map segment.
pub fn register_jointly<const N: usize>(
    seen: &Observed<'_>,
    start: &Start<'_>,
    config: &JointConfig,
    joint: &mut Joint,
    map: &mut SegmentMap<N>,
) -> (Isometry2<f32>, RegistrationReport) {
    let mut report = RegistrationReport { keyframe: true, ..RegistrationReport::default() };
    let mut matched: Vec<Pair, MAX_SEGMENTS> = Vec::new();
    let position = start.prior.translation.vector;
    let mut since_prior = components(start.pose) - components(start.prior);
    since_prior.z = wrap_angle(since_prior.z);
    for pair in seen.pairs {
        let Some(segment) = seen.segments.get(pair.observed) else { continue };
        let Some(place) = joint.track(pair.mapped, map, seen.stamp.scan) else {
            report.doubtful += 1;
            continue;
        };
        let Some(entry) = map.get_mut(pair.mapped) else { continue };
        let length_m = segment.length_m().min(entry.segment.length_m());
        let variances = with_line_noise(variances(segment), seen.line_noise, length_m);
        let segment = segment.transformed(start.pose);
        let measurement =
            Measurement::of_pair(place, &entry.segment, &segment, position, &since_prior, variances);
        let chi2 = joint.chi2(&measurement);
        if chi2.is_nan() || chi2 > config.max_chi2 {
            report.doubtful += 1;
            continue;
        }
        let doubted = entry.hits < config.young_hits
            && joint.age_scans(place) > config.young_scans_per_hit * f32::from(entry.hits);
        let only = doubted.then_some(place);
        joint.measure(&measurement, (chi2 / config.kernel_chi2).max(1.0), only);
        mark_seen(entry, &seen.stamp);
        report.matched += 1;
        // As many pairs as observed segments at most.
        let _ = matched.push(*pair);
    }
    let mut pose = joint.settle(start.prior, map);
    for pair in &matched {
        let (Some(segment), Some(entry)) = (seen.segments.get(pair.observed), map.get_mut(pair.mapped))
        else {
            continue;
        };
        let moments = &mut entry.segment.moments;
        moments.inliers = moments.inliers.saturating_add(segment.moments.inliers);
        let longer = entry.segment.extended([pose * segment.start, pose * segment.end]);
        if longer.is_finite() {
            entry.segment = longer;
        }
    }
    for segment in seen.unknown() {
        let [var_offset, var_direction] =
            with_line_noise(variances(segment), seen.line_noise, segment.length_m());
        let segment = with_variances(&segment.transformed(&pose), var_offset, var_direction);
        if segment.is_finite()
            && let Some(index) = map.insert(segment, seen.stamp.scan, seen.stamp.way_m)
        {
            joint.add(index, pose.translation.vector, map, seen.stamp.scan);
            report.new += 1;
        }
    }
    fuse_walls(seen, config, &mut pose, joint, map);
    (pose, report)
}

fn with_line_noise([offset, direction]: [f32; 2], noise: &LineNoise, length_m: f32) -> [f32; 2] {
    [offset + noise.var_offset(), direction + noise.var_direction(length_m)]
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

/// Fuses each map segment that this scan changed with those that are the same wall.
fn fuse_walls<const N: usize>(
    seen: &Observed<'_>,
    config: &JointConfig,
    pose: &mut Isometry2<f32>,
    joint: &mut Joint,
    map: &mut SegmentMap<N>,
) {
    let mut index = 0;
    while let Some(changed) = map.segments().get(index).copied() {
        let is_twin = |(i, s): (usize, &MapSegment)| {
            i != index && one_wall(&changed, s, &pose.translation.vector.into(), seen.line_noise, config)
        };
        let twin = (changed.last_seen == seen.stamp.scan)
            .then(|| map.segments().iter().enumerate().position(is_twin))
            .flatten();
        let Some(twin) = twin else {
            index += 1;
            continue;
        };
        let inliers = |i: usize| map.segments().get(i).map_or(0, |s| s.segment.moments.inliers);
        let (kept, gone) = if inliers(twin) > inliers(index) { (twin, index) } else { (index, twin) };
        if let Some(settled) = agree([kept, gone], seen, config, pose, joint, map) {
            *pose = settled;
        }
        map.fuse(kept, gone);
        let last = map.segments().len();
        joint.removed(gone, last, map);
        // The grown segment is looked at again, wherever it went.
        index = if kept == last { gone } else { kept };
    }
}

/// Measures that two map segments are one line, unless they disagree. Returns the pose by that.
fn agree<const N: usize>(
    twins: [usize; 2],
    seen: &Observed<'_>,
    config: &JointConfig,
    pose: &Isometry2<f32>,
    joint: &mut Joint,
    map: &mut SegmentMap<N>,
) -> Option<Isometry2<f32>> {
    let [kept, gone] = twins.map(|index| joint.track(index, map, seen.stamp.scan));
    let [a, b] = twins.map(|index| map.segments().get(index).map(|s| s.segment));
    let (a, b) = (a?, b?);
    let length_m = a.length_m().min(b.length_m());
    let variances = with_line_noise([0.0, 0.0], seen.line_noise, length_m);
    let measurement = Measurement::of_twins((&a, kept?), (&b, gone?), variances);
    (joint.chi2(&measurement) <= config.fuse_chi2).then(|| {
        joint.measure(&measurement, 1.0, None);
        joint.settle(pose, map)
    })
}

/// Whether two map segments are one wall: either they agree within their uncertainty, or they lie so close behind each
/// other that one would hide the other.
fn one_wall(
    a: &MapSegment,
    b: &MapSegment,
    position: &Point2<f32>,
    noise: &LineNoise,
    config: &JointConfig,
) -> bool {
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
        && distance <= config.fuse_sigmas * noise.sigma_offset_m;
    let agrees = || {
        Residual::new(short, long, *position, noise)
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
    use crate::pose::{perpendicular, pose};
    use nalgebra::{Matrix3, Vector3};
    use std::vec::Vec as StdVec;

    const NOISE: LineNoise = LineNoise { sigma_offset_m: 0.005, sigma_direction_rad: 0.002 };

    fn wall(from: (f32, f32), to: (f32, f32)) -> Segment {
        let (from, to) = (Point2::new(from.0, from.1), Point2::new(to.0, to.1));
        let left = nalgebra::center(&from, &to) + perpendicular(to - from);
        let points = (0..40).map(|i| (from + (to - from) * (i as f32 / 39.0), 1e4));
        Segment::fitted(Moments::from_points(points), &[from, to], left)
    }

    fn config() -> JointConfig {
        match crate::SlamConfig::default().registration {
            RegistrationConfig::Joint(config) => config,
            RegistrationConfig::EndPoints => unreachable!("the default estimates jointly"),
        }
    }

    fn observed<'a>(segments: &'a [Segment], pairs: &'a [Pair], scan: u32) -> Observed<'a> {
        Observed { segments, pairs, stamp: Stamp { scan, way_m: 1.0 }, line_noise: &NOISE }
    }

    /// A robot that stands at the origin and is sure of it.
    fn run(
        map: &mut SegmentMap<8>,
        joint: &mut Joint,
        segments: &[Segment],
        pairs: &[Pair],
        scan: u32,
    ) -> RegistrationReport {
        let here = pose(0.0, 0.0, 0.0);
        let start = Start { prior: &here, pose: &here };
        register_jointly(&observed(segments, pairs, scan), &start, &config(), joint, map).1
    }

    fn joint() -> Joint {
        let mut joint = Joint::new(Vector3::zeros());
        joint.loosen_pose(&(Matrix3::identity() * 1e-6), &mut SegmentMap::<0>::new());
        joint
    }

    #[test]
    fn unmatched_segments_are_added_and_matched_ones_joined() {
        let first = [wall((0.0, 1.0), (2.0, 1.0))];
        let second = [wall((1.0, 1.0), (3.0, 1.0)), wall((3.0, 1.0), (3.0, -1.0))];
        let pairs = [Pair { observed: 0, mapped: 0 }];
        let check = |map: &SegmentMap<8>, reports: [RegistrationReport; 2]| {
            assert_eq!(reports.map(|r| (r.new, r.matched)), [(1, 0), (1, 1)]);
            let joined = &map.segments()[0];
            assert_eq!((joined.hits, joined.segment.moments.inliers), (2, 80));
            assert!((joined.segment.length_m() - 3.0).abs() < 1e-4, "ends are the farthest feet");
        };
        let (mut map, here) = (SegmentMap::new(), pose(0.0, 0.0, 0.0));
        let once = register_end_points(&observed(&first, &[], 1), &here, &mut map);
        let twice = register_end_points(&observed(&second, &pairs, 2), &here, &mut map);
        check(&map, [once, twice]);
        let (mut map, mut joint) = (SegmentMap::new(), joint());
        let once = run(&mut map, &mut joint, &first, &[], 1);
        let twice = run(&mut map, &mut joint, &second, &pairs, 2);
        check(&map, [once, twice]);
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
        let (mut map, mut joint) = (SegmentMap::new(), joint());
        let pieces =
            [wall((0.0, 1.0), (1.0, 1.0)), wall((2.5, 1.002), (3.5, 1.0)), wall((7.0, 1.0), (8.0, 1.0))];
        run(&mut map, &mut joint, &pieces, &[], 1);
        assert_eq!(map.segments().len(), 3);
        // A look at the middle closes the first gap, not the second.
        let pairs = [Pair { observed: 0, mapped: 0 }];
        run(&mut map, &mut joint, &[wall((0.5, 1.0), (3.0, 1.0))], &pairs, 2);
        let mut lengths: StdVec<f32> = map.segments().iter().map(|s| s.segment.length_m()).collect();
        lengths.sort_by(f32::total_cmp);
        assert_eq!(lengths.len(), 2);
        assert!((lengths[1] - 3.5).abs() < 1e-3);
        assert_eq!(map.counters().fused, 1);
    }

    fn registered(walls: &[Segment]) -> SegmentMap<8> {
        let (mut map, mut joint) = (SegmentMap::new(), joint());
        run(&mut map, &mut joint, walls, &[], 1);
        map
    }

    #[test]
    fn a_wall_goes_on_behind_a_door_no_wider_than_it_is_long() {
        let beside = |end: f32| registered(&[wall((0.0, 1.0), (2.0, 1.0)), wall((2.9, 1.0), (end, 1.0))]);
        assert_eq!(beside(5.0).segments().len(), 1);
        assert_eq!(beside(3.2).segments().len(), 2, "a short thing behind the door is another thing");
    }

    #[test]
    fn walls_that_differ_stay_apart() {
        let map = registered(&[
            wall((0.0, 1.0), (2.0, 1.0)),
            wall((2.0, 1.02), (0.0, 1.02)), // its other face
            wall((2.1, 1.15), (3.0, 1.15)), // the back of a recess beside it
            wall((0.0, 1.3), (2.0, 1.3)),   // behind it
            wall((2.0, 1.0), (2.0, 3.0)),   // round the corner
        ]);
        assert_eq!(map.segments().len(), 5);
        assert_eq!(map.counters().fused, 0);
    }

    #[test]
    fn a_pair_that_does_not_fit_changes_nothing() {
        let (mut map, mut joint) = (SegmentMap::new(), joint());
        run(&mut map, &mut joint, &[wall((0.0, 1.0), (2.0, 1.0))], &[], 1);
        let before = map.segments()[0].segment;
        let pairs = [Pair { observed: 0, mapped: 0 }];
        let report = run(&mut map, &mut joint, &[wall((0.0, 1.3), (2.0, 1.3))], &pairs, 2);
        assert_eq!((report.doubtful, report.new), (1, 0));
        let after = map.segments()[0].segment;
        assert_eq!((after.start, after.end, after.direction), (before.start, before.end, before.direction));
        assert_eq!(map.segments()[0].hits, 1);
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
