//! Line segments and the sums they are made of.
//!
//! A [`Segment`] is directed: walking from `start` to `end`, the sensor that saw it stood on the left, so its unit
//! normal points to the free side. The two faces of a thin wall are two segments with opposite normals.
//!
//! Its line is the total-least-squares fit to weighted points, held as [`Moments`]: two sets of points join in O(1)
//! and give exactly the line that all points together would give. Second moments are about the centroid, so that
//! `f32` keeps its digits a kilometre from the origin.

use nalgebra::{Isometry2, Point2, Vector2};

use crate::geometry::math::{max, min, sqrt};
use crate::geometry::pose::{cross, perpendicular};

/// Weighted sums over points of the plane. A weight is the inverse variance of the point, 1/m².
#[derive(Clone, Copy, Debug, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct Moments {
    /// Number of points (the paper's n).
    pub inliers: u32,
    /// Sum of the weights, 1/m²: the inverse variance of the centroid across the line.
    pub weight: f32,
    /// Weighted centroid, metres.
    pub centroid: Point2<f32>,
    /// Weighted central second moments Σw·x², Σw·x·y, Σw·y², dimensionless.
    pub scatter: [f32; 3],
}

impl Moments {
    /// No points.
    pub const EMPTY: Self =
        Self { inliers: 0, weight: 0.0, centroid: Point2::new(0.0, 0.0), scatter: [0.0, 0.0, 0.0] };

    /// Sums over `(point, weight)` pairs with positive weights. Work: two passes.
    pub fn from_points(points: impl Iterator<Item = (Point2<f32>, f32)> + Clone) -> Self {
        let (mut inliers, mut weight, mut sum) = (0u32, 0.0, Vector2::zeros());
        // Sums are taken from the first point on, the centroid's digits are then those of the extent.
        let Some((origin, _)) = points.clone().next() else { return Self::EMPTY };
        for (point, w) in points.clone() {
            inliers = inliers.saturating_add(1);
            weight += w;
            sum += (point - origin) * w;
        }
        let centroid = origin + sum / weight;
        let [mut xx, mut xy, mut yy] = [0.0; 3];
        for (point, w) in points {
            let d = point - centroid;
            xx += w * d.x * d.x;
            xy += w * d.x * d.y;
            yy += w * d.y * d.y;
        }
        Self { inliers, weight, centroid, scatter: [xx, xy, yy] }
    }

    /// The sums over both sets of points: exact, by the parallel-axis theorem.
    #[must_use]
    pub fn merged(&self, other: &Self) -> Self {
        let weight = self.weight + other.weight;
        if weight <= 0.0 {
            return *self;
        }
        let apart = other.centroid - self.centroid;
        let share = other.weight / weight;
        let between = self.weight * share;
        let [xx, xy, yy] = self.scatter;
        let [oxx, oxy, oyy] = other.scatter;
        Self {
            inliers: self.inliers.saturating_add(other.inliers),
            weight,
            centroid: self.centroid + apart * share,
            scatter: [
                xx + oxx + between * apart.x * apart.x,
                xy + oxy + between * apart.x * apart.y,
                yy + oyy + between * apart.y * apart.y,
            ],
        }
    }

    /// The sums of the points carried to another frame.
    #[must_use]
    pub fn transformed(&self, to_from_here: &Isometry2<f32>) -> Self {
        let (c, s) = (to_from_here.rotation.re, to_from_here.rotation.im);
        let [xx, xy, yy] = self.scatter;
        Self {
            centroid: to_from_here * self.centroid,
            scatter: [
                c * c * xx - 2.0 * c * s * xy + s * s * yy,
                c * s * (xx - yy) + (c * c - s * s) * xy,
                s * s * xx + 2.0 * c * s * xy + c * c * yy,
            ],
            ..*self
        }
    }

