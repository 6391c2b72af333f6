//! Descriptions in TOML files: read, parsed and checked, with errors that name file and key.

use std::path::{Path, PathBuf};

use serde::de::DeserializeOwned;

/// Why a file could not be used.
#[derive(Debug, thiserror::Error)]
pub enum FileError {
    /// The file could not be read.
    #[error("{}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// Not TOML, an unknown key, a missing key or a wrong type; the message names key and line.
    #[error("{}", path.display())]
    Parse {
        /// The file.
        path: PathBuf,
        /// What the parser said.
        source: Box<toml::de::Error>,
    },
    /// A value that nothing real has.
    #[error("{}: {key}: {reason}", path.display())]
    Impossible {
        /// The file.
        path: PathBuf,
        /// Key with its table, as `sensor.steps.last`, or with its number from 1 in a list.
        key: String,
        /// What is wrong with it.
        reason: String,
    },
}

/// Key and what is wrong with it.
pub type Impossible = (String, String);

/// A description that can tell whether it makes sense.
pub trait Checked: DeserializeOwned {
    /// Says which value is impossible.
    fn check(&self) -> Result<(), Impossible>;
}

/// Reads and checks a file.
pub fn load<T: Checked>(path: &Path) -> Result<T, FileError> {
    parse(&read(path)?, path)
}

/// The text of a file.
pub fn read(path: &Path) -> Result<String, FileError> {
    std::fs::read_to_string(path).map_err(|source| FileError::Read { path: path.to_owned(), source })
}

/// Checks a text that stands in a file.
pub fn parse<T: Checked>(text: &str, path: &Path) -> Result<T, FileError> {
    let described: T = deserialize(text, path)?;
    described.check().map_err(|(key, reason)| FileError::Impossible {
        path: path.to_owned(),
        key,
        reason,
    })?;
    Ok(described)
}

/// What a text in a file says, unchecked.
pub fn deserialize<T: DeserializeOwned>(text: &str, path: &Path) -> Result<T, FileError> {
    toml::from_str(text)
        .map_err(|source| FileError::Parse { path: path.to_owned(), source: Box::new(source) })
}

/// A number of either width, which prints as it was written.
pub trait Number: Copy + std::fmt::Display + Into<f64> {}

impl Number for f32 {}
impl Number for f64 {}

/// Fails unless the value is finite.
pub fn finite(key: impl Into<String>, value: impl Number) -> Result<(), Impossible> {
    require(key, value, value.into().is_finite(), "is not finite")
}

/// Fails unless the value is finite and above zero.
pub fn positive(key: impl Into<String>, value: impl Number) -> Result<(), Impossible> {
    require(key, value, value.into() > 0.0 && value.into().is_finite(), "is not above zero")
}

/// Fails unless the value is finite and not below zero.
pub fn not_negative(key: impl Into<String>, value: impl Number) -> Result<(), Impossible> {
    require(key, value, value.into() >= 0.0 && value.into().is_finite(), "is below zero")
}

fn require(key: impl Into<String>, value: impl Number, holds: bool, reason: &str) -> Result<(), Impossible> {
    if holds { Ok(()) } else { Err((key.into(), format!("{value} {reason}"))) }
}
