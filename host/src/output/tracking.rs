//! How well the robot knew where it was, and its odometry was of use, over a whole drive.

use serde::Serialize;
use slam_core::SlamUpdate;
use slam_core::relocalisation::SearchState;
use slam_core::tracking::TrackingState;

use crate::replay::Step;

/// Numbers of scans, and when things first happened.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Tracking {
    /// Scans after which the pose was to be relied on.
    pub tracking: usize,
    /// Scans after which it was uncertain.
    pub uncertain: usize,
    /// Scans after which the robot was lost.
    pub lost: usize,
    /// Stamp of the first of these, seconds.
    pub first_lost_s: Option<f64>,
    /// Times that it found itself in its map again.
    pub relocalised: usize,
    /// Times that it did not, and went on from where it was thought to be.
    pub gave_up: usize,
    /// Scans that overruled the odometry.
    pub odometry_left_out: usize,
    /// Stamp of the first of these, seconds.
    pub first_left_out_s: Option<f64>,
    /// Scans for which the odometry was of no use.
    pub odometry_useless: usize,
    /// Stamp of the first of these, seconds.
    pub first_useless_s: Option<f64>,
}

impl Tracking {
    /// Of a replayed drive.
    pub fn of(steps: &[Step]) -> Self {
        let counted = |holds: fn(&SlamUpdate) -> bool| {
            let mut those = steps.iter().filter(|step| holds(&step.update)).peekable();
            let first_s = those.peek().map(|step| step.stamp_us as f64 / 1e6);
            (those.count(), first_s)
        };
        let (lost, first_lost_s) = counted(|u| u.state == TrackingState::Lost);
        let (odometry_left_out, first_left_out_s) = counted(|u| u.odometry_left_out && !u.odometry_useless);
        let (odometry_useless, first_useless_s) = counted(|u| u.odometry_useless);
        Self {
            tracking: counted(|u| u.state == TrackingState::Tracking).0,
            uncertain: counted(|u| u.state == TrackingState::Uncertain).0,
            lost,
            first_lost_s,
            relocalised: counted(|u| u.relocalisation.is_some_and(|r| r.state == SearchState::Found)).0,
            gave_up: counted(|u| u.relocalisation.is_some_and(|r| r.state == SearchState::GivenUp)).0,
            odometry_left_out,
            first_left_out_s,
            odometry_useless,
            first_useless_s,
        }
    }

    /// For a summary.
    pub fn line(&self) -> String {
        let scans = self.tracking + self.uncertain + self.lost;
        let parts = |counts: &[(usize, &str)]| {
            let some = counts.iter().filter(|(n, _)| *n > 0).map(|(n, what)| format!("{n} {what}"));
            some.collect::<Vec<_>>().join(", ")
        };
        let mut line = match parts(&[(self.uncertain, "uncertain"), (self.lost, "lost")]) {
            bad if bad.is_empty() => "all scans".to_owned(),
            bad => format!("{bad} of {scans}"),
        };
        if self.relocalised > 0 {
            let times =
                if self.relocalised == 1 { "once".into() } else { format!("{} times", self.relocalised) };
            line += &format!("; found itself {times}");
        }
        let odometry = parts(&[(self.odometry_left_out, "left out"), (self.odometry_useless, "useless")]);
        if !odometry.is_empty() {
            line += &format!("; odometry {odometry}");
        }
        line
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_line_says_only_what_was_not_right() {
        let mut tracking = Tracking { tracking: 908, ..Tracking::default() };
        assert_eq!(tracking.line(), "all scans");
        tracking = Tracking { tracking: 893, uncertain: 12, lost: 3, odometry_left_out: 5, ..tracking };
        assert_eq!(tracking.line(), "12 uncertain, 3 lost of 908; odometry 5 left out");
        tracking = Tracking { relocalised: 1, odometry_left_out: 0, ..tracking };
        assert_eq!(tracking.line(), "12 uncertain, 3 lost of 908; found itself once");
        assert_eq!(Tracking::of(&[]), Tracking::default());
    }
}
