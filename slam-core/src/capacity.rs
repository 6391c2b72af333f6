//! Room for a whole floor: the capacities of the firmware and of whatever stands in for it on a PC, so that both compute the same.

/// Map segments.
pub const SEGMENTS: usize = 1024;
/// Places.
pub const PLACES: usize = 256;
/// Samples of the odometry: 0.32 s of the firmware's. They decide when an older motion is taken together, and with that the last bits.
pub const SAMPLES: usize = 64;
