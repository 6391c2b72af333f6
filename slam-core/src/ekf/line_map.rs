//! The lines of the map together with their slots in the filter.
//!
//! Slots know lines by their index in the map. Whatever gives an index to another line goes through here, where map and slots are
//! changed at once: also while an update is pending, a line keeps its error and its covariances, and nobody inherits them.

use crate::ekf::filter::EkfSlam;
use crate::ekf::keyframe_update::Stamp;
use crate::geometry::line_noise::LineNoise;
use crate::geometry::segment::Segment;
use crate::map::SegmentMap;

/// Map and filter, to be changed at once.
pub(crate) struct LineMap<'a, const N: usize> {
    /// The lines.
    pub map: &'a mut SegmentMap<N>,
    /// The filter, which has some of them in its state.
    pub filter: &'a mut EkfSlam,
}

impl<const N: usize> LineMap<'_, N> {
    /// Adds a segment to the map; a full map drops the line that is worth least for it. Returns its index, if it found room. It is not
    /// in the filter's state yet. Work: `N` steps when full.
    pub fn insert(&mut self, segment: Segment, stamp: &Stamp) -> Option<usize> {
        let index = self.map.insert(segment, stamp.scan, stamp.way_m)?;
        self.filter.line_replaced(index);
        Some(index)
    }

    /// Makes two lines one, which keeps the line and the slot of `kept`. Returns its index.
    pub fn merge(&mut self, kept: usize, gone: usize) -> usize {
        let lines = self.map.segments().len();
        self.map.fuse(kept, gone);
        let last = self.map.segments().len();
        if last == lines {
            return kept;
        }
        self.filter.line_removed(gone, last);
        if kept == last { gone } else { kept }
    }

    /// Leaves of a line what stands on both sides of an opening. The larger part keeps the slot; the other is a line of its own with the
    /// same errors, but for what parts of a wall have of their own. No update may be pending. Work: the number of states; `N` steps when
    /// the map is full.
    pub fn cut(&mut self, index: usize, parts: [Option<Segment>; 2], noise: &LineNoise, stamp: &Stamp) {
        let Some(other) = self.map.cut(index, parts, stamp.scan) else { return };
        self.filter.line_replaced(other);
        let length_m = self.map.segments().get(other).map_or(0.0, |entry| entry.length_m());
        self.filter.copy_line(index, other, noise.added_to([0.0; 2], length_m), self.map);
    }

    /// Forgets a line.
    pub fn remove(&mut self, index: usize) {
        let lines = self.map.segments().len();
        self.map.forget(index);
        let last = self.map.segments().len();
        if last < lines {
            self.filter.line_removed(index, last);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ekf::state::{LINES, line_states};
    use nalgebra::{Isometry2, Point2, Vector2, Vector3};
    use proptest::prelude::*;
    use std::collections::BTreeSet;

    const CAPACITY: usize = 6;

    /// A line that is known again by its number of points.
    fn tagged(tag: u32) -> Segment {
        let y = tag as f32;
        Segment::from_ends(Point2::new(0.0, y), Point2::new(2.0, y), tag, 1e-4, Point2::new(0.0, y - 1.0))
    }

    fn tag_of(segment: &Segment) -> u32 {
        segment.moments.inliers
    }

    #[derive(Clone, Copy, Debug)]
    enum Step {
        /// The index is in the state from then on, where it is not yet.
        Augment(usize),
        Insert,
        Remove(usize),
        Merge(usize, usize),
    }

    fn step() -> impl Strategy<Value = Step> {
        let index = || 0..CAPACITY + 1;
        prop_oneof![
            index().prop_map(Step::Augment),
            Just(Step::Insert),
            Just(Step::Insert),
            index().prop_map(Step::Remove),
            (index(), index()).prop_map(|(kept, gone)| Step::Merge(kept, gone)),
        ]
    }

    /// The error that the state of a line has, by who it is.
    fn error_of(tag: u32) -> f32 {
        0.001 * tag as f32
    }

    struct World {
        map: SegmentMap<CAPACITY>,
        filter: EkfSlam,
        /// The lines that ought to be in the state.
        tracked: BTreeSet<u32>,
        next_tag: u32,
    }

    impl World {
        fn new() -> Self {
            let filter = EkfSlam::new(Vector3::zeros());
            let mut world = Self { map: SegmentMap::new(), filter, tracked: BTreeSet::new(), next_tag: 1 };
            (0..CAPACITY).for_each(|_| world.take(Step::Insert));
            (0..CAPACITY - 1).for_each(|index| world.take(Step::Augment(index)));
            world
        }

        fn tag_at(&self, index: usize) -> Option<u32> {
            self.map.segments().get(index).map(|entry| tag_of(&entry.segment()))
        }

        fn lines(&mut self) -> LineMap<'_, CAPACITY> {
            LineMap { map: &mut self.map, filter: &mut self.filter }
        }

        fn take(&mut self, step: Step) {
            match step {
                Step::Augment(index) => {
                    let Some(tag) = self.tag_at(index).filter(|tag| !self.tracked.contains(tag)) else {
                        return;
                    };
                    self.filter.augment(index, Vector2::zeros(), &mut self.map);
                    let [offset, _] = line_states(self.filter.slot_of(index).unwrap());
                    self.filter.error_state[offset] = error_of(tag);
                    self.tracked.insert(tag);
                }
                Step::Insert => {
                    let (tag, before) = (self.next_tag, self.tags());
                    let stamp = Stamp { scan: tag, way_m: tag as f32 };
                    let index = self.lines().insert(tagged(tag), &stamp).unwrap();
                    assert_eq!(self.tag_at(index), Some(tag));
                    let after = self.tags();
                    before.iter().filter(|tag| !after.contains(tag)).for_each(|tag| {
                        self.tracked.remove(tag);
                    });
                    self.next_tag += 1;
                }
                Step::Remove(index) => {
                    let tag = self.tag_at(index);
                    self.lines().remove(index);
                    tag.map(|tag| self.tracked.remove(&tag));
                }
                Step::Merge(kept, gone) => {
                    let (Some(tag), Some(gone_tag)) = (self.tag_at(kept), self.tag_at(gone)) else { return };
                    let index = self.lines().merge(kept, gone);
                    if kept != gone {
                        self.tracked.remove(&gone_tag);
                        // It goes on under the name of the one that was kept.
                        let entry = self.map.get_mut(index).unwrap();
                        let mut renamed = entry.segment();
                        renamed.moments.inliers = tag;
                        entry.set_segment(&renamed);
                    }
                    assert_eq!(self.tag_at(index), Some(tag));
                }
            }
        }

        fn tags(&self) -> std::vec::Vec<u32> {
            self.map.segments().iter().map(|entry| tag_of(&entry.segment())).collect()
        }
    }

    proptest! {
        /// A full map that drops lines in the state, and lines that are removed and merged, between measurement and commit: each
        /// line is moved by its own error, and by nobody else's.
        #[test]
        fn each_line_has_its_own_error_whatever_becomes_of_the_map(
            steps in prop::collection::vec(step(), 0..30),
        ) {
            let mut world = World::new();
            for step in steps {
                world.take(step);
                let tracked = (0..LINES).filter_map(|slot| world.filter.line_id(slot));
                let mut tags: std::vec::Vec<_> = tracked.map(|index| world.tag_at(index)).collect();
                tags.sort_unstable();
                let expected: std::vec::Vec<_> = world.tracked.iter().copied().map(Some).collect();
                prop_assert_eq!(tags, expected, "after {:?}", step);
            }
            let before = world.map.segments().to_vec();
            world.filter.commit(&Isometry2::identity(), &mut world.map);
            for (before, after) in before.iter().zip(world.map.segments()) {
                let tag = tag_of(&before.segment());
                let error = if world.tracked.contains(&tag) { error_of(tag) } else { 0.0 };
                let off = after.segment().midpoint() - before.segment().shifted(error, 0.0).midpoint();
                prop_assert!(off.norm() < 5e-5, "{tag} is off by {off}");
            }
        }
    }

    /// The part that gets a slot of its own is known as well as the other one, and moves with it.
    #[test]
    fn parts_of_a_line_have_the_same_errors() {
        let noise = LineNoise { sigma_offset_m: 1e-3, sigma_direction_rad: 1e-3 };
        let stamp = Stamp { scan: 2, way_m: 0.0 };
        let mut map = SegmentMap::<CAPACITY>::new();
        let mut filter = EkfSlam::new(Vector3::zeros());
        let mut lines = LineMap { map: &mut map, filter: &mut filter };
        let index = lines.insert(tagged(1), &Stamp { scan: 1, way_m: 0.0 }).unwrap();
        lines.filter.augment(index, Vector2::zeros(), lines.map);
        let whole = lines.map.segments()[index].segment();
        let at = |along_m: f32| whole.start + whole.direction * along_m;
        let parts = [(0.0, 0.5), (1.2, 2.0)]
            .map(|(from, to)| Some(Segment { start: at(from), end: at(to), ..whole }));
        lines.cut(index, parts, &noise, &stamp);
        assert_eq!(map.counters().opened, 1);
        let [kept, other] = [index, 1].map(|index| line_states(filter.slot_of(index).unwrap()));
        let is_at = |end: Point2<f32>, along_m| (end - at(along_m)).norm() < 1e-6;
        assert!(is_at(map.segments()[index].segment().start, 1.2), "the larger part keeps its slot");
        assert!(is_at(map.segments()[1].segment().end, 0.5));
        for (kept, other) in kept.into_iter().zip(other) {
            let variance = filter.covariance.get(kept, kept);
            assert_eq!(filter.covariance.get(kept, other), variance);
            assert!(filter.covariance.get(other, other) > variance, "parts are not quite one line");
        }
    }
}
