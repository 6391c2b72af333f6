//! Going on where no scan has come, after a reset, or after a motion that nobody saw.

use nalgebra::{Isometry2, Matrix3};

use super::Slam;
use crate::map::MapSegment;
use crate::odometry::Increment;
use crate::relocalisation::Relocaliser;
use crate::tracking::correction::Prior;

impl<const N: usize, const BEAMS: usize, const P: usize> Slam<N, BEAMS, P> {
    /// Moves the robot by odometry alone, where no scan has come.
    pub fn coast(&mut self, motion: &Increment) -> Isometry2<f32> {
        let (estimator, mut around) = self.estimator();
        let is_usable = estimator.coast(motion, &mut around);
        self.counters.count_motion(is_usable);
        self.counters.coasted = self.counters.coasted.saturating_add(1);
        self.pass_unseen(motion);
        self.estimator.pose()
    }

    /// Takes up a map made before, with the robot at a pose in it that is taken as certain. Segments beyond the capacity are left out, and
    /// counted as refused.
    pub fn take_up(&mut self, map: impl Iterator<Item = MapSegment>, map_from_base: Isometry2<f32>) {
        self.map.take_up(map.map(|entry| entry.seen_at(0.0)));
        self.places.clear();
        self.jump(&Prior { pose: map_from_base, covariance: Matrix3::zeros() });
    }

    /// Makes the pose less sure by a covariance of (x, y, θ) in `map`: the robot may have moved unseen.
    pub fn loosen(&mut self, by: &Matrix3<f32>) {
        let (estimator, mut around) = self.estimator();
        estimator.inflate(by, &mut around);
    }

    /// Puts in order what a reset in the middle of [`Self::process_scan`] may have left half done. Segments that are not finite leave
    /// the map, and the filter begins anew with what the map says. False where the pose is lost: nothing can be
    /// kept then.
    pub fn recover(&mut self) -> bool {
        if !self.estimator.recover_pose() {
            return false;
        }
        self.map.forget_broken();
        self.estimator.begin_anew(&self.config);
        self.places.recover();
        self.relocaliser = Relocaliser::new();
        if self.is_relocalising() {
            self.relocalise();
        }
        true
    }
}
