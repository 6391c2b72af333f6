//! The page that says what the experiments measured.

use std::fmt::Write;

use comfy_table::{CellAlignment, Row, Table, presets};

use super::{
    BUILDINGS, CONDITIONS, Case, FEATURELESS, Measured, Results, Run, kidnapped, kinds_page, papers_page,
};
use crate::score::Spread;
use crate::sim::SimKind;
use crate::sim::judge::NEES_INSTANTS;

pub(super) fn mean(values: impl Iterator<Item = f64>) -> f64 {
    Spread::of(values).map_or(f64::NAN, |s| s.mean)
}

pub(super) fn table(header: impl Into<Row>) -> Table {
    let mut table = Table::new();
    table.load_style(presets::ASCII_MARKDOWN);
    table.set_header(header);
    for column in table.column_iter_mut().skip(1) {
        column.set_cell_alignment(CellAlignment::Right);
    }
    table
}

pub(super) fn metres(value: f64) -> String {
    if value.is_finite() { format!("{value:.3}") } else { "–".into() }
}

/// Share of the blueprint's corners that the maps have as they lie.
pub(super) fn corners_found<'a>(measured: impl Iterator<Item = &'a Measured> + Clone) -> String {
    corners_share(measured, &|m| m.judgement.corners_found)
}

/// The same for what else is found.
pub(super) fn corners_share<'a>(
    measured: impl Iterator<Item = &'a Measured> + Clone,
    found: &dyn Fn(&Measured) -> usize,
) -> String {
    let share = measured.clone().map(found).sum::<usize>() as f64;
    let named: usize = measured.map(|m| m.judgement.corners).sum();
    format!("{:.0} %", 100.0 * share / named.max(1) as f64)
}

/// The drives of a case.
pub(super) fn drives(results: &Results, case: Case) -> impl Iterator<Item = &Run> + Clone {
    results.runs.iter().filter(move |r| r.case == case)
}

/// How many of the drives lost track.
pub(super) fn lost<'a>(measured: impl Iterator<Item = &'a Measured> + Clone) -> String {
    format!("{} of {}", measured.clone().filter(|m| m.lost()).count(), measured.count())
}

/// Table 1: what the paper measured, dead reckoning, and ours.
pub fn buildings(results: &Results) -> Table {
    let mut table = table([
        "building",
        "",
        "corner error as the map lies: mean",
        "worst",
        "found",
        "laid over the blueprint: mean",
        "worst",
        "found",
        "trajectory error, rmse",
        "final position",
        "final heading",
        "map segments",
        "lost track",
    ]);
    for building in BUILDINGS {
        let all = || drives(results, Case::usual(building.name, SimKind::Ideal));
        let blank = |name: &str| {
            let mut row = vec![building.name.to_owned(), name.to_owned()];
            row.resize(13, "–".into());
            row
        };
        if let Some(measured) = building.paper_measured_m {
            let mut row = blank("as the paper measured");
            row[5] = metres(measured);
            table.add_row(row);
        }
        let mut row = blank("dead reckoning");
        row[8] = metres(mean(all().map(|r| r.dead_reckoning.ate_rmse_m)));
        row[9] = metres(mean(all().map(|r| r.dead_reckoning.final_position_error_m)));
        row[10] = format!("{:.2}°", mean(all().map(|r| r.dead_reckoning.final_heading_error_deg)));
        table.add_row(row);
        let ours = || all().map(|r| &r.default);
        let over = |value: fn(&Measured) -> f64| mean(ours().map(value));
        let corner = |error: fn(&Measured) -> Option<f64>| {
            let spread = Spread::of(ours().filter_map(error));
            [|s: &Spread| s.mean, |s: &Spread| s.worst]
                .map(|value| metres(spread.as_ref().map_or(f64::NAN, value)))
        };
        let [lies, lies_worst] = corner(|m| m.judgement.corner_error_m);
        let [laid, laid_worst] = corner(|m| m.judgement.laid.corner_error_m);
        table.add_row([
            building.name.to_owned(),
            "default".into(),
            lies,
            lies_worst,
            corners_found(ours()),
            laid,
            laid_worst,
            corners_share(ours(), &|m| m.judgement.laid.corners_found),
            metres(over(|m| m.judgement.trajectory.ate_rmse_m)),
            metres(over(|m| m.judgement.trajectory.final_position_error_m)),
            format!("{:.2}°", over(|m| m.judgement.trajectory.final_heading_error_deg)),
            format!("{:.0}", over(|m| m.segments as f64)),
            lost(ours()),
        ]);
    }
    table
}

