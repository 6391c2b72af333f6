//! What measurements have told, on its way into the covariance.
//!
//! To take a number out of a covariance every value of it must be loaded and stored. So numbers wait until there are four:
//! what the next measurement has in common with the states is reckoned as if they had been taken out.

use crate::ekf::joint::{LEAST_VARIANCE, STATES};
use crate::geometry::math::max;

/// Most numbers that wait.
const ROOM: usize = 4;

/// Numbers told that are independent of each other.
#[derive(Clone, Debug)]
pub(crate) struct Told {
    /// Covariance of each state with each of them; behind them that with the two numbers of the measurement at hand.
    with: [[f32; STATES]; ROOM],
    /// Inverses of their variances.
    information: [f32; ROOM],
    len: usize,
}

/// A number told: covariance of each state with it, and inverse of its variance.
type Earlier<'a> = (&'a [f32; STATES], f32);

impl Told {
    /// Nothing.
    pub fn new() -> Self {
        Self { with: [[0.0; STATES]; ROOM], information: [0.0; ROOM], len: 0 }
    }

    /// Whether there is room for the two numbers of another measurement.
    pub fn has_room(&self) -> bool {
        self.len + 2 <= ROOM
    }

    /// Numbers told, and room for the two of a measurement.
    pub fn parts(&mut self) -> (impl Iterator<Item = Earlier<'_>>, Option<&mut [[f32; STATES]; 2]>) {
        let (told, room) = self.with.split_at_mut_checked(self.len).unwrap_or_default();
        (told.iter().zip(self.information), room.first_chunk_mut())
    }

    /// Covariance of each state with the numbers of the measurement at hand.
    pub fn at_hand<const K: usize>(&self) -> Option<&[[f32; STATES]; K]> {
        self.with.get(self.len..)?.first_chunk()
    }

    /// So many numbers of the measurement at hand have been told, of this information.
    pub fn add<const K: usize>(&mut self, information: [f32; K]) {
        if let Some(room) = self.information.get_mut(self.len..).and_then(|room| room.first_chunk_mut()) {
            *room = information;
            self.len += K;
        }
    }

    /// Takes them out of a covariance of so many states, an even number: the lower triangle, row by row. Variances stay above the
    /// least.
    pub fn take_out(&mut self, covariance: &mut [f32], states: usize) {
        if self.len == 0 {
            return;
        }
        self.with.iter_mut().skip(self.len).for_each(|with| with.fill(0.0));
        self.information.iter_mut().skip(self.len).for_each(|information| *information = 0.0);
        self.lower(covariance, states);
        self.len = 0;
    }

    /// Two rows at once, so that what they are lowered by is loaded for both.
    fn lower(&self, covariance: &mut [f32], states: usize) {
        let mut rest = covariance;
        for state in (0..states).step_by(2) {
            let Some((upper, below)) = rest.split_at_mut_checked(state + 1) else { return };
            let Some((lower, below)) = below.split_at_mut_checked(state + 2) else { return };
            rest = below;
            let gains = [state, state + 1].map(|state| gains(&self.with, self.information, state));
            if gains == [[0.0; ROOM]; 2] {
                continue;
            }
            let Some((last, lower)) = lower.split_last_mut() else { return };
            self.subtract([upper, lower], &gains);
            for (with, gain) in self.with.iter().zip(gains[1]) {
                *last -= gain * with.get(state + 1).copied().unwrap_or(0.0);
            }
            upper.last_mut().into_iter().chain([last]).for_each(keep_above_least);
        }
    }

    /// The heart of the joint estimate: four columns at a time, so that the microcontroller need not count so often.
    #[inline]
    fn subtract(&self, [upper, lower]: [&mut [f32]; 2], gains: &[[f32; ROOM]; 2]) {
        let columns = upper.len();
        let [a, b, c, d] =
            self.with.each_ref().map(|with| with.get(..columns).unwrap_or_default().as_chunks::<4>());
        let ((upper, upper_rest), (lower, lower_rest)) =
            (upper.as_chunks_mut::<4>(), lower.as_chunks_mut::<4>());
        let fours = upper.iter_mut().zip(lower).zip(a.0).zip(b.0).zip(c.0).zip(d.0);
        for (((((upper, lower), a), b), c), d) in fours {
            columns_of(upper, lower, [a, b, c, d], gains);
        }
        columns_of(upper_rest, lower_rest, [a.1, b.1, c.1, d.1], gains);
    }
}

/// What a state learns from each of some numbers, for each part of its error.
pub(crate) fn gains<const K: usize>(
    with: &[[f32; STATES]; K],
    information: [f32; K],
    state: usize,
) -> [f32; K] {
    let mut gains = information;
    for (gain, with) in gains.iter_mut().zip(with) {
        *gain *= with.get(state).copied().unwrap_or(0.0);
    }
    gains
}

/// Rounding may have taken a variance below zero.
pub(crate) fn keep_above_least(variance: &mut f32) {
    *variance = max(*variance, LEAST_VARIANCE);
}

/// Takes from two rows so many times each of the vectors.
#[inline(always)]
fn columns_of(upper: &mut [f32], lower: &mut [f32], with: [&[f32]; ROOM], gains: &[[f32; ROOM]; 2]) {
    let [a, b, c, d] = with;
    let [[ua, ub, uc, ud], [la, lb, lc, ld]] = gains;
    let columns = upper.iter_mut().zip(lower).zip(a).zip(b).zip(c).zip(d);
    for (((((upper, lower), a), b), c), d) in columns {
        *upper = *upper - ua * a - ub * b - uc * c - ud * d;
        *lower = *lower - la * a - lb * b - lc * c - ld * d;
    }
}
