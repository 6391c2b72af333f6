//! Room for a whole floor: the capacities of the firmware and of whatever stands in for it on a PC, so that both compute the same.

/// Map segments.
pub const SEGMENTS: usize = 1024;
/// Places.
pub const PLACES: usize = 256;
