//! How firmly a log's figure stands: what it becomes with a little more noise on the ranges.

use rayon::prelude::*;
use slam_core::SlamConfig;

use super::perturb::perturbed;
use crate::log::Log;
use crate::replay::{self, Replay, ReplayError};
use crate::robot::Robot;
use crate::score::Spread;

/// How often logs are replayed with noise.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Noise {
    /// Times, with the seeds from 1 to that; zero for not at all.
    pub runs: usize,
    /// Standard deviation of the noise, metres.
    pub sigma_m: f64,
}

impl Noise {
    /// No replay but the plain one.
    pub const NONE: Self = Self { runs: 0, sigma_m: 0.0 };
}

/// What the main measure of a log became.
#[derive(Clone, Copy, Debug)]
pub struct Firmness {
    /// Its name.
    pub measure: &'static str,
    /// Of the log as it is, metres.
    pub plain_m: f64,
    /// The middle one of the runs with noise.
    pub median_m: f64,
    /// The largest of them.
    pub worst_m: f64,
}

/// Replays a log with noise and scores each run. `None` where nothing was asked for, or a run has no figure.
pub fn firmness(
    (log, robot): (&Log, &Robot),
    noise: &Noise,
    measure: &'static str,
    plain_m: f64,
    score: impl Fn(&Replay) -> Option<f64> + Sync,
) -> Result<Option<Firmness>, ReplayError> {
    let run = |seed: u64| {
        let log = perturbed(log, robot, noise.sigma_m, seed);
        Ok(score(&replay::run(&log, robot, SlamConfig::default(), || {})?))
    };
    let errors_m: Vec<Option<f64>> =
        (1..=noise.runs as u64).into_par_iter().map(run).collect::<Result<_, ReplayError>>()?;
    let errors_m: Option<Vec<f64>> = errors_m.into_iter().collect();
    let spread = errors_m.and_then(|errors_m| Spread::of(errors_m.into_iter()));
    Ok(spread.map(|s| Firmness { measure, plain_m, median_m: s.median, worst_m: s.worst }))
}
