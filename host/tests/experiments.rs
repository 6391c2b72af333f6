//! `lineslam experiments`: one command, one page, with every table and figure it speaks of.

use std::path::{Path, PathBuf};
use std::process::{Command, Output};

fn worlds() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../worlds")
}

fn experiments(out: &Path, worlds: &Path) -> Output {
    Command::new(env!("CARGO_BIN_EXE_lineslam"))
        .args(["experiments", "--seeds", "1", "--first-seed", "77", "--ransac-seeds", "2", "--worlds"])
        .arg(worlds)
        .arg("--out")
        .arg(out)
        .output()
        .unwrap()
}

#[test]
fn the_page_has_its_tables_figures_and_command() {
    let folder = tempfile::tempdir().unwrap();
    let output = experiments(folder.path(), &worlds());
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let page = std::fs::read_to_string(folder.path().join("experiments.md")).unwrap();
    assert!(
        page.contains("experiments --seeds 1 --first-seed 77 --ransac-seeds 2\n"),
        "the command that wrote it"
    );
    assert!(page.contains("0.067") && page.contains("0.234"), "the paper's own figures");
    for condition in ["wheel errors doubled", "±30 mm", "10 %", "every fifth scan"] {
        assert!(page.contains(condition), "{condition}");
    }
    let images: Vec<&str> =
        page.split("](images/").skip(1).map(|rest| rest.split_once(')').unwrap().0).collect();
    let [paper, partial] = ["corridor_paper.svg", "corridor_paper-partial.svg"];
    assert_eq!(images, ["hall.svg", "hall_dead_reckoning.svg", "corridor.svg", "office.svg", paper, partial]);
    for configuration in ["paper", "paper-weighted", "paper-partial", "default"] {
        for drives in ["calibrated wheels", "usual errors"] {
            let is_row = |line: &&str| {
                let cells: Vec<&str> = line.split('|').map(str::trim).collect();
                cells.get(2..4) == Some(&[drives, configuration])
            };
            // Of three buildings, in the table of the corners and in that of the trajectories.
            assert_eq!(page.lines().filter(is_row).count(), 6, "{configuration}, {drives}");
        }
    }
    for world in ["hall", "corridor", "office", "lab", "flat", "twins", "loop"] {
        for kind in ["ideal", "real"] {
            let is_row = |line: &&str| {
                let cells: Vec<&str> = line.split('|').map(str::trim).collect();
                cells.get(1..3) == Some(&[world, kind])
            };
            // Corners, trajectories, covariance.
            assert_eq!(page.lines().filter(is_row).count(), 3, "{world}, {kind}");
        }
    }
    assert!(page.contains("Of 23 limits ") || page.contains("All 23 limits are kept."), "the limits");
    assert_eq!(
        page.matches(" 1 m back, ").count() + page.matches(" 8 m back, ").count(),
        8,
        "lifted in four worlds"
    );
    for image in images {
        let svg = std::fs::read_to_string(folder.path().join("images").join(image)).unwrap();
        assert!(svg.starts_with("<svg"), "{image}");
    }
    assert!(!page.contains("NaN"), "{page}");
}

#[test]
fn a_world_that_is_missing_is_named_and_nothing_is_written() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("out");
    let output = experiments(&out, folder.path());
    assert_eq!(output.status.code(), Some(2), "{output:?}");
    assert!(String::from_utf8_lossy(&output.stderr).contains("hall.toml"), "{output:?}");
    assert!(!out.exists());
}
