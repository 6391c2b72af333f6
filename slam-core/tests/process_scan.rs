//! The whole pipeline: it never panics, it is reproducible, and it finds its way in a room.

#![allow(clippy::disallowed_methods)]

mod common;

use common::{BEAMS, Wall, ranges_mm};
use nalgebra::{Isometry2, Point2, Vector2};
use proptest::prelude::*;
use slam_core::geometry::pose::{components, pose};
use slam_core::odometry::Increment;
use slam_core::odometry::track::{SWEEP_KNOTS, ScanMotion};
use slam_core::slam::ScanRejection;
use slam_core::tracking::correction::Verdict;
use slam_core::{Scan, Slam, SlamConfig};

fn configs() -> [SlamConfig; 4] {
    [SlamConfig::default(), SlamConfig::paper(), SlamConfig::paper_weighted(), SlamConfig::paper_partial()]
}

fn still() -> ScanMotion {
    ScanMotion::instantaneous(Increment::identity())
}

fn moved(before_from_after: Isometry2<f32>) -> ScanMotion {
    ScanMotion::instantaneous(Increment::from_motion(before_from_after))
}

/// Both ends of each wall of a room of 6 m by 4.4 m with a box in it.
fn room() -> Vec<Wall> {
    let corners = [(-2.0, -2.2), (4.0, -2.2), (4.0, 2.2), (-2.0, 2.2)];
    let block = [(1.4, -2.2), (1.4, -1.2), (2.2, -1.2), (2.2, -2.2)];
    let walls = (0..4).map(|i| (corners[i], corners[(i + 1) % 4]));
    walls.chain((0..3).map(|i| (block[i], block[i + 1]))).collect()
}

/// Ranges in that room, seen from `map_from_base`.
fn room_scan(config: &SlamConfig, map_from_base: &Isometry2<f32>) -> Vec<u16> {
    ranges_mm(&room(), config, map_from_base, 5.6)
}

/// Distance of a point from the nearest wall of the room.
fn off_walls_m(point: Point2<f32>) -> f32 {
    let distances = room().into_iter().map(|((x1, y1), (x2, y2))| {
        let (from, along) = (Point2::new(x1, y1), Vector2::new(x2 - x1, y2 - y1));
        let share = ((point - from).dot(&along) / along.norm_squared()).clamp(0.0, 1.0);
        (from + along * share - point).norm()
    });
    distances.fold(f32::INFINITY, f32::min)
}

#[test]
fn finds_its_way_round_a_room_with_wrong_odometry() {
    for config in configs() {
        let mut slam = Slam::<64>::new(config).unwrap();
        let mut truth = pose(0.0, 0.0, 0.0);
        let mut worst: f32 = 0.0;
        for k in 0..120 {
            let step = if k == 0 { pose(0.0, 0.0, 0.0) } else { pose(0.04, 0.0, 0.05) };
            truth *= step;
            // The odometry reports 10 % too much way and a tenth too little turn.
            let reported = pose(step.translation.x * 1.1, 0.0, step.rotation.angle() * 0.9);
            let update =
                slam.process_scan(&Scan { ranges_mm: &room_scan(&config, &truth) }, &moved(reported));
            worst = worst.max((update.pose.translation.vector - truth.translation.vector).norm());
        }
        assert!(worst < 0.05, "worst error {worst} m with {:?}", config.extraction);
        assert_eq!(slam.counters().scans, 120);
    }
}

#[test]
fn the_same_input_gives_the_same_bits() {
    for config in configs() {
        let run = || {
            let mut slam = Slam::<64>::new(config).unwrap();
            let mut bits = Vec::new();
            for k in 0..40 {
                let truth = pose(0.02 * k as f32, 0.0, 0.03 * k as f32);
                let update = slam.process_scan(
                    &Scan { ranges_mm: &room_scan(&config, &truth) },
                    &moved(pose(0.02, 0.0, 0.03)),
                );
                bits.extend(components(&update.pose).iter().map(|v| v.to_bits()));
                bits.extend(update.covariance.iter().map(|v| v.to_bits()));
            }
            (bits, slam.map().segments().to_vec())
        };
        assert_eq!(run(), run());
    }
}

