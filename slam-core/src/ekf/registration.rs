//! What was seen becomes map.
//!
//! In: observed segments in `base`, the corrected pose, the pairs. Out: a changed map. Unmatched segments are added,
//! matched ones joined with their pair.
//!
//! The paper (equation (10), Fig. 6) joins by the line through the four end points. The default hands the pairs to the
//! [`Joint`] estimate, which moves pose and lines together, and fuses map segments that turn out to be one wall.

use heapless::Vec;
use nalgebra::{Isometry2, Point2, Vector3};

use crate::config::SlamConfig;
use crate::ekf::joint::{Joint, Learning, Measurement, Trust, variances, with_variances};
use crate::ekf::keyframe::KeyframeConfig;
use crate::frontend::extraction::MAX_SEGMENTS;
use crate::geometry::math::{max, min};
use crate::geometry::pose::{cross, difference, is_finite};
use crate::geometry::residual::{LineNoise, Residual};
use crate::geometry::segment::Segment;
use crate::map::nearby::Nearby;
use crate::map::{MapSegment, SegmentMap};
use crate::paper::end_points::EndPointsConfig;
use crate::tracking::association::Pair;

/// Most sightings of a keyframe that are taken in.
pub const MAX_TAKEN: usize = 12;
/// Most segments of a keyframe that are made longer once it is settled; others are at once.
const MAX_LONGER: usize = 24;

/// How segments enter the map.
#[derive(Clone, Copy, Debug, PartialEq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize), serde(rename_all = "snake_case"))]
pub enum RegistrationConfig {
    /// Equation (10) and Fig. 6 of the paper.
    EndPoints(EndPointsConfig),
    /// Lines are estimated together with the pose, walls fused.
    Joint(JointConfig),
}

impl RegistrationConfig {
    /// Settings of the joint estimate, where there is one.
    pub(crate) fn joint(&self) -> Option<&JointConfig> {
        match self {
            Self::EndPoints(_) => None,
            Self::Joint(config) => Some(config),
        }
    }
}

/// Settings of the joint estimate.
#[derive(Clone, Copy, Debug, PartialEq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct JointConfig {
    /// Which scans are taken in.
    pub keyframes: KeyframeConfig,
    /// Most sightings that are taken in of a keyframe, those that tell most; no more than [`MAX_TAKEN`].
    pub max_taken: u8,
    /// Most of those from which everything learns; from the others only the robot and the line that was seen.
    pub max_learning: u8,
    /// Most sightings that are taken in during one scan, so that none takes long. They begin with the scan after the
    /// keyframe; where keyframes follow each other, all are taken in at once.
    pub taken_per_scan: u8,
    /// A number that would tell less than this is passed over: variance of what it measures, over its own.
    pub least_gain: f32,
    /// The variances of a segment that is tracked again count so many times. What its error has in common with those of its
    /// neighbours is forgotten; taken for independent, many of them would make the pose surer than it is.
    pub again_factor: f32,
    /// A pair that fits worse than this χ² changes nothing.
    pub max_chi2: f32,
    /// A pair that fits worse than this χ² counts for less: its variance grows with its χ².
    pub kernel_chi2: f32,
    /// A segment seen in fewer scans than this is young. A young one that is seen only now and then may be walking, or
    /// nothing: the pose learns nothing from it.
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

impl JointConfig {
    fn trust(&self) -> Trust {
        Trust { max_chi2: self.max_chi2, kernel_chi2: self.kernel_chi2, least_gain: self.least_gain }
    }
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
    /// Whether the last keyframe was taken in wholly: the map and with it the pose have moved.
    pub settled: bool,
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
    /// What saw them.
    pub eye: Eye,
}

/// What the registration must know of the sensor.
#[derive(Clone, Copy, Debug)]
pub struct Eye {
    /// How far it sees, metres.
    pub reach_m: f32,
    /// Errors of lines beyond their points' noise.
    pub line_noise: LineNoise,
}

impl Eye {
    pub(crate) fn of(config: &SlamConfig) -> Self {
        Self { reach_m: config.sensor.reach_m(), line_noise: config.line_noise }
    }
}

impl Observed<'_> {
    /// The segments without a pair.
    pub(crate) fn unknown(&self) -> impl Iterator<Item = &Segment> {
        let known = |index: usize| self.pairs.iter().any(|p| p.observed == index);
        self.segments.iter().enumerate().filter(move |(index, _)| !known(*index)).map(|(_, s)| s)
    }
}

