//! What was seen becomes map.
//!
//! In: observed segments in `base`, the corrected pose, the pairs. Out: a changed map. Unmatched segments are added,
//! matched ones joined with their pair.
//!
//! The paper (equation (10), Fig. 6) joins by the line through the four end points. The default hands the pairs to the
//! [`Joint`] estimate, which moves pose and lines together, and fuses map segments that turn out to be one wall.

use heapless::Vec;
use nalgebra::{Isometry2, Point2};

use crate::association::Pair;
use crate::extraction::MAX_SEGMENTS;
use crate::joint::{Joint, Learning, Measurement, Weighed, variances, with_variances};
use crate::keyframe::KeyframeConfig;
use crate::map::{MapSegment, SegmentMap};
use crate::math::wrap_angle;
use crate::nearby::Nearby;
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
    /// Most sightings that are taken in of a scan, those that tell most.
    pub max_taken: u8,
    /// Most of those from which everything learns; from the others only the robot and the line that was seen.
    pub max_learning: u8,
    /// A number that would tell less than this is passed over: variance of what it measures, over its own.
    pub least_gain: f32,
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
    /// How far the sensor sees, metres.
    pub reach_m: f32,
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
/// Returns the pose, and in `near` the map segments around it.
///
/// Work: for each sighting from which everything learns, the square of the number of states tracked, for the others that
/// number; for fusing, one step for each map segment that was
/// seen and each one around the robot, and one for each map segment.
pub fn register_jointly<const N: usize>(
    seen: &Observed<'_>,
    start: &Start<'_>,
    config: &JointConfig,
    joint: &mut Joint,
    map: &mut SegmentMap<N>,
    near: &mut Nearby<N>,
) -> (Isometry2<f32>, RegistrationReport) {
    let mut report = RegistrationReport { keyframe: true, ..RegistrationReport::default() };
    let mut sightings: Vec<Sighting, MAX_SEGMENTS> = Vec::new();
    for &pair in seen.pairs {
        // As many pairs as observed segments at most.
        match Sighting::new(pair, seen, start, joint, map) {
            Some(sighting) => drop(sightings.push(sighting)),
            None => report.doubtful += 1,
        }
    }
    for index in 0..sightings.len() {
        let rank = rank(&sightings, index);
        let Some(sighting) = sightings.get_mut(index) else { break };
        let Some(measurement) = sighting.pair.measurement(sighting.place, seen, start, map) else { continue };
        let Weighed { chi2, gains } = joint.weigh(&measurement);
        sighting.fits = chi2 <= config.max_chi2;
        let Some(entry) = map.get_mut(sighting.pair.mapped).filter(|_| sighting.fits) else {
            report.doubtful += 1;
            continue;
        };
        let doubted = entry.hits < config.young_hits
            && joint.age_scans(sighting.place) > config.young_scans_per_hit * f32::from(entry.hits);
        let learning = match sighting.place {
            place if doubted => Some(Learning::Line(place)),
            _ if rank < usize::from(config.max_learning) => Some(Learning::All),
            place if rank < usize::from(config.max_taken) => Some(Learning::RobotAndLine(place)),
            _ => None,
        };
        if let Some(learning) = learning {
            let factor = (chi2 / config.kernel_chi2).max(1.0);
            joint.measure(&measurement, factor, gains.map(|gain| gain >= config.least_gain), learning);
        }
        mark_seen(entry, &seen.stamp);
        report.matched += 1;
    }
    let mut pose = joint.settle(start.prior, map);
    for Sighting { pair, .. } in sightings.iter().filter(|s| s.fits) {
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
            joint.add(index, pose.translation.vector, map);
            report.new += 1;
        }
    }
    fuse_walls(seen, config, &mut pose, joint, map, near);
    (pose, report)
}

/// A map segment seen again, for the joint estimate.
struct Sighting {
    pair: Pair,
    /// Of the map segment among the lines tracked.
    place: usize,
    /// What it would tell before anything of this scan is taken in, both [`Weighed::gains`] added.
    gain: f32,
    /// Whether it agrees with what has been measured before it.
    fits: bool,
}

