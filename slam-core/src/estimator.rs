//! Where the robot is and how sure that is: the one owner of the pose and of all that it stands on.
//!
//! In: motions by the odometry, the pose that tracking finds, segments and pairs of a scan. Out: the pose of `base` in `map` with
//! its covariance, and a map that is moved with it.
//!
//! Scan by scan the pose is tracked among lines that stand still; the local covariance is its own error among them. Of [`keyframe`](crate::ekf::keyframe)s
//! an extended Kalman filter, [`EkfSlam`], takes in what was seen, a few lines with each scan, and gathers in its error state what they say. By
//! [`Estimator::commit`] pose and lines move at once. With the paper's registration there is no filter, and the pose is only tracked.

mod recovery;
mod upkeep;

use nalgebra::{Isometry2, Matrix3, Point2, Vector3};

use crate::config::SlamConfig;
use crate::ekf::config::{EkfConfig, RegistrationConfig};
use crate::ekf::filter::EkfSlam;
use crate::ekf::keyframe::{Anchor, Keyframe, KeyframeConfig, LocalVariance};
use crate::ekf::keyframe_update::{
    KeyframeUpdate, LinearizationPoint, Observed, RegistrationReport, SensorModel, Stamp,
};
use crate::geometry::line_noise::LineNoise;
use crate::geometry::pose::{is_finite, normalized, perpendicular, rotate_covariance};
use crate::geometry::segment::Segment;
use crate::map::SegmentMap;
use crate::odometry::Increment;
use crate::odometry::bias::OdometryBias;
use crate::odometry::health::OdometryHealth;
use crate::odometry::track::ScanMotion;
use crate::paper::end_points::register_end_points;
use crate::tracking::correction::Prior;
use crate::tracking::{Hypothesis, Tracker, TrackingState};
use crate::update::SlamUpdate;

/// What the estimator works with and does not own.
pub(crate) struct Surroundings<'a, const N: usize> {
    /// The settings of all stages.
    pub config: &'a SlamConfig,
    /// How far the odometry is to be believed.
    pub odometry: &'a OdometryHealth,
    /// Segments of the scan at hand, in `base`.
    pub observed: &'a [Segment],
    /// The lines that are estimated with the pose.
    pub map: &'a mut SegmentMap<N>,
    /// Those around the robot, and their pairs among the segments.
    pub tracker: &'a mut Tracker<N>,
}

/// The pose, its covariance, the filter, and where the filter stands.
///
/// RAM: 24 KiB.
pub(crate) struct Estimator {
    map_from_base: Isometry2<f32>,
    /// Of the pose among the lines around it; what they have in common with it is the filter's.
    local_covariance: Matrix3<f32>,
    /// The filter; none with the paper's registration.
    filter: Option<EkfSlam>,
    /// Where the filter stands, and the odometry since.
    keyframe: Keyframe,
    /// Of the filter by the keyframe, spread over scans.
    update: KeyframeUpdate,
    /// Where the filter's error state was injected last, with the pose's covariance.
    anchor: Anchor,
    /// Where the robot was when lines were last opened.
    opened_from: Point2<f32>,
    /// Whose turn is next to be looked at for openings: a rank among the lines nearby, modulo their number.
    next_opened: u16,
    /// The line that is next to be tidied up.
    next_tidied: u16,
    /// Scans before the one at hand.
    scans: u32,
    travelled_m: f32,
    /// Way driven until the pose was found anew: what was seen before lies elsewhere.
    jumped_at_m: f32,
}

/// Where a motion leads.
struct Moved {
    pose: Isometry2<f32>,
    /// Jacobian of the new pose by the old one.
    by_pose: Matrix3<f32>,
    /// Covariance that the motion adds.
    noise: Matrix3<f32>,
}

impl Estimator {
    /// At the origin and sure of it, with a filter that is not prepared. Inlined, so that it is built in its place.
    #[inline(always)]
    pub fn blank() -> Self {
        Self {
            map_from_base: Isometry2::identity(),
            local_covariance: Matrix3::zeros(),
            filter: Some(EkfSlam::blank()),
            keyframe: Keyframe::at(Isometry2::identity(), LocalVariance::default()),
            update: KeyframeUpdate::default(),
            anchor: Anchor::default(),
            opened_from: Point2::origin(),
            next_opened: 0,
            next_tidied: 0,
            scans: 0,
            travelled_m: 0.0,
            jumped_at_m: 0.0,
        }
    }

