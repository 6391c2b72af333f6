//! The map segments that a scan can touch, found once for each scan and kept by direction.
//!
//! In: map, pose, the sensor's reach. Out: their indices, all of them or those that run nearly in some direction: in a building,
//! about a quarter.

use heapless::Vec;
use nalgebra::{Isometry2, Vector2};

use crate::map::MapSegment;

/// Sectors of direction. Each is at least [`NARROWEST_RAD`] wide.
const SECTORS: usize = 12;
/// Of a segment that is not nearby.
const NO_SECTOR: u8 = SECTORS as u8;
/// Width of the narrowest sector, radians: atan 1/2, less a little for rounding.
const NARROWEST_RAD: f32 = 0.46;

/// Indices of map segments; 2·`N` bytes and a few words.
#[derive(Clone, Debug)]
pub struct Nearby<const N: usize> {
    /// By sector.
    indices: Vec<u16, N>,
    /// Where each sector ends.
    ends: [u16; SECTORS],
}

impl<const N: usize> Default for Nearby<N> {
    fn default() -> Self {
        Self::new()
    }
}

impl<const N: usize> Nearby<N> {
    /// None.
    pub const fn new() -> Self {
        Self { indices: Vec::new(), ends: [0; SECTORS] }
    }

    /// Finds the segments within `reach_m` of the pose that `counts` holds for. Work: a step for each map segment, and one for each found.
    pub fn gather(
        &mut self,
        map: &[MapSegment],
        pose: &Isometry2<f32>,
        reach_m: f32,
        counts: impl Fn(&MapSegment) -> bool,
    ) {
        let near = |entry: &MapSegment| {
            let to_middle = entry.midpoint().coords - pose.translation.vector;
            let radius = reach_m + 0.5 * entry.length_m();
            to_middle.norm_squared() <= radius * radius && counts(entry)
        };
        // A counting sort: the sector of each and how many there are of it, where each sector begins, then each to its place.
        let mut sectors = [NO_SECTOR; N];
        self.ends = [0; SECTORS];
        for (own, entry) in sectors.iter_mut().zip(map).filter(|(_, entry)| near(entry)) {
            let sector = sector(entry.direction());
            if let Some(count) = self.ends.get_mut(sector) {
                *own = sector as u8;
                *count += 1;
            }
        }
        let mut begin = 0;
        for end in &mut self.ends {
            begin += core::mem::replace(end, begin);
        }
        self.indices.clear();
        // At most as many as the map holds, which is the capacity.
        let _ = self.indices.resize(usize::from(begin), 0);
        for (index, sector) in sectors.iter().take(map.len()).enumerate() {
            let Some(end) = self.ends.get_mut(usize::from(*sector)) else { continue };
            if let Some(place) = self.indices.get_mut(usize::from(*end)) {
                *place = index as u16;
            }
            // What was the sector's beginning becomes its end.
            *end += 1;
        }
    }

    /// All that were found, by direction.
    pub fn all(&self) -> &[u16] {
        &self.indices
    }

    /// At least those that run within this angle of a direction.
    pub fn along(&self, direction: Vector2<f32>, max_angle_rad: f32) -> impl Iterator<Item = u16> {
        let (middle, aside) = (sector(direction), (max_angle_rad / NARROWEST_RAD) as usize + 1);
        let (first, sectors) =
            if 2 * aside + 1 < SECTORS { (middle + SECTORS - aside, 2 * aside + 1) } else { (0, SECTORS) };
        (first..first + sectors).flat_map(|k| self.sector(k % SECTORS)).copied()
    }

    fn sector(&self, sector: usize) -> &[u16] {
        let end = |k: usize| self.ends.get(k).map_or(0, |end| usize::from(*end));
        let begin = if sector == 0 { 0 } else { end(sector - 1) };
        self.indices.get(begin..end(sector)).unwrap_or_default()
    }
}

