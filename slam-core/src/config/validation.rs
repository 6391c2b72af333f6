//! What values of a configuration make sense.

use super::{MOST_OF_A_TURN, SlamConfig};
use crate::ekf::config::RegistrationConfig;
use crate::ekf::keyframe_update::MAX_UPDATES;
use crate::frontend::extraction::ExtractionConfig;
use crate::geometry::math::min;
use crate::tracking::association::AssociationConfig;
use crate::tracking::correction::CorrectionConfig;

impl SlamConfig {
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
            positive("registration.ekf.max_joint_chi2", c.max_joint_chi2)?;
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
