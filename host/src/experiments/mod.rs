//! The paper's experiments, and more: simulated buildings over many seeds, with what is wrong with the robot made worse.
//! [`run`] measures, [`papers`] what the paper's configurations do, [`kidnapped`] what becomes of a robot that somebody lifts;
//! [`limits`] are what is asked of the default. [`document`] writes the page, [`figures`] draws. Recorded logs are those of
//! [`benchmark`](crate::benchmark).

pub mod document;
pub mod figures;
pub mod kidnapped;
pub mod kinds_page;
pub mod limits;
pub mod papers;
mod papers_page;

use std::ops::Range;
use std::path::PathBuf;

use rayon::prelude::*;
use slam_core::SlamConfig;
use slam_core::tracking::correction::Verdict;

use crate::replay::{self, Replay, ReplayError};
use crate::robot::Robot;
use crate::sim::judge::{self, Judgement, TrajectoryErrors};
use crate::sim::world::World;
use crate::sim::{self, Drive, SimConfig, SimKind, UnitErrors};
use crate::toml_file::FileError;

/// A building of the experiments.
#[derive(Clone, Copy, Debug)]
pub struct Building {
    /// Name of its file in the worlds' folder.
    pub name: &'static str,
    /// Corner error that the paper measured in a building of this kind, metres.
    pub paper_measured_m: Option<f64>,
}

/// The buildings in which everything is measured.
pub const BUILDINGS: [Building; 3] = [
    Building { name: "hall", paper_measured_m: Some(0.067) },
    Building { name: "corridor", paper_measured_m: Some(0.234) },
    Building { name: "office", paper_measured_m: None },
];

/// The worlds in which both kinds of errors are driven.
pub const WORLDS: [&str; 7] = ["hall", "corridor", "office", "lab", "flat", "twins", "loop"];

/// Two parallel walls and nothing else.
pub const FEATURELESS: &str = "parallel";

/// What is wrong with the robot in one series.
#[derive(Clone, Copy, Debug)]
pub struct Condition {
    /// What it is called in the table.
    pub name: &'static str,
    /// Changes to the usual errors, as `--set` takes them.
    pub settings: &'static [&'static str],
}

/// The usual errors first.
pub const CONDITIONS: [Condition; 5] = [
    Condition { name: "as above", settings: &[] },
    Condition {
        name: "wheel errors doubled",
        settings: &[
            "wheel.radius_error=0.02",
            "wheel.radius_difference=0.004",
            "wheel.track_error=0.04",
            "wheel.slip_m_per_sqrt_m=0.008",
        ],
    },
    Condition {
        name: "±30 mm on every range",
        settings: &["sensor.sigma_m=0", "sensor.sigma_per_m=0", "sensor.uniform_m=0.03"],
    },
    Condition { name: "10 % of the beams fail", settings: &["sensor.dropout=0.1"] },
    Condition { name: "every fifth scan missing", settings: &["sensor.skip_every=5"] },
];

/// A robot farther than this from where it thinks it is has lost track, metres.
pub const LOST_M: f64 = 0.5;

/// One configuration on one drive.
#[derive(Clone, Debug)]
pub struct Measured {
    /// Map and trajectory against the truth.
    pub judgement: Judgement,
    /// Segments of the map.
    pub segments: usize,
    /// Share of the scans that had pairs which do not determine the whole pose.
    pub singular: f64,
}

impl Measured {
    /// Whether the robot was once farther than [`LOST_M`] from where it thought it was.
    pub fn lost(&self) -> bool {
        self.judgement.worst_position_error_m > LOST_M
    }
}

/// What is driven.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Case {
    /// Name of the world.
    pub world: &'static str,
    /// Kind of the errors.
    pub kind: SimKind,
    /// Index in [`CONDITIONS`].
    pub condition: usize,
}

impl Case {
    /// The usual errors of a kind.
    pub const fn usual(world: &'static str, kind: SimKind) -> Self {
        Self { world, kind, condition: 0 }
    }

    /// All that [`run`] drives.
    fn all() -> impl Iterator<Item = Self> {
        let usual = |world| SimKind::ALL.map(|kind| Self::usual(world, kind));
        let ideal =
            |world| (1..CONDITIONS.len()).map(move |c| Self { world, kind: SimKind::Ideal, condition: c });
        let worse = BUILDINGS.into_iter().flat_map(move |building| ideal(building.name));
        WORLDS.into_iter().flat_map(usual).chain(worse).chain([Self::usual(FEATURELESS, SimKind::Ideal)])
    }
}

