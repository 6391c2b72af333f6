//! Ranges to points: each beam is placed where the sensor was when that beam was taken.
//!
//! In: ranges in `laser`, the motion of the base during the sweep. Out: points in `base` as it stood at the middle
//! beam, in beam order, obstacles only.
//!
//! Between two knots of the sweep (4 ms for a URG-04LX) the sensor's pose is interpolated linearly; at 3 rad/s that
//! leaves less than 20 µrad of bearing error. The paper takes the scan as instantaneous.

use heapless::VecView;
use nalgebra::{Complex, Point2};

use crate::geometry::math::sin_cos;
use crate::odometry::track::{SWEEP_KNOTS, ScanMotion};
use crate::sensor::scan::{Reading, Scan, SensorConfig};

/// Most beams left out behind one that is placed.
const MOST_LEFT_OUT: usize = 2;

/// How scans are turned into points.
#[derive(Clone, Copy, Debug, PartialEq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct DeskewConfig {
    /// Whether the motion during the sweep is undone.
    pub enabled: bool,
}

/// An obstacle that one beam saw.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ScanPoint {
    /// Where, in `base` at the middle beam, metres.
    pub position: Point2<f32>,
    /// Range measured, metres.
    pub range_m: f32,
    /// Index of the beam in the scan.
    pub beam: u16,
}

/// What became of the beams.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct DeskewReport {
    /// Beams with a distance, placed.
    pub points: u32,
    /// Beams left out.
    pub left_out: u32,
    /// Beams that saw nothing in range.
    pub no_echo: u32,
    /// Beams with an error code.
    pub bad: u32,
}

/// Places the beams of a scan. Up to two beams behind each one placed are left out where a surface that faces the sensor
/// has its points no farther apart than `spacing_m` then; zero places all. Work: one step for each beam placed or without
/// a distance.
pub fn deskew(
    scan: &Scan<'_>,
    motion: &ScanMotion,
    sensor: &SensorConfig,
    config: &DeskewConfig,
    spacing_m: f32,
    points: &mut VecView<ScanPoint>,
) -> DeskewReport {
    points.clear();
    let mut report = DeskewReport::default();
    let beams = scan.ranges_mm.len();
    let knot_of_beam = (SWEEP_KNOTS - 1) as f32 / beams.saturating_sub(1).max(1) as f32;
    let first = sensor.geometry.first_step;
    let (used_from, used_to) = sensor.used_steps;
    let begin = usize::from(used_from.saturating_sub(first));
    let end = (usize::from(used_to) + 1).saturating_sub(usize::from(first)).min(beams);
    let used = scan.ranges_mm.get(..end).unwrap_or_default();
    let plain = sensor.codes.plain_distances();
    let step_rad = sensor.geometry.step_rad();
    // Behind a point nearer than each of these one beam more is left out.
    let nearer_than_m: [f32; MOST_LEFT_OUT] =
        core::array::from_fn(|k| spacing_m / (step_rad * (k + 2) as f32));
    let mut interval = Interval::new(motion, sensor, config, 0);
    let side = if sensor.mounting.upside_down { -1.0 } else { 1.0 };
    let unit = |angle_rad: f32| {
        let (s, c) = sin_cos(angle_rad);
        Complex::new(c, side * s)
    };
    let (mut beam, mut direction) = (begin, unit(sensor.geometry.bearing(begin)));
    let turns: [_; MOST_LEFT_OUT + 1] = core::array::from_fn(|k| unit(step_rad * (k + 1) as f32));
    while let Some(&value_mm) = used.get(beam) {
        let reading = if plain.contains(&value_mm) {
            Reading::Range(f32::from(value_mm) * 1e-3)
        } else {
            sensor.codes.read(value_mm)
        };
        let mut left_out = 0;
        match reading {
            Reading::Range(range_m) => {
                let knot = beam as f32 * knot_of_beam;
                let mut share = knot - interval.knot;
                if share >= 1.0 {
                    interval = Interval::new(motion, sensor, config, (knot as usize).min(SWEEP_KNOTS - 2));
                    share = knot - interval.knot;
                    // From beam to beam by turning, from knot to knot anew: what rounding turns stays below 10 µrad.
                    direction = unit(sensor.geometry.bearing(beam));
                }
                let position = interval.place(direction * range_m, share);
                if points.push(ScanPoint { position, range_m, beam: beam as u16 }).is_err() {
                    break;
                }
                left_out = nearer_than_m.iter().filter(|limit| range_m < **limit).count();
            }
            Reading::NoEcho => report.no_echo += 1,
            Reading::Bad => report.bad += 1,
        }
        direction *= turns.get(left_out).copied().unwrap_or_default();
        beam += 1 + left_out;
    }
    report.points = points.len() as u32;
    let looked_at = report.points + report.no_echo + report.bad;
    report.left_out = (end.saturating_sub(begin) as u32).saturating_sub(looked_at);
    report
}

