//! Points along a line: sums in the line's own frame, which need one pass and no square roots.
//!
//! Coordinates are `s` along the line and `o` off it. As the points of a line lie near it, their offsets keep all their
//! digits in `f32`, and a sum over some of the points is the difference of two sums.

use nalgebra::{Point2, Vector2};

use super::Viewpoint;
use crate::frontend::deskew::ScanPoint;
use crate::geometry::math::{max, sqrt};
use crate::geometry::pose::perpendicular;
use crate::geometry::segment::Moments;

/// The variance of a point across a surface, prepared for many points: range noise acts along the beam, the beam's own
/// uncertain bearing and its width across it.
///
/// With β the angle between beam and normal it is σ²(r)·cos²β + σ_bearing²·r²·sin²β, where r·cosβ is the sensor's distance from
/// the surface.
#[derive(Clone, Copy, Debug)]
pub(super) struct VarianceAcross {
    floor: f32,
    growth: f32,
    bearing: f32,
}

impl VarianceAcross {
    pub fn new(view: &Viewpoint<'_>) -> Self {
        let noise = &view.sensor.noise;
        let square = |v: f32| v * v;
        let bearing = square(noise.sigma_bearing_rad);
        Self { floor: square(noise.sigma_m), growth: square(noise.sigma_per_m) - bearing, bearing }
    }

    /// The variance times the square of the range; given are the squares of the range and of the surface's distance from
    /// the sensor.
    #[inline]
    pub fn times_range2(&self, range2: f32, distance2: f32) -> f32 {
        self.bearing * range2 * range2 + distance2 * (self.floor + self.growth * range2)
    }
}

/// A line, and where the sensor is from it.
#[derive(Clone, Copy, Debug)]
pub(super) struct Frame {
    origin: Point2<f32>,
    pub along: Vector2<f32>,
    pub normal: Vector2<f32>,
    /// Of the line from the sensor along the normal, metres.
    pub distance_m: f32,
}

impl Frame {
    fn new(origin: Point2<f32>, along: Vector2<f32>, view: &Viewpoint<'_>) -> Self {
        let normal = perpendicular(along);
        Self { origin, along, normal, distance_m: normal.dot(&(origin - view.position)) }
    }

    /// The line from the first to the last point; `None` where they coincide.
    pub fn of_chord(points: &[ScanPoint], view: &Viewpoint<'_>) -> Option<Self> {
        let (first, last) = (points.first()?.position, points.last()?.position);
        let chord = last - first;
        let length = sqrt(chord.norm_squared());
        (length > 0.0).then(|| Self::new(first, chord / length, view))
    }

    /// The line through a point in some direction: for points that have none.
    pub fn of_point(point: Point2<f32>, view: &Viewpoint<'_>) -> Self {
        Self::new(point, -Vector2::y(), view)
    }

    /// The line that was fitted.
    pub fn of_fit(fit: &Moments, view: &Viewpoint<'_>) -> Self {
        Self::new(fit.centroid, fit.direction(), view)
    }

    /// Offset of a point, metres.
    #[inline]
    pub fn off(&self, point: &ScanPoint) -> f32 {
        self.normal.dot(&(point.position - self.origin))
    }

    /// Sums over points, each weighed by the noise it has across a surface that lies along this line.
    pub fn sums(&self, points: &[ScanPoint], variance: &VarianceAcross) -> Sums {
        let mut sums = Sums::default();
        points.iter().for_each(|point| self.add(point, variance, &mut sums));
        sums
    }

    /// Adds a point to such sums.
    #[inline]
    pub fn add(&self, point: &ScanPoint, variance: &VarianceAcross, sums: &mut Sums) {
        let from_origin = point.position - self.origin;
        let (s, o) = (self.along.dot(&from_origin), self.normal.dot(&from_origin));
        let range2 = point.range_m * point.range_m;
        let distance = self.distance_m + o;
        sums.add(s, o, range2 / variance.times_range2(range2, distance * distance));
    }

