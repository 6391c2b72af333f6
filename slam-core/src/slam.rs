//! The only stateful wiring: a scan and a motion go in, a pose and a map come out.

use core::mem::MaybeUninit;
use heapless::Vec;

use nalgebra::{Isometry2, Matrix3, Vector3};

use crate::config::{ConfigError, SlamConfig};
use crate::correction::{Observability, Prior, Verdict};
use crate::deskew::{DeskewReport, ScanPoint, deskew};
use crate::extraction::{ExtractionReport, MAX_SEGMENTS, extract};
use crate::joint::Joint;
use crate::keyframe::{AmongLines, Keyframe, KeyframeConfig, Settled};
use crate::loop_closure::{Closure, LoopConfig, PendingClosure, drift};
use crate::map::{MapSegment, SegmentMap};
use crate::math::{max, sqrt};
use crate::noise_learning::NoiseLearning;
use crate::odometry::Increment;
use crate::odometry_bias::OdometryBias;
use crate::odometry_monitor::OdometryMonitor;
use crate::odometry_track::ScanMotion;
use crate::paper::end_points::register_end_points;
use crate::pose::{difference, is_finite, normalized, perpendicular, rotate_covariance};
use crate::registration::{Eye, Observed, RegistrationConfig, RegistrationReport, Sightings, Stamp, Start};
use crate::scan::{Scan, SensorConfig};
use crate::segment::Segment;
use crate::tracking::state::{Evidence, StateMonitor};
use crate::tracking::tracker::{Kernel, Scene, left_out};
use crate::tracking::{Hypothesis, Tracker, TrackingState};
pub use crate::update::{Counters, ScanRejection, SlamUpdate, Stage};
use crate::visibility::{confirmed_and_contradicted, is_gone, mark_seen_through};
use crate::wheel_faults::{WheelFault, WheelMonitor};

/// Map, pose and working memory: room for `N` map segments and `BEAMS` beams.
///
/// RAM: [`Slam::BYTES`], about 66 bytes for each map segment, 16 for each beam and 30 KiB.
pub struct Slam<const N: usize, const BEAMS: usize = 682> {
    config: SlamConfig,
    map: SegmentMap<N>,
    map_from_base: Isometry2<f32>,
    /// Of the pose among the lines around it; what they have in common with it is the joint estimate's.
    local_covariance: Matrix3<f32>,
    counters: Counters,
    way_m: f32,
    closing: PendingClosure,
    joint: Option<Joint>,
    keyframe: Keyframe,
    sightings: Sightings,
    /// Where the joint estimate last took in a keyframe wholly, and how sure it was of the pose then.
    settled: Settled,
    points: Vec<ScanPoint, BEAMS>,
    observed: Vec<Segment, MAX_SEGMENTS>,
    tracker: Tracker<N>,
    state: StateMonitor,
    odometry: OdometryMonitor,
    learning: NoiseLearning,
    wheels: WheelMonitor,
    /// Whether the last scan fixed the pose.
    fixed: bool,
}

impl<const N: usize, const BEAMS: usize> Slam<N, BEAMS> {
    /// Size in RAM.
    pub const BYTES: usize = core::mem::size_of::<Self>();

    /// An empty map, with the robot at its origin.
    pub fn new(config: SlamConfig) -> Result<Self, ConfigError> {
        Self::check(&config)?;
        let mut slam = Self::blank(config);
        slam.prepare();
        Ok(slam)
    }

    /// The same, made where it is to stay: no copy of it passes over the stack.
    pub fn new_in(place: &mut MaybeUninit<Self>, config: SlamConfig) -> Result<&mut Self, ConfigError> {
        Self::check(&config)?;
        let slam = place.write(Self::blank(config));
        slam.prepare();
        Ok(slam)
    }

    /// Takes another scanner, or the same one whose beams lie otherwise from now on, as scanners that do not turn evenly need it
    /// before each scan. Map and pose stay.
    pub fn set_sensor(&mut self, sensor: SensorConfig) -> Result<(), ConfigError> {
        let config = SlamConfig { sensor, ..self.config };
        Self::check(&config)?;
        self.config = config;
        Ok(())
    }

