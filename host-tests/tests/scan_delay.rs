//! Scans that are stamped late, or early, by what nobody said: the robot finds it out while it drives.

use std::path::Path;

use lineslam::replay;
use lineslam::robot::Robot;
use lineslam::sim::world::World;
use lineslam::sim::{SimConfig, drive, judge};
use slam_core::SlamConfig;

/// Seeds that nothing was chosen on.
const SEEDS: std::ops::Range<u64> = 301..304;

#[test]
fn a_delay_of_the_scans_is_found_in_the_hall() {
    let world = World::load(&Path::new(env!("CARGO_MANIFEST_DIR")).join("../worlds/hall.toml")).unwrap();
    let robot = Robot::usual_for("simulated");
    let mut without = SlamConfig::default();
    without.odometry.delay = None;
    let (mut with_m, mut without_m) = (0.0, 0.0);
    for seed in SEEDS {
        let mut late = SimConfig::default();
        late.sensor.delay_s = 0.05;
        for (sim, used) in [(late, true), (SimConfig::default(), false)] {
            let drive = drive(&world, &robot, &sim, seed).unwrap();
            let replay = replay::run(&drive.log, &robot, SlamConfig::default(), || {}).unwrap();
            let delay = replay.delay.expect("it is estimated");
            let off_s = f64::from(delay.delay_s) - drive.unit.stamp_delay_s;
            assert!(off_s.abs() < 0.015, "seed {seed}: {delay:?}, {:?}", drive.unit);
            assert_eq!(delay.used, used, "seed {seed}: {delay:?}, {:?}", drive.unit);
            if used {
                let other = replay::run(&drive.log, &robot, without, || {}).unwrap();
                assert_eq!(other.delay, None);
                with_m += judge::judge(&world, &drive, &replay).trajectory.ate_rmse_m;
                without_m += judge::judge(&world, &drive, &other).trajectory.ate_rmse_m;
            }
        }
    }
    println!("trajectory error, sum of three: {with_m:.3} m with the delay used, {without_m:.3} m without");
    assert!(with_m < 1.3 * without_m);
}