    /// Prepares the filter where the configuration asks for one, and drops it where not.
    pub fn prepare(&mut self, config: &SlamConfig) {
        match &mut self.filter {
            Some(filter) if config.registration.ekf().is_some() => {
                filter.prepare(config.odometry.bias_sigmas())
            }
            filter => *filter = None,
        }
    }

    /// Pose of `base` in `map`.
    pub fn pose(&self) -> Isometry2<f32> {
        self.map_from_base
    }

    /// The pose with its covariance (x, y, θ) among the lines around it, in `map`.
    pub fn local(&self) -> Prior {
        Prior { pose: self.map_from_base, covariance: self.local_covariance }
    }

    /// Covariance of the pose (x, y, θ), in `map`, the error of the lines around it included.
    pub fn covariance(&self, line_noise: &LineNoise) -> Matrix3<f32> {
        if self.filter.is_none() {
            return self.local_covariance;
        }
        // What the walls that were seen have in common does not average out over many of them.
        let in_common = line_noise.var_offset();
        self.anchor.carried(&self.map_from_base)
            + self.anchor.grown(&self.local_covariance)
            + Matrix3::from_diagonal(&Vector3::new(in_common, in_common, 0.0))
    }

    /// Systematic errors of the odometry as learnt so far.
    pub fn odometry_bias(&self) -> OdometryBias {
        self.filter.as_ref().map_or_else(OdometryBias::default, EkfSlam::bias)
    }

    /// Way driven until now, metres.
    pub fn travelled_m(&self) -> f32 {
        self.travelled_m
    }

    /// Scans before the one at hand.
    pub fn scans(&self) -> u32 {
        self.scans
    }

    /// The scan at hand, as the map counts: from one, so that zero is a scan that never was.
    pub fn stamp(&self) -> Stamp {
        Stamp { scan: self.scans.saturating_add(1), way_m: self.travelled_m }
    }

    /// The scan at hand is over.
    pub fn end_scan(&mut self) {
        self.scans = self.scans.saturating_add(1);
    }

    /// Eq. (1) with covariance: moves the pose by the odometry. False where a number is not finite: the robot is then taken to
    /// stand still, unsure by a metre and a radian.
    pub fn predict<const N: usize>(&mut self, motion: &ScanMotion, around: &mut Surroundings<'_, N>) -> bool {
        let Prior { pose, covariance } =
            self.predicted(&self.local(), &motion.since_previous, around.odometry, around.config);
        if !(motion.is_finite() && is_finite(&pose) && covariance.iter().all(|v| v.is_finite())) {
            self.local_covariance = Matrix3::identity();
            self.inflate_filter(&Matrix3::identity(), around);
            return false;
        }
        (self.map_from_base, self.local_covariance) = (pose, covariance);
        self.keyframe.since = self.keyframe.since.then(&motion.since_previous);
        self.keyframe.scans = self.keyframe.scans.saturating_add(1);
        self.travelled_m += motion.since_previous.distance_m;
        if self.keyframe_is_due(&around.config.registration) {
            self.commit(around);
        }
        true
    }

    /// Where the odometry leads from a pose, with covariance.
    pub fn predicted(
        &self,
        from: &Prior,
        motion: &Increment,
        odometry: &OdometryHealth,
        config: &SlamConfig,
    ) -> Prior {
        let Moved { pose, by_pose, noise } = self.moved(&from.pose, motion, odometry, config);
        Prior { pose, covariance: by_pose * from.covariance * by_pose.transpose() + noise }
    }

    /// Moves on by odometry alone, where no scan has come. False as in [`Self::predict`].
    pub fn coast<const N: usize>(&mut self, motion: &Increment, around: &mut Surroundings<'_, N>) -> bool {
        let is_usable = self.predict(&ScanMotion::instantaneous(*motion), around);
        if self.keyframe_is_due(&around.config.registration) {
            self.advance(around);
            self.set_anchor();
        }
        // Where the robot went unseen is no way on which lines were crossed.
        self.restart_way();
        is_usable
    }

