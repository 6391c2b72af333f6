//! Poses, lines and how far two lines are apart.

pub mod line_noise;
pub mod math;
pub mod pose;
pub mod residual;
pub mod segment;
