//! The measurement model: an observed segment against a line of the map.
//!
//! Two numbers, with n, d, c the line's normal, direction and centroid, and d', c' those of the observed segment, carried to `map`
//! through the pose:
//!
//! ```text
//!  offset      r₁ = n·(c' − c)      distance of the observed centroid from the line, m
//!  direction   r₂ = d × d'          sine of the angle between them; the angle to 0.5 % within the widest gate, rad
//! ```
//!
//! Together with the sums behind each segment they carry all that the points say about the pose: the least squares over the
//! points and these two have the same minimum and the same information. Along the line nothing is said.
//!
//! Linear in the errors of pose (x, y, θ) and line (offset along n at c, direction):
//!
//! ```text
//!  J_pose = | nᵀ  n·(c' − p)⊥ |     J_line = | −1  −d·(c' − c) |
//!           | 0   1           |              |  0  −1          |
//! ```
//!
//! R, `ObservationNoise`, is that of the observation alone. Who estimates the line together with the pose, the filter, has the
//! line's covariance in its state and uses R. Who does not, the tracker, must count the line's error as noise: the `Residual` has
//! R + J_line·P_line·J_lineᵀ.

use nalgebra::{Matrix2, Matrix2x3, Matrix3, Point2, Vector2};

use crate::geometry::line_noise::{LineNoise, fitted_variances};
use crate::geometry::math::min;
use crate::geometry::pose::{cross, perpendicular};
use crate::geometry::segment::Segment;

/// R of an observation, diagonal: variances of offset (m²) and direction (rad²).
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct ObservationNoise {
    /// By the points of the segment.
    points: [f32; 2],
    /// By what does not average out over points.
    line: [f32; 2],
}

impl ObservationNoise {
    /// Of a segment, in whatever frame, that is observed where the map has a line.
    pub fn new(observed: &Segment, mapped: &Segment, noise: &LineNoise) -> Self {
        let length_m = min(observed.length_m(), mapped.length_m());
        Self { points: fitted_variances(observed), line: [noise.var_offset(), noise.var_direction(length_m)] }
    }

    /// Both variances; infinite where the segment has no extent.
    pub fn variances(&self) -> [f32; 2] {
        let ([offset, direction], [line_offset, line_direction]) = (self.points, self.line);
        [offset + line_offset, direction + line_direction]
    }
}

/// An observed segment against a line of the map, linear in pose and line.
#[derive(Clone, Copy, Debug)]
pub(crate) struct LineObservation {
    /// Observed minus expected: offset (m) and direction (rad).
    pub residual: [f32; 2],
    /// J_pose, by (x, y, θ).
    pub by_pose: [[f32; 3]; 2],
    /// J_line, by the offset and the direction of the map's line.
    pub by_line: [[f32; 2]; 2],
    /// R.
    pub noise: ObservationNoise,
}

impl LineObservation {
    /// `observed` is in `map`, carried there by some pose; J_pose is that of a pose at `position`.
    pub fn new(observed: &Segment, mapped: &Segment, position: Point2<f32>, noise: ObservationNoise) -> Self {
        let (normal, centroid) = (mapped.normal(), observed.moments.centroid);
        Self {
            residual: [
                normal.dot(&(centroid - mapped.moments.centroid)),
                cross(mapped.direction, observed.direction),
            ],
            by_pose: by_pose(normal, centroid - position),
            by_line: [[-1.0, -mapped.along_of(centroid)], [0.0, -1.0]],
            noise,
        }
    }

