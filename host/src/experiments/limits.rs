//! What is asked of the default configuration in the simulated buildings, and what of it holds.

use super::{Case, Run};
use crate::sim::SimKind;

/// What there is a limit for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Quantity {
    /// Equation (11) as the map lies, in the frame of the start: the mean over the drives, metres.
    Corners,
    /// Equation (11) with the map laid over the blueprint with a scale: the mean over the drives, metres.
    ScaledCorners,
    /// Error of the trajectory, rmse, after one alignment with a scale: the mean over the drives, metres.
    ScaledTrajectory,
    /// Drives that lost track.
    Lost,
}

impl Quantity {
    /// What it is called in a sentence.
    pub fn name(self) -> &'static str {
        match self {
            Self::Corners => "corner error as the map lies",
            Self::ScaledCorners => "corner error with a scale",
            Self::ScaledTrajectory => "trajectory error with a scale",
            Self::Lost => "drives that lost track",
        }
    }

    /// Of one drive. Infinite where its map has no corner to be judged by: that keeps no limit.
    fn of(self, run: &Run) -> f64 {
        let judgement = &run.default.judgement;
        match self {
            Self::Corners => judgement.corner_error_m.unwrap_or(f64::INFINITY),
            Self::ScaledCorners => judgement.laid_with_scale.corner_error_m.unwrap_or(f64::INFINITY),
            Self::ScaledTrajectory => judgement.trajectory.scaled_rmse_m,
            Self::Lost => f64::from(u8::from(run.default.lost())),
        }
    }

    /// Over drives; `None` of none.
    fn over<'a>(self, runs: impl Iterator<Item = &'a Run>) -> Option<f64> {
        let (sum, n) = runs.fold((0.0, 0u32), |(sum, n), run| (sum + self.of(run), n + 1));
        let share = if self == Self::Lost { 1.0 } else { f64::from(n) };
        (n > 0).then(|| sum / share)
    }
}

/// What is asked for.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Limit {
    /// Name of the world.
    pub world: &'static str,
    /// Kind of the errors.
    pub kind: SimKind,
    /// What is limited.
    pub quantity: Quantity,
    /// The most that it may be.
    pub most: f64,
}

/// A limit, and what was measured.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Held {
    /// The limit.
    pub limit: Limit,
    /// What was measured.
    pub measured: f64,
}

impl Held {
    /// Whether the limit is kept. Not a number keeps none.
    pub fn holds(&self) -> bool {
        self.measured <= self.limit.most
    }
}

/// Corner errors as the map lies, ideal kind, metres.
const CORNERS_M: [(&str, f64); 3] = [("hall", 0.030), ("corridor", 0.030), ("office", 0.015)];
/// Corner and trajectory errors aligned with a scale, real kind, metres.
const SCALED_M: [(&str, f64); 5] =
    [("hall", 0.05), ("corridor", 0.05), ("office", 0.05), ("lab", 0.06), ("flat", 0.06)];

/// All limits.
pub fn all() -> impl Iterator<Item = Limit> {
    let ideal = CORNERS_M.into_iter().map(|(world, most)| Limit {
        world,
        kind: SimKind::Ideal,
        quantity: Quantity::Corners,
        most,
    });
    let real = SCALED_M.into_iter().flat_map(|(world, most)| {
        [Quantity::ScaledCorners, Quantity::ScaledTrajectory].map(|quantity| Limit {
            world,
            kind: SimKind::Real,
            quantity,
            most,
        })
    });
    let lost = SCALED_M.into_iter().flat_map(|(world, _)| {
        SimKind::ALL.map(|kind| Limit { world, kind, quantity: Quantity::Lost, most: 0.0 })
    });
    ideal.chain(real).chain(lost)
}

/// The limit of a quantity in a case, held against its drives. `None` where there is no limit, or no drive.
pub fn held(runs: &[Run], case: Case, quantity: Quantity) -> Option<Held> {
    let is_asked = |l: &Limit| Case::usual(l.world, l.kind) == case && l.quantity == quantity;
    let limit = all().find(is_asked)?;
    let measured = quantity.over(runs.iter().filter(|r| r.case == case))?;
    Some(Held { limit, measured })
}

/// All limits, held against the drives that there are.
pub fn all_held(runs: &[Run]) -> Vec<Held> {
    all().filter_map(|l| held(runs, Case::usual(l.world, l.kind), l.quantity)).collect()
}
