use super::*;
use crate::ekf::config::RegistrationConfig;
use crate::geometry::pose::components;
use crate::geometry::pose::{perpendicular, pose};
use crate::geometry::segment::Moments;
use crate::paper::end_points::{EndPointWeight, EndPointsConfig, register_end_points};
use nalgebra::{Matrix3, Vector3};
use std::vec::Vec as StdVec;

const NOISE: LineNoise = LineNoise { sigma_offset_m: 0.005, sigma_direction_rad: 0.002 };
const SENSOR: SensorModel = SensorModel { reach_m: 5.6, line_noise: NOISE };

fn wall(from: (f32, f32), to: (f32, f32)) -> Segment {
    let (from, to) = (Point2::new(from.0, from.1), Point2::new(to.0, to.1));
    let left = nalgebra::center(&from, &to) + perpendicular(to - from);
    let points = (0..40).map(|i| (from + (to - from) * (i as f32 / 39.0), 1e4));
    Segment::fitted(Moments::from_points(points), &[from, to], left)
}

fn config() -> EkfConfig {
    match crate::SlamConfig::default().registration {
        RegistrationConfig::Ekf(config) => config,
        RegistrationConfig::EndPoints(_) => unreachable!("the default is the filter"),
    }
}

fn observed<'a>(segments: &'a [Segment], pairs: &'a [Pair], scan: u32) -> Observed<'a> {
    Observed { segments, pairs, stamp: Stamp { scan, way_m: 1.0 }, sensor: SENSOR }
}

/// A robot that stands at the origin and is sure of it.
fn run<const N: usize>(
    map: &mut SegmentMap<N>,
    filter: &mut EkfSlam,
    segments: &[Segment],
    pairs: &[Pair],
    scan: u32,
) -> RegistrationReport {
    let here = pose(0.0, 0.0, 0.0);
    let at = LinearizationPoint { prior: here, pose: here };
    let mut update = KeyframeUpdate::default();
    let report = update.begin(&observed(segments, pairs, scan), &at, &config(), filter, map);
    update.commit(&SENSOR, &config(), filter, map, &mut Nearby::new()).unwrap();
    report
}

fn filter() -> EkfSlam {
    let mut filter = EkfSlam::new(Vector3::zeros());
    filter.inflate_pose(&(Matrix3::identity() * 1e-6), &mut SegmentMap::<0>::new());
    filter
}

#[test]
fn unmatched_segments_are_added_and_matched_ones_joined() {
    let first = [wall((0.0, 1.0), (2.0, 1.0))];
    let second = [wall((1.0, 1.0), (3.0, 1.0)), wall((3.0, 1.0), (3.0, -1.0))];
    let pairs = [Pair { observed: 0, mapped: 0 }];
    let check = |map: &SegmentMap<8>, reports: [RegistrationReport; 2]| {
        assert_eq!(reports.map(|r| (r.new, r.matched)), [(1, 0), (1, 1)]);
        let joined = &map.segments()[0];
        assert_eq!((joined.hits, joined.segment().moments.inliers), (2, 80));
        assert!((joined.length_m() - 3.0).abs() < 1e-4, "ends are the farthest feet");
    };
    let (mut map, here) = (SegmentMap::new(), pose(0.0, 0.0, 0.0));
    let config = EndPointsConfig { weight: EndPointWeight::Equal };
    let once = register_end_points(&observed(&first, &[], 1), &here, &config, &mut map);
    let twice = register_end_points(&observed(&second, &pairs, 2), &here, &config, &mut map);
    check(&map, [once, twice]);
    let (mut map, mut filter) = (SegmentMap::<8>::new(), filter());
    let once = run(&mut map, &mut filter, &first, &[], 1);
    let twice = run(&mut map, &mut filter, &second, &pairs, 2);
    check(&map, [once, twice]);
}

#[test]
fn one_wall_seen_in_pieces_becomes_one_segment() {
    let (mut map, mut filter) = (SegmentMap::<8>::new(), filter());
    let pieces = [wall((0.0, 1.0), (1.0, 1.0)), wall((2.5, 1.002), (3.5, 1.0)), wall((7.0, 1.0), (8.0, 1.0))];
    run(&mut map, &mut filter, &pieces, &[], 1);
    assert_eq!(map.segments().len(), 3);
    // A look at the middle closes the first gap, not the second.
    let pairs = [Pair { observed: 0, mapped: 0 }];
    run(&mut map, &mut filter, &[wall((0.5, 1.0), (3.0, 1.0))], &pairs, 2);
    let mut lengths: StdVec<f32> = map.segments().iter().map(|s| s.length_m()).collect();
    lengths.sort_by(f32::total_cmp);
    assert_eq!(lengths.len(), 2);
    assert!((lengths[1] - 3.5).abs() < 1e-3);
    assert_eq!(map.counters().fused, 1);
}

/// A robot that has moved, unsure by centimetres, and sees four walls it knows, and one it does not.
struct Keyframe {
    map: SegmentMap<8>,
    filter: EkfSlam,
    update: KeyframeUpdate,
}