    /// The same to somebody who does not estimate the line: the variances that `mapped` carries become noise. `None` for lines
    /// without extent.
    pub fn given_pose_only(&self, mapped: &Segment) -> Option<Residual> {
        let [var_map_offset, var_map_angle] = fitted_variances(mapped);
        let along = -self.by_line[0][1];
        let ObservationNoise { points, line } = self.noise;
        let var_offset = points[0] + var_map_offset + along * along * var_map_angle + line[0];
        let var_angle = points[1] + var_map_angle + line[1];
        // A map line turned by δ is along·δ away at the observed centroid: both numbers have that in common.
        let common = along * var_map_angle;
        let [[x, y, lever], [_, _, turn]] = self.by_pose;
        (var_offset.is_finite() && var_angle.is_finite()).then(|| Residual {
            error: Vector2::from(self.residual),
            jacobian: Matrix2x3::new(x, y, lever, 0.0, 0.0, turn),
            covariance: Matrix2::new(var_offset, common, common, var_angle),
        })
    }
}

/// J_pose of a line with this normal, at a point this far from the robot that carries it.
pub(crate) fn by_pose(normal: Vector2<f32>, from_robot: Vector2<f32>) -> [[f32; 3]; 2] {
    [[normal.x, normal.y, normal.dot(&perpendicular(from_robot))], [0.0, 0.0, 1.0]]
}

/// An observation against a line that is not estimated, linear in the pose.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Residual {
    /// Offset (m) and direction (rad).
    pub error: Vector2<f32>,
    /// By (x, y, θ) of the pose.
    pub jacobian: Matrix2x3<f32>,
    /// R + J_line·P_line·J_lineᵀ.
    pub covariance: Matrix2<f32>,
}

impl Residual {
    /// `observed` is in `map`, through the pose whose position is given. `None` for lines without extent.
    pub fn new(
        observed: &Segment,
        mapped: &Segment,
        position: Point2<f32>,
        noise: &LineNoise,
    ) -> Option<Self> {
        let noise = ObservationNoise::new(observed, mapped, noise);
        LineObservation::new(observed, mapped, position, noise).given_pose_only(mapped)
    }

    /// Inverse covariance.
    pub fn information(&self) -> Option<Matrix2<f32>> {
        self.covariance.try_inverse()
    }

