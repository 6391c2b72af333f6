//! Robot files: wheels, encoders, scanner and mounting, in TOML.
//!
//! Every key is needed and no other is known, so that a slip of the pen is an error that names it, with the file.

use std::path::Path;

use serde::{Deserialize, Serialize};
use slam_core::SlamConfig;
use slam_core::odometry::{DifferentialDrive, OdometryNoise, ticks_between_u16, ticks_between_u32};
use slam_core::pose::pose;
use slam_core::scan::{Mounting, RangeCodes, RangeNoise, ScanGeometry, SensorConfig};

use crate::toml_file::{self, Checked, FileError, Impossible, finite, not_negative, positive};

/// A robot, as its file describes it.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Robot {
    /// What it is called in reports.
    pub name: String,
    /// Wheels and encoders; logs that bring poses need none.
    pub wheels: Option<Wheels>,
    /// Growth of the odometry's uncertainty.
    pub odometry_noise: NoiseFile,
    /// The scanner.
    pub sensor: Sensor,
    /// Where the scanner sits.
    pub mounting: MountingFile,
    /// Whether nobody described this robot: what a log states goes before it.
    #[serde(skip)]
    pub usual: bool,
}

/// `[wheels]`
#[derive(Clone, Copy, Debug, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct Wheels {
    /// Radius of the left wheel, metres.
    pub left_radius_m: f32,
    /// Radius of the right wheel, metres.
    pub right_radius_m: f32,
    /// Distance between the wheels, metres.
    pub track_m: f32,
    /// Counter steps for one turn of a wheel.
    pub ticks_per_turn: f32,
    /// Width of the counters, after which they wrap: 16 or 32.
    pub counter_bits: u8,
}

impl Wheels {
    /// Ticks of the left and right wheel between two readings of counters this wide.
    pub fn ticks_between(&self, before: [i64; 2], after: [i64; 2]) -> [i32; 2] {
        [0, 1].map(|side| match self.counter_bits {
            16 => ticks_between_u16(before[side] as u16, after[side] as u16),
            _ => ticks_between_u32(before[side] as u32, after[side] as u32),
        })
    }
}

/// `[odometry_noise]`, standard deviations that grow with the square root of the way.
#[derive(Clone, Copy, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct NoiseFile {
    along_m_per_sqrt_m: f32,
    across_m_per_sqrt_m: f32,
    heading_deg_per_sqrt_m: f32,
    /// Degrees for each square root of a degree turned.
    heading_deg_per_sqrt_turn_deg: f32,
    position_floor_m: f32,
    heading_floor_deg: f32,
}

impl NoiseFile {
    /// All that grows with the way, so many times as large.
    #[must_use]
    pub fn times(&self, factor: f32) -> Self {
        Self {
            along_m_per_sqrt_m: factor * self.along_m_per_sqrt_m,
            across_m_per_sqrt_m: factor * self.across_m_per_sqrt_m,
            heading_deg_per_sqrt_m: factor * self.heading_deg_per_sqrt_m,
            heading_deg_per_sqrt_turn_deg: factor * self.heading_deg_per_sqrt_turn_deg,
            ..*self
        }
    }
}

/// `[sensor]`
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Sensor {
    /// What it is, for people.
    pub model: String,
    min_range_mm: u32,
    max_range_mm: u32,
    no_echo_mm: Vec<[u32; 2]>,
    sigma_m: f32,
    sigma_per_m: f32,
    /// Standard deviation of a beam's bearing, degrees.
    sigma_bearing_deg: f32,
    /// Standard deviation of what does not average out over a line's points, metres.
    line_sigma_m: f32,
    /// Time from the middle beam to the stamp logged with the scan, seconds.
    pub scan_delay_s: f64,
    steps: Option<Steps>,
    field: Option<Field>,
}

/// `[sensor.steps]`: a scanner whose beams are known beforehand, in SCIP's terms.
#[derive(Clone, Copy, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Steps {
    first: u16,
    last: u16,
    front: u16,
    per_revolution: f32,
    revolution_s: f64,
    used: [u16; 2],
}

