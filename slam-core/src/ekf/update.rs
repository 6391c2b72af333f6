//! The measurement update: error state at once, covariance deferred.
//!
//! With r the residual at the present error state δ, S = H·P·Hᵀ + R:
//!
//! ```text
//!  δ ← δ − P·Hᵀ·S⁻¹·r        P ← P − P·Hᵀ·S⁻¹·H·P
//! ```
//!
//! The two numbers of a measurement are made independent (direction given offset) and taken in as scalars.

use nalgebra::{Matrix2, Vector2};

use crate::ekf::deferred::PendingDowndate;
use crate::ekf::filter::EkfSlam;
use crate::ekf::measurement::{Jacobian, Measurement};
use crate::ekf::state::{POSE, STATES, UpdateScope, line_states};
use crate::geometry::math::max;

/// How a measurement is tested before it is taken in.
#[derive(Clone, Copy, Debug)]
pub(crate) struct UpdateGate {
    /// Largest normalised innovation squared.
    pub max_nis: f32,
    /// From this normalised innovation squared on, R grows in proportion to it.
    pub kernel_nis: f32,
    /// An innovation with a smaller information ratio is left out.
    pub min_information_ratio: f32,
}

/// What a measurement would tell.
#[derive(Clone, Copy, Debug)]
pub(crate) struct InnovationTest {
    /// Normalised innovation squared: rᵀ·S⁻¹·r.
    pub nis: f32,
    /// H·P·Hᵀ over R, of offset and direction each.
    pub information_ratio: [f32; 2],
}

/// A scalar innovation: residual and variance.
#[derive(Clone, Copy, Debug)]
struct Innovation {
    residual: f32,
    variance: f32,
}

type Pending = PendingDowndate<STATES>;

impl InnovationTest {
    fn new(residual: [f32; 2], hpht: &Matrix2<f32>, measurement: &Measurement) -> Self {
        let ([var_o, var_d], residual) = (measurement.noise, Vector2::from(residual));
        let s = Matrix2::new(hpht.m11 + var_o, hpht.m12, hpht.m12, hpht.m22 + var_d);
        Self {
            nis: s.try_inverse().map_or(f32::INFINITY, |w| residual.dot(&(w * residual))),
            information_ratio: [hpht.m11 / var_o, hpht.m22 / var_d],
        }
    }
}

impl EkfSlam {
    /// What a measurement would tell now. Work: some steps, whatever the number of states.
    pub(crate) fn test(&self, measurement: &Measurement) -> InnovationTest {
        let columns: heapless::Vec<_, 7> = measurement.jacobian.columns().collect();
        let mut hpht = Matrix2::zeros();
        for (k, &(i, [o_i, d_i])) in columns.iter().enumerate() {
            for &(j, [o_j, d_j]) in columns.iter().take(k) {
                let value = self.covariance.get(i, j);
                hpht.m11 += 2.0 * o_i * o_j * value;
                hpht.m12 += (o_i * d_j + o_j * d_i) * value;
                hpht.m22 += 2.0 * d_i * d_j * value;
            }
            let variance = self.covariance.get(i, i);
            hpht.m11 += o_i * o_i * variance;
            hpht.m12 += o_i * d_i * variance;
            hpht.m22 += d_i * d_i * variance;
        }
        InnovationTest::new(self.residual(measurement), &hpht, measurement)
    }

    /// Residual at the present error state: r(0) + H·δ.
    fn residual(&self, measurement: &Measurement) -> [f32; 2] {
        let ([offset, direction], [by_o, by_d]) =
            (measurement.residual, measurement.jacobian.times(&self.error_state));
        [offset + by_o, direction + by_d]
    }

    /// Takes in a measurement; false where the gate rejects it. Work: with [`UpdateScope::All`] the square of the number of states,
    /// otherwise that number, some times.
    pub(crate) fn update(
        &mut self,
        measurement: &Measurement,
        gate: &UpdateGate,
        scope: UpdateScope,
    ) -> bool {
        let mut pending = Pending::new();
        let is_taken = self.update_deferred(measurement, gate, scope, &mut pending);
        pending.apply(&mut self.covariance);
        is_taken
    }

    /// The same for several measurements one after the other, with fewer passes over the covariance. Those of a line that has left
    /// the state are skipped.
    pub(crate) fn update_all<'a>(
        &mut self,
        measurements: impl Iterator<Item = (&'a Measurement, UpdateScope)>,
        gate: &UpdateGate,
    ) {
        let mut pending = Pending::new();
        for (measurement, scope) in measurements {
            if measurement.jacobian.line_parts().iter().any(|(slot, _)| self.line_id(*slot).is_none()) {
                continue;
            }
            if !pending.has_room() {
                pending.apply(&mut self.covariance);
            }
            self.update_deferred(measurement, gate, scope, &mut pending);
        }
        pending.apply(&mut self.covariance);
    }

