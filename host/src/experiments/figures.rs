//! The figures: map over blueprint or reference, and what dead reckoning would have drawn.

use nalgebra::Isometry2;
use slam_core::SlamConfig;

use super::Figure;
use crate::log::Log;
use crate::output::svg::{self, Scene};
use crate::replay::{self, Replay, ReplayError, Step};
use crate::robot::Robot;
use crate::score::{self, StampedPose};
use crate::sim::world::World;
use crate::sim::{self, SimConfig, judge};

/// The map of a simulated drive over its blueprint, with the true path; for the hall also as dead reckoning has it.
pub fn simulated(world: &World, seed: u64) -> Result<Vec<Figure>, ReplayError> {
    let robot = Robot::usual_for("simulated");
    let drive = sim::drive(world, &robot, &SimConfig::default(), seed)?;
    let replay = replay::run(&drive.log, &robot, SlamConfig::default(), || {})?;
    let blueprint = judge::blueprint_in_map(world, &drive);
    let map_from_world = drive.truth.first().map_or_else(Isometry2::identity, Isometry2::inverse);
    let truth: Vec<Isometry2<f32>> =
        drive.truth.iter().map(|pose| nalgebra::convert_unchecked(map_from_world * pose)).collect();
    let title = format!("{}, seed {seed}", world.name);
    let draw = |replay: &Replay, subtitle: &str| {
        svg::render(
            &replay.into(),
            &Scene { title: &title, subtitle, blueprint: &blueprint, reference: &truth },
        )
    };
    let mut figures = vec![(format!("{}.svg", world.name), draw(&replay, "default configuration"))];
    if world.name == "hall" {
        figures
            .push((format!("{}_dead_reckoning.svg", world.name), draw(&by_wheels(replay), "dead reckoning")));
    }
    Ok(figures)
}

/// The map of a recorded log, with the reference trajectory laid on it.
pub fn recorded(
    name: &str,
    log: &Log,
    replay: &Replay,
    poses: &[StampedPose],
    reference: &[StampedPose],
) -> Figure {
    let reference: Vec<Isometry2<f32>> = score::align(reference, poses)
        .map(|alignment| {
            let carried =
                |p: &StampedPose| nalgebra::convert_unchecked(alignment.reference_from_estimate * p.pose);
            reference.iter().map(carried).collect()
        })
        .unwrap_or_default();
    let title = format!("{name} ({})", log.format);
    let scene =
        Scene { title: &title, subtitle: "default configuration", reference: &reference, ..Scene::default() };
    (format!("{name}.svg"), svg::render(&replay.into(), &scene))
}

/// The same scans where the wheels say they were taken, without a map.
fn by_wheels(replay: Replay) -> Replay {
    let moved = |step: Step| Step { pose: step.odometry, pose_in_final_map: step.odometry, ..step };
    Replay { steps: replay.steps.into_iter().map(moved).collect(), map: Vec::new(), ..replay }
}
