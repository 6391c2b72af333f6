//! The scanner: its beams, its noise, what its ranges mean.

pub mod scan;
