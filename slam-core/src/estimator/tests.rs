use super::*;
use crate::geometry::pose::{components, difference, exp, pose};
use crate::places::Places;
use nalgebra::Point2;

/// All that an estimator works with, around a robot that has seen nothing.
struct Robot {
    config: SlamConfig,
    odometry: OdometryHealth,
    map: SegmentMap<8>,
    tracker: Tracker<8>,
    estimator: Estimator,
}

impl Robot {
    fn new(config: SlamConfig) -> Self {
        let mut estimator = Estimator::blank();
        estimator.prepare(&config);
        let odometry = OdometryHealth::new(config.line_noise, config.odometry.noise);
        Self { config, odometry, map: SegmentMap::new(), tracker: Tracker::new(), estimator }
    }

    fn with<'a>(&'a mut self, observed: &'a [Segment]) -> (&'a mut Estimator, Surroundings<'a, 8>) {
        let Self { config, odometry, map, tracker, estimator } = self;
        (estimator, Surroundings { config, odometry, observed, map, tracker })
    }

    /// A scan that changes nothing of the pose.
    fn see(&mut self, observed: &[Segment]) -> RegistrationReport {
        let (estimator, mut around) = self.with(observed);
        let update = SlamUpdate::predicted(&estimator.local(), TrackingState::Tracking);
        let report = estimator.register(&update, &mut around);
        estimator.end_scan();
        report
    }

    fn go(&mut self, x: f32, y: f32, turn: f32) -> bool {
        let (estimator, mut around) = self.with(&[]);
        let increment = Increment::from_motion(pose(x, y, turn));
        estimator.predict(&ScanMotion::instantaneous(increment), &mut around)
    }
}

fn wall() -> Segment {
    Segment::from_ends(Point2::new(2.0, -1.0), Point2::new(2.0, 1.0), 40, 1e-4, Point2::origin())
}

#[test]
fn the_motion_s_jacobian_is_the_finite_difference() {
    let mut robot = Robot::new(SlamConfig::default());
    let (estimator, around) = robot.with(&[]);
    let increment = Increment::from_motion(pose(0.3, 0.05, 0.4));
    for from in [Vector3::new(1.0, -2.0, 0.7), Vector3::new(-3.0, 0.5, 3.1)] {
        let at = |off: Vector3<f32>| {
            let c = from + off;
            estimator.moved(&pose(c.x, c.y, c.z), &increment, around.odometry, around.config)
        };
        let by_pose = at(Vector3::zeros()).by_pose;
        let h = 1e-2;
        for k in 0..3 {
            let step = Vector3::ith(k, h);
            let slope = difference(&at(step).pose, &at(-step).pose) / (2.0 * h);
            assert!((slope - by_pose.column(k)).norm() < 1e-3, "{k}: {slope} {by_pose}");
        }
    }
}

/// Over the way between keyframes. The Jacobian takes a turn as spread over the way, which is off by a twelfth of its square.
#[test]
fn the_motion_s_jacobian_by_the_odometry_s_errors_is_the_finite_difference() {
    let mut robot = Robot::new(SlamConfig::default());
    let (estimator, around) = robot.with(&[]);
    let motions = [(0.15, 0.0), (-0.15, 0.1), (0.1, -0.15), (0.0, 0.2), (0.15, 0.15)];
    for (forward, turn) in motions {
        let increment = Increment::from_motion(exp(&Vector3::new(forward, 0.0, turn)));
        for heading in [0.0, 0.7, -2.0, 3.1] {
            let from = pose(1.0, -0.5, heading);
            let jacobian = by_odometry(&from, &increment);
            let h = 0.05;
            for k in 0..3 {
                let mut at = |error: f32| {
                    let bias = OdometryBias(Vector3::ith(k, error));
                    estimator.filter.as_mut().unwrap().set_bias(bias);
                    estimator.moved(&from, &increment, around.odometry, around.config).pose
                };
                let slope = difference(&at(h), &at(-h)) / (2.0 * h);
                let off = slope - jacobian.column(k);
                assert!(off.norm() < 3e-4, "{k} of {forward} {turn}: {slope} {jacobian}");
            }
        }
    }
}

