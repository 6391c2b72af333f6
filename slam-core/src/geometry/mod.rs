//! Poses, lines and how far two lines are apart.

pub mod line_noise;
pub mod line_observation;
pub mod math;
pub mod pose;
pub mod segment;
