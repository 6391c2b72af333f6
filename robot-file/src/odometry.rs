//! `[odometry_noise]`: how fast odometry grows uncertain.

use std::path::{Path, PathBuf};

use serde::Deserialize;
use slam_core::odometry::OdometryNoise;

use crate::profile::{self, needed};
use crate::toml_file::{FileError, Impossible, not_negative, positive};

/// `[odometry_noise]`, standard deviations that grow with the square root of the way.
#[derive(Clone, Copy, Debug)]
pub struct NoiseFile {
    along_m_per_sqrt_m: f32,
    across_m_per_sqrt_m: f32,
    heading_deg_per_sqrt_m: f32,
    /// Degrees for each square root of a degree turned.
    heading_deg_per_sqrt_turn_deg: f32,
    position_floor_m: f32,
    heading_floor_deg: f32,
}

/// The same as written, in a robot file or in a profile.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct NoiseText {
    profile: Option<String>,
    along_m_per_sqrt_m: Option<f32>,
    across_m_per_sqrt_m: Option<f32>,
    heading_deg_per_sqrt_m: Option<f32>,
    heading_deg_per_sqrt_turn_deg: Option<f32>,
    position_floor_m: Option<f32>,
    heading_floor_deg: Option<f32>,
}

impl NoiseText {
    /// With the profile that it names, if any.
    pub(crate) fn complete(self, path: &Path, files: &mut Vec<PathBuf>) -> Result<NoiseFile, FileError> {
        let in_file = |(key, reason): Impossible| FileError::Impossible {
            path: path.to_owned(),
            key: format!("odometry_noise.{key}"),
            reason,
        };
        let Some(name) = self.profile.clone() else { return self.whole().map_err(in_file) };
        let key = "odometry_noise.profile";
        let (profile, profile_path) = profile::read::<Self>(&name, key, &profile::ODOMETRY, path, files)?;
        let in_profile = |(key, reason)| FileError::Impossible { path: profile_path.clone(), key, reason };
        if profile.profile.is_some() {
            return Err(in_profile(("profile".into(), "a profile cannot name another".into())));
        }
        profile.clone().whole().map_err(in_profile)?;
        self.over(profile).whole().map_err(in_file)
    }

    fn over(self, profile: Self) -> Self {
        Self {
            profile: None,
            along_m_per_sqrt_m: self.along_m_per_sqrt_m.or(profile.along_m_per_sqrt_m),
            across_m_per_sqrt_m: self.across_m_per_sqrt_m.or(profile.across_m_per_sqrt_m),
            heading_deg_per_sqrt_m: self.heading_deg_per_sqrt_m.or(profile.heading_deg_per_sqrt_m),
            heading_deg_per_sqrt_turn_deg: self
                .heading_deg_per_sqrt_turn_deg
                .or(profile.heading_deg_per_sqrt_turn_deg),
            position_floor_m: self.position_floor_m.or(profile.position_floor_m),
            heading_floor_deg: self.heading_floor_deg.or(profile.heading_floor_deg),
        }
    }

    fn whole(self) -> Result<NoiseFile, Impossible> {
        let noise = NoiseFile {
            along_m_per_sqrt_m: needed("along_m_per_sqrt_m", self.along_m_per_sqrt_m)?,
            across_m_per_sqrt_m: needed("across_m_per_sqrt_m", self.across_m_per_sqrt_m)?,
            heading_deg_per_sqrt_m: needed("heading_deg_per_sqrt_m", self.heading_deg_per_sqrt_m)?,
            heading_deg_per_sqrt_turn_deg: needed(
                "heading_deg_per_sqrt_turn_deg",
                self.heading_deg_per_sqrt_turn_deg,
            )?,
            position_floor_m: needed("position_floor_m", self.position_floor_m)?,
            heading_floor_deg: needed("heading_floor_deg", self.heading_floor_deg)?,
        };
        not_negative("along_m_per_sqrt_m", noise.along_m_per_sqrt_m)?;
        not_negative("across_m_per_sqrt_m", noise.across_m_per_sqrt_m)?;
        not_negative("heading_deg_per_sqrt_m", noise.heading_deg_per_sqrt_m)?;
        not_negative("heading_deg_per_sqrt_turn_deg", noise.heading_deg_per_sqrt_turn_deg)?;
        positive("position_floor_m", noise.position_floor_m)?;
        positive("heading_floor_deg", noise.heading_floor_deg)?;
        Ok(noise)
    }
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

    /// For the core.
    pub(crate) fn core(&self) -> OdometryNoise {
        OdometryNoise {
            sigma_along_m_per_sqrt_m: self.along_m_per_sqrt_m,
            sigma_across_m_per_sqrt_m: self.across_m_per_sqrt_m,
            sigma_heading_rad_per_sqrt_m: self.heading_deg_per_sqrt_m.to_radians(),
            sigma_heading_rad_per_sqrt_rad: self.heading_deg_per_sqrt_turn_deg * 1f32.to_radians().sqrt(),
            sigma_position_floor_m: self.position_floor_m,
            sigma_heading_floor_rad: self.heading_floor_deg.to_radians(),
        }
    }
}