/// The default configuration where the robot is worse than usual.
pub fn robustness(results: &Results) -> Table {
    let mut table = table([
        "what is wrong",
        "building",
        "corner error as the map lies: mean",
        "worst",
        "trajectory error, rmse",
        "corners found",
        "lost track",
    ]);
    for (index, condition) in CONDITIONS.iter().enumerate() {
        for building in BUILDINGS {
            let case = Case { world: building.name, kind: SimKind::Ideal, condition: index };
            let all = || drives(results, case).map(|r| &r.default);
            let corners = Spread::of(all().filter_map(|m| m.judgement.corner_error_m));
            let corner = |value: fn(&Spread) -> f64| metres(corners.as_ref().map_or(f64::NAN, value));
            table.add_row([
                condition.name.to_owned(),
                building.name.into(),
                corner(|s| s.mean),
                corner(|s| s.worst),
                metres(mean(all().map(|m| m.judgement.trajectory.ate_rmse_m))),
                corners_found(all()),
                lost(all()),
            ]);
        }
    }
    table
}

/// Whether the reported covariance is honest, and what people leave behind.
pub fn honesty(results: &Results) -> Table {
    let mut table = table([
        "building",
        "kind",
        "drives",
        "NEES, mean",
        "95 % band of its mean over the drives",
        "instants within it",
        "along the heading within 2σ",
        "spurious segments per 100 others",
    ]);
    for case in kinds_page::cases() {
        let all = || drives(results, case).map(|r| &r.default.judgement);
        let (low, high) = nees_band(all().count());
        let at = |instant: usize| mean(all().filter_map(|j| j.nees.get(instant).copied()));
        let within = (0..NEES_INSTANTS).map(at).filter(|v| (low..=high).contains(v)).count();
        let spurious: usize = all().map(|j| j.spurious_segments).sum();
        let established: usize = all().map(|j| j.established_segments).sum();
        table.add_row([
            case.world.to_owned(),
            case.kind.name().into(),
            all().count().to_string(),
            format!("{:.2}", mean(all().map(|j| j.mean_nees))),
            format!("{low:.2} to {high:.2}"),
            format!("{within} of {NEES_INSTANTS}"),
            format!("{:.0} %", 100.0 * mean(all().map(|j| j.along_within_two_sigma))),
            per_100(spurious, established),
        ]);
    }
    table
}

/// Spurious segments per hundred of the other established ones.
pub(super) fn per_100(spurious: usize, established: usize) -> String {
    format!("{:.1}", 100.0 * spurious as f64 / (established - spurious).max(1) as f64)
}

/// Where the mean NEES lies outside its band, in a sentence.
pub fn dishonest(results: &Results) -> String {
    let mut outside = Vec::new();
    for case in kinds_page::cases() {
        let all = || drives(results, case).map(|r| r.default.judgement.mean_nees);
        let (low, high) = nees_band(all().count());
        let mean = mean(all());
        if !(low..=high).contains(&mean) {
            outside.push(format!("{}, {} ({mean:.2})", case.world, case.kind.name()));
        }
    }
    match outside.len() {
        0 => "The mean is within the band in every building and kind.".into(),
        n => format!(
            "The mean is outside the band in {n} of {}: {}.",
            kinds_page::cases().count(),
            outside.join("; ")
        ),
    }
}

/// Bounds within which the mean of a χ² of three degrees of freedom over `n` samples lies in 95 % of all cases, by
/// Wilson and Hilferty's approximation.
pub fn nees_band(n: usize) -> (f64, f64) {
    let freedom = 3.0 * n.max(1) as f64;
    let quantile = |z: f64| {
        let spread = 2.0 / (9.0 * freedom);
        3.0 * (1.0 - spread + z * spread.sqrt()).powi(3)
    };
    (quantile(-1.96), quantile(1.96))
}

/// Two parallel walls: what is seen and what is not.
pub fn featureless(results: &Results) -> Table {
    let mut table = table(["", "mean", "worst"]);
    let all = || drives(results, Case::usual(FEATURELESS, SimKind::Ideal));
    let mut row = |name: &str, unit: &str, digits: usize, values: Vec<f64>| {
        let show = |v: f64| format!("{v:.digits$} {unit}");
        let spread = Spread::of(values.into_iter());
        let shown =
            |value: fn(&Spread) -> f64| spread.as_ref().map_or_else(|| "–".into(), |s| show(value(s)));
        table.add_row([name.to_owned(), shown(|s| s.mean), shown(|s| s.worst)]);
    };
    let along = "final error along the walls";
    row(along, "m", 3, all().map(|r| r.default.judgement.trajectory.final_along_error_m).collect());
    let wheels = "the same of dead reckoning";
    row(wheels, "m", 3, all().map(|r| r.dead_reckoning.final_along_error_m).collect());
    let across = "largest error across, of a drive";
    row(across, "m", 3, all().map(|r| r.default.judgement.worst_across_error_m).collect());
    let heading = "largest error of the heading, of a drive";
    row(heading, "°", 2, all().map(|r| r.default.judgement.worst_heading_error_deg).collect());
    table
}