/// The sector of a unit direction: thirds of the edges of the square |x| + |y| = 1, counter-clockwise from the x axis.
fn sector(direction: Vector2<f32>) -> usize {
    let (x, y) = (direction.x, direction.y);
    let along = y / (x.abs() + y.abs());
    let edges = if x < 0.0 {
        2.0 - along
    } else if along < 0.0 {
        4.0 + along
    } else {
        along
    };
    // Nothing that is no number comes here; were it so, it would be sector 0.
    ((edges * (SECTORS as f32 / 4.0)) as usize).min(SECTORS - 1)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::math::sin_cos;
    use crate::geometry::pose::pose;
    use crate::geometry::segment::Segment;
    use nalgebra::Point2;
    use proptest::prelude::*;
    use std::collections::BTreeSet;

    fn entry(x: f32, y: f32, angle: f32) -> MapSegment {
        let (s, c) = sin_cos(angle);
        let start = Point2::new(x, y);
        let end = start + Vector2::new(c, s);
        // Seen from its left, so that it runs from start to end.
        let segment = Segment::from_ends(start, end, 10, 1e-4, start + Vector2::new(-s, c));
        MapSegment::new(&segment, 1, 0, 0.0)
    }

    proptest! {
        #[test]
        fn none_is_missed_and_none_comes_twice(
            places in proptest::collection::vec((-9.0f32..9.0, -9.0f32..9.0, -3.2f32..3.2), 0..60),
            angle in -3.2f32..3.2,
            within in 0.0f32..1.6,
        ) {
            let map: std::vec::Vec<MapSegment> = places.iter().map(|&(x, y, a)| entry(x, y, a)).collect();
            let mut nearby = Nearby::<64>::new();
            nearby.gather(&map, &pose(1.0, 0.0, 2.0), 5.6, |s| s.segment().midpoint().x > -8.0);
            let plain: BTreeSet<u16> = (0..map.len() as u16)
                .filter(|i| {
                    let s = &map[usize::from(*i)].segment();
                    let near = (s.midpoint() - Point2::new(1.0, 0.0)).norm() <= 5.6 + 0.5 * s.length_m();
                    near && s.midpoint().x > -8.0
                })
                .collect();
            prop_assert_eq!(nearby.all().iter().copied().collect::<BTreeSet<_>>(), plain.clone());
            let (s, c) = sin_cos(angle);
            let direction = Vector2::new(c, s);
            let found: std::vec::Vec<u16> = nearby.along(direction, within).collect();
            let once: BTreeSet<u16> = found.iter().copied().collect();
            prop_assert_eq!(once.len(), found.len());
            prop_assert!(once.is_subset(&plain));
            for index in plain {
                let own = map[usize::from(index)].direction();
                let apart = libm::acosf(own.dot(&direction).clamp(-1.0, 1.0));
                prop_assert!(apart > within - 1e-3 || once.contains(&index), "{} rad apart", apart);
            }
        }
    }

    #[test]
    fn in_a_building_a_quarter_is_looked_at() {
        let quarter = core::f32::consts::FRAC_PI_2;
        let map: std::vec::Vec<MapSegment> =
            (0..40).map(|k| entry(0.1 * k as f32, 0.0, quarter * (k % 4) as f32 + 0.01)).collect();
        let mut nearby = Nearby::<64>::new();
        nearby.gather(&map, &Isometry2::identity(), 5.6, |_| true);
        assert_eq!(nearby.along(Vector2::x(), 0.35).count(), 10);
    }

    #[test]
    fn segments_out_of_reach_are_not_nearby() {
        // One near, one far, one far but long.
        let long =
            Segment::from_ends(Point2::new(-50.0, 1.0), Point2::new(50.0, 1.0), 9, 1e-4, Point2::origin());
        let map = [entry(1.0, 0.0, 0.0), entry(9.0, 0.0, 0.0), entry(0.0, 0.0, 0.0).with_segment(&long)];
        let mut nearby = Nearby::<4>::new();
        nearby.gather(&map, &Isometry2::identity(), 5.6, |_| true);
        assert_eq!(nearby.all().iter().copied().collect::<BTreeSet<_>>(), BTreeSet::from([0, 2]));
    }
}