    pub(crate) fn check(config: &SlamConfig) -> Result<(), ConfigError> {
        config.validate()?;
        let beams = config.sensor.geometry.beams();
        if beams > BEAMS {
            return Err(ConfigError::TooManyBeams { beams, capacity: BEAMS });
        }
        Ok(())
    }

    /// Before [`Self::prepare`]. Inlined, so that it is built in its place.
    #[inline(always)]
    pub(crate) fn blank(config: SlamConfig) -> Self {
        Self {
            config,
            map: SegmentMap::new(),
            map_from_base: Isometry2::identity(),
            local_covariance: Matrix3::zeros(),
            counters: Counters::default(),
            way_m: 0.0,
            closing: PendingClosure::default(),
            joint: None,
            keyframe: Keyframe::at(Isometry2::identity(), AmongLines::default()),
            sightings: Sightings::default(),
            settled: Settled::default(),
            points: Vec::new(),
            observed: Vec::new(),
            tracker: Tracker::new(),
            state: StateMonitor::default(),
            odometry: OdometryMonitor::default(),
            wheels: WheelMonitor::default(),
            learning: NoiseLearning::new(config.line_noise, config.odometry.noise),
            fixed: false,
        }
    }

    /// What depends on the configuration.
    pub(crate) fn prepare(&mut self) {
        if matches!(self.config.registration, RegistrationConfig::Joint(_)) {
            let sigmas = self.odometry_sigmas();
            self.joint.insert(Joint::blank()).prepare(sigmas);
        }
    }

    /// The settings.
    pub fn config(&self) -> &SlamConfig {
        &self.config
    }

    /// The map.
    pub fn map(&self) -> &SegmentMap<N> {
        &self.map
    }

    /// Pose of `base` in `map` at the last scan.
    pub fn pose(&self) -> Isometry2<f32> {
        self.map_from_base
    }

    /// Covariance of the pose (x, y, θ), in `map`.
    pub fn covariance(&self) -> Matrix3<f32> {
        if self.joint.is_none() {
            return self.local_covariance;
        }
        // What the walls that were seen have in common does not average out over many of them.
        let in_common = self.config.line_noise.var_offset();
        self.settled.carried(&self.map_from_base)
            + self.settled.grown(&self.local_covariance)
            + Matrix3::from_diagonal(&Vector3::new(in_common, in_common, 0.0))
    }

    /// Systematic errors of the odometry as learnt so far.
    pub fn odometry_bias(&self) -> OdometryBias {
        self.joint.as_ref().map_or_else(OdometryBias::default, Joint::bias)
    }

    /// How far the pose is to be relied on.
    pub fn state(&self) -> TrackingState {
        self.state.state()
    }

    /// What is wrong with the wheels, where that is known.
    pub fn wheel_fault(&self) -> Option<WheelFault> {
        self.wheels.fault()
    }

    /// Counters since the start.
    pub fn counters(&self) -> Counters {
        self.counters
    }

    /// Points of the last scan that were placed, in `base` at its middle beam.
    pub fn points(&self) -> &[ScanPoint] {
        &self.points
    }

