//! The pose, the odometry's systematic errors and the lines around the robot, estimated together.
//!
//! A line is placed by a robot that is not sure where it stands, and is then used to say where the robot stands. Taken one
//! by one, pose and lines would confirm each other's errors and grow sure of them. Their joint covariance knows what they
//! have in common: an extended Kalman filter over the pose (x, y, θ), three errors of the odometry, and offset and
//! direction of up to [`LINES`] map segments, those seen last. A segment that gives up its place keeps its own variances;
//! what it had in common with others is forgotten, and made up for when it is tracked again.
//!
//! Errors are those about the present estimate, and are carried over when it moves: turned about the map's origin, a robot
//! that has been moved turns about elsewhere, and a line that has been turned is shifted along another normal. Without that
//! a filter comes to know, by turning its own estimate back and forth, what no measurement told it: where all of the map lies.
//!
//! Offsets are along a line's normal at its centroid, which wanders along the line to where the offset is independent of
//! the direction: the centroid of all points that were seen on it, as it were.

use core::ops::Range;

use nalgebra::{Isometry2, Matrix2, Matrix3, Vector2, Vector3};

use crate::ekf::told::{self, Told};
use crate::geometry::math::{max, within};
use crate::geometry::pose::{components, cross, perpendicular, pose};
use crate::geometry::segment::Segment;
use crate::map::SegmentMap;
use crate::odometry::bias::OdometryBias;

/// Most map segments whose errors are tracked together: 48.
pub const LINES: usize = 48;
const _: () = assert!(LINES <= u64::BITS as usize, "a bit for each");
/// Pose, then the odometry's errors, then the lines.
const POSE: usize = 0;
const ODOMETRY: usize = 3;
const FIRST_LINE: usize = 6;
pub(crate) const STATES: usize = FIRST_LINE + 2 * LINES;
const PACKED: usize = STATES * (STATES + 1) / 2;
/// Largest variances of the pose's position (m²) and heading (rad²). Beyond them `f32` could not tell the lines around the
/// robot from each other any more; a robot so unsure begins anew with what it sees.
const MOST_VARIANCE: [f32; 3] = [25.0, 25.0, 0.25];
/// A line that has turned by less has its errors where they were, radians: with a robot that knows its position to a
/// decimetre that is wrong by a tenth of a millimetre.
const CARRIED_RAD: f32 = 1e-3;
/// A centroid stays where it is while the offset's variance there is larger by less than this share.
const CENTRED_SHARE: f32 = 0.01;
/// Least variance of a state: beneath it `f32` has no digits left.
pub(crate) const LEAST_VARIANCE: f32 = 1e-12;

/// The joint estimate's covariance. RAM: 22 KiB.
#[derive(Clone, Debug)]
pub struct Joint {
    /// Lower triangle, row by row.
    covariance: [f32; PACKED],
    /// Index in the map of each line tracked.
    owners: [Option<u16>; LINES],
    /// The odometry's errors.
    bias: OdometryBias,
    /// Scans since each line was added; infinite for one that was known before.
    ages_scans: [f32; LINES],
    /// Places that hold lines of the scan at hand, a bit for each.
    in_use: u64,
    /// Turn of each line, radians, that has not been carried over to the covariance yet.
    turned: [f32; LINES],
    /// What the measurements since the last [`Joint::settle`] have moved each state by.
    shift: [f32; STATES],
}

/// How an observed segment differs from its map segment, and what the difference depends on.
#[derive(Clone, Debug)]
pub(crate) struct Measurement {
    /// Offset (m) and direction (rad).
    errors: [f32; 2],
    /// Of both.
    variances: [f32; 2],
    by: Derivative,
}

/// Derivatives of two numbers, an offset and a direction.
#[derive(Clone, Debug)]
struct Derivative {
    by_pose: [[f32; 3]; 2],
    /// By the offset and the direction of the line at a place.
    by_lines: heapless::Vec<(usize, [[f32; 2]; 2]), 2>,
}

impl Derivative {
    /// States on which the numbers depend, with the derivatives of both.
    fn entries(&self) -> impl Iterator<Item = (usize, [f32; 2])> + Clone {
        let [o, d] = self.by_pose;
        let pose = (0..3).zip(o.into_iter().zip(d)).map(|(i, (o, d))| (POSE + i, [o, d]));
        let of_line = |&(place, [o, d]): &(usize, [[f32; 2]; 2])| {
            states_of(place).into_iter().zip(o.into_iter().zip(d)).map(|(state, (o, d))| (state, [o, d]))
        };
        pose.chain(self.by_lines.iter().flat_map(of_line))
    }

    /// What the numbers change by when all states change by these.
    fn times(&self, changes: &[f32; STATES]) -> [f32; 2] {
        let mut sums = [0.0; 2];
        let mut add = |first: usize, derivatives: [&[f32]; 2]| {
            for (sum, by) in sums.iter_mut().zip(derivatives) {
                let changes = changes.get(first..first + by.len()).unwrap_or_default();
                by.iter().zip(changes).for_each(|(by, change)| *sum += by * change);
            }
        };
        add(POSE, self.by_pose.each_ref().map(|by| by.as_slice()));
        for (place, by_line) in &self.by_lines {
            let [first, _] = states_of(*place);
            add(first, by_line.each_ref().map(|by| by.as_slice()));
        }
        sums
    }
}

/// Where the covariance of two states lies: the lower triangle, row by row.
fn packed(i: usize, j: usize) -> usize {
    let (row, column) = if i >= j { (i, j) } else { (j, i) };
    row * (row + 1) / 2 + column
}

impl Joint {
    /// A pose known for certain, and odometry errors with these standard deviations.
    pub fn new(sigma_odometry: Vector3<f32>) -> Self {
        let mut joint = Self::blank();
        joint.prepare(sigma_odometry);
        joint
    }

    /// Sure of everything. Inlined, so that it is built in its place.
    #[inline(always)]
    pub(crate) fn blank() -> Self {
        Self {
            covariance: [0.0; PACKED],
            owners: [None; LINES],
            bias: OdometryBias::default(),
            ages_scans: [f32::INFINITY; LINES],
            in_use: 0,
            turned: [0.0; LINES],
            shift: [0.0; STATES],
        }
    }

    /// As unsure of the odometry's errors as these standard deviations say.
    pub(crate) fn prepare(&mut self, sigma_odometry: Vector3<f32>) {
        for (i, sigma) in sigma_odometry.iter().enumerate() {
            self.set(ODOMETRY + i, ODOMETRY + i, sigma * sigma);
        }
    }

