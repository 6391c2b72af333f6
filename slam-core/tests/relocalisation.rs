//! A robot that is lifted and put down elsewhere finds itself, or says that it does not know.

#![allow(clippy::disallowed_methods)]

mod common;

use common::{Wall, ranges_mm};
use nalgebra::{Isometry2, Point2};
use slam_core::geometry::pose::pose;
use slam_core::map::store::{StoredLine, StoredLoop, StoredMap, StoredPlace};
use slam_core::odometry::Increment;
use slam_core::relocalisation::SearchState;
use slam_core::tracking::TrackingState;
use slam_core::{Scan, ScanMotion, Slam, SlamConfig, SlamUpdate};

/// How far the scanner sees, metres.
const REACH_M: f32 = 4.0;

/// A room of 5 m by 4 m whose lower left corner is there, with a cupboard, a shelf askew and a recess; its door leads down.
fn room(x: f32, y: f32) -> Vec<Wall> {
    let walls = [
        ((0.0, 0.0), (2.0, 0.0)),
        ((3.0, 0.0), (5.0, 0.0)),
        ((5.0, 0.0), (5.0, 4.0)),
        ((5.0, 4.0), (3.2, 4.0)),
        ((3.2, 4.0), (3.2, 4.4)),
        ((3.2, 4.4), (1.5, 4.4)),
        ((1.5, 4.4), (1.5, 4.0)),
        ((1.5, 4.0), (0.0, 4.0)),
        ((0.0, 4.0), (0.0, 0.0)),
        ((5.0, 1.2), (4.3, 1.2)),
        ((4.3, 1.2), (4.3, 2.1)),
        ((4.3, 2.1), (5.0, 2.1)),
        ((0.0, 2.6), (0.9, 3.1)),
    ];
    walls.map(|((ax, ay), (bx, by))| ((ax + x, ay + y), (bx + x, by + y))).to_vec()
}

/// Two rooms alike on a corridor, which a cabinet at its right end tells apart.
fn twins() -> Vec<Wall> {
    let mut walls = [room(0.0, 1.5), room(5.0, 1.5)].concat();
    walls.extend([((0.0, 0.0), (10.0, 0.0)), ((10.0, 0.0), (10.0, 1.5)), ((0.0, 1.5), (0.0, 0.0))]);
    walls.extend([((9.0, 0.0), (9.0, 0.5)), ((9.0, 0.5), (9.6, 0.5)), ((9.6, 0.5), (9.6, 0.0))]);
    walls
}

struct Drive {
    walls: Vec<Wall>,
    config: SlamConfig,
    slam: Box<Slam<128>>,
    start: Isometry2<f32>,
    truth: Isometry2<f32>,
}

impl Drive {
    fn new(walls: Vec<Wall>, start: Isometry2<f32>) -> Self {
        let config = SlamConfig::default();
        Self { walls, config, slam: Box::new(Slam::new(config).unwrap()), start, truth: start }
    }

    fn step(&mut self, motion: Isometry2<f32>) -> SlamUpdate {
        self.truth *= motion;
        let ranges_mm = ranges_mm(&self.walls, &self.config, &self.truth, REACH_M);
        let motion = ScanMotion::instantaneous(Increment::from_motion(motion));
        self.slam.process_scan(&Scan { ranges_mm: &ranges_mm }, &motion)
    }

    /// Turns towards a point and drives there.
    fn to(&mut self, x: f32, y: f32) -> Vec<SlamUpdate> {
        let mut updates = Vec::new();
        for _ in 0..400 {
            let ahead = self.truth.inverse() * Point2::new(x, y);
            let angle = ahead.y.atan2(ahead.x);
            if ahead.coords.norm() < 0.05 {
                break;
            }
            let turn = angle.clamp(-0.12, 0.12);
            updates.push(self.step(pose(if angle.abs() < 0.2 { 0.04 } else { 0.0 }, 0.0, turn)));
        }
        updates
    }

    fn stand(&mut self, scans: usize) -> Vec<SlamUpdate> {
        (0..scans).map(|_| self.step(pose(0.0, 0.0, 0.0))).collect()
    }

    fn off(&self) -> (f32, f32) {
        let off = self.start.inv_mul(&self.truth).inv_mul(&self.slam.pose());
        (off.translation.vector.norm(), off.rotation.angle().abs())
    }
}

fn found(updates: &[SlamUpdate]) -> Option<usize> {
    updates.iter().position(|u| u.relocalisation.is_some_and(|r| r.state == SearchState::Found))
}

