//! How thick the walls of a replay are.

use nalgebra::Point2;

use crate::beams::seen;
use crate::log::Log;
use crate::replay::Replay;
use crate::score::{self, Spread, StampedPose};

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

/// What was seen farther off says how well headings are known rather than how walls lie; it is left out, metres.
const FARTHEST_M: f32 = 20.0;

/// The walls of a replay's scans, laid by these poses. Not a number where the poses are of another time.
pub fn walls(log: &Log, replay: &Replay, poses: &[StampedPose]) -> Walls {
    let steps = &replay.steps;
    let stamps_s: Vec<f64> = steps.iter().map(|step| step.stamp_us as f64 * 1e-6).collect();
    let poses = score::at_stamps(poses, &stamps_s).map(|matched| matched.poses).unwrap_or_default();
    let laid: Vec<(u32, Vec<Point2<f64>>)> = steps
        .iter()
        .zip(poses)
        .enumerate()
        .map(|(k, (step, pose))| {
            let seen = seen(log, replay, k);
            let near = seen.obstacles().filter(|point| point.coords.norm() < FARTHEST_M);
            let laid = near.map(|point| pose * nalgebra::convert::<_, Point2<f64>>(point));
            ((step.update.way_m / PASS_M) as u32, laid.collect())
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
