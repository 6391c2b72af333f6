//! Settings: how segments enter the map.

use crate::ekf::keyframe::KeyframeConfig;
#[cfg(doc)]
use crate::ekf::keyframe_update::MAX_UPDATES;
use crate::ekf::update::UpdateGate;
use crate::paper::end_points::EndPointsConfig;

/// How segments enter the map.
#[derive(Clone, Copy, Debug, PartialEq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize), serde(rename_all = "snake_case"))]
pub enum RegistrationConfig {
    /// Equation (10) and Fig. 6 of the paper.
    EndPoints(EndPointsConfig),
    /// EKF-SLAM: lines are estimated together with the pose, walls merged.
    Ekf(EkfConfig),
}

impl RegistrationConfig {
    /// Settings of the filter, where there is one.
    pub(crate) fn ekf(&self) -> Option<&EkfConfig> {
        match self {
            Self::EndPoints(_) => None,
            Self::Ekf(config) => Some(config),
        }
    }
}

/// Settings of the filter.
#[derive(Clone, Copy, Debug, PartialEq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct EkfConfig {
    /// Which scans are keyframes.
    pub keyframes: KeyframeConfig,
    /// Most lines of a keyframe that are measured, those with the largest information ratio; no more than [`MAX_UPDATES`].
    pub max_updates: u8,
    /// Most of those that update all states; the others update only the robot and the line itself (Schmidt–Kalman).
    pub max_full_updates: u8,
    /// Most updates during one scan, so that none takes long. They begin with the scan after the keyframe; where keyframes
    /// follow each other, all are made at once.
    pub updates_per_scan: u8,
    /// An innovation is left out where its information ratio is less: variance of what is expected, H·P·Hᵀ, over that of the
    /// measurement, R.
    pub min_information_ratio: f32,
    /// Factor on the variances of a line that enters the state again. Its correlations with its neighbours were dropped; taken for
    /// independent, many such lines would make the pose overconfident.
    pub reactivation_inflation: f32,
    /// A pair with a larger normalised innovation squared is rejected.
    pub max_nis: f32,
    /// Largest χ² between two observed segments that are one line of the map, by their own errors; 9.2 is the 99 % point.
    pub max_joint_chi2: f32,
    /// From this normalised innovation squared on, a pair's R grows in proportion to it.
    pub kernel_nis: f32,
    /// A line seen in fewer scans than this is tentative. A tentative one that is seen only now and then may be walking, or
    /// nothing: the pose is not updated by it.
    pub tentative_hits: u16,
    /// Now and then: in fewer than one of so many scans since it was first seen.
    pub tentative_scans_per_hit: f32,
    /// Two lines with a larger angle between them are two walls, radians.
    pub merge_max_angle_rad: f32,
    /// Two lines of which an end lies farther than this off the other are two walls, metres.
    pub merge_max_distance_m: f32,
    /// Two lines with a wider gap between them, along, are two pieces, metres, …
    pub merge_gap_m: f32,
    /// … but of one wall where the gap is no longer than either, up to this, metres: a wall with a door in it.
    pub wall_max_gap_m: f32,
    /// Within these bounds, largest normalised innovation squared between two lines that are one wall.
    pub merge_max_nis: f32,
    /// Overlapping lines closer than this many standard deviations of a line's offset are one wall whatever their innovation: one
    /// would hide the other.
    pub merge_sigmas: f32,
    /// Share of the shorter one that must overlap for that.
    pub merge_overlap: f32,
}

impl EkfConfig {
    pub(crate) fn gate(&self) -> UpdateGate {
        UpdateGate {
            max_nis: self.max_nis,
            kernel_nis: self.kernel_nis,
            min_information_ratio: self.min_information_ratio,
        }
    }

    /// Two lines that are one wall are measured against each other with all their information.
    pub(crate) fn merge_gate(&self) -> UpdateGate {
        UpdateGate { max_nis: self.merge_max_nis, kernel_nis: f32::INFINITY, min_information_ratio: 0.0 }
    }
}