/// `[sensor.field]`: a scanner whose number of beams the log states.
#[derive(Clone, Copy, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Field {
    of_view_deg: f32,
}

/// `[mounting]`
#[derive(Clone, Copy, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MountingFile {
    x_m: f32,
    y_m: f32,
    yaw_deg: f32,
    upside_down: bool,
}

/// Beams, limits and mounting that a log states itself. They stand in for what no robot file says.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StatedGeometry {
    /// Bearing of the first beam in `laser`, radians.
    pub first_bearing_rad: f32,
    /// Angle from beam to beam, radians; negative where the beams run clockwise.
    pub step_rad: f32,
    /// Time of a whole revolution, seconds; zero where all beams may be taken as simultaneous.
    pub revolution_s: f32,
    /// Least and greatest distance, metres; what is at the greatest or beyond met nothing.
    pub limits_m: Option<[f32; 2]>,
    /// Pose of the scanner on the robot (x, y, yaw), metres and radians.
    pub base_from_laser: Option<[f32; 3]>,
    /// Whether the scanner hangs head down.
    pub upside_down: bool,
}

/// How the beams of one scan lie, as far as a log tells.
#[derive(Clone, Copy, Debug)]
pub struct ScanLayout<'a> {
    /// Ranges of this scan.
    pub beams: usize,
    /// Ranges of most scans of the log, over which a robot file's field of view is spread.
    pub commonest: usize,
    /// What the log states.
    pub stated: Option<&'a StatedGeometry>,
}

impl ScanLayout<'_> {
    /// A scan of a log in which all are alike and nothing is stated.
    pub fn plain(beams: usize) -> Self {
        Self { beams, commonest: beams, stated: None }
    }
}

impl Checked for Robot {
    fn check(&self) -> Result<(), Impossible> {
        if let Some(w) = &self.wheels {
            positive("wheels.left_radius_m", w.left_radius_m)?;
            positive("wheels.right_radius_m", w.right_radius_m)?;
            positive("wheels.track_m", w.track_m)?;
            positive("wheels.ticks_per_turn", w.ticks_per_turn)?;
            if w.counter_bits != 16 && w.counter_bits != 32 {
                return Err((
                    "wheels.counter_bits".into(),
                    format!("{} is neither 16 nor 32", w.counter_bits),
                ));
            }
        }
        let n = &self.odometry_noise;
        not_negative("odometry_noise.along_m_per_sqrt_m", n.along_m_per_sqrt_m)?;
        not_negative("odometry_noise.across_m_per_sqrt_m", n.across_m_per_sqrt_m)?;
        not_negative("odometry_noise.heading_deg_per_sqrt_m", n.heading_deg_per_sqrt_m)?;
        not_negative("odometry_noise.heading_deg_per_sqrt_turn_deg", n.heading_deg_per_sqrt_turn_deg)?;
        positive("odometry_noise.position_floor_m", n.position_floor_m)?;
        positive("odometry_noise.heading_floor_deg", n.heading_floor_deg)?;
        self.check_sensor()?;
        let m = &self.mounting;
        finite("mounting.x_m", m.x_m)?;
        finite("mounting.y_m", m.y_m)?;
        finite("mounting.yaw_deg", m.yaw_deg)
    }
}

impl Robot {
    /// Reads and checks a robot file.
    pub fn load(path: &Path) -> Result<Self, FileError> {
        toml_file::load(path)
    }

    /// The robot that a format's logs were recorded with, built in: `robots/mines.toml`, `robots/sick.toml`, or
    /// `robots/paper.toml` for simulated ones.
    pub fn usual_for(format: &str) -> Self {
        let (text, name) = match format {
            "mines" => (include_str!("../../robots/mines.toml"), "robots/mines.toml"),
            "simulated" => (include_str!("../../robots/paper.toml"), "robots/paper.toml"),
            _ => (include_str!("../../robots/sick.toml"), "robots/sick.toml"),
        };
        let robot: Self = toml_file::parse(text, Path::new(name)).expect("the built-in robots are tested");
        Self { usual: true, ..robot }
    }

