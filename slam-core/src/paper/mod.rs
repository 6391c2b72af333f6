//! "Least-square Matching for Mobile Robot SLAM Based on Line-segment Model", in the order of its equations.
//!
//! | paper | what | here |
//! |---|---|---|
//! | (1) | the encoders' speeds predict the pose, by Euler's step | [`Integration::Euler`](crate::odometry::Integration) |
//! | 2.1 | a scan becomes line segments with a weight n, the number of their inliers | [`ransac`] |
//! | 2.2 | a segment is found in the map, or is new | [`bisector`] |
//! | (3)–(9) | the pairs correct the pose, once; a singular system leaves it alone | [`least_squares`](mod@least_squares) |
//! | (10), Fig. 6 | what was seen enters the map by the corrected pose | [`end_points`] |
//! | (11) | corners of the map are held against those of the blueprint | `sim::judge` of `lineslam`, on the PC |
//!
//! [`SlamConfig::paper`](crate::SlamConfig::paper) is this and nothing else; [`config`](crate::config) says which values are ours
//! because the paper does not state them. Each deviation is a setting of its stage and has a configuration of its own:
//!
//! | configuration | differs from the one above in |
//! |---|---|
//! | [`paper`](crate::SlamConfig::paper) | nothing |
//! | [`paper_weighted`](crate::SlamConfig::paper_weighted) | [`EndPointWeight::Inliers`](end_points::EndPointWeight) |
//! | [`paper_partial`](crate::SlamConfig::paper_partial) | [`Singular::CorrectObserved`](least_squares::Singular) |
//!
//! Covariances are not the paper's, which has none. They are reported, and nothing here is decided by them.

pub mod bisector;
pub mod end_points;
#[cfg(test)]
pub mod fixtures;
pub mod least_squares;
pub mod ransac;
