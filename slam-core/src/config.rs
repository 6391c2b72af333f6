//! All settings, one struct for each stage, and where each value comes from.

use nalgebra::Isometry2;

use crate::association::{AssociationConfig, BisectorConfig, GateConfig};
use crate::correction::{CorrectionConfig, MapConfig, SearchConfig};
use crate::deskew::DeskewConfig;
use crate::extraction::{ExtractionConfig, RansacConfig, SplitConfig};
use crate::keyframe::KeyframeConfig;
use crate::loop_closure::LoopConfig;
use crate::odometry::{Integration, OdometryNoise};
use crate::odometry_bias::BiasConfig;
use crate::registration::{JointConfig, MAX_TAKEN, RegistrationConfig};
use crate::residual::LineNoise;
use crate::scan::{Mounting, RangeCodes, RangeNoise, ScanGeometry, SensorConfig};
use crate::visibility::ForgetConfig;

/// Odometry settings.
#[derive(Clone, Copy, Debug, PartialEq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct OdometryConfig {
    /// Step from wheel motion to pose. The caller that owns the counters uses it.
    pub integration: Integration,
    /// Growth of uncertainty.
    pub noise: OdometryNoise,
    /// Learning of systematic errors, or none.
    pub bias: Option<BiasConfig>,
}

/// Everything [`Slam`](crate::Slam) can be told.
#[derive(Clone, Copy, Debug, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct SlamConfig {
    /// The scanner and where it sits.
    pub sensor: SensorConfig,
    /// The wheels.
    pub odometry: OdometryConfig,
    /// Ranges to points.
    pub deskew: DeskewConfig,
    /// Points to segments.
    pub extraction: ExtractionConfig,
    /// Errors of lines beyond their points' noise.
    pub line_noise: LineNoise,
    /// Segments to pairs.
    pub association: AssociationConfig,
    /// Pairs to pose.
    pub correction: CorrectionConfig,
    /// Old parts of the map recognised, or not.
    pub loop_closure: Option<LoopConfig>,
    /// What is seen through forgotten, or not.
    pub forgetting: Option<ForgetConfig>,
    /// Segments to map.
    pub registration: RegistrationConfig,
}

/// A scan's beams go round no farther than this, in turns.
pub const MOST_OF_A_TURN: f32 = 1.02;

/// URG-04LX 0.140 m ahead of the axle: the robot of the paper.
const PAPER_SENSOR: SensorConfig = SensorConfig {
    geometry: ScanGeometry::URG_04LX,
    used_steps: (ScanGeometry::URG_04LX.first_step, ScanGeometry::URG_04LX.last_step),
    codes: RangeCodes::URG_04LX,
    // 10 mm up to 1 m, 1 % of the range beyond (data sheet's repeatability, as one curve).
    noise: RangeNoise { sigma_m: 0.01, sigma_per_m: 0.01, sigma_bearing_rad: 0.003 },
    mounting: Mounting { base_from_laser: PAPER_MOUNTING, upside_down: false },
};

const PAPER_MOUNTING: Isometry2<f32> = Isometry2 {
    rotation: nalgebra::Unit::new_unchecked(nalgebra::Complex { re: 1.0, im: 0.0 }),
    translation: nalgebra::Translation { vector: nalgebra::Vector2::new(0.140, 0.0) },
};

/// A small base with rubber tyres on a hard floor.
const ODOMETRY_NOISE: OdometryNoise = OdometryNoise {
    sigma_along_m_per_sqrt_m: 0.04,
    sigma_across_m_per_sqrt_m: 0.02,
    sigma_heading_rad_per_sqrt_m: 0.03,
    sigma_heading_rad_per_sqrt_rad: 0.06,
    sigma_position_floor_m: 0.002,
    sigma_heading_floor_rad: 0.002,
};

