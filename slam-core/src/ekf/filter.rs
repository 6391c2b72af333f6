//! The filter: pose, systematic errors of the odometry, and lines, with one covariance.
//!
//! Lines are placed by a robot that is not sure where it stands, and then say where the robot stands. Taken one by one, pose and
//! lines would confirm each other's errors; their cross-covariance prevents that. Up to [`LINES`] lines are
//! in the state, those seen last.
//!
//! It is an error-state filter: pose and lines are nominal values, held outside; measurements gather in the error state, and
//! `EkfSlam::commit` injects it. Injection changes the frame in which errors are expressed, and the covariance is carried over by the
//! Jacobian of the reset (Solà 2017, section 6.3): a robot that has been moved turns about another point of the map, and a line that
//! has been turned has another normal. Without that the filter gains information on the map's absolute position and heading, which
//! are not observable.
//!
//! A line's offset is along its normal at its centroid. The centroid is moved along the line to where offset and direction are
//! uncorrelated.

use nalgebra::{Isometry2, Matrix3, Vector3};

use crate::ekf::slots::Slots;
use crate::ekf::state::{Covariance, FIRST_LINE, LINES, ODOMETRY, POSE, STATES, line_states};
use crate::geometry::line_noise::with_variances;
use crate::geometry::line_observation::by_pose;
use crate::geometry::math::{VARIANCE_FLOOR, max, sin_cos, within};
use crate::geometry::pose::{components, pose};
use crate::geometry::segment::Segment;
use crate::map::{END_STEP_M, SegmentMap};
use crate::odometry::bias::OdometryBias;

/// Largest variances of the pose's position (m²) and heading (rad²). Beyond them `f32` does not resolve the lines around the robot
/// from each other any more, and the lines leave the state.
const MAX_POSE_VARIANCE: [f32; 3] = [25.0, 25.0, 0.25];
/// A line's covariance is carried to its new normal once it has turned by this, radians. Below, with a robot that knows its position
/// to a decimetre, that is wrong by a tenth of a millimetre.
const MIN_RESET_TURN_RAD: f32 = 1e-3;
/// The centroid is moved where that lowers the offset's variance by more than this share.
const MIN_CENTROID_GAIN: f32 = 0.01;

/// The filter. RAM: 22 KiB.
#[derive(Clone, Debug)]
pub struct EkfSlam {
    pub(super) covariance: Covariance,
    pub(super) slots: Slots,
    /// Errors of the odometry: the nominal value of its states.
    bias: OdometryBias,
    /// What the measurements since the last [`EkfSlam::commit`] say of each state.
    pub(super) error_state: [f32; STATES],
}

impl EkfSlam {
    /// A pose known for certain, and odometry errors with these standard deviations.
    pub fn new(sigma_odometry: Vector3<f32>) -> Self {
        let mut filter = Self::blank();
        filter.prepare(sigma_odometry);
        filter
    }

    /// All variances zero. Inlined, so that it is built in its place.
    #[inline(always)]
    pub(crate) fn blank() -> Self {
        Self {
            covariance: Covariance::zeros(FIRST_LINE),
            slots: Slots::free(),
            bias: OdometryBias::default(),
            error_state: [0.0; STATES],
        }
    }

    /// Sets the variances of the odometry's errors, by these standard deviations.
    pub(crate) fn prepare(&mut self, sigma_odometry: Vector3<f32>) {
        for (i, sigma) in sigma_odometry.iter().enumerate() {
            self.covariance.set(ODOMETRY + i, ODOMETRY + i, sigma * sigma);
        }
    }

    /// Begins anew: no lines, a pose known for certain, and the odometry's errors as estimated so far, with these standard deviations.
    pub(crate) fn clear(&mut self, sigma_odometry: Vector3<f32>) {
        self.covariance.clear(FIRST_LINE);
        self.slots.clear();
        self.error_state.fill(0.0);
        if !self.bias.0.iter().all(|v| v.is_finite()) {
            self.bias = OdometryBias::default();
        }
        self.prepare(sigma_odometry);
    }

