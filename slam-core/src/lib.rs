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
//!  ranges_mm ──► deskew ──► extraction ──► association ◄──┐ ──► registration ──► map
//!                  ▲        [Segment]       [Pair] │      │       [Joint]         │
//!  ticks ──► odometry ──► predicted pose ────────► [Tracker] ───────► │ ▲    forgetting
//!            [OdometryTrack]  ▲              correction, heading search│ │          │
//!                             └───── pose, odometry's errors ◄───────┘ loop closure
//! ```
//!
//! The correction finds which segment is which, and a pose good enough to make everything linear. Of the scans that are
//! [`keyframe`]s the joint estimate then has the last word on the pose, on the odometry's errors and on the lines, a few
//! scans later.
//!
//! [`Slam::process_scan`](slam::Slam::process_scan) is that drawing; each stage is a module of its own and can be used
//! without it.
//!
//! # Frames and units
//! Frames follow REP 105: `map`, `odom`, `base` (middle of the axle, x forward, y left, counter-clockwise positive) and
//! `laser`. A transform `map_from_base` takes coordinates in `base` to `map`; `pose` alone always means
//! `map_from_base`. Metres, radians, seconds, `f32`; raw values carry their unit in the name (`range_mm`, `stamp_us`).
//! Times are those of the middle beam of a scan.
//!
//! # Reading order
//! [`mapper`] for the one door, [`slam`] for the whole behind it, [`segment`] for what a line is, then the stages in the
//! order of the drawing. [`config`] has every constant and where it comes from.
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

pub mod association;
pub mod config;
pub mod correction;
pub mod deskew;
pub mod extraction;
pub mod joint;
pub mod keyframe;
pub mod loop_closure;
pub mod map;
pub mod mapper;
pub mod math;
pub mod nearby;
pub mod noise_learning;
pub mod odometry;
pub mod odometry_bias;
pub mod odometry_delay;
pub mod odometry_monitor;
pub mod odometry_track;
pub mod paper;
pub mod pose;
pub mod registration;
pub mod residual;
pub mod scan;
pub mod segment;
pub mod slam;
mod told;
pub mod tracking;
pub mod update;
pub mod visibility;
pub mod wheel_faults;

pub use config::{ConfigError, SlamConfig};
pub use map::{MapSegment, SegmentMap};
pub use mapper::{Mapper, WheelTicks};
pub use odometry_track::{OdometryTrack, ScanMotion};
pub use scan::Scan;
pub use segment::Segment;
pub use slam::{Slam, SlamUpdate};
