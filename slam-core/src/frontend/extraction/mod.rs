//! Points to line segments.
//!
//! In: the points of a scan in `base`, in beam order. Out: at most [`MAX_SEGMENTS`] segments in `base`, in beam
//! order for [`split`], in the order found for [`ransac`].
//!
//! The paper (section 2.1) draws lines by RANSAC through all points of the scan and cuts them afterwards. The default
//! cuts first: in scan order, at gaps and corners, so that no line can join what the scanner saw apart.

pub mod split;
mod strip;

use heapless::VecView;
use nalgebra::Point2;

pub use split::SplitConfig;

use crate::frontend::deskew::ScanPoint;
use crate::geometry::segment::Segment;
use crate::paper::ransac::{self, RansacConfig};
use crate::sensor::scan::SensorConfig;

/// Most segments kept of one scan: 64, 52 bytes each.
pub const MAX_SEGMENTS: usize = 64;

/// How points become segments.
#[derive(Clone, Copy, Debug, PartialEq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize), serde(rename_all = "snake_case"))]
pub enum ExtractionConfig {
    /// Section 2.1 of the paper.
    Ransac(RansacConfig),
    /// Split and merge in scan order.
    Split(SplitConfig),
}

/// What the extraction did.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct ExtractionReport {
    /// Segments found and kept.
    pub segments: u32,
    /// Segments that found no room among [`MAX_SEGMENTS`]; those with the fewest inliers go.
    pub crowded_out: u32,
}

/// Extracts the segments of a scan.
///
/// `scan_number` seeds RANSAC, so that a scan gives the same segments wherever and whenever it is processed.
pub fn extract(
    points: &[ScanPoint],
    sensor: &SensorConfig,
    config: &ExtractionConfig,
    scan_number: u32,
    segments: &mut VecView<Segment>,
) -> ExtractionReport {
    segments.clear();
    let view = Viewpoint::new(sensor);
    let mut out = Collector { segments, report: ExtractionReport::default() };
    match config {
        ExtractionConfig::Ransac(config) => ransac::extract(points, &view, config, scan_number, &mut out),
        ExtractionConfig::Split(config) => split::extract(points, &view, config, &mut out),
    }
    out.report.segments = out.segments.len() as u32;
    out.report
}

/// Segments found so far, the weakest giving way when there is no room.
pub(crate) struct Collector<'a> {
    segments: &'a mut VecView<Segment>,
    report: ExtractionReport,
}

impl Collector<'_> {
    pub(crate) fn push(&mut self, segment: Segment) {
        if !segment.is_finite() {
            return;
        }
        let Err(segment) = self.segments.push(segment) else { return };
        self.report.crowded_out += 1;
        if let Some(weakest) = self.segments.iter_mut().min_by_key(|s| s.moments.inliers)
            && weakest.moments.inliers < segment.moments.inliers
        {
            *weakest = segment;
        }
    }
}

/// The sensor and where it stood at the middle beam, in `base`.
pub(crate) struct Viewpoint<'a> {
    pub sensor: &'a SensorConfig,
    pub position: Point2<f32>,
}

