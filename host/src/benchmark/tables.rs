//! The tables: one of all for the terminal, and those of the page.

use comfy_table::{CellAlignment, ColumnConstraint, ContentArrangement, Table, presets};

use super::measure::{ByReference, ByRelations, Measured};
use super::published::{self, Measure, Published, source_number};
use super::{PASS_M, Row};
use crate::score::PairErrors;

/// Columns of the terminal that the table takes at most.
const WIDTH: u16 = 158;

/// A number with so many digits behind the point; a dash where it is none.
fn figure(value: f64, digits: usize) -> String {
    if value.is_finite() { format!("{value:.digits$}") } else { "–".into() }
}

/// Mean and standard deviation of the translation.
fn translation(e: &PairErrors, digits: usize) -> String {
    format!("{} ± {}", figure(e.trans_m, digits), figure(e.trans_std, digits))
}

/// The same of the rotation.
fn rotation(e: &PairErrors, digits: usize) -> String {
    format!("{} ± {}", figure(e.rot_deg, digits), figure(e.rot_std, digits))
}

/// One table of all: what was used, what it took, the errors, and what others publish or why there is nothing.
pub fn summary(rows: &[Row]) -> Table {
    let mut table = Table::new();
    table.load_style(presets::UTF8_FULL_CONDENSED);
    table.set_header([
        "log",
        "scans",
        "skipped",
        "loops",
        "scans/s",
        "KiB",
        "error of",
        "dead reckoning",
        "online",
        "final",
        "others, as published",
    ]);
    for row in rows {
        let mut facts = facts(row);
        let mut lines = errors(row);
        let said = match &row.outcome {
            Ok(_) => "no reference, no relations".to_owned(),
            Err(reason) => format!("not replayed: {reason}"),
        };
        if lines.is_empty() {
            lines.push(["–".into(), "–".into(), "–".into(), "–".into(), said]);
        }
        for line in lines {
            table.add_row(facts.into_iter().chain(line));
            facts = Default::default();
        }
    }
    table.set_content_arrangement(ContentArrangement::Dynamic).set_width(WIDTH);
    for (k, column) in table.column_iter_mut().enumerate() {
        column.set_padding((0, 1));
        if (1..10).contains(&k) && k != 6 {
            column.set_cell_alignment(CellAlignment::Right);
        }
        if k < 10 {
            column.set_constraint(ColumnConstraint::ContentWidth);
        }
    }
    table
}

/// Log, scans, records skipped, loops, scans a second and RAM.
fn facts(row: &Row) -> [String; 6] {
    let of = |show: fn(&Measured) -> String| row.outcome.as_ref().map_or_else(|_| "–".into(), show);
    [
        row.found.name.clone(),
        of(|m| m.scans.to_string()),
        of(|m| m.skipped.to_string()),
        of(|m| m.loops_closed.to_string()),
        of(|m| figure(m.scans_per_s(), 0)),
        of(|m| format!("{:.1}", m.slam_bytes as f64 / 1024.0)),
    ]
}

/// For each measure of a log: its name, dead reckoning, online, final, and what others publish.
fn errors(row: &Row) -> Vec<[String; 5]> {
    let others = |measure: Measure| {
        let line = |p: &Published| format!("{} {}", p.figure, p.method);
        published::on(&row.found.log, measure).map(line).collect::<Vec<_>>().join("\n")
    };
    let mut lines = Vec::new();
    if let Some(ByReference { ate_rmse_m: p, .. }) = row.by_reference() {
        let [reckoned, online, in_map] = [p.dead_reckoning, p.online, p.in_final_map].map(|m| figure(m, 3));
        lines.push(["ATE, m".into(), reckoned, online, in_map, others(Measure::Trajectory)]);
    }
    if let Some(ByRelations { errors: p, published, .. }) = row.by_relations() {
        let mut line =
            |what: &str, show: fn(&PairErrors, usize) -> String, digits: usize, measure: Measure| {
                let [reckoned, online, in_map] =
                    [&p.dead_reckoning, &p.online, &p.in_final_map].map(|e| show(&e.errors, digits));
                let others = if *published { others(measure) } else { String::new() };
                lines.push([what.into(), reckoned, online, in_map, others]);
            };
        line("relations, m", translation, 3, Measure::Relations);
        line("relations, °", rotation, 2, Measure::RelationsRotation);
    }
    lines
}

fn markdown<T: Into<String>>(header: impl IntoIterator<Item = T>) -> Table {
    let mut table = Table::new();
    table.load_style(presets::ASCII_MARKDOWN);
    table.set_header(header.into_iter().map(Into::into).collect::<Vec<String>>());
    for column in table.column_iter_mut().skip(1) {
        column.set_cell_alignment(CellAlignment::Right);
    }
    table
}

/// Ours, in the order of [`Poses::all`](super::Poses::all).
const OURS: [&str; 3] = ["lineslam, online", "lineslam, final", "dead reckoning"];

