//! The only stateful wiring: a scan and a motion go in, a pose and a map come out.

mod access;
mod recovery;
mod relocation;
mod saved;

use nalgebra::Isometry2;

use crate::config::SlamConfig;
use crate::estimator::{Estimator, Surroundings};
use crate::frontend::Frontend;
use crate::map::SegmentMap;
use crate::map::visibility::{View, is_gone, mark_seen_through};
use crate::odometry::Increment;
use crate::odometry::health::{OdometryHealth, ScanEvidence};
use crate::odometry::track::ScanMotion;
use crate::places::{Places, Visit};
use crate::relocalisation::Relocaliser;
use crate::sensor::scan::Scan;
use crate::tracking::correction::Prior;
use crate::tracking::state::StateMonitor;
use crate::tracking::tracker::Scene;
use crate::tracking::{Hypothesis, Tracker, TrackingState};
pub use crate::update::{Counters, ScanRejection, SlamUpdate, Stage};

/// Map, pose and working memory: room for `N` map segments, `BEAMS` beams and `P` places.
///
/// RAM: [`Slam::BYTES`], about 42 bytes for each map segment, 16 for each beam, 172 for each place and 40 KiB.
pub struct Slam<const N: usize, const BEAMS: usize = 682, const P: usize = 96> {
    config: SlamConfig,
    map: SegmentMap<N>,
    estimator: Estimator,
    frontend: Frontend<BEAMS>,
    tracker: Tracker<N>,
    places: Places<P>,
    odometry: OdometryHealth,
    state: StateMonitor,
    relocaliser: Relocaliser,
    /// Whether the map learns.
    mapping: bool,
    counters: Counters,
}

impl<const N: usize, const BEAMS: usize, const P: usize> Slam<N, BEAMS, P> {
    /// Takes in one scan and the motion that led to it.
    ///
    /// Never panics, whatever the numbers: what cannot be used is counted, see [`Counters`] and
    /// [`SlamUpdate::rejected`].
    pub fn process_scan(&mut self, scan: &Scan<'_>, motion: &ScanMotion) -> SlamUpdate {
        self.process_scan_watched(scan, motion, &mut |_| ())
    }

    /// The same, for whoever measures: `watch` is told each [`Stage`] as it begins, [`Stage::Prediction`] excepted, which is
    /// the first. Association and correction take turns.
    pub fn process_scan_watched(
        &mut self,
        scan: &Scan<'_>,
        motion: &ScanMotion,
        watch: &mut impl FnMut(Stage),
    ) -> SlamUpdate {
        let by_odometry = motion.since_previous;
        let expected = self.odometry.expected(motion);
        let motion = expected.as_ref().unwrap_or(motion);
        let previous = self.estimator.pose();
        let prior = self.predict(motion);
        let mut update = SlamUpdate::predicted(&prior, self.state.state());
        update.rejected = ScanRejection::of(scan, &self.config.sensor.geometry);
        if update.rejected.is_none() {
            self.observe(scan, motion, &mut update, watch);
            if self.is_relocalising() {
                self.look_for_robot(scan, motion, &mut update, watch);
            } else {
                self.track(&previous, &prior, &mut update, watch);
            }
            self.monitor_odometry(&by_odometry, &previous, &mut update);
            self.judge_state(scan, &motion.since_previous, &mut update);
            if self.mapping {
                self.register(&mut update, watch);
                self.forget(scan, &update);
                self.keep_places(&by_odometry, &mut update);
            } else {
                let Self { config, estimator, map, .. } = self;
                estimator.follow(config, map);
            }
        } else {
            self.pass_unseen(&by_odometry);
        }
        self.finish(&mut update);
        update
    }

    /// The estimator, and what it works with.
    fn estimator(&mut self) -> (&mut Estimator, Surroundings<'_, N>) {
        let Self { config, odometry, frontend, map, tracker, estimator, .. } = self;
        (estimator, Surroundings { config, odometry, observed: frontend.segments(), map, tracker })
    }

