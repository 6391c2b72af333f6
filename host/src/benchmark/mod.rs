//! Recorded logs that others use too, beside what others publish on them.
//!
//! ```text
//!  folder ──► discover: logs, references, relations ──► measure: replay and score ──► tables, page
//!                                        (perturb, firmness: again with noise)  published: others' figures ──┘
//! ```
//!
//! Logs are replayed one after the other, so that the time of the core is that of a core at rest. A log that cannot be read, or
//! a reference that does not fit, is said in its row and does not end the run.

mod discover;
mod figure;
mod firmness;
mod measure;
pub mod page;
mod perturb;
pub mod published;
pub mod tables;
#[cfg(test)]
mod tests;
mod walls;

use std::path::PathBuf;

pub use discover::{Container, Found, find};
pub use firmness::{Firmness, Noise};
pub use measure::{ByReference, ByRelations, Measured, Poses, measure};
pub use perturb::perturbed;
pub use walls::{PASS_M, Walls, walls};

/// Why there is nothing to measure.
#[derive(Debug, thiserror::Error)]
pub enum BenchmarkError {
    /// The folder cannot be searched.
    #[error("{}", path.display())]
    Folder {
        /// The folder.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// Nothing in it looks like a log.
    #[error("{}: no log here, nor in the folders below (files that end in {endings})", path.display())]
    NoLogs {
        /// The folder.
        path: PathBuf,
        /// Endings of files that are taken for logs.
        endings: String,
    },
    /// A log that was asked for is not among them.
    #[error("no log '{name}' among those found: {found}")]
    NoSuchLog {
        /// What was asked for.
        name: String,
        /// What is there.
        found: String,
    },
}

/// One log, and what came of it.
#[derive(Clone, Debug)]
pub struct Row {
    /// The log.
    pub found: Found,
    /// What was measured, or why nothing was.
    pub outcome: Result<Measured, String>,
    /// What else the reader should know.
    pub remarks: Vec<String>,
}

impl Row {
    /// What was measured against a reference.
    pub fn by_reference(&self) -> Option<&ByReference> {
        self.outcome.as_ref().ok()?.reference.as_ref()
    }

    /// What was measured by relations.
    pub fn by_relations(&self) -> Option<&ByRelations> {
        self.outcome.as_ref().ok()?.relations.as_ref()
    }
}
