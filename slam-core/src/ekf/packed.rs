//! A symmetric matrix of which the lower triangle is stored, row by row: element (i, j ≤ i) at i·(i + 1)/2 + j.
//!
//! Only the first `live` rows and columns are in use; the others are zero. Diagonal elements are variances: a downdate keeps
//! them above [`VARIANCE_FLOOR`].

use core::ops::Range;

use nalgebra::Matrix3;

use crate::geometry::math::{VARIANCE_FLOOR, max};

/// Columns of a downdate of the whole matrix.
pub(crate) const RANK: usize = 4;

/// Elements of the lower triangle of a matrix with so many rows.
pub(crate) const fn packed_len(states: usize) -> usize {
    states * (states + 1) / 2
}

/// Where element (i, j) lies.
const fn packed(i: usize, j: usize) -> usize {
    let (row, column) = if i >= j { (i, j) } else { (j, i) };
    row * (row + 1) / 2 + column
}

/// A covariance of up to `STATES` states in `LEN` = [`packed_len`]`(STATES)` numbers.
#[derive(Clone, Debug)]
pub(crate) struct PackedSymmetric<const STATES: usize, const LEN: usize> {
    values: [f32; LEN],
    live: usize,
}

impl<const STATES: usize, const LEN: usize> PackedSymmetric<STATES, LEN> {
    const LEN_FITS: () = assert!(LEN == packed_len(STATES), "the lower triangle");

    /// Zero. Inlined, so that it is built in its place.
    #[inline(always)]
    pub const fn zeros(live: usize) -> Self {
        let () = Self::LEN_FITS;
        Self { values: [0.0; LEN], live }
    }

    /// Sets all to zero.
    pub fn clear(&mut self, live: usize) {
        self.values.fill(0.0);
        self.live = live;
    }

    /// Rows in use.
    pub fn live(&self) -> usize {
        self.live
    }

    /// Says how many rows are in use from now on; those beyond must be zero.
    pub fn set_live(&mut self, live: usize) {
        self.live = live.min(STATES);
    }

    /// Element (i, j); zero outside of the matrix.
    pub fn get(&self, i: usize, j: usize) -> f32 {
        self.values.get(packed(i, j)).copied().unwrap_or(0.0)
    }

    /// Sets elements (i, j) and (j, i).
    pub fn set(&mut self, i: usize, j: usize, value: f32) {
        if let Some(element) = self.values.get_mut(packed(i, j)) {
            *element = value;
        }
    }

    /// The 3 × 3 block on the diagonal from a state on.
    pub fn block(&self, first: usize) -> Matrix3<f32> {
        Matrix3::from_fn(|i, j| self.get(first + i, first + j))
    }

    /// Sets that block.
    pub fn set_block(&mut self, first: usize, block: &Matrix3<f32>) {
        for (i, row) in block.row_iter().enumerate() {
            for (j, value) in row.iter().enumerate() {
                self.set(first + i, first + j, *value);
            }
        }
    }

    /// Sets row and column of a state to zero.
    pub fn zero_state(&mut self, state: usize) {
        (0..STATES).for_each(|other| self.set(other, state, 0.0));
    }

    /// `sums` += `by` · (row of the state).
    fn add_row(&self, state: usize, by: f32, sums: &mut [f32]) {
        // Up to the diagonal the row is contiguous …
        let (beside, below) = sums.split_at_mut_checked(state + 1).unwrap_or_default();
        let begin = packed(state, 0);
        if let Some(row) = self.values.get(begin..=begin + state) {
            beside.iter_mut().zip(row).for_each(|(sum, value)| *sum += by * value);
        }
        // … beyond it there is one element in each row, and each row is longer by one.
        let mut at = packed(state + 1, state);
        for (row, sum) in (state + 1..).zip(below) {
            *sum += by * self.values.get(at).copied().unwrap_or(0.0);
            at += row + 1;
        }
    }

    /// `sums` += P·Hᵀ, where the two rows of H have these `W` numbers from column `first` on.
    pub fn add_columns<const W: usize>(
        &self,
        first: usize,
        jacobian: &[[f32; W]; 2],
        sums: &mut [[f32; STATES]; 2],
    ) {
        let [sums_o, sums_d] = sums;
        let [by_o, by_d] = jacobian;
        // Above the block its columns lie as rows, …
        for (w, (by_o, by_d)) in by_o.iter().zip(by_d).enumerate() {
            let begin = packed(first + w, 0);
            let row = self.values.get(begin..begin + first).unwrap_or_default();
            for ((value, o), d) in row.iter().zip(sums_o.iter_mut()).zip(sums_d.iter_mut()) {
                *o += by_o * value;
                *d += by_d * value;
            }
        }
        let mut add = |state: usize, values: &[f32; W]| {
            let (Some(o), Some(d)) = (sums_o.get_mut(state), sums_d.get_mut(state)) else { return };
            for ((value, by_o), by_d) in values.iter().zip(by_o).zip(by_d) {
                *o += by_o * value;
                *d += by_d * value;
            }
        };
        for state in first..first + W {
            add(state, &core::array::from_fn(|w| self.get(state, first + w)));
        }
        // … below it side by side in each row, and each row is longer by one.
        let mut at = packed(first + W, first);
        for state in first + W..self.live {
            if let Some(values) = self.values.get(at..).and_then(|rest| rest.first_chunk()) {
                add(state, values);
            }
            at += state + 1;
        }
    }

