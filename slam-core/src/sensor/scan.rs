//! A scan as the sensor gives it: ranges in millimetres, and what turns them into points.
//!
//! Geometry and codes are data: they come from the sensor (SCIP `PP`), a robot file or a log, never from here.

use core::f32::consts::PI;

use nalgebra::Isometry2;

/// How a scanner's beams lie in angle and time.
#[derive(Clone, Copy, Debug, PartialEq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct ScanGeometry {
    /// Step of the first range of a scan (SCIP `AMIN`).
    pub first_step: u16,
    /// Step of the last range of a scan, inclusive (SCIP `AMAX`).
    pub last_step: u16,
    /// Step that looks along x of `laser` (SCIP `AFRT`).
    pub front_step: u16,
    /// Steps in 360° (SCIP `ARES`). Need not be whole: a log may state any angular resolution.
    pub steps_per_revolution: f32,
    /// Time of one revolution, microseconds. Zero where all beams may be taken as simultaneous.
    pub revolution_us: u32,
}

impl ScanGeometry {
    /// The URG-04LX with its factory parameters: 682 beams over 240°, ten revolutions a second.
    pub const URG_04LX: Self = Self {
        first_step: 44,
        last_step: 725,
        front_step: 384,
        steps_per_revolution: 1024.0,
        revolution_us: 100_000,
    };

    /// Number of ranges in a scan. Zero when `last_step` lies before `first_step`.
    pub fn beams(&self) -> usize {
        (usize::from(self.last_step) + 1).saturating_sub(usize::from(self.first_step))
    }

    /// Angle between neighbouring beams, radians.
    pub fn step_rad(&self) -> f32 {
        2.0 * PI / self.steps_per_revolution
    }

    /// Bearing of a beam in `laser`, radians, counter-clockwise positive.
    pub fn bearing(&self, beam: usize) -> f32 {
        (f32::from(self.first_step) + beam as f32 - f32::from(self.front_step)) * self.step_rad()
    }

    /// Time from the first beam to the last, microseconds.
    pub fn sweep_us(&self) -> u64 {
        let steps = self.beams().saturating_sub(1) as f32;
        (steps / self.steps_per_revolution * self.revolution_us as f32) as u64
    }
}

/// What the numbers of a scan mean.
#[derive(Clone, Copy, Debug, PartialEq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct RangeCodes {
    /// Least value that is a distance, millimetres; what is below and not in `no_echo_mm` is an error code.
    pub min_mm: u16,
    /// Greatest distance used, millimetres. What is beyond counts as no echo.
    pub max_mm: u16,
    /// Inclusive intervals of values that mean "nothing in range". An unused one has its ends swapped.
    pub no_echo_mm: [(u16, u16); 2],
}

impl RangeCodes {
    /// The URG-04LX: distances from 20 mm to 5600 mm, 0 and 6 for "nothing in range".
    pub const URG_04LX: Self = Self { min_mm: 20, max_mm: 5600, no_echo_mm: [(0, 0), (6, 6)] };

    /// Values that are distances whatever else is configured; empty where a code for "nothing in range" lies among the
    /// distances.
    pub fn plain_distances(&self) -> core::ops::RangeInclusive<u16> {
        let among = |&(from, to): &(u16, u16)| from <= to && from <= self.max_mm && to >= self.min_mm;
        if self.no_echo_mm.iter().any(among) {
            return core::ops::RangeInclusive::new(1, 0);
        }
        self.min_mm..=self.max_mm
    }

    /// Takes a scanner's own limits, metres: what is at the greatest or beyond met nothing, whatever else was a code for that.
    pub fn limit(&mut self, least_m: f32, most_m: f32) {
        // Casts saturate.
        self.min_mm = ((least_m * 1e3 + 0.5) as u16).max(2);
        self.max_mm = ((most_m * 1e3 + 0.5) as u16).saturating_sub(1).max(self.min_mm.saturating_add(1));
        self.no_echo_mm = [(1, 0); 2];
    }

    /// What one value of a scan means.
    pub fn read(&self, value_mm: u16) -> Reading {
        let no_echo = self.no_echo_mm.iter().any(|&(from, to)| (from..=to).contains(&value_mm));
        if no_echo || value_mm > self.max_mm {
            Reading::NoEcho
        } else if value_mm < self.min_mm {
            Reading::Bad
        } else {
            Reading::Range(f32::from(value_mm) * 1e-3)
        }
    }
}

