//! The pose, the odometry's systematic errors and the lines around the robot, estimated together.
//!
//! A line is placed by a robot that is not sure where it stands, and is then used to say where the robot stands. Taken one
//! by one, pose and lines would confirm each other's errors and grow sure of them. Their joint covariance knows what they
//! have in common: an extended Kalman filter over the pose (x, y, θ), three errors of the odometry, and offset and
//! direction of up to [`LINES`] map segments, those seen last. A segment that gives up its place keeps its own variances.
//!
//! Errors are those about the present estimate, and are carried over when it moves: turned about the map's origin, a robot
//! that has been moved turns about elsewhere, and a line that has been turned is shifted along another normal. Without that
//! a filter comes to know, by turning its own estimate back and forth, what no measurement told it: where all of the map lies.
//!
//! Offsets are along a line's normal at its centroid, which wanders along the line to where the offset is independent of
//! the direction: the centroid of all points that were seen on it, as it were.

use nalgebra::{Isometry2, Matrix2, Matrix3, Vector2, Vector3};

use crate::map::SegmentMap;
use crate::math::within;
use crate::odometry_bias::OdometryBias;
use crate::pose::{components, cross, perpendicular, pose};
use crate::segment::Segment;

/// Most map segments whose errors are tracked together: 48.
pub const LINES: usize = 48;
const _: () = assert!(LINES <= u64::BITS as usize, "a bit for each");
/// Pose, then the odometry's errors, then the lines.
const POSE: usize = 0;
const ODOMETRY: usize = 3;
const FIRST_LINE: usize = 6;
const STATES: usize = FIRST_LINE + 2 * LINES;
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
const LEAST_VARIANCE: f32 = 1e-12;

