//! Tests of the crates together; see `tests/`. Here is where they find what does not belong to this project.

use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::OnceLock;

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

/// The command `lineslam`, built if it is not yet.
pub fn lineslam() -> &'static Path {
    static BUILT: OnceLock<PathBuf> = OnceLock::new();
    BUILT.get_or_init(|| {
        let cargo = std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into());
        // Beside the folder of the tests' own programs, and as they were built.
        let test = std::env::current_exe().expect("a test has a path");
        let folder = test.parent().and_then(Path::parent).expect("tests lie in deps/");
        let release = folder.ends_with("release").then_some("--release");
        let status = Command::new(cargo)
            .args(["build", "--quiet", "-p", "lineslam", "--bin", "lineslam"])
            .args(release)
            .current_dir(root())
            .status()
            .expect("cargo runs");
        assert!(status.success(), "lineslam cannot be built");
        folder.join(format!("lineslam{}", std::env::consts::EXE_SUFFIX))
    })
}

/// A Python that can import these packages: the one that `LINESLAM_PYTHON` names, as `cargo xtask test` makes it, or `python3`.
pub fn python_with(packages: &str) -> Option<PathBuf> {
    let python = std::env::var_os("LINESLAM_PYTHON").unwrap_or_else(|| "python3".into());
    let mut imports = Command::new(&python);
    imports.args(["-c", &format!("import {packages}")]).stderr(Stdio::null());
    imports.status().is_ok_and(|status| status.success()).then(|| python.into())
}
