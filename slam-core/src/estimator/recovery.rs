//! Beginning at a pose, and going on after a reset.

use super::Estimator;
use crate::config::SlamConfig;
use crate::ekf::keyframe::{Keyframe, LocalVariance};
use crate::geometry::pose::{is_finite, normalized};
use crate::map::SegmentMap;
use crate::map::store::StoredMap;
use crate::tracking::correction::Prior;

impl Estimator {
    /// Takes over what a saved map knows of odometry and way. To be followed by [`Self::restart`].
    pub fn take_over(&mut self, saved: &StoredMap<'_>, config: &SlamConfig) {
        if let Some(filter) = self.filter.as_mut().filter(|_| config.odometry.bias.is_some()) {
            filter.set_bias(saved.odometry_bias);
        }
        if let Some(ekf) = config.registration.ekf() {
            // What is seen first does not say where the map's frame lies.
            self.scans = self.scans.max(ekf.keyframes.at_start.saturating_add(1));
        }
        self.travelled_m = saved.way_m;
    }

    /// Begins anew at a pose with a covariance.
    pub fn restart<const N: usize>(&mut self, at: &Prior, config: &SlamConfig, map: &mut SegmentMap<N>) {
        (self.map_from_base, self.local_covariance) = (at.pose, at.covariance);
        self.jumped_at_m = self.travelled_m;
        self.restart_way();
        self.begin_anew(config);
        if let Some(filter) = &mut self.filter {
            filter.inflate_pose(&at.covariance, map);
        }
        self.keyframe.local_variance = LocalVariance::of(&at.covariance);
        self.set_anchor();
    }

    /// In a map that stays as it is: where a keyframe would be due, the pose alone is taken for what the filter knows.
    pub fn follow<const N: usize>(&mut self, config: &SlamConfig, map: &mut SegmentMap<N>) {
        if self.keyframe_is_due(&config.registration) {
            self.restart(&self.local(), config, map);
        }
    }

    /// Begins anew from where the robot stands. Of the filter only the odometry's errors stay.
    pub fn begin_anew(&mut self, config: &SlamConfig) {
        if let Some(filter) = &mut self.filter {
            filter.clear(config.odometry.bias_sigmas());
        }
        self.update.clear();
        self.keyframe = Keyframe::at(self.map_from_base, LocalVariance::default());
        self.set_anchor();
    }

    /// Puts the pose in order after a reset that may have come while it was written. False where it is lost.
    pub fn recover_pose(&mut self) -> bool {
        let is_whole = is_finite(&self.map_from_base) && self.local_covariance.iter().all(|v| v.is_finite());
        if is_whole {
            self.map_from_base = normalized(&self.map_from_base);
        }
        is_whole
    }
}