/// A table of methods, ours first, over logs.
fn methods<'a, T>(
    logs: &[(&'a Row, &'a T)],
    measure: Measure,
    ours: impl Fn(&'a T, usize) -> String,
    comparable: impl Fn(&'a T) -> bool,
) -> Table {
    let names = logs.iter().map(|(row, _)| row.found.name.clone());
    let mut table = markdown(["".to_owned()].into_iter().chain(names));
    for (k, name) in OURS.into_iter().enumerate() {
        table.add_row(std::iter::once(name.to_owned()).chain(logs.iter().map(|(_, t)| ours(t, k))));
    }
    for (method, source) in published::methods(measure) {
        let figures: Vec<Option<&str>> = logs
            .iter()
            .map(|(row, t)| {
                let mut on = published::on(&row.found.log, measure).filter(|_| comparable(t));
                on.find(|p| (p.method, p.source) == (method, source)).map(|p| p.figure)
            })
            .collect();
        if figures.iter().any(Option::is_some) {
            let cells = figures.into_iter().map(|f| f.unwrap_or("–").to_owned());
            table.add_row(std::iter::once(format!("{method} [{}]", source_number(source))).chain(cells));
        }
    }
    table
}

/// Absolute trajectory errors of the logs with a reference.
pub(super) fn trajectory_table(rows: &[Row]) -> Option<Table> {
    let logs: Vec<_> = rows.iter().filter_map(|row| Some((row, row.by_reference()?))).collect();
    let ours = |r: &ByReference, k: usize| figure(*r.ate_rmse_m.all()[k], 3);
    (!logs.is_empty()).then(|| methods(&logs, Measure::Trajectory, ours, |_| true))
}

/// Translational and rotational errors of the logs with relations, and what was held against what.
pub(super) fn relation_tables(rows: &[Row]) -> Option<[Table; 3]> {
    let logs: Vec<_> = rows.iter().filter_map(|row| Some((row, row.by_relations()?))).collect();
    if logs.is_empty() {
        return None;
    }
    let metres = |r: &ByRelations, k: usize| translation(&r.errors.all()[k].errors, 4);
    let degrees = |r: &ByRelations, k: usize| rotation(&r.errors.all()[k].errors, 3);
    let mut used =
        markdown(["log", "relations", "used", "laser ahead, m", "median online, m", "median final, m"]);
    for (row, r) in &logs {
        let (online, in_map) = (&r.errors.online, &r.errors.in_final_map);
        used.add_row([
            row.found.name.clone(),
            online.of.to_string(),
            online.errors.n.to_string(),
            format!("{}", r.laser_m),
            figure(online.errors.trans_med, 4),
            figure(in_map.errors.trans_med, 4),
        ]);
    }
    let comparable = |r: &ByRelations| r.published;
    Some([
        methods(&logs, Measure::Relations, metres, comparable),
        methods(&logs, Measure::RelationsRotation, degrees, comparable),
        used,
    ])
}

/// What becomes of the main measures with noise, of the logs that were replayed so.
fn firm_rows(rows: &[Row]) -> Vec<[String; 5]> {
    let firm = rows.iter().filter_map(|row| Some((row, row.outcome.as_ref().ok()?.firmness?)));
    firm.map(|(row, f)| {
        let [plain, median, worst] = [f.plain_m, f.median_m, f.worst_m].map(|m| figure(m, 3));
        [row.found.name.clone(), f.measure.into(), plain, median, worst]
    })
    .collect()
}

const FIRM: [&str; 5] = ["log", "final error of", "plain", "median with noise", "worst with noise"];

/// The same for the page; `None` where no log was replayed with noise.
pub(super) fn firm_table(rows: &[Row]) -> Option<Table> {
    let firm = firm_rows(rows);
    let mut table = markdown(FIRM);
    let some = !firm.is_empty();
    table.add_rows(firm);
    some.then_some(table)
}

/// And for the terminal.
pub fn firm_summary(rows: &[Row]) -> Option<Table> {
    let firm = firm_rows(rows);
    let mut table = Table::new();
    table.load_style(presets::UTF8_FULL_CONDENSED);
    table.set_header(FIRM);
    for column in table.column_iter_mut().skip(2) {
        column.set_cell_alignment(CellAlignment::Right);
    }
    let some = !firm.is_empty();
    table.add_rows(firm);
    some.then_some(table)
}

/// What each log took.
pub(super) fn cost_table(rows: &[Row]) -> Table {
    let mut table = markdown([
        "log",
        "scans used",
        "records skipped",
        "loops closed",
        "scans a second",
        "RAM of the core, KiB",
        "way driven, m",
    ]);
    for row in rows {
        let way = row.outcome.as_ref().map_or_else(|_| "–".into(), |m| figure(m.distance_m, 0));
        table.add_row(facts(row).into_iter().chain([way]));
    }
    table
}

/// How thick walls are, of the logs with a reference.
pub(super) fn walls_table(rows: &[Row]) -> Table {
    let pass = |whose: &str| format!("each {PASS_M} m alone, {whose}");
    let mut table = markdown([
        "log".to_owned(),
        "whole map, online".into(),
        "final".into(),
        "by the reference".into(),
        format!("the same, as published [{}]", source_number(published::README)),
        pass("online"),
        pass("by the reference"),
    ]);
    for (row, r) in rows.iter().filter_map(|row| Some((row, row.by_reference()?))) {
        let theirs = published::on(&row.found.log, Measure::ReferenceWalls).next();
        table.add_row([
            row.found.name.clone(),
            figure(r.online_walls.whole_m, 4),
            figure(r.final_walls.whole_m, 4),
            figure(r.reference_walls.whole_m, 4),
            theirs.map_or("–", |p| p.figure).to_owned(),
            figure(r.online_walls.pass_m, 4),
            figure(r.reference_walls.pass_m, 4),
        ]);
    }
    table
}
