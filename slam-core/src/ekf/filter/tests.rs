use super::*;
use crate::ekf::world::World;

/// There and back, over more walls than are tracked: the pose's error is as large as the covariance says.
#[test]
fn the_covariance_is_that_of_the_error() {
    let runs = 60;
    let (mut out, mut back) = (0.0, 0.0);
    for seed in 0..runs {
        let mut world = World::new(seed);
        let bias = Vector3::new(0.02 * world.gauss.draw(), 0.0, 0.01 * world.gauss.draw());
        world.look();
        (0..100).for_each(|_| world.step(0.1, bias));
        out += world.nees() / runs as f32;
        (0..90).for_each(|_| world.step(-0.1, bias));
        back += world.nees() / runs as f32;
    }
    // Mean of 60 samples of χ² with three degrees of freedom: 3 ± 0.32.
    assert!((2.2..4.0).contains(&out), "going out: {out}");
    assert!((2.0..4.5).contains(&back), "coming back: {back}");
}

/// New walls say where they are, never where the robot is: without anything known before, it grows only less sure.
#[test]
fn new_walls_do_not_make_the_robot_surer() {
    let mut world = World::new(3);
    world.look();
    let mut last = 0.0;
    for k in 0..120 {
        world.step(0.1, Vector3::zeros());
        let sigma = world.filter.pose_covariance().m11.sqrt();
        if k % 30 == 29 {
            assert!(sigma > last, "after {k} steps {sigma}, before {last}");
            last = sigma;
        }
    }
}

#[test]
fn the_odometry_s_errors_are_learnt() {
    let mut world = World::new(5);
    world.look();
    let bias = Vector3::new(0.03, 0.0, 0.01);
    (0..150).for_each(|k| world.step(if k < 100 { 0.1 } else { -0.1 }, bias));
    let learnt = world.filter.bias().0;
    assert!((learnt.x - 0.03).abs() < 0.015 && (learnt.z - 0.01).abs() < 0.007, "{learnt}");
}

#[test]
fn variances_that_rounding_spoilt_are_survived() {
    for spoilt in [-1e-3, f32::NAN, f32::INFINITY, 0.0] {
        let mut world = World::new(4);
        world.look();
        for state in FIRST_LINE..world.filter.covariance.live() {
            world.filter.covariance.set(state, state, spoilt);
        }
        let pose = world.filter.commit(&world.believed, &mut world.map);
        assert!(crate::geometry::pose::is_finite(&pose));
        assert!(world.map.segments().iter().all(|s| s.segment().is_finite()), "{spoilt}");
    }
}

#[test]
fn size_is_what_the_documentation_says() {
    assert!(core::mem::size_of::<EkfSlam>() <= 22 * 1024, "{}", core::mem::size_of::<EkfSlam>());
}

/// Against G·P·Gᵀ, with G the rotation of x and y.
#[test]
fn a_turned_map_turns_the_position_s_error_and_nothing_else() {
    for angle in [0.0, 0.3, -1.2, 3.0f32] {
        let mut world = World::new(5);
        world.look();
        (0..40).for_each(|_| world.step(0.1, Vector3::zeros()));
        let before = world.filter.clone();
        world.filter.turn_pose(angle);
        let (s, c) = angle.sin_cos();
        let live = before.covariance.live();
        let dense =
            nalgebra::DMatrix::<f64>::from_fn(live, live, |i, j| f64::from(before.covariance.get(i, j)));
        let mut turn = nalgebra::DMatrix::<f64>::identity(live, live);
        let (s, c) = (f64::from(s), f64::from(c));
        for (i, j, v) in [(0, 0, c), (0, 1, -s), (1, 0, s), (1, 1, c)] {
            turn[(POSE + i, POSE + j)] = v;
        }
        let expected = &turn * dense * turn.transpose();
        for i in 0..live {
            for j in 0..=i {
                let off = f64::from(world.filter.covariance.get(i, j)) - expected[(i, j)];
                assert!(off.abs() < 1e-6 + 1e-3 * expected[(i, j)].abs(), "{angle}: {i} {j} {off}");
            }
        }
    }
}
