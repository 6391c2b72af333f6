//! Robots that drive, see what is around them, and drift.

use super::*;
use crate::geometry::pose::{components, exp, normalized};
use crate::geometry::segment::Segment;
use crate::map::fixtures::line;
use nalgebra::Vector3;

const CONFIG: PlacesConfig = crate::config::PLACES;

/// Things of many sizes and directions along both sides of a way round a block of `w` by `h` metres.
fn building(w: f32, h: f32) -> std::vec::Vec<Segment> {
    let mut seed = 3u32;
    let mut random = || {
        seed = seed.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (seed >> 8) as f32 / (1 << 24) as f32
    };
    let mut walls = std::vec::Vec::new();
    let round = 2.0 * (w + h);
    for k in 0..(round / 1.5) as usize {
        let at = along(1.5 * k as f32, w, h);
        let side = if k % 2 == 0 { 1.5 + random() } else { -1.5 - random() };
        let from = at * Point2::new(random(), side);
        let (s, c) = (core::f32::consts::TAU * random()).sin_cos();
        let length = 0.5 + 1.5 * random();
        walls.push(line((from.x, from.y), (from.x + c * length, from.y + s * length), 9).segment());
    }
    walls
}

/// Where a robot is after a way round the block.
fn along(way: f32, w: f32, h: f32) -> Isometry2<f32> {
    let way = way % (2.0 * (w + h));
    let quarter = core::f32::consts::FRAC_PI_2;
    match way {
        d if d < w => pose(d, 0.0, 0.0),
        d if d < w + h => pose(w, d - w, quarter),
        d if d < 2.0 * w + h => pose(2.0 * w + h - d, h, 2.0 * quarter),
        d => pose(0.0, 2.0 * (w + h) - d, -quarter),
    }
}

struct Drive {
    places: std::boxed::Box<Places<96>>,
    truth: Isometry2<f32>,
    estimate: Isometry2<f32>,
    way_m: f32,
    closures: usize,
    /// What was believed at each scan, moved with its places.
    path: std::vec::Vec<(f32, Isometry2<f32>, Isometry2<f32>)>,
}

impl Drive {
    fn new() -> Self {
        let places = std::boxed::Box::new(Places::new());
        let (truth, estimate) = (Isometry2::identity(), Isometry2::identity());
        Self { places, truth, estimate, way_m: 0.0, closures: 0, path: std::vec::Vec::new() }
    }

    /// To a true pose, with so much drift.
    fn go(&mut self, to: Isometry2<f32>, drift: Vector3<f32>, building: &[Segment]) {
        let motion = self.truth.inv_mul(&to);
        self.estimate = normalized(&(self.estimate * motion * exp(&drift)));
        self.truth = to;
        let motion = Increment::from_motion(motion);
        self.way_m += motion.distance_m;
        // The local map: what is around, as the robot believes it to lie.
        let map_from_truth = self.estimate * to.inverse();
        let near = |s: &&Segment| (s.midpoint().coords - to.translation.vector).norm() < 6.0;
        let entry = |s: &Segment| MapSegment::new(&s.transformed(&map_from_truth), 9, 1, self.way_m);
        let map: std::vec::Vec<_> = building.iter().filter(near).map(entry).collect();
        let (pose, way_m) = (self.estimate, self.way_m);
        self.path.push((way_m, pose, to));
        let visit =
            Visit { pose, motion, way_m, verdict: Verdict::Full, support: 0.9, map: &map, walls: None };
        self.places.visit(&visit, &CONFIG);
        if let Some(closure) = self.places.step(&visit, &CONFIG) {
            self.closures += 1;
            self.estimate = closure.moved * self.estimate;
            for (way_m, pose, _) in &mut self.path {
                *pose = self.places.moved_pose(*way_m, pose);
            }
        }
    }

    fn worst_m(&self) -> f32 {
        let off = |(_, a, b): &(f32, Isometry2<f32>, Isometry2<f32>)| {
            (a.translation.vector - b.translation.vector).norm()
        };
        self.path.iter().map(off).fold(0.0, f32::max)
    }
}

#[test]
fn a_robot_that_drifts_comes_home() {
    let building = building(40.0, 20.0);
    let mut drive = Drive::new();
    let drift = Vector3::new(0.0004, 0.0, 0.00006);
    (0..1000).for_each(|k| drive.go(along(0.15 * k as f32, 40.0, 20.0), drift, &building));
    assert!(drive.closures > 0 && drive.places.loops().len() >= 2, "{} loops", drive.places.loops().len());
    let home = (drive.estimate.translation.vector - drive.truth.translation.vector).norm();
    // The first places had drifted by a decimetre before anything could be recognised.
    assert!(home < 0.2, "{home}");
    assert!(drive.worst_m() < 0.3, "{}", drive.worst_m());
    let moved = drive.path.last().unwrap().1.translation.vector - drive.estimate.translation.vector;
    assert!(moved.norm() < 0.05, "what is local moves with the robot: {moved}");
}

