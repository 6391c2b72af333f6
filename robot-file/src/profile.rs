//! Profiles: what belongs to a type of scanner or of base, in files that robot files name.
//!
//! A profile is built in and named, as `urg-04lx`, or is a file, named by its path from the robot file, as `../my-lidar.toml`. What
//! the robot file says itself goes before it, key by key.

use std::path::{Path, PathBuf};

use serde::de::DeserializeOwned;

use crate::toml_file::{self, FileError};

/// A profile that is built in: its name and its file in this repository, and the text.
pub(crate) type BuiltIn = (&'static str, &'static str, &'static str);

/// Scanners.
pub(crate) const SENSORS: [BuiltIn; 3] = [
    ("urg-04lx", "sensors/urg-04lx.toml", include_str!("../../sensors/urg-04lx.toml")),
    ("urg-04lx-ug01", "sensors/urg-04lx-ug01.toml", include_str!("../../sensors/urg-04lx-ug01.toml")),
    ("sick-lms2xx", "sensors/sick-lms2xx.toml", include_str!("../../sensors/sick-lms2xx.toml")),
];

/// Odometry.
pub(crate) const ODOMETRY: [BuiltIn; 1] =
    [("two-wheels", "odometry/two-wheels.toml", include_str!("../../odometry/two-wheels.toml"))];

/// Reads the profile that a robot file names under `key`. Files that are read are added to `files`.
pub(crate) fn read<T: DeserializeOwned>(
    name: &str,
    key: &str,
    built_in: &[BuiltIn],
    robot_file: &Path,
    files: &mut Vec<PathBuf>,
) -> Result<(T, PathBuf), FileError> {
    if let Some((_, path, text)) = built_in.iter().find(|(known, ..)| *known == name) {
        return Ok((toml_file::deserialize(text, Path::new(path))?, PathBuf::from(path)));
    }
    if !name.ends_with(".toml") {
        let known: Vec<&str> = built_in.iter().map(|(known, ..)| *known).collect();
        let reason =
            format!("there is no '{name}', only {}; a file's name ends with .toml", known.join(", "));
        return Err(FileError::Impossible { path: robot_file.to_owned(), key: key.to_owned(), reason });
    }
    let path = robot_file.parent().unwrap_or(Path::new("")).join(name);
    let text = std::fs::read_to_string(&path).map_err(|error| FileError::Impossible {
        path: robot_file.to_owned(),
        key: key.to_owned(),
        reason: format!("{}: {error}", path.display()),
    })?;
    files.push(path.clone());
    Ok((toml_file::deserialize(&text, &path)?, path))
}

/// The value of a key that somebody must state.
pub(crate) fn needed<T>(key: &str, value: Option<T>) -> Result<T, toml_file::Impossible> {
    value.ok_or_else(|| (key.to_owned(), "is missing".to_owned()))
}
