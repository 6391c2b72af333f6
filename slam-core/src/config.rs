//! All settings, one struct for each stage, and where each value comes from.

use nalgebra::{Isometry2, Vector3};

use crate::ekf::config::{EkfConfig, RegistrationConfig};
use crate::ekf::keyframe::KeyframeConfig;
use crate::ekf::keyframe_update::MAX_UPDATES;
use crate::frontend::deskew::DeskewConfig;
use crate::frontend::extraction::{ExtractionConfig, SplitConfig};
use crate::geometry::line_noise::LineNoise;
use crate::geometry::math::min;
use crate::map::openings::OpeningConfig;
use crate::map::visibility::ForgetConfig;
use crate::map::walls::WallConfig;
use crate::odometry::bias::BiasConfig;
use crate::odometry::delay::DelayConfig;
use crate::odometry::monitor::MonitorConfig;
use crate::odometry::noise_learning::LearningConfig;
use crate::odometry::{Integration, OdometryNoise};
use crate::paper::bisector::BisectorConfig;
use crate::paper::end_points::{EndPointWeight, EndPointsConfig};
use crate::paper::least_squares::{LeastSquaresConfig, Singular};
use crate::paper::ransac::RansacConfig;
use crate::places::PlacesConfig;
use crate::relocalisation::RelocalisationConfig;
use crate::sensor::scan::{Mounting, RangeCodes, RangeNoise, ScanGeometry, SensorConfig};
use crate::tracking::association::{AssociationConfig, GateConfig};
use crate::tracking::correction::{CorrectionConfig, GaussNewtonConfig};
use crate::tracking::{SearchConfig, StateConfig};

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
    /// Distance between the wheels, metres, where the odometry is that of two wheels: their faults are told by it.
    pub track_m: Option<f32>,
    /// Check against the scanner, or none.
    pub monitor: Option<MonitorConfig>,
    /// Estimate of the scans' delay beyond what the robot file says, or none. [`Mapper`](crate::Mapper) uses it.
    pub delay: Option<DelayConfig>,
}