pub(crate) fn mark_seen(entry: &mut MapSegment, stamp: &Stamp) {
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

impl Start<'_> {
    /// From the prior's (x, y, θ) to the pose's.
    fn since_prior(&self) -> Vector3<f32> {
        difference(self.pose, self.prior)
    }
}

/// The sightings of a keyframe on their way into the joint estimate of the pose, the odometry's errors and the lines.
///
/// The estimate stays at the keyframe until all are taken in, and the map as it was; then pose and lines move at once.
/// What is new enters map and estimate at the end.
#[derive(Clone, Debug, Default)]
pub struct Sightings {
    /// In the order of the scan.
    list: Vec<Sighting, MAX_TAKEN>,
    /// Segments that go on beyond the ends of theirs in the map: the place of that among the lines, and both ends in
    /// `base`.
    longer: Vec<(usize, [Point2<f32>; 2]), MAX_LONGER>,
    /// How many of them have been taken in.
    taken: usize,
    /// Where they were made from, until they are settled.
    made: Option<Made>,
}

/// Where sightings were made from.
#[derive(Clone, Copy, Debug)]
struct Made {
    /// The predicted pose, which the joint estimate has.
    prior: Isometry2<f32>,
    /// The pose through which the pairs were found.
    pose: Isometry2<f32>,
    /// Number of the scan.
    scan: u32,
}

/// A map segment seen again.
#[derive(Clone, Debug)]
struct Sighting {
    measurement: Measurement,
    learning: Learning,
}

impl Sightings {
    /// Whether there are any that have not been settled.
    pub fn wait(&self) -> bool {
        self.made.is_some()
    }

    /// Drops them.
    pub fn clear(&mut self) {
        self.list.clear();
        self.longer.clear();
        (self.taken, self.made) = (0, None);
    }

    /// Makes the sightings of a keyframe, and adds to the map what is not known.
    ///
    /// Work: for each pair some steps, and one for each other pair.
    pub fn make<const N: usize>(
        &mut self,
        seen: &Observed<'_>,
        start: &Start<'_>,
        config: &JointConfig,
        joint: &mut Joint,
        map: &mut SegmentMap<N>,
    ) -> RegistrationReport {
        self.clear();
        self.made = Some(Made { prior: *start.prior, pose: *start.pose, scan: seen.stamp.scan });
        let mut report = RegistrationReport { keyframe: true, ..RegistrationReport::default() };
        // What each would tell; nothing where it does not fit. As many pairs as observed segments at most.
        let mut gains: Vec<Option<f32>, MAX_SEGMENTS> = Vec::new();
        for pair in seen.pairs {
            let gain = joint.track(pair.mapped, config.again_factor, map).and_then(|place| {
                let weighed = joint.weigh(&pair.measurement(place, seen, start, map)?);
                (weighed.chi2 <= config.max_chi2).then(|| weighed.gains.iter().sum())
            });
            let _ = gains.push(gain);
        }
        for (index, pair) in seen.pairs.iter().enumerate() {
            let (Some(rank), Some(place)) = (rank(&gains, index), joint.place_of(pair.mapped)) else {
                report.doubtful += 1;
                continue;
            };
            if rank < usize::from(config.max_taken)
                && let Some(measurement) = pair.measurement(place, seen, start, map)
                && let Some(entry) = map.segments().get(pair.mapped)
            {
                let doubted = entry.hits < config.young_hits
                    && joint.age_scans(place) > config.young_scans_per_hit * f32::from(entry.hits);
                let learning = match place {
                    place if doubted => Learning::Line(place),
                    _ if rank < usize::from(config.max_learning) => Learning::All,
                    place => Learning::RobotAndLine(place),
                };
                // There is room for as many as may be taken.
                let _ = self.list.push(Sighting { measurement, learning });
            }
            if let (Some(segment), Some(entry)) = (seen.segments.get(pair.observed), map.get_mut(pair.mapped))
            {
                mark_seen(entry, &seen.stamp);
                let moments = &mut entry.segment.moments;
                moments.inliers = moments.inliers.saturating_add(segment.moments.inliers);
                let ends = [segment.start, segment.end];
                let longer = entry.segment.extended(ends.map(|end| start.pose * end));
                if longer.length_m() > entry.segment.length_m() && self.longer.push((place, ends)).is_err() {
                    entry.segment = longer;
                }
            }
            report.matched += 1;
        }
        for segment in seen.unknown() {
            let [var_offset, var_direction] =
                with_line_noise(variances(segment), &seen.eye.line_noise, segment.length_m());
            let segment = with_variances(&segment.transformed(start.pose), var_offset, var_direction);
            if segment.is_finite()
                && let Some(index) = map.insert(segment, seen.stamp.scan, seen.stamp.way_m)
            {
                joint.replaced(index, map);
                report.new += 1;
            }
        }
        report
    }