impl<'a> Viewpoint<'a> {
    pub(crate) fn new(sensor: &'a SensorConfig) -> Self {
        Self { sensor, position: sensor.mounting.base_from_laser.translation.vector.into() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::SlamConfig;
    use heapless::Vec;
    use nalgebra::Vector2;
    use std::vec::Vec as StdVec;

    /// Variance of a point across a surface with this unit normal, m², written plainly: range noise acts along the beam, the beam's own
    /// uncertain bearing and its width across it.
    pub(super) fn variance_across(point: &ScanPoint, normal: Vector2<f32>, view: &Viewpoint<'_>) -> f32 {
        let (noise, range2) = (&view.sensor.noise, point.range_m * point.range_m);
        let along_beam = normal.dot(&(point.position - view.position));
        let cos2 = (along_beam * along_beam / range2).min(1.0);
        noise.variance(point.range_m) * cos2
            + noise.sigma_bearing_rad * noise.sigma_bearing_rad * range2 * (1.0 - cos2)
    }

    /// Both ends.
    type Wall = ((f32, f32), (f32, f32));

    /// Beams of a URG-04LX at the origin against walls given as end points; `noise_m` along the beam, from a seed.
    fn scan(walls: &[Wall], noise_m: f32) -> StdVec<ScanPoint> {
        use rand_core::{Rng, SeedableRng};
        let mut rng = rand_pcg::Pcg32::seed_from_u64(3);
        let mut gauss = || (0..12).map(|_| rng.next_u32() as f32 / u32::MAX as f32).sum::<f32>() - 6.0;
        let geometry = crate::sensor::scan::ScanGeometry::URG_04LX;
        let mut points = StdVec::new();
        for beam in 0..geometry.beams() {
            let (s, c) = crate::geometry::math::sin_cos(geometry.bearing(beam));
            let direction = Vector2::new(c, s);
            let hit = walls.iter().filter_map(|&((x1, y1), (x2, y2))| {
                let (from, along) = (Vector2::new(x1, y1), Vector2::new(x2 - x1, y2 - y1));
                let denominator = crate::geometry::pose::cross(direction, along);
                let range = crate::geometry::pose::cross(from, along) / denominator;
                let share = crate::geometry::pose::cross(from, direction) / denominator;
                ((0.0..=1.0).contains(&share) && range > 0.0).then_some(range)
            });
            let range = hit.fold(f32::INFINITY, f32::min);
            if range < 5.6 {
                let range_m = range + noise_m * gauss();
                points.push(ScanPoint { position: (direction * range_m).into(), range_m, beam: beam as u16 });
            }
        }
        points
    }

    pub(super) fn sensor() -> SensorConfig {
        let mut sensor = SlamConfig::default().sensor;
        sensor.mounting.base_from_laser = nalgebra::Isometry2::identity();
        sensor
    }

    fn run(points: &[ScanPoint], config: &ExtractionConfig) -> StdVec<Segment> {
        let mut segments: Vec<Segment, MAX_SEGMENTS> = Vec::new();
        extract(points, &sensor(), config, 0, &mut segments);
        segments.iter().copied().collect()
    }

    const ROOM: [Wall; 3] =
        [((-1.5, -2.0), (2.5, -2.0)), ((2.5, -2.0), (2.5, 1.8)), ((2.5, 1.8), (-1.5, 1.8))];

    #[test]
    fn a_room_gives_its_walls() {
        for config in [SlamConfig::default().extraction, SlamConfig::paper().extraction] {
            let segments = run(&scan(&ROOM, 0.01), &config);
            let long: StdVec<&Segment> = segments.iter().filter(|s| s.length_m() > 1.0).collect();
            assert_eq!(long.len(), 3, "{config:?}: {segments:?}");
            for (x, y) in [(0.5, -2.0), (2.5, 0.0), (0.5, 1.8)] {
                let on = |s: &&&Segment| s.line().signed_distance(Point2::new(x, y)).abs() < 0.01;
                assert_eq!(long.iter().filter(on).count(), 1, "{config:?}: one wall through {x} {y}");
            }
            for segment in long {
                assert!(
                    segment.line().signed_distance(Point2::origin()) > 0.0,
                    "the free side is the sensor's"
                );
            }
        }
    }

    #[test]
    fn corners_are_where_walls_meet() {
        let segments = run(&scan(&ROOM, 0.005), &SlamConfig::default().extraction);
        for corner in [Point2::new(2.5, -2.0), Point2::new(2.5, 1.8)] {
            let near = |s: &Segment| (s.start - corner).norm().min((s.end - corner).norm()) < 0.06;
            assert_eq!(segments.iter().filter(|s| near(s)).count(), 2, "{segments:?}");
        }
    }

    #[test]
    fn no_line_crosses_a_gap() {
        // A wall with a door, and a second surface in line with it, as seen through the door.
        let walls = [((2.0, -1.5), (2.0, -0.4)), ((2.0, 0.5), (2.0, 1.5)), ((4.0, -1.0), (4.0, 1.2))];
        for segment in run(&scan(&walls, 0.01), &SlamConfig::default().extraction) {
            let crosses =
                segment.start.y.min(segment.end.y) < -0.45 && segment.start.y.max(segment.end.y) > 0.55;
            assert!(!crosses || segment.midpoint().x > 3.5, "{segment:?}");
        }
    }

    #[test]
    fn round_and_scattered_things_are_no_walls() {
        let post: StdVec<_> = (0..24)
            .map(|k| {
                let at = |k: i32| {
                    let (s, c) = crate::geometry::math::sin_cos(k as f32 * core::f32::consts::PI / 12.0);
                    (2.0 + 0.12 * c, 0.12 * s)
                };
                (at(k), at(k + 1))
            })
            .collect();
        let segments = run(&scan(&post, 0.005), &SlamConfig::default().extraction);
        assert!(segments.iter().all(|s| s.length_m() < 0.25), "{segments:?}");
    }

    /// A round post of this radius, seen from the origin.
    fn post(centre: (f32, f32), radius_m: f32) -> StdVec<Wall> {
        let at = |k: i32| {
            let (s, c) = crate::geometry::math::sin_cos(k as f32 * core::f32::consts::PI / 24.0);
            (centre.0 + radius_m * c, centre.1 + radius_m * s)
        };
        (0..48).map(|k| (at(k), at(k + 1))).collect()
    }

    #[test]
    fn round_things_give_no_segments_and_boxes_do() {
        let config = SlamConfig::default().extraction;
        for (distance, radius_m) in [(1.5, 0.2), (2.5, 0.22), (3.0, 0.3), (4.0, 0.3), (4.0, 0.45)] {
            let noise_m = 0.01f32.max(0.01 * distance);
            let segments = run(&scan(&post((distance, 0.3), radius_m), noise_m), &config);
            assert!(segments.is_empty(), "{radius_m} m at {distance} m: {segments:?}");
        }
        for distance in [1.5, 2.5, 3.5] {
            let (x, y, half) = (distance + 0.35, 0.2, 0.35);
            // On its edge, and turned to the robot.
            let edge = [((x, y + half), (x - half, y)), ((x - half, y), (x, y - half))];
            let face = [((x - half, y - half), (x - half, y + half))];
            let noise_m = 0.01f32.max(0.01 * distance);
            assert_eq!(run(&scan(&edge, noise_m), &config).len(), 2, "box at {distance} m");
            assert_eq!(run(&scan(&face, noise_m), &config).len(), 1, "face at {distance} m");
        }
        // From inside a bay is a bay.
        let bay: StdVec<Wall> = post((0.0, 0.0), 0.45);
        assert!(!run(&scan(&bay, 0.01), &config).is_empty());
    }

    #[test]
    fn covariance_of_a_line_is_that_of_its_noise() {
        let points = scan(&[((2.0, -1.0), (2.0, 1.0))], 0.0);
        let segments = run(&points, &SlamConfig::default().extraction);
        let moments = segments[0].moments;
        // Closed form: σ² of the range times cos² of the incidence, and of the bearing for the rest.
        let noise = sensor().noise;
        let variance = |p: &ScanPoint| {
            let cos2 = (2.0 / p.range_m).powi(2);
            noise.variance(p.range_m) * cos2 + (noise.sigma_bearing_rad * p.range_m).powi(2) * (1.0 - cos2)
        };
        let expected: f32 = points.iter().map(|p| 1.0 / variance(p)).sum();
        assert!((moments.weight / expected - 1.0).abs() < 1e-3, "{} {expected}", moments.weight);
        let lever: f32 =
            points.iter().map(|p| (p.position.y - moments.centroid.y).powi(2) / variance(p)).sum();
        assert!((moments.scatter_along(segments[0].direction) / lever - 1.0).abs() < 1e-3);
    }

    /// A wall seen at an angle: a plain total-least-squares fit turns it by 0.026° on average, always the same way.
    #[test]
    fn oblique_walls_are_not_turned_by_noise() {
        use rand_core::{Rng, SeedableRng};
        let wall = [((0.9, -2.0), (4.7, -2.0))];
        let clean = scan(&wall, 0.0);
        let mut rng = rand_pcg::Pcg32::seed_from_u64(11);
        let mut gauss = || (0..12).map(|_| rng.next_u32() as f32 / u32::MAX as f32).sum::<f32>() - 6.0;
        let (mut sum, runs) = (0.0f64, 4000);
        for _ in 0..runs {
            let noisy: StdVec<ScanPoint> = clean
                .iter()
                .map(|p| {
                    let range_m = p.range_m + gauss() * sensor().noise.variance(p.range_m).sqrt();
                    ScanPoint { position: p.position * (range_m / p.range_m), range_m, ..*p }
                })
                .collect();
            let segments = run(&noisy, &SlamConfig::default().extraction);
            let longest = segments.iter().max_by_key(|s| s.moments.inliers).unwrap();
            sum += f64::from(longest.direction.y.atan2(longest.direction.x));
        }
        let mean_deg = (sum / f64::from(runs)).to_degrees();
        // The standard error of the mean is 0.002°.
        assert!(mean_deg.abs() < 0.012, "turned by {mean_deg:.4}°");
    }

    #[test]
    fn more_segments_than_room_for_drop_the_weakest() {
        let mut segments: Vec<Segment, 2> = Vec::new();
        let mut collector = Collector { segments: &mut segments, report: ExtractionReport::default() };
        for inliers in [10, 5, 7, 3] {
            let (from, to) = (Point2::new(1.0, 0.0), Point2::new(1.0, 1.0));
            collector.push(Segment::from_ends(from, to, inliers, 1e-4, Point2::origin()));
        }
        let crowded_out = collector.report.crowded_out;
        let kept: StdVec<u32> = segments.iter().map(|s| s.moments.inliers).collect();
        assert_eq!((kept, crowded_out), (std::vec![10, 7], 2));
    }

    #[test]
    fn nothing_gives_nothing() {
        for config in [SlamConfig::default().extraction, SlamConfig::paper().extraction] {
            assert!(run(&[], &config).is_empty());
            assert!(run(&scan(&ROOM, 0.0)[..1], &config).is_empty());
        }
    }
}