    /// The odometry's errors as estimated so far.
    pub fn bias(&self) -> OdometryBias {
        self.bias
    }

    /// Sets them.
    pub(crate) fn set_bias(&mut self, bias: OdometryBias) {
        self.bias = bias;
    }

    /// Covariance of the pose (x, y, θ).
    pub fn pose_covariance(&self) -> Matrix3<f32> {
        self.covariance.block(POSE)
    }

    /// Prediction: P ← F·P·Fᵀ + Q. `by_pose` and `by_odometry` are the Jacobians of the new pose by the old one and by the odometry's
    /// errors, `noise` is Q of the pose.
    pub fn predict<const N: usize>(
        &mut self,
        by_pose: &Matrix3<f32>,
        by_odometry: &Matrix3<f32>,
        noise: &Matrix3<f32>,
        map: &mut SegmentMap<N>,
    ) {
        self.slots.next_scan();
        let covariance = &mut self.covariance;
        let cross = Matrix3::from_fn(|i, j| covariance.get(POSE + i, ODOMETRY + j));
        let (pose, errors) = (covariance.block(POSE), covariance.block(ODOMETRY));
        let mixed = by_pose * cross * by_odometry.transpose();
        let predicted = by_pose * pose * by_pose.transpose()
            + mixed
            + mixed.transpose()
            + by_odometry * errors * by_odometry.transpose()
            + noise;
        for state in ODOMETRY..covariance.live() {
            let with_pose = Vector3::from_fn(|i, _| covariance.get(POSE + i, state));
            let with_odometry = Vector3::from_fn(|i, _| covariance.get(ODOMETRY + i, state));
            let with_predicted = by_pose * with_pose + by_odometry * with_odometry;
            for (i, value) in with_predicted.iter().enumerate() {
                covariance.set(POSE + i, state, *value);
            }
        }
        covariance.set_block(POSE, &predicted);
        self.reset_if_too_unsure(map);
    }

    /// Takes all lines out of the state and drops the pose's cross-covariances, where its variances exceed [`MAX_POSE_VARIANCE`].
    fn reset_if_too_unsure<const N: usize>(&mut self, map: &mut SegmentMap<N>) {
        let variances = self.pose_covariance().diagonal();
        if variances.iter().zip(&MAX_POSE_VARIANCE).all(|(own, most)| own <= most) {
            return;
        }
        (0..LINES).for_each(|slot| self.decouple(slot, map));
        (POSE..ODOMETRY).for_each(|state| self.covariance.zero_state(state));
        let most = Vector3::from(MAX_POSE_VARIANCE);
        self.covariance.set_block(POSE, &Matrix3::from_diagonal(&variances.inf(&most)));
    }

    /// The map is turned about its origin, lines and pose as one: the error of the position is turned, by three shears; those of lines
    /// are along their normals, and stay.
    pub(crate) fn turn_pose(&mut self, angle_rad: f32) {
        let (s, c) = sin_cos(angle_rad);
        // −tan(a/2); a closed loop turns the map by a few degrees.
        let shear = -s / max(1.0 + c, 1e-3);
        for (state, other, factor) in [(POSE, POSE + 1, shear), (POSE + 1, POSE, s), (POSE, POSE + 1, shear)]
        {
            self.covariance.add_multiples(state, &[(other, factor)]);
        }
    }

    /// Takes a line of the map out of the state, if it is there.
    pub(crate) fn decouple_line<const N: usize>(&mut self, index: usize, map: &mut SegmentMap<N>) {
        if let Some(slot) = self.slots.slot_of(index) {
            self.decouple(slot, map);
        }
    }

    /// Adds to the pose's covariance.
    pub fn inflate_pose<const N: usize>(&mut self, by: &Matrix3<f32>, map: &mut SegmentMap<N>) {
        let inflated = self.pose_covariance() + by;
        self.covariance.set_block(POSE, &inflated);
        self.reset_if_too_unsure(map);
    }