/// The page. `command` is what the reader types for it, `images` the figures' folder as seen from the page.
pub fn render(results: &Results, command: &str, images: &str) -> String {
    let mut page = String::new();
    let mut say = |text: &str| {
        // Writing to a String cannot fail.
        let _ = writeln!(page, "{text}\n");
    };
    say("# Experiments");
    say(&format!("All of this page, figures included, is written by\n\n```sh\n{command}\n```"));
    say("Simulated drives. Recorded logs that others use too are in [benchmark.md](benchmark.md).");
    for part in
        [both_kinds(results), papers_buildings(results, images), papers_page::section(results, images)]
    {
        part.iter().for_each(|text| say(text));
    }
    for part in [worse(results), kidnapped::section(results), covariance(results)] {
        part.iter().for_each(|text| say(text));
    }
    say("## Two parallel walls");
    say("30 m between two walls without any feature, ideal kind. Along them only the wheels know.");
    say(&featureless(results).to_string());
    page.truncate(page.trim_end().len());
    page.push('\n');
    page
}

fn both_kinds(results: &Results) -> Vec<String> {
    let [drives, kinds, measures, scale] = kinds_page::method(results);
    vec![
        "## How it is measured".into(),
        paragraph(&drives),
        kinds,
        paragraph(&measures),
        paragraph(&scale),
        "## Ideal and real".into(),
        paragraph(
            "The default configuration. What is asked of it stands beside what was measured: `≤` where it is kept, bold and `>`
            where it is not. Corners as the map lies are limited for the ideal kind, corners and trajectory aligned with a scale for
            the real one, and of hall, corridor, office, lab and flat no drive may lose track.",
        ),
        kinds_page::missed(&results.runs),
        "Corner error, equation (11), metres:".into(),
        kinds_page::corners(results).to_string(),
        paragraph(
            "Trajectory error, rmse, metres. The end of the drive is the distance of the last position from the truth, unaligned,
            and beside it that of the wheels alone. In the loop, a corridor round a block that ends where it began, it is what is
            left once the loop is closed, or the whole drift where it is not:",
        ),
        kinds_page::trajectories(results).to_string(),
    ]
}

fn papers_buildings(results: &Results, images: &str) -> Vec<String> {
    vec![
        "## The paper's buildings".into(),
        paragraph(
            "What the paper measured in a hall and a corridor of this kind, what the wheels alone say, and the default, errors of the
            ideal kind. The trajectory error is aligned; the final position and heading are as they are.",
        ),
        buildings(results).to_string(),
        "The hall of the paper's Fig. 8a, with the estimated path in red on the true one in green:".into(),
        format!("![Map of the hall over its blueprint]({images}/hall.svg)"),
        "The same scans by dead reckoning (Fig. 8b), which drives through the block in the middle:".into(),
        format!("![The hall by dead reckoning]({images}/hall_dead_reckoning.svg)"),
        "The corridor (Fig. 9), there and back:".into(),
        format!("![Map of the corridor over its blueprint]({images}/corridor.svg)"),
        "The office, in which three people walk:".into(),
        format!("![Map of the office over its blueprint]({images}/office.svg)"),
    ]
}

fn worse(results: &Results) -> Vec<String> {
    vec![
        "## When the robot is worse".into(),
        "The default configuration, same seeds, same constants; errors of the ideal kind but for what is named:".into(),
        robustness(results).to_string(),
    ]
}

fn covariance(results: &Results) -> Vec<String> {
    let about = format!(
        "The normalised estimation error squared (NEES) of the pose is 3 on average when the covariance is that of the error. It is
        above the band where the robot is surer than it should be, below it where it is more careful. The pose is held against it
        at {NEES_INSTANTS} instants of each drive; at each, the mean over the drives of an honest estimate lies within the χ² band
        in 95 % of all cases. The mean of all scans is beside it. An error of scale is none that the covariance knows of. A segment
        is spurious when it was seen in at least three scans and most of it is farther than 0.15 m from everything that stands
        still."
    );
    let title = "## Is the covariance honest?".into();
    vec![title, paragraph(&about), paragraph(&dishonest(results)), honesty(results).to_string()]
}

/// Lines are no longer than this.
const LINE: usize = 120;

/// A paragraph, broken into lines once its numbers are in it.
pub(super) fn paragraph(text: &str) -> String {
    let mut broken = String::new();
    let mut length = 0;
    for word in text.split_whitespace() {
        let width = word.chars().count();
        let fits = length + 1 + width <= LINE;
        if length > 0 {
            broken.push(if fits { ' ' } else { '\n' });
        }
        length = if fits && length > 0 { length + 1 + width } else { width };
        broken.push_str(word);
    }
    broken
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_band_of_the_mean_nees_is_that_of_the_tables() {
        // χ² of 60 degrees of freedom: 40.48 and 83.30.
        let (low, high) = nees_band(20);
        assert!((low - 40.48 / 20.0).abs() < 0.01 && (high - 83.30 / 20.0).abs() < 0.01, "{low} {high}");
    }
}