/// The sensor's pose within one piece of the sweep: at its beginning, and what it changes by until its end.
struct Interval {
    /// Number of the knot at its beginning.
    knot: f32,
    at: [f32; 4],
    by: [f32; 4],
}

impl Interval {
    fn new(motion: &ScanMotion, sensor: &SensorConfig, config: &DeskewConfig, index: usize) -> Self {
        let knot = |k: usize| {
            let pose = match motion.middle_from_knot.get(k) {
                Some(middle_from_knot) if config.enabled => {
                    middle_from_knot * sensor.mounting.base_from_laser
                }
                _ => sensor.mounting.base_from_laser,
            };
            [pose.rotation.re, pose.rotation.im, pose.translation.x, pose.translation.y]
        };
        let (at, next) = (knot(index), knot(index + 1));
        let mut by = next;
        by.iter_mut().zip(&at).for_each(|(to, from)| *to -= from);
        Self { knot: index as f32, at, by }
    }

    #[inline]
    fn place(&self, in_laser: Complex<f32>, share: f32) -> Point2<f32> {
        let ([c, s, x, y], [by_c, by_s, by_x, by_y]) = (self.at, self.by);
        let (c, s, x, y) = (c + by_c * share, s + by_s * share, x + by_x * share, y + by_y * share);
        Point2::new(c * in_laser.re - s * in_laser.im + x, s * in_laser.re + c * in_laser.im + y)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::SlamConfig;
    use crate::geometry::pose::{exp, pose};
    use crate::odometry::Increment;
    use heapless::Vec;
    use nalgebra::{Vector2, Vector3};

    fn run(sensor: &SensorConfig, ranges_mm: &[u16], motion: &ScanMotion) -> Vec<ScanPoint, 682> {
        let mut points = Vec::<ScanPoint, 682>::new();
        let config = DeskewConfig { enabled: true };
        deskew(&Scan { ranges_mm }, motion, sensor, &config, 0.0, &mut points);
        points
    }

    fn still() -> ScanMotion {
        ScanMotion::instantaneous(Increment::identity())
    }

    #[test]
    fn front_beam_lies_ahead_of_the_sensor() {
        let mut ranges = [1u16; 682];
        ranges[340] = 2000;
        let sensor = SlamConfig::paper().sensor;
        let points = run(&sensor, &ranges, &still());
        assert_eq!(points.len(), 1);
        assert!((points[0].position - Point2::new(2.14, 0.0)).norm() < 1e-6);
    }

    #[test]
    fn beams_close_to_each_other_are_left_out() {
        let sensor = SlamConfig::paper().sensor;
        // 0.06 m are the spacing of each third beam at 3.26 m, of each second one at 4.89 m.
        for (range_mm, stride) in [(1000, 3), (3200, 3), (3300, 2), (4800, 2), (4900, 1), (5600, 1)] {
            let mut points = Vec::<ScanPoint, 682>::new();
            let (scan, config) = (Scan { ranges_mm: &[range_mm; 682] }, DeskewConfig { enabled: true });
            let report = deskew(&scan, &still(), &sensor, &config, 0.06, &mut points);
            assert_eq!((points.len(), report.points), (682usize.div_ceil(stride), points.len() as u32));
            let all = run(&sensor, scan.ranges_mm, &still());
            for (placed, plain) in points.iter().zip(all.iter().step_by(stride)) {
                assert!((placed.position - plain.position).norm() < 1e-4 && placed.beam == plain.beam);
            }
        }
        let mut points = Vec::<ScanPoint, 682>::new();
        let mut ranges_mm = [1000; 682];
        (ranges_mm[3], ranges_mm[4], ranges_mm[7]) = (0, 16, 6);
        let (scan, config) = (Scan { ranges_mm: &ranges_mm }, DeskewConfig { enabled: true });
        let report = deskew(&scan, &still(), &sensor, &config, 0.06, &mut points);
        assert_eq!(report.points + report.left_out + report.no_echo + report.bad, 682);
        // Behind a beam without a distance the next one is looked at.
        let placed: [u16; 3] = core::array::from_fn(|k| points[k].beam);
        assert_eq!((report.no_echo, report.bad, placed), (1, 1, [0, 5, 8]));
    }

    #[test]
    fn upside_down_and_yaw_move_the_beam() {
        let mut ranges = [1u16; 682];
        ranges[340 + 256] = 1000;
        let mut sensor = SlamConfig::paper().sensor;
        sensor.mounting.base_from_laser = pose(0.0, 0.0, 0.0);
        assert!((run(&sensor, &ranges, &still())[0].position - Point2::new(0.0, 1.0)).norm() < 1e-5);
        sensor.mounting.upside_down = true;
        assert!((run(&sensor, &ranges, &still())[0].position - Point2::new(0.0, -1.0)).norm() < 1e-5);
        sensor.mounting.base_from_laser = pose(0.0, 0.0, core::f32::consts::FRAC_PI_2);
        assert!((run(&sensor, &ranges, &still())[0].position - Point2::new(1.0, 0.0)).norm() < 1e-5);
    }

    /// A robot that turns and drives while the scanner sweeps sees a straight wall straight.
    #[test]
    fn a_wall_seen_while_turning_is_straight_after_deskew() {
        let sensor = SlamConfig::default().sensor;
        let twist = Vector3::new(0.5, 0.0, 2.6);
        let geometry = sensor.geometry;
        let sweep_s = geometry.sweep_us() as f32 * 1e-6;
        let mut motion = still();
        for (k, knot) in motion.middle_from_knot.iter_mut().enumerate() {
            *knot = exp(&(twist * sweep_s * (k as f32 / (SWEEP_KNOTS - 1) as f32 - 0.5)));
        }
        // Wall: x = 2 in base at the middle beam.
        let mut ranges = [0u16; 682];
        for (beam, range) in ranges.iter_mut().enumerate() {
            let at = exp(&(twist * sweep_s * (beam as f32 / 681.0 - 0.5))) * sensor.mounting.base_from_laser;
            let (s, c) = sin_cos(geometry.bearing(beam));
            let direction = at.rotation * Vector2::new(c, s);
            let distance = (2.0 - at.translation.x) / direction.x;
            if distance > 0.0 && distance < 5.0 {
                *range = (distance * 1000.0 + 0.5) as u16;
            }
        }
        let points = run(&sensor, &ranges, &motion);
        assert!(points.len() > 300);
        let worst = points.iter().map(|p| (p.position.x - 2.0).abs()).fold(0.0, f32::max);
        assert!(worst < 0.001, "worst point {worst} m off the wall");
        let skewed = run(&sensor, &ranges, &still());
        let worst = skewed.iter().map(|p| (p.position.x - 2.0).abs()).fold(0.0, f32::max);
        assert!(worst > 0.1, "without de-skew the wall is bent, {worst} m");
    }
}