/// One beam's outcome.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Reading {
    /// Distance to an obstacle, metres.
    Range(f32),
    /// The sensor looked and saw nothing within its range.
    NoEcho,
    /// The sensor could not tell.
    Bad,
}

/// Noise of a scanner's beams; along the beam σ = √(`sigma_m`² + (`sigma_per_m` · range)²).
#[derive(Clone, Copy, Debug, PartialEq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize), serde(deny_unknown_fields))]
pub struct RangeNoise {
    /// Standard deviation at zero range, metres.
    pub sigma_m: f32,
    /// Growth with range, metres for each metre.
    pub sigma_per_m: f32,
    /// Standard deviation of a beam's bearing, radians: its width and its error. It counts where a surface is seen flat.
    pub sigma_bearing_rad: f32,
}

impl RangeNoise {
    /// Variance of a range, m².
    pub fn variance(&self, range_m: f32) -> f32 {
        let grown = self.sigma_per_m * range_m;
        self.sigma_m * self.sigma_m + grown * grown
    }
}

/// Where the scanner sits on the robot.
#[derive(Clone, Copy, Debug, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct Mounting {
    /// Pose of the scanner in `base`: metres forward and left of the axle's middle, yaw in radians.
    pub base_from_laser: Isometry2<f32>,
    /// Whether the scanner hangs head down, so that its steps run clockwise as seen from above.
    pub upside_down: bool,
}

/// Everything about the sensor that the core needs.
#[derive(Clone, Copy, Debug, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct SensorConfig {
    /// Beams in angle and time.
    pub geometry: ScanGeometry,
    /// First and last step that are used; the others see the robot itself.
    pub used_steps: (u16, u16),
    /// Meaning of the values.
    pub codes: RangeCodes,
    /// Range noise.
    pub noise: RangeNoise,
    /// Where it sits.
    pub mounting: Mounting,
}

impl SensorConfig {
    /// How far it sees, metres.
    pub fn reach_m(&self) -> f32 {
        f32::from(self.codes.max_mm) * 1e-3
    }
}

/// Ranges of one scan, first step first.
#[derive(Clone, Copy, Debug)]
pub struct Scan<'a> {
    /// One value for each beam: millimetres, or a code of the sensor. A shorter or longer slice than the geometry's
    /// beams is an invalid scan, which [`Slam`](crate::Slam) counts and skips.
    pub ranges_mm: &'a [u16],
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn urg_geometry_is_the_specification_s() {
        let g = ScanGeometry::URG_04LX;
        assert_eq!(g.beams(), 682);
        assert!((g.bearing(0).to_degrees() + 119.53).abs() < 0.01);
        assert!((g.bearing(681).to_degrees() - 119.88).abs() < 0.01);
        assert_eq!(g.bearing(340), 0.0);
        // Steps 44 to 725 of 1024 in 100 ms.
        assert!((66_400..66_600).contains(&g.sweep_us()));
    }

    #[test]
    fn plain_distances_are_distances_and_all_of_them_where_no_code_lies_among_them() {
        let urg = RangeCodes::URG_04LX;
        let among = RangeCodes { no_echo_mm: [(0, 0), (4000, 4000)], ..urg };
        for codes in [urg, among] {
            let plain = codes.plain_distances();
            for value_mm in 0..=u16::MAX {
                let is_range = matches!(codes.read(value_mm), Reading::Range(_));
                assert!(is_range || !plain.contains(&value_mm), "{value_mm}");
                assert!(codes == among || is_range == plain.contains(&value_mm), "{value_mm}");
            }
        }
        assert!(among.plain_distances().is_empty());
    }

    #[test]
    fn no_echo_and_bad_readings_are_told_apart() {
        let codes = RangeCodes::URG_04LX;
        assert_eq!(codes.read(0), Reading::NoEcho);
        assert_eq!(codes.read(6), Reading::NoEcho);
        for bad in [1, 2, 7, 8, 9, 10, 16, 18, 19] {
            assert_eq!(codes.read(bad), Reading::Bad, "{bad}");
        }
        for (value_mm, metres) in [(20, 0.02f32), (1234, 1.234), (5600, 5.6)] {
            assert!(matches!(codes.read(value_mm), Reading::Range(r) if (r - metres).abs() < 1e-6));
        }
        assert_eq!(codes.read(5601), Reading::NoEcho);
    }

    #[test]
    fn swapped_steps_have_no_beams() {
        let g = ScanGeometry { first_step: 10, last_step: 3, ..ScanGeometry::URG_04LX };
        assert_eq!(g.beams(), 0);
        assert_eq!(g.sweep_us(), 0);
    }
}