    /// Squared Mahalanobis distance, with the pose's own covariance allowed for.
    pub fn chi2(&self, pose_covariance: &Matrix3<f32>) -> f32 {
        let total = self.covariance + self.jacobian * pose_covariance * self.jacobian.transpose();
        total.try_inverse().map_or(f32::INFINITY, |w| self.error.dot(&(w * self.error)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::line_noise::with_variances;
    use crate::geometry::pose::pose;
    use crate::geometry::segment::Moments;
    use proptest::prelude::*;

    fn wall(points: usize, noise: impl Fn(usize) -> f32) -> Segment {
        let point = |i: usize| Point2::new(2.0 + noise(i), -1.0 + 2.0 * i as f32 / (points - 1) as f32);
        let moments = Moments::from_points((0..points).map(|i| (point(i), 1.0e4)));
        Segment::fitted(moments, &[point(0), point(points - 1)], Point2::origin())
    }

    const NOISE: LineNoise = LineNoise { sigma_offset_m: 0.0, sigma_direction_rad: 0.0 };

    fn observation(observed: &Segment, mapped: &Segment, c: [f32; 3]) -> LineObservation {
        let pose = pose(c[0], c[1], c[2]);
        let noise = ObservationNoise::new(observed, mapped, &NOISE);
        LineObservation::new(&observed.transformed(&pose), mapped, pose.translation.vector.into(), noise)
    }

    /// The direction's residual is a sine, of which the slope is the cosine.
    fn slope_is(
        plus: &LineObservation,
        minus: &LineObservation,
        h: f32,
        column: [f32; 2],
        angle: f32,
    ) -> bool {
        let slope = |k: usize| (plus.residual[k] - minus.residual[k]) / (2.0 * h);
        (slope(0) - column[0]).abs() < 2e-3 && (slope(1) - column[1] * angle.cos()).abs() < 2e-3
    }

    proptest! {
        #[test]
        fn both_jacobians_are_the_finite_difference(
            x in -1.0f32..1.0,
            y in -1.0f32..1.0,
            a in -0.3f32..0.3,
            mapped_from in -3.1f32..3.1,
        ) {
            // The wall lies in any direction, and the robot is where it sees it so.
            let to = pose(0.3, -0.2, mapped_from);
            let mapped = wall(40, |i| 0.003 * (i as f32).sin()).transformed(&to);
            let observed = wall(20, |i| 0.004 * (2.0 * i as f32).cos());
            let c = [x, y, mapped_from + a];
            let at = observation(&observed, &mapped, c);
            let angle = at.residual[1].asin();
            let h = 1e-2;
            for k in 0..3 {
                let step = |h: f32| {
                    let mut c = c;
                    c[k] += h;
                    observation(&observed, &mapped, c)
                };
                let column = at.by_pose.map(|row| row[k]);
                prop_assert!(slope_is(&step(h), &step(-h), h, column, angle), "pose {k}: {at:?}");
            }
            for k in 0..2 {
                let step = |h: f32| {
                    let moved = if k == 0 { mapped.shifted(h, 0.0) } else { mapped.shifted(0.0, h) };
                    observation(&observed, &moved, c)
                };
                let column = at.by_line.map(|row| row[k]);
                prop_assert!(slope_is(&step(h), &step(-h), h, column, angle), "line {k}: {at:?}");
            }
        }

        /// To somebody who does not estimate the line, its covariance is noise like any other.
        #[test]
        fn a_line_that_is_not_estimated_is_noise(
            x in -1.0f32..1.0,
            y in -1.0f32..1.0,
            a in -0.3f32..0.3,
            var_offset in 1e-6f32..1e-2,
            var_direction in 1e-6f32..1e-2,
        ) {
            let mapped = with_variances(&wall(40, |_| 0.0), var_offset, var_direction);
            let at = observation(&wall(20, |_| 0.0), &mapped, [x, y, a]);
            let [r_offset, r_direction] = at.noise.variances();
            let by_line = Matrix2::from(at.by_line).transpose();
            let expected = Matrix2::new(r_offset, 0.0, 0.0, r_direction)
                + by_line * Matrix2::new(var_offset, 0.0, 0.0, var_direction) * by_line.transpose();
            let got = at.given_pose_only(&mapped).unwrap().covariance;
            prop_assert!((got - expected).amax() < 1e-5 * expected.amax(), "{got} {expected}");
        }
    }

    #[test]
    fn a_line_without_extent_says_nothing() {
        let point = wall(2, |_| 0.0).transformed(&pose(0.0, 0.0, 0.0));
        let mut point = Segment { end: point.start, ..point };
        point.moments.scatter = [0.0; 3];
        let whole = wall(20, |_| 0.0);
        for (observed, mapped) in [(&point, &whole), (&whole, &point)] {
            assert!(Residual::new(observed, mapped, Point2::origin(), &NOISE).is_none());
        }
        assert!(!ObservationNoise::new(&point, &whole, &NOISE).variances()[1].is_finite());
    }

    /// The information of the two residuals is that of all points about the pose.
    #[test]
    fn information_is_that_of_point_to_line_least_squares() {
        let mut map = wall(40, |_| 0.0);
        map = with_variances(&map, 1e-12, 1e-12); // a map line known perfectly
        let observed = wall(25, |_| 0.0);
        let position = Point2::new(0.3, -0.2);
        let r = Residual::new(&observed, &map, position, &NOISE).unwrap();
        let information = r.jacobian.transpose() * r.information().unwrap() * r.jacobian;
        let mut reference = nalgebra::Matrix3::<f64>::zeros();
        for i in 0..25 {
            let p = Point2::new(2.0, -1.0 + 2.0 * f64::from(i) / 24.0);
            let ry = p.y - f64::from(position.y);
            // Normal (-1, 0): derivative of -(x component) by the pose.
            let j = nalgebra::RowVector3::new(-1.0, 0.0, ry);
            reference += j.transpose() * j * 1.0e4;
        }
        for (got, want) in information.iter().zip(reference.iter()) {
            assert!((f64::from(*got) - want).abs() < 1e-3 * reference.norm(), "{information} {reference}");
        }
    }
}