    /// Lets go of all lines and begins with a pose that is sure, and with the odometry's errors as they are known, as
    /// unsure as these standard deviations say.
    pub(crate) fn clear(&mut self, sigma_odometry: Vector3<f32>) {
        self.covariance.fill(0.0);
        self.owners.fill(None);
        self.ages_scans.fill(f32::INFINITY);
        self.in_use = 0;
        self.turned.fill(0.0);
        self.shift.fill(0.0);
        if !self.bias.0.iter().all(|v| v.is_finite()) {
            self.bias = OdometryBias::default();
        }
        self.prepare(sigma_odometry);
    }

    /// The odometry's errors as known so far.
    pub fn bias(&self) -> OdometryBias {
        self.bias
    }

    /// Covariance of the pose (x, y, θ).
    pub fn pose_covariance(&self) -> Matrix3<f32> {
        self.block(POSE)
    }

    fn block(&self, first: usize) -> Matrix3<f32> {
        Matrix3::from_fn(|i, j| self.get(first + i, first + j))
    }

    fn get(&self, i: usize, j: usize) -> f32 {
        self.covariance.get(packed(i, j)).copied().unwrap_or(0.0)
    }

    /// Adds so many times the covariances of a state with the first states.
    fn add_row(&self, state: usize, by: f32, sums: &mut [f32]) {
        // Up to the diagonal they lie side by side …
        let (beside, below) = sums.split_at_mut_checked(state + 1).unwrap_or_default();
        let begin = packed(state, 0);
        if let Some(row) = self.covariance.get(begin..=begin + state) {
            beside.iter_mut().zip(row).for_each(|(sum, value)| *sum += by * value);
        }
        // … beyond it one in each row, and each row is longer by one.
        let mut at = packed(state + 1, state);
        for (row, sum) in (state + 1..).zip(below) {
            *sum += by * self.covariance.get(at).copied().unwrap_or(0.0);
            at += row + 1;
        }
    }

    /// Covariance of each state with two numbers that have these derivatives.
    fn covariance_with(&self, derivative: &Derivative, sums: &mut [[f32; STATES]; 2]) {
        *sums = [[0.0; STATES]; 2];
        if derivative.by_pose != [[0.0; 3]; 2] {
            self.add_columns(POSE, &derivative.by_pose, sums);
        }
        for (place, by_line) in &derivative.by_lines {
            let [first, _] = states_of(*place);
            self.add_columns(first, by_line, sums);
        }
    }

    /// The same in the room for it, after what has been told.
    fn covariance_after(&self, told: &mut Told, derivative: &Derivative) {
        let (earlier, Some(with)) = told.parts() else { return };
        self.covariance_with(derivative, with);
        let [with_o, with_d] = with;
        for (earlier, information) in earlier {
            let [share_o, share_d] = derivative.times(earlier).map(|with| with * information);
            for ((o, d), earlier) in with_o.iter_mut().zip(with_d.iter_mut()).zip(earlier) {
                *o -= share_o * earlier;
                *d -= share_d * earlier;
            }
        }
    }

    /// Adds the covariances of all states with some that lie side by side, so many times each, to two sums.
    fn add_columns<const W: usize>(
        &self,
        first: usize,
        times: &[[f32; W]; 2],
        sums: &mut [[f32; STATES]; 2],
    ) {
        let [sums_o, sums_d] = sums;
        let [times_o, times_d] = times;
        let all = self.states();
        // Before them their columns lie as rows, …
        for (w, (by_o, by_d)) in times_o.iter().zip(times_d).enumerate() {
            let begin = packed(first + w, 0);
            let row = self.covariance.get(begin..begin + first).unwrap_or_default();
            for ((value, o), d) in row.iter().zip(sums_o.iter_mut()).zip(sums_d.iter_mut()) {
                *o += by_o * value;
                *d += by_d * value;
            }
        }
        let mut add = |state: usize, values: &[f32; W]| {
            let (Some(o), Some(d)) = (sums_o.get_mut(state), sums_d.get_mut(state)) else { return };
            for ((value, by_o), by_d) in values.iter().zip(times_o).zip(times_d) {
                *o += by_o * value;
                *d += by_d * value;
            }
        };
        for state in first..first + W {
            add(state, &core::array::from_fn(|w| self.get(state, first + w)));
        }
        // … beyond them side by side in each row, which are each longer by one.
        let mut at = packed(first + W, first);
        for state in first + W..all {
            if let Some(values) = self.covariance.get(at..).and_then(|rest| rest.first_chunk()) {
                add(state, values);
            }
            at += state + 1;
        }
    }

    fn set(&mut self, i: usize, j: usize, value: f32) {
        if let Some(slot) = self.covariance.get_mut(packed(i, j)) {
            *slot = value;
        }
    }

    /// States up to the last line in use.
    fn states(&self) -> usize {
        let lines = self.owners.iter().rposition(Option::is_some).map_or(0, |last| last + 1);
        FIRST_LINE + 2 * lines
    }

    /// Moves the pose: `by_pose` and `by_odometry` are the new pose's derivatives by the old one and by the odometry's
    /// errors, `noise` is what the motion adds.
    pub fn predict<const N: usize>(
        &mut self,
        by_pose: &Matrix3<f32>,
        by_odometry: &Matrix3<f32>,
        noise: &Matrix3<f32>,
        map: &mut SegmentMap<N>,
    ) {
        self.ages_scans.iter_mut().for_each(|age| *age += 1.0);
        self.in_use = 0;
        let cross = Matrix3::from_fn(|i, j| self.get(POSE + i, ODOMETRY + j));
        let (pose, errors) = (self.block(POSE), self.block(ODOMETRY));
        let mixed = by_pose * cross * by_odometry.transpose();
        let moved = by_pose * pose * by_pose.transpose()
            + mixed
            + mixed.transpose()
            + by_odometry * errors * by_odometry.transpose()
            + noise;
        for state in ODOMETRY..self.states() {
            let with_pose = Vector3::from_fn(|i, _| self.get(POSE + i, state));
            let with_odometry = Vector3::from_fn(|i, _| self.get(ODOMETRY + i, state));
            let with_moved = by_pose * with_pose + by_odometry * with_odometry;
            for (i, value) in with_moved.iter().enumerate() {
                self.set(POSE + i, state, *value);
            }
        }
        self.set_pose_covariance(&moved);
        self.begin_anew_if_lost(map);
    }

