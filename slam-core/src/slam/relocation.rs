//! A robot that was displaced looks for itself in its map.

use super::Slam;
use crate::geometry::pose::diagonal;
use crate::odometry::Increment;
use crate::odometry::track::ScanMotion;
use crate::relocalisation::{Evidence, PoseHypothesis, Relocaliser, SearchState};
use crate::sensor::scan::Scan;
use crate::tracking::correction::Prior;
use crate::tracking::tracker::Scene;
use crate::update::{SlamUpdate, Stage};

/// How far off a robot may be that was displaced where nothing is known, or begins where somebody says: standard deviations of x, y (m)
/// and θ (rad).
pub(super) const THOUGHT: [f32; 3] = [0.2, 0.2, 0.1];

impl<const N: usize, const BEAMS: usize, const P: usize> Slam<N, BEAMS, P> {
    /// The robot may be anywhere in its map: it is [`Lost`](crate::tracking::TrackingState::Lost) from now on, and looks for itself with each
    /// scan. [`SlamUpdate::relocalisation`] says what is known; once it is found the robot goes on from there. Nothing happens where
    /// the configuration has no [`relocalisation`](crate::SlamConfig::relocalisation).
    pub fn relocalise(&mut self) {
        if self.config.relocalisation.is_some() {
            self.state.displace();
            self.relocaliser.begin(None);
        }
    }

    /// Where a robot may be that is looking for itself.
    pub fn pose_hypotheses(&self) -> &[PoseHypothesis] {
        self.relocaliser.hypotheses()
    }

    /// Whether the pose is not tracked, but looked for.
    pub(super) fn is_relocalising(&self) -> bool {
        self.config.relocalisation.is_some() && self.state.is_displaced()
    }

    /// The robot moved where no scan was taken in.
    pub(super) fn pass_unseen(&mut self, motion: &Increment) {
        let is_relocalising = self.is_relocalising();
        let Self { config, estimator, places, odometry, relocaliser, .. } = self;
        places.pass_blindly(motion);
        if is_relocalising {
            relocaliser.go_on(motion, |at| estimator.predicted(at, motion, odometry, config));
        }
    }

    /// Takes a scan to look for the robot; where it is found it goes on from there.
    pub(super) fn look_for_robot(
        &mut self,
        scan: &Scan<'_>,
        motion: &ScanMotion,
        update: &mut SlamUpdate,
        watch: &mut impl FnMut(Stage),
    ) {
        let Self { config, map, estimator, frontend, tracker, places, odometry, relocaliser, .. } = self;
        let Some(settings) = &config.relocalisation else { return };
        let scene = Scene { observed: frontend.segments(), map: map.segments(), config };
        let motion = &motion.since_previous;
        let evidence = Evidence { scene, scan, places, motion };
        let predicted = |at: &Prior| estimator.predicted(at, motion, odometry, config);
        let outcome = relocaliser.step(&evidence, tracker, predicted, settings, watch);
        update.relocalisation = Some(outcome);
        let at = match (outcome.state, outcome.best) {
            (SearchState::Found, Some(found)) => found.prior(),
            (SearchState::GivenUp, _) => {
                let Prior { pose, covariance } = estimator.local();
                Prior { pose, covariance: covariance + diagonal(THOUGHT) }
            }
            _ => {
                tracker.forget_pairs();
                return;
            }
        };
        let hypothesis = tracker.refined_at(&scene, &at, watch);
        update.take_pose(&hypothesis);
        self.jump(&Prior { pose: hypothesis.pose, covariance: hypothesis.covariance });
        if outcome.state == SearchState::GivenUp {
            self.state.give_up();
        }
    }

    /// The robot goes on from a pose: what was known of the way there says nothing of it.
    pub(super) fn jump(&mut self, to: &Prior) {
        let Self { config, estimator, map, .. } = self;
        estimator.restart(to, config, map);
        self.places.pass_lost();
        self.odometry.map_moved();
        self.relocaliser = Relocaliser::new();
        self.state.found();
    }
}
