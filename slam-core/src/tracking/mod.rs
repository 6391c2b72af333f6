//! Where the robot is, scan by scan: hypotheses of the pose, and the one that explains the scan best.
//!
//! ```text
//!  prior ──► Gauss–Newton with re-association ──► hypothesis ──► does it explain the scan? ── yes ──► tracked
//!                        ▲                                              │ no
//!                        └── headings, shifts ◄── heading search ◄──────┘
//! ```
//!
//! [`Tracker`] owns the candidates among the map's lines and makes [`Hypothesis`] after hypothesis; [`heading_search`] proposes
//! poses from the scan itself, without asking the wheels; [`state`] says whether the outcome is to be relied on.

pub mod association;
pub mod correction;
mod evidence;
pub mod heading_search;
pub mod hypothesis;
mod search;
pub mod state;
pub mod tracker;

pub use hypothesis::Hypothesis;
pub use search::SearchConfig;
pub use state::{StateConfig, TrackingState};
pub use tracker::Tracker;