impl OdometryConfig {
    /// Standard deviations of the systematic errors before anything is learnt; zero where they are not to be.
    pub(crate) fn bias_sigmas(&self) -> Vector3<f32> {
        self.bias.map_or_else(Vector3::zeros, |bias| bias.sigmas())
    }
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
    /// Noise learnt while driving, or taken as it is configured.
    pub learning: Option<LearningConfig>,
    /// Segments to pairs.
    pub association: AssociationConfig,
    /// Pairs to pose.
    pub correction: CorrectionConfig,
    /// How far the pose is to be relied on.
    pub state: StateConfig,
    /// A robot that was displaced looks for itself in its map, or not.
    pub relocalisation: Option<RelocalisationConfig>,
    /// Places, and loops between them closed, or not.
    pub places: Option<PlacesConfig>,
    /// What is seen through forgotten, or not.
    pub forgetting: Option<ForgetConfig>,
    /// Cutting of what was seen through or driven through in part; together with forgetting only.
    pub openings: Option<OpeningConfig>,
    /// Walls told from what is tentative, or every line taken for a wall; what is tentative is forgotten together with what is seen
    /// through.
    pub walls: Option<WallConfig>,
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

/// Half of a scan explained is good, a quarter is bad. With these none of fr079, mit-csail, aces, exp1, exp3, csail, fr101 and
/// seattle is ever lost (`lineslam replay`, the line `tracking`), and m08 of the drives that go wrong is.
const STATE: StateConfig = StateConfig {
    good_score: 0.5,
    bad_score: 0.25,
    uncertain_after: 3,
    lost_after: 10,
    lost_way_m: 8.0,
    least_segments: 2,
    found_after: 3,
    contradicted_share: 0.5,
    most_missing: 1.5,
    standing_slack: 0.25,
    standing_m: 0.1,
};

/// Prior: a host that stamps a scan as its last byte comes is late by half a sweep and the way there, some 50 ms. The limit is what the
/// firmware's 0.32 s of odometry have to spare. The other two were chosen on simulated drives and on recorded logs: where slips
/// are common (`lineslam simulate --real` in the hall) the estimate is off by three of its sigmas now and then, so that only a small
/// one is trusted.
const DELAY: DelayConfig = DelayConfig { sigma_s: 0.05, max_s: 0.1, max_sigma_s: 0.008, significance: 4.0 };

/// Way, gates and confirmations are a prototype's, on six logs. Chosen on mit-csail and fr079.bag, checked on aces, csail, exp1 and exp3
/// (`lineslam benchmark`): `min_share` (0.5 to 0.6 are alike), `seen_within_m` (3 closes hardly any loop, 6 is alike), `local_m` (5 and 20 cost
/// fr079 3 to 12 mm online). `sigma_scale` from 1 to 3 is alike.
pub(crate) const PLACES: PlacesConfig = PlacesConfig {
    way_m: 4.0,
    turn_rad: core::f32::consts::FRAC_PI_2,
    seen_within_m: 4.5,
    sigma_scale: 1.5,
    min_way_m: 15.0,
    reach_m: 5.0,
    max_chi2: 16.0,
    min_share: 0.55,
    max_runner_up: 0.8,
    min_information: 200.0,
    confirmations: 1,
    same_position_m: 0.35,
    same_heading_rad: 0.07,
    min_gain: 0.5,
    local_m: 10.0,
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
        // Copied from flash, not put together in code.
        const BEST: SlamConfig = SlamConfig {
            sensor: PAPER_SENSOR,
            odometry: OdometryConfig {
                integration: Integration::Arc,
                noise: ODOMETRY_NOISE,
                track_m: None,
                bias: Some(BiasConfig { sigma_distance: 0.01, sigma_turn: 0.01, sigma_turn_per_m: 0.005 }),
                monitor: Some(MonitorConfig {
                    min_score: 0.5,
                    useless_ratio: 0.7,
                    useful_ratio: 0.2,
                    memory_m: 2.0,
                    unknown_share: 0.7,
                    unknown_floor: [0.02, 0.02],
                }),
                delay: Some(DELAY),
            },
            deskew: DeskewConfig { enabled: true },
            extraction: ExtractionConfig::Split(SplitConfig {
                max_gap_m: 0.05,
                min_incidence_rad: 0.17,
                max_missing_beams: 4,
                max_unseen_m: 0.5,
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
            learning: Some(LearningConfig {
                line_scans: 15.0,
                least_sigma_offset_m: 0.006,
                offset_per_residual: 0.8,
                odometry_pieces: 8.0,
                piece_m: 0.5,
                least_share: 0.1,
                max_sigma_m: 0.06,
            }),
            association: AssociationConfig::Gated(GateConfig {
                max_angle_rad: 0.35,
                max_distance_m: 0.6,
                max_chi2: 13.8,
                min_overlap: 0.3,
                max_overlap_slack_m: 1.0,
            }),
            correction: CorrectionConfig::MaximumAPosteriori(GaussNewtonConfig {
                max_iterations: 8,
                converged_step: 1e-3,
                kernel_chi2: 4.0,
                close_heading_rad: 0.02,
                direction_trust_rad: 0.02,
                observable_sigma_m: 0.1,
                search: SearchConfig {
                    below_score: 0.8,
                    reach_rad: 0.6,
                    widen: [0.05, 0.3],
                    widen_per_m: 0.2,
                    proposed: [0.1, 0.05],
                    gain: 0.03,
                    more_segments: 1.0,
                    more_segments_from_nothing: 0.8,
                    something_score: 0.45,
                    loss_per_chi2: 0.002,
                    far_rad: 0.07,
                    far_score: 0.5,
                    far_score_from_nothing: 0.35,
                    nothing_score: 0.3,
                    wild_chi2: 30.0,
                    suspicious_chi2: 6.0,
                    suspicious_scans: 2,
                },
            }),
            state: STATE,
            relocalisation: Some(RelocalisationConfig {
                places_per_scan: 1,
                guesses_per_scan: 10,
                least_segments: 3,
                least_support: 0.45,
                min_support: 0.7,
                max_runner_up: 0.65,
                min_odds: 5.0,
                scans: 5,
                apart_m: 0.07,
                min_lead: 2.0,
                give_up_m: 8.0,
            }),
            places: Some(PLACES),
            forgetting: Some(ForgetConfig { margin_m: 0.2, margin_sigmas: 3.0, min_sine: 0.1, scans: 3 }),
            walls: Some(WallConfig {
                min_hits: 3,
                max_gap_m: 0.15,
                sines: [0.05, 0.8],
                max_bridge_m: 2.5,
                forget_m: 10.0,
                revisit_m: 15.0,
                max_twin_gap_m: 0.1,
                lines_per_keyframe: 4,
            }),
            openings: Some(OpeningConfig {
                min_width_m: 0.4,
                passage_m: 0.5,
                lines_per_scan: 8,
                min_hits: 3,
            }),
            registration: RegistrationConfig::Ekf(EkfConfig {
                keyframes: KeyframeConfig {
                    way_m: 0.15,
                    scans: 10,
                    at_start: 10,
                    spacing_between_m: 0.07,
                    min_score: 0.4,
                    scans_below: 6,
                    way_below_m: 1.6,
                },
                max_updates: 12,
                max_full_updates: 6,
                updates_per_scan: 6,
                min_information_ratio: 0.1,
                reactivation_inflation: 2.0,
                max_nis: 60.0,
                kernel_nis: 2.0,
                tentative_hits: 4,
                tentative_scans_per_hit: 2.1,
                merge_max_angle_rad: 0.1,
                merge_max_distance_m: 0.25,
                merge_gap_m: 0.2,
                wall_max_gap_m: 1.0,
                merge_max_nis: 4.0,
                merge_sigmas: 16.0,
                merge_overlap: 0.5,
            }),
        };
        BEST
    }
}

impl SlamConfig {
    /// The paper, literally: [`paper`](crate::paper) goes through its equations. Values the paper does not state are marked as
    /// ours.
    pub fn paper() -> Self {
        Self {
            sensor: PAPER_SENSOR,
            odometry: OdometryConfig {
                integration: Integration::Euler,
                noise: ODOMETRY_NOISE,
                bias: None,
                track_m: None,
                monitor: None,
                delay: None,
            },
            deskew: DeskewConfig { enabled: false },
            extraction: ExtractionConfig::Ransac(RansacConfig {
                draws: 50,               // ours
                inlier_distance_m: 0.03, // ours: the sensor's ±30 mm
                max_gap_m: 0.2,          // ours
                min_inliers: 6,          // ours
                seed: 1,
            }),
            line_noise: LineNoise { sigma_offset_m: 0.0, sigma_direction_rad: 0.0 },
            learning: None,
            association: AssociationConfig::Bisector(BisectorConfig { max_distance_m: 0.3 }), // ours
            correction: CorrectionConfig::LeastSquares(LeastSquaresConfig {
                singular_share: 1e-3, // ours
                singular: Singular::KeepPose,
            }),
            state: STATE,
            relocalisation: None,
            places: None,
            forgetting: None,
            openings: None,
            walls: None,
            registration: RegistrationConfig::EndPoints(EndPointsConfig { weight: EndPointWeight::Equal }),
        }
    }

    /// The paper but for one thing: when segments are merged, an end point weighs as many points as it stands for, as it does
    /// in equation (3).
    pub fn paper_weighted() -> Self {
        let weight = EndPointWeight::Inliers;
        Self { registration: RegistrationConfig::EndPoints(EndPointsConfig { weight }), ..Self::paper() }
    }

    /// [`Self::paper_weighted`] but for one thing: where a system is singular, the directions that are observed are corrected.
    /// One step from the paper towards the default.
    pub fn paper_partial() -> Self {
        Self {
            correction: CorrectionConfig::LeastSquares(LeastSquaresConfig {
                singular_share: 1e-2,
                singular: Singular::CorrectObserved,
            }),
            ..Self::paper_weighted()
        }
    }

    /// The same with other luck in what RANSAC draws; a configuration without RANSAC stays as it is. A scan's number is added
    /// to the seed: seeds that are to have nothing in common lie farther apart than a log has scans.
    #[must_use]
    pub fn with_ransac_seed(mut self, seed: u64) -> Self {
        if let ExtractionConfig::Ransac(config) = &mut self.extraction {
            config.seed = seed;
        }
        self
    }

    /// Checks every value; the error names the field.
    pub fn validate(&self) -> Result<(), ConfigError> {
        let checked = self
            .validate_sensor()
            .and_then(|()| self.validate_odometry())
            .and_then(|()| self.validate_stages());
        checked.map_err(|field| ConfigError::Invalid { field })
    }

    fn validate_sensor(&self) -> Checked {
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
        check(
            "sensor.mounting.base_from_laser",
            crate::geometry::pose::is_finite(&s.mounting.base_from_laser),
        )
    }

    fn validate_odometry(&self) -> Checked {
        let n = &self.odometry.noise;
        not_negative("odometry.noise.sigma_along_m_per_sqrt_m", n.sigma_along_m_per_sqrt_m)?;
        not_negative("odometry.noise.sigma_across_m_per_sqrt_m", n.sigma_across_m_per_sqrt_m)?;
        not_negative("odometry.noise.sigma_heading_rad_per_sqrt_m", n.sigma_heading_rad_per_sqrt_m)?;
        not_negative("odometry.noise.sigma_heading_rad_per_sqrt_rad", n.sigma_heading_rad_per_sqrt_rad)?;
        // The prior is inverted: at rest these are all there is.
        positive("odometry.noise.sigma_position_floor_m", n.sigma_position_floor_m)?;
        positive("odometry.noise.sigma_heading_floor_rad", n.sigma_heading_floor_rad)?;
        if let Some(track_m) = self.odometry.track_m {
            positive("odometry.track_m", track_m)?;
        }
        if let Some(m) = &self.odometry.monitor {
            not_negative("odometry.monitor.min_score", m.min_score)?;
            positive("odometry.monitor.useless_ratio", m.useless_ratio)?;
            positive("odometry.monitor.useful_ratio", m.useful_ratio)?;
            positive("odometry.monitor.memory_m", m.memory_m)?;
            positive("odometry.monitor.unknown_share", m.unknown_share)?;
            positive("odometry.monitor.unknown_floor", min(m.unknown_floor[0], m.unknown_floor[1]))?;
        }
        if let Some(d) = &self.odometry.delay {
            positive("odometry.delay.sigma_s", d.sigma_s)?;
            not_negative("odometry.delay.max_s", d.max_s)?;
            positive("odometry.delay.max_sigma_s", d.max_sigma_s)?;
            not_negative("odometry.delay.significance", d.significance)?;
        }
        if let Some(b) = &self.odometry.bias {
            not_negative("odometry.bias.sigma_distance", b.sigma_distance)?;
            not_negative("odometry.bias.sigma_turn", b.sigma_turn)?;
            not_negative("odometry.bias.sigma_turn_per_m", b.sigma_turn_per_m)?;
        }
        Ok(())
    }

    fn validate_stages(&self) -> Checked {
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
                not_negative("extraction.split.max_unseen_m", c.max_unseen_m)?;
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
        if let CorrectionConfig::LeastSquares(c) = &self.correction {
            let share = c.singular_share;
            check("correction.least_squares.singular_share", (0.0..1.0).contains(&share))?;
        }
        if let CorrectionConfig::MaximumAPosteriori(c) = &self.correction {
            check("correction.maximum_a_posteriori.max_iterations", c.max_iterations > 0)?;
            not_negative("correction.maximum_a_posteriori.converged_step", c.converged_step)?;
            positive("correction.maximum_a_posteriori.kernel_chi2", c.kernel_chi2)?;
            not_negative("correction.maximum_a_posteriori.close_heading_rad", c.close_heading_rad)?;
            not_negative("correction.maximum_a_posteriori.direction_trust_rad", c.direction_trust_rad)?;
            positive("correction.maximum_a_posteriori.observable_sigma_m", c.observable_sigma_m)?;
            c.search.validate()?;
        }
        if let Some(l) = &self.learning {
            check("learning.line_scans", l.line_scans >= 1.0 && l.line_scans.is_finite())?;
            positive("learning.least_sigma_offset_m", l.least_sigma_offset_m)?;
            positive("learning.offset_per_residual", l.offset_per_residual)?;
            check("learning.odometry_pieces", l.odometry_pieces >= 1.0 && l.odometry_pieces.is_finite())?;
            positive("learning.piece_m", l.piece_m)?;
            check("learning.least_share", l.least_share > 0.0 && l.least_share <= 1.0)?;
            positive("learning.max_sigma_m", l.max_sigma_m)?;
        }
        not_negative("state.good_score", self.state.good_score)?;
        not_negative("state.bad_score", self.state.bad_score)?;
        positive("state.lost_way_m", self.state.lost_way_m)?;
        positive("state.contradicted_share", self.state.contradicted_share)?;
        not_negative("state.standing_slack", self.state.standing_slack)?;
        not_negative("state.standing_m", self.state.standing_m)?;
        positive("state.most_missing", self.state.most_missing)?;
        if let Some(relocalisation) = &self.relocalisation {
            relocalisation.validate()?;
            // It looks for itself around places.
            check("relocalisation", self.places.is_some())?;
        }
        if let Some(places) = &self.places {
            places.validate()?;
        }
        if let Some(c) = &self.forgetting {
            not_negative("forgetting.margin_m", c.margin_m)?;
            not_negative("forgetting.margin_sigmas", c.margin_sigmas)?;
            check("forgetting.min_sine", (0.0..=1.0).contains(&c.min_sine))?;
            check("forgetting.scans", c.scans > 0)?;
        }
        if let Some(c) = &self.walls {
            c.validate()?;
        }
        if let Some(c) = &self.openings {
            positive("openings.min_width_m", c.min_width_m)?;
            positive("openings.passage_m", c.passage_m)?;
        }
        if let RegistrationConfig::Ekf(c) = &self.registration {
            check("registration.ekf.max_updates", (1..=MAX_UPDATES).contains(&usize::from(c.max_updates)))?;
            check("registration.ekf.updates_per_scan", c.updates_per_scan > 0)?;
            not_negative("registration.ekf.min_information_ratio", c.min_information_ratio)?;
            check(
                "registration.ekf.reactivation_inflation",
                c.reactivation_inflation >= 1.0 && c.reactivation_inflation.is_finite(),
            )?;
            positive("registration.ekf.max_nis", c.max_nis)?;
            positive("registration.ekf.kernel_nis", c.kernel_nis)?;
            positive("registration.ekf.keyframes.way_m", c.keyframes.way_m)?;
            check("registration.ekf.keyframes.scans", c.keyframes.scans > 0)?;
            not_negative("registration.ekf.keyframes.spacing_between_m", c.keyframes.spacing_between_m)?;
            not_negative("registration.ekf.keyframes.min_score", c.keyframes.min_score)?;
            not_negative("registration.ekf.keyframes.way_below_m", c.keyframes.way_below_m)?;
            not_negative("registration.ekf.tentative_scans_per_hit", c.tentative_scans_per_hit)?;
            positive("registration.ekf.merge_max_angle_rad", c.merge_max_angle_rad)?;
            positive("registration.ekf.merge_max_distance_m", c.merge_max_distance_m)?;
            positive("registration.ekf.merge_sigmas", c.merge_sigmas)?;
            not_negative("registration.ekf.merge_gap_m", c.merge_gap_m)?;
            not_negative("registration.ekf.wall_max_gap_m", c.wall_max_gap_m)?;
            positive("registration.ekf.merge_max_nis", c.merge_max_nis)?;
            positive("registration.ekf.merge_overlap", c.merge_overlap)?;
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

/// Fine, or the field that is not. It fits into registers, which is 0.5 kB of flash less than a [`ConfigError`] after each check.
pub(crate) type Checked = Result<(), &'static str>;

// Called seventy times and once in a lifetime: not inlined, they are 4 kB of flash less.
#[inline(never)]
pub(crate) fn check(field: &'static str, holds: bool) -> Checked {
    if holds { Ok(()) } else { Err(field) }
}

#[inline(never)]
fn positive(field: &'static str, value: f32) -> Checked {
    check(field, value > 0.0 && value.is_finite())
}

#[inline(never)]
pub(crate) fn not_negative(field: &'static str, value: f32) -> Checked {
    check(field, value >= 0.0 && value.is_finite())
}
