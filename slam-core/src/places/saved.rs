//! Places as they were: saved, or left by a reset.

use super::chain::Anchor;
use super::finding::Finder;
use super::solver::Loop;
use super::{LOOPS, Places};
use crate::map::store::{StoredLoop, StoredPlace};

impl<const P: usize> Places<P> {
    /// Takes places and loops as they were; there must be room for them.
    pub(crate) fn restore(
        &mut self,
        anchors: impl Iterator<Item = Anchor>,
        loops: impl Iterator<Item = Loop>,
    ) {
        self.clear();
        self.chain.anchors = anchors.take(P).collect();
        self.loops = loops.take(LOOPS).collect();
        // The posterior is that of a solution.
        self.is_stale = !self.loops.is_empty();
        let waiting = self.chain.anchors.iter().rev().take_while(|anchor| anchor.lines.is_empty());
        self.without_lines = waiting.take(2).count() as u8;
    }

    /// Puts in order what a reset may have left half done. Where places were moving, or one was half written, all are forgotten: the map
    /// is whole without them.
    pub(crate) fn recover(&mut self) {
        let anchors = self.chain.anchors();
        let is_whole = |anchor: &Anchor| StoredPlace::of(anchor).anchor().is_some();
        // A robot that turns on the spot has places of the same way, but not the same place twice.
        let in_order = anchors.is_sorted_by(|before, after| {
            before.way_m < after.way_m || (before.way_m == after.way_m && before.pose != after.pose)
        });
        let loops = self.loops.iter().all(|edge| StoredLoop::of(edge).edge(anchors.len()).is_some());
        if self.is_moving || !in_order || !loops || !anchors.iter().all(is_whole) {
            self.clear();
            return;
        }
        self.solver.clear();
        self.finder = Finder::new();
        (self.is_stale, self.without_lines) = (!self.loops.is_empty(), 0);
        self.pass_lost();
    }
}
