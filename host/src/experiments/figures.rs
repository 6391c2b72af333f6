//! The figures: map over blueprint, and what dead reckoning would have drawn.

use nalgebra::Isometry2;

use super::Figure;
use super::papers::SERIES;
use crate::configuration::Configuration;
use crate::output::svg::{self, Picture, Scene};
use crate::replay::{self, Replay, ReplayError, Step};
use crate::robot::Robot;
use crate::sim::world::{Edge, World};
use crate::sim::{self, Drive, SimConfig, judge};

/// The map of a simulated drive over its blueprint, with the true path; for the hall also as dead reckoning has it.
pub fn simulated(world: &World, seed: u64) -> Result<Vec<Figure>, ReplayError> {
    let driven = Driven::new(world, &SimConfig::default(), seed)?;
    let replay = driven.replay(Configuration::Default)?;
    let subtitle = Configuration::Default.subtitle();
    let mut figures = vec![(format!("{}.svg", world.name), driven.draw(&replay, subtitle))];
    if world.name == "hall" {
        let name = format!("{}_dead_reckoning.svg", world.name);
        figures.push((name, driven.draw(&by_wheels(replay), "dead reckoning")));
    }
    Ok(figures)
}

/// The same by the paper's text and with partial correction, on a drive of the first of the paper's series.
pub fn papers(world: &World, seed: u64) -> Result<Vec<Figure>, ReplayError> {
    let driven = Driven::new(world, &(SERIES[0].errors)(), seed)?;
    let figure = |configuration: Configuration| {
        let replay = driven.replay(configuration)?;
        let subtitle = format!("{}, {}", configuration.subtitle(), SERIES[0].name);
        Ok((format!("{}_{}.svg", world.name, configuration.name()), driven.draw(&replay, &subtitle)))
    };
    [Configuration::Paper, Configuration::PaperPartial].into_iter().map(figure).collect()
}

/// A drive, with what is drawn behind it.
struct Driven {
    robot: Robot,
    drive: Drive,
    title: String,
    blueprint: Vec<Edge>,
    truth: Vec<Isometry2<f32>>,
}

impl Driven {
    fn new(world: &World, errors: &SimConfig, seed: u64) -> Result<Self, ReplayError> {
        let robot = Robot::usual_for("simulated");
        let drive = sim::drive(world, &robot, errors, seed)?;
        let map_from_world = drive.truth.first().map_or_else(Isometry2::identity, Isometry2::inverse);
        let in_map = |pose: &Isometry2<f64>| nalgebra::convert_unchecked(map_from_world * pose);
        let truth = drive.truth.iter().map(in_map).collect();
        let title = format!("{}, seed {seed}", world.name);
        Ok(Self { blueprint: judge::blueprint_in_map(world, &drive), robot, drive, title, truth })
    }

    fn replay(&self, configuration: Configuration) -> Result<Replay, ReplayError> {
        replay::run(&self.drive.log, &self.robot, configuration.config(), || {})
    }

    fn draw(&self, replay: &Replay, subtitle: &str) -> String {
        let scene =
            Scene { title: &self.title, subtitle, blueprint: &self.blueprint, reference: &self.truth };
        svg::render(&Picture::of(&self.drive.log, replay), &scene)
    }
}

/// The same scans where the wheels say they were taken, without a map.
fn by_wheels(replay: Replay) -> Replay {
    let moved = |step: Step| Step { pose: step.odometry, pose_in_final_map: step.odometry, ..step };
    Replay { steps: replay.steps.into_iter().map(moved).collect(), map: Vec::new(), ..replay }
}