#[test]
fn a_small_map_stays_within_its_room_and_says_what_it_dropped() {
    let config = SlamConfig::default();
    let mut slam = Slam::<3>::new(config).unwrap();
    for k in 0..30 {
        slam.process_scan(
            &Scan { ranges_mm: &room_scan(&config, &pose(0.0, 0.0, 0.2 * k as f32)) },
            &moved(pose(0.0, 0.0, 0.2)),
        );
    }
    let counters = slam.map().counters();
    assert_eq!(slam.map().segments().len(), 3);
    assert!(counters.evicted + counters.refused > 0, "{counters:?}");
}

#[test]
fn without_a_scan_worth_anything_the_odometry_carries_on() {
    for config in configs() {
        let mut slam = Slam::<16>::new(config).unwrap();
        slam.process_scan(&Scan { ranges_mm: &[0; BEAMS] }, &still());
        let update = slam.process_scan(&Scan { ranges_mm: &[7; BEAMS] }, &moved(pose(0.5, 0.0, 0.1)));
        assert!((components(&update.pose) - nalgebra::Vector3::new(0.5, 0.0, 0.1)).norm() < 1e-6);
        assert!(!update.corrected);
        assert_eq!(update.observability.verdict, Verdict::Blind);
        assert_eq!((slam.counters().without_segments, slam.counters().uncorrected), (2, 2));
        assert_eq!(update.deskew.bad, BEAMS as u32);
    }
}

#[test]
fn a_scan_of_the_wrong_size_is_counted_and_its_motion_kept() {
    let mut slam = Slam::<16>::new(SlamConfig::default()).unwrap();
    let update = slam.process_scan(&Scan { ranges_mm: &[1000; 17] }, &moved(pose(0.5, 0.0, 0.0)));
    assert_eq!(update.rejected, Some(ScanRejection::WrongBeamCount { expected: BEAMS, actual: 17 }));
    assert!((update.pose.translation.x - 0.5).abs() < 1e-6);
    assert_eq!(slam.counters().wrong_beam_count, 1);
}

#[test]
fn a_motion_that_is_not_a_number_is_counted_and_survived() {
    for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        for config in configs() {
            let mut slam = Slam::<64>::new(config).unwrap();
            let here = pose(0.0, 0.0, 0.0);
            let ranges = room_scan(&config, &here);
            slam.process_scan(&Scan { ranges_mm: &ranges }, &still());
            let mut motion = still();
            motion.since_previous.distance_m = bad;
            slam.process_scan(&Scan { ranges_mm: &ranges }, &motion);
            motion.since_previous.distance_m = 0.0;
            motion.middle_from_knot[3].translation.x = bad;
            let update = slam.process_scan(&Scan { ranges_mm: &ranges }, &motion);
            assert!(update.pose.translation.vector.norm() < 0.02);
            assert_eq!(slam.counters().bad_motion, 2);
        }
    }
}

/// A map made before is recognised by a robot that takes it up, where it is told that it stands.
#[test]
fn a_map_taken_up_is_recognised() {
    let config = SlamConfig::default();
    let mut before = Slam::<64>::new(config).unwrap();
    for _ in 0..10 {
        before.process_scan(
            &Scan { ranges_mm: &room_scan(&config, &pose(0.0, 0.0, 0.0)) },
            &moved(pose(0.0, 0.0, 0.0)),
        );
    }
    let known = before.map().segments().len();
    let mut slam = Slam::<64>::new(config).unwrap();
    let here = pose(0.3, -0.2, 0.4);
    slam.take_up(before.map().segments().iter().copied(), here);
    let update =
        slam.process_scan(&Scan { ranges_mm: &room_scan(&config, &here) }, &moved(pose(0.0, 0.0, 0.0)));
    assert!(update.registration.matched >= 3, "{:?}", update.registration);
    assert!((update.pose.translation.vector - here.translation.vector).norm() < 0.02, "{}", update.pose);
    // And what there is no room for is counted.
    let mut small = Slam::<2>::new(config).unwrap();
    small.take_up(before.map().segments().iter().copied(), here);
    assert_eq!(small.map().counters().refused as usize, known - 2);
}