    /// Unit direction in which the points spread most; its sign is arbitrary. x where they spread nowhere.
    pub fn direction(&self) -> Vector2<f32> {
        let [xx, xy, yy] = self.scatter;
        // Half of the angle whose cosine and sine are these, without a transcendental function.
        let (cos, sin) = (xx - yy, 2.0 * xy);
        let length = sqrt(cos * cos + sin * sin);
        if !(length > 0.0 && length.is_finite()) {
            return Vector2::new(1.0, 0.0);
        }
        let (cos, sin) = (cos / length, sin / length);
        if cos > 0.0 {
            let x = sqrt(0.5 * (1.0 + cos));
            Vector2::new(x, 0.5 * sin / x)
        } else {
            let y = sqrt(0.5 * (1.0 - cos));
            Vector2::new(0.5 * sin / y, y)
        }
    }

    /// Weighted scatter along a unit direction: the inverse variance of the line's angle, 1/rad².
    pub fn scatter_along(&self, direction: Vector2<f32>) -> f32 {
        let [xx, xy, yy] = self.scatter;
        let (x, y) = (direction.x, direction.y);
        max(x * x * xx + 2.0 * x * y * xy + y * y * yy, 0.0)
    }

    /// Weighted sum of squared distances from the fitted line: χ² of the fit.
    pub fn residual(&self) -> f32 {
        self.scatter_along(perpendicular(self.direction()))
    }
}

/// A straight line in Hesse normal form: the points p with `normal`·p = `distance_m`.
#[derive(Clone, Copy, Debug, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct Line {
    /// Unit normal.
    pub normal: Vector2<f32>,
    /// Signed distance of the line from the origin along the normal, metres; negative where the normal points to
    /// the origin.
    pub distance_m: f32,
}

impl Line {
    /// Signed distance of a point, metres, positive on the side the normal points to.
    #[inline]
    pub fn signed_distance(&self, point: Point2<f32>) -> f32 {
        self.normal.dot(&point.coords) - self.distance_m
    }
}

/// A directed line segment with the sums of the points it stands for.
#[derive(Clone, Copy, Debug, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct Segment {
    /// The points it was fitted to. Its weight and scatter are the line's covariance.
    pub moments: Moments,
    /// Unit direction from start to end; the free side is on its left.
    pub direction: Vector2<f32>,
    /// First end, metres.
    pub start: Point2<f32>,
    /// Last end, metres.
    pub end: Point2<f32>,
}

impl Segment {
    /// The least-squares segment of points: ends are the farthest feet of `extremes`, and `viewpoint` is on its left.
    pub fn fitted(moments: Moments, extremes: &[Point2<f32>], viewpoint: Point2<f32>) -> Self {
        let mut direction = moments.direction();
        if cross(direction, viewpoint - moments.centroid) < 0.0 {
            direction = -direction;
        }
        Self::along(moments, direction, extremes)
    }

    /// The segment of two end points that stand for `inliers` points of variance `variance_m2`, as the paper has it:
    /// half of the points at each end.
    pub fn from_ends(
        start: Point2<f32>,
        end: Point2<f32>,
        inliers: u32,
        variance_m2: f32,
        viewpoint: Point2<f32>,
    ) -> Self {
        let weight = 0.5 * inliers as f32 / variance_m2;
        let mut moments = Moments::from_points([(start, weight), (end, weight)].into_iter());
        moments.inliers = inliers;
        Self::fitted(moments, &[start, end], viewpoint)
    }

    /// The same points carried to another frame.
    #[must_use]
    pub fn transformed(&self, to_from_here: &Isometry2<f32>) -> Self {
        Self {
            moments: self.moments.transformed(to_from_here),
            direction: to_from_here.rotation * self.direction,
            start: to_from_here * self.start,
            end: to_from_here * self.end,
        }
    }

