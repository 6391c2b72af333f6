//! Drives without a scanner: what the mapper makes of ticks, motions, resets and gaps.

use nalgebra::Vector3;

use super::*;
use crate::geometry::pose::components;
use crate::odometry::Integration;

const DRIVE: DifferentialDrive = DifferentialDrive {
    left_wheel_radius_m: 0.05,
    right_wheel_radius_m: 0.05,
    track_m: 0.3,
    ticks_per_turn: 2000.0,
};

fn mapper() -> Mapper<64, 64> {
    Mapper::new(SlamConfig::default(), DRIVE).unwrap()
}

/// Straight on, 200 samples a second, ten ticks each.
fn ticks(k: u64) -> WheelTicks {
    // Across the wrap of 32 bits.
    let at = (i32::MAX - 500).wrapping_add(10 * k as i32);
    WheelTicks { stamp_us: 5_000 * k, left: at, right: at }
}

/// What ten ticks are, metres.
const STEP_M: f32 = 10.0 / 2000.0 * core::f32::consts::TAU * 0.05;

#[test]
fn without_scans_it_goes_on_by_odometry_and_says_how_sure_it_is() {
    let mut mapper = mapper();
    assert_eq!(mapper.coast(u64::MAX), None);
    for k in 0..1000 {
        mapper.push(ticks(k));
        if k % 20 == 19 {
            mapper.coast(u64::MAX).unwrap();
        }
    }
    let x = mapper.slam().pose().translation.x;
    assert!((x - 999.0 * STEP_M).abs() < 1e-3, "{x}");
    assert_eq!(mapper.slam().counters().coasted, 50);
    assert!(mapper.slam().covariance().m11 > 1e-6);
    assert_eq!(mapper.coast(u64::MAX), None);
}

#[test]
fn after_a_reset_the_pose_goes_on_by_the_ticks_with_less_certainty() {
    let mut mapper = mapper();
    for k in 0..100 {
        mapper.push(ticks(k));
    }
    mapper.coast(u64::MAX).unwrap();
    let before = (components(&mapper.slam().pose()), mapper.slam().covariance());
    mapper.resume();
    // The clock has begun anew; ten samples were lost.
    mapper.push(WheelTicks { stamp_us: 7, ..ticks(110) });
    mapper.push(WheelTicks { stamp_us: 5_007, ..ticks(111) });
    mapper.coast(u64::MAX).unwrap();
    let moved = components(&mapper.slam().pose()) - before.0;
    assert!((moved - Vector3::new(12.0 * STEP_M, 0.0, 0.0)).norm() < 1e-4, "{moved}");
    let grown = mapper.slam().covariance() - before.1;
    assert!(grown.m11 > 3.9e-4 && grown.m33 > 3.9e-4, "{grown}");
    assert_eq!(mapper.counters().resumed, 1);
}

#[test]
fn what_the_wheels_turned_while_the_firmware_hung_is_motion() {
    let mut mapper = mapper();
    for k in 0..100 {
        mapper.push(ticks(k));
    }
    mapper.coast(u64::MAX).unwrap();
    let before = mapper.slam().pose().translation.x;
    mapper.resume();
    // 3 s at 0.31 m/s went by.
    mapper.push(WheelTicks { stamp_us: 7, ..ticks(700) });
    mapper.push(WheelTicks { stamp_us: 5_007, ..ticks(701) });
    mapper.coast(u64::MAX).unwrap();
    let moved = mapper.slam().pose().translation.x - before;
    assert!((moved - 602.0 * STEP_M).abs() < 1e-3, "{moved}");
    assert_eq!(mapper.counters().impossible_steps, 0);
}

#[test]
fn a_reset_in_the_middle_of_a_scan_keeps_what_is_whole() {
    let mut mapper = mapper();
    for k in 0..100 {
        mapper.push(ticks(k));
    }
    for scan in 0..3 {
        mapper.scan(200_000 + 100_000 * scan, &[1500; 682]).unwrap();
    }
    let segments = mapper.slam().map().segments().len();
    assert!(segments > 3);
    assert!(mapper.recover());
    mapper.push(WheelTicks { stamp_us: 7, ..ticks(110) });
    assert_eq!(mapper.slam().map().segments().len(), segments);
    assert!(mapper.slam().covariance().m11 > 24e-4);
    // And it goes on.
    mapper.push(WheelTicks { stamp_us: 100_007, ..ticks(111) });
    assert!(mapper.scan(60_000, &[1500; 682]).unwrap().corrected);
}