    /// Injects the error state into pose, odometry's errors and lines, and resets it, with the covariance. Returns the pose.
    pub(crate) fn commit<const N: usize>(
        &mut self,
        prior: &Isometry2<f32>,
        map: &mut SegmentMap<N>,
    ) -> Isometry2<f32> {
        let error_state = core::mem::replace(&mut self.error_state, [0.0; STATES]);
        let error = |state: usize| error_state.get(state).copied().unwrap_or(0.0);
        for (i, bias) in self.bias.0.iter_mut().enumerate() {
            *bias += error(ODOMETRY + i);
        }
        let c = components(prior);
        let injected = pose(c.x + error(POSE), c.y + error(POSE + 1), c.z + error(POSE + 2));
        // Reset: an error of the heading that turns everything about the map's origin moves the robot's new position.
        self.covariance.add_multiples(POSE, &[(POSE + 2, -error(POSE + 1))]);
        self.covariance.add_multiples(POSE + 1, &[(POSE + 2, error(POSE))]);
        let pose_information = self.pose_covariance().try_inverse();
        for slot in 0..LINES {
            let Some(entry) = self.slots.line_id(slot).and_then(|index| map.get_mut(index)) else { continue };
            let [offset, direction] = line_states(slot);
            let mut line = entry.segment().shifted(error(offset), error(direction));
            self.reset_normal(slot, error(direction), &line, &injected);
            self.move_centroid(slot, &mut line);
            let [var_offset, var_direction] =
                [offset, direction].map(|state| self.variance_given_pose(state, pose_information.as_ref()));
            line = with_variances(&line, var_offset, var_direction);
            if line.is_finite() {
                entry.set_segment(&line);
            }
        }
        injected
    }

    /// Reset of a line that has turned: its offset's error is along the new normal.
    fn reset_normal(&mut self, slot: usize, turn_rad: f32, line: &Segment, pose: &Isometry2<f32>) {
        let Some(turned) = self.slots.turns.get_mut(slot) else { return };
        *turned += turn_rad;
        if turned.abs() > MIN_RESET_TURN_RAD {
            // The normal turns away from the direction.
            let normal_by = -line.direction * core::mem::take(turned);
            let from_robot = line.moments.centroid.coords - pose.translation.vector;
            let [[x, y, heading], _] = by_pose(normal_by, from_robot);
            let [offset, _] = line_states(slot);
            self.covariance.add_multiples(offset, &[(POSE, x), (POSE + 1, y), (POSE + 2, heading)]);
        }
    }

    /// Moves the centroid along the line to where offset and direction are uncorrelated, within the ends.
    fn move_centroid(&mut self, slot: usize, line: &mut Segment) {
        let [offset, direction] = line_states(slot);
        let var_direction = self.covariance.get(direction, direction);
        if var_direction > 0.0 {
            let way = -self.covariance.get(offset, direction) / var_direction;
            let (a, b) = (line.along_of(line.start), line.along_of(line.end));
            // Whole steps, so that the ends stay where they are.
            let way =
                if a <= b { END_STEP_M * ((within(way, a, b) / END_STEP_M) as i32) as f32 } else { 0.0 };
            if way * way * var_direction > MIN_CENTROID_GAIN * self.covariance.get(offset, offset) {
                self.covariance.add_multiples(offset, &[(direction, way)]);
                line.moments.centroid += line.direction * way;
            }
        }
    }

    /// Variance of a line's state given the pose: P_ll − P_lp·P_pp⁻¹·P_pl.
    fn variance_given_pose(&self, state: usize, pose_information: Option<&Matrix3<f32>>) -> f32 {
        // Rounding may have taken a variance below zero, and a range must not be empty.
        let own = max(self.covariance.get(state, state), VARIANCE_FLOOR);
        let with = Vector3::from_fn(|i, _| self.covariance.get(POSE + i, state));
        let explained = pose_information.map_or(0.0, |w| with.dot(&(w * with)));
        max(within(own - explained, 0.01 * own, own), VARIANCE_FLOOR)
    }
}

#[cfg(test)]
mod tests;
