//! The paper's configurations side by side, and the default beside them: the same drives, and for each several RANSAC seeds,
//! whose luck moves single drives by more than the configurations differ.

use std::ops::Range;

use rayon::prelude::*;

use super::{BUILDINGS, ExperimentError, Measured, Options, measure};
use crate::configuration::Configuration;
use crate::replay::ReplayError;
use crate::robot::Robot;
use crate::sim::world::World;
use crate::sim::{self, SimConfig, WheelModel};

/// Drives that all configurations are given.
#[derive(Clone, Copy, Debug)]
pub struct Series {
    /// What it is called in the tables.
    pub name: &'static str,
    /// What is wrong with the robot.
    pub errors: fn() -> SimConfig,
}

/// The first is the one of which the page tells.
pub const SERIES: [Series; 2] = [
    Series { name: "calibrated wheels", errors: calibrated },
    Series { name: "usual errors", errors: SimConfig::default },
];

/// Wheels as the robot file says but for slip, as the paper's must have been.
fn calibrated() -> SimConfig {
    let usual = SimConfig::default();
    let wheel = WheelModel { radius_error: 0.0, radius_difference: 0.0, track_error: 0.0, ..usual.wheel };
    SimConfig { wheel, ..usual }
}

/// The configurations, from the paper's text to the default.
pub const CONFIGURATIONS: [Configuration; 4] =
    [Configuration::PAPERS[0], Configuration::PAPERS[1], Configuration::PAPERS[2], Configuration::Default];

/// RANSAC seeds lie so far apart: no log has so many scans.
const RANSAC_SEED_STEP: u64 = 1_000_000;

/// One replay of one drive.
#[derive(Clone, Debug)]
pub struct PaperRun {
    /// Name of the building.
    pub world: &'static str,
    /// Index in [`SERIES`].
    pub series: usize,
    /// Seed of the drive.
    pub seed: u64,
    /// What it was replayed with.
    pub configuration: Configuration,
    /// What came of it.
    pub measured: Measured,
}

/// Number of drives that [`run`] reports.
pub fn steps(options: &Options) -> usize {
    BUILDINGS.len() * SERIES.len() * (options.seeds.end - options.seeds.start) as usize
}

/// Every drive with every configuration. `progress` is called after each drive, from any thread.
pub fn run(options: &Options, progress: impl Fn() + Sync) -> Result<Vec<PaperRun>, ExperimentError> {
    let mut jobs = Vec::new();
    for building in BUILDINGS {
        let world = std::sync::Arc::new(options.world(building.name)?);
        for series in 0..SERIES.len() {
            jobs.extend(options.seeds.clone().map(|seed| (building.name, world.clone(), series, seed)));
        }
    }
    let runs = jobs
        .par_iter()
        .map(|(name, world, series, seed)| {
            let runs = drive(name, world, *series, *seed, 0..options.ransac_seeds);
            progress();
            runs
        })
        .collect::<Result<Vec<Vec<PaperRun>>, ReplayError>>()?;
    Ok(runs.into_iter().flatten().collect())
}

/// One drive with every configuration, those of the paper once for each RANSAC seed.
pub fn drive(
    name: &'static str,
    world: &World,
    series: usize,
    seed: u64,
    ransac: Range<u64>,
) -> Result<Vec<PaperRun>, ReplayError> {
    let robot = Robot::usual_for("simulated");
    let drive = sim::drive(world, &robot, &(SERIES[series].errors)(), seed)?;
    let mut runs = Vec::new();
    for configuration in CONFIGURATIONS {
        let draws = if configuration == Configuration::Default { 0..1 } else { ransac.clone() };
        for draw in draws {
            let config = configuration.config().with_ransac_seed(1 + draw * RANSAC_SEED_STEP);
            let (measured, _) = measure(world, &drive, &robot, config)?;
            runs.push(PaperRun { world: name, series, seed, configuration, measured });
        }
    }
    Ok(runs)
}
