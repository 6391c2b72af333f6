//! Where the fixed set of scans is, and how the firmware is linked.

use std::path::PathBuf;
use std::{env, fs};

/// Names the file with the set, which `cargo xtask bench-target` makes.
const SET: &str = "LINESLAM_FIXED_SET";

fn main() {
    for argument in ["--nmagic", "-Tlink.x", "-Tdefmt.x"] {
        println!("cargo::rustc-link-arg-bins={argument}");
    }
    let root = PathBuf::from(env::var_os("CARGO_MANIFEST_DIR").expect("cargo sets it")).join("..");
    let out = PathBuf::from(env::var_os("OUT_DIR").expect("cargo sets it"));
    println!("cargo::rerun-if-env-changed={SET}");
    for file in [&root.join("memory.x"), &PathBuf::from("build.rs")] {
        println!("cargo::rerun-if-changed={}", file.display());
    }
    if env::var("CARGO_CFG_TARGET_OS").is_ok_and(|os| os != "none") {
        return;
    }
    fs::copy(root.join("memory.x"), out.join("memory.x")).expect("memory.x can be copied");
    println!("cargo::rustc-link-search={}", out.display());
    let Some(set) = env::var_os(SET).map(PathBuf::from) else {
        println!("cargo::error={SET} is not set; `cargo xtask bench-target` builds this");
        std::process::exit(1);
    };
    println!("cargo::rerun-if-changed={}", set.display());
    if let Err(error) = fs::copy(&set, out.join("set.rs")) {
        println!("cargo::error={SET}: {}: {error}", set.display());
        std::process::exit(1);
    }
}
