//! Lines of a map for tests.

use nalgebra::Point2;

use crate::geometry::pose::perpendicular;
use crate::geometry::segment::Segment;
use crate::map::MapSegment;

/// A line that so many scans saw, the last after no way; walking from the first end to the second, the free side is on the left.
pub fn line(from: (f32, f32), to: (f32, f32), hits: u16) -> MapSegment {
    let (from, to) = (Point2::new(from.0, from.1), Point2::new(to.0, to.1));
    let free = nalgebra::center(&from, &to) + perpendicular(to - from);
    let segment = Segment::from_ends(from, to, 9, 1e-4, free);
    MapSegment::new(&segment, hits, 1, 0.0)
}
