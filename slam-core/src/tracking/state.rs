//! Whether the pose is to be relied on: a state with hysteresis, from how well scans are explained.

use crate::geometry::math::max;

/// How far the pose is to be relied on.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize), serde(rename_all = "snake_case"))]
pub enum TrackingState {
    /// Scans are explained by the map, or show what it has not got yet.
    #[default]
    Tracking,
    /// Scans have been explained badly for a while: what they show enters the map late and sparsely.
    Uncertain,
    /// The robot was displaced, the map contradicts what is seen, or nothing has been seen for long: nothing enters the map.
    Lost,
}

impl TrackingState {
    /// Its name, as files and logs have it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Tracking => "tracking",
            Self::Uncertain => "uncertain",
            Self::Lost => "lost",
        }
    }
}

/// When the state changes.
#[derive(Clone, Copy, Debug, PartialEq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct StateConfig {
    /// A scan explained to this share counts as good, …
    pub good_score: f32,
    /// … one explained to less than this as bad; between them nothing changes.
    pub bad_score: f32,
    /// Bad scans in a row from which on the pose is uncertain.
    pub uncertain_after: u8,
    /// Bad scans that the map contradicts, since the last good ones, from which on the robot is lost.
    pub lost_after: u8,
    /// Way with less to see than [`Self::least_segments`] from which on the robot is lost, metres; a radian counts as a metre. It
    /// ends with what is seen: what the odometry has told since is as sure as it says.
    pub lost_way_m: f32,
    /// See there.
    pub least_segments: u16,
    /// Good scans in a row that end both.
    pub found_after: u8,
    /// Share of the walls that should be seen and are seen through, from which on the map contradicts the scan.
    pub contradicted_share: f32,
    /// What may be missing, summed over the scans of a robot that has hardly moved by its wheels, of what the scans before were explained
    /// to, as a share of it, until it is lost: somebody displaced it.
    pub most_missing: f32,
    /// A scan may miss this share of it.
    pub standing_slack: f32,
    /// Way that counts as hardly moved, metres; a radian counts as a metre.
    pub standing_m: f32,
}

/// Where scans before were explained to less than this, worse ones say nothing.
const LEAST_EXPECTED: f32 = 0.7;
/// What a scan adds to the mean of what scans are explained to.
const EXPECTED_SHARE: f32 = 0.2;

/// The state and what it is judged by.
#[derive(Clone, Copy, Debug, Default)]
pub struct StateMonitor {
    state: TrackingState,
    good: u8,
    bad: u8,
    contradicted: u8,
    blind_way_m: f32,
    /// Share of a scan that is explained where the robot goes on, the mean over the last ones.
    expected: f32,
    /// What has been missing of that, summed up while the robot has hardly moved.
    missing: f32,
    /// Way since that began, metres; a radian counts as a metre.
    missing_m: f32,
    /// The robot is lost, and not only because there was nothing to see.
    displaced: bool,
}

/// What one scan says of it.
#[derive(Clone, Copy, Debug)]
pub struct Evidence {
    /// Share of the scan explained.
    pub score: f32,
    /// Share of the walls that should be seen and are seen through instead.
    pub contradicted_share: f32,
    /// Segments seen.
    pub segments: u16,
    /// Way since the scan before, metres; a radian counts as a metre.
    pub way_m: f32,
}

impl StateMonitor {
    /// The state.
    pub fn state(&self) -> TrackingState {
        self.state
    }

    /// Bad scans in a row.
    pub fn bad_scans(&self) -> u8 {
        self.bad
    }

    /// Whether the robot is lost because it is elsewhere than it thinks, and not because there was nothing to see.
    pub fn is_displaced(&self) -> bool {
        self.displaced
    }

    /// The robot may be anywhere.
    pub fn displace(&mut self) {
        *self = Self { state: TrackingState::Lost, displaced: true, ..Self::default() };
    }

    /// The robot has been found.
    pub fn found(&mut self) {
        *self = Self::default();
    }

    /// A robot that stands sees what it saw: scans that are explained much worse than those before say that it was displaced. A
    /// cumulative sum test (Page, "Continuous inspection schemes", Biometrika 1954).
    fn count_unexplained(&mut self, evidence: &Evidence, config: &StateConfig) {
        let expected = self.expected >= LEAST_EXPECTED;
        let missing = if expected { 1.0 - evidence.score / self.expected } else { 0.0 };
        self.missing = max(self.missing + missing - config.standing_slack, 0.0);
        self.missing_m += evidence.way_m;
        if self.missing == 0.0 || self.missing_m > config.standing_m {
            // It has gone on, and may see what it has not seen before.
            (self.missing, self.missing_m) = (0.0, 0.0);
            self.expected += EXPECTED_SHARE * (evidence.score - self.expected);
        }
    }

    /// It was not found, and goes on all the same.
    pub fn give_up(&mut self) {
        *self = Self { state: TrackingState::Uncertain, ..Self::default() };
    }