#[test]
fn a_lifted_robot_says_that_it_is_lost_and_finds_itself() {
    let mut drive = Drive::new(room(0.0, 0.0), pose(1.0, 1.0, 0.0));
    for (x, y) in [(3.5, 1.0), (3.5, 3.0), (1.5, 3.0), (1.5, 1.0), (3.5, 1.0)] {
        drive.to(x, y);
    }
    assert!(drive.off().0 < 0.05 && drive.slam.state() == TrackingState::Tracking);
    let lines = drive.slam.map().segments().len();
    drive.truth = pose(1.2, 3.2, -2.0);
    let standing = drive.stand(8);
    assert!(standing.iter().any(|u| u.state == TrackingState::Lost), "it does not notice");
    let driving = drive.to(3.0, 2.8);
    let scans = found(&driving).expect("it does not find itself");
    assert!(scans < 50, "after {scans} scans");
    let (off_m, off_rad) = drive.off();
    assert!(off_m < 0.05 && off_rad < 0.03, "{off_m} {off_rad}");
    assert_eq!((drive.slam.state(), drive.slam.counters().relocalised), (TrackingState::Tracking, 1));
    let now = drive.slam.map().segments().len();
    assert!(now <= lines + 3, "it has drawn what it saw where it was not: {lines} lines, {now} now");
}

#[test]
fn in_two_rooms_alike_it_is_not_sure_until_it_has_left() {
    let mut drive = Drive::new(twins(), pose(0.6, 0.75, 0.0));
    for x in [2.5, 7.5, 2.5] {
        for (dx, y) in [(0.0, 0.75), (0.0, 2.5), (1.0, 4.0), (-1.0, 4.0), (0.0, 2.5), (0.0, 0.75)] {
            drive.to(x + dx, y);
        }
    }
    drive.to(8.2, 0.75);
    drive.to(2.5, 0.75);
    assert!(drive.off().0 < 0.1, "{:?}", drive.off());
    // From the corridor into the right one of both.
    drive.truth = pose(7.5, 3.5, 2.0);
    assert!(drive.stand(8).iter().any(|u| u.state == TrackingState::Lost));
    let inside = [drive.to(6.5, 4.5), drive.to(8.2, 4.2), drive.to(7.5, 2.8)].concat();
    assert_eq!(found(&inside), None, "nothing in there tells which it is");
    assert_eq!(drive.slam.state(), TrackingState::Lost);
    let hypotheses = drive.slam.pose_hypotheses().iter().filter(|g| g.support > 0.8).count();
    assert!(hypotheses >= 2, "{hypotheses}");
    let outside = [drive.to(7.5, 0.75), drive.to(8.2, 0.75), drive.to(7.0, 0.75)].concat();
    assert!(found(&outside).is_some() && drive.off().0 < 0.1, "{:?}", drive.off());
}

#[test]
fn where_nothing_has_been_mapped_it_goes_on_in_the_end() {
    let mut walls = room(0.0, 0.0);
    walls.extend(twins().iter().map(|&((ax, ay), (bx, by))| ((ax * 0.7, ay + 50.0), (bx * 0.7, by + 50.0))));
    let mut drive = Drive::new(walls, pose(1.0, 1.0, 0.0));
    for (x, y) in [(3.5, 1.0), (3.5, 3.0), (1.5, 3.0)] {
        drive.to(x, y);
    }
    drive.truth = pose(1.0, 50.7, 0.0);
    let mut updates = drive.stand(8);
    for _ in 0..3 {
        updates.extend(drive.to(5.0, 50.7));
        updates.extend(drive.to(1.0, 50.7));
    }
    let last = updates.iter().rev().find_map(|u| u.relocalisation).expect("it was lost");
    assert_eq!((last.state, found(&updates)), (SearchState::GivenUp, None));
    let given_up = updates.iter().find(|u| u.relocalisation.is_some_and(|r| r.state == SearchState::GivenUp));
    assert_eq!(given_up.map(|u| u.state), Some(TrackingState::Uncertain));
    assert_eq!((drive.slam.counters().gave_up, drive.slam.pose_hypotheses().len()), (1, 0));
}

#[test]
fn a_robot_that_may_be_anywhere_asks_to_be_found() {
    let mut drive = Drive::new(room(0.0, 0.0), pose(1.0, 1.0, 0.0));
    for (x, y) in [(3.5, 1.0), (3.5, 3.0), (1.5, 3.0)] {
        drive.to(x, y);
    }
    drive.slam.relocalise();
    assert_eq!(drive.slam.state(), TrackingState::Lost);
    let driving = [drive.to(2.5, 1.0), drive.to(3.5, 1.0)].concat();
    assert!(found(&driving).is_some() && drive.off().0 < 0.05, "{:?}", drive.off());
    // The paper knows nothing of it.
    let mut paper = Slam::<64>::new(SlamConfig::paper()).unwrap();
    paper.relocalise();
    assert_eq!(paper.state(), TrackingState::Tracking);
}

/// A map as it was saved.
fn stored(slam: &Slam<128>) -> (Vec<StoredLine>, Vec<StoredPlace>, Vec<StoredLoop>) {
    (slam.stored_lines().collect(), slam.stored_places().collect(), slam.stored_loops().collect())
}