    /// The segment moved along its normal (m) and turned about its centroid (rad, small).
    #[must_use]
    pub fn shifted(&self, offset_m: f32, turn_rad: f32) -> Self {
        let turned = self.direction + self.normal() * turn_rad;
        let direction = turned / sqrt(turned.norm_squared());
        let shift = self.normal() * offset_m;
        let mut moments = self.moments;
        moments.centroid += shift;
        Self::along(moments, direction, &[self.start + shift, self.end + shift])
    }

    /// The segment on the same line, made longer where these points lie beyond its ends.
    #[must_use]
    pub fn extended(&self, points: [Point2<f32>; 2]) -> Self {
        Self::along(self.moments, self.direction, &[self.start, self.end, points[0], points[1]])
    }

    fn along(moments: Moments, direction: Vector2<f32>, extremes: &[Point2<f32>]) -> Self {
        let (mut least, mut most) = (f32::INFINITY, f32::NEG_INFINITY);
        for point in extremes {
            let s = direction.dot(&(point - moments.centroid));
            (least, most) = (min(s, least), max(s, most));
        }
        if least > most {
            (least, most) = (0.0, 0.0);
        }
        let (start, end) = (moments.centroid + direction * least, moments.centroid + direction * most);
        Self { moments, direction, start, end }
    }

    /// Unit normal, pointing to the free side.
    #[inline]
    pub fn normal(&self) -> Vector2<f32> {
        perpendicular(self.direction)
    }

    /// The infinite line in Hesse normal form.
    pub fn line(&self) -> Line {
        let normal = self.normal();
        Line { normal, distance_m: normal.dot(&self.moments.centroid.coords) }
    }

    /// Distance between the ends, metres.
    pub fn length_m(&self) -> f32 {
        self.direction.dot(&(self.end - self.start))
    }

    /// Point half way between the ends.
    pub fn midpoint(&self) -> Point2<f32> {
        nalgebra::center(&self.start, &self.end)
    }

    /// Coordinate of a point along the segment, metres from its centroid.
    #[inline]
    pub fn along_of(&self, point: Point2<f32>) -> f32 {
        self.direction.dot(&(point - self.moments.centroid))
    }

    /// The point of the segment that is nearest to another point.
    pub fn nearest_to(&self, point: Point2<f32>) -> Point2<f32> {
        let (from, to) = (self.along_of(self.start), self.along_of(self.end));
        self.moments.centroid + self.direction * max(min(self.along_of(point), to), from)
    }

    /// Two segments, the longer one first.
    pub fn longer_first<'a>(a: &'a Self, b: &'a Self) -> [&'a Self; 2] {
        if a.length_m() >= b.length_m() { [a, b] } else { [b, a] }
    }

    /// Distance of the farther end of `other` from this segment's line, metres.
    pub fn farther_end_m(&self, other: &Self) -> f32 {
        let line = self.line();
        max(line.signed_distance(other.start).abs(), line.signed_distance(other.end).abs())
    }

    /// Length over which `other`, projected on this segment, lies within it, metres; negative: the gap between them.
    pub fn overlap_m(&self, other: &Self) -> f32 {
        -self.gap_to_m([other.start, other.end])
    }

    /// The gap along this segment to a stretch between two points, metres; negative where they overlap.
    pub fn gap_to_m(&self, [a, b]: [Point2<f32>; 2]) -> f32 {
        let (from, to) = (self.along_of(self.start), self.along_of(self.end));
        let (a, b) = (self.along_of(a), self.along_of(b));
        max(from, min(a, b)) - min(to, max(a, b))
    }

    /// Whether every number is finite.
    pub fn is_finite(&self) -> bool {
        let ends = [self.start, self.end, self.moments.centroid];
        ends.iter().all(|p| p.x.is_finite() && p.y.is_finite())
            && self.moments.weight.is_finite()
            && self.moments.scatter.iter().all(|s| s.is_finite())
            && self.direction.x.is_finite()
            && self.direction.y.is_finite()
    }
}

#[cfg(test)]
mod tests;
