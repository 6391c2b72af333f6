//! What the page says of both kinds of errors, and of the limits.

use comfy_table::Table;

use super::document::{corners_found, corners_share, drives, lost, mean, metres, table};
use super::limits::{self, Held, Quantity};
use super::{Case, LOST_M, Measured, Results, Run, WORLDS};
use crate::score::Spread;
use crate::sim::SimKind;
use crate::sim::judge::TrajectoryErrors;

/// The rows of the tables, in their order.
pub(super) fn cases() -> impl Iterator<Item = Case> {
    WORLDS.into_iter().flat_map(|world| SimKind::ALL.map(|kind| Case::usual(world, kind)))
}

/// Mean and worst, metres; beside the mean its limit, where there is one, and in bold what is above it.
fn mean_and_worst(values: impl Iterator<Item = f64>, held: Option<Held>) -> [String; 2] {
    let spread = Spread::of(values);
    let [mean, worst] = [|s: &Spread| s.mean, |s: &Spread| s.worst]
        .map(|value| metres(spread.as_ref().map_or(f64::NAN, value)));
    let mean = match held {
        None => mean,
        Some(held) if held.holds() => format!("{mean} ≤ {}", metres(held.limit.most)),
        Some(held) => format!("**{mean}** > {}", metres(held.limit.most)),
    };
    [mean, worst]
}

/// Mean, and from where to where, if that is not all one.
fn scales(values: impl Iterator<Item = f64> + Clone) -> String {
    let Some(spread) = Spread::of(values.clone()) else { return "–".into() };
    let least = values.fold(f64::INFINITY, f64::min);
    if least == spread.worst {
        return format!("{least:.4}");
    }
    format!("{:.4} ({least:.4} to {:.4})", spread.mean, spread.worst)
}

/// Drives that lost track, in bold where there may be none.
fn lost_and_limit(results: &Results, case: Case) -> String {
    let lost = lost(drives(results, case).map(|r| &r.default));
    match limits::held(&results.runs, case, Quantity::Lost) {
        Some(held) if !held.holds() => format!("**{lost}**"),
        _ => lost,
    }
}

/// Equation (11), by world and kind.
pub fn corners(results: &Results) -> Table {
    let mut table = table([
        "building",
        "kind",
        "drives",
        "as the map lies: mean",
        "worst",
        "found",
        "laid over the blueprint: mean",
        "worst",
        "found",
        "laid with a scale: mean",
        "worst",
        "found",
        "the scale",
    ]);
    for case in cases() {
        let all = || drives(results, case).map(|r| &r.default);
        let held = |quantity| limits::held(&results.runs, case, quantity);
        let corner = |error: fn(&Measured) -> Option<f64>, quantity: Option<Quantity>| {
            mean_and_worst(all().filter_map(error), quantity.and_then(held))
        };
        let scaled = all().map(|m| &m.judgement.laid_with_scale).filter(|laid| laid.corners_found > 0);
        let mut row = vec![case.world.to_owned(), case.kind.name().into(), all().count().to_string()];
        row.extend(corner(|m| m.judgement.corner_error_m, Some(Quantity::Corners)));
        row.push(corners_found(all()));
        row.extend(corner(|m| m.judgement.laid.corner_error_m, None));
        row.push(corners_share(all(), &|m| m.judgement.laid.corners_found));
        row.extend(corner(|m| m.judgement.laid_with_scale.corner_error_m, Some(Quantity::ScaledCorners)));
        row.push(corners_share(all(), &|m| m.judgement.laid_with_scale.corners_found));
        row.push(scales(scaled.map(|laid| laid.scale)));
        table.add_row(row);
    }
    table
}