/// Four walls, seen from the origin, and a robot that is no longer sure where it is.
fn in_a_room<const N: usize>() -> ([Segment; 4], SegmentMap<N>, EkfSlam) {
    let (mut map, mut filter) = (SegmentMap::<N>::new(), filter());
    let known = [
        wall((3.0, -2.0), (3.0, 2.0)),
        wall((-3.0, 2.0), (3.0, 2.0)),
        wall((-3.0, -2.0), (-3.0, 2.0)),
        wall((-3.0, -2.0), (3.0, -2.0)),
    ];
    run(&mut map, &mut filter, &known, &[], 1);
    filter.inflate_pose(&(Matrix3::identity() * 1e-3), &mut map);
    (known, map, filter)
}

impl Keyframe {
    /// The robot is at `truth`, believes in the origin, and has found `tracked`.
    fn new(truth: f32, tracked: f32) -> Self {
        let (known, mut map, mut filter) = in_a_room::<8>();
        let base_from_map = pose(truth, 0.0, 0.0).inverse();
        let mut seen: StdVec<Segment> = known.iter().map(|s| s.transformed(&base_from_map)).collect();
        let unknown = wall((2.0, -1.0), (2.0, -0.5));
        seen.push(unknown.transformed(&base_from_map));
        let pairs: StdVec<Pair> = (0..4).map(|i| Pair { observed: i, mapped: i }).collect();
        let (prior, pose) = (pose(0.0, 0.0, 0.0), pose(tracked, 0.0, 0.0));
        let mut update = KeyframeUpdate::default();
        let at = LinearizationPoint { prior, pose };
        let report = update.begin(&observed(&seen, &pairs, 2), &at, &config(), &mut filter, &mut map);
        assert_eq!((report.matched, report.new, report.committed), (4, 1, false));
        Self { map, filter, update }
    }

    fn commit(&mut self) -> Isometry2<f32> {
        let (map, filter) = (&mut self.map, &mut self.filter);
        let [_, committed] = self.update.commit(&SENSOR, &config(), filter, map, &mut Nearby::new()).unwrap();
        committed
    }
}

#[test]
fn measurements_taken_in_one_by_one_are_those_taken_in_at_once() {
    let (mut slowly, mut at_once) = (Keyframe::new(0.03, 0.02), Keyframe::new(0.03, 0.02));
    let before = slowly.map.segments().to_vec();
    let mut scans = 0;
    while slowly.update.advance(1, &config(), &mut slowly.filter) {
        scans += 1;
        assert_eq!(slowly.map.segments(), &*before, "the map stays as it was until the commit");
        assert!(slowly.update.is_pending());
    }
    assert_eq!(scans, 4);
    // But for rounding.
    assert!((components(&slowly.commit()) - components(&at_once.commit())).amax() < 1e-6);
    for (a, b) in slowly.map.segments().iter().zip(at_once.map.segments()) {
        assert!((a.segment().start - b.segment().start).norm() < 1e-6);
        assert!((a.segment().end - b.segment().end).norm() < 1e-6);
    }
    let covariance = slowly.filter.pose_covariance();
    assert!((covariance - at_once.filter.pose_covariance()).amax() < 1e-4 * covariance.amax());
    assert!(!slowly.update.is_pending() && slowly.map.segments() != before);
}

/// Wherever the pose was thought to be when a wall was added, it is where the robot saw it from the pose that is committed.
#[test]
fn what_is_new_lies_as_it_was_seen() {
    for tracked in [0.0, 0.02, 0.03, 0.05] {
        let mut keyframe = Keyframe::new(0.03, tracked);
        let committed = keyframe.commit();
        assert!((committed.translation.vector.x - 0.03).abs() < 2e-3, "{tracked}: {committed}");
        let new = keyframe.map.segments()[4].segment().transformed(&committed.inverse());
        assert!((new.midpoint().x - 1.97).abs() < 1e-3, "{tracked}: {new:?}");
    }
}

#[test]
fn a_line_forgotten_before_it_is_taken_in_says_nothing() {
    let (mut whole, mut less) = (Keyframe::new(0.03, 0.03), Keyframe::new(0.03, 0.03));
    // Of the only walls that tell how far ahead the robot is.
    for index in [2, 0] {
        LineMap { map: &mut less.map, filter: &mut less.filter }.remove(index);
    }
    assert!((whole.commit().translation.vector.x - 0.03).abs() < 2e-3);
    assert!(less.commit().translation.vector.x.abs() < 2e-3);
}

fn registered(walls: &[Segment]) -> SegmentMap<8> {
    let (mut map, mut filter) = (SegmentMap::<8>::new(), filter());
    run(&mut map, &mut filter, walls, &[], 1);
    map
}