/// A measurement's derivative: state and coefficient, at most eight of them.
type Row = heapless::Vec<(usize, f32), 8>;

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
    /// Offset (m) and direction (rad): error and derivative.
    rows: [(f32, Row); 2],
    /// Variances of both.
    variances: [f32; 2],
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

    /// The place of a map segment among the lines, if it is tracked.
    fn place_of(&self, index: usize) -> Option<usize> {
        self.owners.iter().position(|owner| owner.is_some_and(|o| usize::from(o) == index))
    }

    /// The place of a map segment among the lines; it is given one if it has none, at the cost of the segment not seen
    /// for longest. `None` when all lines tracked were seen in the scan at hand.
    pub(crate) fn track<const N: usize>(&mut self, index: usize, map: &mut SegmentMap<N>) -> Option<usize> {
        if let Some(place) = self.place_of(index) {
            self.in_use |= 1 << place;
            return Some(place);
        }
        let segment = map.segments().get(index)?.segment;
        let place = self.free_place(map)?;
        *self.owners.get_mut(place)? = u16::try_from(index).ok();
        *self.ages_scans.get_mut(place)? = f32::INFINITY;
        for (state, variance) in states_of(place).into_iter().zip(variances(&segment)) {
            self.set(state, state, variance);
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
        self.in_use &= !(1 << place);
    }

    /// The map's segment `gone` is no more, and the one at `last` has taken its index.
    pub(crate) fn removed<const N: usize>(&mut self, gone: usize, last: usize, map: &mut SegmentMap<N>) {
        if let Some(place) = self.place_of(gone) {
            if let Some(owner) = self.owners.get_mut(place) {
                *owner = None;
            }
            self.release(place, map);
        }
        if let Some(owner) = self.place_of(last).and_then(|place| self.owners.get_mut(place)) {
            *owner = u16::try_from(gone).ok();
        }
    }

    /// What a measurement would say now, after what was measured before.
    pub(crate) fn weigh(&self, measurement: &Measurement) -> Weighed {
        let [(error_o, row_o), (error_d, row_d)] = &measurement.rows;
        let error = Vector2::new(error_o + self.moved(row_o), error_d + self.moved(row_d));
        let [var_o, var_d] = measurement.variances;
        let [known_o, known_d] = [row_o, row_d].map(|row| self.between(row, row));
        let both = self.between(row_o, row_d);
        let covariance = Matrix2::new(known_o + var_o, both, both, known_d + var_d);
        Weighed {
            chi2: covariance.try_inverse().map_or(f32::INFINITY, |w| error.dot(&(w * error))),
            gains: [known_o / var_o, known_d / var_d],
        }
    }

    /// Takes in those numbers of a measurement, offset and direction, that `taken` names; its variances are so many times what
    /// it says. Work: with [`Learning::All`] the square of the number of states, otherwise that number, some times.
    pub(crate) fn measure(
        &mut self,
        measurement: &Measurement,
        variance_factor: f32,
        taken: [bool; 2],
        learning: Learning,
    ) {
        // What has been told but not yet taken off the covariance.
        let mut told: Option<Innovation> = None;
        let numbers = measurement.rows.iter().zip(measurement.variances).zip(taken);
        for (((error, row), variance), _) in numbers.filter(|(_, taken)| *taken) {
            let innovation = self.innovation(row, variance * variance_factor).and_then(|i| match &told {
                Some(told) => i.after(told, row),
                None => Some(i),
            });
            let Some(innovation) = innovation else { continue };
            self.shift_by(&innovation, error + self.moved(row), learning);
            match (told.take(), learning) {
                // What only a line learns, the robot does not know when it is told the next.
                (_, Learning::Line(_)) => self.lower([&innovation], learning),
                (Some(told), _) => self.lower([&told, &innovation], learning),
                (None, _) => told = Some(innovation),
            }
        }
        if let Some(told) = &told {
            self.lower([told], learning);
        }
    }

    /// What a row of a measurement says of all states; `None` where the numbers do not allow it.
    fn innovation(&self, row: &Row, variance: f32) -> Option<Innovation> {
        let mut with = [0.0; STATES];
        let tracked = with.get_mut(..self.states())?;
        for &(state, by) in row {
            self.add_row(state, by, tracked);
        }
        Innovation { total: along(row, &with) + variance, with }.checked()
    }

    fn shift_by(&mut self, innovation: &Innovation, error: f32, learning: Learning) {
        if !error.is_finite() {
            return;
        }
        let by = error / innovation.total;
        for (state, (shift, with)) in self.shift.iter_mut().zip(&innovation.with).enumerate() {
            if learning.includes(state) {
                *shift -= with * by;
            }
        }
    }

    /// Takes from the covariance what innovations that are independent of each other have told. What does not learn has no
    /// gain; the gains of the others are those of the whole filter.
    fn lower<const K: usize>(&mut self, innovations: [&Innovation; K], learning: Learning) {
        let states = self.states();
        let with = innovations.map(|i| &i.with);
        let (first, own) = learning.states();
        let mut rest = self.covariance.as_mut_slice();
        for state in 0..states {
            let Some((row, below)) = rest.split_at_mut_checked(state + 1) else { return };
            rest = below;
            let gains = innovations.map(|i| i.with.get(state).map_or(0.0, |with| with / i.total));
            if gains == [0.0; K] {
                continue;
            }
            if learning.includes(state) {
                subtract(row, 0, with, gains);
                if let Some(variance) = row.last_mut() {
                    *variance = variance.max(LEAST_VARIANCE);
                }
                continue;
            }
            // What it has in common with those that do learn.
            for (begin, count) in [(0, first), (own[0], own.len())] {
                if let Some(part) = row.get_mut(begin..(begin + count).min(state)) {
                    subtract(part, begin, with, gains);
                }
            }
        }
    }

    /// What the measurements so far have changed in a measurement's error.
    fn moved(&self, row: &Row) -> f32 {
        along(row, &self.shift)
    }

    fn between(&self, a: &Row, b: &Row) -> f32 {
        a.iter().map(|&(i, by)| by * b.iter().map(|&(j, other)| other * self.get(i, j)).sum::<f32>()).sum()
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
                    let [by_pose, _] = pose_rows(normal_by, from_robot);
                    self.add_states(offset, &by_pose);
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
        self.set(state, state, own.max(0.0));
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
        let own = self.get(state, state).max(LEAST_VARIANCE);
        let with = Vector3::from_fn(|i, _| self.get(POSE + i, state));
        let explained = pose_information.map_or(0.0, |w| with.dot(&(w * with)));
        within(own - explained, 0.01 * own, own).max(LEAST_VARIANCE)
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
        let by_pose = pose_rows(segment.normal(), segment.moments.centroid.coords - position);
        let Some(place) = self.free_place(map) else {
            let rows = [self.between(&by_pose[0], &by_pose[0]), self.between(&by_pose[1], &by_pose[1])];
            if let Some(entry) = map.get_mut(index) {
                entry.segment = with_variances(&segment, var_offset + rows[0], var_direction + rows[1]);
            }
            return;
        };
        if let (Some(owner), Some(age)) = (self.owners.get_mut(place), self.ages_scans.get_mut(place)) {
            (*owner, *age) = (u16::try_from(index).ok(), 0.0);
        }
        let own = states_of(place);
        for (state, row) in own.into_iter().zip(&by_pose) {
            for other in 0..self.states() {
                if !own.contains(&other) {
                    let value = row.iter().map(|&(i, by)| by * self.get(i, other)).sum();
                    self.set(state, other, value);
                }
            }
        }
        let [offset, direction] = own;
        let [row_o, row_d] = &by_pose;
        self.set(offset, offset, self.between(row_o, row_o) + var_offset);
        self.set(direction, direction, self.between(row_d, row_d) + var_direction);
        self.set(offset, direction, self.between(row_o, row_d));
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
    /// How many of the first states learn, and which two besides.
    fn states(self) -> (usize, [usize; 2]) {
        match self {
            Self::All => (STATES, [0, 1]),
            Self::RobotAndLine(place) => (FIRST_LINE, states_of(place)),
            Self::Line(place) => (0, states_of(place)),
        }
    }

    fn includes(self, state: usize) -> bool {
        let (first, own) = self.states();
        state < first || own.contains(&state)
    }
}

/// What one number measured says: the covariance of each state with what was measured, and the variance of that, the
/// measurement's own included.
struct Innovation {
    with: [f32; STATES],
    total: f32,
}

impl Innovation {
    fn checked(self) -> Option<Self> {
        (self.total > 0.0 && self.total.is_finite()).then_some(self)
    }

    /// What this says beyond what another has told; `row` is this one's.
    fn after(mut self, other: &Self, row: &Row) -> Option<Self> {
        let both = along(row, &other.with);
        let share = both / other.total;
        self.with.iter_mut().zip(&other.with).for_each(|(own, other)| *own -= share * other);
        self.total -= share * both;
        self.checked()
    }
}

/// What a row measures of some values of all states.
fn along(row: &Row, values: &[f32; STATES]) -> f32 {
    row.iter().map(|&(state, by)| by * values.get(state).copied().unwrap_or(0.0)).sum()
}

/// Takes so many times each of some vectors, from an index on, from the values. The heart of the joint estimate: four at a time, so
/// that the microcontroller need not count so often.
#[inline]
fn subtract<const K: usize>(from: &mut [f32], begin: usize, with: [&[f32; STATES]; K], times: [f32; K]) {
    let with = with.map(|values| values.get(begin..begin + from.len()).unwrap_or_default().as_chunks::<4>());
    let (fours, rest) = from.as_chunks_mut::<4>();
    match (with.as_slice(), times.as_slice()) {
        // Two at once: a value is loaded and stored but once.
        (&[(a, _), (b, _)], &[times_a, times_b]) => {
            for ((four, a), b) in fours.iter_mut().zip(a).zip(b) {
                for ((value, a), b) in four.iter_mut().zip(a).zip(b) {
                    *value = *value - times_a * a - times_b * b;
                }
            }
        }
        _ => {
            for ((others, _), times) in with.iter().zip(times) {
                for (four, others) in fours.iter_mut().zip(*others) {
                    four.iter_mut().zip(others).for_each(|(value, other)| *value -= times * other);
                }
            }
        }
    }
    for ((_, others), times) in with.iter().zip(times) {
        rest.iter_mut().zip(*others).for_each(|(value, other)| *value -= times * other);
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
        let [offset, direction] = states_of(place);
        let centroid = seen.moments.centroid;
        let apart = centroid - mapped.moments.centroid;
        let [mut by_offset, mut by_direction] = pose_rows(mapped.normal(), centroid.coords - prior_position);
        // Both derivatives hold at most five of eight entries.
        let _ = by_offset.push((offset, -1.0));
        let _ = by_offset.push((direction, -mapped.direction.dot(&apart)));
        let _ = by_direction.push((direction, -1.0));
        let errors = [mapped.normal().dot(&apart), cross(mapped.direction, seen.direction)];
        // The error at the prior: that at the pose, less what the way from there has changed.
        let at_prior = |error: f32, row: &Row| {
            let way = row.iter().filter(|(state, _)| *state < ODOMETRY);
            error - way.map(|&(state, by)| by * since_prior.get(state).copied().unwrap_or(0.0)).sum::<f32>()
        };
        let error_o = at_prior(errors[0], &by_offset);
        let error_d = at_prior(errors[1], &by_direction);
        Self { rows: [(error_o, by_offset), (error_d, by_direction)], variances }
    }

    /// Two map segments that are one wall.
    pub(crate) fn of_twins(kept: (&Segment, usize), gone: (&Segment, usize), variances: [f32; 2]) -> Self {
        let ((a, place_a), (b, place_b)) = (kept, gone);
        let ([offset_a, direction_a], [offset_b, direction_b]) = (states_of(place_a), states_of(place_b));
        let apart = b.moments.centroid - a.moments.centroid;
        let along = a.along_of(b.moments.centroid);
        let by_offset = Row::from_slice(&[(offset_b, 1.0), (offset_a, -1.0), (direction_a, -along)]);
        let by_direction = Row::from_slice(&[(direction_b, 1.0), (direction_a, -1.0)]);
        let errors = [a.normal().dot(&apart), cross(a.direction, b.direction)];
        Self {
            rows: [(errors[0], by_offset.unwrap_or_default()), (errors[1], by_direction.unwrap_or_default())],
            variances,
        }
    }
}

fn states_of(place: usize) -> [usize; 2] {
    [FIRST_LINE + 2 * place, FIRST_LINE + 2 * place + 1]
}

/// Variances of a segment's offset and direction, as its sums say.
pub(crate) fn variances(segment: &Segment) -> [f32; 2] {
    let variance = |information: f32| 1.0 / information.max(1e-9);
    [variance(segment.moments.weight), variance(segment.moments.scatter_along(segment.direction))]
}

/// The segment with sums that say these variances.
pub(crate) fn with_variances(segment: &Segment, var_offset: f32, var_direction: f32) -> Segment {
    let mut segment = *segment;
    let d = segment.direction;
    let information = 1.0 / var_direction.max(LEAST_VARIANCE);
    segment.moments.weight = 1.0 / var_offset.max(LEAST_VARIANCE);
    segment.moments.scatter = [d.x * d.x * information, d.x * d.y * information, d.y * d.y * information];
    segment
}

/// Derivatives of a line's offset, at a point this far from the robot, and of its direction by the pose it is seen from.
fn pose_rows(normal: Vector2<f32>, from_robot: Vector2<f32>) -> [Row; 2] {
    let lever = normal.dot(&perpendicular(from_robot));
    let by_offset = [(POSE, normal.x), (POSE + 1, normal.y), (POSE + 2, lever)];
    let by_direction = [(POSE + 2, 1.0)];
    [Row::from_slice(&by_offset).unwrap_or_default(), Row::from_slice(&by_direction).unwrap_or_default()]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::odometry::{Increment, OdometryNoise};
    use crate::pose::rotate_covariance;
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
                let place = self.joint.track(index, &mut self.map).unwrap();
                let entry = self.map.get_mut(index).unwrap();
                entry.last_seen = self.scan;
                let position = self.believed.translation.vector;
                let measurement =
                    Measurement::of_pair(place, &entry.segment, &seen, position, &Vector3::zeros(), SEEN);
                self.joint.measure(&measurement, 1.0, [true; 2], Learning::All);
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
            off.z = crate::math::wrap_angle(off.z);
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
        let place = world.joint.track(0, &mut world.map).unwrap();
        let seen = entry.segment.shifted(0.05, 0.1);
        let position = world.believed.translation.vector;
        let measurement =
            Measurement::of_pair(place, &entry.segment, &seen, position, &Vector3::zeros(), SEEN);
        world.joint.measure(&measurement, 1.0, [true; 2], Learning::Line(place));
        assert_eq!(world.joint.pose_covariance(), before.pose_covariance());
        let same = world.joint.settle(&world.believed, &mut world.map);
        assert_eq!(components(&same), components(&world.believed));
        let moved = world.map.segments()[0].segment.midpoint() - entry.segment.midpoint();
        assert!(moved.norm() > 0.01, "{moved}");
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
            assert!(crate::pose::is_finite(&pose));
            assert!(world.map.segments().iter().all(|s| s.segment.is_finite()), "{spoilt}");
        }
    }

    #[test]
    fn size_is_what_the_documentation_says() {
        assert!(core::mem::size_of::<Joint>() <= 22 * 1024, "{}", core::mem::size_of::<Joint>());
    }
}
