//! `cargo xtask performance`: measures all that `docs/performance.md` says, and writes it.

use std::fmt::Write;
use std::path::Path;

use anyhow::Context;
use svg::Document;
use svg::node::element::{Circle, Line, Polyline, Text};

use crate::bench::instructions_of;
use crate::run::{announce, cargo, debian_package, program, root, step, target_folder};
use crate::{firmware, size};

/// Scans of a run of the benchmark on the PC, as in `host/benches/process_scan.rs`.
const SCANS_OF_RUN: f64 = 60.0;
/// Scans of the set that callgrind is shown, as in `host/examples/process_scan.rs`.
const SCANS_OF_SET: f64 = 300.0;
/// Recorded with a URG-04LX.
const LOG: &str = "../shared/data/exp1.dat.gz";

/// What others publish of their systems, and where.
const PEERS: &str = "\
| system | map | what is published | where |
|---|---|---|---|
| BreezySLAM (CoreSLAM, tinySLAM) | grid | its demonstration maps the log exp1 is of with 800 × 800 cells; the algorithm is 200 lines of C | github.com/simondlevy/BreezySLAM, `examples/logdemo.py`; Steux and El Hamzaoui, ICARCV 2010 |
| Hector SLAM | grids of several resolutions | \"low computational resources\"; accurate enough in its scenarios to close no loops explicitly | Kohlbrecher et al., \"A flexible and scalable SLAM system with full 3D motion estimation\", SSRR 2011, abstract |
| Gmapping | a grid for each particle | 30 particles by default | docs.ros.org/api/gmapping |

None of them was run here, and none of these figures is of this machine or of a microcontroller. What is measured here is all above
this table. Accuracy on logs that others use too is in [benchmark.md](benchmark.md).
";

/// Measures and writes.
pub fn report() -> anyhow::Result<()> {
    let counted = firmware::bench_output()?;
    step("time on the PC", &mut cargo("bench --quiet -p lineslam --bench process_scan"))?;
    let mut sweeps = Vec::new();
    for group in ["beams", "segments"] {
        sweeps.push((group, sweep(group)?));
    }
    let on_pc = on_the_pc()?;
    let sizes = size::summary()?;
    let mut text = String::new();
    writeln!(text, "# What it costs\n\nWritten by `cargo xtask performance`.\n")?;
    writeln!(
        text,
        "## On the Cortex-M4F\n\nInstructions, counted on the emulated core: `cargo xtask bench-target`. The set of scans is fixed: 300 \
         consecutive ones of the simulated office, 682 beams. Maps are the building's, with copies of it beside it.\n\n```text\n{}\n```\n",
        counted.trim()
    )?;
    writeln!(
        text,
        "Cycles are those of a model: what the manuals of core and part say of each kind of instruction, of branches, of what waits for \
         what, and of the flash with its accelerator (`emulator/src/cycles.rs`, which also says what it leaves out). Each instruction \
         executed is taken through it. The loops were counted by hand, and the benchmark fails where what it counts differs. No \
         silicon was measured. `cargo xtask emulate --cycles` has the whole board take its time by the model; without, all its \
         instructions take as long as the average one.\n"
    )?;
    writeln!(
        text,
        "## Memory\n\n{sizes}\nThe stack is painted before `main`, and the emulated hall ends with what was used of it: `cargo xtask demo`.\n"
    )?;
    writeln!(text, "## On the PC\n\n{on_pc}")?;
    for (group, points) in &sweeps {
        let (what, file) = match *group {
            "beams" => ("beams, with 200 segments known", "performance_beams.svg"),
            _ => ("map segments, with 682 beams", "performance_segments.svg"),
        };
        writeln!(
            text,
            "Time of a scan over {what} (criterion, median):\n\n![Time of a scan over {what}](images/{file})\n"
        )?;
        writeln!(text, "| {group} | µs a scan |\n|---|---|")?;
        for (count, us) in points {
            writeln!(text, "| {count} | {us:.1} |")?;
        }
        writeln!(text)?;
        let picture = plot(points, &format!("time of a scan, µs, over {what}"));
        svg::save(root().join("docs/images").join(file), &picture).with_context(|| file.to_owned())?;
    }
    writeln!(text, "## Beside others\n\n{PEERS}")?;
    let file = root().join("docs/performance.md");
    std::fs::write(&file, text).with_context(|| file.display().to_string())?;
    println!("\nwritten to docs/performance.md");
    Ok(())
}

/// Medians that criterion has left, microseconds a scan.
fn sweep(group: &str) -> anyhow::Result<Vec<(u32, f64)>> {
    let folder = target_folder().join("criterion").join(group);
    let mut points = Vec::new();
    for entry in std::fs::read_dir(&folder).with_context(|| folder.display().to_string())? {
        let path = entry?.path();
        let Some(count) = path.file_name().and_then(|n| n.to_str()).and_then(|n| n.parse().ok()) else {
            continue;
        };
        points.push((count, median_ns(&path.join("new/estimates.json"))? / SCANS_OF_RUN * 1e-3));
    }
    points.sort_by_key(|(count, _)| *count);
    Ok(points)
}

