//! Whether the pose is to be relied on: a state with hysteresis, from how well scans are explained.

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
    /// The map contradicts what is seen, or nothing has been seen for long: nothing enters the map.
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
}

/// The state and what it is judged by.
#[derive(Clone, Copy, Debug, Default)]
pub struct StateMonitor {
    state: TrackingState,
    good: u8,
    bad: u8,
    contradicted: u8,
    blind_way_m: f32,
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

    /// Takes in a scan.
    pub fn update(&mut self, evidence: &Evidence, config: &StateConfig) -> TrackingState {
        let next = |counter: u8, holds: bool| if holds { counter.saturating_add(1) } else { 0 };
        let bad = evidence.score < config.bad_score;
        self.bad = next(self.bad, bad);
        self.good = next(self.good, evidence.score >= config.good_score);
        let contradicted = bad && evidence.contradicted_share >= config.contradicted_share;
        // A scan that shows nothing either way neither confirms nor clears.
        self.contradicted = self.contradicted.saturating_add(u8::from(contradicted));
        let blind = evidence.segments < config.least_segments;
        self.blind_way_m = if blind { self.blind_way_m + evidence.way_m } else { 0.0 };
        if self.good >= config.found_after {
            self.contradicted = 0;
        }
        self.state = if self.good >= config.found_after {
            TrackingState::Tracking
        } else if self.contradicted >= config.lost_after || self.blind_way_m >= config.lost_way_m {
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
}
