//! The filter against a dense extended Kalman filter in `f64`, which shares nothing with it but the measurements: textbook gain,
//! Joseph's form, gains of considered states set to zero.

use std::{format, string::String, vec, vec::Vec};

use nalgebra::{DMatrix, DVector, Matrix3, Vector3};

use super::*;
use crate::ekf::state::{FIRST_LINE, ODOMETRY};
use crate::ekf::world::{PLAIN, SEEN, SURE, World, measurement};
use crate::geometry::line_noise::variances;
use crate::geometry::segment::Segment;

const VAGUE: f32 = 1e3;
/// Leaves out what is as vague as that.
const GATE: UpdateGate = UpdateGate { min_information_ratio: 1e-3, ..PLAIN };

/// A Kalman filter of the error state.
#[derive(Clone)]
struct Dense {
    covariance: DMatrix<f64>,
    error: DVector<f64>,
}

impl Dense {
    fn of(filter: &EkfSlam) -> Self {
        Self {
            covariance: DMatrix::from_fn(STATES, STATES, |i, j| f64::from(filter.covariance.get(i, j))),
            error: DVector::from_fn(STATES, |i, _| f64::from(filter.error_state[i])),
        }
    }

    /// One or two rows of a measurement at once.
    fn update_rows(&mut self, measurement: &Measurement, rows: &[usize], in_scope: &dyn Fn(usize) -> bool) {
        let mut h = DMatrix::zeros(rows.len(), STATES);
        for (state, column) in measurement.jacobian.columns() {
            rows.iter().enumerate().for_each(|(k, row)| h[(k, state)] += f64::from(column[*row]));
        }
        let r = DMatrix::from_fn(rows.len(), rows.len(), |i, j| {
            if i == j { f64::from(measurement.noise[rows[i]]) } else { 0.0 }
        });
        let residual = DVector::from_fn(rows.len(), |k, _| f64::from(measurement.residual[rows[k]]));
        let residual = residual + &h * &self.error;
        let s = &h * &self.covariance * h.transpose() + &r;
        let mut gain = &self.covariance * h.transpose() * s.try_inverse().unwrap();
        (0..STATES).filter(|state| !in_scope(*state)).for_each(|state| gain.row_mut(state).fill(0.0));
        self.error -= &gain * residual;
        let rest = DMatrix::identity(STATES, STATES) - &gain * &h;
        self.covariance = &rest * &self.covariance * rest.transpose() + &gain * r * gain.transpose();
    }

    fn update(&mut self, measurement: &Measurement, scope: UpdateScope) {
        let line = |slot, state| line_states(slot).contains(&state);
        let in_scope = |state: usize| match scope {
            UpdateScope::All => true,
            UpdateScope::RobotAndLine(slot) => state < FIRST_LINE || line(slot, state),
            UpdateScope::Line(slot) => line(slot, state),
        };
        let rows: Vec<usize> = (0..2).filter(|row| measurement.noise[*row] < VAGUE).collect();
        match scope {
            // With the pose considered, two scalar updates are not the same as one of both; the filter makes two.
            UpdateScope::Line(_) => {
                rows.iter().for_each(|row| self.update_rows(measurement, &[*row], &in_scope))
            }
            _ => self.update_rows(measurement, &rows, &in_scope),
        }
    }

    /// Within `f32`'s digits of the standard deviations before.
    fn agrees_with(&self, filter: &EkfSlam, before: &Self) -> Result<(), String> {
        let sigma = |i: usize| before.covariance[(i, i)].max(0.0).sqrt();
        for i in 0..STATES {
            let off = (self.error[i] - f64::from(filter.error_state[i])).abs();
            if off > 1e-3 * sigma(i) {
                return Err(format!("error of {i}: {off} of {}", sigma(i)));
            }
            for j in 0..=i {
                let off = (self.covariance[(i, j)] - f64::from(filter.covariance.get(i, j))).abs();
                if off > 1e-4 * sigma(i) * sigma(j) {
                    return Err(format!("covariance of {i} and {j}: {off} of {}", sigma(i) * sigma(j)));
                }
            }
        }
        Ok(())
    }
}