impl Default for SlamConfig {
    /// The best we know.
    ///
    /// Sensor geometry and codes are the data sheet's. All other values are ours: chosen by the geometric mean of the
    /// trajectory error over eight or more seeds of range noise on recorded logs of two kinds of scanner, and by the corner
    /// error of simulated buildings on seeds other than those reported.
    fn default() -> Self {
        Self {
            sensor: PAPER_SENSOR,
            odometry: OdometryConfig {
                integration: Integration::Arc,
                noise: ODOMETRY_NOISE,
                bias: Some(BiasConfig { sigma_distance: 0.01, sigma_turn: 0.01, sigma_turn_per_m: 0.005 }),
            },
            deskew: DeskewConfig { enabled: true },
            extraction: ExtractionConfig::Split(SplitConfig {
                max_gap_m: 0.05,
                min_incidence_rad: 0.17,
                max_missing_beams: 4,
                split_sigmas: 4.0,
                merge_chi2: 0.6,
                trim_sigmas: 2.5,
                max_mean_chi2: 2.0,
                min_inliers: 6,
                min_length_m: 0.15,
                max_round_radius_m: 0.5,
                max_sigma_direction_rad: 0.2,
            }),
            line_noise: LineNoise { sigma_offset_m: 0.01, sigma_direction_rad: 0.002 },
            association: AssociationConfig::Gated(GateConfig {
                max_angle_rad: 0.35,
                max_distance_m: 0.6,
                max_chi2: 13.8,
                min_overlap: 0.3,
                max_overlap_slack_m: 1.0,
            }),
            correction: CorrectionConfig::MaximumAPosteriori(MapConfig {
                max_iterations: 8,
                converged_step: 1e-3,
                kernel_chi2: 4.0,
                close_heading_rad: 0.02,
                direction_trust_rad: 0.02,
                observable_sigma_m: 0.1,
                search: SearchConfig { below_support: 0.8, gain: 0.2, step_rad: 0.1, reach_rad: 0.6 },
            }),
            loop_closure: Some(LoopConfig {
                min_way_m: 20.0,
                sigma_position_m_per_sqrt_m: 0.05,
                sigma_heading_rad_per_sqrt_m: 0.004,
                min_support: 0.8,
                min_chi2: 9.0,
                max_chi2: 16.0,
                confirmations: 4,
                same_position_m: 0.1,
                same_heading_rad: 0.03,
            }),
            forgetting: Some(ForgetConfig { margin_m: 0.2, margin_sigmas: 3.0, min_sine: 0.1, scans: 3 }),
            registration: RegistrationConfig::Joint(JointConfig {
                keyframes: KeyframeConfig { way_m: 0.15, scans: 10, at_start: 10, spacing_between_m: 0.07 },
                max_taken: 12,
                max_learning: 6,
                taken_per_scan: 6,
                least_gain: 0.1,
                again_factor: 2.0,
                max_chi2: 60.0,
                kernel_chi2: 2.0,
                young_hits: 4,
                young_scans_per_hit: 2.1,
                fuse_max_angle_rad: 0.1,
                fuse_max_distance_m: 0.25,
                fuse_gap_m: 0.2,
                fuse_max_gap_m: 1.0,
                fuse_chi2: 4.0,
                fuse_sigmas: 16.0,
                fuse_overlap: 0.5,
            }),
        }
    }
}

impl SlamConfig {
    /// The paper, step for step. Values the paper does not state are marked as ours.
    pub fn paper() -> Self {
        Self {
            sensor: PAPER_SENSOR,
            odometry: OdometryConfig { integration: Integration::Euler, noise: ODOMETRY_NOISE, bias: None },
            deskew: DeskewConfig { enabled: false },
            extraction: ExtractionConfig::Ransac(RansacConfig {
                draws: 50,               // ours
                inlier_distance_m: 0.03, // ours: the sensor's ±30 mm
                max_gap_m: 0.2,          // ours
                min_inliers: 6,          // ours
                seed: 1,
            }),
            line_noise: LineNoise { sigma_offset_m: 0.0, sigma_direction_rad: 0.0 },
            association: AssociationConfig::Bisector(BisectorConfig { max_distance_m: 0.3 }), // ours
            correction: CorrectionConfig::LeastSquares,
            loop_closure: None,
            forgetting: None,
            registration: RegistrationConfig::EndPoints,
        }
    }

    /// Checks every value; the error names the field.
    pub fn validate(&self) -> Result<(), ConfigError> {
        self.validate_sensor()?;
        self.validate_odometry()?;
        self.validate_stages()
    }

    fn validate_sensor(&self) -> Result<(), ConfigError> {
        let s = &self.sensor;
        let g = &s.geometry;
        check("sensor.geometry.last_step", g.last_step > g.first_step)?;
        check(
            "sensor.geometry.steps_per_revolution",
            g.steps_per_revolution >= 1.0 && g.steps_per_revolution.is_finite(),
        )?;
        // Beyond a full turn the same bearings would come twice; where scanners that look all round close it they may, and the
        // step be rounded.
        check(
            "sensor.geometry.steps_per_revolution",
            (g.beams() - 1) as f32 <= MOST_OF_A_TURN * g.steps_per_revolution,
        )?;
        check("sensor.used_steps", s.used_steps.0 <= s.used_steps.1)?;
        check("sensor.codes.max_mm", s.codes.max_mm > s.codes.min_mm)?;
        positive("sensor.noise.sigma_m", s.noise.sigma_m)?;
        not_negative("sensor.noise.sigma_per_m", s.noise.sigma_per_m)?;
        positive("sensor.noise.sigma_bearing_rad", s.noise.sigma_bearing_rad)?;
        check("sensor.mounting.base_from_laser", crate::pose::is_finite(&s.mounting.base_from_laser))
    }