    /// Takes the pose that tracking found.
    pub fn accept(&mut self, hypothesis: &Hypothesis) {
        (self.map_from_base, self.local_covariance) = (hypothesis.pose, hypothesis.covariance);
    }

    /// Makes the pose less sure by a covariance of (x, y, θ) in `map`.
    pub fn inflate<const N: usize>(&mut self, by: &Matrix3<f32>, around: &mut Surroundings<'_, N>) {
        self.local_covariance += by;
        self.inflate_filter(by, around);
    }

    /// The same of the filter's pose only: that of the scan at hand is known from the scan. Whether an update was committed with it.
    fn inflate_filter<const N: usize>(
        &mut self,
        by: &Matrix3<f32>,
        around: &mut Surroundings<'_, N>,
    ) -> bool {
        let committed = self.commit(around);
        if let Some(filter) = &mut self.filter {
            filter.inflate_pose(by, around.map);
        }
        self.keyframe.local_variance = self.keyframe.local_variance.plus(by);
        self.set_anchor();
        committed
    }

    /// The filter goes on from where a scan says that overruled the prediction, so much less sure (covariance of (x, y, θ)): what
    /// the odometry said since the keyframe does not count. Whether an update was committed with it, so that the map has changed.
    pub fn overrule<const N: usize>(&mut self, by: &Matrix3<f32>, around: &mut Surroundings<'_, N>) -> bool {
        let committed = self.inflate_filter(by, around);
        let moved = self.keyframe.map_from_base.inverse() * self.map_from_base;
        self.keyframe.since.before_from_after = normalized(&moved);
        self.restart_way();
        committed
    }

    /// Completes the keyframe's update and injects the error state: pose and lines move at once, and lines that turn out to be one
    /// wall are merged. Without a pending update nothing happens, and it says so.
    pub fn commit<const N: usize>(&mut self, around: &mut Surroundings<'_, N>) -> bool {
        let Some(config) = around.config.registration.ekf() else { return false };
        let Some(filter) = &mut self.filter else { return false };
        let (sensor, near) = (SensorModel::of(around.config), &mut around.tracker.nearby);
        let Some([before, after]) = self.update.commit(&sensor, config, filter, around.map, near) else {
            return false;
        };
        // Merging has renumbered the map's segments.
        around.tracker.forget_shortlist();
        self.keyframe.map_from_base = after;
        self.set_anchor();
        self.map_from_base = after * before.inverse() * self.map_from_base;
        true
    }

    /// Whether the scan at hand is to be taken into the map.
    pub fn keyframe_is_due(&self, config: &RegistrationConfig) -> bool {
        config.ekf().is_none_or(|config| self.keyframe.is_due(self.scans, &config.keyframes))
    }

    /// How close to each other the points of the scan at hand need not be, metres.
    pub fn spacing_m(&self, config: &RegistrationConfig) -> f32 {
        match config.ekf() {
            Some(ekf) if !self.keyframe_is_due(config) => ekf.keyframes.spacing_between_m,
            _ => 0.0,
        }
    }

    /// From pairs to map, and with the filter to the pose. `update` is what has come of the scan so far.
    pub fn register<const N: usize>(
        &mut self,
        update: &SlamUpdate,
        around: &mut Surroundings<'_, N>,
    ) -> RegistrationReport {
        let config = around.config;
        match &config.registration {
            RegistrationConfig::EndPoints(end_points) => {
                let (segments, pairs) = (around.observed, &*around.tracker.pairs);
                let seen = Observed { segments, pairs, stamp: self.stamp(), sensor: SensorModel::of(config) };
                register_end_points(&seen, &self.map_from_base, end_points, around.map)
            }
            RegistrationConfig::Ekf(ekf) => {
                let is_due = self.keyframe_is_due(&config.registration);
                if is_due && self.admits(update, &ekf.keyframes, around) {
                    self.take_keyframe(ekf, around)
                } else {
                    self.go_on_with_keyframe(ekf, around)
                }
            }
        }
    }