#[test]
fn a_saved_map_is_driven_in_and_goes_on() {
    let mut first = Drive::new(room(0.0, 0.0), pose(1.0, 1.0, 0.0));
    for (x, y) in [(3.5, 1.0), (3.5, 3.0), (1.5, 3.0), (1.5, 1.0), (3.5, 1.0)] {
        first.to(x, y);
    }
    let (lines, places, loops) = stored(&first.slam);
    let map = StoredMap {
        lines: &lines,
        places: &places,
        loops: &loops,
        way_m: first.slam.way_m(),
        odometry_bias: first.slam.odometry_bias(),
    };
    let begin = pose(3.2, 2.6, 2.0);
    for (known, mapping) in [(false, false), (true, false), (true, true), (false, true)] {
        let mut drive = Drive::new(room(0.0, 0.0), pose(1.0, 1.0, 0.0));
        drive.truth = begin;
        let at = drive.start.inv_mul(&begin);
        drive.slam.load(&map, known.then_some(at)).unwrap();
        drive.slam.set_mapping(mapping);
        let before = drive.slam.map().segments().to_vec();
        assert_eq!((drive.slam.state() == TrackingState::Lost, drive.slam.is_mapping()), (!known, mapping));
        let updates = [drive.to(1.5, 3.0), drive.to(1.5, 1.0), drive.to(3.5, 1.2)].concat();
        assert_eq!(found(&updates).is_some(), !known);
        assert_eq!(drive.slam.state(), TrackingState::Tracking);
        let (off_m, off_rad) = drive.off();
        assert!(off_m < 0.05 && off_rad < 0.03, "{known} {mapping}: {off_m} {off_rad}");
        assert_eq!(drive.slam.map().segments() == before, !mapping, "{known}");
        assert!(drive.slam.way_m() > map.way_m + 3.0);
    }
}

#[test]
fn a_map_that_cannot_be_used_changes_nothing() {
    let mut drive = Drive::new(room(0.0, 0.0), pose(1.0, 1.0, 0.0));
    for (x, y) in [(3.5, 1.0), (3.5, 3.0), (1.5, 3.0)] {
        drive.to(x, y);
    }
    let (lines, places, loops) = stored(&drive.slam);
    let whole = StoredMap {
        lines: &lines,
        places: &places,
        loops: &loops,
        way_m: drive.slam.way_m(),
        odometry_bias: drive.slam.odometry_bias(),
    };
    let mut bad_lines = lines.clone();
    bad_lines[1].end_m = bad_lines[1].start_m;
    let mut bad_places = places.clone();
    bad_places[0].way_m = f32::NAN;
    let many = vec![lines[0]; 129];
    let edge = StoredLoop { from: 0, to: 99, measured: [0.0; 3], covariance: [1.0, 0.0, 0.0, 1.0, 0.0, 1.0] };
    let before = (drive.slam.map().segments().to_vec(), drive.slam.pose());
    for (map, says) in [
        (StoredMap { lines: &bad_lines, ..whole }, "lines[1] has a number that makes no sense"),
        (StoredMap { places: &bad_places, ..whole }, "places[0] has a number that makes no sense"),
        (StoredMap { loops: &[edge], ..whole }, "loops[0] has a number that makes no sense"),
        (StoredMap { lines: &many, ..whole }, "the map has 129 lines, there is room for 128"),
        (
            StoredMap { places: &[], ..whole },
            "the map has no places to look for the robot: say where it stands",
        ),
        (StoredMap { way_m: f32::INFINITY, ..whole }, "way_m or odometry_bias makes no sense"),
    ] {
        assert_eq!(drive.slam.load(&map, None).unwrap_err().to_string(), says);
    }
    assert_eq!((drive.slam.map().segments().to_vec(), drive.slam.pose()), before);
    assert_eq!(drive.slam.state(), TrackingState::Tracking);
}

#[test]
fn motions_that_are_no_numbers_and_scans_that_are_none_are_survived() {
    let mut drive = Drive::new(room(0.0, 0.0), pose(1.0, 1.0, 0.0));
    for (x, y) in [(3.5, 1.0), (3.5, 3.0), (1.5, 3.0)] {
        drive.to(x, y);
    }
    drive.slam.relocalise();
    drive.stand(3);
    assert!(!drive.slam.pose_hypotheses().is_empty());
    let mut broken = ScanMotion::instantaneous(Increment::identity());
    broken.since_previous.before_from_after.translation.x = f32::NAN;
    let ranges_mm = ranges_mm(&drive.walls, &drive.config, &drive.truth, REACH_M);
    drive.slam.process_scan(&Scan { ranges_mm: &ranges_mm }, &broken);
    drive.slam.process_scan(&Scan { ranges_mm: &[] }, &broken);
    // What is coasted on while scans stay away moves the hypotheses too.
    drive.stand(3);
    drive.truth *= pose(0.2, 0.0, 0.1);
    drive.slam.coast(&Increment::from_motion(pose(0.2, 0.0, 0.1)));
    let is_known =
        |drive: &Drive| drive.slam.pose_hypotheses().iter().any(|g| g.scans > 0 && g.support > 0.8);
    drive.stand(1);
    assert!(is_known(&drive));
    let driving = [drive.to(2.5, 1.0), drive.to(3.5, 1.0)].concat();
    assert!(found(&driving).is_some() && drive.off().0 < 0.05, "{:?}", drive.off());
}