    /// What is matched.
    fn scene(&self) -> Scene<'_> {
        Scene { observed: self.frontend.segments(), map: self.map.segments(), config: &self.config }
    }

    /// Where the odometry says the base is.
    fn predict(&mut self, motion: &ScanMotion) -> Prior {
        let (estimator, mut around) = self.estimator();
        let is_usable = estimator.predict(motion, &mut around);
        self.counters.count_motion(is_usable);
        if self.mapping && self.estimator.is_way_long() {
            // Between the commit of one keyframe's update and the next keyframe.
            let Self { config, estimator, tracker, map, .. } = self;
            estimator.open_lines(config, tracker.nearby.all(), None, map);
        }
        self.estimator.local()
    }

    /// Ranges to segments in `base`.
    fn observe(
        &mut self,
        scan: &Scan<'_>,
        motion: &ScanMotion,
        update: &mut SlamUpdate,
        watch: &mut impl FnMut(Stage),
    ) {
        let spacing_m = self.estimator.spacing_m(&self.config.registration);
        let number = self.estimator.scans();
        (update.deskew, update.extraction) =
            self.frontend.observe(scan, motion, spacing_m, number, &self.config, watch);
    }

    /// From the prediction to the pose that explains the scan best.
    fn track(
        &mut self,
        previous: &Isometry2<f32>,
        prior: &Prior,
        update: &mut SlamUpdate,
        watch: &mut impl FnMut(Stage),
    ) {
        let scene =
            Scene { observed: self.frontend.segments(), map: self.map.segments(), config: &self.config };
        let tracked = self.tracker.track(&scene, previous, prior, watch);
        update.take(&tracked);
        self.estimator.accept(&tracked.hypothesis);
        if let Some(left_out) = &tracked.left_out {
            let (estimator, mut around) = self.estimator();
            if !estimator.overrule(left_out, &mut around) {
                return;
            }
            // The commit has moved lines, and merging may have renumbered them.
            let scene =
                Scene { observed: self.frontend.segments(), map: self.map.segments(), config: &self.config };
            let (pose, covariance) = (self.estimator.pose(), tracked.hypothesis.covariance);
            self.tracker.associate(&scene, &Hypothesis::at(pose, covariance));
        }
    }

    /// The odometry against the scanner, and how noisy both are.
    fn monitor_odometry(&mut self, motion: &Increment, previous: &Isometry2<f32>, update: &mut SlamUpdate) {
        let (pose, bias) = (self.estimator.pose(), self.estimator.odometry_bias());
        update.residual_m = self.tracker.residual_m(&self.scene(), &pose);
        let evidence = ScanEvidence {
            previous,
            pose: &pose,
            support: update.support,
            observability: &update.observability,
            residual_m: update.residual_m,
            jumped: update.odometry_left_out,
            bias: &bias,
        };
        if let Some((line_noise, noise)) = self.odometry.update(motion, &evidence, &self.config) {
            (self.config.line_noise, self.config.odometry.noise) = (line_noise, noise);
        }
    }

    /// Whether the pose is to be relied on, by what the map makes of the scan.
    fn judge_state(&mut self, scan: &Scan<'_>, motion: &Increment, update: &mut SlamUpdate) {
        if self.is_relocalising() {
            update.state = self.state.state();
            return;
        }
        let pose = self.estimator.pose();
        let evidence = self.tracker.evidence(&self.scene(), scan, &pose, update.support, motion);
        update.contradicted_share = evidence.contradicted_share;
        update.state = self.state.update(&evidence, &self.config.state);
        if self.is_relocalising() {
            // It may as well be where it is thought to be.
            self.relocaliser.begin(Some(self.estimator.local()));
        }
    }

    /// From pairs to map.
    fn register(&mut self, update: &mut SlamUpdate, watch: &mut impl FnMut(Stage)) {
        watch(Stage::Registration);
        let (estimator, mut around) = self.estimator();
        update.registration = estimator.register(update, &mut around);
    }

    /// Forgets what a keyframe has seen through, and opens what the robot or beams went through in part.
    fn forget(&mut self, scan: &Scan<'_>, update: &SlamUpdate) {
        // What is seen from a wrong pose, and the way there, says nothing of the map.
        let is_sure = update.corrected && update.state != TrackingState::Lost;
        let Self { config, estimator, tracker, map, .. } = self;
        let Some(forgetting) = config.forgetting.as_ref().filter(|_| is_sure) else {
            estimator.restart_way();
            return;
        };
        let (pose, stamp) = (estimator.pose(), estimator.stamp());
        // As the registration left them: fusing may have moved segments.
        let nearby = tracker.nearby.all();
        let view = View::new(scan, &pose, &config.sensor, forgetting);
        if update.registration.keyframe {
            mark_seen_through(&view, stamp.scan, nearby, map);
        }
        // A scan that searches has enough to do.
        let view = Some(&view).filter(|_| update.registration.committed && !update.searched);
        estimator.open_lines(config, nearby, view, map);
        if !update.registration.keyframe {
            return;
        }
        while let Some(index) = map.segments().iter().position(|s| is_gone(s, forgetting)) {
            estimator.forget_line(index, map);
        }
        if let Some(walls) = &config.walls {
            estimator.tidy(walls, map);
        }
    }

    /// Takes the scan into the places, and does some of their work. Where loops have corrected them, everything moves with them.
    fn keep_places(&mut self, motion: &Increment, update: &mut SlamUpdate) {
        let Some(config) = self.config.places else { return };
        if update.state == TrackingState::Lost {
            self.places.pass_blindly(motion);
            return;
        }
        let visit = Visit {
            pose: self.estimator.pose(),
            motion: *motion,
            way_m: self.estimator.travelled_m(),
            verdict: update.observability.verdict,
            support: update.support,
            map: self.map.segments(),
            walls: self.config.walls.as_ref(),
        };
        self.places.visit(&visit, &config);
        for _ in 0..self.places.steps(motion, update.registration.keyframe) {
            // One at most for each scan: who asks how the places have moved must not miss any.
            update.closure = self.places.step(&visit, &config);
            if let Some(closure) = update.closure {
                let Self { config, odometry, frontend, map, tracker, estimator, places, .. } = self;
                let mut around =
                    Surroundings { config, odometry, observed: frontend.segments(), map, tracker };
                estimator.carry(&closure.moved, places, &mut around);
                places.moved_all();
                odometry.map_moved();
                update.predicted = closure.moved * update.predicted;
                break;
            }
        }
    }

    /// Counts the scan and says where everything stands.
    fn finish(&mut self, update: &mut SlamUpdate) {
        self.counters.count(update);
        self.estimator.end_scan();
        update.pose = self.estimator.pose();
        update.covariance = self.covariance();
        update.way_m = self.estimator.travelled_m();
        update.odometry_useless = self.odometry.is_useless();
        update.wheel_fault = self.odometry.wheel_fault();
        update.counters = self.counters;
        update.map_counters = self.map.counters();
    }
}
