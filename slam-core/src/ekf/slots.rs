//! Which lines of the map are in the state: each has a slot, that is two states.
//!
//! A line comes in by augmentation, seen from the pose, or by activation, with the variances that its segment carries. When all
//! slots are taken, the line not seen for longest is decoupled: its segment keeps its variances, its covariances with other states
//! are dropped. Activated again it would count as independent; its variances are inflated to make up for that.

use core::num::NonZeroU16;

use nalgebra::Vector2;

use crate::ekf::filter::EkfSlam;
use crate::ekf::measurement::Jacobian;
use crate::ekf::state::{FIRST_LINE, LINES, STATES, line_states};
use crate::geometry::line_noise::{variances, with_variances};
use crate::geometry::line_observation::by_pose;
use crate::map::{MapSegment, SegmentMap};

/// A line of the map: its index there.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct LineId(NonZeroU16);

impl LineId {
    fn of(index: usize) -> Option<Self> {
        u16::try_from(index).ok()?.checked_add(1).and_then(NonZeroU16::new).map(Self)
    }

    fn index(self) -> usize {
        usize::from(self.0.get()) - 1
    }
}

/// The slots, and what the filter keeps of each line besides its covariance.
#[derive(Clone, Debug)]
pub(super) struct Slots {
    line_ids: [Option<LineId>; LINES],
    /// Scans since augmentation; infinite for a line that was activated.
    ages_scans: [f32; LINES],
    /// Slots of lines in the current scan, a bit for each: they are not given away.
    in_use: u64,
    /// Turn of each line, radians, by which its offset's error has not been carried to the new normal yet.
    pub turns: [f32; LINES],
}

impl Slots {
    /// All free. Inlined, so that it is built in its place.
    #[inline(always)]
    pub const fn free() -> Self {
        Self { line_ids: [None; LINES], ages_scans: [f32::INFINITY; LINES], in_use: 0, turns: [0.0; LINES] }
    }

    /// Frees all.
    pub fn clear(&mut self) {
        self.line_ids.fill(None);
        self.ages_scans.fill(f32::INFINITY);
        self.in_use = 0;
        self.turns.fill(0.0);
    }

    /// A scan has passed.
    pub fn next_scan(&mut self) {
        self.ages_scans.iter_mut().for_each(|age| *age += 1.0);
        self.in_use = 0;
    }

    /// The line in a slot.
    pub fn line_id(&self, slot: usize) -> Option<usize> {
        self.line_ids.get(slot).copied().flatten().map(LineId::index)
    }

    /// The slot of a line.
    pub fn slot_of(&self, index: usize) -> Option<usize> {
        self.line_ids.iter().position(|id| id.is_some_and(|id| id.index() == index))
    }

    /// How many lines are in the state.
    #[cfg(test)]
    pub fn lines(&self) -> usize {
        self.line_ids.iter().flatten().count()
    }

    /// States up to those of the last slot taken.
    fn live_states(&self) -> usize {
        let slots = self.line_ids.iter().rposition(Option::is_some).map_or(0, |last| last + 1);
        FIRST_LINE + 2 * slots
    }

    /// The slot to be given away next: a free one, or that of the line not seen for longest. None while all are in use.
    fn next<const N: usize>(&self, map: &SegmentMap<N>) -> Option<usize> {
        let last_seen = |id: &Option<LineId>| match id {
            Some(id) => map.segments().get(id.index()).map_or(0, |s| 1 + s.last_seen),
            None => 0,
        };
        let unused = self.line_ids.iter().enumerate().filter(|(slot, _)| self.in_use & (1 << slot) == 0);
        unused.map(|(slot, id)| (slot, last_seen(id))).min_by_key(|(_, seen)| *seen).map(|(slot, _)| slot)
    }
}

impl EkfSlam {
    /// Scans since the line in a slot came in by augmentation; infinite for one that was activated.
    pub(crate) fn age_scans(&self, slot: usize) -> f32 {
        self.slots.ages_scans.get(slot).copied().unwrap_or(0.0)
    }

    /// Index in the map of the line in a slot.
    pub(crate) fn line_id(&self, slot: usize) -> Option<usize> {
        self.slots.line_id(slot)
    }

    /// The slot of a line of the map, if it is in the state.
    pub(crate) fn slot_of(&self, index: usize) -> Option<usize> {
        self.slots.slot_of(index)
    }

    /// The slot of a line of the map. One that is not in the state is given a slot, with the variances that its segment carries times
    /// `inflation`. `None` while all slots are those of lines in the current scan.
    pub(crate) fn activate<const N: usize>(
        &mut self,
        index: usize,
        inflation: f32,
        map: &mut SegmentMap<N>,
    ) -> Option<usize> {
        if let Some(slot) = self.slot_of(index) {
            self.slots.in_use |= 1 << slot;
            return Some(slot);
        }
        let segment = map.segments().get(index)?.segment();
        let slot = self.take_slot(map)?;
        self.assign(slot, index, f32::INFINITY);
        for (state, variance) in line_states(slot).into_iter().zip(variances(&segment)) {
            self.covariance.set(state, state, inflation * variance);
        }
        Some(slot)
    }