    /// Whether a scan may enter the map: one that is explained, or that the robot has waited for long enough; none while it is lost.
    fn admits<const N: usize>(
        &self,
        update: &SlamUpdate,
        config: &KeyframeConfig,
        around: &Surroundings<'_, N>,
    ) -> bool {
        let since = &self.keyframe.since;
        let waited = self.keyframe.scans >= config.scans_below
            || since.distance_m + since.turn_rad >= config.way_below_m;
        let at_start = self.scans <= config.at_start || around.tracker.nearby.all().is_empty();
        update.state != TrackingState::Lost && (update.support >= config.min_score || waited || at_start)
    }

    /// Makes the scan at hand the keyframe. The filter is updated from the next scan on; at once where keyframes follow each
    /// other.
    fn take_keyframe<const N: usize>(
        &mut self,
        config: &EkfConfig,
        around: &mut Surroundings<'_, N>,
    ) -> RegistrationReport {
        let in_a_row = self.keyframe.scans <= 1;
        let prior = self.advance(around);
        self.keyframe = Keyframe::at(prior, LocalVariance::of(&self.local_covariance));
        let at = LinearizationPoint { prior, pose: self.map_from_base };
        let seen = Observed {
            segments: around.observed,
            pairs: &around.tracker.pairs,
            stamp: self.stamp(),
            sensor: SensorModel::of(around.config),
        };
        let Some(filter) = &mut self.filter else { return RegistrationReport::default() };
        let mut report = self.update.begin(&seen, &at, config, filter, around.map);
        if in_a_row {
            self.commit(around);
            report.committed = true;
        }
        report
    }

    /// Updates the filter by some more measurements of the keyframe; after the last one the error state is injected.
    fn go_on_with_keyframe<const N: usize>(
        &mut self,
        config: &EkfConfig,
        around: &mut Surroundings<'_, N>,
    ) -> RegistrationReport {
        let mut report = RegistrationReport::default();
        let Some(filter) = self.filter.as_mut().filter(|_| self.update.is_pending()) else { return report };
        if !self.update.advance(config.updates_per_scan.into(), config, filter) {
            self.commit(around);
            report.committed = true;
        }
        report
    }

    /// Moves the filter's pose on by what the odometry said since the last keyframe. Returns it.
    fn advance<const N: usize>(&mut self, around: &mut Surroundings<'_, N>) -> Isometry2<f32> {
        let last = self.keyframe;
        let moved = self.moved(&last.map_from_base, &last.since, around.odometry, around.config);
        if let Some(filter) = &mut self.filter {
            let by_odometry = by_odometry(&last.map_from_base, &last.since);
            filter.predict(&moved.by_pose, &by_odometry, &moved.noise, around.map);
        }
        // Of no scan yet: the pose may have been corrected since.
        let local_variance = LocalVariance::of(&self.local_covariance);
        self.keyframe = Keyframe { scans: 1, ..Keyframe::at(moved.pose, local_variance) };
        moved.pose
    }

    /// Where an increment of the odometry leads from a pose.
    fn moved(
        &self,
        from: &Isometry2<f32>,
        increment: &Increment,
        odometry: &OdometryHealth,
        config: &SlamConfig,
    ) -> Moved {
        let increment = self.odometry_bias().corrected(increment);
        let pose = normalized(&(from * increment.before_from_after));
        let lever = perpendicular(from.rotation * increment.before_from_after.translation.vector);
        let mut by_pose = Matrix3::identity();
        (by_pose.m13, by_pose.m23) = (lever.x, lever.y);
        let noise = odometry.covariance(&increment, &config.odometry);
        Moved { pose, by_pose, noise: rotate_covariance(from, &noise) }
    }

    /// Poses are relative to the keyframe from now on, where the filter stands with no update pending.
    fn set_anchor(&mut self) {
        if let Some(filter) = &self.filter {
            let position = self.keyframe.map_from_base.translation.vector;
            let covariance = filter.pose_covariance();
            self.anchor = Anchor { position, covariance, local_variance: self.keyframe.local_variance };
        }
    }
}

/// Jacobian of the pose that an increment leads to, in `map`, by the odometry's errors.
fn by_odometry(from: &Isometry2<f32>, increment: &Increment) -> Matrix3<f32> {
    let turn = from.rotation.to_rotation_matrix().to_homogeneous();
    turn * OdometryBias::derivative(increment)
}

#[cfg(test)]
mod tests;