    /// Sums over the points of a line that is nearly known, free of two biases of a plain fit. Points more than so many standard
    /// deviations off are left out.
    ///
    /// Range noise moves a point along its beam: off the line, and along it by an amount that depends on the first. Seen at
    /// an angle, that correlation turns a total-least-squares line by σ²·sinβ·cosβ over the variance along it, always the
    /// same way. So each point is taken where its beam meets the known line, off it by what it was off. And the noise is
    /// taken for the range of the known line: taken for the range measured, points too near would weigh more.
    pub fn refined_sums(
        &self,
        points: &[ScanPoint],
        view: &Viewpoint<'_>,
        variance: &VarianceAcross,
        sigmas: f32,
    ) -> Sums {
        let mut sums = Sums::default();
        let view_along = self.along.dot(&(view.position - self.origin));
        let (distance2, sigmas2) = (self.distance_m * self.distance_m, sigmas * sigmas);
        for point in points {
            let beam = point.position - view.position;
            let across = self.normal.dot(&beam);
            let off = across - self.distance_m;
            let share = self.distance_m / across;
            let range = point.range_m * share;
            let range2 = range * range;
            let scaled = variance.times_range2(range2, distance2);
            // False where the beam runs along the line, and `share` is no number.
            if off * off * range2 <= sigmas2 * scaled {
                sums.add(view_along + share * self.along.dot(&beam), off, range2 / scaled);
            }
        }
        sums
    }

    /// The sums as they are outside of this frame.
    pub fn moments(&self, sums: &Sums) -> Moments {
        if sums.inliers == 0 {
            return Moments::EMPTY;
        }
        let (a, n) = (self.along, self.normal);
        let [ss, so, oo] = sums.central();
        Moments {
            inliers: sums.inliers,
            weight: sums.weight,
            centroid: self.origin + a * (sums.s / sums.weight) + n * (sums.o / sums.weight),
            scatter: [
                a.x * a.x * ss + 2.0 * a.x * n.x * so + n.x * n.x * oo,
                a.x * a.y * ss + (a.x * n.y + a.y * n.x) * so + n.x * n.y * oo,
                a.y * a.y * ss + 2.0 * a.y * n.y * so + n.y * n.y * oo,
            ],
        }
    }
}

/// Weighted sums over points in a [`Frame`].
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Sums {
    pub inliers: u32,
    weight: f32,
    s: f32,
    o: f32,
    ss: f32,
    so: f32,
    oo: f32,
}

impl Sums {
    #[inline]
    fn add(&mut self, s: f32, o: f32, weight: f32) {
        let (ws, wo) = (weight * s, weight * o);
        self.inliers += 1;
        self.weight += weight;
        self.s += ws;
        self.o += wo;
        self.ss += ws * s;
        self.so += ws * o;
        self.oo += wo * o;
    }

    /// The sums over the points that another, over some of them, leaves out.
    pub fn without(&self, some: &Self) -> Self {
        Self {
            inliers: self.inliers - some.inliers,
            weight: self.weight - some.weight,
            s: self.s - some.s,
            o: self.o - some.o,
            ss: self.ss - some.ss,
            so: self.so - some.so,
            oo: self.oo - some.oo,
        }
    }

    /// Central second moments: along, mixed, off.
    fn central(&self) -> [f32; 3] {
        let (s, o) = (self.s / self.weight, self.o / self.weight);
        [self.ss - self.s * s, self.so - self.s * o, self.oo - self.o * o]
    }