    fn validate_odometry(&self) -> Result<(), ConfigError> {
        let n = &self.odometry.noise;
        not_negative("odometry.noise.sigma_along_m_per_sqrt_m", n.sigma_along_m_per_sqrt_m)?;
        not_negative("odometry.noise.sigma_across_m_per_sqrt_m", n.sigma_across_m_per_sqrt_m)?;
        not_negative("odometry.noise.sigma_heading_rad_per_sqrt_m", n.sigma_heading_rad_per_sqrt_m)?;
        not_negative("odometry.noise.sigma_heading_rad_per_sqrt_rad", n.sigma_heading_rad_per_sqrt_rad)?;
        // The prior is inverted: at rest these are all there is.
        positive("odometry.noise.sigma_position_floor_m", n.sigma_position_floor_m)?;
        positive("odometry.noise.sigma_heading_floor_rad", n.sigma_heading_floor_rad)?;
        if let Some(b) = &self.odometry.bias {
            not_negative("odometry.bias.sigma_distance", b.sigma_distance)?;
            not_negative("odometry.bias.sigma_turn", b.sigma_turn)?;
            not_negative("odometry.bias.sigma_turn_per_m", b.sigma_turn_per_m)?;
        }
        Ok(())
    }

    fn validate_stages(&self) -> Result<(), ConfigError> {
        match &self.extraction {
            ExtractionConfig::Ransac(c) => {
                check("extraction.ransac.draws", c.draws > 0)?;
                positive("extraction.ransac.inlier_distance_m", c.inlier_distance_m)?;
                positive("extraction.ransac.max_gap_m", c.max_gap_m)?;
                check("extraction.ransac.min_inliers", c.min_inliers >= 2)?;
            }
            ExtractionConfig::Split(c) => {
                positive("extraction.split.max_gap_m", c.max_gap_m)?;
                positive("extraction.split.min_incidence_rad", c.min_incidence_rad)?;
                positive("extraction.split.split_sigmas", c.split_sigmas)?;
                not_negative("extraction.split.merge_chi2", c.merge_chi2)?;
                positive("extraction.split.trim_sigmas", c.trim_sigmas)?;
                positive("extraction.split.max_mean_chi2", c.max_mean_chi2)?;
                check("extraction.split.min_inliers", c.min_inliers >= 2)?;
                not_negative("extraction.split.min_length_m", c.min_length_m)?;
                not_negative("extraction.split.max_round_radius_m", c.max_round_radius_m)?;
                positive("extraction.split.max_sigma_direction_rad", c.max_sigma_direction_rad)?;
            }
        }
        not_negative("line_noise.sigma_offset_m", self.line_noise.sigma_offset_m)?;
        not_negative("line_noise.sigma_direction_rad", self.line_noise.sigma_direction_rad)?;
        match &self.association {
            AssociationConfig::Bisector(c) => {
                positive("association.bisector.max_distance_m", c.max_distance_m)?
            }
            AssociationConfig::Gated(c) => {
                positive("association.gated.max_angle_rad", c.max_angle_rad)?;
                positive("association.gated.max_distance_m", c.max_distance_m)?;
                positive("association.gated.max_chi2", c.max_chi2)?;
                check("association.gated.min_overlap", (0.0..=1.0).contains(&c.min_overlap))?;
                not_negative("association.gated.max_overlap_slack_m", c.max_overlap_slack_m)?;
            }
        }
        if let CorrectionConfig::MaximumAPosteriori(c) = &self.correction {
            check("correction.maximum_a_posteriori.max_iterations", c.max_iterations > 0)?;
            not_negative("correction.maximum_a_posteriori.converged_step", c.converged_step)?;
            positive("correction.maximum_a_posteriori.kernel_chi2", c.kernel_chi2)?;
            not_negative("correction.maximum_a_posteriori.close_heading_rad", c.close_heading_rad)?;
            not_negative("correction.maximum_a_posteriori.direction_trust_rad", c.direction_trust_rad)?;
            positive("correction.maximum_a_posteriori.observable_sigma_m", c.observable_sigma_m)?;
            not_negative("correction.maximum_a_posteriori.search.below_support", c.search.below_support)?;
            not_negative("correction.maximum_a_posteriori.search.gain", c.search.gain)?;
            positive("correction.maximum_a_posteriori.search.step_rad", c.search.step_rad)?;
            not_negative("correction.maximum_a_posteriori.search.reach_rad", c.search.reach_rad)?;
        }
        if let Some(c) = &self.loop_closure {
            not_negative("loop_closure.min_way_m", c.min_way_m)?;
            not_negative("loop_closure.sigma_position_m_per_sqrt_m", c.sigma_position_m_per_sqrt_m)?;
            not_negative("loop_closure.sigma_heading_rad_per_sqrt_m", c.sigma_heading_rad_per_sqrt_m)?;
            not_negative("loop_closure.min_support", c.min_support)?;
            not_negative("loop_closure.min_chi2", c.min_chi2)?;
            positive("loop_closure.max_chi2", c.max_chi2)?;
            check("loop_closure.confirmations", c.confirmations > 0)?;
            not_negative("loop_closure.same_position_m", c.same_position_m)?;
            not_negative("loop_closure.same_heading_rad", c.same_heading_rad)?;
        }
        if let Some(c) = &self.forgetting {
            not_negative("forgetting.margin_m", c.margin_m)?;
            not_negative("forgetting.margin_sigmas", c.margin_sigmas)?;
            check("forgetting.min_sine", (0.0..=1.0).contains(&c.min_sine))?;
            check("forgetting.scans", c.scans > 0)?;
        }
        if let RegistrationConfig::Joint(c) = &self.registration {
            check("registration.joint.max_taken", (1..=MAX_TAKEN).contains(&usize::from(c.max_taken)))?;
            check("registration.joint.taken_per_scan", c.taken_per_scan > 0)?;
            not_negative("registration.joint.least_gain", c.least_gain)?;
            check("registration.joint.again_factor", c.again_factor >= 1.0 && c.again_factor.is_finite())?;
            positive("registration.joint.max_chi2", c.max_chi2)?;
            positive("registration.joint.kernel_chi2", c.kernel_chi2)?;
            positive("registration.joint.keyframes.way_m", c.keyframes.way_m)?;
            check("registration.joint.keyframes.scans", c.keyframes.scans > 0)?;
            not_negative("registration.joint.keyframes.spacing_between_m", c.keyframes.spacing_between_m)?;
            not_negative("registration.joint.young_scans_per_hit", c.young_scans_per_hit)?;
            positive("registration.joint.fuse_max_angle_rad", c.fuse_max_angle_rad)?;
            positive("registration.joint.fuse_max_distance_m", c.fuse_max_distance_m)?;
            positive("registration.joint.fuse_sigmas", c.fuse_sigmas)?;
            not_negative("registration.joint.fuse_gap_m", c.fuse_gap_m)?;
            not_negative("registration.joint.fuse_max_gap_m", c.fuse_max_gap_m)?;
            positive("registration.joint.fuse_chi2", c.fuse_chi2)?;
            positive("registration.joint.fuse_overlap", c.fuse_overlap)?;
        }
        Ok(())
    }
}

