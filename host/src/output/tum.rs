//! TUM trajectories: `timestamp x y z qx qy qz qw` a line.

use std::fmt::Write;

use nalgebra::Isometry2;
use slam_core::pose::components;

/// Stamps in seconds with their six decimals, poses in metres.
pub fn render<'a>(poses: impl Iterator<Item = (u64, &'a Isometry2<f32>)>) -> String {
    let mut text = String::new();
    for (stamp_us, pose) in poses {
        let c = components(pose);
        let half = 0.5 * f64::from(c.z);
        let (qz, qw) = half.sin_cos();
        let (seconds, micros) = (stamp_us / 1_000_000, stamp_us % 1_000_000);
        // Writing to a String cannot fail.
        let _ = writeln!(text, "{seconds}.{micros:06} {:.6} {:.6} 0 0 0 {qz:.9} {qw:.9}", c.x, c.y);
    }
    text
}
