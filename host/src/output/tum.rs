//! TUM trajectories: `timestamp x y z qx qy qz qw` a line.

use std::fmt::Write;

use nalgebra::Isometry2;
use slam_core::geometry::pose::components;

/// Stamps in seconds with their six decimals, poses in metres.
pub fn render<'a>(poses: impl Iterator<Item = (u64, &'a Isometry2<f32>)>) -> String {
    let mut text = String::new();
    for (stamp_us, pose) in poses {
        let c = components(pose);
        line(&mut text, stamp_us, c.x.into(), c.y.into(), c.z.into());
    }
    text
}

/// The same for poses of twice the digits.
pub fn render_f64<'a>(poses: impl Iterator<Item = (u64, &'a Isometry2<f64>)>) -> String {
    let mut text = String::new();
    for (stamp_us, pose) in poses {
        line(&mut text, stamp_us, pose.translation.x, pose.translation.y, pose.rotation.angle());
    }
    text
}

/// A stamp in seconds with its six decimals.
pub(super) fn seconds(stamp_us: u64) -> String {
    format!("{}.{:06}", stamp_us / 1_000_000, stamp_us % 1_000_000)
}

fn line(text: &mut String, stamp_us: u64, x_m: f64, y_m: f64, theta_rad: f64) {
    let half = 0.5 * theta_rad;
    let (qz, qw) = (libm::sin(half), libm::cos(half));
    // Writing to a String cannot fail.
    let _ = writeln!(text, "{} {x_m:.6} {y_m:.6} 0 0 0 {qz:.9} {qw:.9}", seconds(stamp_us));
}
