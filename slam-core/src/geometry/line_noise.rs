//! How sure a line is: variances of its offset (m², along the normal, at the centroid) and its direction (rad²).
//!
//! Of a fitted segment they are the inverses of its sums of weights: 1/Σw, and 1/Σw·s² with s along the line. A segment of the map
//! carries its variances in the same sums.

use crate::geometry::math::{VARIANCE_FLOOR, max};
use crate::geometry::segment::Segment;

/// Error of a line that does not average out over its points: walls are not straight, sensors have a bias.
#[derive(Clone, Copy, Debug, PartialEq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct LineNoise {
    /// Standard deviation of a line's offset, metres.
    pub sigma_offset_m: f32,
    /// Standard deviation of a line's direction, radians.
    pub sigma_direction_rad: f32,
}

impl LineNoise {
    /// Variance of a line's offset, m².
    pub fn var_offset(&self) -> f32 {
        self.sigma_offset_m * self.sigma_offset_m
    }

    /// Variance of the direction of a line of this length, rad²: the shorter it is, the more an offset of its parts
    /// turns it. Infinite at length zero.
    pub fn var_direction(&self, length_m: f32) -> f32 {
        self.sigma_direction_rad * self.sigma_direction_rad + 12.0 * self.var_offset() / (length_m * length_m)
    }

    /// Variances of offset and direction, with this noise of a line of such a length on top.
    pub fn added_to(&self, [offset, direction]: [f32; 2], length_m: f32) -> [f32; 2] {
        [offset + self.var_offset(), direction + self.var_direction(length_m)]
    }
}

/// Variances of a segment's offset and direction, as its sums say; infinite where they say nothing.
pub(crate) fn fitted_variances(segment: &Segment) -> [f32; 2] {
    let variance = |information: f32| if information > 0.0 { 1.0 / information } else { f32::INFINITY };
    [variance(segment.moments.weight), variance(segment.moments.scatter_along(segment.direction))]
}

/// The same for a covariance, which must be finite: 10⁹ at most.
pub(crate) fn variances(segment: &Segment) -> [f32; 2] {
    let variance = |information: f32| 1.0 / max(information, 1e-9);
    [variance(segment.moments.weight), variance(segment.moments.scatter_along(segment.direction))]
}

/// The segment with sums that say these variances.
pub(crate) fn with_variances(segment: &Segment, var_offset: f32, var_direction: f32) -> Segment {
    let mut segment = *segment;
    let d = segment.direction;
    let information = 1.0 / max(var_direction, VARIANCE_FLOOR);
    segment.moments.weight = 1.0 / max(var_offset, VARIANCE_FLOOR);
    segment.moments.scatter = [d.x * d.x * information, d.x * d.y * information, d.y * d.y * information];
    segment
}