    /// Segments seen in the last scan, in `base` at its middle beam.
    pub fn observed(&self) -> &[Segment] {
        &self.observed
    }

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
        // Without useful odometry the last motion is taken to go on.
        let by_odometry = motion.since_previous;
        let instead = if self.odometry.is_useless() {
            Some(self.odometry.expected())
        } else {
            self.odometry.made_up(&by_odometry)
        };
        let instead = instead.map(|increment| motion.evenly(increment));
        let motion = instead.as_ref().unwrap_or(motion);
        let prior = self.predict(motion);
        let mut update = SlamUpdate {
            pose: prior.pose,
            covariance: prior.covariance,
            predicted: prior.pose,
            deskew: DeskewReport::default(),
            extraction: ExtractionReport::default(),
            registration: RegistrationReport::default(),
            corrected: false,
            iterations: 0,
            support: 0.0,
            residual_m: 0.0,
            contradicted_share: 0.0,
            state: self.state.state(),
            odometry_left_out: false,
            odometry_useless: self.odometry.is_useless(),
            wheel_fault: self.wheels.fault(),
            observability: Observability::BLIND,
            way_m: self.way_m,
            closure: None,
            rejected: self.rejection(scan),
            counters: self.counters,
            map_counters: self.map.counters(),
        };
        if update.rejected.is_none() {
            self.observe(scan, motion, &mut update, watch);
            self.correct(&prior, &mut update, watch);
            if let Some(config) = self.config.loop_closure {
                self.close_loop(&config, &mut update, watch);
            }
            update.residual_m = self.residual_m(&update.pose);
            self.monitor_odometry(&by_odometry, &mut update);
            self.judge_state(scan, &motion.since_previous, &mut update);
            watch(Stage::Registration);
            self.register(&mut update);
            if update.registration.keyframe {
                self.forget(scan, &update);
            }
        }
        self.count(&update);
        update.counters = self.counters;
        update.map_counters = self.map.counters();
        self.map_from_base = update.pose;
        self.local_covariance = update.covariance;
        update.covariance = self.covariance();
        update
    }

    /// Moves the robot by odometry alone, where no scan has come.
    pub fn coast(&mut self, motion: &Increment) -> Isometry2<f32> {
        let prior = self.predict(&ScanMotion::instantaneous(*motion));
        self.map_from_base = prior.pose;
        self.local_covariance = prior.covariance;
        self.counters.coasted = self.counters.coasted.saturating_add(1);
        if self.keyframe_is_due() {
            self.advance_joint();
            self.note_settled();
        }
        prior.pose
    }

    /// Takes up a map made before, with the robot at a pose in it that is taken as certain. Segments beyond the capacity are left out, and
    /// counted as refused.
    pub fn take_up(&mut self, map: &[MapSegment], map_from_base: Isometry2<f32>) {
        self.map.take_up(map);
        self.map_from_base = map_from_base;
        self.local_covariance = Matrix3::zeros();
        self.begin_joint_anew();
    }

    /// Makes the pose less sure by a covariance of (x, y, θ) in `map`: the robot may have moved unseen.
    pub fn loosen(&mut self, by: &Matrix3<f32>) {
        self.local_covariance += by;
        self.map_from_base = self.settle() * self.map_from_base;
        self.loosen_joint(by);
    }

    /// Puts in order what a reset in the middle of [`Self::process_scan`] may have left half done. Segments that are not finite leave
    /// the map, and the joint estimate begins anew with what the map says. False where the pose is lost: nothing can be
    /// kept then.
    pub fn recover(&mut self) -> bool {
        if !is_finite(&self.map_from_base) || !self.local_covariance.iter().all(|v| v.is_finite()) {
            return false;
        }
        self.map_from_base = normalized(&self.map_from_base);
        for index in (0..self.map.segments().len()).rev() {
            if self.map.segments().get(index).is_some_and(|entry| !entry.segment.is_finite()) {
                self.map.forget(index);
            }
        }
        self.begin_joint_anew();
        self.closing = PendingClosure::default();
        true
    }

    /// From where the robot stands, whose pose is taken as certain.
    fn begin_joint_anew(&mut self) {
        let sigmas = self.odometry_sigmas();
        if let Some(joint) = &mut self.joint {
            joint.clear(sigmas);
        }
        self.sightings.clear();
        self.keyframe = Keyframe::at(self.map_from_base, AmongLines::default());
        self.note_settled();
    }

    fn loosen_joint(&mut self, by: &Matrix3<f32>) {
        if let Some(joint) = &mut self.joint {
            joint.loosen_pose(by, &mut self.map);
        }
        self.keyframe.among_lines = self.keyframe.among_lines.plus(by);
        self.note_settled();
    }

    /// The joint estimate stands at the keyframe, with nothing left to be taken in.
    fn note_settled(&mut self) {
        if let Some(joint) = &self.joint {
            let position = self.keyframe.map_from_base.translation.vector;
            let covariance = joint.pose_covariance();
            self.settled = Settled { position, covariance, among_lines: self.keyframe.among_lines };
        }
    }

    fn odometry_sigmas(&self) -> Vector3<f32> {
        self.config.odometry.bias.map_or_else(Vector3::zeros, |bias| bias.sigmas())
    }

    /// Eq. (1) with covariance: where the odometry says the base is.
    fn predict(&mut self, motion: &ScanMotion) -> Prior {
        let moved = self.moved(&self.map_from_base, &motion.since_previous);
        let covariance = moved.by_pose * self.local_covariance * moved.by_pose.transpose() + moved.noise;
        let prior = Prior { pose: moved.pose, covariance };
        if !(motion.is_finite() && is_finite(&prior.pose) && covariance.iter().all(|v| v.is_finite())) {
            self.counters.bad_motion = self.counters.bad_motion.saturating_add(1);
            let pose = self.settle() * self.map_from_base;
            self.loosen_joint(&Matrix3::identity());
            return Prior { pose, covariance: Matrix3::identity() };
        }
        self.keyframe.since = self.keyframe.since.then(&motion.since_previous);
        self.keyframe.scans = self.keyframe.scans.saturating_add(1);
        self.way_m += motion.since_previous.distance_m;
        if self.keyframe_is_due() {
            // The joint estimate moves on.
            return Prior { pose: self.settle() * prior.pose, ..prior };
        }
        prior
    }

    /// Where an increment of the odometry leads from a pose.
    fn moved(&self, from: &Isometry2<f32>, increment: &Increment) -> Moved {
        let increment = self.odometry_bias().corrected(increment);
        let pose = normalized(&(from * increment.before_from_after));
        let lever = perpendicular(from.rotation * increment.before_from_after.translation.vector);
        let mut by_pose = Matrix3::identity();
        (by_pose.m13, by_pose.m23) = (lever.x, lever.y);
        let mut noise = self.config.odometry.noise.covariance(&increment);
        if let Some(config) = self.config.odometry.monitor.as_ref().filter(|_| self.odometry.is_useless()) {
            noise += self.odometry.expected_covariance(config);
        }
        let noise = rotate_covariance(from, &noise);
        Moved { pose, by_pose, noise }
    }

    fn rejection(&self, scan: &Scan<'_>) -> Option<ScanRejection> {
        let (expected, actual) = (self.config.sensor.geometry.beams(), scan.ranges_mm.len());
        (expected != actual).then_some(ScanRejection::WrongBeamCount { expected, actual })
    }

    /// Ranges to segments in `base`.
    fn observe(
        &mut self,
        scan: &Scan<'_>,
        motion: &ScanMotion,
        update: &mut SlamUpdate,
        watch: &mut impl FnMut(Stage),
    ) {
        watch(Stage::Deskew);
        let still = ScanMotion::instantaneous(motion.since_previous);
        let motion = if motion.is_finite() { motion } else { &still };
        let (sensor, config) = (&self.config.sensor, &self.config);
        let spacing_m = self.spacing_m();
        update.deskew = deskew(scan, motion, sensor, &config.deskew, spacing_m, &mut self.points);
        watch(Stage::Extraction);
        update.extraction =
            extract(&self.points, sensor, &config.extraction, self.counters.scans, &mut self.observed);
    }

    /// From the prediction to the corrected pose.
    fn correct(&mut self, prior: &Prior, update: &mut SlamUpdate, watch: &mut impl FnMut(Stage)) {
        let scene = Scene { observed: &self.observed, map: self.map.segments(), config: &self.config };
        let mut tracked = self.tracker.track(&scene, &self.map_from_base, prior, watch);
        if self.state.state() == TrackingState::Lost
            && tracked.hypothesis.score < scene.config.state.good_score
        {
            if let Some(found) = self.tracker.look_around(&scene, prior, watch) {
                tracked.left_out = Some(left_out(&found.pose, &prior.pose));
                tracked.hypothesis = found;
            } else {
                self.tracker.associate(&scene, &tracked.hypothesis);
            }
        }
        let hypothesis = tracked.hypothesis;
        update.iterations = tracked.iterations;
        self.counters.searched = self.counters.searched.saturating_add(u32::from(tracked.searched));
        self.take(hypothesis, update);
        if let Some(left_out) = &tracked.left_out {
            update.odometry_left_out = true;
            update.pose = self.settle() * update.pose;
            self.loosen_joint(left_out);
            // The joint estimate, too, goes on from where the scan says.
            let moved = self.keyframe.map_from_base.inverse() * update.pose;
            self.keyframe.since.before_from_after = normalized(&moved);
        }
    }

    /// Makes a hypothesis the outcome of the scan.
    fn take(&mut self, hypothesis: Hypothesis, update: &mut SlamUpdate) {
        update.corrected = hypothesis.corrected;
        update.pose = hypothesis.pose;
        update.covariance = hypothesis.covariance;
        update.observability = hypothesis.observability;
        update.support = hypothesis.score;
    }

    /// The scan at hand, as the map counts: from one, so that zero is a scan that never was.
    fn scan_number(&self) -> u32 {
        self.counters.scans.saturating_add(1)
    }

    fn stamp(&self) -> Stamp {
        Stamp { scan: self.scan_number(), way_m: self.way_m }
    }

    fn eye(&self) -> Eye {
        Eye { reach_m: self.config.sensor.reach_m(), line_noise: self.config.line_noise }
    }

    /// Recognises old parts of the map from which the pose has drifted, and closes the loop.
    fn close_loop(&mut self, config: &LoopConfig, update: &mut SlamUpdate, watch: &mut impl FnMut(Stage)) {
        watch(Stage::Association);
        let (map, way_m) = (self.map.segments(), self.way_m);
        let age = |i: &u16| map.get(usize::from(*i)).map_or(0.0, |s| way_m - s.seen_at_m);
        let oldest = self.tracker.nearby.all().iter().map(age).fold(0.0, max);
        if oldest < config.min_way_m {
            return;
        }
        update.pose = self.settle() * update.pose;
        let scene = Scene { observed: &self.observed, map: self.map.segments(), config: &self.config };
        let old = |entry: &MapSegment| way_m - entry.seen_at_m >= config.min_way_m;
        self.tracker.gather(scene.map, &update.pose, scene.config, old);
        let prior = Prior { pose: update.pose, covariance: update.covariance + drift(config, oldest) };
        let start = Hypothesis::of_prior(&prior);
        let hypothesis = self.tracker.refined(&scene, &prior, start, Kernel::Strict, watch);
        self.tracker.gather_all(&scene, &update.pose);
        let seen =
            hypothesis.observability.verdict == Verdict::Full && hypothesis.score >= config.min_support;
        let drifted = chi2_between(&hypothesis.pose, &update.pose, &update.covariance) >= config.min_chi2;
        // The pose knows how far it may have drifted.
        let likely = self.joint.as_ref().is_none_or(|j| {
            chi2_between(&hypothesis.pose, &update.pose, &j.pose_covariance()) <= config.max_chi2
        });
        let began =
            self.tracker.pairs.iter().filter_map(|p| self.map.segments().get(p.mapped)).map(|s| s.seen_at_m);
        let loop_began_m = began.fold(0.0, max);
        if seen && drifted && likely {
            let closure = Closure { drifted: update.pose, closed: hypothesis.pose, loop_began_m, way_m };
            if self.closing.confirmed_by(&closure, config) {
                self.map.iter_mut().for_each(|entry| closure.bend_segment(entry));
                update.pose = hypothesis.pose;
                update.covariance = hypothesis.covariance;
                update.observability = hypothesis.observability;
                update.closure = Some(closure);
                self.counters.loops_closed = self.counters.loops_closed.saturating_add(1);
            }
        } else {
            self.closing = PendingClosure::default();
        }
        watch(Stage::Association);
        let scene = Scene { observed: &self.observed, map: self.map.segments(), config: &self.config };
        self.tracker.associate(&scene, &Hypothesis::at(update.pose, update.covariance));
    }

    /// How close to each other the points of the scan at hand need not be, metres.
    fn spacing_m(&self) -> f32 {
        match &self.config.registration {
            RegistrationConfig::Joint(config) if !self.keyframe_is_due() => {
                config.keyframes.spacing_between_m
            }
            _ => 0.0,
        }
    }

    /// Whether the scan at hand is to be taken into the map.
    fn keyframe_is_due(&self) -> bool {
        match &self.config.registration {
            RegistrationConfig::EndPoints(_) => true,
            RegistrationConfig::Joint(config) => self.keyframe.is_due(self.counters.scans, &config.keyframes),
        }
    }

    /// Moves the joint estimate's pose on by what the odometry said since the last keyframe. Returns it.
    fn advance_joint(&mut self) -> Isometry2<f32> {
        let last = self.keyframe;
        let moved = self.moved(&last.map_from_base, &last.since);
        if let Some(joint) = &mut self.joint {
            let turn = last.map_from_base.rotation.to_rotation_matrix().to_homogeneous();
            let by_odometry = turn * OdometryBias::derivative(&last.since);
            joint.predict(&moved.by_pose, &by_odometry, &moved.noise, &mut self.map);
        }
        // Of no scan yet: the pose may have been corrected since.
        let among_lines = AmongLines::of(&self.local_covariance);
        self.keyframe = Keyframe { scans: 1, ..Keyframe::at(moved.pose, among_lines) };
        moved.pose
    }

    /// Whether a scan may enter the map: one that is explained, or that the robot has waited for long enough; none while it is lost.
    fn admits(&self, update: &SlamUpdate, config: &KeyframeConfig) -> bool {
        let since = &self.keyframe.since;
        let waited = self.keyframe.scans >= config.scans_below
            || since.distance_m + since.turn_rad >= config.way_below_m;
        let at_start = self.counters.scans <= config.at_start || self.tracker.nearby.all().is_empty();
        update.state != TrackingState::Lost && (update.support >= config.min_score || waited || at_start)
    }

    /// Whether the pose is to be relied on, by what the map makes of the scan.
    fn judge_state(&mut self, scan: &Scan<'_>, motion: &Increment, update: &mut SlamUpdate) {
        if let Some(config) = &self.config.forgetting
            && update.support < self.config.state.good_score
        {
            let (sensor, nearby) = (&self.config.sensor, self.tracker.nearby.all());
            let map = self.map.segments();
            let [confirmed, contradicted] =
                confirmed_and_contradicted(scan, &update.pose, sensor, config, nearby, map);
            update.contradicted_share =
                f32::from(contradicted) / f32::from(confirmed.saturating_add(contradicted).max(1));
        }
        let evidence = Evidence {
            score: update.support,
            contradicted_share: update.contradicted_share,
            segments: self.observed.len() as u16,
            way_m: motion.distance_m + motion.turn_rad,
        };
        update.state = self.state.update(&evidence, &self.config.state);
    }

    /// The odometry against the scanner, where this scan and the one before fixed the pose.
    fn monitor_odometry(&mut self, motion: &Increment, update: &mut SlamUpdate) {
        let Some(config) = &self.config.odometry.monitor else { return };
        let fixed = update.support >= config.min_score && update.observability.verdict == Verdict::Full;
        let by_scanner = self.map_from_base.inverse() * update.pose;
        self.odometry.account(motion, &by_scanner, fixed && !update.odometry_left_out);
        if fixed && self.fixed {
            self.odometry.update(motion, &by_scanner, config);
            if let Some(track_m) = self.config.odometry.track_m {
                self.wheels.update(motion, &by_scanner, track_m);
            }
        } else {
            self.odometry.lost_sight();
            self.wheels.interrupt();
        }
        self.fixed = fixed;
        if let Some(learning) = &self.config.learning {
            self.learning.drive(&self.odometry_bias().corrected(motion));
            if update.odometry_left_out || update.closure.is_some() || self.odometry.is_useless() {
                self.learning.interrupt();
            } else if fixed {
                self.learning.fixed(&update.pose, update.observability.weak_sigma_m, learning);
            }
            if fixed {
                self.learning.take_residual(update.residual_m, learning);
            }
            self.config.line_noise = self.learning.line_noise(learning);
            self.config.odometry.noise = self.learning.odometry_noise();
        }
        update.odometry_useless = self.odometry.is_useless();
        update.wheel_fault = self.wheels.fault();
    }

    /// From pairs to map, and with it, in the joint estimate, to the pose.
    fn register(&mut self, update: &mut SlamUpdate) {
        let config = match self.config.registration {
            RegistrationConfig::Joint(config) => config,
            RegistrationConfig::EndPoints(config) => {
                let (segments, pairs) = (&*self.observed, &*self.tracker.pairs);
                let seen = Observed { segments, pairs, stamp: self.stamp(), eye: self.eye() };
                update.registration = register_end_points(&seen, &update.pose, &config, &mut self.map);
                return;
            }
        };
        if update.closure.is_none() && !(self.keyframe_is_due() && self.admits(update, &config.keyframes)) {
            let Some(joint) = self.joint.as_mut().filter(|_| self.sightings.wait()) else { return };
            if !self.sightings.take_in(config.taken_per_scan.into(), &config, joint) {
                update.pose = self.settle() * update.pose;
                update.registration.settled = true;
            }
            return;
        }
        let in_a_row = self.keyframe.scans <= 1;
        let advanced = self.advance_joint();
        // A closed loop has moved the prediction with the map.
        let carried = update.closure.map(|closure| closure.closed * closure.drifted.inverse());
        let prior = carried.map_or(advanced, |closed_from_drifted| closed_from_drifted * advanced);
        self.keyframe = Keyframe::at(prior, AmongLines::of(&update.covariance));
        let start = Start { prior: &prior, pose: &update.pose };
        let seen = Observed {
            segments: &self.observed,
            pairs: &self.tracker.pairs,
            stamp: self.stamp(),
            eye: self.eye(),
        };
        let Some(joint) = &mut self.joint else { return };
        update.registration = self.sightings.make(&seen, &start, &config, joint, &mut self.map);
        if in_a_row || update.closure.is_some() {
            update.pose = self.settle() * update.pose;
            update.registration.settled = true;
        }
    }

    /// Takes in what is left of the last keyframe. Returns by what poses in the map are moved.
    fn settle(&mut self) -> Isometry2<f32> {
        let RegistrationConfig::Joint(config) = &self.config.registration else {
            return Isometry2::identity();
        };
        let eye = self.eye();
        let Some(joint) = &mut self.joint else { return Isometry2::identity() };
        let (map, near) = (&mut self.map, &mut self.tracker.nearby);
        let Some([before, after]) = self.sightings.settle(&eye, config, joint, map, near) else {
            return Isometry2::identity();
        };
        // Fusing has renumbered the map's segments.
        self.tracker.forget_shortlist();
        self.keyframe.map_from_base = after;
        self.note_settled();
        after * before.inverse()
    }

    /// Forgets what the scan has seen through.
    fn forget(&mut self, scan: &Scan<'_>, update: &SlamUpdate) {
        let Some(config) = self.config.forgetting.filter(|_| update.corrected) else { return };
        let (sensor, scan_number) = (&self.config.sensor, self.scan_number());
        // As the registration left them: fusing may have moved segments.
        let nearby = self.tracker.nearby.all();
        mark_seen_through(scan, &update.pose, scan_number, sensor, &config, nearby, &mut self.map);
        while let Some(index) = self.map.segments().iter().position(|s| is_gone(s, &config)) {
            self.map.forget(index);
            if let Some(joint) = &mut self.joint {
                joint.removed(index, self.map.segments().len(), &mut self.map);
            }
        }
    }

    fn residual_m(&self, pose: &Isometry2<f32>) -> f32 {
        let (mut sum, mut points) = (0.0, 0.0);
        for pair in &self.tracker.pairs {
            let (Some(seen), Some(entry)) =
                (self.observed.get(pair.observed), self.map.segments().get(pair.mapped))
            else {
                continue;
            };
            let n = seen.moments.inliers as f32;
            let distance = entry.segment.line().signed_distance(pose * seen.moments.centroid);
            sum += n * distance * distance;
            points += n;
        }
        if points > 0.0 { sqrt(sum / points) } else { 0.0 }
    }

    fn count(&mut self, update: &SlamUpdate) {
        let add = |counter: &mut u32, amount: u32| *counter = counter.saturating_add(amount);
        let c = &mut self.counters;
        add(&mut c.scans, 1);
        add(&mut c.wrong_beam_count, u32::from(update.rejected.is_some()));
        add(&mut c.without_segments, u32::from(update.extraction.segments == 0));
        add(&mut c.uncorrected, u32::from(!update.corrected));
        add(&mut c.crowded_out, update.extraction.crowded_out);
        add(&mut c.odometry_left_out, u32::from(update.odometry_left_out));
        add(&mut c.lost, u32::from(update.state == TrackingState::Lost));
    }
}

/// Where a motion leads.
struct Moved {
    pose: Isometry2<f32>,
    /// Derivative of the new pose by the old one.
    by_pose: Matrix3<f32>,
    /// Covariance that the motion adds.
    noise: Matrix3<f32>,
}

/// Squared Mahalanobis distance between two poses.
fn chi2_between(a: &Isometry2<f32>, b: &Isometry2<f32>, covariance: &Matrix3<f32>) -> f32 {
    let off = difference(a, b);
    covariance.try_inverse().map_or(0.0, |w| off.dot(&(w * off)))
}
