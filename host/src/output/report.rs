//! `report.json`: what a replay used, skipped, cost and made.

use std::collections::BTreeMap;
use std::time::Duration;

use serde::Serialize;
use slam_core::SlamConfig;
use slam_core::map::MapCounters;
use slam_core::slam::Counters;
use slam_core::tracking::correction::Verdict;

use super::tracking::Tracking;
use crate::log::{Log, Warning, doubts};
use crate::replay::{Agreement, Replay};
use crate::robot::Robot;
use crate::sim::judge::{self, Judgement, LaidCorners, TrajectoryErrors};
use crate::sim::world::World;
use crate::sim::{Drive, SimConfig, UnitErrors};

/// Everything the file says.
#[derive(Debug, Serialize)]
pub struct Report {
    /// Format the log was read as.
    pub format: &'static str,
    /// Name of the robot.
    pub robot: String,
    /// Name of the configuration.
    pub configuration: String,
    /// Scans processed.
    pub scans_used: usize,
    /// Records skipped, by reason.
    pub records_skipped: BTreeMap<&'static str, usize>,
    /// What looks wrong: what is suspected, from what number, and what to pass to mend it.
    pub warnings: Vec<Warning>,
    /// Segments of the final map.
    pub segments: usize,
    /// Way driven, by odometry, metres.
    pub distance_m: f64,
    /// Time from the first scan to the last, seconds.
    pub duration_s: f64,
    /// Time of one scan in the core.
    pub scan_us: Percentiles,
    /// Scans by what their pairs fixed.
    pub observability: BTreeMap<&'static str, usize>,
    /// Scans by how far the pose was to be relied on, and what became of the odometry.
    pub tracking: Tracking,
    /// What was found out about the odometry, where there is one.
    pub odometry: Option<OdometryReport>,
    /// How the poses compare with those that the robot said, where it recorded them itself.
    pub as_the_robot: Option<Agreement>,
    /// Counters of the core.
    pub counters: Counters,
    /// Counters of the map.
    pub map_counters: MapCounters,
    /// RAM of the `Slam` that was used, bytes.
    pub slam_bytes: usize,
    /// Room for map segments.
    pub map_capacity: usize,
    /// What only a simulation can say.
    #[serde(flatten)]
    pub simulation: Option<SimulationReport>,
    /// Every setting.
    pub config: SlamConfig,
}

/// What was found out about the odometry.
#[derive(Debug, Serialize)]
pub struct OdometryReport {
    /// By how much scans were stamped late, beyond what the robot file says, seconds.
    pub delay_s: f32,
    /// Standard deviation of that, seconds.
    pub delay_sigma_s: f32,
    /// Whether it was known well enough to be used in the end.
    pub delay_used: bool,
}

/// The truth's word on a simulated drive.
#[derive(Debug, Serialize)]
pub struct SimulationReport {
    /// Name of the world.
    pub world: String,
    /// Seed of all noise.
    pub seed: u64,
    /// Errors of the simulated robot.
    pub errors: SimConfig,
    /// What was wrong with this unit.
    pub unit: UnitErrors,
    /// Measures of map and trajectory.
    #[serde(flatten)]
    pub judgement: Judgement,
    /// Measures of dead reckoning, which has no map.
    pub dead_reckoning: TrajectoryErrors,
}

impl SimulationReport {
    /// Judges a replay of a simulated drive.
    pub fn new(world: &World, drive: &Drive, replay: &Replay, seed: u64, errors: SimConfig) -> Self {
        let odometry = judge::in_world(drive, replay.steps.iter().map(|s| s.odometry));
        Self {
            world: world.name.clone(),
            seed,
            errors,
            unit: drive.unit,
            judgement: judge::judge(world, drive, replay),
            dead_reckoning: judge::trajectory_errors(&drive.truth, &odometry),
        }
    }