    /// Lets go of the lines and of what the pose has in common with anything, where the pose is less sure than `f32` can bear.
    fn begin_anew_if_lost<const N: usize>(&mut self, map: &mut SegmentMap<N>) {
        let covariance = self.pose_covariance();
        let variances = covariance.diagonal();
        if variances.iter().zip(&MOST_VARIANCE).all(|(own, most)| own <= most) {
            return;
        }
        for place in 0..LINES {
            self.release(place, map);
        }
        for state in 0..STATES {
            (POSE..ODOMETRY).for_each(|pose| self.set(pose, state, 0.0));
        }
        let most = Vector3::from(MOST_VARIANCE);
        self.set_pose_covariance(&Matrix3::from_diagonal(&variances.inf(&most)));
    }

    /// Makes the pose less sure, for reasons of its own.
    pub fn loosen_pose<const N: usize>(&mut self, by: &Matrix3<f32>, map: &mut SegmentMap<N>) {
        let looser = self.pose_covariance() + by;
        self.set_pose_covariance(&looser);
        self.begin_anew_if_lost(map);
    }

    fn set_pose_covariance(&mut self, covariance: &Matrix3<f32>) {
        for (i, row) in covariance.row_iter().enumerate() {
            for (j, value) in row.iter().enumerate() {
                self.set(POSE + i, POSE + j, *value);
            }
        }
    }

    /// Scans since the line at a place was added; infinite for one that was known before.
    pub(crate) fn age_scans(&self, place: usize) -> f32 {
        self.ages_scans.get(place).copied().unwrap_or(0.0)
    }

    /// Index in the map of the line that has this place.
    pub(crate) fn owner(&self, place: usize) -> Option<usize> {
        self.owners.get(place).copied().flatten().map(usize::from)
    }

    /// The place of a map segment among the lines, if it is tracked.
    pub(crate) fn place_of(&self, index: usize) -> Option<usize> {
        self.owners.iter().position(|owner| owner.is_some_and(|o| usize::from(o) == index))
    }

    /// The place of a map segment among the lines; it is given one if it has none, at the cost of the segment not seen
    /// for longest, and with its own variances so many times. `None` when all lines tracked were seen in the scan at hand.
    pub(crate) fn track<const N: usize>(
        &mut self,
        index: usize,
        again_factor: f32,
        map: &mut SegmentMap<N>,
    ) -> Option<usize> {
        if let Some(place) = self.place_of(index) {
            self.in_use |= 1 << place;
            return Some(place);
        }
        let segment = map.segments().get(index)?.segment;
        let place = self.free_place(map)?;
        *self.owners.get_mut(place)? = u16::try_from(index).ok();
        *self.ages_scans.get_mut(place)? = f32::INFINITY;
        for (state, variance) in states_of(place).into_iter().zip(variances(&segment)) {
            self.set(state, state, again_factor * variance);
        }
        Some(place)
    }

    /// A place without covariances, for use in the scan at hand.
    fn free_place<const N: usize>(&mut self, map: &mut SegmentMap<N>) -> Option<usize> {
        let last_seen = |owner: &Option<u16>| match owner {
            Some(owner) => map.segments().get(usize::from(*owner)).map_or(0, |s| 1 + s.last_seen),
            None => 0,
        };
        let owners = self.owners.iter().enumerate().filter(|(place, _)| self.in_use & (1 << place) == 0);
        let (place, _) =
            owners.map(|(place, owner)| (place, last_seen(owner))).min_by_key(|(_, seen)| *seen)?;
        self.release(place, map);
        self.in_use |= 1 << place;
        Some(place)
    }

    /// Ends the tracking of a line; its segment keeps its own variances.
    fn release<const N: usize>(&mut self, place: usize, map: &mut SegmentMap<N>) {
        let [offset, direction] = states_of(place);
        if let Some(owner) = self.owners.get_mut(place).and_then(Option::take)
            && let Some(entry) = map.get_mut(usize::from(owner))
        {
            entry.segment =
                with_variances(&entry.segment, self.get(offset, offset), self.get(direction, direction));
        }
        for state in 0..STATES {
            self.set(state, offset, 0.0);
            self.set(state, direction, 0.0);
        }
        if let Some(turned) = self.turned.get_mut(place) {
            *turned = 0.0;
        }
        if let Some(shift) = self.shift.get_mut(offset..=direction) {
            shift.fill(0.0);
        }
        self.in_use &= !(1 << place);
    }

    /// Ends the tracking of a line whose segment is no more.
    fn vacate<const N: usize>(&mut self, place: usize, map: &mut SegmentMap<N>) {
        if let Some(owner) = self.owners.get_mut(place) {
            *owner = None;
        }
        self.release(place, map);
    }

    /// The map has given the place of a segment to another one.
    pub(crate) fn replaced<const N: usize>(&mut self, index: usize, map: &mut SegmentMap<N>) {
        if let Some(place) = self.place_of(index) {
            self.vacate(place, map);
        }
    }

    /// The map's segment `gone` is no more, and the one at `last` has taken its index.
    pub(crate) fn removed<const N: usize>(&mut self, gone: usize, last: usize, map: &mut SegmentMap<N>) {
        if let Some(place) = self.place_of(gone) {
            self.vacate(place, map);
        }
        if let Some(owner) = self.place_of(last).and_then(|place| self.owners.get_mut(place)) {
            *owner = u16::try_from(gone).ok();
        }
    }

    /// What a measurement would say now, after what was measured before.
    pub(crate) fn weigh(&self, measurement: &Measurement) -> Weighed {
        let entries: heapless::Vec<_, 7> = measurement.by.entries().collect();
        let mut known = Matrix2::zeros();
        for (k, &(i, [o_i, d_i])) in entries.iter().enumerate() {
            for &(j, [o_j, d_j]) in entries.iter().take(k) {
                let value = self.get(i, j);
                known.m11 += 2.0 * o_i * o_j * value;
                known.m12 += (o_i * d_j + o_j * d_i) * value;
                known.m22 += 2.0 * d_i * d_j * value;
            }
            let variance = self.get(i, i);
            known.m11 += o_i * o_i * variance;
            known.m12 += o_i * d_i * variance;
            known.m22 += d_i * d_i * variance;
        }
        Weighed::new(self.errors(measurement), &known, measurement)
    }

    /// Errors of a measurement after what was measured before.
    fn errors(&self, measurement: &Measurement) -> [f32; 2] {
        let ([offset, direction], [by_o, by_d]) = (measurement.errors, measurement.by.times(&self.shift));
        [offset + by_o, direction + by_d]
    }

    /// Takes in a measurement, as far as it deserves it; false where it does not. Work: with [`Learning::All`] the square of the
    /// number of states, otherwise that number, some times.
    pub(crate) fn measure(&mut self, measurement: &Measurement, trust: &Trust, learning: Learning) -> bool {
        let mut told = Told::new();
        let is_taken = self.learn_from(measurement, trust, learning, &mut told);
        self.take_out(&mut told);
        is_taken
    }