/// A value outside its range.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[non_exhaustive]
pub enum ConfigError {
    /// The field, by its path in [`SlamConfig`], has a value that makes no sense.
    Invalid {
        /// Path of the field.
        field: &'static str,
    },
    /// The sensor has more beams than `Slam` has room for.
    TooManyBeams {
        /// Beams the geometry describes.
        beams: usize,
        /// Beams there is room for.
        capacity: usize,
    },
}

impl core::fmt::Display for ConfigError {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        match self {
            Self::Invalid { field } => write!(f, "{field} is out of range"),
            Self::TooManyBeams { beams, capacity } => {
                write!(f, "the sensor has {beams} beams, there is room for {capacity}")
            }
        }
    }
}

impl core::error::Error for ConfigError {}

// Called seventy times and once in a lifetime: not inlined, they are 4 kB of flash less.
#[inline(never)]
fn check(field: &'static str, holds: bool) -> Result<(), ConfigError> {
    if holds { Ok(()) } else { Err(ConfigError::Invalid { field }) }
}

#[inline(never)]
fn positive(field: &'static str, value: f32) -> Result<(), ConfigError> {
    check(field, value > 0.0 && value.is_finite())
}

#[inline(never)]
fn not_negative(field: &'static str, value: f32) -> Result<(), ConfigError> {
    check(field, value >= 0.0 && value.is_finite())
}