#[test]
fn counters_that_restart_are_no_motion() {
    let mut mapper = mapper();
    // Ten metres on the counters, then from zero on.
    for k in 0..200 {
        let ticks = if k < 100 { 64_000 + 10 * k as i32 } else { 10 * (k as i32 - 100) };
        mapper.push(WheelTicks { stamp_us: 5_000 * k, left: ticks, right: ticks });
        if k % 20 == 19 {
            mapper.coast(u64::MAX).unwrap();
        }
    }
    assert_eq!((mapper.counters().impossible_steps, mapper.counters().counters_restarted), (1, 1));
    let x = mapper.slam().pose().translation.x;
    assert!((x - 198.0 * STEP_M).abs() < 1e-3, "{x}");
}

#[test]
fn what_cannot_be_used_is_counted() {
    let mut mapper = mapper();
    assert!(mapper.scan(1_000, &[1000; 682]).is_none());
    mapper.push(ticks(4));
    mapper.push(ticks(3));
    mapper.push(ticks(4));
    assert!(mapper.scan(30_000, &[1000; 682]).is_some());
    // Older than the pose.
    assert!(mapper.scan(1_000, &[1000; 682]).is_none());
    let expected =
        MapperCounters { stamps_refused: 2, scans_without_odometry: 2, ..MapperCounters::default() };
    assert_eq!(mapper.counters(), expected);
    // The ticks of a refused sample are not lost.
    mapper.push(ticks(5));
    assert_eq!(mapper.last_ticks(), Some(ticks(5)));
}

/// A curve, 10 samples to the scan.
fn curve(mapper: &mut Mapper<64, 64>, samples: core::ops::Range<u64>) -> Vector3<f32> {
    for k in samples.clone() {
        mapper.push(WheelTicks { stamp_us: 5_000 * k, left: 6 * k as i32, right: 10 * k as i32 });
    }
    let middle_us = 5_000 * (samples.end - 1);
    let motion = mapper.motion(middle_us).unwrap();
    mapper.scan(middle_us, &[0; 682]).unwrap();
    components(&motion.since_previous.before_from_after)
}

#[test]
fn a_gap_between_scans_is_bridged_however_few_samples_the_track_holds() {
    let mut mapper = mapper();
    assert_eq!(curve(&mut mapper, 0..10), Vector3::zeros(), "the map begins at the first scan");
    // The closed form of an arc of 1000 samples, in f64.
    let moved = curve(&mut mapper, 10..1010);
    let (way, turn) = (1000.0 * f64::from(STEP_M) * 0.8, 1000.0 * f64::from(STEP_M) * 0.4 / 0.3);
    let (x, y) = (way / turn * turn.sin(), way / turn * (1.0 - turn.cos()));
    let heading = turn.sin().atan2(turn.cos());
    for (got, want) in moved.iter().zip([x, y, heading]) {
        assert!((f64::from(*got) - want).abs() < 1e-3, "{moved} {x} {y} {heading}");
    }
    // And coasting takes it up too.
    for k in 1010..1500 {
        mapper.push(WheelTicks { stamp_us: 5_000 * k, left: 6 * k as i32, right: 10 * k as i32 });
    }
    let before = mapper.slam().pose();
    mapper.coast(u64::MAX).unwrap();
    let turned = components(&(before.inverse() * mapper.slam().pose())).z;
    let turn = 490.0 * f64::from(STEP_M) * 0.4 / 0.3;
    assert!((f64::from(turned) - turn.sin().atan2(turn.cos())).abs() < 1e-2, "{turned} {turn}");
}

