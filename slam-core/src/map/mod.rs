//! The map: a fixed number of line segments in `map`.
//!
//! When it is full, the segment that is worth least gives way to the new one: scans that saw it, fewer the longer the way since.
//! Segments of the scan at hand never do. Each eviction and each segment refused is counted.

#[cfg(test)]
pub(crate) mod fixtures;
mod map_segment;
pub mod nearby;
pub mod openings;
pub mod store;
pub mod visibility;
pub mod walls;

use heapless::Vec;

use crate::geometry::math::max;
use crate::geometry::segment::Segment;
pub(crate) use map_segment::END_STEP_M;
pub use map_segment::MapSegment;

/// Up to `N` segments; 40·`N` bytes and a few words. `N` may be up to 65 535.
#[derive(Clone, Debug, Default)]
pub struct SegmentMap<const N: usize> {
    segments: Vec<MapSegment, N>,
    counters: MapCounters,
}

/// What happened to the map since it began.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct MapCounters {
    /// Segments added.
    pub added: u32,
    /// Segments dropped to make room for others.
    pub evicted: u32,
    /// Segments that found no room because all others were in use.
    pub refused: u32,
    /// Segments that became one with another.
    pub fused: u32,
    /// Segments that beams went through until they were forgotten.
    pub forgotten: u32,
    /// Openings that were cut into segments.
    pub opened: u32,
}

impl<const N: usize> SegmentMap<N> {
    /// Size of the map in RAM.
    pub const BYTES: usize = core::mem::size_of::<Self>();

    const INDEX_FITS: () = assert!(N <= u16::MAX as usize, "a map holds at most 65 535 segments");

    /// No segments.
    pub const fn new() -> Self {
        let () = Self::INDEX_FITS;
        let counters = MapCounters { added: 0, evicted: 0, refused: 0, fused: 0, forgotten: 0, opened: 0 };
        Self { segments: Vec::new(), counters }
    }

    /// The segments, in no order that means anything.
    pub fn segments(&self) -> &[MapSegment] {
        &self.segments
    }

    /// Counters since the map began.
    pub fn counters(&self) -> MapCounters {
        self.counters
    }

    /// Begins anew with these segments, which have not been seen yet by any scan to come.
    pub(crate) fn take_up(&mut self, segments: impl Iterator<Item = MapSegment>) {
        self.segments.clear();
        for mut entry in segments {
            entry.last_seen = 0;
            if !entry.segment().is_finite() || self.segments.push(entry).is_err() {
                self.counters.refused = self.counters.refused.saturating_add(1);
            }
        }
    }

    pub(crate) fn get_mut(&mut self, index: usize) -> Option<&mut MapSegment> {
        self.segments.get_mut(index)
    }

    /// Adds a segment seen by scan `seen`, after a way of `seen_at_m`. Returns its index, if it
    /// found a place. Work: `N` steps when full.
    pub fn insert(&mut self, segment: Segment, seen: u32, seen_at_m: f32) -> Option<usize> {
        self.insert_entry(MapSegment::new(&segment, 1, seen, seen_at_m), seen, None)
    }

    /// The same for one that may have been seen before; `now` is the scan at hand, and `spared` does not give way to it.
    fn insert_entry(&mut self, entry: MapSegment, now: u32, spared: Option<usize>) -> Option<usize> {
        let way_m = entry.seen_at_m;
        if self.segments.push(entry).is_ok() {
            self.counters.added = self.counters.added.saturating_add(1);
            return Some(self.segments.len() - 1);
        }
        let may_go = |(index, s): &(usize, &mut MapSegment)| s.last_seen != now && Some(*index) != spared;
        let stale = self.segments.iter_mut().enumerate().filter(may_go);
        let Some((index, least)) = stale.min_by(|(_, a), (_, b)| a.worth(way_m).total_cmp(&b.worth(way_m)))
        else {
            self.counters.refused = self.counters.refused.saturating_add(1);
            return None;
        };
        *least = entry;
        self.counters.evicted = self.counters.evicted.saturating_add(1);
        self.counters.added = self.counters.added.saturating_add(1);
        Some(index)
    }

    /// Ends segment `gone`, which has become one with segment `kept`; the last segment takes its place.
    pub(crate) fn fuse(&mut self, kept: usize, gone: usize) {
        if kept == gone || gone >= self.segments.len() {
            return;
        }
        let taken = self.segments.swap_remove(gone);
        let index = if kept == self.segments.len() { gone } else { kept };
        let Some(kept) = self.segments.get_mut(index) else { return };
        kept.set_segment(&kept.segment().extended([taken.segment().start, taken.segment().end]));
        kept.add_inliers(&taken.segment());
        kept.hits = kept.hits.max(taken.hits);
        kept.last_seen = kept.last_seen.max(taken.last_seen);
        kept.seen_at_m = max(kept.seen_at_m, taken.seen_at_m);
        self.counters.fused = self.counters.fused.saturating_add(1);
    }

