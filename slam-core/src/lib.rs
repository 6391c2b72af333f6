//! Line-segment SLAM for a microcontroller: a laser scanner, two wheel encoders, a map of line segments in fixed
//! memory. No allocation, no `unsafe`, no clock, no panic; plain `f32`, one `libm` and the root of IEEE 754, so that
//! every machine computes the same bits (tested on the PC and on a Cortex-M4F in emulation).
//!
//! The algorithm is that of "Least-square Matching for Mobile Robot SLAM Based on Line-segment Model":
//! [`SlamConfig::paper`] is what its text says ([`paper`] goes through the equations), [`SlamConfig::default`] our best, through
//! the same pipeline. What the paper's deviates from its text in has a name of its own: [`SlamConfig::paper_weighted`],
//! [`SlamConfig::paper_partial`].
//!
//! ```text
//!  ranges_mm ──► frontend ──────────► tracking ───────────────────► registration ──► map ◄──► places
//!                deskew, extraction   association,                  ekf: EkfSlam      │         chain, finding,
//!                  ▲     [Segment]    correction, [Pair]             ▲ │          forgetting     solver
//!                  │                  heading search                 │ │              │
//!  ticks ──► odometry ──► predict ───────┴──► pose ──────────────────┘ │              │
//!            [OdometryTrack]  ▲                                        ▼              ▼
//!                  ▲          └───────── pose, its covariance, the odometry's errors, lines
//!                  └── monitor, noise and wheel faults, by what the scan says
//! ```
//!
//! [`Slam::process_scan`](slam::Slam::process_scan) reads like that drawing: predict, observe, track, monitor the odometry, judge
//! the state, register, forget, keep the places. Each stage is a folder of its own and can be used without it.
//!
//! The correction finds which segment is which, and a pose good enough to make everything linear. Of the scans that are
//! [`keyframe`](ekf::keyframe)s the filter then has the last word on the pose, on the odometry's errors and on the lines,
//! a few scans later.
//!
//! # Frames and units
//! Frames follow REP 105: `map`, `odom`, `base` (middle of the axle, x forward, y left, counter-clockwise positive) and
//! `laser`. A transform `map_from_base` takes coordinates in `base` to `map`; `pose` alone always means
//! `map_from_base`. Metres, radians, seconds, `f32`; raw values carry their unit in the name (`range_mm`, `stamp_us`).
//! Times are those of the middle beam of a scan.
//!
//! # Reading order
//! [`mapper`] for the one door, [`slam`] for the whole, [`geometry::segment`] for what a line is, [`sensor`] and [`odometry`]
//! for what comes in, then the stages in the order of the drawing: [`frontend`], [`tracking`], [`ekf`], [`map`] and [`places`], and [`paper`] for
//! the paper's own. [`config`] has every constant and where it comes from.
//!
//! # Example
//! ```
//! use slam_core::odometry::DifferentialDrive;
//! use slam_core::{Mapper, SlamConfig, WheelTicks};
//!
//! let config = SlamConfig::default(); // a URG-04LX, 0.140 m ahead of the axle
//! let drive = DifferentialDrive {
//!     left_wheel_radius_m: 0.05,
//!     right_wheel_radius_m: 0.05,
//!     track_m: 0.3,
//!     ticks_per_turn: 2000.0,
//! };
//! let mut mapper = Mapper::<128, 32>::new(config, drive)?;
//!
//! // As often as the encoders are sampled:
//! for (stamp_us, left, right) in [(0, 0, 0), (50_000, 4, 11), (100_000, 14, 22)] {
//!     mapper.push(WheelTicks { stamp_us, left, right });
//! }
//! // As often as the sensor delivers a scan, whose middle beam was taken at 60 ms:
//! let ranges_mm = [2000u16; 682];
//! let update = mapper.scan(60_000, &ranges_mm).expect("there is odometry for it");
//! assert_eq!(update.rejected, None);
//! # Ok::<(), slam_core::ConfigError>(())
//! ```
#![no_std]
#![forbid(unsafe_code)]
#![deny(missing_docs)]
#![cfg_attr(
    not(test),
    deny(clippy::indexing_slicing, clippy::unwrap_used, clippy::expect_used, clippy::panic)
)]
#![cfg_attr(test, allow(clippy::disallowed_methods))]

#[cfg(test)]
extern crate std;

pub mod capacity;
pub mod config;
pub mod ekf;
mod estimator;
mod few;
pub mod frontend;
pub mod geometry;
pub mod map;
pub mod mapper;
pub mod odometry;
pub mod paper;
pub mod places;
pub mod relocalisation;
pub mod sensor;
pub mod slam;
pub mod tracking;
pub mod update;

pub use config::{ConfigError, SlamConfig};
pub use geometry::segment::Segment;
pub use map::{MapSegment, SegmentMap};
pub use mapper::{Mapper, WheelTicks};
pub use odometry::track::{OdometryTrack, ScanMotion};
pub use sensor::scan::Scan;
pub use slam::{Slam, SlamUpdate};