    /// Takes in a scan.
    pub fn update(&mut self, evidence: &Evidence, config: &StateConfig) -> TrackingState {
        let next = |counter: u8, holds: bool| if holds { counter.saturating_add(1) } else { 0 };
        let bad = evidence.score < config.bad_score;
        self.bad = next(self.bad, bad);
        self.good = next(self.good, evidence.score >= config.good_score);
        self.count_unexplained(evidence, config);
        let contradicted = bad && evidence.contradicted_share >= config.contradicted_share;
        // A scan that shows nothing either way neither confirms nor clears.
        self.contradicted = self.contradicted.saturating_add(u8::from(contradicted));
        let blind = evidence.segments < config.least_segments;
        self.blind_way_m = if blind { self.blind_way_m + evidence.way_m } else { 0.0 };
        if self.good >= config.found_after {
            self.contradicted = 0;
        }
        self.displaced = self.contradicted >= config.lost_after || self.missing > config.most_missing;
        self.state = if self.displaced {
            TrackingState::Lost
        } else if self.good >= config.found_after {
            TrackingState::Tracking
        } else if self.blind_way_m >= config.lost_way_m {
            TrackingState::Lost
        } else if self.bad >= config.uncertain_after || self.state == TrackingState::Lost {
            TrackingState::Uncertain
        } else {
            self.state
        };
        self.state
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const CONFIG: StateConfig = StateConfig {
        good_score: 0.5,
        bad_score: 0.3,
        uncertain_after: 2,
        lost_after: 4,
        lost_way_m: 5.0,
        least_segments: 2,
        found_after: 3,
        contradicted_share: 0.5,
        most_missing: 1.5,
        standing_slack: 0.25,
        standing_m: 0.1,
    };

    fn fed(monitor: &mut StateMonitor, score: f32, contradicted_share: f32, times: usize) -> TrackingState {
        let segments = if score == 0.0 { 0 } else { 5 };
        let evidence = Evidence { score, contradicted_share, segments, way_m: 0.1 };
        (0..times).map(|_| monitor.update(&evidence, &CONFIG)).last().unwrap()
    }

    #[test]
    fn one_bad_scan_changes_nothing_and_two_make_it_uncertain() {
        let mut monitor = StateMonitor::default();
        assert_eq!(fed(&mut monitor, 0.9, 0.0, 5), TrackingState::Tracking);
        assert_eq!(fed(&mut monitor, 0.1, 0.0, 1), TrackingState::Tracking);
        assert_eq!(fed(&mut monitor, 0.1, 0.0, 1), TrackingState::Uncertain);
        assert_eq!(fed(&mut monitor, 0.4, 0.0, 9), TrackingState::Uncertain, "between both nothing changes");
        assert_eq!(fed(&mut monitor, 0.9, 0.0, 2), TrackingState::Uncertain);
        assert_eq!(fed(&mut monitor, 0.9, 0.0, 1), TrackingState::Tracking);
    }

    #[test]
    fn it_is_lost_where_the_map_contradicts_or_after_a_way() {
        let mut monitor = StateMonitor::default();
        assert_eq!(fed(&mut monitor, 0.1, 0.8, 3), TrackingState::Uncertain);
        assert_eq!(fed(&mut monitor, 0.1, 0.8, 1), TrackingState::Lost);
        assert_eq!(fed(&mut monitor, 0.9, 0.0, 1), TrackingState::Lost, "one good scan may be luck");
        assert_eq!(fed(&mut monitor, 0.9, 0.0, 2), TrackingState::Tracking);
        assert_eq!(fed(&mut monitor, 0.0, 0.0, 40), TrackingState::Uncertain);
        assert_eq!(fed(&mut monitor, 0.0, 0.0, 15), TrackingState::Lost, "after five metres");
        assert_eq!(
            fed(&mut monitor, 0.1, 0.0, 1),
            TrackingState::Uncertain,
            "there is something to see again"
        );
    }
    /// A robot that stands or creeps, after so many scans that were explained to this share.
    fn standing(score: f32) -> StateMonitor {
        let mut monitor = StateMonitor::default();
        creep(&mut monitor, score, 0.0, 20);
        monitor
    }

    fn creep(monitor: &mut StateMonitor, score: f32, way_m: f32, times: usize) -> TrackingState {
        let evidence = Evidence { score, contradicted_share: 0.0, segments: 5, way_m };
        (0..times).map(|_| monitor.update(&evidence, &CONFIG)).last().unwrap()
    }

    #[test]
    fn a_robot_that_stands_and_sees_something_else_was_displaced() {
        let mut monitor = standing(0.95);
        assert_eq!(creep(&mut monitor, 0.1, 0.0, 2), TrackingState::Uncertain);
        assert_eq!(creep(&mut monitor, 0.1, 0.0, 1), TrackingState::Lost);
        assert!(monitor.is_displaced());
        monitor.found();
        assert!(!monitor.is_displaced() && monitor.state() == TrackingState::Tracking);
        // What fits half takes longer, and a scan now and then that somebody walked through says nothing.
        let mut monitor = standing(0.95);
        assert_eq!(creep(&mut monitor, 0.5, 0.0, 5), TrackingState::Tracking);
        assert_eq!(creep(&mut monitor, 0.5, 0.0, 5), TrackingState::Lost);
        let mut monitor = standing(0.95);
        for _ in 0..20 {
            creep(&mut monitor, 0.1, 0.0, 1);
            assert_eq!(creep(&mut monitor, 0.95, 0.0, 3), TrackingState::Tracking);
        }
    }

    #[test]
    fn one_that_goes_on_comes_to_where_nothing_is_known() {
        let mut monitor = standing(0.95);
        assert_eq!(creep(&mut monitor, 0.1, 0.06, 30), TrackingState::Uncertain);
        // And where little was known before, little says nothing.
        let mut monitor = standing(0.5);
        assert_eq!(creep(&mut monitor, 0.1, 0.0, 30), TrackingState::Uncertain);
        assert!(!monitor.is_displaced());
    }

    #[test]
    fn one_that_may_be_anywhere_is_lost_until_it_is_found() {
        let mut monitor = standing(0.95);
        monitor.displace();
        assert!(monitor.is_displaced() && monitor.state() == TrackingState::Lost);
        monitor.give_up();
        assert!(!monitor.is_displaced());
        assert_eq!(creep(&mut monitor, 0.4, 0.1, 5), TrackingState::Uncertain);
        assert_eq!(creep(&mut monitor, 0.9, 0.1, 3), TrackingState::Tracking);
    }
}
