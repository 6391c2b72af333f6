//! `[sensor]`: a scanner, spelled out in the robot file or taken from a profile.

use std::path::{Path, PathBuf};

use scip::rate::RATES;
use serde::Deserialize;
use slam_core::sensor::scan::{RangeCodes, ScanGeometry};

use crate::profile::{self, needed};
use crate::toml_file::{FileError, Impossible, not_negative, positive};

/// `[sensor]`
#[derive(Clone, Debug)]
pub struct Sensor {
    /// What it is, for people.
    pub model: String,
    min_range_mm: u32,
    max_range_mm: u32,
    no_echo_mm: Vec<[u32; 2]>,
    /// Largest systematic error of a range by the data sheet, metres, and as a share of the range where that is more. Only
    /// simulated scanners use it.
    pub accuracy: Option<[f64; 2]>,
    pub(crate) sigma_m: f32,
    pub(crate) sigma_per_m: f32,
    /// Standard deviation of a beam's bearing, degrees.
    pub(crate) sigma_bearing_deg: f32,
    /// Standard deviation of what does not average out over a line's points, metres.
    pub(crate) line_sigma_m: f32,
    /// Time from the middle beam to the stamp logged with the scan, seconds.
    pub scan_delay_s: f64,
    /// Bit rate at which the microcontroller works with it, bit/s, one of [`RATES`]; `None` for the driver's default.
    pub baud_rate: Option<u32>,
    pub(crate) steps: Option<Steps>,
    pub(crate) field: Option<Field>,
}

/// `[sensor.steps]`: a scanner whose beams are known beforehand, in SCIP's terms.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Steps {
    first: u16,
    last: u16,
    front: u16,
    per_revolution: f32,
    revolution_s: f64,
    pub(crate) used: [u16; 2],
}

/// `[sensor.field]`: a scanner whose number of beams the log states.
#[derive(Clone, Copy, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Field {
    pub(crate) of_view_deg: f32,
}

/// A scanner as written, in a robot file or in a profile.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct SensorText {
    profile: Option<String>,
    model: Option<String>,
    min_range_mm: Option<u32>,
    max_range_mm: Option<u32>,
    no_echo_mm: Option<Vec<[u32; 2]>>,
    accuracy_m: Option<f64>,
    accuracy_per_m: Option<f64>,
    sigma_m: Option<f32>,
    sigma_per_m: Option<f32>,
    sigma_bearing_deg: Option<f32>,
    line_sigma_m: Option<f32>,
    scan_delay_s: Option<f64>,
    baud_rate: Option<u32>,
    steps: Option<StepsText>,
    field: Option<Field>,
}

#[derive(Clone, Copy, Debug, Default, Deserialize)]
#[serde(deny_unknown_fields)]
struct StepsText {
    first: Option<u16>,
    last: Option<u16>,
    front: Option<u16>,
    per_revolution: Option<f32>,
    revolution_s: Option<f64>,
    used: Option<[u16; 2]>,
}

impl SensorText {
    /// With the profile that it names, if any.
    pub(crate) fn complete(self, path: &Path, files: &mut Vec<PathBuf>) -> Result<Sensor, FileError> {
        let in_file = |(key, reason): Impossible| FileError::Impossible {
            path: path.to_owned(),
            key: if key.is_empty() { "sensor".into() } else { format!("sensor.{key}") },
            reason,
        };
        let Some(name) = self.profile.clone() else { return self.whole().map_err(in_file) };
        let (profile, profile_path) =
            profile::read::<Self>(&name, "sensor.profile", &profile::SENSORS, path, files)?;
        let in_profile = |(key, reason)| FileError::Impossible { path: profile_path.clone(), key, reason };
        for (key, stated) in [
            ("profile", profile.profile.is_some()),
            ("scan_delay_s", profile.scan_delay_s.is_some()),
            ("baud_rate", profile.baud_rate.is_some()),
        ] {
            if stated {
                return Err(in_profile((key.into(), "belongs into a robot file".into())));
            }
        }
        let profile = Self { scan_delay_s: Some(0.0), ..profile };
        profile.clone().whole().map_err(in_profile)?;
        self.over(profile).whole().map_err(in_file)
    }

    /// What the robot file says goes before the profile.
    fn over(self, profile: Self) -> Self {
        // Beams by steps or by field: one kind replaces the other.
        let steps = match (self.steps, profile.steps) {
            (Some(own), Some(other)) => Some(own.over(other)),
            (None, Some(other)) if self.field.is_none() => Some(other),
            (own, _) => own,
        };
        let field = self.field.or(profile.field.filter(|_| self.steps.is_none()));
        Self {
            profile: None,
            model: self.model.or(profile.model),
            min_range_mm: self.min_range_mm.or(profile.min_range_mm),
            max_range_mm: self.max_range_mm.or(profile.max_range_mm),
            no_echo_mm: self.no_echo_mm.or(profile.no_echo_mm),
            accuracy_m: self.accuracy_m.or(profile.accuracy_m),
            accuracy_per_m: self.accuracy_per_m.or(profile.accuracy_per_m),
            sigma_m: self.sigma_m.or(profile.sigma_m),
            sigma_per_m: self.sigma_per_m.or(profile.sigma_per_m),
            sigma_bearing_deg: self.sigma_bearing_deg.or(profile.sigma_bearing_deg),
            line_sigma_m: self.line_sigma_m.or(profile.line_sigma_m),
            // Never the profile's: they belong to the robot.
            scan_delay_s: self.scan_delay_s,
            baud_rate: self.baud_rate,
            steps,
            field,
        }
    }