    fn check_sensor(&self) -> Result<(), Impossible> {
        let s = &self.sensor;
        if s.max_range_mm <= s.min_range_mm {
            let reason = format!("{} is not above min_range_mm = {}", s.max_range_mm, s.min_range_mm);
            return Err(("sensor.max_range_mm".into(), reason));
        }
        if s.max_range_mm > u32::from(u16::MAX) {
            return Err(("sensor.max_range_mm".into(), format!("{} is above 65535", s.max_range_mm)));
        }
        if s.no_echo_mm.len() > 2 {
            return Err((
                "sensor.no_echo_mm".into(),
                format!("{} intervals, at most 2 are possible", s.no_echo_mm.len()),
            ));
        }
        if let Some([from, to]) = s.no_echo_mm.iter().find(|[from, to]| from > to) {
            return Err(("sensor.no_echo_mm".into(), format!("interval [{from}, {to}] is empty")));
        }
        positive("sensor.sigma_m", s.sigma_m)?;
        not_negative("sensor.sigma_per_m", s.sigma_per_m)?;
        positive("sensor.sigma_bearing_deg", s.sigma_bearing_deg)?;
        positive("sensor.line_sigma_m", s.line_sigma_m)?;
        if !(-10.0..=10.0).contains(&s.scan_delay_s) {
            return Err(("sensor.scan_delay_s".into(), format!("{} is not within ±10 s", s.scan_delay_s)));
        }
        match (&s.steps, &s.field) {
            (Some(steps), None) => steps.check(),
            (None, Some(field)) if field.of_view_deg > 0.0 && field.of_view_deg <= 360.0 => Ok(()),
            (None, Some(field)) => Err((
                "sensor.field.of_view_deg".into(),
                format!("{} is not within 0 to 360", field.of_view_deg),
            )),
            _ => Err(("sensor".into(), "needs either [sensor.steps] or [sensor.field]".into())),
        }
    }

    /// Wheel geometry for the core.
    pub fn drive(&self) -> Option<DifferentialDrive> {
        self.wheels.map(|w| DifferentialDrive {
            left_wheel_radius_m: w.left_radius_m,
            right_wheel_radius_m: w.right_radius_m,
            track_m: w.track_m,
            ticks_per_turn: w.ticks_per_turn,
        })
    }

    /// Number of ranges a scan must have, where the robot file says so.
    pub fn beams(&self) -> Option<usize> {
        self.sensor.steps.map(|s| s.geometry().beams())
    }

    /// The default configuration on this robot; a URG's beams where the file does not state them.
    pub fn config(&self) -> SlamConfig {
        let mut config = SlamConfig::default();
        let beams = self.beams().unwrap_or(ScanGeometry::URG_04LX.beams());
        self.apply(&mut config, &ScanLayout::plain(beams));
        config
    }

    /// Puts this robot into a configuration, for scans of this layout.
    pub fn apply(&self, config: &mut SlamConfig, layout: &ScanLayout<'_>) {
        let n = &self.odometry_noise;
        config.odometry.noise = OdometryNoise {
            sigma_along_m_per_sqrt_m: n.along_m_per_sqrt_m,
            sigma_across_m_per_sqrt_m: n.across_m_per_sqrt_m,
            sigma_heading_rad_per_sqrt_m: n.heading_deg_per_sqrt_m.to_radians(),
            sigma_heading_rad_per_sqrt_rad: n.heading_deg_per_sqrt_turn_deg * 1f32.to_radians().sqrt(),
            sigma_position_floor_m: n.position_floor_m,
            sigma_heading_floor_rad: n.heading_floor_deg.to_radians(),
        };
        config.line_noise.sigma_offset_m = self.sensor.line_sigma_m;
        config.sensor = self.sensor_for(layout);
    }

