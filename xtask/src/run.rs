//! Running other programs, from the workspace's root.

use std::ffi::OsStr;
use std::path::PathBuf;
use std::process::Command;
use std::sync::LazyLock;
use std::time::Instant;

use anyhow::{Context, bail};

use crate::TARGET;

/// Root of the workspace.
pub fn root() -> PathBuf {
    let manifest = PathBuf::from(env!("CARGO_MANIFEST_DIR"));
    manifest.parent().map_or(manifest.clone(), PathBuf::from)
}

/// Where cargo puts what it makes.
pub fn target_folder() -> PathBuf {
    std::env::var_os("CARGO_TARGET_DIR").map_or_else(|| root().join("target"), PathBuf::from)
}

/// Whether a program is there and runs.
pub fn is_installed(name: &str) -> bool {
    program(name).arg("--version").output().is_ok_and(|o| o.status.success())
}

/// A program, to be run from the root.
pub fn program(name: impl AsRef<OsStr>) -> Command {
    let mut command = Command::new(name);
    command.current_dir(root());
    command
}

/// The cargo that runs this task, with its arguments.
pub fn cargo(arguments: &str) -> Command {
    let mut command = program(std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into()));
    command.args(arguments.split_whitespace());
    command
}

/// Says what is done, does it, and fails with the command's name if it fails.
pub fn step(title: &str, command: &mut Command) -> anyhow::Result<()> {
    announce(title);
    let status =
        command.status().with_context(|| format!("{title}: cannot run {:?}", command.get_program()))?;
    if !status.success() {
        bail!("{title}: {command:?} failed with {status}");
    }
    Ok(())
}

/// A headline for what follows, with the time since the task began.
pub fn announce(title: &str) {
    static BEGAN: LazyLock<Instant> = LazyLock::new(Instant::now);
    let s = BEGAN.elapsed().as_secs();
    println!("\n==> {title} ({} min {:02} s)", s / 60, s % 60);
}

/// Adds the firmware's target to the toolchain if it is not there.
pub fn ensure_target() -> anyhow::Result<()> {
    let installed = program("rustup")
        .args(["target", "list", "--installed"])
        .output()
        .context("rustup is needed to see which targets are installed")?;
    if String::from_utf8_lossy(&installed.stdout).lines().any(|line| line.trim() == TARGET) {
        return Ok(());
    }
    step(&format!("install target {TARGET}"), program("rustup").args(["target", "add", TARGET]))
}

/// Installs a Debian package if its program is not there.
pub fn debian_package(name: &str, command: &str) -> anyhow::Result<()> {
    if is_installed(command) {
        return Ok(());
    }
    let is_root = program("id").arg("-u").output().is_ok_and(|o| o.stdout.trim_ascii() == b"0");
    let apt = |arguments: &str| {
        let mut command = if is_root {
            program("apt-get")
        } else {
            let mut sudo = program("sudo");
            sudo.arg("apt-get");
            sudo
        };
        command.args(arguments.split_whitespace());
        command
    };
    step("update the list of Debian packages", &mut apt("update -qq"))?;
    step(&format!("install {name}"), &mut apt(&format!("install -y -qq {name}")))
}
