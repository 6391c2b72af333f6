//! `lineslam score`.

use std::path::{Path, PathBuf};

use anyhow::Context;
use clap::ArgGroup;
use comfy_table::{CellAlignment, Table, presets};
use lineslam::score::{
    self, AgainstReference, PairErrors, RelationErrors, ScoreError, StampedPose, at_laser, read_relations,
    read_tum, span_s,
};
use serde::Serialize;

#[derive(clap::Args)]
#[command(group = ArgGroup::new("judge").args(["reference", "relations"]).required(true).multiple(true))]
pub struct Args {
    /// The trajectory: a TUM file, such as replay's trajectory.tum.
    trajectory: PathBuf,
    /// Trajectory that counts as true, a TUM file. Gives the absolute trajectory error, after one rotation and translation that
    /// lay the trajectory on it, and the errors between poses some way apart.
    #[arg(long, value_name = "REF.tum")]
    reference: Option<PathBuf>,
    /// Relations between poses, checked by hand: a line each, t1 t2 x y z roll pitch yaw or t1 t2 x y yaw, the pose at t2 as
    /// seen from that at t1, in seconds, metres and radians.
    #[arg(long, value_name = "FILE")]
    relations: Option<PathBuf>,
    /// Move each pose this far ahead before it is held against the relations, where these are those of the laser, metres.
    #[arg(
        long,
        value_name = "METRES",
        default_value_t = 0.0,
        requires = "relations",
        allow_negative_numbers = true
    )]
    laser: f64,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

/// What is printed as JSON.
#[derive(Serialize)]
struct Scores<'a> {
    trajectory: &'a Path,
    poses: usize,
    #[serde(skip_serializing_if = "Option::is_none")]
    reference: Option<AgainstReference>,
    #[serde(skip_serializing_if = "Option::is_none")]
    relations: Option<ByRelations>,
}

#[derive(Serialize)]
struct ByRelations {
    laser_m: f64,
    #[serde(flatten)]
    found: RelationErrors,
}

pub fn run(args: &Args) -> anyhow::Result<()> {
    let trajectory = read_tum(&args.trajectory)?;
    let reference =
        args.reference.as_deref().map(|path| by_reference(args, &trajectory, path)).transpose()?;
    let relations =
        args.relations.as_deref().map(|path| by_relations(args, &trajectory, path)).transpose()?;
    let scores = Scores { trajectory: &args.trajectory, poses: trajectory.len(), reference, relations };
    if args.json {
        println!("{}", serde_json::to_string_pretty(&scores).context("the scores as JSON")?);
    } else {
        println!("{}\n\n{}", summary(args, &scores), pairs(&scores));
    }
    Ok(())
}

fn by_reference(
    args: &Args,
    trajectory: &[StampedPose],
    path: &Path,
) -> Result<AgainstReference, ScoreError> {
    let reference = read_tum(path)?;
    score::against_reference(trajectory, &reference)
        .ok_or_else(|| no_overlap(args, trajectory, path, span_s(reference.iter().map(|p| p.stamp_s))))
}

fn by_relations(args: &Args, trajectory: &[StampedPose], path: &Path) -> Result<ByRelations, ScoreError> {
    let relations = read_relations(path)?;
    let found = score::relation_errors(&at_laser(trajectory, args.laser), &relations).ok_or_else(|| {
        no_overlap(args, trajectory, path, span_s(relations.iter().flat_map(|r| r.stamps_s)))
    })?;
    Ok(ByRelations { laser_m: args.laser, found })
}

fn no_overlap(args: &Args, trajectory: &[StampedPose], other: &Path, other_s: (f64, f64)) -> ScoreError {
    ScoreError::NoOverlap {
        trajectory: args.trajectory.clone(),
        trajectory_s: span_s(trajectory.iter().map(|p| p.stamp_s)),
        other: other.to_owned(),
        other_s,
    }
}

fn summary(args: &Args, scores: &Scores<'_>) -> Table {
    let mut table = Table::new();
    table.load_style(presets::NOTHING);
    let mut row = |what: &str, value: String| {
        table.add_row([what.to_owned(), value]);
    };
    row("trajectory", format!("{}, {} poses", args.trajectory.display(), scores.poses));
    if let (Some(path), Some(r)) = (&args.reference, &scores.reference) {
        row("reference", format!("{}, {} poses", path.display(), r.poses));
        if r.coverage < 1.0 {
            let without = 100.0 * (1.0 - r.coverage);
            row("", format!("at {without:.1} % of its stamps there is no pose: scored as standing still"));
        }
        if r.exact < r.coverage {
            let between = 100.0 * (r.coverage - r.exact);
            row("", format!("at {between:.1} % of its stamps the pose is interpolated"));
        }
        row(
            "absolute trajectory error",
            format!("rmse {:.4} m, median {:.4} m, max {:.4} m", r.ate_rmse_m, r.ate_med_m, r.ate_max_m),
        );
        row("heading", format!("rmse {:.3}°", r.rot_rmse_deg));
        row("path", format!("{:.1} m, the reference's {:.1} m", r.path_est_m, r.path_ref_m));
    }
    if let (Some(path), Some(r)) = (&args.relations, &scores.relations) {
        let laser =
            if r.laser_m == 0.0 { String::new() } else { format!(", of the laser {} m ahead", r.laser_m) };
        let used = format!("{}, {} of {} used{laser}", path.display(), r.found.errors.n, r.found.of);
        row("relations", used);
    }
    if let Some(column) = table.column_mut(0) {
        column.set_cell_alignment(CellAlignment::Right);
    }
    table
}

/// The errors between pairs of poses.
fn pairs(scores: &Scores<'_>) -> Table {
    let mut table = Table::new();
    table.load_style(presets::UTF8_FULL_CONDENSED);
    table.set_header(["between poses", "pairs", "translation, m", "median", "rotation, °"]);
    let mut row = |what: String, e: &PairErrors| {
        table.add_row([
            what,
            e.n.to_string(),
            format!("{:.4} ± {:.4}", e.trans_m, e.trans_std),
            format!("{:.4}", e.trans_med),
            format!("{:.3} ± {:.3}", e.rot_deg, e.rot_std),
        ]);
    };
    for (name, errors) in scores.reference.iter().flat_map(|r| &r.rpe) {
        let what = match name.as_str() {
            "step" => "of one step".to_owned(),
            "revisit" => "back at a place".to_owned(),
            way => format!("{} m of way apart", way.trim_end_matches('m')),
        };
        row(what, errors);
    }
    if let Some(relations) = &scores.relations {
        row("relations".to_owned(), &relations.found.errors);
    }
    for column in table.column_iter_mut().skip(1) {
        column.set_cell_alignment(CellAlignment::Right);
    }
    table
}