    /// The scanner, for scans of this layout.
    pub fn sensor_for(&self, layout: &ScanLayout<'_>) -> SensorConfig {
        let (s, m) = (&self.sensor, &self.mounting);
        // A robot file that somebody gave knows better, but for scans that it does not fit.
        let fits = !self.usual && self.beams().is_none_or(|beams| beams == layout.beams);
        let stated = layout.stated.filter(|_| !fits);
        let mut codes = s.codes();
        if let Some([least, most]) = stated.and_then(|stated| stated.limits_m) {
            codes.limit(least, most);
        }
        let (mut base_from_laser, upside_down) = match stated.and_then(|s| Some((s.base_from_laser?, s))) {
            Some(([x, y, yaw], stated)) => (pose(x, y, yaw), stated.upside_down),
            None => (pose(m.x_m, m.y_m, m.yaw_deg.to_radians()), m.upside_down),
        };
        let mut clockwise = false;
        // Steps count from the first beam; what is left of its bearing is yaw.
        let mut from_first = |first_rad: f32, step_rad: f32, revolution_s: f32| {
            base_from_laser *= pose(0.0, 0.0, if upside_down { -first_rad } else { first_rad });
            clockwise = step_rad < 0.0;
            ScanGeometry {
                first_step: 0,
                last_step: layout.beams.saturating_sub(1) as u16,
                front_step: 0,
                steps_per_revolution: 2.0 * std::f32::consts::PI / step_rad.abs(),
                revolution_us: (revolution_s * 1e6).round() as u32,
            }
        };
        let geometry = match (&s.steps, stated) {
            (_, Some(stated)) => from_first(stated.first_bearing_rad, stated.step_rad, stated.revolution_s),
            (Some(steps), None) => steps.geometry(),
            (None, None) => {
                let of_view_rad = s.field.as_ref().map_or(180.0, |f| f.of_view_deg).to_radians();
                // 180 and 360 beams leave out the last edge, 181 and 361 have it.
                let step_rad = of_view_rad / (layout.commonest - layout.commonest % 2).max(1) as f32;
                from_first(-0.5 * of_view_rad, step_rad, 0.0)
            }
        };
        let used_steps = match (&s.steps, stated) {
            (Some(steps), None) => (steps.used[0], steps.used[1]),
            _ => (geometry.first_step, geometry.last_step),
        };
        SensorConfig {
            geometry,
            used_steps,
            codes,
            noise: RangeNoise {
                sigma_m: s.sigma_m,
                sigma_per_m: s.sigma_per_m,
                sigma_bearing_rad: s.sigma_bearing_deg.to_radians(),
            },
            // Beams that run clockwise are those of a scanner that hangs head down.
            mounting: Mounting { base_from_laser, upside_down: upside_down ^ clockwise },
        }
    }
}

impl Sensor {
    fn codes(&self) -> RangeCodes {
        let saturated = |mm: u32| mm.min(u32::from(u16::MAX)) as u16;
        let mut no_echo_mm = [(1, 0); 2];
        for (code, [from, to]) in no_echo_mm.iter_mut().zip(&self.no_echo_mm) {
            *code = (saturated(*from), saturated(*to));
        }
        RangeCodes { min_mm: saturated(self.min_range_mm), max_mm: saturated(self.max_range_mm), no_echo_mm }
    }
}

impl Steps {
    fn geometry(&self) -> ScanGeometry {
        ScanGeometry {
            first_step: self.first,
            last_step: self.last,
            front_step: self.front,
            steps_per_revolution: self.per_revolution,
            revolution_us: (self.revolution_s * 1e6).round() as u32,
        }
    }

    fn check(&self) -> Result<(), Impossible> {
        positive("sensor.steps.per_revolution", self.per_revolution)?;
        if self.last <= self.first {
            return Err((
                "sensor.steps.last".into(),
                format!("{} is not above first = {}", self.last, self.first),
            ));
        }
        if f32::from(self.last - self.first) > self.per_revolution {
            return Err(("sensor.steps.last".into(), "the steps are more than a revolution".into()));
        }
        if !(0.0..=10.0).contains(&self.revolution_s) {
            return Err((
                "sensor.steps.revolution_s".into(),
                format!("{} is not within 0 to 10 s", self.revolution_s),
            ));
        }
        let [from, to] = self.used;
        if from > to || from < self.first || to > self.last {
            return Err((
                "sensor.steps.used".into(),
                format!("[{from}, {to}] is not within the steps of the sensor"),
            ));
        }
        Ok(())
    }
}