    /// Takes in so many of them; false where none was left.
    ///
    /// Work: for each from which everything learns the square of the number of states tracked, for the others that number.
    pub fn take_in(&mut self, most: usize, config: &JointConfig, joint: &mut Joint) -> bool {
        let end = self.list.len().min(self.taken.saturating_add(most));
        let now = self.list.get(self.taken..end).unwrap_or_default();
        joint.measure_all(now.iter().map(|s| (&s.measurement, s.learning)), &config.trust());
        self.taken = end;
        !now.is_empty()
    }

    /// Takes in what is left, moves pose and lines, and fuses walls. Returns the keyframe's pose as it was thought to be,
    /// and as it is; in `near` the map segments around it. `None` where there is nothing to settle.
    ///
    /// Work: for the lines tracked one step each; for each new segment the number of states tracked; for fusing, one step
    /// for each map segment that was seen and each one around the robot, and one for each map segment.
    pub fn settle<const N: usize>(
        &mut self,
        eye: &Eye,
        config: &JointConfig,
        joint: &mut Joint,
        map: &mut SegmentMap<N>,
        near: &mut Nearby<N>,
    ) -> Option<[Isometry2<f32>; 2]> {
        self.take_in(MAX_TAKEN, config, joint);
        let Made { prior, pose, scan } = self.made.take()?;
        let mut settled = joint.settle(&prior, map);
        for &(place, ends) in &self.longer {
            if let Some(entry) = joint.owner(place).and_then(|index| map.get_mut(index)) {
                let longer = entry.segment.extended(ends.map(|end| settled * end));
                if longer.is_finite() {
                    entry.segment = longer;
                }
            }
        }
        // What is new lies as it was seen from where the robot was.
        let moved = settled * pose.inverse();
        for index in 0..map.segments().len() {
            let Some(entry) = map.get_mut(index).filter(|e| e.last_seen == scan && e.hits == 1) else {
                continue;
            };
            let segment = entry.segment.transformed(&moved);
            if segment.is_finite() {
                entry.segment = segment;
                joint.add(index, settled.translation.vector, map);
            }
        }
        fuse_walls(scan, eye, config, &mut settled, joint, map, near);
        Some([pose, if is_finite(&settled) { settled } else { pose }])
    }
}

/// How many pairs tell more than one of them, which must tell something. Taken in in that order, those that are least
/// known, and may be wrong, would come first: the order stays that of the scan.
fn rank(gains: &[Option<f32>], index: usize) -> Option<usize> {
    let gain = gains.get(index).copied().flatten()?;
    let more =
        |(i, other): &(usize, &Option<f32>)| other.is_some_and(|o| o > gain || o == gain && *i < index);
    Some(gains.iter().enumerate().filter(more).count())
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
        let length_m = min(segment.length_m(), mapped.length_m());
        let variances = with_line_noise(variances(segment), &seen.eye.line_noise, length_m);
        let segment = segment.transformed(start.pose);
        let position = start.prior.translation.vector;
        Some(Measurement::of_pair(place, mapped, &segment, position, &start.since_prior(), variances))
    }
}

fn with_line_noise([offset, direction]: [f32; 2], noise: &LineNoise, length_m: f32) -> [f32; 2] {
    [offset + noise.var_offset(), direction + noise.var_direction(length_m)]
}