    /// χ² of the line that fits best, regressed on the frame's.
    pub fn residual(&self) -> f32 {
        let [ss, so, oo] = self.central();
        max(if ss > 0.0 { oo - so * so / ss } else { oo }, 0.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::SlamConfig;
    use crate::frontend::extraction::tests::variance_across;
    use proptest::prelude::*;
    use std::vec::Vec;

    /// Points near a line that the sensor sees from the origin.
    fn wall() -> impl Strategy<Value = Vec<ScanPoint>> {
        let offsets = proptest::collection::vec(-0.03f32..0.03, 3..80);
        (offsets, 0.3f32..4.0, -2.0f32..2.0, -3.0f32..3.0).prop_map(|(offsets, distance, begin, turn)| {
            let at = crate::geometry::pose::pose(0.0, 0.0, turn);
            let points = offsets.iter().enumerate().map(|(k, off)| {
                let position = at * Point2::new(distance + off, begin + 0.02 * k as f32);
                ScanPoint { position, range_m: position.coords.norm(), beam: k as u16 }
            });
            points.collect()
        })
    }

    proptest! {
        #[test]
        fn the_variance_is_the_plain_one(points in wall()) {
            let sensor = crate::frontend::extraction::tests::sensor();
            let view = Viewpoint::new(&sensor);
            let frame = Frame::of_chord(&points, &view).unwrap();
            let prepared = VarianceAcross::new(&view);
            for point in &points {
                let range2 = point.range_m * point.range_m;
                let distance = frame.distance_m + frame.off(point);
                let got = prepared.times_range2(range2, distance * distance) / range2;
                let want = variance_across(point, frame.normal, &view);
                prop_assert!((got / want - 1.0).abs() < 1e-3, "{} {}", got, want);
            }
        }

        #[test]
        fn the_sums_are_the_plain_ones(points in wall(), cut in 1usize..80) {
            let sensor = crate::frontend::extraction::tests::sensor();
            let view = Viewpoint::new(&sensor);
            let frame = Frame::of_chord(&points, &view).unwrap();
            let prepared = VarianceAcross::new(&view);
            let plain = |points: &[ScanPoint]| {
                Moments::from_points(
                    points.iter().map(|p| (p.position, 1.0 / variance_across(p, frame.normal, &view))),
                )
            };
            let all = frame.sums(&points, &prepared);
            let (a, b) = points.split_at(cut.min(points.len() - 1));
            let first = frame.sums(a, &prepared);
            for (sums, points) in [(all, &*points), (first, a), (all.without(&first), b)] {
                let (got, want) = (frame.moments(&sums), plain(points));
                prop_assert_eq!(got.inliers, want.inliers);
                prop_assert!((got.centroid - want.centroid).norm() < 1e-4);
                prop_assert!((got.weight / want.weight - 1.0).abs() < 1e-3);
                let scale = want.scatter[0] + want.scatter[2] + 1e-3 * all.weight;
                for (g, w) in got.scatter.iter().zip(want.scatter) {
                    prop_assert!((g - w).abs() < 2e-3 * scale, "{} {}", g, w);
                }
            }
            // In f64, from the same weights.
            let (mut w, mut s, mut o, mut ss, mut so, mut oo) = (0.0f64, 0.0, 0.0, 0.0, 0.0, 0.0);
            for p in &points {
                let d = p.position - points[0].position;
                let along = f64::from(d.x) * f64::from(frame.along.x) + f64::from(d.y) * f64::from(frame.along.y);
                let off = f64::from(d.x) * f64::from(frame.normal.x) + f64::from(d.y) * f64::from(frame.normal.y);
                let weight = 1.0 / f64::from(variance_across(p, frame.normal, &view));
                (w, s, o) = (w + weight, s + weight * along, o + weight * off);
                (ss, so, oo) = (ss + weight * along * along, so + weight * along * off, oo + weight * off * off);
            }
            let (ss, so, oo) = (ss - s * s / w, so - s * o / w, oo - o * o / w);
            let want = oo - so * so / ss;
            prop_assert!((f64::from(all.residual()) - want).abs() < 0.02 + 0.01 * want, "{} {}", all.residual(), want);
        }
    }

    #[test]
    fn a_beam_along_the_line_and_no_points_at_all_give_no_numbers_that_are_none() {
        let sensor = SlamConfig::default().sensor;
        let view = Viewpoint::new(&sensor);
        let variance = VarianceAcross::new(&view);
        let at = |x: f32| ScanPoint { position: Point2::new(0.14 + x, 0.0), range_m: x, beam: 0 };
        let points = [at(1.0), at(2.0), at(3.0)];
        let frame = Frame::of_chord(&points, &view).unwrap();
        let sums = frame.refined_sums(&points, &view, &variance, 4.0);
        assert_eq!((sums.inliers, frame.moments(&sums)), (0, Moments::EMPTY));
        assert!(Frame::of_chord(&[at(1.0), at(2.0), at(1.0)], &view).is_none());
    }
}