    /// The same for several measurements one after the other, with less work. One of a line that has been forgotten says
    /// nothing.
    pub(crate) fn measure_all<'a>(
        &mut self,
        measurements: impl Iterator<Item = (&'a Measurement, Learning)>,
        trust: &Trust,
    ) {
        let mut told = Told::new();
        for (measurement, learning) in measurements {
            if measurement.by.by_lines.iter().any(|(place, _)| self.owner(*place).is_none()) {
                continue;
            }
            if !told.has_room() {
                self.take_out(&mut told);
            }
            self.learn_from(measurement, trust, learning, &mut told);
        }
        self.take_out(&mut told);
    }

    fn take_out(&mut self, told: &mut Told) {
        let states = self.states();
        told.take_out(&mut self.covariance, states);
    }

    /// Takes in a measurement but for what everything has learnt of the covariance, which is told.
    fn learn_from(
        &mut self,
        measurement: &Measurement,
        trust: &Trust,
        learning: Learning,
        told: &mut Told,
    ) -> bool {
        self.covariance_after(told, &measurement.by);
        let Some(with) = told.at_hand::<2>() else { return false };
        let [[o_with_o, d_with_o], [_, d_with_d]] = with.each_ref().map(|with| measurement.by.times(with));
        let known = Matrix2::new(o_with_o, d_with_o, d_with_o, d_with_d);
        let weighed = Weighed::new(self.errors(measurement), &known, measurement);
        if weighed.chi2.is_nan() || weighed.chi2 > trust.max_chi2 {
            return false;
        }
        let factor = max(weighed.chi2 / trust.kernel_chi2, 1.0);
        let noise = measurement.variances.map(|variance| variance * factor);
        let [offset, direction] = weighed.gains.map(|gain| gain >= trust.least_gain);
        match learning {
            // What only a line learns, the robot does not know when it is told the next.
            Learning::Line(_) if offset && direction => {
                self.take_in(measurement, noise, [true, false], learning, told);
                self.covariance_after(told, &measurement.by);
                self.take_in(measurement, noise, [false, true], learning, told);
            }
            _ => self.take_in(measurement, noise, [offset, direction], learning, told),
        }
        true
    }

    /// Takes in those numbers of a measurement, offset and direction, that `taken` names.
    #[inline]
    fn take_in(
        &mut self,
        measurement: &Measurement,
        noise: [f32; 2],
        taken: [bool; 2],
        learning: Learning,
        told: &mut Told,
    ) {
        let (_, Some([with_o, with_d])) = told.parts() else { return };
        let [[o_with_o, d_with_o], [_, d_with_d]] =
            [&*with_o, &*with_d].map(|with| measurement.by.times(with));
        let errors = self.errors(measurement);
        let tells = |taken, number: &Number| {
            taken && number.variance > 0.0 && number.variance.is_finite() && number.error.is_finite()
        };
        let offset = Number { error: errors[0], variance: o_with_o + noise[0] };
        let mut direction = Number { error: errors[1], variance: d_with_d + noise[1] };
        let with_offset = tells(taken[0], &offset);
        if with_offset && taken[1] {
            // What the direction says beyond what the offset has told.
            let share = d_with_o / offset.variance;
            with_d.iter_mut().zip(&*with_o).for_each(|(d, o)| *d -= share * o);
            direction.error -= share * offset.error;
            direction.variance -= share * d_with_o;
        }
        match (with_offset, tells(taken[1], &direction)) {
            (true, true) => self.learn([offset, direction], learning, told),
            (true, false) => self.learn([offset], learning, told),
            (false, true) => {
                *with_o = *with_d;
                self.learn([direction], learning, told);
            }
            (false, false) => {}
        }
    }

    /// Learns from numbers that are independent of each other.
    fn learn<const K: usize>(&mut self, numbers: [Number; K], learning: Learning, told: &mut Told) {
        let Some(with) = told.at_hand::<K>() else { return };
        for range in learning.states() {
            for (with, number) in with.iter().zip(&numbers) {
                let by = number.error / number.variance;
                let shifts = self.shift.get_mut(range.clone()).unwrap_or_default();
                let with = with.get(range.clone()).unwrap_or_default();
                shifts.iter_mut().zip(with).for_each(|(shift, with)| *shift -= with * by);
            }
        }
        let information = numbers.map(|number| 1.0 / number.variance);
        match learning {
            Learning::All => told.add(information),
            Learning::RobotAndLine(_) | Learning::Line(_) => self.lower_some(with, information, learning),
        }
    }

    /// Takes from the covariance what numbers of this information have told those that learn. What does not learn has no
    /// gain; the gains of the others are those of the whole filter.
    fn lower_some<const K: usize>(
        &mut self,
        with: &[[f32; STATES]; K],
        information: [f32; K],
        learning: Learning,
    ) {
        let ranges = learning.states();
        let states = self.states();
        let mut rest = self.covariance.as_mut_slice();
        for state in 0..states {
            let Some((row, below)) = rest.split_at_mut_checked(state + 1) else { return };
            rest = below;
            let gains = told::gains(with, information, state);
            if gains == [0.0; K] {
                continue;
            }
            if ranges.iter().any(|range| range.contains(&state)) {
                subtract(row, 0, with, gains);
                row.last_mut().into_iter().for_each(told::keep_above_least);
                continue;
            }
            // What it has in common with those that do learn.
            for range in &ranges {
                if let Some(part) = row.get_mut(range.start..range.end.min(state)) {
                    subtract(part, range.start, with, gains);
                }
            }
        }
    }

