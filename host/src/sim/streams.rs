//! A stream of random numbers for each error, so that one that is turned off does not move the others.

use rand_distr::{Distribution, StandardNormal};
use rand_pcg::Pcg64;

/// What a stream is for. The numbers are part of what a seed means.
#[derive(Clone, Copy, Debug)]
pub enum Stream {
    /// The base's radii and track, and the slip of its wheels.
    Base = 1,
    /// Noise of the ranges.
    Scanner = 2,
    /// Slip in turns.
    TurnSlip,
    /// Slip at starts.
    StartSlip,
    /// Wheels that spin for a moment.
    Spins,
    /// Kicks of the caster.
    Caster,
    /// Bias of this scanner.
    Bias,
    /// How far it drifts until it is warm.
    WarmUp,
    /// Speckle.
    Speckle,
    /// Returns that are too weak.
    Weak,
    /// Wandering of the motor.
    Motor,
    /// Jitter of the stamps.
    Stamps,
    /// Offset of the stamps.
    Offset,
    /// Walls that are not straight.
    Bow,
    /// Where there is skirting.
    Skirting,
}

/// The stream for an error.
pub fn stream(seed: u64, of: Stream) -> Pcg64 {
    Pcg64::new(u128::from(seed).wrapping_mul(0x9E37_79B9_7F4A_7C15) + 1, of as u128)
}

/// A normal number.
pub fn gauss(rng: &mut Pcg64) -> f64 {
    StandardNormal.sample(rng)
}

/// An exponential number with mean 1.
pub fn exponential(rng: &mut Pcg64) -> f64 {
    use rand::RngExt;
    -libm::log(1.0 - rng.random::<f64>())
}

/// A first-order process that wanders about zero with unit variance.
#[derive(Clone, Debug)]
pub struct Wandering {
    rng: Pcg64,
    value: f64,
    time_s: f64,
}

impl Wandering {
    /// It forgets where it was within `time_s`.
    pub fn new(mut rng: Pcg64, time_s: f64) -> Self {
        let value = gauss(&mut rng);
        Self { rng, value, time_s }
    }

    /// Its value a while later.
    pub fn after(&mut self, dt_s: f64) -> f64 {
        let kept = libm::exp(-dt_s / self.time_s);
        self.value = kept * self.value + (1.0 - kept * kept).sqrt() * gauss(&mut self.rng);
        self.value
    }
}
