//! A scanner that looks all round, in a simulated building.

use host_tests::root;
use lineslam::replay;
use lineslam::robot::Robot;
use lineslam::sim::world::World;
use lineslam::sim::{self, SimConfig, judge};
use slam_core::SlamConfig;

#[test]
fn a_scanner_of_360_degrees_maps_the_office() {
    let text = std::fs::read_to_string(root().join("robots/paper.toml")).unwrap();
    let steps = "[sensor.steps]\nfirst = 0\nlast = 1023\nfront = 512\nused = [0, 1023]\n\n[mounting]";
    let round = text.replace("[mounting]", steps);
    assert_ne!(round, text);
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("round.toml");
    std::fs::write(&path, round).unwrap();
    let robot = Robot::load(&path).unwrap();
    let world = World::load(&root().join("worlds/office.toml")).unwrap();
    for seed in [1, 2] {
        let drive = sim::drive(&world, &robot, &SimConfig::default(), seed).unwrap();
        assert_eq!(drive.log.scans[0].ranges_mm.len(), 1024);
        let replay = replay::run(&drive.log, &robot, SlamConfig::default(), || {}).unwrap();
        let judged = judge::judge(&world, &drive, &replay);
        println!(
            "office, 360°, seed {seed}: trajectory {:.3} m, corners {:.3} m, {} of {} found, {} spurious",
            judged.trajectory.ate_rmse_m,
            judged.corner_error_m.unwrap(),
            judged.corners_found,
            judged.corners,
            judged.spurious_segments
        );
        assert!(judged.trajectory.ate_rmse_m < 0.05 && judged.corner_error_m.unwrap() < 0.06, "{judged:?}");
        assert_eq!(judged.spurious_segments, 0);
    }
}