#[test]
fn a_robot_that_goes_straight_on_closes_nothing() {
    let building = building(150.0, 30.0);
    let mut drive = Drive::new();
    let drift = Vector3::new(0.0004, 0.0, 0.00006);
    (0..900).for_each(|k| drive.go(along(0.15 * k as f32, 150.0, 30.0), drift, &building));
    assert_eq!((drive.closures, drive.places.loops().len()), (0, 0));
}

#[test]
fn more_way_than_there_is_room_for_thins_the_chain() {
    let building = building(40.0, 20.0);
    let mut drive = Drive::new();
    let drift = Vector3::new(0.0003, 0.0, 0.00005);
    (0..5500).for_each(|k| drive.go(along(0.15 * k as f32, 40.0, 20.0), drift, &building));
    assert!(drive.places.anchors().len() >= 90 && drive.places.loops().len() == LOOPS);
    assert!(drive.worst_m() < 0.4, "{}", drive.worst_m());
    let ways = drive.places.anchors().windows(2).map(|two| two[1].way_m() - two[0].way_m());
    assert!(ways.fold(0.0, f32::max) < 40.0, "no hole in the chain");
    let is_finite = |anchor: &Anchor| components(&anchor.pose()).iter().all(|v| v.is_finite());
    assert!(drive.places.anchors().iter().all(is_finite));
}

/// Variances of the edge between two places, with that motion between them where no scan was taken in.
fn variances(unseen: Option<Increment>) -> [f32; 3] {
    let mut places = std::boxed::Box::new(Places::<96>::new());
    for way_m in [0.0, 4.0] {
        let motion = Increment::from_motion(pose(way_m, 0.0, 0.0));
        let pose = pose(way_m, 0.0, 0.0);
        places.visit(
            &Visit { pose, motion, way_m, verdict: Verdict::Full, support: 0.9, map: &[], walls: None },
            &CONFIG,
        );
        unseen.iter().for_each(|motion| places.pass_blindly(motion));
    }
    places.chain.anchors[1].variances
}

#[test]
fn way_that_no_scan_saw_makes_the_chain_unsure_and_no_number_does_not_spoil_it() {
    let seen = variances(None);
    for unseen in [pose(3.0, 0.0, 0.0), pose(f32::NAN, 0.0, 0.0)] {
        let blind = variances(Some(Increment::from_motion(unseen)));
        assert!((0..3).all(|k| blind[k] > 10.0 * seen[k] && blind[k] < 1.0), "{blind:?} {seen:?}");
    }
}

#[test]
fn a_keyframe_takes_a_step_but_not_the_only_one_twice_in_a_row() {
    let mut places = std::boxed::Box::new(Places::<96>::new());
    let [slow, fast] = [0.01, 0.3].map(|m| Increment::from_motion(pose(m, 0.0, 0.0)));
    let mut steps =
        |motion, keyframes: [bool; 4]| keyframes.map(|is_keyframe| places.steps(motion, is_keyframe));
    assert_eq!(steps(&slow, [true; 4]), [0, 1, 0, 1]);
    assert_eq!(steps(&slow, [false, true, false, true]), [1, 0, 1, 0]);
    let [first, second, third, _] = steps(&fast, [false, true, true, true]);
    assert!(first > 2 && second == first - 1 && third == second, "{first} {second} {third}");
}

#[test]
fn size_is_what_the_documentation_says() {
    let bytes = Places::<96>::BYTES;
    assert!(bytes <= 172 * 96 + 10 * 1024, "{bytes}");
}

#[test]
fn a_reset_keeps_places_that_are_whole() {
    let building = building(40.0, 20.0);
    let mut drive = Drive::new();
    let drift = Vector3::new(0.0004, 0.0, 0.00006);
    (0..1000).for_each(|k| drive.go(along(0.15 * k as f32, 40.0, 20.0), drift, &building));
    let (places, loops) = (drive.places.anchors().len(), drive.places.loops().len());
    assert!(loops > 1);
    drive.places.moved_all();
    let whole = drive.places.clone();
    drive.places.recover();
    assert_eq!((drive.places.anchors().len(), drive.places.loops().len()), (places, loops));
    (1000..1400).for_each(|k| drive.go(along(0.15 * k as f32, 40.0, 20.0), drift, &building));
    assert!((drive.estimate.translation.vector - drive.truth.translation.vector).norm() < 0.3);
    // Two of the same, as a reset in the middle of a removal leaves them; a number that is none; a reset while places move.
    let twice = |places: &mut Places<96>| places.chain.anchors[4] = places.chain.anchors[5].clone();
    let none = |places: &mut Places<96>| places.chain.anchors[4].pose.translation.x = f32::NAN;
    let edge = |places: &mut Places<96>| places.loops[0].to = 500;
    let moving = |places: &mut Places<96>| places.is_moving = true;
    for harm in [&twice as &dyn Fn(&mut Places<96>), &none, &edge, &moving] {
        let mut places = whole.clone();
        harm(&mut places);
        places.recover();
        assert!(places.anchors().is_empty() && places.loops().is_empty());
    }
}
