//! The page that says what the experiments measured.

use std::fmt::Write;

use comfy_table::{CellAlignment, Row, Table, presets};

use super::{BUILDINGS, CONDITIONS, FEATURELESS, LOST_M, Measured, Results, Run, papers_page};
use crate::score::Spread;
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
fn corners_found<'a>(measured: impl Iterator<Item = &'a Measured> + Clone) -> String {
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

/// The drives of a world under a condition.
fn drives<'a>(
    results: &'a Results,
    world: &'a str,
    condition: usize,
) -> impl Iterator<Item = &'a Run> + Clone {
    results.runs.iter().filter(move |r| r.world == world && r.condition == condition)
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
        let all = || drives(results, building.name, 0);
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
            format!("{} of {}", ours().filter(|m| m.lost()).count(), ours().count()),
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
            let all = || drives(results, building.name, index).map(|r| &r.default);
            let corners = Spread::of(all().filter_map(|m| m.judgement.corner_error_m));
            let corner = |value: fn(&Spread) -> f64| metres(corners.as_ref().map_or(f64::NAN, value));
            table.add_row([
                condition.name.to_owned(),
                building.name.into(),
                corner(|s| s.mean),
                corner(|s| s.worst),
                metres(mean(all().map(|m| m.judgement.trajectory.ate_rmse_m))),
                corners_found(all()),
                format!("{} of {}", all().filter(|m| m.lost()).count(), all().count()),
            ]);
        }
    }
    table
}

/// Whether the reported covariance is honest, and what people leave behind.
pub fn honesty(results: &Results) -> Table {
    let mut table = table([
        "building",
        "NEES, mean",
        "95 % band of its mean over seeds",
        "instants within it",
        "along the heading within 2σ",
        "spurious segments per 100",
    ]);
    for building in BUILDINGS {
        let all = || drives(results, building.name, 0).map(|r| &r.default.judgement);
        let (low, high) = nees_band(all().count());
        let at = |instant: usize| mean(all().filter_map(|j| j.nees.get(instant).copied()));
        let within = (0..NEES_INSTANTS).map(at).filter(|v| (low..=high).contains(v)).count();
        let spurious: usize = all().map(|j| j.spurious_segments).sum();
        let established: usize = all().map(|j| j.established_segments).sum();
        table.add_row([
            building.name.to_owned(),
            format!("{:.2}", mean(all().map(|j| j.mean_nees))),
            format!("{low:.2} to {high:.2}"),
            format!("{within} of {NEES_INSTANTS}"),
            format!("{:.0} %", 100.0 * mean(all().map(|j| j.along_within_two_sigma))),
            format!("{:.1}", 100.0 * spurious as f64 / (established - spurious).max(1) as f64),
        ]);
    }
    table
}

/// Bounds within which the mean of a χ² of three degrees of freedom over `n` samples lies in 95 % of all cases, by
/// Wilson and Hilferty's approximation.
fn nees_band(n: usize) -> (f64, f64) {
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
    let all = || drives(results, FEATURELESS, 0);
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
    let (first, last) = (results.seeds.start, results.seeds.end - 1);
    let mut page = String::new();
    let mut say = |text: &str| {
        // Writing to a String cannot fail.
        let _ = writeln!(page, "{text}\n");
    };
    say("# Experiments");
    say(&format!("All of this page, figures included, is written by\n\n```sh\n{command}\n```"));
    say("Simulated drives. Recorded logs that others use too are in [benchmark.md](benchmark.md).");
    say("## The paper's buildings");
    say(&format!(
        "Simulated drives with seeds {first} to {last}. Each seed draws wheels that are 1 % larger or smaller than the\n\
         robot file says, a track off by 2 %, slip, and a URG-04LX with σ of 10 mm to 1 m and 1 % of the range beyond, dropouts\n\
         and mixed pixels. The corner error is equation (11): the mean distance between the blueprint's corners and the\n\
         crossings of the map's lines there, once as the map lies, in the frame in which the drive began, and once with the map\n\
         laid over the blueprint by a rotation and a translation, as the paper lays it. The trajectory error is after one SE(2)\n\
         alignment. A drive has lost track when the robot was once farther than {LOST_M} m from where it\n\
         thought it was. Metres where nothing else is said; means over the seeds."
    ));
    say(&buildings(results).to_string());
    say("The hall of the paper's Fig. 8a, with the estimated path in red on the true one in green:");
    say(&format!("![Map of the hall over its blueprint]({images}/hall.svg)"));
    say("The same scans by dead reckoning (Fig. 8b), which drives through the block in the middle:");
    say(&format!("![The hall by dead reckoning]({images}/hall_dead_reckoning.svg)"));
    say("The corridor (Fig. 9), there and back:");
    say(&format!("![Map of the corridor over its blueprint]({images}/corridor.svg)"));
    say("The office, in which three people walk:");
    say(&format!("![Map of the office over its blueprint]({images}/office.svg)"));
    for paragraph in papers_page::section(results, images) {
        say(&paragraph);
    }
    say("## When the robot is worse");
    say("The default configuration, same seeds, same constants:");
    say(&robustness(results).to_string());
    say("## Is the covariance honest?");
    say(&format!(
        "The normalised estimation error squared (NEES) of the pose is 3 on average when the covariance is that of the error. \
         Held\nagainst it at {NEES_INSTANTS} instants of each drive. A segment is spurious when it was seen in at least three \
         scans and most\nof it is farther than 0.15 m from everything that stands still."
    ));
    say(&honesty(results).to_string());
    say("## Two parallel walls");
    say("30 m between two walls without any feature. Along them only the wheels know.");
    say(&featureless(results).to_string());
    page.truncate(page.trim_end().len());
    page.push('\n');
    page
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
