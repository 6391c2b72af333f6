//! `trajectory.csv`: a scan a line, with how sure its pose is and what became of it.

use slam_core::SlamUpdate;
use slam_core::geometry::pose::components;
use slam_core::tracking::correction::Verdict;

use crate::replay::Step;

#[derive(serde::Serialize)]
struct Row {
    stamp_s: String,
    x_m: f32,
    y_m: f32,
    theta_rad: f32,
    cov_xx_m2: f32,
    cov_xy_m2: f32,
    cov_xt_m_rad: f32,
    cov_yy_m2: f32,
    cov_yt_m_rad: f32,
    cov_tt_rad2: f32,
    state: &'static str,
    fixed: &'static str,
    odometry: &'static str,
    support: f32,
    residual_m: f32,
}

/// Renders the poses of `trajectory.tum`, as the robot knew them then, with the covariance of (x, y, θ).
pub fn render(steps: &[Step]) -> Result<Vec<u8>, csv::Error> {
    let mut writer = csv::WriterBuilder::new().has_headers(false).from_writer(Vec::new());
    writer.write_record([
        "stamp_s",
        "x_m",
        "y_m",
        "theta_rad",
        "cov_xx_m2",
        "cov_xy_m2",
        "cov_xt_m_rad",
        "cov_yy_m2",
        "cov_yt_m_rad",
        "cov_tt_rad2",
        "state",
        "fixed",
        "odometry",
        "support",
        "residual_m",
    ])?;
    for step in steps {
        let (pose, covariance) = (components(&step.pose), &step.update.covariance);
        writer.serialize(Row {
            stamp_s: super::tum::seconds(step.stamp_us),
            x_m: pose.x,
            y_m: pose.y,
            theta_rad: pose.z,
            cov_xx_m2: covariance[(0, 0)],
            cov_xy_m2: covariance[(0, 1)],
            cov_xt_m_rad: covariance[(0, 2)],
            cov_yy_m2: covariance[(1, 1)],
            cov_yt_m_rad: covariance[(1, 2)],
            cov_tt_rad2: covariance[(2, 2)],
            state: state(&step.update),
            fixed: fixed(&step.update),
            odometry: odometry(&step.update),
            // Without a minus before zero.
            support: step.update.support + 0.0,
            residual_m: step.update.residual_m,
        })?;
    }
    writer.into_inner().map_err(|e| e.into_error().into())
}

/// How far the pose is to be relied on; `rejected` where the scan was not used.
fn state(update: &SlamUpdate) -> &'static str {
    if update.rejected.is_some() { "rejected" } else { update.state.name() }
}

/// What the pairs fixed; `uncorrected` where the pose is the odometry's.
fn fixed(update: &SlamUpdate) -> &'static str {
    match update.observability.verdict {
        _ if !update.corrected => "uncorrected",
        Verdict::Full => "full",
        Verdict::Corridor => "corridor",
        Verdict::Blind => "blind",
    }
}

/// What became of the odometry's motion: `left_out` where this scan overruled it, `useless` where it has been of no use for a while.
fn odometry(update: &SlamUpdate) -> &'static str {
    match update {
        update if update.odometry_useless => "useless",
        update if update.odometry_left_out => "left_out",
        _ => "used",
    }
}