/// A robot that has driven for a while, and measurements of the lines in its state.
fn world_and_measurements(noise: [f32; 2]) -> (World, Vec<(usize, Measurement)>) {
    let mut world = World::new(12);
    world.look();
    (0..30).for_each(|k| world.step(if k < 20 { 0.1 } else { -0.1 }, Vector3::new(0.02, 0.0, 0.01)));
    let position = world.believed.translation.vector;
    let mut measurements = Vec::new();
    for index in 0..world.map.segments().len() {
        let Some(slot) = world.filter.slot_of(index) else { continue };
        let mapped = world.map.segments()[index].segment();
        let seen = mapped.shifted(0.01 * world.gauss.draw(), 0.02 * world.gauss.draw());
        measurements.push((slot, measurement(slot, &mapped, &seen, position, noise)));
    }
    assert!(measurements.len() > 8);
    (world, measurements)
}

/// Measurements whose downdates are pending when another comes: of one number or two each.
fn prefix(pending: usize, measurements: &[(usize, Measurement)]) -> Vec<Measurement> {
    let whole = |k: usize| measurements[k].1.clone();
    let only = |k: usize, row: usize| {
        let mut measurement = whole(k);
        measurement.noise[1 - row] = VAGUE;
        measurement
    };
    match pending {
        0 => vec![],
        1 => vec![only(0, 0)],
        2 => vec![whole(0)],
        3 => vec![whole(0), only(3, 1)],
        _ => vec![whole(0), whole(3)],
    }
}

/// After 0 to 4 pending downdates, of the same line and of another one.
#[test]
fn every_scope_is_that_of_a_dense_filter() {
    for noise in [SEEN, SURE] {
        let (world, measurements) = world_and_measurements(noise);
        let before = Dense::of(&world.filter);
        for pending_downdates in 0..=4 {
            for (slot, last) in [&measurements[3], &measurements[6]] {
                let scopes = [UpdateScope::All, UpdateScope::RobotAndLine(*slot), UpdateScope::Line(*slot)];
                for scope in scopes {
                    let (mut filter, mut dense) = (world.filter.clone(), before.clone());
                    let mut pending = Pending::new();
                    for measurement in prefix(pending_downdates, &measurements) {
                        assert!(filter.update_deferred(&measurement, &GATE, UpdateScope::All, &mut pending));
                        dense.update(&measurement, UpdateScope::All);
                    }
                    assert_eq!(pending.parts().0.count(), pending_downdates);
                    if !pending.has_room() {
                        pending.apply(&mut filter.covariance);
                    }
                    assert!(filter.update_deferred(last, &GATE, scope, &mut pending));
                    dense.update(last, scope);
                    pending.apply(&mut filter.covariance);
                    let verdict = dense.agrees_with(&filter, &before);
                    assert_eq!(verdict, Ok(()), "{scope:?} of slot {slot} after {pending_downdates} pending");
                }
            }
        }
    }
}

/// A whole keyframe, of all scopes in turn.
#[test]
fn a_series_of_updates_is_that_of_a_dense_filter() {
    let (world, measurements) = world_and_measurements(SURE);
    let before = Dense::of(&world.filter);
    let (mut filter, mut dense) = (world.filter.clone(), before.clone());
    let scope = |k: usize, slot: usize| match k % 4 {
        1 => UpdateScope::RobotAndLine(slot),
        3 => UpdateScope::Line(slot),
        _ => UpdateScope::All,
    };
    let scoped = || measurements.iter().enumerate().map(|(k, (slot, m))| (m, scope(k, *slot)));
    filter.update_all(scoped(), &GATE);
    scoped().for_each(|(measurement, scope)| dense.update(measurement, scope));
    assert_eq!(dense.agrees_with(&filter, &before), Ok(()));
    let surer =
        (0..STATES).filter(|i| dense.covariance[(*i, *i)] < 0.9 * before.covariance[(*i, *i)]).count();
    assert!(surer > 10, "{surer} states are surer");
}

