//! A packed Cholesky factor that grows by rows of three: S = L·Lᵀ.

use nalgebra::{Matrix3, Vector3};

use crate::geometry::math::sqrt;

/// Most loops that are kept; with 24 no log of `lineslam benchmark` comes out better.
pub const LOOPS: usize = 16;
/// Rows.
pub(super) const ROWS: usize = 3 * LOOPS;
const LEN: usize = ROWS * (ROWS + 1) / 2;

/// Numbers for each row.
pub(super) type Column = [f32; ROWS];

/// L, row by row: element (i, j ≤ i) at i·(i + 1)/2 + j. 4.6 KiB.
#[derive(Clone, Debug)]
pub(super) struct Factor {
    values: [f32; LEN],
    rows: usize,
}

impl Factor {
    pub const fn new() -> Self {
        Self { values: [0.0; LEN], rows: 0 }
    }

    pub fn clear(&mut self) {
        self.rows = 0;
    }

    /// Loops in it.
    pub fn loops(&self) -> usize {
        self.rows / 3
    }

    fn row(&self, row: usize) -> &[f32] {
        let begin = row * (row + 1) / 2;
        self.values.get(begin..=begin + row).unwrap_or_default()
    }

    /// Appends the three rows of a loop; `block(b)` is its 3 × 3 block of S with loop `b`, the last one its own. False where S is not
    /// positive definite, or there is no room.
    ///
    /// Work: for the n-th loop 4.5·n² multiplications.
    pub fn append(&mut self, block: impl Fn(usize) -> Matrix3<f32>) -> bool {
        let first = self.rows;
        if first + 3 > ROWS {
            return false;
        }
        for b in 0..=first / 3 {
            let block = block(b);
            for r in 0..3 {
                let row = first + r;
                let begin = row * (row + 1) / 2;
                for c in 0..3 {
                    let column = 3 * b + c;
                    let value = block.get((r, c)).copied().unwrap_or(0.0);
                    if column <= row
                        && let Some(slot) = self.values.get_mut(begin + column)
                    {
                        *slot = value;
                    }
                }
            }
        }
        for row in first..first + 3 {
            if !self.eliminate(row) {
                return false;
            }
        }
        self.rows = first + 3;
        true
    }

    /// Turns a row of S into one of L, by those before it.
    fn eliminate(&mut self, row: usize) -> bool {
        let (done, rest) = self.values.split_at_mut(row * (row + 1) / 2);
        let Some(own) = rest.get_mut(..=row) else { return false };
        for column in 0..row {
            let begin = column * (column + 1) / 2;
            let Some((pivot, other)) = done.get(begin..=begin + column).and_then(<[f32]>::split_last) else {
                return false;
            };
            let sum: f32 = own.iter().zip(other).map(|(a, b)| a * b).sum();
            if let Some(value) = own.get_mut(column) {
                *value = (*value - sum) / pivot;
            }
        }
        let Some((diagonal, before)) = own.split_last_mut() else { return false };
        let left = *diagonal - before.iter().map(|v| v * v).sum::<f32>();
        *diagonal = sqrt(left);
        left > 0.0 && left.is_finite()
    }

    /// L⁻¹·v, in place.
    pub fn forward(&self, v: &mut Column) {
        for row in 0..self.rows {
            let Some((pivot, before)) = self.row(row).split_last() else { return };
            let sum: f32 = before.iter().zip(v.iter()).map(|(a, b)| a * b).sum();
            if let Some(value) = v.get_mut(row) {
                *value = (*value - sum) / pivot;
            }
        }
    }

    /// L⁻ᵀ·v, in place.
    pub fn backward(&self, v: &mut Column) {
        for row in (0..self.rows).rev() {
            let Some((pivot, before)) = self.row(row).split_last() else { return };
            let Some(value) = v.get_mut(row) else { return };
            *value /= pivot;
            let value = *value;
            for (slot, l) in v.iter_mut().zip(before) {
                *slot -= l * value;
            }
        }
    }

    /// The diagonal block of S⁻¹ that belongs to a loop. Work: three solutions.
    pub fn inverse_block(&self, index: usize) -> Matrix3<f32> {
        let mut block = Matrix3::zeros();
        for c in 0..3 {
            let mut unit = [0.0; ROWS];
            if let Some(one) = unit.get_mut(3 * index + c) {
                *one = 1.0;
            }
            self.forward(&mut unit);
            self.backward(&mut unit);
            block.set_column(c, &three(&unit, index));
        }
        block
    }
}

/// The three numbers of a loop.
pub(super) fn three(v: &Column, index: usize) -> Vector3<f32> {
    Vector3::from_fn(|k, _| v.get(3 * index + k).copied().unwrap_or(0.0))
}

pub(super) fn set_three(v: &mut Column, index: usize, value: &Vector3<f32>) {
    for (slot, value) in v.iter_mut().skip(3 * index).zip(value.iter()) {
        *slot = *value;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::DMatrix;

    #[test]
    fn it_solves_what_a_dense_matrix_solves_and_refuses_what_is_not_positive() {
        let loops = 7;
        let n = 3 * loops;
        let root = DMatrix::<f64>::from_fn(n, n, |i, j| ((i * 7 + j * 13) % 11) as f64 / 11.0 - 0.4);
        let s = &root * root.transpose() + DMatrix::identity(n, n) * 0.3;
        let mut factor = Factor::new();
        for a in 0..loops {
            let block = |b: usize| Matrix3::from_fn(|r, c| s[(3 * a + r, 3 * b + c)] as f32);
            assert!(factor.append(block));
        }
        assert_eq!(factor.loops(), loops);
        let mut v = [0.0; ROWS];
        (0..n).for_each(|k| v[k] = (k as f32 * 0.7).sin());
        let right = nalgebra::DVector::<f64>::from_fn(n, |k, _| f64::from(v[k]));
        let exact = s.clone().cholesky().unwrap().solve(&right);
        factor.forward(&mut v);
        factor.backward(&mut v);
        (0..n).for_each(|k| assert!((f64::from(v[k]) - exact[k]).abs() < 1e-3, "{k}"));
        let inverse = s.try_inverse().unwrap();
        let block = factor.inverse_block(4);
        let off = (0..3).flat_map(|r| (0..3).map(move |c| (r, c)));
        off.for_each(|(r, c)| assert!((f64::from(block[(r, c)]) - inverse[(12 + r, 12 + c)]).abs() < 1e-3));
        assert!(!factor.append(|_| -Matrix3::identity()));
        assert_eq!(factor.loops(), loops, "what was there stays");
    }

    #[test]
    fn it_takes_as_many_loops_as_it_says() {
        let mut factor = Factor::new();
        for a in 0..LOOPS {
            assert!(factor.append(|b| if a == b { Matrix3::identity() } else { Matrix3::zeros() }));
        }
        assert!(!factor.append(|_| Matrix3::identity()));
        let mut v = [2.0; ROWS];
        factor.forward(&mut v);
        assert_eq!(v, [2.0; ROWS]);
    }
}
