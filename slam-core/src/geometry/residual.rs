//! How far an observed segment is from a map segment, and how sure that is.
//!
//! Two numbers: the distance of the observed centroid from the map's line, and the angle between the lines. Together
//! with the sums behind each segment they carry all that the points say about the pose: the least squares over the
//! points and this pair of residuals have the same minimum and the same information. Along the line nothing is said.

use nalgebra::{Matrix2, Matrix2x3, Matrix3, Point2, Vector2};

use crate::geometry::line_noise::LineNoise;
use crate::geometry::math::min;
use crate::geometry::pose::{cross, perpendicular};
use crate::geometry::segment::Segment;

/// Residual of one pair, linear in the pose.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Residual {
    /// Distance of the observed centroid from the map's line (m) and angle from the map's direction (rad).
    pub error: Vector2<f32>,
    /// Derivative by (x, y, θ) of the pose.
    pub jacobian: Matrix2x3<f32>,
    /// Covariance of the error, pose aside.
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
        let normal = mapped.normal();
        let centroid = observed.moments.centroid;
        let offset = normal.dot(&(centroid - mapped.moments.centroid));
        // sin of the angle: the angle itself to 0.5 % within the widest direction gate.
        let angle = cross(mapped.direction, observed.direction);
        let along = mapped.along_of(centroid);

        let mapped_scatter = mapped.moments.scatter_along(mapped.direction);
        let observed_scatter = observed.moments.scatter_along(observed.direction);
        let var = |information: f32| if information > 0.0 { 1.0 / information } else { f32::INFINITY };
        let (var_map_angle, var_observed_angle) = (var(mapped_scatter), var(observed_scatter));
        let var_offset = var(observed.moments.weight)
            + var(mapped.moments.weight)
            + along * along * var_map_angle
            + noise.var_offset();
        let var_angle = var_observed_angle
            + var_map_angle
            + noise.var_direction(min(observed.length_m(), mapped.length_m()));
        // A map line turned by δ is along·δ away at the observed centroid: both errors have that in common.
        let common = along * var_map_angle;
        if !(var_offset.is_finite() && var_angle.is_finite()) {
            return None;
        }
        let lever = normal.dot(&perpendicular(centroid - position));
        Some(Self {
            error: Vector2::new(offset, angle),
            jacobian: Matrix2x3::new(normal.x, normal.y, lever, 0.0, 0.0, 1.0),
            covariance: Matrix2::new(var_offset, common, common, var_angle),
        })
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
    use crate::geometry::pose::pose;
    use crate::geometry::segment::Moments;
    use proptest::prelude::*;

    fn wall(points: usize, noise: impl Fn(usize) -> f32) -> Segment {
        let point = |i: usize| Point2::new(2.0 + noise(i), -1.0 + 2.0 * i as f32 / (points - 1) as f32);
        let moments = Moments::from_points((0..points).map(|i| (point(i), 1.0e4)));
        Segment::fitted(moments, &[point(0), point(points - 1)], Point2::origin())
    }

    const NOISE: LineNoise = LineNoise { sigma_offset_m: 0.0, sigma_direction_rad: 0.0 };

    proptest! {
        #[test]
        fn jacobian_is_the_finite_difference(x in -1.0f32..1.0, y in -1.0f32..1.0, a in -0.1f32..0.1) {
            let map = wall(40, |i| 0.003 * (i as f32).sin());
            let observed = wall(20, |i| 0.004 * (2.0 * i as f32).cos());
            let error = |dx: f32, dy: f32, da: f32| {
                let pose = pose(x + dx, y + dy, a + da);
                let r = Residual::new(&observed.transformed(&pose), &map, pose.translation.vector.into(), &NOISE);
                r.unwrap()
            };
            let at = error(0.0, 0.0, 0.0);
            let h = 1e-2;
            for (column, (p, m)) in [
                (error(h, 0.0, 0.0), error(-h, 0.0, 0.0)),
                (error(0.0, h, 0.0), error(0.0, -h, 0.0)),
                (error(0.0, 0.0, h), error(0.0, 0.0, -h)),
            ].into_iter().enumerate() {
                let slope = (p.error - m.error) / (2.0 * h);
                // The angle residual is a sine: its slope is the cosine.
                prop_assert!((slope - at.jacobian.column(column)).norm() < 2e-2, "{} {}", slope, at.jacobian);
            }
        }
    }

    /// The information of the two residuals is that of all points about the pose.
    #[test]
    fn information_is_that_of_point_to_line_least_squares() {
        let mut map = wall(40, |_| 0.0);
        map = crate::geometry::line_noise::with_variances(&map, 1e-12, 1e-12); // a map line known perfectly
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
