//! A LaserScan message: its ranges, the instant of its middle beam, how its beams lie.

use std::f64::consts::{PI, TAU};

use super::messages::{Header, LaserScan};
use crate::robot::StatedGeometry;

/// A scan's sweep lasts no longer than this; what says more is wrong.
const LONGEST_SWEEP_S: f64 = 10.0;
/// No scanner's beams go around further than this; rounding and what closes the turn allowed for.
const WIDEST_RAD: f64 = 1.02 * TAU;

/// What a scan states beside its ranges.
#[derive(Clone, Copy, Debug)]
pub struct Stated {
    /// How the beams lie; the mounting is left open.
    pub geometry: StatedGeometry,
    /// From the first beam's instant to the middle beam's, nanoseconds.
    pub to_middle_ns: i64,
}

/// What a scan states, checked; the error says what makes no sense.
pub fn stated(scan: &LaserScan<Header>) -> Result<Stated, String> {
    let beams = scan.ranges.len();
    if beams == 0 {
        return Err("the scan has no ranges".into());
    }
    let last = (beams - 1) as f64;
    let step = step_rad(scan, last)?;
    if !scan.angle_min.is_finite() || step.abs() * last > WIDEST_RAD {
        let (from, step) = (scan.angle_min, step.to_degrees());
        return Err(format!("{beams} beams from {from} rad on, {step}° apart, are no scan"));
    }
    let time_increment = f64::from(scan.time_increment);
    let sweep_s = time_increment * last;
    let between_s = if (0.0..=LONGEST_SWEEP_S).contains(&sweep_s) { time_increment } else { 0.0 };
    // Of a single beam the sweep is zero whatever the increment says.
    let revolution_s = Some(between_s * TAU / step.abs()).filter(|s| (0.0..=1e3).contains(s)).unwrap_or(0.0);
    let limits = [scan.range_min, scan.range_max];
    let sane = limits[0] >= 0.0 && limits[1] > limits[0] && limits[1].is_finite();
    Ok(Stated {
        geometry: StatedGeometry {
            first_bearing_rad: scan.angle_min,
            step_rad: step as f32,
            revolution_s: revolution_s as f32,
            limits_m: sane.then_some(limits),
            base_from_laser: None,
            upside_down: false,
        },
        to_middle_ns: (between_s * last / 2.0 * 1e9).round() as i64,
    })
}

/// The angle from beam to beam, signed; from the scan's ends where it is not stated.
fn step_rad(scan: &LaserScan<Header>, last: f64) -> Result<f64, String> {
    let stated = f64::from(scan.angle_increment);
    if stated.is_finite() && stated != 0.0 {
        return Ok(stated);
    }
    let between = (f64::from(scan.angle_max) - f64::from(scan.angle_min)) / last;
    if between.is_finite() && between != 0.0 {
        return Ok(between);
    }
    Err(format!("angle_increment is {stated} and angle_max {} does not tell it either", scan.angle_max))
}

/// Nanoseconds to microseconds, to the nearest.
pub fn to_us(ns: i64) -> i64 {
    ns.saturating_add(500).div_euclid(1000)
}

/// Whether the step is the 180° of a SICK divided by the beams less one, where its beams are 1° or 0.5° apart.
pub fn divided_field(beams: usize, step_rad: f32) -> bool {
    let divided = PI / (beams.max(2) - 1) as f64;
    matches!(beams, 180 | 360) && (f64::from(step_rad.abs()) / divided - 1.0).abs() <= 1e-5
}

#[cfg(test)]
mod tests {
    use super::*;

    fn scan(beams: usize) -> LaserScan<Header> {
        LaserScan {
            header: Header { stamp_ns: 1, frame: "laser".into() },
            angle_min: -1.5,
            angle_max: 1.5,
            angle_increment: 0.01,
            time_increment: 1e-4,
            scan_time: 0.1,
            range_min: 0.1,
            range_max: 5.0,
            ranges: vec![1.0; beams],
        }
    }

    #[test]
    fn the_sweep_is_stated_or_taken_as_none() {
        let stated_of = |scan: &LaserScan<Header>| stated(scan).unwrap();
        let good = stated_of(&scan(301));
        assert_eq!(good.to_middle_ns, (f64::from(1e-4f32) * 150.0 * 1e9).round() as i64);
        assert!((good.geometry.revolution_s - 0.062_831_86).abs() < 1e-6);
        for wrong in [-1e-4, 0.5, f32::NAN, f32::INFINITY, f32::MAX] {
            let none = stated_of(&LaserScan { time_increment: wrong, ..scan(301) });
            assert_eq!((none.to_middle_ns, none.geometry.revolution_s), (0, 0.0), "{wrong}");
        }
    }

    #[test]
    fn a_missing_increment_is_taken_from_the_ends() {
        let between = stated(&LaserScan { angle_increment: 0.0, ..scan(301) }).unwrap();
        assert!((between.geometry.step_rad - 0.01).abs() < 1e-7);
        assert!(stated(&LaserScan { angle_increment: f32::NAN, angle_max: -1.5, ..scan(301) }).is_err());
        assert!(stated(&LaserScan { angle_increment: 0.0, ..scan(1) }).is_err());
        assert!(stated(&scan(0)).is_err());
        assert!(stated(&LaserScan { angle_increment: 0.1, ..scan(301) }).is_err());
        assert!(stated(&LaserScan { angle_min: f32::NAN, ..scan(301) }).is_err());
    }

    #[test]
    fn limits_that_make_no_sense_are_left_out() {
        let limits = |range_min, range_max| {
            stated(&LaserScan { range_min, range_max, ..scan(9) }).unwrap().geometry.limits_m
        };
        assert_eq!(limits(0.1, 5.0), Some([0.1, 5.0]));
        for (least, most) in [(5.0, 5.0), (-1.0, 5.0), (0.0, f32::INFINITY), (f32::NAN, 5.0), (0.0, 0.0)] {
            assert_eq!(limits(least, most), None, "{least} {most}");
        }
    }

    #[test]
    fn a_sick_of_which_the_field_was_divided_is_known() {
        assert!(divided_field(180, (PI / 179.0) as f32));
        assert!(divided_field(360, -(PI / 359.0) as f32));
        assert!(!divided_field(360, (PI / 360.0) as f32));
        assert!(!divided_field(361, (PI / 360.0) as f32));
    }
}