    /// Updates the error state now; the covariance too, where only a part is in scope, and otherwise queues its downdate.
    pub(super) fn update_deferred(
        &mut self,
        measurement: &Measurement,
        gate: &UpdateGate,
        scope: UpdateScope,
        pending: &mut Pending,
    ) -> bool {
        self.compute_pht(pending, &measurement.jacobian);
        let Some(pht) = pending.current_pht::<2>() else { return false };
        let [[o_o, d_o], [_, d_d]] = pht.each_ref().map(|pht| measurement.jacobian.times(pht));
        let hpht = Matrix2::new(o_o, d_o, d_o, d_d);
        let test = InnovationTest::new(self.residual(measurement), &hpht, measurement);
        if test.nis.is_nan() || test.nis > gate.max_nis {
            return false;
        }
        let factor = max(test.nis / gate.kernel_nis, 1.0);
        let noise = measurement.noise.map(|variance| variance * factor);
        let [offset, direction] = test.information_ratio.map(|ratio| ratio >= gate.min_information_ratio);
        match scope {
            // The pose is considered: after the offset's update the gains of the direction are other ones.
            UpdateScope::Line(_) if offset && direction => {
                self.update_numbers(measurement, noise, [true, false], scope, pending);
                self.compute_pht(pending, &measurement.jacobian);
                self.update_numbers(measurement, noise, [false, true], scope, pending);
            }
            _ => self.update_numbers(measurement, noise, [offset, direction], scope, pending),
        }
        true
    }

    /// Updates with those numbers of a measurement, offset and direction, that `selected` names.
    #[inline]
    fn update_numbers(
        &mut self,
        measurement: &Measurement,
        noise: [f32; 2],
        selected: [bool; 2],
        scope: UpdateScope,
        pending: &mut Pending,
    ) {
        let (_, Some([pht_o, pht_d])) = pending.parts() else { return };
        let [[o_o, d_o], [_, d_d]] = [&*pht_o, &*pht_d].map(|pht| measurement.jacobian.times(pht));
        let residual = self.residual(measurement);
        let is_usable = |selected, innovation: &Innovation| {
            selected
                && innovation.variance > 0.0
                && innovation.variance.is_finite()
                && innovation.residual.is_finite()
        };
        let offset = Innovation { residual: residual[0], variance: o_o + noise[0] };
        let mut direction = Innovation { residual: residual[1], variance: d_d + noise[1] };
        let with_offset = is_usable(selected[0], &offset);
        if with_offset && selected[1] {
            // The direction given the offset: one step of Gram–Schmidt on S.
            let share = d_o / offset.variance;
            pht_d.iter_mut().zip(&*pht_o).for_each(|(d, o)| *d -= share * o);
            direction.residual -= share * offset.residual;
            direction.variance -= share * d_o;
        }
        match (with_offset, is_usable(selected[1], &direction)) {
            (true, true) => self.apply_innovations([offset, direction], scope, pending),
            (true, false) => self.apply_innovations([offset], scope, pending),
            (false, true) => {
                *pht_o = *pht_d;
                self.apply_innovations([direction], scope, pending);
            }
            (false, false) => {}
        }
    }

    /// Updates with independent innovations.
    fn apply_innovations<const K: usize>(
        &mut self,
        innovations: [Innovation; K],
        scope: UpdateScope,
        pending: &mut Pending,
    ) {
        let Some(pht) = pending.current_pht::<K>() else { return };
        let ranges = scope.states();
        for range in ranges.clone() {
            for (pht, innovation) in pht.iter().zip(&innovations) {
                let by = innovation.residual / innovation.variance;
                let errors = self.error_state.get_mut(range.clone()).unwrap_or_default();
                let pht = pht.get(range.clone()).unwrap_or_default();
                errors.iter_mut().zip(pht).for_each(|(error, pht)| *error -= pht * by);
            }
        }
        let information = innovations.map(|innovation| 1.0 / innovation.variance);
        match scope {
            UpdateScope::All => pending.queue(information),
            UpdateScope::RobotAndLine(_) | UpdateScope::Line(_) => {
                self.covariance.downdate_scope(pht, information, &ranges);
            }
        }
    }

    /// P·Hᵀ by the stored covariance.
    pub(super) fn covariance_times(&self, jacobian: &Jacobian, pht: &mut [[f32; STATES]; 2]) {
        *pht = [[0.0; STATES]; 2];
        if let Some(by_pose) = jacobian.pose_part() {
            self.covariance.add_columns(POSE, by_pose, pht);
        }
        for (slot, by_line) in jacobian.line_parts() {
            let [first, _] = line_states(*slot);
            self.covariance.add_columns(first, by_line, pht);
        }
    }

    /// P·Hᵀ with all pending downdates, in the room for it: (P − Σ q·qᵀ/s)·Hᵀ.
    fn compute_pht(&self, pending: &mut Pending, jacobian: &Jacobian) {
        let (earlier, Some(pht)) = pending.parts() else { return };
        self.covariance_times(jacobian, pht);
        let [pht_o, pht_d] = pht;
        for (earlier, information) in earlier {
            let [by_o, by_d] = jacobian.times(earlier).map(|h_q| h_q * information);
            for ((o, d), earlier) in pht_o.iter_mut().zip(pht_d.iter_mut()).zip(earlier) {
                *o -= by_o * earlier;
                *d -= by_d * earlier;
            }
        }
    }
}

#[cfg(test)]
mod dense;
#[cfg(test)]
mod tests;