    fn whole(self) -> Result<Sensor, Impossible> {
        let accuracy = match (self.accuracy_m, self.accuracy_per_m) {
            (None, None) => None,
            (m, per_m) => Some([needed("accuracy_m", m)?, needed("accuracy_per_m", per_m)?]),
        };
        let sensor = Sensor {
            model: needed("model", self.model)?,
            min_range_mm: needed("min_range_mm", self.min_range_mm)?,
            max_range_mm: needed("max_range_mm", self.max_range_mm)?,
            no_echo_mm: needed("no_echo_mm", self.no_echo_mm)?,
            accuracy,
            sigma_m: needed("sigma_m", self.sigma_m)?,
            sigma_per_m: needed("sigma_per_m", self.sigma_per_m)?,
            sigma_bearing_deg: needed("sigma_bearing_deg", self.sigma_bearing_deg)?,
            line_sigma_m: needed("line_sigma_m", self.line_sigma_m)?,
            scan_delay_s: needed("scan_delay_s", self.scan_delay_s)?,
            baud_rate: self.baud_rate,
            steps: self.steps.map(StepsText::whole).transpose()?,
            field: self.field,
        };
        sensor.check()?;
        Ok(sensor)
    }
}

impl Sensor {
    fn check(&self) -> Result<(), Impossible> {
        if self.max_range_mm <= self.min_range_mm {
            let reason = format!("{} is not above min_range_mm = {}", self.max_range_mm, self.min_range_mm);
            return Err(("max_range_mm".into(), reason));
        }
        if self.max_range_mm > u32::from(u16::MAX) {
            return Err(("max_range_mm".into(), format!("{} is above 65535", self.max_range_mm)));
        }
        if self.no_echo_mm.len() > 2 {
            let reason = format!("{} intervals, at most 2 are possible", self.no_echo_mm.len());
            return Err(("no_echo_mm".into(), reason));
        }
        if let Some([from, to]) = self.no_echo_mm.iter().find(|[from, to]| from > to) {
            return Err(("no_echo_mm".into(), format!("interval [{from}, {to}] is empty")));
        }
        if let Some([metres, share]) = self.accuracy {
            not_negative("accuracy_m", metres)?;
            not_negative("accuracy_per_m", share)?;
        }
        positive("sigma_m", self.sigma_m)?;
        not_negative("sigma_per_m", self.sigma_per_m)?;
        positive("sigma_bearing_deg", self.sigma_bearing_deg)?;
        positive("line_sigma_m", self.line_sigma_m)?;
        if !(-10.0..=10.0).contains(&self.scan_delay_s) {
            return Err(("scan_delay_s".into(), format!("{} is not within ±10 s", self.scan_delay_s)));
        }
        if let Some(rate) = self.baud_rate.filter(|rate| !RATES.contains(rate)) {
            let known = RATES.map(|rate| rate.to_string()).join(", ");
            return Err(("baud_rate".into(), format!("{rate} is none of the sensor's: {known}")));
        }
        match (&self.steps, &self.field) {
            (Some(steps), None) => steps.check(),
            (None, Some(field)) if field.of_view_deg > 0.0 && field.of_view_deg <= 360.0 => Ok(()),
            (None, Some(field)) => {
                Err(("field.of_view_deg".into(), format!("{} is not within 0 to 360", field.of_view_deg)))
            }
            _ => Err((String::new(), "needs either [sensor.steps] or [sensor.field]".into())),
        }
    }

    pub(crate) fn codes(&self) -> RangeCodes {
        let saturated = |mm: u32| mm.min(u32::from(u16::MAX)) as u16;
        let mut no_echo_mm = [(1, 0); 2];
        for (code, [from, to]) in no_echo_mm.iter_mut().zip(&self.no_echo_mm) {
            *code = (saturated(*from), saturated(*to));
        }
        RangeCodes { min_mm: saturated(self.min_range_mm), max_mm: saturated(self.max_range_mm), no_echo_mm }
    }
}

impl StepsText {
    fn over(self, profile: Self) -> Self {
        Self {
            first: self.first.or(profile.first),
            last: self.last.or(profile.last),
            front: self.front.or(profile.front),
            per_revolution: self.per_revolution.or(profile.per_revolution),
            revolution_s: self.revolution_s.or(profile.revolution_s),
            used: self.used.or(profile.used),
        }
    }

    fn whole(self) -> Result<Steps, Impossible> {
        Ok(Steps {
            first: needed("steps.first", self.first)?,
            last: needed("steps.last", self.last)?,
            front: needed("steps.front", self.front)?,
            per_revolution: needed("steps.per_revolution", self.per_revolution)?,
            revolution_s: needed("steps.revolution_s", self.revolution_s)?,
            used: needed("steps.used", self.used)?,
        })
    }
}

impl Steps {
    pub(crate) fn geometry(&self) -> ScanGeometry {
        ScanGeometry {
            first_step: self.first,
            last_step: self.last,
            front_step: self.front,
            steps_per_revolution: self.per_revolution,
            revolution_us: (self.revolution_s * 1e6).round() as u32,
        }
    }

    fn check(&self) -> Result<(), Impossible> {
        positive("steps.per_revolution", self.per_revolution)?;
        if self.last <= self.first {
            return Err(("steps.last".into(), format!("{} is not above first = {}", self.last, self.first)));
        }
        if f32::from(self.last - self.first) > self.per_revolution {
            return Err(("steps.last".into(), "the steps are more than a revolution".into()));
        }
        if !(0.0..=10.0).contains(&self.revolution_s) {
            let reason = format!("{} is not within 0 to 10 s", self.revolution_s);
            return Err(("steps.revolution_s".into(), reason));
        }
        let [from, to] = self.used;
        if from > to || from < self.first || to > self.last {
            return Err((
                "steps.used".into(),
                format!("[{from}, {to}] is not within the steps of the sensor"),
            ));
        }
        Ok(())
    }
}
