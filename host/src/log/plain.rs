//! The plain format, for robots whose recordings have no other: JSON lines, an object a line, as docs/logs.md describes them.
//!
//! ```text
//! {"lineslam_log": 1, "sensor": {"first_bearing_deg": -90, "step_deg": 0.5}, "wheels": {…}}
//! {"t_us": 1000000, "ticks": [0, 0]}
//! {"t_us": 1033300, "ranges_mm": [1200, 1201, …]}
//! ```

use std::fmt::Write;

use serde::{Deserialize, Serialize};

use super::records::{BAD_MM, Records, ScanRecord, Source};
use super::{Defect, Log, Odometry, RangeUnit, ReadOptions, StampUnit};
use crate::robot::{Robot, StatedGeometry, Wheels};

/// Version of the format that is written, and the newest that is read.
const VERSION: u32 = 1;
/// Most beams of one scan.
const MOST_BEAMS: usize = 65_536;

/// The first line. Everything but the version may be left out.
#[derive(Debug, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
struct Header {
    lineslam_log: u32,
    #[serde(skip_serializing_if = "Option::is_none")]
    robot: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    sensor: Option<PlainSensor>,
    #[serde(skip_serializing_if = "Option::is_none")]
    wheels: Option<Wheels>,
}

/// How beams lie, and where the scanner sits.
#[derive(Clone, Copy, Debug, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
struct PlainSensor {
    first_bearing_deg: f32,
    step_deg: f32,
    #[serde(default)]
    revolution_s: f32,
    min_range_m: Option<f32>,
    max_range_m: Option<f32>,
    /// x and y in metres ahead and left of the axle's middle, yaw in degrees.
    mounting: Option<[f32; 3]>,
    #[serde(default)]
    upside_down: bool,
}

impl PlainSensor {
    fn geometry(&self) -> Result<StatedGeometry, Defect> {
        let numbers = [self.first_bearing_deg, self.step_deg, self.revolution_s];
        let sane = numbers.iter().all(|v| v.is_finite())
            && self.step_deg != 0.0
            && self.step_deg.abs() <= 360.0
            && (0.0..=10.0).contains(&self.revolution_s)
            && self.mounting.is_none_or(|m| m.iter().all(|v| v.is_finite()));
        if !sane {
            return Err(Defect::Malformed("sensor: no scanner has these numbers".into()));
        }
        Ok(StatedGeometry {
            first_bearing_rad: self.first_bearing_deg.to_radians(),
            step_rad: self.step_deg.to_radians(),
            revolution_s: self.revolution_s,
            limits_m: self.max_range_m.map(|most| [self.min_range_m.unwrap_or(0.0), most]),
            base_from_laser: self.mounting.map(|[x, y, yaw]| [x, y, yaw.to_radians()]),
            upside_down: self.upside_down,
        })
    }
}

/// Any other line: a time, and what was read then.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Reading {
    t_us: f64,
    ticks: Option<[i64; 2]>,
    pose: Option<[f64; 3]>,
    ranges_mm: Option<Vec<Option<f64>>>,
    ranges_m: Option<Vec<Option<f64>>>,
    sensor: Option<PlainSensor>,
}

/// Whether a line could be of this format.
pub fn looks_like(text: &str) -> bool {
    text.starts_with('{')
}

/// Reads line after line.
pub struct Parser {
    us_per_unit: f64,
    ranges: Option<RangeUnit>,
    geometry: Option<StatedGeometry>,
}

impl Parser {
    /// As the options say.
    pub fn new(options: &ReadOptions<'_>) -> Self {
        let us_per_unit = options.stamps.unwrap_or(StampUnit::Us).us();
        Self { us_per_unit, ranges: options.ranges, geometry: None }
    }

