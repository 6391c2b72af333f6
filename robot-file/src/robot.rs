//! Robot files: wheels, encoders, scanner and mounting, in TOML.
//!
//! What belongs to the type of scanner or base may come from a [profile](crate::profile). Every key is needed, there or here, and
//! no other is known, so that a slip of the pen is an error that names it, with the file.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use slam_core::SlamConfig;
use slam_core::geometry::pose::pose;
use slam_core::odometry::{DifferentialDrive, ticks_between_u16, ticks_between_u32};
use slam_core::sensor::scan::{Mounting, RangeNoise, ScanGeometry, SensorConfig};

use crate::encoders::EncoderInputs;
use crate::odometry::{NoiseFile, NoiseText};
use crate::sensor::{Sensor, SensorText};
use crate::toml_file::{self, FileError, Impossible, finite, positive};

/// A robot, as its file describes it.
#[derive(Clone, Debug)]
pub struct Robot {
    /// What it is called in reports.
    pub name: String,
    /// Wheels and encoders; logs that bring poses need none.
    pub wheels: Option<Wheels>,
    /// How the microcontroller takes in the encoders' lines.
    pub encoders: EncoderInputs,
    /// Growth of the odometry's uncertainty.
    pub odometry_noise: NoiseFile,
    /// The scanner.
    pub sensor: Sensor,
    /// Where the scanner sits.
    pub mounting: MountingFile,
    /// Whether nobody described this robot: what a log states goes before it.
    pub usual: bool,
    /// Files of profiles that were read beside the robot file.
    pub profile_files: Vec<PathBuf>,
}

/// A robot file as written.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RobotText {
    name: String,
    wheels: Option<Wheels>,
    #[serde(default)]
    encoders: EncoderInputs,
    odometry_noise: NoiseText,
    sensor: SensorText,
    mounting: MountingFile,
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
    /// Counter steps for one turn of a wheel: all edges of both lines are counted, so four times an encoder's lines (its "PPR"), times
    /// the gear between encoder and wheel.
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

impl Wheels {
    fn check(&self) -> Result<(), Impossible> {
        positive("wheels.left_radius_m", self.left_radius_m)?;
        positive("wheels.right_radius_m", self.right_radius_m)?;
        positive("wheels.track_m", self.track_m)?;
        positive("wheels.ticks_per_turn", self.ticks_per_turn)?;
        if self.counter_bits != 16 && self.counter_bits != 32 {
            let reason = format!("{} is neither 16 nor 32", self.counter_bits);
            return Err(("wheels.counter_bits".into(), reason));
        }
        Ok(())
    }
}

impl MountingFile {
    fn check(&self) -> Result<(), Impossible> {
        finite("mounting.x_m", self.x_m)?;
        finite("mounting.y_m", self.y_m)?;
        finite("mounting.yaw_deg", self.yaw_deg)
    }
}

impl Robot {
    /// Reads and checks a robot file, and the profiles that it names.
    pub fn load(path: &Path) -> Result<Self, FileError> {
        Self::parse(&toml_file::read(path)?, path)
    }

    /// Checks a text that stands in a robot file. Profiles that are files are looked for from there.
    pub fn parse(text: &str, path: &Path) -> Result<Self, FileError> {
        let RobotText { name, wheels, encoders, odometry_noise, sensor, mounting } =
            toml_file::deserialize(text, path)?;
        let impossible = |(key, reason)| FileError::Impossible { path: path.to_owned(), key, reason };
        wheels.as_ref().map_or(Ok(()), Wheels::check).map_err(impossible)?;
        encoders.check().map_err(impossible)?;
        mounting.check().map_err(impossible)?;
        let mut profile_files = Vec::new();
        Ok(Self {
            name,
            wheels,
            encoders,
            odometry_noise: odometry_noise.complete(path, &mut profile_files)?,
            sensor: sensor.complete(path, &mut profile_files)?,
            mounting,
            usual: false,
            profile_files,
        })
    }