impl Sighting {
    fn new<const N: usize>(
        pair: Pair,
        seen: &Observed<'_>,
        start: &Start<'_>,
        joint: &mut Joint,
        map: &mut SegmentMap<N>,
    ) -> Option<Self> {
        let place = joint.track(pair.mapped, map)?;
        let gain = joint.weigh(&pair.measurement(place, seen, start, map)?).gains.iter().sum();
        Some(Self { pair, place, gain, fits: false })
    }
}

/// How many sightings tell more than one of them. Taken in in that order, those that are least known, and may be wrong, would
/// come first: the order stays that of the scan.
fn rank(sightings: &[Sighting], index: usize) -> usize {
    let gain = sightings.get(index).map_or(0.0, |s| s.gain);
    sightings.iter().enumerate().filter(|(i, s)| s.gain > gain || s.gain == gain && *i < index).count()
}

impl Pair {
    /// What the pair says of the pose and of the line tracked at `place`.
    fn measurement<const N: usize>(
        &self,
        place: usize,
        seen: &Observed<'_>,
        start: &Start<'_>,
        map: &SegmentMap<N>,
    ) -> Option<Measurement> {
        let segment = seen.segments.get(self.observed)?;
        let mapped = &map.segments().get(self.mapped)?.segment;
        let length_m = segment.length_m().min(mapped.length_m());
        let variances = with_line_noise(variances(segment), seen.line_noise, length_m);
        let segment = segment.transformed(start.pose);
        let position = start.prior.translation.vector;
        let mut since_prior = components(start.pose) - components(start.prior);
        since_prior.z = wrap_angle(since_prior.z);
        Some(Measurement::of_pair(place, mapped, &segment, position, &since_prior, variances))
    }
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

/// Fuses each map segment that this scan changed with those that are the same wall. Leaves the segments around the robot in
/// `near`.
fn fuse_walls<const N: usize>(
    seen: &Observed<'_>,
    config: &JointConfig,
    pose: &mut Isometry2<f32>,
    joint: &mut Joint,
    map: &mut SegmentMap<N>,
    near: &mut Nearby<N>,
) {
    near.gather(map.segments(), pose, seen.reach_m, |_| true);
    let mut next = 0;
    while let Some(index) = near.all().get(next).copied().map(usize::from) {
        let Some(changed) = map.segments().get(index).copied() else { break };
        let is_twin = |other: &usize| {
            *other != index
                && map.segments().get(*other).is_some_and(|s| {
                    one_wall(&changed, s, &pose.translation.vector.into(), seen.line_noise, config)
                })
        };
        let twin = (changed.last_seen == seen.stamp.scan)
            .then(|| {
                near.along(changed.segment.direction, config.fuse_max_angle_rad)
                    .map(usize::from)
                    .find(is_twin)
            })
            .flatten();
        let Some(twin) = twin else {
            next += 1;
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
        let grown = if kept == last { gone } else { kept };
        near.gather(map.segments(), pose, seen.reach_m, |_| true);
        let all = near.all();
        next = all.iter().position(|i| usize::from(*i) >= grown).unwrap_or(all.len());
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
    let [kept, gone] = twins.map(|index| joint.track(index, map));
    let [a, b] = twins.map(|index| map.segments().get(index).map(|s| s.segment));
    let (a, b) = (a?, b?);
    let length_m = a.length_m().min(b.length_m());
    let variances = with_line_noise([0.0, 0.0], seen.line_noise, length_m);
    let measurement = Measurement::of_twins((&a, kept?), (&b, gone?), variances);
    (joint.weigh(&measurement).chi2 <= config.fuse_chi2).then(|| {
        joint.measure(&measurement, 1.0, [true; 2], Learning::All);
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
    if !facing || cross(a.direction, b.direction).abs() > config.fuse_max_angle_rad {
        return false;
    }
    // The shorter one is judged by the longer one's line.
    let (long, short) = if a.length_m() >= b.length_m() { (a, b) } else { (b, a) };
    let distance = distance_m(long, short);
    if distance > config.fuse_max_distance_m {
        return false;
    }
    let overlap_m = long.overlap_m(short);
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
        Observed { segments, pairs, stamp: Stamp { scan, way_m: 1.0 }, line_noise: &NOISE, reach_m: 5.6 }
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
        let mut near = Nearby::new();
        register_jointly(&observed(segments, pairs, scan), &start, &config(), joint, map, &mut near).1
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
}