    /// Covariance after x_state ← x_state + Σ by·x_i, over the pairs (i, by) of `others`: P ← T·P·Tᵀ.
    pub fn add_multiples(&mut self, state: usize, others: &[(usize, f32)]) {
        let own: f32 = self.get(state, state)
            + others
                .iter()
                .map(|&(i, by)| {
                    let among = others.iter().map(|&(j, other)| other * self.get(i, j)).sum::<f32>();
                    by * (2.0 * self.get(state, i) + among)
                })
                .sum::<f32>();
        let mut sums = [-0.0; STATES];
        let sums = sums.get_mut(..self.live).unwrap_or_default();
        for &(i, by) in others {
            self.add_row(i, by, sums);
        }
        let (beside, below) = sums.split_at_mut_checked(state + 1).unwrap_or_default();
        let begin = packed(state, 0);
        if let Some(row) = self.values.get_mut(begin..begin + state) {
            row.iter_mut().zip(beside).for_each(|(value, sum)| *value += *sum);
        }
        let mut at = packed(state + 1, state);
        for (row, sum) in (state + 1..).zip(below) {
            if let Some(value) = self.values.get_mut(at) {
                *value += *sum;
            }
            at += row + 1;
        }
        self.set(state, state, max(own, 0.0));
    }

    /// P ← P − Σ pht·phtᵀ·information, over [`RANK`] columns. The number of live rows is even. Work: its square, twice.
    pub fn downdate(&mut self, pht: &[[f32; STATES]; RANK], information: [f32; RANK]) {
        let mut rest = self.values.as_mut_slice();
        // Two rows at once, so that the columns are loaded for both.
        for state in (0..self.live).step_by(2) {
            let Some((upper, below)) = rest.split_at_mut_checked(state + 1) else { return };
            let Some((lower, below)) = below.split_at_mut_checked(state + 2) else { return };
            rest = below;
            let gains = [state, state + 1].map(|state| gains(pht, information, state));
            if gains == [[0.0; RANK]; 2] {
                continue;
            }
            let Some((last, lower)) = lower.split_last_mut() else { return };
            subtract_from_rows([upper, lower], pht, &gains);
            for (pht, gain) in pht.iter().zip(gains[1]) {
                *last -= gain * pht.get(state + 1).copied().unwrap_or(0.0);
            }
            upper.last_mut().into_iter().chain([last]).for_each(keep_above_floor);
        }
    }

    /// The same with `K` columns for the states in `scope` and their covariances with the others, as in the Schmidt–Kalman
    /// filter. Work: the number of live rows times that of states in scope.
    pub fn downdate_scope<const K: usize>(
        &mut self,
        pht: &[[f32; STATES]; K],
        information: [f32; K],
        scope: &[Range<usize>; 2],
    ) {
        let mut rest = self.values.as_mut_slice();
        for state in 0..self.live {
            let Some((row, below)) = rest.split_at_mut_checked(state + 1) else { return };
            rest = below;
            let gains = gains(pht, information, state);
            if gains == [0.0; K] {
                continue;
            }
            if scope.iter().any(|range| range.contains(&state)) {
                subtract(row, 0, pht, gains);
                row.last_mut().into_iter().for_each(keep_above_floor);
                continue;
            }
            // A considered state: its covariances with those in scope.
            for range in scope {
                if let Some(part) = row.get_mut(range.start..range.end.min(state)) {
                    subtract(part, range.start, pht, gains);
                }
            }
        }
    }
}

/// A state's Kalman gains for `K` independent innovations: its row of P·Hᵀ over their variances.
fn gains<const K: usize, const STATES: usize>(
    pht: &[[f32; STATES]; K],
    information: [f32; K],
    state: usize,
) -> [f32; K] {
    let mut gains = information;
    for (gain, pht) in gains.iter_mut().zip(pht) {
        *gain *= pht.get(state).copied().unwrap_or(0.0);
    }
    gains
}

/// Rounding may have taken a variance below zero.
fn keep_above_floor(variance: &mut f32) {
    *variance = max(*variance, VARIANCE_FLOOR);
}

/// `part`, which begins at column `begin` of its row, −= Σ gain·pht.
#[inline]
fn subtract<const K: usize, const STATES: usize>(
    part: &mut [f32],
    begin: usize,
    pht: &[[f32; STATES]; K],
    gains: [f32; K],
) {
    for (pht, gain) in pht.iter().zip(gains) {
        let pht = pht.get(begin..begin + part.len()).unwrap_or_default();
        part.iter_mut().zip(pht).for_each(|(value, pht)| *value -= gain * pht);
    }
}

