//! Covariance downdates that are put off until there are four.
//!
//! P ← P − (P·Hᵀ)·S⁻¹·(P·Hᵀ)ᵀ loads and stores every element of P. Instead P·Hᵀ and S⁻¹ are kept, for up to four independent
//! scalar innovations, and subtracted together; until then each new P·Hᵀ is corrected by those that are pending.

use crate::ekf::packed::{PackedSymmetric, RANK};

/// Downdates by independent scalar innovations that are not in the covariance yet.
#[derive(Clone, Debug)]
pub(crate) struct PendingDowndate<const STATES: usize> {
    /// P·Hᵀ of each; behind the pending ones, that of the two innovations of the current measurement.
    pht: [[f32; STATES]; RANK],
    /// Inverse innovation variances.
    information: [f32; RANK],
    len: usize,
}

/// P·Hᵀ of a pending downdate, and its inverse innovation variance.
type Pending<'a, const STATES: usize> = (&'a [f32; STATES], f32);

impl<const STATES: usize> PendingDowndate<STATES> {
    /// None.
    pub fn new() -> Self {
        Self { pht: [[0.0; STATES]; RANK], information: [0.0; RANK], len: 0 }
    }

    /// Whether there is room for the two innovations of another measurement.
    pub fn has_room(&self) -> bool {
        self.len + 2 <= RANK
    }

    /// The pending ones, and room for P·Hᵀ of the current measurement.
    pub fn parts(&mut self) -> (impl Iterator<Item = Pending<'_, STATES>>, Option<&mut [[f32; STATES]; 2]>) {
        let (pending, room) = self.pht.split_at_mut_checked(self.len).unwrap_or_default();
        (pending.iter().zip(self.information), room.first_chunk_mut())
    }

    /// P·Hᵀ of the current measurement.
    pub fn current_pht<const K: usize>(&self) -> Option<&[[f32; STATES]; K]> {
        self.pht.get(self.len..)?.first_chunk()
    }

    /// Queues the first `K` innovations of the current measurement, with their inverse variances.
    pub fn queue<const K: usize>(&mut self, information: [f32; K]) {
        if let Some(room) = self.information.get_mut(self.len..).and_then(|room| room.first_chunk_mut()) {
            *room = information;
            self.len += K;
        }
    }

    /// Subtracts all that are pending from the covariance.
    pub fn apply<const LEN: usize>(&mut self, covariance: &mut PackedSymmetric<STATES, LEN>) {
        if self.len == 0 {
            return;
        }
        self.pht.iter_mut().skip(self.len).for_each(|pht| pht.fill(0.0));
        self.information.iter_mut().skip(self.len).for_each(|information| *information = 0.0);
        covariance.downdate(&self.pht, self.information);
        self.len = 0;
    }
}