    /// The robot that a format's logs were recorded with, built in: `robots/mines.toml`, `robots/sick.toml`, or
    /// `robots/paper.toml` for simulated ones.
    pub fn usual_for(format: &str) -> Self {
        let (text, name) = match format {
            "mines" => (include_str!("../../robots/mines.toml"), "robots/mines.toml"),
            "simulated" | "robot" => (include_str!("../../robots/paper.toml"), "robots/paper.toml"),
            _ => (include_str!("../../robots/sick.toml"), "robots/sick.toml"),
        };
        let robot = Self::parse(text, Path::new(name)).expect("the built-in robots are tested");
        Self { usual: true, ..robot }
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
        config.odometry.track_m = self.wheels.map(|w| w.track_m);
        config.odometry.noise = self.odometry_noise.core();
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::encoders::Pull;

    const MINES: &str = include_str!("../../robots/mines.toml");

    fn parse(changes: &[(&str, &str)], path: &Path) -> Result<Robot, String> {
        let mut text = MINES.to_owned();
        for (from, to) in changes {
            assert!(text.contains(from), "'{from}' is not in mines.toml");
            text = text.replacen(from, to, 1);
        }
        Robot::parse(&text, path).map_err(|error| match &error {
            FileError::Parse { source, .. } => format!("{error}: {source}"),
            _ => error.to_string(),
        })
    }

    #[test]
    fn the_robots_differ_in_geometry_alone() {
        let [mines, paper] = ["mines", "simulated"].map(|format| Robot::usual_for(format).config());
        assert_eq!(mines.odometry.noise, paper.odometry.noise);
        assert_eq!(mines.sensor.noise, paper.sensor.noise);
        assert_eq!(mines.sensor.codes, paper.sensor.codes);
        assert_eq!(mines.sensor.geometry, paper.sensor.geometry);
        assert_eq!(mines.line_noise, paper.line_noise);
        assert_eq!((mines.sensor.used_steps, paper.sensor.used_steps), ((114, 655), (44, 725)));
    }

    #[test]
    fn a_robot_file_goes_before_its_profile() {
        let path = Path::new("robots/rover.toml");
        let robot = parse(&[("[sensor.steps]", "sigma_m = 0.5\n[sensor.steps]\nlast = 700")], path).unwrap();
        let config = robot.config();
        assert_eq!((config.sensor.noise.sigma_m, config.sensor.geometry.last_step), (0.5, 700));
        assert_eq!(config.sensor.geometry.front_step, 384);
        let field = ("[sensor.steps]\n", "[sensor.field]\nof_view_deg = 90.0\n");
        let used = ("used = [114, 655]\n", "");
        assert_eq!(
            parse(&[field, used], path).unwrap().beams(),
            None,
            "a field replaces the profile's steps"
        );
    }

    #[test]
    fn the_bit_rate_is_one_of_the_sensor_s() {
        let path = Path::new("robots/rover.toml");
        let with = |rate: &str| parse(&[("[sensor]", &format!("[sensor]\nbaud_rate = {rate}"))], path);
        assert_eq!(with("500000").unwrap().sensor.baud_rate, Some(500_000));
        assert_eq!(parse(&[], path).unwrap().sensor.baud_rate, None);
        assert_eq!(Robot::usual_for("simulated").sensor.baud_rate, Some(250_000));
        for (rate, words) in [
            ("256000", ["rover.toml: sensor.baud_rate", "256000 is none", "115200, 250000, 500000"]),
            ("0", ["rover.toml: sensor.baud_rate", "0 is none", "19200"]),
            ("-1", ["rover.toml", "baud_rate = -1", "integer `-1`"]),
            ("\"fast\"", ["rover.toml", "baud_rate = \"fast\"", "u32"]),
        ] {
            let said = with(rate).unwrap_err();
            assert!(words.iter().all(|word| said.contains(word)), "{words:?} are not in: {said}");
        }
    }

    #[test]
    fn encoders_have_pull_ups_and_a_filter_unless_the_file_says_otherwise() {
        let path = Path::new("robots/rover.toml");
        let with = |keys: &str| {
            parse(&[("[odometry_noise]", &format!("[encoders]\n{keys}\n[odometry_noise]"))], path)
        };
        assert_eq!(parse(&[], path).unwrap().encoders, EncoderInputs { pull: Pull::Up, filter_us: 5.0 });
        assert_eq!(
            with("pull = \"none\"").unwrap().encoders,
            EncoderInputs { pull: Pull::None, filter_us: 5.0 }
        );
        assert_eq!(
            with("pull = \"down\"\nfilter_us = 0").unwrap().encoders,
            EncoderInputs { pull: Pull::Down, filter_us: 0.0 }
        );
        for (keys, words) in [
            ("filter_us = 12.0", &["rover.toml: encoders.filter_us", "12 is above 11.3"][..]),
            ("filter_us = -1.0", &["rover.toml: encoders.filter_us", "-1 is below zero"]),
            ("filter_us = nan", &["rover.toml: encoders.filter_us", "NaN"]),
            ("pull = \"sideways\"", &["rover.toml", "sideways", "pull"]),
            ("filtre_us = 1.0", &["rover.toml", "filtre_us"]),
        ] {
            let said = with(keys).unwrap_err();
            assert!(words.iter().all(|word| said.contains(word)), "{words:?} are not in: {said}");
        }
    }

    #[test]
    fn profiles_that_cannot_be_used_are_named() {
        let folder = std::env::temp_dir().join(format!("lineslam-profiles-{}", std::process::id()));
        std::fs::create_dir_all(&folder).unwrap();
        let path = folder.join("rover.toml");
        let own = crate::profile::SENSORS[0].2.replace("sigma_m = 0.01", "sigma_m = 0.03");
        std::fs::write(folder.join("own.toml"), &own).unwrap();
        std::fs::write(folder.join("bad.toml"), own.replace("last = 725", "last = 4")).unwrap();
        std::fs::write(folder.join("delay.toml"), format!("scan_delay_s = 0.1\n{own}")).unwrap();
        std::fs::write(folder.join("rate.toml"), format!("baud_rate = 250000\n{own}")).unwrap();
        let named = |name: &str| parse(&[("\"urg-04lx\"", &format!("\"{name}\""))], &path);
        let robot = named("own.toml").unwrap();
        assert_eq!(robot.config().sensor.noise.sigma_m, 0.03);
        assert_eq!(robot.profile_files, [folder.join("own.toml")]);
        for (name, words) in [
            ("urg-05", &["rover.toml: sensor.profile", "urg-05", "urg-04lx, "][..]),
            ("absent.toml", &["rover.toml: sensor.profile", "absent.toml"]),
            ("bad.toml", &["bad.toml: steps.last", "4 is not above"]),
            ("delay.toml", &["delay.toml: scan_delay_s"]),
            ("rate.toml", &["rate.toml: baud_rate", "belongs into a robot file"]),
        ] {
            let said = named(name).unwrap_err();
            assert!(words.iter().all(|word| said.contains(word)), "{words:?} are not in: {said}");
        }
        let said = parse(&[("used = [114, 655]", "used = [114, 655]\nfrist = 3")], &path).unwrap_err();
        assert!(said.contains("frist") && said.contains("rover.toml"), "{said}");
        let said = parse(&[("used = [114, 655]", "used = [114, 800]")], &path).unwrap_err();
        assert!(said.contains("rover.toml: sensor.steps.used"), "{said}");
        let said = parse(&[("\"two-wheels\"", "\"three-wheels\"")], &path).unwrap_err();
        assert!(said.contains("rover.toml: odometry_noise.profile"), "{said}");
        std::fs::remove_dir_all(&folder).unwrap();
    }
}