/// Fuses each map segment that a scan saw with those that are the same wall. Leaves the segments around the robot in
/// `near`.
fn fuse_walls<const N: usize>(
    scan: u32,
    eye: &Eye,
    config: &JointConfig,
    pose: &mut Isometry2<f32>,
    joint: &mut Joint,
    map: &mut SegmentMap<N>,
    near: &mut Nearby<N>,
) {
    near.gather(map.segments(), pose, eye.reach_m, |_| true);
    let mut next = 0;
    while let Some(index) = near.all().get(next).copied().map(usize::from) {
        let Some(changed) = map.segments().get(index).copied() else { break };
        let is_twin = |other: &usize| {
            *other != index
                && map.segments().get(*other).is_some_and(|s| {
                    one_wall(&changed, s, &pose.translation.vector.into(), &eye.line_noise, config)
                })
        };
        let twin = (changed.last_seen == scan)
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
        if let Some(settled) = agree([kept, gone], eye, config, pose, joint, map) {
            *pose = settled;
        }
        map.fuse(kept, gone);
        let last = map.segments().len();
        joint.removed(gone, last, map);
        // The grown segment is looked at again, wherever it went.
        let grown = if kept == last { gone } else { kept };
        near.gather(map.segments(), pose, eye.reach_m, |_| true);
        let all = near.all();
        next = all.iter().position(|i| usize::from(*i) >= grown).unwrap_or(all.len());
    }
}

/// Measures that two map segments are one line, unless they disagree. Returns the pose by that.
fn agree<const N: usize>(
    twins: [usize; 2],
    eye: &Eye,
    config: &JointConfig,
    pose: &Isometry2<f32>,
    joint: &mut Joint,
    map: &mut SegmentMap<N>,
) -> Option<Isometry2<f32>> {
    let [kept, gone] = twins.map(|index| joint.track(index, config.again_factor, map));
    let [a, b] = twins.map(|index| map.segments().get(index).map(|s| s.segment));
    let (a, b) = (a?, b?);
    let length_m = min(a.length_m(), b.length_m());
    let variances = with_line_noise([0.0, 0.0], &eye.line_noise, length_m);
    let measurement = Measurement::of_twins((&a, kept?), (&b, gone?), variances);
    let trust = Trust { max_chi2: config.fuse_chi2, kernel_chi2: f32::INFINITY, least_gain: 0.0 };
    joint.measure(&measurement, &trust, Learning::All).then(|| joint.settle(pose, map))
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
    let gap_m = max(config.fuse_gap_m, min(short.length_m(), config.fuse_max_gap_m));
    hides || overlap_m >= -gap_m && agrees()
}