#[test]
fn a_delay_that_cannot_be_is_refused_by_name() {
    let refused = |break_it: fn(&mut crate::odometry::delay::DelayConfig)| {
        let mut config = SlamConfig::default();
        break_it(config.odometry.delay.as_mut().unwrap());
        Mapper::<64, 64>::new(config, DRIVE).err()
    };
    let named = |field| Some(ConfigError::Invalid { field });
    assert_eq!(refused(|d| d.sigma_s = 0.0), named("odometry.delay.sigma_s"));
    assert_eq!(refused(|d| d.max_s = f32::NAN), named("odometry.delay.max_s"));
    assert_eq!(refused(|d| d.max_sigma_s = -1.0), named("odometry.delay.max_sigma_s"));
    assert_eq!(refused(|d| d.significance = f32::INFINITY), named("odometry.delay.significance"));
    assert!(refused(|_| ()).is_none());
}

/// A robot that turns to and fro, whose scans are stamped late: the lookup follows, and coasting with it.
#[test]
fn scans_are_looked_up_by_the_delay_that_was_found() {
    let late_us = 40_000;
    let rate = |t: f64| 0.8 * (libm::sin(2.0 * t) + 0.5 * libm::sin(3.1 * t));
    // Its integral, in f64.
    let heading = |t: f64| 0.8 * (0.5 * (1.0 - libm::cos(2.0 * t)) + 0.5 / 3.1 * (1.0 - libm::cos(3.1 * t)));
    assert!((heading(1.001) - heading(1.0) - 0.001 * rate(1.0005)).abs() < 1e-6);
    let mut mapper = Mapper::<64, 64>::new(SlamConfig::default(), None).unwrap();
    // A square room, seen from its middle and from a scanner in it.
    let mounting = mapper.slam().config().sensor.mounting.base_from_laser;
    let geometry = mapper.slam().config().sensor.geometry;
    let mut said = 0.0;
    for k in 0..12_000u64 {
        let stamp_us = 10_000 * k;
        let turned = heading(stamp_us as f64 * 1e-6) - said;
        said += turned;
        let moved = Increment::from_motion(crate::geometry::pose::pose(0.0, 0.0, turned as f32));
        mapper.push_motion(stamp_us, moved);
        // What was taken 0.15 s ago is delivered.
        if k % 10 == 0 && k > 40 {
            let taken_s = (stamp_us - 150_000) as f64 * 1e-6;
            let ranges: [u16; 682] = core::array::from_fn(|beam| {
                let at_s = taken_s + (beam as f64 - 340.5) / 1024.0 * 0.1;
                let map_from_laser = crate::geometry::pose::pose(0.0, 0.0, heading(at_s) as f32) * mounting;
                let way = map_from_laser.rotation * Isometry2::rotation(geometry.bearing(beam));
                let (c, s) = (way.rotation.re, way.rotation.im);
                let from = map_from_laser.translation.vector;
                let to_wall = |from: f32, along: f32, half: f32| {
                    if along.abs() < 1e-6 { f32::MAX } else { (half * along.signum() - from) / along }
                };
                (1000.0 * to_wall(from.x, c, 1.7).min(to_wall(from.y, s, 2.3))) as u16
            });
            let middle_us = stamp_us - 150_000 + late_us;
            mapper.scan(middle_us, &ranges).unwrap();
            assert_eq!(mapper.pose_us(), Some(middle_us));
        }
    }
    let delay = mapper.delay().unwrap();
    assert!((delay.delay_s - 0.04).abs() < 0.008 && delay.used, "{delay:?}");
    // On the scans' clock.
    let pose_us = mapper.pose_us().unwrap();
    assert!(mapper.coast(pose_us - 5_000).is_none() && mapper.coast(pose_us + 20_000).is_some());
    assert_eq!(mapper.pose_us(), Some(pose_us + 20_000));
    assert!(mapper.motion(pose_us).is_none());
}