/// The way the robot took, by world and kind.
pub fn trajectories(results: &Results) -> Table {
    let mut table = table([
        "building",
        "kind",
        "drives",
        "unaligned: mean",
        "worst",
        "aligned: mean",
        "worst",
        "with a scale: mean",
        "worst",
        "the scale",
        "that of the unit's ranges",
        "end of the drive: mean",
        "worst",
        "by dead reckoning: mean",
        "lost track",
    ]);
    for case in cases() {
        let all = || drives(results, case);
        let error = |value: fn(&TrajectoryErrors) -> f64, quantity: Option<Quantity>| {
            let held = quantity.and_then(|quantity| limits::held(&results.runs, case, quantity));
            mean_and_worst(all().map(|r| value(&r.default.judgement.trajectory)), held)
        };
        let mut row = vec![case.world.to_owned(), case.kind.name().into(), all().count().to_string()];
        row.extend(error(|t| t.unaligned_rmse_m, None));
        row.extend(error(|t| t.ate_rmse_m, None));
        row.extend(error(|t| t.scaled_rmse_m, Some(Quantity::ScaledTrajectory)));
        row.push(scales(all().map(|r| r.default.judgement.trajectory.scale)));
        row.push(scales(all().map(|r| 1.0 / r.unit.range_scale)));
        row.extend(error(|t| t.final_position_error_m, None));
        row.push(metres(mean(all().map(|r| r.dead_reckoning.final_position_error_m))));
        row.push(lost_and_limit(results, case));
        table.add_row(row);
    }
    table
}

/// Which limits are missed, in a sentence or a list.
pub fn missed(runs: &[Run]) -> String {
    let all = limits::all_held(runs);
    let missed: Vec<&Held> = all.iter().filter(|held| !held.holds()).collect();
    let (n, k) = (all.len(), missed.len());
    if missed.is_empty() {
        return format!("All {n} limits are kept.");
    }
    let mut text = format!("Of {n} limits {k} {} missed:\n", if k == 1 { "is" } else { "are" });
    for held in missed {
        let Held { limit, measured } = held;
        let shown = match limit.quantity {
            Quantity::Lost => format!("{measured:.0}, and none may"),
            _ if measured.is_finite() => format!("{measured:.3} m, where {:.3} m is the limit", limit.most),
            _ => format!("there are maps without any corner; {:.3} m is the limit", limit.most),
        };
        text.push_str(&format!(
            "\n- {}, {} kind, {}: {shown}",
            limit.world,
            limit.kind.name(),
            limit.quantity.name()
        ));
    }
    text
}

/// What is measured and how.
pub(super) fn method(results: &Results) -> [String; 4] {
    let (first, last) = (results.seeds.start, results.seeds.end - 1);
    [
        format!(
            "Each world of `worlds/` is driven with seeds {first} to {last}. The robot is
            `robots/paper.toml`: two wheels with encoders, a URG-04LX. From the seed come the errors, of one of two kinds
            (`lineslam simulate worlds/hall.toml --kind real --seed {first}` is one such drive):"
        ),
        "- `ideal` has errors that average out: wheels 1 % larger or smaller than the robot file says, a track off by 2 %, slip, \
         ranges with\n  σ of 10 mm up to 1 m and 1 % of the range beyond, dropouts and mixed pixels. Walls are as drawn.\n\
         - `real` has what ordinary robots and buildings have besides: ranges with the bias that the data sheet allows, and one of \
         the cold\n  unit; dark and shiny surfaces, glass, beams that tilt over sills; slip in turns and at starts, wheels that spin, \
         a caster that kicks;\n  stamps that are late, early and jitter; walls with a bow, and skirting before them."
            .into(),
        format!(
            "The corner error is equation (11): the mean distance between the blueprint's corners and the crossings of the map's
            lines there. A corner that is 0.35 m off is not found, so an error counts only together with the share found. The
            trajectory error is the root mean square of the positions, each as the robot knew it at that scan. Both are in the
            frame in which the drive began, without any alignment; after the one rotation and translation that fit best, as the
            paper lays its map over the blueprint; and after these with a scale. A drive has lost track when the robot was once
            farther than {LOST_M} m from where it thought it was. All lengths are metres where nothing else is said, means and worst are
            over the drives."
        ),
        "A unit's error of scale cannot be told from driving: ranges that are all 1 % too long make a map that is 1 % too large, with
        nothing in it to show that. So the real kind is held against its limits aligned with a scale, and the scale by which map or
        trajectory is multiplied is printed: mean, least and largest. Beside it stands what it should be, one over the scale of
        the unit's ranges."
            .into(),
    ]
}