#[test]
fn a_motion_that_is_no_number_leaves_the_robot_unsure_where_it_was() {
    for config in [SlamConfig::default(), SlamConfig::paper()] {
        let mut robot = Robot::new(config);
        assert!(robot.go(0.3, 0.0, 0.1));
        let before = robot.estimator.pose();
        assert!(!robot.go(f32::NAN, 0.0, 0.0));
        assert_eq!(components(&robot.estimator.pose()), components(&before));
        assert_eq!(robot.estimator.local().covariance, Matrix3::identity());
        let covariance = robot.estimator.covariance(&config.line_noise);
        assert!(covariance.m11 >= 1.0 && covariance.m33 >= 0.25, "{covariance}");
        assert!(robot.go(0.1, 0.0, 0.0));
    }
}

#[test]
fn pose_and_lines_move_at_once_and_only_once() {
    let mut robot = Robot::new(SlamConfig::default());
    assert_eq!(robot.see(&[wall()]).new, 1);
    let at_first = robot.map.segments()[0].segment();
    // Two decimetres by the odometry, and a centimetre more by the wall.
    assert!(robot.go(0.1, 0.0, 0.0) && robot.go(0.1, 0.0, 0.0));
    robot.tracker.pairs.push(crate::tracking::association::Pair { observed: 0, mapped: 0 }).unwrap();
    let seen = wall().transformed(&pose(-0.21, 0.0, 0.0));
    assert_eq!(robot.see(&[seen]).matched, 1);
    assert_eq!(robot.map.segments()[0].segment().midpoint(), at_first.midpoint(), "not yet");
    let before = robot.estimator.pose();
    let (estimator, mut around) = robot.with(&[]);
    estimator.commit(&mut around);
    let after = robot.estimator.pose();
    let gone_on = (before.inverse() * after).translation.vector.x;
    let pushed = (robot.map.segments()[0].segment().midpoint() - at_first.midpoint()).x;
    assert!(gone_on > 0.0 && pushed < 0.0, "both give way: {gone_on} {pushed}");
    let (estimator, mut around) = robot.with(&[]);
    estimator.commit(&mut around);
    assert_eq!(components(&robot.estimator.pose()), components(&after));
}

#[test]
fn what_is_local_moves_as_one_and_old_lines_stay_with_their_places() {
    let mut robot = Robot::new(SlamConfig::default());
    robot.see(&[wall()]);
    (0..20).for_each(|_| assert!(robot.go(1.0, 0.0, 0.0)));
    robot.see(&[wall()]);
    let (estimator, mut around) = robot.with(&[]);
    estimator.commit(&mut around);
    let seen = |robot: &Robot| {
        let base_from_map = robot.estimator.pose().inverse();
        base_from_map * robot.map.segments()[1].segment().midpoint()
    };
    let (old, new) = (robot.map.segments()[0].segment(), seen(&robot));
    let before = (robot.estimator.pose(), robot.estimator.local().covariance.determinant());
    let moved = pose(0.5, -0.3, 0.2);
    let (estimator, mut around) = robot.with(&[]);
    estimator.carry(&moved, &Places::<96>::new(), &mut around);
    assert_eq!(robot.map.segments()[0].segment().midpoint(), old.midpoint(), "no place has moved");
    assert!((seen(&robot) - new).norm() < 1e-5);
    assert!(
        (robot.estimator.pose().translation.vector - (moved * before.0).translation.vector).norm() < 1e-5
    );
    let determinant = robot.estimator.local().covariance.determinant();
    assert!((determinant - before.1).abs() <= 1e-2 * before.1, "{determinant} {}", before.1);
}

#[test]
fn size_is_what_the_documentation_says() {
    assert!(core::mem::size_of::<Estimator>() <= 24 * 1024, "{}", core::mem::size_of::<Estimator>());
}