/// How far apart two pieces of wall lie that keyframes saw 1 cm apart, with 0.9 m between them; the second is so long.
fn apart_m(length_m: f32, keyframes: u32) -> f32 {
    let walls = [wall((0.0, 1.0), (2.0, 1.0)), wall((2.9, 1.01), (2.9 + length_m, 1.01))];
    let pairs = [Pair { observed: 0, mapped: 0 }, Pair { observed: 1, mapped: 1 }];
    let (mut map, mut filter) = (SegmentMap::<8>::new(), filter());
    run(&mut map, &mut filter, &walls, &[], 1);
    for scan in 2..=keyframes {
        run(&mut map, &mut filter, &walls, &pairs, scan);
    }
    assert_eq!(map.segments().len(), 2, "the door stays open");
    let [first, second] = [0, 1].map(|i| map.segments()[i].segment());
    first.line().signed_distance(second.midpoint()).abs()
}

#[test]
fn pieces_on_both_sides_of_a_door_make_each_other_straight() {
    let tentative = u32::from(config().tentative_hits);
    let [young, old] = [tentative - 1, tentative].map(|keyframes| apart_m(2.1, keyframes));
    assert!(old < 0.008, "{old}");
    assert!((young - 0.01).abs() < 1e-3, "what has been seen by a few keyframes may be no wall: {young}");
    let short = apart_m(0.3, tentative);
    assert!((short - 0.01).abs() < 1e-3, "a short thing behind the door is another thing: {short}");
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
    let (mut map, mut filter) = (SegmentMap::<8>::new(), filter());
    run(&mut map, &mut filter, &[wall((0.0, 1.0), (2.0, 1.0))], &[], 1);
    let before = map.segments()[0].segment();
    let pairs = [Pair { observed: 0, mapped: 0 }];
    let report = run(&mut map, &mut filter, &[wall((0.0, 1.3), (2.0, 1.3))], &pairs, 2);
    assert_eq!((report.doubtful, report.new), (1, 0));
    let after = map.segments()[0].segment();
    assert_eq!((after.start, after.end, after.direction), (before.start, before.end, before.direction));
    assert_eq!(map.segments()[0].hits, 1);
}

/// A robot that is three centimetres off sees a fifth wall, and with the next keyframe the four that it knows and two new ones: the
/// fifth is in the state, and as far off as the robot was. Returns map, filter, the new walls as they were seen and the pose at the
/// commit.
fn five_walls_and_two<const N: usize>() -> (SegmentMap<N>, EkfSlam, [Segment; 2], Isometry2<f32>) {
    let (known, mut map, mut filter) = in_a_room::<N>();
    let base_from_map = pose(0.03, 0.0, 0.0).inverse();
    run(&mut map, &mut filter, &[wall((-1.0, 1.0), (-1.0, 1.5)).transformed(&base_from_map)], &[], 2);
    let unknown = [wall((2.0, -1.0), (2.0, -0.5)), wall((1.0, -1.5), (1.5, -1.0))];
    let seen: StdVec<Segment> = known.iter().chain(&unknown).map(|s| s.transformed(&base_from_map)).collect();
    let pairs: StdVec<Pair> = (0..4).map(|i| Pair { observed: i, mapped: i }).collect();
    let at = LinearizationPoint { prior: pose(0.0, 0.0, 0.0), pose: pose(0.02, 0.0, 0.0) };
    let mut update = KeyframeUpdate::default();
    let report = update.begin(&observed(&seen, &pairs, 3), &at, &config(), &mut filter, &mut map);
    assert_eq!((report.matched, report.new), (4, 2));
    update.advance(2, &config(), &mut filter);
    let [_, committed] =
        update.commit(&SENSOR, &config(), &mut filter, &mut map, &mut Nearby::new()).unwrap();
    (map, filter, unknown.map(|s| s.transformed(&base_from_map)), committed)
}

/// To drop a line is to marginalise it out: everything else is as if there had been room.
#[test]
fn a_tracked_line_evicted_between_keyframe_and_commit_gives_its_error_to_nobody() {
    let (full, filter_full, new, pose_full) = five_walls_and_two::<6>();
    let (roomy, filter_roomy, _, pose_roomy) = five_walls_and_two::<8>();
    assert_eq!((full.counters().evicted, roomy.counters().evicted), (1, 0));
    let fifth = roomy.segments()[4].segment().midpoint().x;
    assert!((fifth + 1.0).abs() < 3e-3, "it had an error of three centimetres: {fifth}");
    assert!((components(&pose_full) - components(&pose_roomy)).amax() < 1e-6);
    let covariance = filter_roomy.pose_covariance();
    assert!((filter_full.pose_covariance() - covariance).amax() < 1e-4 * covariance.amax());
    for index in 0..4 {
        let (a, b) = (&full.segments()[index].segment(), &roomy.segments()[index].segment());
        assert!((a.start - b.start).norm() < 1e-5 && (a.end - b.end).norm() < 1e-5, "{index}");
    }
    for seen in new {
        let lies = full.segments()[4..].iter().any(|entry| {
            let in_base = entry.segment().transformed(&pose_full.inverse());
            (in_base.midpoint() - seen.midpoint()).norm() < 1e-3
        });
        assert!(lies, "where it was seen: {seen:?}");
    }
    assert_eq!((0..6).filter_map(|index| filter_full.slot_of(index)).count(), 6);
}