#[test]
fn each_stage_is_told_as_it_begins_and_watching_changes_nothing() {
    use slam_core::slam::Stage;
    for config in configs() {
        let (mut watched, mut plain) = (Slam::<64>::new(config).unwrap(), Slam::<64>::new(config).unwrap());
        for k in 0..20 {
            let ranges_mm = room_scan(&config, &pose(0.02 * k as f32, 0.0, 0.0));
            let (scan, motion) = (Scan { ranges_mm: &ranges_mm }, moved(pose(0.02, 0.0, 0.0)));
            let mut told = Vec::new();
            let update = watched.process_scan_watched(&scan, &motion, &mut |stage| told.push(stage));
            assert_eq!(components(&update.pose), components(&plain.process_scan(&scan, &motion).pose));
            assert_eq!(told[..3], [Stage::Deskew, Stage::Extraction, Stage::Association]);
            assert_eq!(told.last(), Some(&Stage::Registration));
            assert!(told.contains(&Stage::Correction) && !told.contains(&Stage::Prediction));
        }
    }
}

#[test]
fn size_in_ram_is_stated() {
    let bytes = Slam::<512>::BYTES;
    // 68 bytes a map segment (64 and its index, twice), 16 a beam, 172 for each of 96 places, 40 KiB of the rest.
    assert!(bytes <= 68 * 512 + 16 * BEAMS + 172 * 96 + 40 * 1024, "{bytes}");
}

fn number() -> impl Strategy<Value = f32> {
    prop_oneof![
        4 => -0.3f32..0.3,
        1 => -2000.0f32..2000.0,
        1 => Just(f32::NAN),
        1 => Just(f32::INFINITY),
        1 => Just(f32::NEG_INFINITY),
        1 => Just(f32::MAX),
        1 => Just(0.0),
    ]
}

fn any_pose() -> impl Strategy<Value = Isometry2<f32>> {
    (number(), number(), number()).prop_map(|(x, y, a)| pose(x, y, a))
}

fn any_motion() -> impl Strategy<Value = ScanMotion> {
    (any_pose(), number(), number(), any_pose()).prop_map(
        |(before_from_after, distance_m, turn_rad, knot)| {
            let since_previous = Increment { before_from_after, distance_m, turn_rad };
            ScanMotion { since_previous, middle_from_knot: [knot; SWEEP_KNOTS], sweep_share: 0.0 }
        },
    )
}

