//! All settings, one struct for each stage, and where each value comes from.

mod validation;

use nalgebra::{Isometry2, Vector3};

use crate::ekf::config::{EkfConfig, RegistrationConfig};
use crate::ekf::keyframe::KeyframeConfig;
use crate::frontend::deskew::DeskewConfig;
use crate::frontend::extraction::{ExtractionConfig, SplitConfig};
use crate::geometry::line_noise::LineNoise;
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
pub use validation::ConfigError;
pub(crate) use validation::{Checked, check, not_negative};

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
/// seattle is ever lost (`lineslam replay`, the line `tracking`), and m08 of the drives that go wrong is. The bag of fr079, whose odometry
/// stalls, is lost once and finds itself. What may be missing while the robot stands was chosen on simulated lifts (flat, lab, hall and office,
/// seeds 1 to 5), so that it holds on these logs; their odometry stands still for up to 6 scans in turns.
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
                hypotheses_per_scan: 10,
                poses_per_scan: 11,
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
                max_joint_chi2: 9.2,
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
}