    /// Lines for a summary.
    pub fn rows(&self) -> Vec<(&'static str, String)> {
        let (j, dead) = (&self.judgement, &self.dead_reckoning);
        let corners = match j.corner_error_m {
            Some(error_m) => format!("{error_m:.3} m, {} of {} found", j.corners_found, j.corners),
            None => format!("none of {} found", j.corners),
        };
        let laid = |laid: &LaidCorners| match laid.corner_error_m {
            Some(error_m) => format!("{error_m:.3} m, {} of {} found", laid.corners_found, j.corners),
            None => format!("none of {} found", j.corners),
        };
        let scaled = format!("{}, scale {:.4}", laid(&j.laid_with_scale), j.laid_with_scale.scale);
        let beside = |ours: f64, theirs: f64| format!("{ours:.3} m, dead reckoning {theirs:.3} m");
        vec![
            ("corner error, eq. (11)", corners),
            ("laid over the blueprint", laid(&j.laid)),
            ("and with scale", scaled),
            ("trajectory error, rmse", beside(j.trajectory.ate_rmse_m, dead.ate_rmse_m)),
            ("unaligned", beside(j.trajectory.unaligned_rmse_m, dead.unaligned_rmse_m)),
            ("aligned with scale", beside(j.trajectory.scaled_rmse_m, dead.scaled_rmse_m)),
            (
                "final position error",
                beside(j.trajectory.final_position_error_m, dead.final_position_error_m),
            ),
        ]
    }
}

/// Microseconds, measured on this machine.
#[derive(Debug, Serialize)]
pub struct Percentiles {
    /// Half of the scans took less.
    pub median: f64,
    /// 99 of 100 scans took less.
    pub p99: f64,
    /// The slowest scan.
    pub max: f64,
}

impl Percentiles {
    /// Of a set of durations; all zero when there is none.
    pub fn of(durations: impl Iterator<Item = Duration>) -> Self {
        let mut us: Vec<f64> = durations.map(|d| d.as_secs_f64() * 1e6).collect();
        us.sort_unstable_by(f64::total_cmp);
        let at = |share: f64| {
            us.get(((us.len().max(1) - 1) as f64 * share).round() as usize).copied().unwrap_or(0.0)
        };
        Self { median: at(0.5), p99: at(0.99), max: at(1.0) }
    }
}

impl Report {
    /// Gathers the report of one replay.
    pub fn new(log: &Log, robot: &Robot, configuration: &str, replay: &Replay) -> Self {
        let stamps = replay.steps.first().zip(replay.steps.last());
        let mut observability = BTreeMap::new();
        for step in &replay.steps {
            let verdict = match step.update.observability.verdict {
                Verdict::Full => "full",
                Verdict::Corridor => "corridor",
                Verdict::Blind => "blind",
            };
            *observability.entry(verdict).or_default() += 1;
        }
        let mut records_skipped = log.skipped.clone();
        if replay.impossible_steps > 0 {
            *records_skipped.entry("odometry_impossible_step").or_default() += replay.impossible_steps;
        }
        let warnings = log.warnings.iter().cloned().chain(doubts::of_drive(log, robot, replay)).collect();
        Self {
            format: log.format,
            robot: robot.name.clone(),
            configuration: configuration.to_owned(),
            scans_used: replay.steps.len(),
            records_skipped,
            warnings,
            segments: replay.map.len(),
            distance_m: replay.distance_m,
            duration_s: stamps.map_or(0.0, |(a, b)| (b.stamp_us - a.stamp_us) as f64 * 1e-6),
            scan_us: Percentiles::of(replay.steps.iter().map(|s| s.took)),
            observability,
            tracking: Tracking::of(&replay.steps),
            odometry: replay.delay.map(|delay| OdometryReport {
                delay_s: delay.delay_s,
                delay_sigma_s: delay.sigma_s,
                delay_used: delay.used,
            }),
            as_the_robot: replay.agreement,
            counters: replay.counters,
            map_counters: replay.map_counters,
            slam_bytes: replay.slam_bytes,
            map_capacity: slam_core::capacity::SEGMENTS,
            simulation: None,
            config: replay.config,
        }
    }

    /// The file's content.
    pub fn render(&self) -> Result<Vec<u8>, serde_json::Error> {
        let mut json = serde_json::to_vec_pretty(self)?;
        json.push(b'\n');
        Ok(json)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn percentiles_are_those_of_the_sorted_times() {
        let p = Percentiles::of((1..=101).rev().map(Duration::from_micros));
        for (got, want) in [(p.median, 51.0), (p.p99, 100.0), (p.max, 101.0)] {
            assert!((got - want).abs() < 1e-9);
        }
        assert_eq!(Percentiles::of(std::iter::empty()).max, 0.0);
    }
}