    /// Reads a line.
    pub fn line(&mut self, line: usize, text: &str, records: &mut Records) -> Result<(), Defect> {
        // Columns are all that the parser says of the place, and the line is known.
        let malformed =
            |error: serde_json::Error| Defect::Malformed(error.to_string().replace(" at line 1", ""));
        if text.contains("\"lineslam_log\"") {
            let header: Header = serde_json::from_str(text).map_err(malformed)?;
            if header.lineslam_log != VERSION {
                let what =
                    format!("version {} of the format is not known, only {VERSION}", header.lineslam_log);
                return Err(Defect::Malformed(what));
            }
            self.geometry = header.sensor.map(|sensor| sensor.geometry()).transpose()?;
            records.wheels = header.wheels;
            return Ok(());
        }
        let reading: Reading = serde_json::from_str(text).map_err(malformed)?;
        let stamp_us = (reading.t_us * self.us_per_unit).round();
        if !stamp_us.is_finite() || stamp_us.abs() > 1e18 {
            return Err(Defect::NotANumber { field: "t_us", word: reading.t_us.to_string() });
        }
        let stamp_us = stamp_us as i64;
        let scan = match (reading.ranges_mm, reading.ranges_m) {
            (None, None) => None,
            (Some(ranges), None) => Some((ranges, self.ranges.unwrap_or(RangeUnit::Mm))),
            (None, Some(ranges)) => Some((ranges, self.ranges.unwrap_or(RangeUnit::M))),
            (Some(_), Some(_)) => {
                return Err(Defect::Malformed("ranges_mm and ranges_m in one line".into()));
            }
        };
        let source = if scan.is_some() { Source::Scan } else { Source::Own };
        let odometry = match (reading.ticks, reading.pose) {
            (None, None) => None,
            (Some(ticks), None) => Some(Odometry::Ticks(ticks)),
            (None, Some(pose)) => Some(Odometry::Pose(pose)),
            (Some(_), Some(_)) => return Err(Defect::Malformed("ticks and pose in one line".into())),
        };
        if scan.is_none() && odometry.is_none() {
            return Err(Defect::Malformed("neither ticks, pose, ranges_mm nor ranges_m".into()));
        }
        if let Some(odometry) = odometry {
            records.odometry(line, stamp_us, source, odometry);
        }
        if let Some((ranges, unit)) = scan {
            if ranges.len() > MOST_BEAMS {
                return Err(Defect::BeamCount { expected: MOST_BEAMS, actual: ranges.len() });
            }
            let geometry = match reading.sensor {
                Some(sensor) => Some(sensor.geometry()?),
                None => self.geometry,
            };
            let mm = |range: Option<f64>| range.map_or(BAD_MM, |range| records.range_mm(range, unit.mm()));
            let ranges_mm = ranges.into_iter().map(mm).collect();
            let geometry = geometry.map(|geometry| records.geometry(geometry));
            records.scans.push(ScanRecord { place: line, stamp_us, ranges_mm, geometry });
        }
        Ok(())
    }
}

/// Writes a log. What is known of the robot goes into its first line; a robot file says the rest.
pub fn render(log: &Log, robot: &Robot) -> String {
    let sensor = robot.sensor_for(&log.layout(0));
    let (codes, mounting) = (sensor.codes, sensor.mounting);
    let c = slam_core::geometry::pose::components(&mounting.base_from_laser);
    let stated = StatedGeometry {
        first_bearing_rad: sensor.geometry.bearing(0),
        step_rad: sensor.geometry.step_rad(),
        revolution_s: sensor.geometry.revolution_us as f32 * 1e-6,
        limits_m: Some([codes.min_mm, codes.max_mm.saturating_add(1)].map(|mm| f32::from(mm) * 1e-3)),
        base_from_laser: Some([c.x, c.y, c.z]),
        upside_down: mounting.upside_down,
    };
    let mut text = header(&robot.name, &stated, robot.wheels);
    let mut odometry = log.odometry.iter().peekable();
    for scan in &log.scans {
        while let Some((stamp_us, reading)) = odometry.next_if(|(stamp_us, _)| *stamp_us < scan.stamp_us) {
            line(&mut text, *stamp_us, Some(reading), None);
        }
        let beside = odometry.next_if(|(stamp_us, _)| *stamp_us == scan.stamp_us);
        line(&mut text, scan.stamp_us, beside.map(|(_, reading)| reading), Some(&scan.ranges_mm));
    }
    odometry.for_each(|(stamp_us, reading)| line(&mut text, *stamp_us, Some(reading), None));
    text
}

/// The first line.
pub fn header(robot: &str, stated: &StatedGeometry, wheels: Option<Wheels>) -> String {
    let header = Header {
        lineslam_log: VERSION,
        robot: Some(robot.to_owned()),
        sensor: Some(PlainSensor {
            first_bearing_deg: stated.first_bearing_rad.to_degrees(),
            step_deg: stated.step_rad.to_degrees(),
            revolution_s: stated.revolution_s,
            min_range_m: stated.limits_m.map(|[least, _]| least),
            max_range_m: stated.limits_m.map(|[_, most]| most),
            mounting: stated.base_from_laser.map(|[x, y, yaw]| [x, y, yaw.to_degrees()]),
            upside_down: stated.upside_down,
        }),
        wheels,
    };
    // Numbers and names always have a form in JSON.
    let mut text = serde_json::to_string(&header).unwrap_or_default();
    text.push('\n');
    text
}

/// Any other line.
pub fn line(text: &mut String, stamp_us: u64, odometry: Option<&Odometry>, ranges_mm: Option<&[u16]>) {
    // Writing to a String cannot fail.
    let _ = write!(text, "{{\"t_us\":{stamp_us}");
    let _ = match odometry {
        Some(Odometry::Ticks([left, right])) => write!(text, ",\"ticks\":[{left},{right}]"),
        Some(Odometry::Pose([x, y, theta])) => write!(text, ",\"pose\":[{x:?},{y:?},{theta:?}]"),
        // No log of ours has angles; a bag's are not written again.
        Some(Odometry::Angles(_)) | None => Ok(()),
    };
    if let Some(ranges_mm) = ranges_mm {
        let words: Vec<String> = ranges_mm.iter().map(u16::to_string).collect();
        let _ = write!(text, ",\"ranges_mm\":[{}]", words.join(","));
    }
    text.push_str("}\n");
}