/// Distance of the farther end of `short` from the line of `long`, metres.
fn distance_m(long: &Segment, short: &Segment) -> f32 {
    let line = long.line();
    max(line.signed_distance(short.start).abs(), line.signed_distance(short.end).abs())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::pose::components;
    use crate::geometry::pose::{perpendicular, pose};
    use crate::geometry::segment::Moments;
    use crate::paper::end_points::{EndPointWeight, register_end_points};
    use nalgebra::{Matrix3, Vector3};
    use std::vec::Vec as StdVec;

    const NOISE: LineNoise = LineNoise { sigma_offset_m: 0.005, sigma_direction_rad: 0.002 };
    const EYE: Eye = Eye { reach_m: 5.6, line_noise: NOISE };

    fn wall(from: (f32, f32), to: (f32, f32)) -> Segment {
        let (from, to) = (Point2::new(from.0, from.1), Point2::new(to.0, to.1));
        let left = nalgebra::center(&from, &to) + perpendicular(to - from);
        let points = (0..40).map(|i| (from + (to - from) * (i as f32 / 39.0), 1e4));
        Segment::fitted(Moments::from_points(points), &[from, to], left)
    }

    fn config() -> JointConfig {
        match crate::SlamConfig::default().registration {
            RegistrationConfig::Joint(config) => config,
            RegistrationConfig::EndPoints(_) => unreachable!("the default estimates jointly"),
        }
    }

    fn observed<'a>(segments: &'a [Segment], pairs: &'a [Pair], scan: u32) -> Observed<'a> {
        Observed { segments, pairs, stamp: Stamp { scan, way_m: 1.0 }, eye: EYE }
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
        let mut sightings = Sightings::default();
        let report = sightings.make(&observed(segments, pairs, scan), &start, &config(), joint, map);
        sightings.settle(&EYE, &config(), joint, map, &mut Nearby::new()).unwrap();
        report
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
        let config = EndPointsConfig { weight: EndPointWeight::Equal };
        let once = register_end_points(&observed(&first, &[], 1), &here, &config, &mut map);
        let twice = register_end_points(&observed(&second, &pairs, 2), &here, &config, &mut map);
        check(&map, [once, twice]);
        let (mut map, mut joint) = (SegmentMap::new(), joint());
        let once = run(&mut map, &mut joint, &first, &[], 1);
        let twice = run(&mut map, &mut joint, &second, &pairs, 2);
        check(&map, [once, twice]);
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

    /// A robot that has moved, unsure by centimetres, and sees four walls it knows, and one it does not.
    struct Keyframe {
        map: SegmentMap<8>,
        joint: Joint,
        sightings: Sightings,
    }

    impl Keyframe {
        /// The robot is at `truth`, believes in the origin, and has found `tracked`.
        fn new(truth: f32, tracked: f32) -> Self {
            let (mut map, mut joint) = (SegmentMap::new(), joint());
            let known = [
                wall((3.0, -2.0), (3.0, 2.0)),
                wall((-3.0, 2.0), (3.0, 2.0)),
                wall((-3.0, -2.0), (-3.0, 2.0)),
                wall((-3.0, -2.0), (3.0, -2.0)),
            ];
            run(&mut map, &mut joint, &known, &[], 1);
            joint.loosen_pose(&(Matrix3::identity() * 1e-3), &mut map);
            let base_from_map = pose(truth, 0.0, 0.0).inverse();
            let mut seen: StdVec<Segment> = known.iter().map(|s| s.transformed(&base_from_map)).collect();
            let unknown = wall((2.0, -1.0), (2.0, -0.5));
            seen.push(unknown.transformed(&base_from_map));
            let pairs: StdVec<Pair> = (0..4).map(|i| Pair { observed: i, mapped: i }).collect();
            let (prior, pose) = (pose(0.0, 0.0, 0.0), pose(tracked, 0.0, 0.0));
            let mut sightings = Sightings::default();
            let start = Start { prior: &prior, pose: &pose };
            let report = sightings.make(&observed(&seen, &pairs, 2), &start, &config(), &mut joint, &mut map);
            assert_eq!((report.matched, report.new, report.settled), (4, 1, false));
            Self { map, joint, sightings }
        }

        fn settle(&mut self) -> Isometry2<f32> {
            let (map, joint) = (&mut self.map, &mut self.joint);
            let [_, settled] =
                self.sightings.settle(&EYE, &config(), joint, map, &mut Nearby::new()).unwrap();
            settled
        }
    }

    #[test]
    fn sightings_taken_in_one_by_one_are_those_taken_in_at_once() {
        let (mut slowly, mut at_once) = (Keyframe::new(0.03, 0.02), Keyframe::new(0.03, 0.02));
        let before = slowly.map.segments().to_vec();
        let mut scans = 0;
        while slowly.sightings.take_in(1, &config(), &mut slowly.joint) {
            scans += 1;
            assert_eq!(slowly.map.segments(), &*before, "the map stays as it was until they are settled");
            assert!(slowly.sightings.wait());
        }
        assert_eq!(scans, 4);
        // But for rounding.
        assert!((components(&slowly.settle()) - components(&at_once.settle())).amax() < 1e-6);
        for (a, b) in slowly.map.segments().iter().zip(at_once.map.segments()) {
            assert!((a.segment.start - b.segment.start).norm() < 1e-6);
            assert!((a.segment.end - b.segment.end).norm() < 1e-6);
        }
        let covariance = slowly.joint.pose_covariance();
        assert!((covariance - at_once.joint.pose_covariance()).amax() < 1e-4 * covariance.amax());
        assert!(!slowly.sightings.wait() && slowly.map.segments() != before);
    }

    /// Wherever the pose was thought to be when a wall was added, it is where the robot saw it from the pose that is settled.
    #[test]
    fn what_is_new_lies_as_it_was_seen() {
        for tracked in [0.0, 0.02, 0.03, 0.05] {
            let mut keyframe = Keyframe::new(0.03, tracked);
            let settled = keyframe.settle();
            assert!((settled.translation.vector.x - 0.03).abs() < 2e-3, "{tracked}: {settled}");
            let new = keyframe.map.segments()[4].segment.transformed(&settled.inverse());
            assert!((new.midpoint().x - 1.97).abs() < 1e-3, "{tracked}: {new:?}");
        }
    }

    #[test]
    fn a_line_forgotten_before_it_is_taken_in_says_nothing() {
        let (mut whole, mut less) = (Keyframe::new(0.03, 0.03), Keyframe::new(0.03, 0.03));
        // Of the only walls that tell how far ahead the robot is.
        for index in [2, 0] {
            less.map.forget(index);
            let last = less.map.segments().len();
            less.joint.removed(index, last, &mut less.map);
        }
        assert!((whole.settle().translation.vector.x - 0.03).abs() < 2e-3);
        assert!(less.settle().translation.vector.x.abs() < 2e-3);
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