fn any_ranges() -> impl Strategy<Value = Vec<u16>> {
    let full = |value: BoxedStrategy<u16>| proptest::collection::vec(value, BEAMS);
    prop_oneof![
        full((0u16..6000).boxed()),
        full(any::<u16>().boxed()),
        full((0u16..20).boxed()),
        full((1900u16..2100).boxed()),
        full(Just(5600).boxed()),
        proptest::collection::vec(any::<u16>(), 0..900),
    ]
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 64, ..ProptestConfig::default() })]

    /// Whatever comes in: no panic, a finite pose, and a map of finite segments. One beam, swapped steps and a map
    /// without room are among the sensors and sizes.
    #[test]
    fn no_input_panics(
        scans in proptest::collection::vec((any_ranges(), any_motion()), 1..8),
        paper in any::<bool>(),
        beams in prop_oneof![Just(BEAMS as u16), Just(2u16), 3u16..BEAMS as u16],
        upside_down in any::<bool>(),
    ) {
        let mut config = if paper { SlamConfig::paper() } else { SlamConfig::default() };
        config.sensor.geometry.last_step = config.sensor.geometry.first_step + beams - 1;
        config.sensor.mounting.upside_down = upside_down;
        let mut slam = Slam::<24>::new(config).unwrap();
        let mut none = Slam::<0>::new(config).unwrap();
        for (ranges, motion) in &scans {
            let cut = ranges.len().min(usize::from(beams));
            for ranges_mm in [&ranges[..cut], &ranges[..]] {
                let update = slam.process_scan(&Scan { ranges_mm }, motion);
                prop_assert!(components(&update.pose).iter().all(|v| v.is_finite()), "{:?}", update.pose);
                none.process_scan(&Scan { ranges_mm }, motion);
            }
            prop_assert!(slam.map().segments().iter().all(|s| s.segment().is_finite()));
        }
    }

    /// A robot a kilometre away, after any number of turns, still knows how it stands in its room.
    #[test]
    fn a_room_far_away_is_a_room(x in -1000.0f32..1000.0, y in -1000.0f32..1000.0, turns in -3.1f32..3.1) {
        let config = SlamConfig::default();
        let mut slam = Slam::<64>::new(config).unwrap();
        let start = pose(x, y, turns);
        slam.process_scan(&Scan { ranges_mm: &[0; BEAMS] }, &moved(start));
        let mut truth = pose(0.0, 0.0, 0.0);
        for _ in 0..20 {
            truth *= pose(0.03, 0.0, 0.3);
            slam.process_scan(&Scan { ranges_mm: &room_scan(&config, &truth) }, &moved(pose(0.03, 0.0, 0.3)));
        }
        // Where the room lies only the odometry has told, within metres. How the robot stands in it is known.
        let room_from_map = truth * slam.pose().inverse();
        let seen_often = slam.map().segments().iter().filter(|s| s.hits >= 10).map(slam_core::MapSegment::segment);
        let walls: Vec<_> = seen_often.map(|s| s.transformed(&room_from_map)).collect();
        prop_assert!(walls.len() >= 4, "{:?}", walls);
        for wall in walls {
            prop_assert!(off_walls_m(wall.start).max(off_walls_m(wall.end)) < 0.08, "{:?}", wall);
        }
        let off = (start * truth).inverse() * slam.pose();
        prop_assert!(off.translation.vector.norm() < 0.5, "{}", off);
    }
}

/// Odometry that is wrong while the scanner sees the whole room: wheels that spin in place, and one wild increment.
#[test]
fn wheels_that_say_otherwise_do_not_move_a_pose_that_the_scan_fixes() {
    let config = SlamConfig::default();
    let ranges_mm = room_scan(&config, &pose(0.0, 0.0, 0.0));
    let standing = || {
        let mut slam = Slam::<64>::new(config).unwrap();
        for _ in 0..12 {
            slam.process_scan(&Scan { ranges_mm: &ranges_mm }, &still());
        }
        slam
    };
    let mut slam = standing();
    let at = |slam: &Slam<64>| slam.pose().translation.vector.norm() + slam.pose().rotation.angle().abs();
    // A metre in vain.
    for _ in 0..30 {
        slam.process_scan(&Scan { ranges_mm: &ranges_mm }, &moved(pose(0.033, 0.0, 0.0)));
        assert!(at(&slam) < 0.05, "{}", slam.pose());
    }
    // A counter that jumps: 0.4 m and 25°.
    let mut slam = standing();
    let update = slam.process_scan(&Scan { ranges_mm: &ranges_mm }, &moved(pose(0.4, 0.0, 0.44)));
    assert!(update.odometry_left_out);
    assert!(at(&slam) < 0.05, "{}", slam.pose());
}

/// Odometry that says nothing: after some way the scanner is followed alone, and that is said.
#[test]
fn without_useful_odometry_the_scanner_is_followed_alone() {
    let config = SlamConfig::default();
    let mut slam = Slam::<64>::new(config).unwrap();
    let mut truth = pose(0.0, 0.0, 0.0);
    let mut useless = false;
    for k in 0..80 {
        if k >= 10 {
            truth *= pose(0.03, 0.0, 0.05);
        }
        let update = slam.process_scan(&Scan { ranges_mm: &room_scan(&config, &truth) }, &still());
        useless |= update.odometry_useless;
        let off = truth.inverse() * slam.pose();
        assert!(off.translation.vector.norm() < 0.08 && off.rotation.angle().abs() < 0.05, "scan {k}: {off}");
    }
    assert!(useless);
}