    /// Carries what was measured over to the pose, the odometry's errors and the segments of the map.
    pub(crate) fn settle<const N: usize>(
        &mut self,
        prior: &Isometry2<f32>,
        map: &mut SegmentMap<N>,
    ) -> Isometry2<f32> {
        let shift = core::mem::replace(&mut self.shift, [0.0; STATES]);
        let part = |state: usize| shift.get(state).copied().unwrap_or(0.0);
        for (i, error) in self.bias.0.iter_mut().enumerate() {
            *error += part(ODOMETRY + i);
        }
        let c = components(prior);
        let settled = pose(c.x + part(POSE), c.y + part(POSE + 1), c.z + part(POSE + 2));
        // Errors are those about the new estimate: one that turns everything about the map's origin moves the robot's new
        // position, and shifts a line along its new normal.
        self.add_states(POSE, &[(POSE + 2, -part(POSE + 1))]);
        self.add_states(POSE + 1, &[(POSE + 2, part(POSE))]);
        let pose_information = self.pose_covariance().try_inverse();
        for place in 0..LINES {
            let Some(owner) = self.owners.get(place).copied().flatten() else { continue };
            let Some(entry) = map.get_mut(usize::from(owner)) else { continue };
            let [offset, direction] = states_of(place);
            let moved = entry.segment.shifted(part(offset), part(direction));
            if let Some(turned) = self.turned.get_mut(place) {
                *turned += part(direction);
                if turned.abs() > CARRIED_RAD {
                    // The normal turns away from the direction.
                    let normal_by = -moved.direction * core::mem::take(turned);
                    let from_robot = moved.moments.centroid.coords - settled.translation.vector;
                    let [[x, y, heading], _] = by_pose(normal_by, from_robot);
                    self.add_states(offset, &[(POSE, x), (POSE + 1, y), (POSE + 2, heading)]);
                }
            }
            let moved = self.centred(&moved, place, pose_information.as_ref());
            if moved.is_finite() {
                entry.segment = moved;
            }
        }
        settled
    }

    /// Adds multiples of other states' errors to a state's error.
    fn add_states(&mut self, state: usize, others: &[(usize, f32)]) {
        let own: f32 = self.get(state, state)
            + others
                .iter()
                .map(|&(i, by)| {
                    let among = others.iter().map(|&(j, other)| other * self.get(i, j)).sum::<f32>();
                    by * (2.0 * self.get(state, i) + among)
                })
                .sum::<f32>();
        let mut sums = [-0.0; STATES];
        let sums = sums.get_mut(..self.states()).unwrap_or_default();
        for &(i, by) in others {
            self.add_row(i, by, sums);
        }
        let (beside, below) = sums.split_at_mut_checked(state + 1).unwrap_or_default();
        let begin = packed(state, 0);
        if let Some(row) = self.covariance.get_mut(begin..begin + state) {
            row.iter_mut().zip(beside).for_each(|(value, sum)| *value += *sum);
        }
        let mut at = packed(state + 1, state);
        for (row, sum) in (state + 1..).zip(below) {
            if let Some(value) = self.covariance.get_mut(at) {
                *value += *sum;
            }
            at += row + 1;
        }
        self.set(state, state, max(own, 0.0));
    }

    /// The segment with its centroid where offset and direction are independent, within its ends, and with its variances
    /// given the pose.
    fn centred(
        &mut self,
        segment: &Segment,
        place: usize,
        pose_information: Option<&Matrix3<f32>>,
    ) -> Segment {
        let [offset, direction] = states_of(place);
        let mut segment = *segment;
        let var_direction = self.get(direction, direction);
        if var_direction > 0.0 {
            let way = -self.get(offset, direction) / var_direction;
            let (a, b) = (segment.along_of(segment.start), segment.along_of(segment.end));
            let way = if a <= b { within(way, a, b) } else { 0.0 };
            if way * way * var_direction > CENTRED_SHARE * self.get(offset, offset) {
                self.add_states(offset, &[(direction, way)]);
                segment.moments.centroid += segment.direction * way;
            }
        }
        let [var_offset, var_direction] =
            [offset, direction].map(|state| self.given_pose(state, pose_information));
        with_variances(&segment, var_offset, var_direction)
    }

    /// Variance of a line's state if the pose were known.
    fn given_pose(&self, state: usize, pose_information: Option<&Matrix3<f32>>) -> f32 {
        // Rounding may have taken a variance below zero, and a range must not be empty.
        let own = max(self.get(state, state), LEAST_VARIANCE);
        let with = Vector3::from_fn(|i, _| self.get(POSE + i, state));
        let explained = pose_information.map_or(0.0, |w| with.dot(&(w * with)));
        max(within(own - explained, 0.01 * own, own), LEAST_VARIANCE)
    }

    /// Tracks a segment just added to the map, seen from the pose with these variances of its own.
    pub(crate) fn add<const N: usize>(
        &mut self,
        index: usize,
        position: Vector2<f32>,
        map: &mut SegmentMap<N>,
    ) {
        let Some(segment) = map.segments().get(index).map(|s| s.segment) else { return };
        let [var_offset, var_direction] = variances(&segment);
        let by_pose = by_pose(segment.normal(), segment.moments.centroid.coords - position);
        let seen = Derivative { by_pose, by_lines: heapless::Vec::new() };
        let place = self.free_place(map);
        let mut with = [[0.0; STATES]; 2];
        self.covariance_with(&seen, &mut with);
        let [[o_with_o, d_with_o], [_, d_with_d]] = with.each_ref().map(|with| seen.times(with));
        let (var_offset, var_direction) = (o_with_o + var_offset, d_with_d + var_direction);
        let Some(place) = place else {
            if let Some(entry) = map.get_mut(index) {
                entry.segment = with_variances(&segment, var_offset, var_direction);
            }
            return;
        };
        if let (Some(owner), Some(age)) = (self.owners.get_mut(place), self.ages_scans.get_mut(place)) {
            (*owner, *age) = (u16::try_from(index).ok(), 0.0);
        }
        let own = states_of(place);
        for (own, with) in own.into_iter().zip(&with) {
            for (other, value) in with.iter().enumerate().take(self.states()) {
                self.set(own, other, *value);
            }
        }
        let [offset, direction] = own;
        self.set(offset, offset, var_offset);
        self.set(direction, direction, var_direction);
        self.set(offset, direction, d_with_o);
    }
}

/// What a measurement would say.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Weighed {
    /// Its error against all that may explain it.
    pub chi2: f32,
    /// Variance of what it measures over its own, for offset and direction: how much each would tell.
    pub gains: [f32; 2],
}

impl Weighed {
    /// Of a measurement with these errors, of numbers that are known with this covariance.
    fn new(errors: [f32; 2], known: &Matrix2<f32>, measurement: &Measurement) -> Self {
        let ([var_o, var_d], error) = (measurement.variances, Vector2::from(errors));
        let covariance = Matrix2::new(known.m11 + var_o, known.m12, known.m12, known.m22 + var_d);
        Self {
            chi2: covariance.try_inverse().map_or(f32::INFINITY, |w| error.dot(&(w * error))),
            gains: [known.m11 / var_o, known.m22 / var_d],
        }
    }
}

/// How far a measurement is believed.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Trust {
    /// One with a larger χ² is not taken in.
    pub max_chi2: f32,
    /// Of one with a larger χ² the variances grow with its χ².
    pub kernel_chi2: f32,
    /// A number whose gain is smaller is passed over.
    pub least_gain: f32,
}