#[test]
fn motions_and_ticks_say_the_same() {
    let (mut by_ticks, mut by_motions) =
        (mapper(), Mapper::<64, 64>::new(SlamConfig::default(), None).unwrap());
    for scan in 0..5u64 {
        for k in 20 * scan..20 * scan + 20 {
            by_ticks.push(ticks(k));
            let moved = if k == 0 { 0 } else { 10 };
            by_motions.push_motion(5_000 * k, DRIVE.increment(moved, moved, Integration::Arc));
        }
        let middle_us = 100_000 * scan + 50_000;
        let motions = [by_ticks.motion(middle_us), by_motions.motion(middle_us)];
        assert_eq!(motions[0], motions[1]);
        let poses = [&mut by_ticks, &mut by_motions].map(|m| m.scan(middle_us, &[1500; 682]).unwrap().pose);
        assert_eq!(poses[0], poses[1]);
    }
    by_motions.push_motion(500_000, Increment::from_motion(crate::geometry::pose::pose(3.0, 0.0, 0.0)));
    assert_eq!(by_motions.counters().impossible_steps, 1);
    // Ticks without wheels are no motion.
    by_motions.push(ticks(110));
    by_motions.push(ticks(120));
    let before = by_motions.slam().pose();
    assert!(by_motions.coast(600_000).is_some());
    assert!((by_motions.slam().pose().translation.vector - before.translation.vector).norm() < 0.2);
}

#[test]
fn counters_of_sixteen_bits_wrap_in_the_upper_half() {
    let drive = DifferentialDrive { ticks_per_turn: DRIVE.ticks_per_turn * 65_536.0, ..DRIVE };
    let (mut wide, mut narrow) = (mapper(), Mapper::<64, 64>::new(SlamConfig::default(), drive).unwrap());
    for k in 0..40u64 {
        wide.push(ticks(k));
        let at = (65_300 + 10 * k) as u16;
        let upper = i32::from(at as i16) << 16;
        narrow.push(WheelTicks { stamp_us: 5_000 * k, left: upper, right: upper });
    }
    assert_eq!(wide.motion(150_000), narrow.motion(150_000));
    assert_eq!(narrow.counters().impossible_steps, 0);
}

#[test]
fn without_odometry_a_scan_may_have_come_from_as_far_as_a_robot_drives() {
    let mut mapper = Mapper::<64, 64>::new(SlamConfig::default(), None).unwrap();
    assert_eq!(mapper.motion(100_000), None);
    for (middle_us, since_s) in [(100_000, 0.0), (300_000, 0.2)] {
        let motion = mapper.unknown_motion(middle_us);
        assert!((motion.since_previous.turn_rad - UNKNOWN_SPEED[1] * since_s).abs() < 1e-6);
        assert!((motion.since_previous.distance_m - UNKNOWN_SPEED[0] * since_s).abs() < 1e-6);
        mapper.scan_with(middle_us, &[1500; 682], &motion);
    }
    assert_eq!(mapper.slam().counters().scans, 2);
}

#[test]
fn a_revolution_that_is_measured_is_what_the_sweep_takes() {
    let mut mapper = mapper();
    (0..60).for_each(|k| mapper.push(ticks(k)));
    // Where the base was at the first beam, in the base at the middle one, by the speed alone.
    let first_x = |mapper: &Mapper<64, 64>| {
        mapper.motion(150_000).unwrap().middle_from_knot[0].translation.x / (STEP_M / 5_000.0)
    };
    let half_sweep_us = |revolution_us: f32| 681.0 / 1024.0 * revolution_us / 2.0;
    assert!((first_x(&mapper) + half_sweep_us(100_000.0)).abs() < 5.0, "{}", first_x(&mapper));
    for measured_us in [97_000, 103_000] {
        mapper.set_revolution_us(measured_us);
        let expected_us = half_sweep_us(measured_us as f32);
        assert!((first_x(&mapper) + expected_us).abs() < 5.0, "{} {expected_us}", first_x(&mapper));
    }
    mapper.set_revolution_us(0);
    assert_eq!(mapper.slam().config().sensor.geometry.revolution_us, 103_000);
    // A scanner whose beams count as simultaneous stays one.
    let mut sensor = mapper.slam().config().sensor;
    sensor.geometry.revolution_us = 0;
    mapper.set_sensor(sensor).unwrap();
    mapper.set_revolution_us(100_000);
    assert_eq!(first_x(&mapper), 0.0);
}
