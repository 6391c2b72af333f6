//! The paper's experiments, and more: simulated buildings over many seeds, with what is wrong with the robot made worse,
//! and recorded logs. [`run`] measures, [`document`] writes the page, [`figures`] draws.

pub mod document;
pub mod figures;

use std::path::{Path, PathBuf};

use nalgebra::{Isometry2, Point2};
use rayon::prelude::*;
use slam_core::SlamConfig;

use crate::log::{self, Format, LogError, ReadOptions};
use crate::replay::{self, Replay, ReplayError, Step};
use crate::robot::Robot;
use crate::score::{self, Relation, Spread, StampedPose};
use crate::sim::judge::{self, Judgement, TrajectoryErrors};
use crate::sim::world::World;
use crate::sim::{self, Drive, SimConfig, WheelModel};
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
}

impl Measured {
    /// Whether the robot was once farther than [`LOST_M`] from where it thought it was.
    pub fn lost(&self) -> bool {
        self.judgement.worst_position_error_m > LOST_M
    }
}

/// One simulated drive.
#[derive(Clone, Debug)]
pub struct Run {
    /// Name of the world.
    pub world: &'static str,
    /// Index in [`CONDITIONS`].
    pub condition: usize,
    /// What the default configuration made of it.
    pub default: Measured,
    /// What the paper's did, under the usual errors.
    pub paper: Option<Measured>,
    /// The same on a drive whose wheels are as the robot file says, as the paper's must have been.
    pub paper_calibrated: Option<Measured>,
    /// What the wheels said.
    pub dead_reckoning: TrajectoryErrors,
}

/// One recorded log.
#[derive(Clone, Debug)]
pub struct Recorded {
    /// Name of the log.
    pub name: &'static str,
    /// Scans replayed.
    pub scans: usize,
    /// Absolute trajectory error of dead reckoning, metres.
    pub dead_reckoning_m: f64,
    /// The same of the paper's configuration.
    pub paper_m: f64,
    /// The same of the default configuration.
    pub default_m: f64,
    /// The same of the default configuration without loop closure.
    pub open_loop_m: f64,
    /// Loops the default configuration closed.
    pub loops_closed: u32,
    /// Mean error of relations checked by hand, where there are any, metres.
    pub relations_m: Option<f64>,
    /// Walls of the scans laid by the default configuration's poses.
    pub walls: Walls,
    /// The same scans laid by the reference's poses.
    pub reference_walls: Walls,
}

/// How thick walls are, by [`score::wall_thicknesses_m`]: medians over all points, metres.
#[derive(Clone, Copy, Debug)]
pub struct Walls {
    /// Of all scans together.
    pub whole_m: f64,
    /// Of each pass of [`PASS_M`] alone.
    pub pass_m: f64,
}

/// Way that counts as one pass, too short to have come back, metres.
pub const PASS_M: f32 = 10.0;

/// File name and content of a figure.
pub type Figure = (String, String);

/// Everything measured, and the figures.
#[derive(Debug)]
pub struct Results {
    /// The seeds of the simulated drives.
    pub seeds: std::ops::Range<u64>,
    /// Every simulated drive.
    pub runs: Vec<Run>,
    /// Every recorded log that was at hand.
    pub recorded: Vec<Recorded>,
    /// The figures.
    pub figures: Vec<Figure>,
}

/// What the experiments are run on.
#[derive(Clone, Debug)]
pub struct Options {
    /// Folder of the worlds.
    pub worlds: PathBuf,
    /// Folder of the recorded logs, or none.
    pub data: Option<PathBuf>,
    /// The seeds of the simulated drives.
    pub seeds: std::ops::Range<u64>,
}

