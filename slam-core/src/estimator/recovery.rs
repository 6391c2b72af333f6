//! Beginning at a pose, and going on after a reset.

use nalgebra::{Isometry2, Matrix3};

use super::Estimator;
use crate::config::SlamConfig;
use crate::ekf::keyframe::{Keyframe, LocalVariance};
use crate::geometry::pose::{is_finite, normalized};
use crate::map::SegmentMap;
use crate::map::store::StoredMap;
use crate::tracking::correction::Prior;

impl Estimator {
    /// Begins anew at a pose that is taken as certain.
    pub fn begin_at(&mut self, map_from_base: Isometry2<f32>, config: &SlamConfig) {
        self.map_from_base = map_from_base;
        self.restart_way();
        self.local_covariance = Matrix3::zeros();
        self.begin_anew(config);
    }

    /// Begins anew in a map that was saved.
    pub fn begin_in<const N: usize>(
        &mut self,
        saved: &StoredMap<'_>,
        at: &Prior,
        config: &SlamConfig,
        map: &mut SegmentMap<N>,
    ) {
        if let Some(filter) = self.filter.as_mut().filter(|_| config.odometry.bias.is_some()) {
            filter.set_bias(saved.odometry_bias);
        }
        if let Some(ekf) = config.registration.ekf() {
            // What is seen first does not say where the map's frame lies.
            self.scans = self.scans.max(ekf.keyframes.at_start.saturating_add(1));
        }
        self.travelled_m = saved.way_m;
        self.restart(at, config, map);
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