    /// Leaves of a segment what stands before an opening and behind it; one of which nothing is left counts as seen through. Returns the
    /// index of the smaller part, which needs room of its own.
    pub(crate) fn cut(&mut self, index: usize, parts: [Option<Segment>; 2], now: u32) -> Option<usize> {
        let entry = self.segments.get_mut(index)?;
        let [first, second] = parts;
        let (kept, other) = match (first, second) {
            (Some(first), Some(second)) if second.length_m() > first.length_m() => (second, Some(first)),
            (Some(first), second) => (first, second),
            (None, Some(second)) => (second, None),
            (None, None) => {
                entry.seen_through = u16::MAX;
                return None;
            }
        };
        entry.set_segment(&kept);
        self.counters.opened = self.counters.opened.saturating_add(1);
        let part = entry.with_segment(&other?);
        self.insert_entry(part, now, Some(index))
    }

    /// Forgets the segments that are not finite.
    pub(crate) fn forget_broken(&mut self) {
        for index in (0..self.segments.len()).rev() {
            if self.segments.get(index).is_some_and(|entry| !entry.segment().is_finite()) {
                self.forget(index);
            }
        }
    }

    /// Forgets a segment; the last one takes its place.
    pub(crate) fn forget(&mut self, index: usize) {
        if index < self.segments.len() {
            self.segments.swap_remove(index);
            self.counters.forgotten = self.counters.forgotten.saturating_add(1);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Point2;

    fn segment(x: f32) -> Segment {
        Segment::from_ends(Point2::new(x, 0.0), Point2::new(x, 1.0), 10, 1e-4, Point2::new(x - 1.0, 0.0))
    }

    #[test]
    fn size_is_what_the_documentation_says() {
        assert_eq!(core::mem::size_of::<MapSegment>(), 40);
        let bytes = SegmentMap::<512>::BYTES;
        assert!(bytes <= 512 * 40 + 64, "{bytes}");
    }

    #[test]
    fn a_full_map_drops_the_segment_seen_least_and_longest_ago() {
        let mut map = SegmentMap::<3>::new();
        for (x, scan) in [(1.0, 5), (2.0, 3), (3.0, 4)] {
            assert!(map.insert(segment(x), scan, 0.0).is_some());
        }
        map.get_mut(0).unwrap().hits = 9;
        assert_eq!(map.insert(segment(4.0), 6, 0.0), Some(1));
        let kept: std::vec::Vec<f32> = map.segments().iter().map(|s| s.segment().start.x).collect();
        assert_eq!(kept, [1.0, 4.0, 3.0]);
        assert_eq!(map.counters().evicted, 1);
    }

    #[test]
    fn segments_of_the_scan_at_hand_are_never_dropped() {
        let mut map = SegmentMap::<2>::new();
        for x in [1.0, 2.0] {
            assert!(map.insert(segment(x), 7, 0.0).is_some());
        }
        assert!(map.insert(segment(3.0), 7, 0.0).is_none());
        assert_eq!(map.counters(), MapCounters { added: 2, refused: 1, ..MapCounters::default() });
        assert!(SegmentMap::<0>::new().insert(segment(1.0), 1, 0.0).is_none(), "a map without room refuses");
    }

    #[test]
    fn fusing_keeps_all_points_and_frees_a_place() {
        let mut map = SegmentMap::<4>::new();
        map.insert(segment(1.0), 1, 0.0);
        map.insert(segment(2.0), 2, 0.0);
        map.insert(segment(1.01), 3, 0.0);
        map.fuse(0, 2);
        assert_eq!(map.segments().len(), 2);
        assert_eq!(map.segments()[0].segment().moments.inliers, 20);
        assert_eq!(map.segments()[0].last_seen, 3);
        map.fuse(0, 0);
        map.fuse(0, 9);
        assert_eq!(map.segments().len(), 2, "itself and nobody are not fused");
    }

    #[test]
    fn a_part_that_is_cut_off_does_not_take_the_room_of_the_rest() {
        let mut map = SegmentMap::<2>::new();
        let wall = |x: f32, length: f32, hits| fixtures::line((x, 0.0), (x, length), hits);
        for entry in [wall(0.0, 5.0, 3), wall(9.0, 5.0, 50)] {
            assert!(map.insert_entry(entry, 1, None).is_some());
        }
        let parts = [wall(0.0, 3.0, 1), wall(0.0, 1.0, 1)].map(|part| Some(part.segment()));
        assert_eq!(map.cut(0, parts, 7), Some(1));
        for (entry, length_m) in map.segments().iter().zip([3.0, 1.0]) {
            assert!((entry.length_m() - length_m).abs() < 1e-5);
        }
        assert_eq!(map.segments()[1].hits, 3, "a part is as old as the whole");
    }
}