/// Why the experiments could not be run.
#[derive(Debug, thiserror::Error)]
pub enum ExperimentError {
    /// A world file cannot be used.
    #[error(transparent)]
    World(#[from] FileError),
    /// A log cannot be used.
    #[error(transparent)]
    Log(#[from] LogError),
    /// A log or drive could not be replayed.
    #[error(transparent)]
    Replay(#[from] ReplayError),
    /// A reference that belongs to a log cannot be used.
    #[error("{}: {reason}", path.display())]
    Reference {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        reason: String,
    },
}

/// The recorded logs: name and file.
const LOGS: [(&str, &str); 5] = [
    ("exp1", "exp1.dat.gz"),
    ("csail", "csail.log.gz"),
    ("fr079", "fr079.log.gz"),
    ("fr101", "fr101.log.gz"),
    ("seattle", "seattle.log.gz"),
];

/// Number of steps that [`run`] reports.
pub fn steps(options: &Options) -> usize {
    let drives = BUILDINGS.len() * CONDITIONS.len() + 1;
    drives * (options.seeds.end - options.seeds.start) as usize + LOGS.len()
}

/// Runs everything. `progress` is called after each drive and each log, from any thread.
pub fn run(options: &Options, progress: impl Fn() + Sync) -> Result<Results, ExperimentError> {
    let load = |name: &str| World::load(&options.worlds.join(format!("{name}.toml")));
    let mut jobs = Vec::new();
    for name in BUILDINGS.map(|b| b.name).into_iter().chain([FEATURELESS]) {
        let world = std::sync::Arc::new(load(name)?);
        let conditions = if name == FEATURELESS { 1 } else { CONDITIONS.len() };
        for condition in 0..conditions {
            jobs.extend(options.seeds.clone().map(|seed| (name, world.clone(), condition, seed)));
        }
    }
    let runs = jobs
        .par_iter()
        .map(|(name, world, condition, seed)| {
            let run = simulated(name, world, *condition, *seed);
            progress();
            run
        })
        .collect::<Result<Vec<Run>, ReplayError>>()?;
    let mut figures = Vec::new();
    for name in ["hall", "corridor", "office"] {
        figures.extend(figures::simulated(&load(name)?, options.seeds.start)?);
    }
    let measured = LOGS
        .par_iter()
        .map(|(name, file)| {
            let done = options.data.as_ref().map(|data| recorded(data, name, file)).transpose();
            progress();
            done.map(Option::flatten)
        })
        .collect::<Result<Vec<_>, ExperimentError>>()?;
    let (recorded, drawn): (Vec<_>, Vec<_>) = measured.into_iter().flatten().unzip();
    figures.extend(drawn);
    Ok(Results { seeds: options.seeds.clone(), runs, recorded, figures })
}

/// One drive in a world, under a condition of [`CONDITIONS`].
pub fn simulated(name: &'static str, world: &World, condition: usize, seed: u64) -> Result<Run, ReplayError> {
    let robot = Robot::usual_for("simulated");
    let mut errors = SimConfig::default();
    for setting in CONDITIONS[condition].settings {
        errors.set(setting).expect("the conditions are constants");
    }
    let measure = |drive: &Drive, config: SlamConfig| -> Result<(Measured, Replay), ReplayError> {
        let replay = replay::run(&drive.log, &robot, config, || {})?;
        let judgement = judge::judge(world, drive, &replay);
        Ok((Measured { judgement, segments: replay.map.len() }, replay))
    };
    let drive = sim::drive(world, &robot, &errors, seed)?;
    let (default, replay) = measure(&drive, SlamConfig::default())?;
    let odometry = judge::in_world(&drive, replay.steps.iter().map(|s| s.odometry));
    let dead_reckoning = judge::trajectory_errors(&drive.truth, &odometry);
    let (mut paper, mut paper_calibrated) = (None, None);
    if condition == 0 {
        paper = Some(measure(&drive, SlamConfig::paper())?.0);
        let slip_m_per_sqrt_m = errors.wheel.slip_m_per_sqrt_m;
        errors.wheel =
            WheelModel { radius_error: 0.0, radius_difference: 0.0, track_error: 0.0, slip_m_per_sqrt_m };
        let calibrated = sim::drive(world, &robot, &errors, seed)?;
        paper_calibrated = Some(measure(&calibrated, SlamConfig::paper())?.0);
    }
    Ok(Run { world: name, condition, default, paper, paper_calibrated, dead_reckoning })
}

/// Measures one log and draws it; `None` where it is not there.
fn recorded(
    data: &Path,
    name: &'static str,
    file: &str,
) -> Result<Option<(Recorded, Figure)>, ExperimentError> {
    let path = data.join(file);
    if !path.exists() {
        return Ok(None);
    }
    let log = log::read(&path, &ReadOptions { format: Format::Auto, beams: None, lenient: false })?;
    let robot = Robot::usual_for(log.format);
    let reference_path = data.join(format!("{name}.ref.tum"));
    let reference = read_with(&reference_path, score::parse_tum)?;
    let replay = |config: SlamConfig| replay::run(&log, &robot, config, || {});
    let error_m =
        |poses: &[StampedPose]| score::absolute_trajectory_error(poses, &reference).unwrap_or(f64::NAN);
    let default = replay(SlamConfig::default())?;
    let open_loop = replay(SlamConfig { loop_closure: None, ..SlamConfig::default() })?;
    let paper = replay(SlamConfig::paper())?;
    let relations_path = data.join(format!("{name}.relations"));
    let relations: Option<Vec<Relation>> =
        relations_path.exists().then(|| read_with(&relations_path, score::parse_relations)).transpose()?;
    let poses = stamped(replay::trajectory(&default.steps));
    let measured = Recorded {
        name,
        scans: default.steps.len(),
        dead_reckoning_m: error_m(&stamped(replay::dead_reckoning(&default.steps))),
        paper_m: error_m(&stamped(replay::trajectory(&paper.steps))),
        default_m: error_m(&poses),
        open_loop_m: error_m(&stamped(replay::trajectory(&open_loop.steps))),
        loops_closed: default.counters.loops_closed,
        relations_m: relations.and_then(|r| score::mean_relation_error_m(&poses, &r)),
        walls: walls(&default.steps, &poses),
        reference_walls: walls(&default.steps, &reference),
    };
    let figure = figures::recorded(name, &log, &default, &poses, &reference);
    Ok(Some((measured, figure)))
}

fn read_with<T, E: std::fmt::Display>(
    path: &Path,
    parse: impl Fn(&str) -> Result<T, E>,
) -> Result<T, ExperimentError> {
    let failed = |reason: String| ExperimentError::Reference { path: path.to_owned(), reason };
    let text = std::fs::read_to_string(path).map_err(|e| failed(e.to_string()))?;
    parse(&text).map_err(|e| failed(e.to_string()))
}

/// The walls of a replay's scans, laid by these poses.
pub fn walls(steps: &[Step], poses: &[StampedPose]) -> Walls {
    let at = score::at_stamps(poses, steps.iter().map(|step| step.stamp_us as f64 * 1e-6));
    let laid: Vec<(u32, Vec<Point2<f64>>)> = steps
        .iter()
        .zip(at)
        .filter_map(|(step, pose)| {
            let pose = pose?;
            let laid = step.points.iter().map(|point| pose * nalgebra::convert::<_, Point2<f64>>(*point));
            Some(((step.update.way_m / PASS_M) as u32, laid.collect()))
        })
        .collect();
    let thicknesses = |scans: &[(u32, Vec<Point2<f64>>)]| {
        let points: Vec<Point2<f64>> = scans.iter().flat_map(|(_, points)| points).copied().collect();
        score::wall_thicknesses_m(&points)
    };
    let median = |thicknesses: Vec<f64>| Spread::of(thicknesses.into_iter()).map_or(f64::NAN, |s| s.median);
    let passes = laid.chunk_by(|(a, _), (b, _)| a == b);
    Walls { whole_m: median(thicknesses(&laid)), pass_m: median(passes.flat_map(thicknesses).collect()) }
}

/// A trajectory as it is scored.
pub fn stamped<'a>(poses: impl Iterator<Item = (u64, &'a Isometry2<f32>)>) -> Vec<StampedPose> {
    poses.map(|(stamp_us, pose)| StampedPose::of_core(stamp_us, pose)).collect()
}
