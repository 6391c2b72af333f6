//! Tests of the crates together; see `tests/`. Here is where they find what does not belong to this project.

use std::io::Write;
use std::path::{Path, PathBuf};

/// Root of the workspace.
pub fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..")
}

/// Where the recorded logs are: the folder that `LINESLAM_DATA` names, or `../shared/data` beside the checkout.
pub fn data() -> PathBuf {
    std::env::var_os("LINESLAM_DATA").map_or_else(|| root().join("../shared/data"), PathBuf::from)
}

/// A file or folder among the recorded logs. Where it is absent the test that asks says that it is skipped.
pub fn recorded(name: &str, test: &str) -> Option<PathBuf> {
    let path = data().join(name);
    if !path.exists() {
        skipped(test, &path);
        return None;
    }
    Some(path)
}

/// Says plainly that a test did nothing. Written past the test harness's capture, so that it is seen.
pub fn skipped(test: &str, missing: &Path) {
    let _ = writeln!(std::io::stdout(), "\nSKIPPED {test}: {} is not there", missing.display());
}