/// A number measured: how much it is off, and how much it may be by all that is known.
#[derive(Clone, Copy, Debug)]
struct Number {
    error: f32,
    variance: f32,
}

/// What learns from a measurement. What does not keeps its estimate, and rightly knows less of it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Learning {
    /// Everything that has something in common with it.
    All,
    /// The pose, the odometry's errors and the line at this place.
    RobotAndLine(usize),
    /// The line at this place.
    Line(usize),
}

impl Learning {
    fn states(self) -> [Range<usize>; 2] {
        let line = |place| {
            let [first, last] = states_of(place);
            first..last + 1
        };
        match self {
            Self::All => [0..STATES, 0..0],
            Self::RobotAndLine(place) => [0..FIRST_LINE, line(place)],
            Self::Line(place) => [0..0, line(place)],
        }
    }
}

/// Takes so many times each of some vectors, from an index on, from the values.
#[inline]
fn subtract<const K: usize>(from: &mut [f32], begin: usize, with: &[[f32; STATES]; K], times: [f32; K]) {
    for (with, times) in with.iter().zip(times) {
        let with = with.get(begin..begin + from.len()).unwrap_or_default();
        from.iter_mut().zip(with).for_each(|(value, with)| *value -= times * with);
    }
}

impl Measurement {
    /// An observed segment, already in `map` through some pose, against the map segment tracked at `place`. `since_prior`
    /// leads from the prior's (x, y, θ) to that pose.
    pub(crate) fn of_pair(
        place: usize,
        mapped: &Segment,
        seen: &Segment,
        prior_position: Vector2<f32>,
        since_prior: &Vector3<f32>,
        variances: [f32; 2],
    ) -> Self {
        let centroid = seen.moments.centroid;
        let apart = centroid - mapped.moments.centroid;
        let by_pose = by_pose(mapped.normal(), centroid.coords - prior_position);
        let [offset, direction] = by_pose.map(|by| Vector3::from(by).dot(since_prior));
        // The error at the prior: that at the pose, less what the way from there has changed.
        let errors =
            [mapped.normal().dot(&apart) - offset, cross(mapped.direction, seen.direction) - direction];
        let by_line = [[-1.0, -mapped.direction.dot(&apart)], [0.0, -1.0]];
        let by_lines = heapless::Vec::from_slice(&[(place, by_line)]).unwrap_or_default();
        Self { errors, variances, by: Derivative { by_pose, by_lines } }
    }

    /// Two map segments that are one wall.
    pub(crate) fn of_twins(kept: (&Segment, usize), gone: (&Segment, usize), variances: [f32; 2]) -> Self {
        let ((a, place_a), (b, place_b)) = (kept, gone);
        let apart = b.moments.centroid - a.moments.centroid;
        let along = a.along_of(b.moments.centroid);
        let by_lines = [(place_a, [[-1.0, -along], [0.0, -1.0]]), (place_b, [[1.0, 0.0], [0.0, 1.0]])];
        let by_lines = heapless::Vec::from_slice(&by_lines).unwrap_or_default();
        let errors = [a.normal().dot(&apart), cross(a.direction, b.direction)];
        Self { errors, variances, by: Derivative { by_pose: [[0.0; 3]; 2], by_lines } }
    }
}

fn states_of(place: usize) -> [usize; 2] {
    [FIRST_LINE + 2 * place, FIRST_LINE + 2 * place + 1]
}

/// Variances of a segment's offset and direction, as its sums say.
pub(crate) fn variances(segment: &Segment) -> [f32; 2] {
    let variance = |information: f32| 1.0 / max(information, 1e-9);
    [variance(segment.moments.weight), variance(segment.moments.scatter_along(segment.direction))]
}

/// The segment with sums that say these variances.
pub(crate) fn with_variances(segment: &Segment, var_offset: f32, var_direction: f32) -> Segment {
    let mut segment = *segment;
    let d = segment.direction;
    let information = 1.0 / max(var_direction, LEAST_VARIANCE);
    segment.moments.weight = 1.0 / max(var_offset, LEAST_VARIANCE);
    segment.moments.scatter = [d.x * d.x * information, d.x * d.y * information, d.y * d.y * information];
    segment
}