    /// State augmentation: a segment just added to the map, as it was seen from the pose, with the variances of the observation.
    /// With G the Jacobian of the line by the pose, its covariances become G·P, and its own G·P·Gᵀ + R.
    pub(crate) fn augment<const N: usize>(
        &mut self,
        index: usize,
        position: Vector2<f32>,
        map: &mut SegmentMap<N>,
    ) {
        let Some(segment) = map.segments().get(index).map(MapSegment::segment) else { return };
        let [var_offset, var_direction] = variances(&segment);
        let by_pose = by_pose(segment.normal(), segment.moments.centroid.coords - position);
        let jacobian = Jacobian::by_pose(by_pose);
        let slot = self.take_slot(map);
        let mut pgt = [[0.0; STATES]; 2];
        self.covariance_times(&jacobian, &mut pgt);
        let [[o_o, d_o], [_, d_d]] = pgt.each_ref().map(|pgt| jacobian.times(pgt));
        let (var_offset, var_direction) = (o_o + var_offset, d_d + var_direction);
        let Some(slot) = slot else {
            if let Some(entry) = map.get_mut(index) {
                entry.set_segment(&with_variances(&segment, var_offset, var_direction));
            }
            return;
        };
        self.assign(slot, index, 0.0);
        let own = line_states(slot);
        let live = self.covariance.live();
        for (own, pgt) in own.into_iter().zip(&pgt) {
            for (other, value) in pgt.iter().enumerate().take(live) {
                self.covariance.set(own, other, *value);
            }
        }
        let [offset, direction] = own;
        self.covariance.set(offset, offset, var_offset);
        self.covariance.set(direction, direction, var_direction);
        self.covariance.set(offset, direction, d_o);
    }

    /// A line of the map, part of another until now, comes in as a copy of that, but for variances that parts have of their own. Where
    /// there is no slot for it, its segment carries its marginal variances. No update may be pending.
    pub(super) fn copy_line<const N: usize>(
        &mut self,
        source: usize,
        index: usize,
        own_variances: [f32; 2],
        map: &mut SegmentMap<N>,
    ) {
        let Some(slot) = self.slot_of(source) else { return };
        // Not to be given away for its own copy.
        self.slots.in_use |= 1 << slot;
        let states = line_states(slot);
        let Some(copy) = self.take_slot(map) else {
            if let Some(entry) = map.get_mut(index) {
                let [var_offset, var_direction] = states.map(|state| self.covariance.get(state, state));
                entry.set_segment(&with_variances(&entry.segment(), var_offset, var_direction));
            }
            return;
        };
        self.assign(copy, index, self.age_scans(slot));
        let own = line_states(copy);
        for (own_state, state) in own.into_iter().zip(states) {
            for other in (0..self.covariance.live()).filter(|other| !own.contains(other)) {
                self.covariance.set(own_state, other, self.covariance.get(state, other));
            }
        }
        let ([offset, direction], [o, d]) = (own, states);
        let [var_offset, var_direction] = own_variances;
        self.covariance.set(offset, offset, self.covariance.get(o, o) + var_offset);
        self.covariance.set(direction, direction, self.covariance.get(d, d) + var_direction);
        self.covariance.set(offset, direction, self.covariance.get(o, d));
        let turned = self.slots.turns.get(slot).copied().unwrap_or(0.0);
        if let Some(turn) = self.slots.turns.get_mut(copy) {
            *turn = turned;
        }
    }

    /// A slot without covariances, in use in the current scan.
    fn take_slot<const N: usize>(&mut self, map: &mut SegmentMap<N>) -> Option<usize> {
        let slot = self.slots.next(map)?;
        self.decouple(slot, map);
        self.slots.in_use |= 1 << slot;
        Some(slot)
    }

    fn assign(&mut self, slot: usize, index: usize, age_scans: f32) {
        if let (Some(id), Some(age)) =
            (self.slots.line_ids.get_mut(slot), self.slots.ages_scans.get_mut(slot))
        {
            (*id, *age) = (LineId::of(index), age_scans);
        }
        self.covariance.set_live(self.slots.live_states());
    }

    /// Takes a line out of the state; its segment keeps its marginal variances.
    pub(super) fn decouple<const N: usize>(&mut self, slot: usize, map: &mut SegmentMap<N>) {
        let [offset, direction] = line_states(slot);
        if let Some(entry) = self.line_id(slot).and_then(|index| map.get_mut(index)) {
            let [var_offset, var_direction] = [offset, direction].map(|i| self.covariance.get(i, i));
            entry.set_segment(&with_variances(&entry.segment(), var_offset, var_direction));
        }
        self.drop_slot(slot);
    }

    /// Frees a slot: its states have no error, no covariance and no line.
    fn drop_slot(&mut self, slot: usize) {
        let [offset, direction] = line_states(slot);
        if let Some(id) = self.slots.line_ids.get_mut(slot) {
            *id = None;
        }
        self.covariance.zero_state(offset);
        self.covariance.zero_state(direction);
        if let Some(turn) = self.slots.turns.get_mut(slot) {
            *turn = 0.0;
        }
        if let Some(error) = self.error_state.get_mut(offset..=direction) {
            error.fill(0.0);
        }
        self.slots.in_use &= !(1 << slot);
        self.covariance.set_live(self.slots.live_states());
    }

    /// The map has given the index of a line to another one.
    pub(super) fn line_replaced(&mut self, index: usize) {
        if let Some(slot) = self.slot_of(index) {
            self.drop_slot(slot);
        }
    }

    /// The map's line `gone` is no more, and the one at `last` has taken its index.
    pub(super) fn line_removed(&mut self, gone: usize, last: usize) {
        self.line_replaced(gone);
        if let Some(id) = self.slot_of(last).and_then(|slot| self.slots.line_ids.get_mut(slot)) {
            *id = LineId::of(gone);
        }
    }
}

#[cfg(test)]
mod tests;