/// One simulated drive.
#[derive(Clone, Debug)]
pub struct Run {
    /// What was driven.
    pub case: Case,
    /// What the default configuration made of it.
    pub default: Measured,
    /// What the wheels said.
    pub dead_reckoning: TrajectoryErrors,
    /// What was wrong with the unit.
    pub unit: UnitErrors,
}

/// File name and content of a figure.
pub type Figure = (String, String);

/// Everything measured, and the figures.
#[derive(Debug)]
pub struct Results {
    /// The seeds of the simulated drives.
    pub seeds: Range<u64>,
    /// Every simulated drive.
    pub runs: Vec<Run>,
    /// Drives in which the robot was lifted.
    pub kidnapped: Vec<kidnapped::Kidnapped>,
    /// The paper's configurations, and the default beside them.
    pub papers: Vec<papers::PaperRun>,
    /// RANSAC seeds of each drive.
    pub ransac_seeds: u64,
    /// The figures.
    pub figures: Vec<Figure>,
}

/// What the experiments are run on.
#[derive(Clone, Debug)]
pub struct Options {
    /// Folder of the worlds.
    pub worlds: PathBuf,
    /// The seeds of the simulated drives.
    pub seeds: Range<u64>,
    /// RANSAC seeds of each drive, for the paper's configurations.
    pub ransac_seeds: u64,
}

impl Options {
    fn world(&self, name: &str) -> Result<World, FileError> {
        World::load(&self.worlds.join(format!("{name}.toml")))
    }
}

/// Why the experiments could not be run.
#[derive(Debug, thiserror::Error)]
pub enum ExperimentError {
    /// A world file cannot be used.
    #[error(transparent)]
    World(#[from] FileError),
    /// A drive could not be replayed.
    #[error(transparent)]
    Replay(#[from] ReplayError),
}

/// Number of steps that [`run`] reports.
pub fn steps(options: &Options) -> usize {
    let seeds = (options.seeds.end - options.seeds.start) as usize;
    Case::all().count() * seeds + papers::steps(options) + kidnapped::steps(options)
}

/// Runs everything. `progress` is called after each drive, from any thread.
pub fn run(options: &Options, progress: impl Fn() + Sync) -> Result<Results, ExperimentError> {
    let mut jobs = Vec::new();
    for case in Case::all() {
        let world = std::sync::Arc::new(options.world(case.world)?);
        jobs.extend(options.seeds.clone().map(|seed| (case, world.clone(), seed)));
    }
    let runs = jobs
        .par_iter()
        .map(|(case, world, seed)| {
            let run = simulated(*case, world, *seed);
            progress();
            run
        })
        .collect::<Result<Vec<Run>, ReplayError>>()?;
    let kidnapped = kidnapped::run(options, &progress)?;
    let papers = papers::run(options, &progress)?;
    let mut figures = Vec::new();
    for name in ["hall", "corridor", "office"] {
        figures.extend(figures::simulated(&options.world(name)?, options.seeds.start)?);
    }
    figures.extend(figures::papers(&options.world("corridor")?, options.seeds.start)?);
    let ransac_seeds = options.ransac_seeds;
    Ok(Results { seeds: options.seeds.clone(), runs, kidnapped, papers, ransac_seeds, figures })
}

/// One drive of a case in its world.
pub fn simulated(case: Case, world: &World, seed: u64) -> Result<Run, ReplayError> {
    let robot = Robot::usual_for("simulated");
    let mut errors = SimConfig::of(case.kind);
    for setting in CONDITIONS[case.condition].settings {
        errors.set(setting).expect("the conditions are constants");
    }
    let drive = sim::drive(world, &robot, &errors, seed)?;
    let (default, replay) = measure(world, &drive, &robot, SlamConfig::default())?;
    let odometry = judge::in_world(&drive, replay.steps.iter().map(|s| s.odometry));
    let dead_reckoning = judge::trajectory_errors(&drive.truth, &odometry);
    Ok(Run { case, default, dead_reckoning, unit: drive.unit })
}

/// One configuration on one drive, and what it was judged by.
fn measure(
    world: &World,
    drive: &Drive,
    robot: &Robot,
    config: SlamConfig,
) -> Result<(Measured, Replay), ReplayError> {
    let replay = replay::run(&drive.log, robot, config, || {})?;
    let judgement = judge::judge(world, drive, &replay);
    let is_singular = |step: &&replay::Step| {
        let update = &step.update;
        update.registration.matched > 0 && update.observability.verdict != Verdict::Full
    };
    let singular = replay.steps.iter().filter(is_singular).count() as f64 / replay.steps.len().max(1) as f64;
    Ok((Measured { judgement, segments: replay.map.len(), singular }, replay))
}
