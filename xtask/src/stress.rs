//! `cargo xtask stress`: how firmly the results on recorded logs stand.

use anyhow::bail;

use crate::run::{cargo, program, root, step, target_folder};
use crate::test::python_with_readers;

/// Replays recorded logs changed in ways that a good system hardly notices (other noise, left and right exchanged, every other
/// beam or scan left out, a later start), and prints the trajectory error of each. The script that changes and scores them is not
/// part of this project: it lies beside the checkout, as do the logs.
pub fn report(seeds: u32, logs: Option<&str>) -> anyhow::Result<()> {
    let script = root().join("../shared/referee/stress.py");
    let data = std::env::var_os("LINESLAM_DATA")
        .map_or_else(|| root().join("../shared/data"), std::path::PathBuf::from);
    for needed in [&script, &data] {
        if !needed.exists() {
            bail!(
                "nothing was run: {} is not there. The logs belong to others and lie beside this project in ../shared, with the \
                 script that changes them",
                needed.display()
            );
        }
    }
    let Some(python) = python_with_readers() else {
        bail!("nothing was run: Python with numpy could not be had");
    };
    step("lineslam, optimised", &mut cargo("build --release -p lineslam"))?;
    let mut command = program(python);
    command.arg(script).arg(target_folder().join("release/lineslam")).arg(root().join("robots")).arg(data);
    command.args(["--seeds", &seeds.to_string()]);
    if let Some(logs) = logs {
        command.args(["--logs", logs]);
    }
    step("trajectory errors of the changed logs, rmse in metres", &mut command)
}
