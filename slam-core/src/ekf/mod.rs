//! Pose, odometry errors and lines in one extended Kalman filter, which takes in keyframes.
//!
//! [`keyframe`] says which scans, [`registration`] what is measured of them and which lines are one wall, [`joint`] is the filter.

pub mod joint;
pub mod keyframe;
pub mod registration;
mod told;
