//! The figures: map over blueprint, and what dead reckoning would have drawn.

use nalgebra::Isometry2;
use slam_core::SlamConfig;

use super::Figure;
use crate::output::svg::{self, Picture, Scene};
use crate::replay::{self, Replay, ReplayError, Step};
use crate::robot::Robot;
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
            &Picture::of(&drive.log, replay),
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

/// The same scans where the wheels say they were taken, without a map.
fn by_wheels(replay: Replay) -> Replay {
    let moved = |step: Step| Step { pose: step.odometry, pose_in_final_map: step.odometry, ..step };
    Replay { steps: replay.steps.into_iter().map(moved).collect(), map: Vec::new(), ..replay }
}
