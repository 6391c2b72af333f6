//! Association, section 2.2 of the paper.
//!
//! The perpendicular bisector of a segment seen now, carried to `map` by the predicted pose, is crossed with every map
//! segment. The distance between the crossings with both is the distance between the segments; the nearest map segment within
//! a threshold is the pair, and without one the segment is new. There is no gate on direction. The threshold is ours.

use crate::geometry::pose::cross;
use crate::geometry::segment::Segment;

/// Settings of the paper's association.
#[derive(Clone, Copy, Debug, PartialEq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct BisectorConfig {
    /// Largest distance between the two crossings of the bisector, metres.
    pub max_distance_m: f32,
}

/// Distance between the points in which the perpendicular bisector of `observed` crosses it and `mapped`, if it does
/// cross `mapped` and the distance is within the threshold.
pub(crate) fn bisector_distance(
    observed: &Segment,
    mapped: &Segment,
    config: &BisectorConfig,
) -> Option<f32> {
    let midpoint = observed.midpoint();
    let (bisector, along) = (observed.normal(), mapped.end - mapped.start);
    let denominator = cross(along, bisector);
    let from_start = midpoint - mapped.start;
    // start + t·along = midpoint + s·bisector.
    let t = cross(from_start, bisector) / denominator;
    let s = cross(from_start, along) / denominator;
    ((0.0..=1.0).contains(&t) && s.abs() <= config.max_distance_m).then_some(s.abs())
}
