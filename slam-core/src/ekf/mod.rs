//! EKF-SLAM with line landmarks: pose, systematic errors of the odometry and lines in one extended Kalman filter.
//!
//! ```text
//!  scan ──► keyframe? ──► keyframe_update ──► update ──► commit ──► merging
//!                         linearize, select   deferred   inject the error state
//! ```
//!
//! | module | what |
//! |---|---|
//! | [`state`] | order of the states, scope of an update |
//! | `packed` | the covariance's storage |
//! | `measurement` | innovation and Jacobian by the states |
//! | [`filter`] | the filter, prediction, injection of the error state |
//! | `update`, `deferred` | measurement update, with its covariance downdate put off |
//! | `slots` | which line has which states; augmentation |
//! | `line_map` | map and slots, changed at once |
//! | [`keyframe`] | which scans the filter sees |
//! | `compatibility` | which pairs can all be right |
//! | [`keyframe_update`], `merging` | the update of a keyframe, spread over scans; lines that are one wall |
//! | [`config`] | settings |
//!
//! References: R. Smith, M. Self, P. Cheeseman, "Estimating uncertain spatial relationships in robotics" (1990); J. Solà,
//! "Quaternion kinematics for the error-state Kalman filter" (2017), for error state, injection and reset; S. F. Schmidt,
//! "Application of state-space methods to navigation problems" (1966), for updates of a part of the state.

mod compatibility;
pub mod config;
mod deferred;
pub mod filter;
pub mod keyframe;
pub mod keyframe_update;
pub(crate) mod line_map;
mod measurement;
mod merging;
mod packed;
mod slots;
pub mod state;
mod update;

#[cfg(test)]
mod world;

pub use config::{EkfConfig, RegistrationConfig};
pub use filter::EkfSlam;
pub use keyframe_update::{KeyframeUpdate, Observed, RegistrationReport, SensorModel, Stamp};