fn median_ns(file: &Path) -> anyhow::Result<f64> {
    let text = std::fs::read_to_string(file).with_context(|| file.display().to_string())?;
    let estimates: serde_json::Value =
        serde_json::from_str(&text).with_context(|| file.display().to_string())?;
    estimates["median"]["point_estimate"].as_f64().with_context(|| format!("{}: no median", file.display()))
}

/// Instructions by callgrind, and the time of a scan of a recorded log.
fn on_the_pc() -> anyhow::Result<String> {
    debian_package("valgrind", "valgrind")?;
    step(
        "build what is counted",
        &mut cargo("build --quiet --release -p lineslam --bins --example process_scan"),
    )?;
    announce("instructions on the PC (callgrind)");
    let example = target_folder().join("release/examples/process_scan");
    let each = (instructions_of(&example, 3)? - instructions_of(&example, 1)?) as f64 / (2.0 * SCANS_OF_SET);
    let mut text = format!(
        "Instructions of a scan of the same set on x86-64, 200 segments known, by callgrind: {each:.0} on average.\n\n"
    );
    if root().join(LOG).exists() {
        let out = target_folder().join("performance");
        let mut command = program(target_folder().join("release/lineslam"));
        command.args(["replay", LOG, "--robot", "robots/mines.toml", "--out"]).arg(&out);
        step("replay of a recorded log", &mut command)?;
        let report = std::fs::read_to_string(out.join("report.json")).context("the replay's report")?;
        let report: serde_json::Value = serde_json::from_str(&report).context("the replay's report")?;
        let median =
            report["scan_us"]["median"].as_f64().context("the replay's report has no scan_us.median")?;
        writeln!(text, "Replay of exp1 (`lineslam replay`), one core, median: {median:.0} µs a scan.\n")?;
    } else {
        println!("SKIPPED the replay of a recorded log: {LOG} is not here");
    }
    Ok(text)
}

/// A plot with both axes logarithmic.
fn plot(points: &[(u32, f64)], title: &str) -> Document {
    const SIZE: (f64, f64) = (640.0, 400.0);
    const MARGIN: (f64, f64) = (60.0, 50.0);
    let decades = |values: &mut dyn Iterator<Item = f64>| {
        let (least, most) = values.fold((f64::MAX, f64::MIN), |(a, b), v| (a.min(v), b.max(v)));
        ((least / 1.3).log10(), (most * 1.3).log10())
    };
    let x_range = decades(&mut points.iter().map(|(x, _)| f64::from(*x)));
    let y_range = decades(&mut points.iter().map(|(_, y)| *y));
    let place = |value: f64, (low, high): (f64, f64), from: f64, to: f64| {
        from + (to - from) * (value.log10() - low) / (high - low)
    };
    let x = |value: f64| place(value, x_range, MARGIN.0, SIZE.0 - 20.0);
    let y = |value: f64| place(value, y_range, SIZE.1 - MARGIN.1, 40.0);
    let label = |text: String, x: f64, y: f64, anchor: &str| {
        Text::new(text)
            .set("x", x)
            .set("y", y)
            .set("text-anchor", anchor)
            .set("font-family", "sans-serif")
            .set("font-size", 13)
            .set("fill", "#333333")
    };
    let mut document = Document::new()
        .set("viewBox", (0, 0, SIZE.0, SIZE.1))
        .set("width", SIZE.0)
        .set("height", SIZE.1)
        .add(
            svg::node::element::Rectangle::new()
                .set("width", "100%")
                .set("height", "100%")
                .set("fill", "white"),
        )
        .add(label(title.to_owned(), 0.5 * SIZE.0, 24.0, "middle"));
    for (count, us) in points {
        let (px, py) = (x(f64::from(*count)), y(*us));
        let grid = |x1: f64, y1: f64, x2: f64, y2: f64| {
            Line::new().set("x1", x1).set("y1", y1).set("x2", x2).set("y2", y2).set("stroke", "#dddddd")
        };
        document = document
            .add(grid(px, 40.0, px, SIZE.1 - MARGIN.1))
            .add(grid(MARGIN.0, py, SIZE.0 - 20.0, py))
            .add(label(count.to_string(), px, SIZE.1 - MARGIN.1 + 20.0, "middle"));
    }
    // Of times that lie close together one label is enough.
    let mut free = f64::MAX;
    let mut by_time = points.to_vec();
    by_time.sort_by(|a, b| a.1.total_cmp(&b.1));
    for (_, us) in &by_time {
        if y(*us) < free {
            document = document.add(label(format!("{us:.0}"), MARGIN.0 - 8.0, y(*us) + 4.0, "end"));
            free = y(*us) - 14.0;
        }
    }
    let line: Vec<String> =
        points.iter().map(|(c, us)| format!("{:.1},{:.1}", x(f64::from(*c)), y(*us))).collect();
    document = document.add(
        Polyline::new()
            .set("points", line.join(" "))
            .set("fill", "none")
            .set("stroke", "#1f5fa8")
            .set("stroke-width", 2),
    );
    for (count, us) in points {
        document = document.add(
            Circle::new()
                .set("cx", x(f64::from(*count)))
                .set("cy", y(*us))
                .set("r", 4)
                .set("fill", "#1f5fa8"),
        );
    }
    document
}