/// Derivatives of a line's offset, at a point this far from the robot, and of its direction by the pose it is seen from.
fn by_pose(normal: Vector2<f32>, from_robot: Vector2<f32>) -> [[f32; 3]; 2] {
    [[normal.x, normal.y, normal.dot(&perpendicular(from_robot))], [0.0, 0.0, 1.0]]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::pose::rotate_covariance;
    use crate::odometry::{Increment, OdometryNoise};
    use nalgebra::Point2;
    use rand_core::{Rng, SeedableRng};

    const NOISE: OdometryNoise = OdometryNoise {
        sigma_along_m_per_sqrt_m: 0.02,
        sigma_across_m_per_sqrt_m: 0.01,
        sigma_heading_rad_per_sqrt_m: 0.03,
        sigma_heading_rad_per_sqrt_rad: 0.0,
        sigma_position_floor_m: 0.001,
        sigma_heading_floor_rad: 0.001,
    };
    const SEEN: [f32; 2] = [1e-4, 4e-4];
    const SURE: [f32; 2] = [1e-5, 4e-5];
    const AGAIN: f32 = 2.0;
    const PLAIN: Trust = Trust { max_chi2: f32::INFINITY, kernel_chi2: f32::INFINITY, least_gain: 0.0 };

    struct Gauss(rand_pcg::Pcg32);

    impl Gauss {
        fn draw(&mut self) -> f32 {
            (0..12).map(|_| self.0.next_u32() as f32 / u32::MAX as f32).sum::<f32>() - 6.0
        }
    }

    /// A robot in a corridor of many short walls, of which it sees those near it, through an odometry with unknown errors.
    struct World {
        walls: std::vec::Vec<Segment>,
        truth: Isometry2<f32>,
        believed: Isometry2<f32>,
        joint: Joint,
        map: SegmentMap<64>,
        /// Index in the map of each wall known.
        known: std::vec::Vec<Option<usize>>,
        gauss: Gauss,
        scan: u32,
    }

    impl World {
        fn new(seed: u64) -> Self {
            let wall = |from: (f32, f32), to: (f32, f32)| {
                let (from, to) = (Point2::new(from.0, from.1), Point2::new(to.0, to.1));
                Segment::from_ends(from, to, 20, 1e-4, Point2::new(from.x, 0.0))
            };
            let walls: std::vec::Vec<Segment> = (0..20)
                .flat_map(|k| {
                    let x = k as f32;
                    [
                        wall((x, 1.0), (x + 0.7, 1.0)),
                        wall((x, -1.0), (x + 0.5, -1.3)),
                        wall((x, -1.0), (x, -1.4)),
                    ]
                })
                .collect();
            let mut gauss = Gauss(rand_pcg::Pcg32::seed_from_u64(seed));
            let joint = Joint::new(Vector3::new(0.02, 0.0, 0.01));
            let known = std::vec![None; walls.len()];
            let here = pose(0.5, 0.0, 0.0);
            gauss.draw();
            let (map, scan) = (SegmentMap::new(), 0);
            Self { walls, truth: here, believed: here, joint, map, known, gauss, scan }
        }

        fn step(&mut self, forward: f32, bias: Vector3<f32>) {
            self.scan += 1;
            let said = Increment::from_motion(pose(forward, 0.0, 0.0));
            let really = OdometryBias(bias).corrected(&said);
            let l = NOISE.covariance(&said).cholesky().unwrap().l();
            let noise = l * Vector3::from_fn(|_, _| self.gauss.draw());
            self.truth *= really.before_from_after * pose(noise.x, noise.y, noise.z);
            let increment = self.joint.bias().corrected(&said);
            let mut by_pose = Matrix3::identity();
            let lever =
                perpendicular(self.believed.rotation * increment.before_from_after.translation.vector);
            (by_pose.m13, by_pose.m23) = (lever.x, lever.y);
            let turn = self.believed.rotation.to_rotation_matrix().to_homogeneous();
            let grown = rotate_covariance(&self.believed, &NOISE.covariance(&increment));
            self.joint.predict(&by_pose, &(turn * OdometryBias::derivative(&said)), &grown, &mut self.map);
            self.believed *= increment.before_from_after;
            self.look();
        }

        fn look(&mut self) {
            let at = self.truth.translation.vector;
            let near: std::vec::Vec<usize> = (0..self.walls.len())
                .filter(|&i| (self.walls[i].midpoint().coords - at).norm() < 2.5)
                .collect();
            let mut new = std::vec::Vec::new();
            for i in near {
                let in_base = self.walls[i].transformed(&self.truth.inverse());
                let noisy =
                    in_base.shifted(self.gauss.draw() * SEEN[0].sqrt(), self.gauss.draw() * SEEN[1].sqrt());
                let seen = with_variances(&noisy.transformed(&self.believed), SEEN[0], SEEN[1]);
                let Some(index) = self.known[i] else {
                    new.push((i, with_variances(&noisy, SEEN[0], SEEN[1])));
                    continue;
                };
                let place = self.joint.track(index, AGAIN, &mut self.map).unwrap();
                let entry = self.map.get_mut(index).unwrap();
                entry.last_seen = self.scan;
                let position = self.believed.translation.vector;
                let measurement =
                    Measurement::of_pair(place, &entry.segment, &seen, position, &Vector3::zeros(), SEEN);
                self.joint.measure(&measurement, &PLAIN, Learning::All);
            }
            self.believed = self.joint.settle(&self.believed, &mut self.map);
            for (i, in_base) in new {
                let index = self.map.insert(in_base.transformed(&self.believed), self.scan, 0.0).unwrap();
                self.joint.add(index, self.believed.translation.vector, &mut self.map);
                self.known[i] = Some(index);
            }
        }

        fn nees(&self) -> f32 {
            let mut off = components(&self.believed) - components(&self.truth);
            off.z = crate::geometry::math::wrap_angle(off.z);
            off.dot(&(self.joint.pose_covariance().try_inverse().unwrap() * off))
        }
    }

    /// There and back, over more walls than are tracked: the pose's error is as large as the covariance says.
    #[test]
    fn the_covariance_is_that_of_the_error() {
        let runs = 60;
        let (mut out, mut back) = (0.0, 0.0);
        for seed in 0..runs {
            let mut world = World::new(seed);
            let bias = Vector3::new(0.02 * world.gauss.draw(), 0.0, 0.01 * world.gauss.draw());
            world.look();
            (0..100).for_each(|_| world.step(0.1, bias));
            out += world.nees() / runs as f32;
            (0..90).for_each(|_| world.step(-0.1, bias));
            back += world.nees() / runs as f32;
        }
        // Mean of 60 samples of χ² with three degrees of freedom: 3 ± 0.32.
        assert!((2.2..4.0).contains(&out), "going out: {out}");
        assert!((2.0..4.5).contains(&back), "coming back: {back}");
    }

    /// New walls say where they are, never where the robot is: without anything known before, it grows only less sure.
    #[test]
    fn new_walls_do_not_make_the_robot_surer() {
        let mut world = World::new(3);
        world.look();
        let mut last = 0.0;
        for k in 0..120 {
            world.step(0.1, Vector3::zeros());
            let sigma = world.joint.pose_covariance().m11.sqrt();
            if k % 30 == 29 {
                assert!(sigma > last, "after {k} steps {sigma}, before {last}");
                last = sigma;
            }
        }
    }

    #[test]
    fn the_odometry_s_errors_are_learnt() {
        let mut world = World::new(5);
        world.look();
        let bias = Vector3::new(0.03, 0.0, 0.01);
        (0..150).for_each(|k| world.step(if k < 100 { 0.1 } else { -0.1 }, bias));
        let learnt = world.joint.bias().0;
        assert!((learnt.x - 0.03).abs() < 0.015 && (learnt.z - 0.01).abs() < 0.007, "{learnt}");
    }

    #[test]
    fn with_only_the_line_named_learns() {
        let mut world = World::new(8);
        world.look();
        world.step(0.1, Vector3::zeros());
        let before = world.joint.clone();
        let entry = world.map.segments()[0];
        let place = world.joint.track(0, AGAIN, &mut world.map).unwrap();
        let seen = entry.segment.shifted(0.05, 0.1);
        let position = world.believed.translation.vector;
        let measurement =
            Measurement::of_pair(place, &entry.segment, &seen, position, &Vector3::zeros(), SEEN);
        world.joint.measure(&measurement, &PLAIN, Learning::Line(place));
        assert_eq!(world.joint.pose_covariance(), before.pose_covariance());
        let same = world.joint.settle(&world.believed, &mut world.map);
        assert_eq!(components(&same), components(&world.believed));
        let moved = world.map.segments()[0].segment.midpoint() - entry.segment.midpoint();
        assert!(moved.norm() > 0.01, "{moved}");
    }

    #[test]
    fn what_is_weighed_is_what_is_measured() {
        let mut world = World::new(6);
        world.look();
        (0..30).for_each(|_| world.step(0.1, Vector3::zeros()));
        let position = world.believed.translation.vector;
        for index in 0..world.map.segments().len() {
            let entry = world.map.segments()[index];
            let Some(place) = world.joint.place_of(index) else { continue };
            let seen = entry.segment.shifted(0.02, 0.01);
            let measurement =
                Measurement::of_pair(place, &entry.segment, &seen, position, &Vector3::zeros(), SEEN);
            let weighed = world.joint.weigh(&measurement);
            let mut with = [[0.0; STATES]; 2];
            world.joint.covariance_with(&measurement.by, &mut with);
            for (state, [o, d]) in (0..STATES).map(|state| (state, [with[0][state], with[1][state]])) {
                let plain = measurement.by.entries().fold([0.0; 2], |sums, (i, [by_o, by_d])| {
                    let value = world.joint.get(state, i);
                    [sums[0] + by_o * value, sums[1] + by_d * value]
                });
                assert!((o - plain[0]).abs() < 1e-6 && (d - plain[1]).abs() < 1e-6, "{state} of {index}");
            }
            let [known_o, _] = measurement.by.times(&with[0]);
            let [_, known_d] = measurement.by.times(&with[1]);
            for (gain, known) in weighed.gains.iter().zip([known_o / SEEN[0], known_d / SEEN[1]]) {
                assert!((gain - known).abs() < 1e-2 * (1.0 + known), "{gain} {known} of {index}");
            }
            let least = |max_chi2| Trust { max_chi2, ..PLAIN };
            let mut doubting = world.joint.clone();
            assert!(!doubting.measure(&measurement, &least(0.99 * weighed.chi2), Learning::All));
            assert!(doubting.measure(&measurement, &least(1.01 * weighed.chi2), Learning::All));
        }
    }

    /// Whoever learns from them: all, and in between the robot with a line, or a line alone.
    #[test]
    fn several_measurements_at_once_say_what_they_say_one_by_one() {
        let mut world = World::new(9);
        world.look();
        (0..30).for_each(|_| world.step(0.1, Vector3::zeros()));
        let position = world.believed.translation.vector;
        let tracked = (0..world.map.segments().len()).filter_map(|i| Some((i, world.joint.place_of(i)?)));
        let measurements: std::vec::Vec<_> = tracked
            .map(|(index, place)| {
                let segment = world.map.segments()[index].segment;
                let seen = segment.shifted(0.01 * world.gauss.draw(), 0.02 * world.gauss.draw());
                let since = Vector3::zeros();
                let learning = match index % 5 {
                    2 => Learning::RobotAndLine(place),
                    4 => Learning::Line(place),
                    _ => Learning::All,
                };
                (Measurement::of_pair(place, &segment, &seen, position, &since, SURE), learning)
            })
            .collect();
        assert!(measurements.len() > 8);
        let (mut one_by_one, mut at_once) = (world.joint.clone(), world.joint.clone());
        // Some numbers are passed over.
        let trust = Trust { kernel_chi2: 2.0, least_gain: 0.05, ..PLAIN };
        for (measurement, learning) in &measurements {
            one_by_one.measure(measurement, &trust, *learning);
        }
        at_once.measure_all(measurements.iter().map(|(m, learning)| (m, *learning)), &trust);
        for i in 0..STATES {
            let sigma = world.joint.get(i, i).sqrt();
            assert!((one_by_one.shift[i] - at_once.shift[i]).abs() <= 1e-3 * sigma, "{i}");
            for j in 0..=i {
                let most = sigma * world.joint.get(j, j).sqrt();
                assert!((one_by_one.get(i, j) - at_once.get(i, j)).abs() <= 1e-4 * most, "{i} {j}");
            }
        }
        let surer = |i: usize| at_once.get(i, i) < 0.9 * world.joint.get(i, i);
        let count = (0..STATES).filter(|i| surer(*i)).count();
        assert!(count > 10, "{count} states have learnt");
    }

    #[test]
    fn a_segment_that_is_tracked_again_counts_for_less_than_it_says_of_itself() {
        let mut world = World::new(7);
        world.look();
        let index = 3;
        let place = world.joint.place_of(index).unwrap();
        world.joint.release(place, &mut world.map);
        let own = variances(&world.map.segments()[index].segment);
        let place = world.joint.track(index, AGAIN, &mut world.map).unwrap();
        for (state, own) in states_of(place).into_iter().zip(own) {
            assert_eq!(world.joint.get(state, state), AGAIN * own);
            assert_eq!(world.joint.get(POSE, state), 0.0);
        }
        // One that is tracked stays as it is.
        assert_eq!(world.joint.track(index, AGAIN, &mut world.map), Some(place));
        assert_eq!(world.joint.get(states_of(place)[0], states_of(place)[0]), AGAIN * own[0]);
    }

    /// The map has dropped a segment for a new one, at the same index.
    #[test]
    fn a_new_segment_does_not_inherit_what_was_known_of_another() {
        let mut world = World::new(2);
        world.look();
        let known = world.joint.owners.iter().flatten().count();
        world.joint.replaced(0, &mut world.map);
        world.joint.add(0, Vector2::zeros(), &mut world.map);
        assert_eq!(world.joint.owners.iter().filter(|owner| **owner == Some(0)).count(), 1);
        assert_eq!(world.joint.owners.iter().flatten().count(), known);
    }

    #[test]
    fn a_segment_that_leaves_the_map_leaves_its_place() {
        let mut world = World::new(2);
        world.look();
        let last = world.map.segments().len() - 1;
        world.map.forget(0);
        world.joint.removed(0, last, &mut world.map);
        let tracked = world.joint.owners.iter().flatten().count();
        assert_eq!(tracked, last, "one place is free, the last segment's is known by its new index");
        assert!(world.joint.place_of(0).is_some() && world.joint.place_of(last).is_none());
    }

    #[test]
    fn variances_that_rounding_spoilt_are_survived() {
        for spoilt in [-1e-3, f32::NAN, f32::INFINITY, 0.0] {
            let mut world = World::new(4);
            world.look();
            for state in FIRST_LINE..world.joint.states() {
                world.joint.set(state, state, spoilt);
            }
            let pose = world.joint.settle(&world.believed, &mut world.map);
            assert!(crate::geometry::pose::is_finite(&pose));
            assert!(world.map.segments().iter().all(|s| s.segment.is_finite()), "{spoilt}");
        }
    }

    #[test]
    fn size_is_what_the_documentation_says() {
        assert!(core::mem::size_of::<Joint>() <= 22 * 1024, "{}", core::mem::size_of::<Joint>());
    }
}
