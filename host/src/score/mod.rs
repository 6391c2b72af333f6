//! How a trajectory is judged: against a reference trajectory, by relations between poses that somebody has checked, and
//! by how thick it makes the walls.
//!
//! ```text
//!  trajectory ─┬─► matching ──► reference: absolute trajectory error after one SE(2) alignment
//!              │                   └─────► relative: errors between poses some way apart
//!              ├─► relations: Kümmerle's measure
//!              └─► walls
//! ```
//!
//! Everything is in f64, metres, radians and seconds; what is reported says its unit.

mod laying;
mod matching;
mod reference;
mod relations;
mod relative;
mod tum;
mod walls;

use std::path::{Path, PathBuf};

use nalgebra::{Isometry2, Vector2};

pub use laying::{lay, lay_with_scale};
pub use matching::{Matched, at_stamps};
pub use reference::{AgainstReference, Alignment, absolute_trajectory_error, against_reference, align};
pub use relations::{
    NotRelation, Relation, RelationErrors, at_laser, mean_relation_error_m, parse_relations, relation_errors,
};
pub use relative::PairErrors;
pub use tum::{NotTum, parse_tum};
pub use walls::wall_thicknesses_m;

/// A stamped planar pose, seconds and metres.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StampedPose {
    /// Stamp, seconds.
    pub stamp_s: f64,
    /// The pose.
    pub pose: Isometry2<f64>,
}

impl StampedPose {
    /// From a stamp in microseconds and a pose of the core's.
    pub fn of_core(stamp_us: u64, pose: &Isometry2<f32>) -> Self {
        Self { stamp_s: stamp_us as f64 * 1e-6, pose: nalgebra::convert(*pose) }
    }

    fn position(&self) -> Vector2<f64> {
        self.pose.translation.vector
    }
}

/// Why a trajectory could not be scored.
#[derive(Debug, thiserror::Error)]
pub enum ScoreError {
    /// A file cannot be read.
    #[error("{}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// A line of a trajectory cannot be used.
    #[error("{}", path.display())]
    Trajectory {
        /// The file.
        path: PathBuf,
        /// The line.
        source: NotTum,
    },
    /// A line of a file of relations cannot be used.
    #[error("{}", path.display())]
    Relations {
        /// The file.
        path: PathBuf,
        /// The line.
        source: NotRelation,
    },
    /// Too little in a file to compare anything with.
    #[error("{}: {found} {what}, at least {least} are needed", path.display())]
    TooFew {
        /// The file.
        path: PathBuf,
        /// How many there are.
        found: usize,
        /// Of what.
        what: &'static str,
        /// How many there must be.
        least: usize,
    },
    /// Nothing of one file happens while the other lasts.
    #[error(
        "{} ({:.3} to {:.3} s) and {} ({:.3} to {:.3} s) do not overlap in time",
        trajectory.display(), trajectory_s.0, trajectory_s.1, other.display(), other_s.0, other_s.1
    )]
    NoOverlap {
        /// The trajectory.
        trajectory: PathBuf,
        /// Its first and last stamp, seconds.
        trajectory_s: (f64, f64),
        /// What it is compared with.
        other: PathBuf,
        /// Its first and last stamp, seconds.
        other_s: (f64, f64),
    },
}

fn text(path: &Path) -> Result<String, ScoreError> {
    std::fs::read_to_string(path).map_err(|source| ScoreError::Read { path: path.to_owned(), source })
}

/// Reads a TUM trajectory of two poses or more.
pub fn read_tum(path: &Path) -> Result<Vec<StampedPose>, ScoreError> {
    let poses =
        parse_tum(&text(path)?).map_err(|source| ScoreError::Trajectory { path: path.to_owned(), source })?;
    if poses.len() < 2 {
        return Err(ScoreError::TooFew {
            path: path.to_owned(),
            found: poses.len(),
            what: "poses",
            least: 2,
        });
    }
    Ok(poses)
}

/// Reads a file of one relation or more.
pub fn read_relations(path: &Path) -> Result<Vec<Relation>, ScoreError> {
    let relations = parse_relations(&text(path)?)
        .map_err(|source| ScoreError::Relations { path: path.to_owned(), source })?;
    if relations.is_empty() {
        return Err(ScoreError::TooFew { path: path.to_owned(), found: 0, what: "relations", least: 1 });
    }
    Ok(relations)
}

/// Smallest and largest of some stamps; zeros of none.
pub fn span_s(stamps_s: impl Iterator<Item = f64>) -> (f64, f64) {
    stamps_s
        .fold(None, |span: Option<(f64, f64)>, s| Some(span.map_or((s, s), |(a, b)| (a.min(s), b.max(s)))))
        .unwrap_or_default()
}

/// The finite numbers of a line, where it has nothing else.
fn numbers(line: &str) -> Option<Vec<f64>> {
    line.split_whitespace().map(|word| word.parse().ok().filter(|v: &f64| v.is_finite())).collect()
}

/// What is before a comment, where that is anything.
fn content(line: &str) -> Option<&str> {
    let content = line.split('#').next().unwrap_or_default().trim();
    (!content.is_empty()).then_some(content)
}

/// Mean, median and largest of some numbers.
#[derive(Clone, Copy, Debug)]
pub struct Spread {
    /// Their mean.
    pub mean: f64,
    /// Their standard deviation, as of a whole population.
    pub deviation: f64,
    /// The middle one, of an even number the mean of both.
    pub median: f64,
    /// The largest.
    pub worst: f64,
}

impl Spread {
    /// `None` of none.
    pub fn of(values: impl Iterator<Item = f64>) -> Option<Self> {
        let mut sorted: Vec<f64> = values.collect();
        sorted.sort_unstable_by(f64::total_cmp);
        let n = sorted.len();
        let median = 0.5 * (sorted.get(n.checked_sub(1)? / 2)? + sorted.get(n / 2)?);
        let mean = sorted.iter().sum::<f64>() / n as f64;
        let deviation = (sorted.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / n as f64).sqrt();
        Some(Self { mean, deviation, median, worst: *sorted.last()? })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_spread_is_mean_deviation_median_and_worst() {
        let spread = Spread::of([4.0, 1.0, 2.0, 9.0].into_iter()).unwrap();
        assert_eq!((spread.mean, spread.median, spread.worst), (4.0, 3.0, 9.0));
        assert!((spread.deviation - 9.5_f64.sqrt()).abs() < 1e-12);
        assert!(Spread::of(std::iter::empty()).is_none());
    }
}