/// The filter's innermost loop: four columns at a time, so that the microcontroller counts less often.
#[inline]
fn subtract_from_rows<const STATES: usize>(
    [upper, lower]: [&mut [f32]; 2],
    pht: &[[f32; STATES]; RANK],
    gains: &[[f32; RANK]; 2],
) {
    let columns = upper.len();
    let [a, b, c, d] = pht.each_ref().map(|pht| pht.get(..columns).unwrap_or_default().as_chunks::<4>());
    let ((upper, upper_rest), (lower, lower_rest)) = (upper.as_chunks_mut::<4>(), lower.as_chunks_mut::<4>());
    let fours = upper.iter_mut().zip(lower).zip(a.0).zip(b.0).zip(c.0).zip(d.0);
    for (((((upper, lower), a), b), c), d) in fours {
        subtract_columns(upper, lower, [a, b, c, d], gains);
    }
    subtract_columns(upper_rest, lower_rest, [a.1, b.1, c.1, d.1], gains);
}

#[inline(always)]
fn subtract_columns(upper: &mut [f32], lower: &mut [f32], pht: [&[f32]; RANK], gains: &[[f32; RANK]; 2]) {
    let [a, b, c, d] = pht;
    let [[ua, ub, uc, ud], [la, lb, lc, ld]] = gains;
    let columns = upper.iter_mut().zip(lower).zip(a).zip(b).zip(c).zip(d);
    for (((((upper, lower), a), b), c), d) in columns {
        *upper = *upper - ua * a - ub * b - uc * c - ud * d;
        *lower = *lower - la * a - lb * b - lc * c - ld * d;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{SMatrix, SVector};

    const N: usize = 10;
    type Dense = SMatrix<f64, N, N>;

    /// A covariance of eight live states, of ten.
    fn sample() -> PackedSymmetric<N, { packed_len(N) }> {
        let mut matrix = PackedSymmetric::zeros(8);
        for i in 0..8 {
            for j in 0..=i {
                let value = if i == j { 5.0 + i as f32 } else { ((3 * i + 5 * j) as f32).sin() };
                matrix.set(i, j, value);
            }
        }
        matrix
    }

    fn dense(matrix: &PackedSymmetric<N, { packed_len(N) }>) -> Dense {
        Dense::from_fn(|i, j| f64::from(matrix.get(i, j)))
    }

    fn column(seed: usize) -> [f32; N] {
        core::array::from_fn(|i| if i < 8 { ((7 * i + seed) as f32).cos() } else { 0.0 })
    }

    fn vector(column: &[f32; N]) -> SVector<f64, N> {
        SVector::from_fn(|i, _| f64::from(column[i]))
    }

    #[test]
    fn columns_are_those_of_the_dense_product() {
        let matrix = sample();
        let mut sums = [[0.0; N]; 2];
        matrix.add_columns(2, &[[0.5, -1.0, 2.0], [0.0, 1.5, -0.5]], &mut sums);
        for (sums, by) in sums.iter().zip([[0.5, -1.0, 2.0], [0.0, 1.5, -0.5]]) {
            let mut h = SVector::<f64, N>::zeros();
            (0..3).for_each(|w| h[2 + w] = by[w]);
            assert!((vector(sums) - dense(&matrix) * h).amax() < 1e-5);
        }
    }

    #[test]
    fn adding_multiples_is_a_congruence() {
        for state in 0..8 {
            let mut matrix = sample();
            let mut t = Dense::identity();
            let others = [((state + 3) % 8, 0.3), ((state + 5) % 8, -0.7)];
            others.iter().for_each(|&(i, by)| t[(state, i)] = f64::from(by));
            let expected = t * dense(&matrix) * t.transpose();
            matrix.add_multiples(state, &others);
            assert!((dense(&matrix) - expected).amax() < 1e-4, "{state}");
        }
    }

    #[test]
    fn downdates_are_those_of_the_dense_matrix() {
        let pht = [1, 2, 3, 4].map(column);
        let information = [0.3f32, 0.2, 0.1, 0.4];
        let full = pht.iter().zip(information).fold(Dense::zeros(), |sum, (pht, information)| {
            sum + vector(pht) * vector(pht).transpose() * f64::from(information)
        });
        let mut matrix = sample();
        let before = dense(&matrix);
        matrix.downdate(&pht, information);
        assert!((dense(&matrix) - (before - full)).amax() < 1e-5);
        // Of a part: considered states keep their own block.
        for scope in [[0..3, 6..8], [0..0, 4..6], [0..8, 0..0]] {
            let mut matrix = sample();
            matrix.downdate_scope(&pht, information, &scope);
            let has = |state: usize| scope.iter().any(|range| range.contains(&state));
            let expected =
                Dense::from_fn(|i, j| before[(i, j)] - if has(i) || has(j) { full[(i, j)] } else { 0.0 });
            assert!((dense(&matrix) - expected).amax() < 1e-5, "{scope:?}");
        }
    }

    #[test]
    fn a_variance_stays_above_the_floor() {
        let mut matrix = sample();
        matrix.downdate(&[[100.0; N], [0.0; N], [0.0; N], [0.0; N]], [1.0, 0.0, 0.0, 0.0]);
        assert!((0..8).all(|i| matrix.get(i, i) == VARIANCE_FLOOR));
    }
}