/// Two lines that are one wall.
#[test]
fn a_constraint_between_lines_is_that_of_a_dense_filter() {
    let (mut world, measurements) = world_and_measurements(SEEN);
    let before = Dense::of(&world.filter);
    let line = |k: usize| {
        let slot = measurements[k].0;
        let index = world.filter.line_id(slot).unwrap();
        (world.map.segments()[index].segment(), slot)
    };
    let ((a, slot_a), (b, slot_b)) = (line(0), line(3));
    let mut constraint = Measurement::of_twins((&a, slot_a), (&b, slot_b), SEEN);
    constraint.residual = [0.01, 0.02];
    let mut dense = before.clone();
    dense.update(&constraint, UpdateScope::All);
    assert!(world.filter.update(&constraint, &GATE, UpdateScope::All));
    assert_eq!(dense.agrees_with(&world.filter, &before), Ok(()));
}

/// P ← F·P·Fᵀ + Q.
#[test]
fn the_prediction_is_that_of_a_dense_filter() {
    let (mut world, _) = world_and_measurements(SEEN);
    let before = Dense::of(&world.filter);
    let by_pose = Matrix3::new(1.0, 0.0, -0.3, 0.0, 1.0, 0.2, 0.0, 0.0, 1.0);
    let by_odometry = Matrix3::new(0.3, 0.01, -0.02, 0.2, 0.03, 0.04, 0.0, 0.5, 0.36);
    let noise = Matrix3::new(4e-4, 1e-5, 0.0, 1e-5, 2e-4, 0.0, 0.0, 0.0, 1e-4);
    let mut f = DMatrix::<f64>::identity(STATES, STATES);
    let mut q = DMatrix::<f64>::zeros(STATES, STATES);
    for i in 0..3 {
        for j in 0..3 {
            f[(POSE + i, POSE + j)] = f64::from(by_pose[(i, j)]);
            f[(POSE + i, ODOMETRY + j)] = f64::from(by_odometry[(i, j)]);
            q[(POSE + i, POSE + j)] = f64::from(noise[(i, j)]);
        }
    }
    let expected = Dense { covariance: &f * &before.covariance * f.transpose() + q, ..before };
    world.filter.predict(&by_pose, &by_odometry, &noise, &mut world.map);
    assert_eq!(expected.agrees_with(&world.filter, &expected), Ok(()));
}

/// Augmentation: the new line has the covariance of the pose, seen through it, and of its own observation.
#[test]
fn augmentation_is_that_of_a_dense_filter() {
    let (mut world, _) = world_and_measurements(SEEN);
    let mut expected = Dense::of(&world.filter);
    let position = world.believed.translation.vector;
    let (a, b) = (position + Vector2::new(1.0, 0.8), position + Vector2::new(1.4, -0.3));
    let new = Segment::from_ends(a.into(), b.into(), 20, 1e-4, position.into());
    let index = world.map.insert(new, world.scan, 0.0).unwrap();
    let [var_offset, var_direction] = variances(&world.map.segments()[index].segment());
    world.filter.augment(index, position, &mut world.map);
    let slot = world.filter.slot_of(index).unwrap();
    let [offset, direction] = line_states(slot);
    let (normal, lever) = (new.normal(), new.moments.centroid.coords - position);
    let mut g = DMatrix::<f64>::identity(STATES, STATES);
    g.row_mut(offset).fill(0.0);
    g.row_mut(direction).fill(0.0);
    g[(offset, POSE)] = f64::from(normal.x);
    g[(offset, POSE + 1)] = f64::from(normal.y);
    // ∂(n·p)/∂θ = n·(−lever_y, lever_x).
    g[(offset, POSE + 2)] = f64::from(normal.y * lever.x - normal.x * lever.y);
    g[(direction, POSE + 2)] = 1.0;
    expected.covariance = &g * expected.covariance * g.transpose();
    expected.covariance[(offset, offset)] += f64::from(var_offset);
    expected.covariance[(direction, direction)] += f64::from(var_direction);
    assert_eq!(expected.agrees_with(&world.filter, &expected), Ok(()));
}
