//! What the page says of the paper's configurations.

use std::collections::BTreeMap;

use comfy_table::Table;

use super::document::{corners_share, lost, mean, metres, paragraph, table};
use super::papers::{CONFIGURATIONS, PaperRun, SERIES};
use super::{BUILDINGS, LOST_M, Measured, Results};
use crate::configuration::Configuration;
use crate::score::Spread;

/// Runs of one row.
#[derive(Clone, Copy)]
struct Row<'a> {
    results: &'a Results,
    world: &'static str,
    series: usize,
    configuration: Configuration,
}

impl<'a> Row<'a> {
    fn all(results: &'a Results) -> impl Iterator<Item = Self> {
        let configured = move |world, series| {
            CONFIGURATIONS.into_iter().map(move |configuration| Self {
                results,
                world,
                series,
                configuration,
            })
        };
        let driven = move |world| (0..SERIES.len()).flat_map(move |series| configured(world, series));
        BUILDINGS.into_iter().flat_map(move |building| driven(building.name))
    }

    fn runs(&self) -> impl Iterator<Item = &'a PaperRun> + Clone {
        let Self { world, series, configuration, .. } = *self;
        self.results
            .papers
            .iter()
            .filter(move |r| r.world == world && r.series == series && r.configuration == configuration)
    }

    fn measured(&self) -> impl Iterator<Item = &'a Measured> + Clone {
        self.runs().map(|r| &r.measured)
    }

    fn mean(&self, value: fn(&Measured) -> f64) -> f64 {
        mean(self.measured().map(value))
    }

    fn trajectory_m(&self) -> f64 {
        self.mean(|m| m.judgement.trajectory.ate_rmse_m)
    }

    fn lost(&self) -> String {
        lost(self.measured())
    }

    /// Trajectory errors drive by drive, those of the RANSAC seeds together.
    fn by_drive(&self) -> Vec<Vec<f64>> {
        let mut drives: BTreeMap<u64, Vec<f64>> = BTreeMap::new();
        for run in self.runs() {
            drives.entry(run.seed).or_default().push(run.measured.judgement.trajectory.ate_rmse_m);
        }
        drives.into_values().collect()
    }

    /// Standard deviation over RANSAC seeds on one drive, as the root of its mean square over the drives; `None` without RANSAC.
    fn ransac_deviation_m(&self) -> Option<f64> {
        let drives = self.by_drive();
        if drives.iter().all(|drive| drive.len() < 2) {
            return None;
        }
        // As of a sample: of three draws, not of all there are.
        let variance = |drive: &Vec<f64>| {
            let n = drive.len() as f64;
            Spread::of(drive.iter().copied()).map(|s| s.deviation.powi(2) * n / (n - 1.0))
        };
        Some(mean(drives.iter().filter_map(variance)).sqrt())
    }

    /// Median and largest over the drives of the factor between the RANSAC seed that did worst and the one that did best.
    fn ransac_factors(&self) -> Option<Spread> {
        let factor = |drive: &Vec<f64>| {
            let worst = drive.iter().copied().fold(0.0, f64::max);
            worst / drive.iter().copied().fold(f64::INFINITY, f64::min)
        };
        Spread::of(self.by_drive().iter().map(factor))
    }

    fn heads(&self) -> [String; 3] {
        [self.world, SERIES[self.series].name, self.configuration.name()].map(str::to_owned)
    }
}

/// Mean ± standard deviation, metres.
fn spread(values: impl Iterator<Item = f64>) -> String {
    Spread::of(values).map_or_else(|| "–".into(), |s| format!("{} ± {}", metres(s.mean), metres(s.deviation)))
}

/// Equation (11).
pub fn corners(results: &Results) -> Table {
    let mut table = table([
        "building",
        "drives",
        "configuration",
        "laid over the blueprint",
        "found",
        "laid with a scale",
        "the scale",
        "found",
        "as the map lies",
        "found",
    ]);
    for row in Row::all(results) {
        let all = || row.measured().map(|m| &m.judgement);
        let share = |found: &dyn Fn(&Measured) -> usize| corners_share(row.measured(), found);
        let scaled = || all().map(|j| &j.laid_with_scale).filter(|laid| laid.corners_found > 0);
        table.add_row(row.heads().into_iter().chain([
            spread(all().filter_map(|j| j.laid.corner_error_m)),
            share(&|m| m.judgement.laid.corners_found),
            spread(all().filter_map(|j| j.laid_with_scale.corner_error_m)),
            format!("{:.4}", mean(scaled().map(|laid| laid.scale))),
            share(&|m| m.judgement.laid_with_scale.corners_found),
            spread(all().filter_map(|j| j.corner_error_m)),
            share(&|m| m.judgement.corners_found),
        ]));
    }
    table
}

/// The way the robot took.
pub fn trajectories(results: &Results) -> Table {
    let mut table = table([
        "building",
        "drives",
        "configuration",
        "aligned",
        "of that RANSAC's luck",
        "aligned with a scale",
        "the scale",
        "unaligned",
        "singular scans",
        "lost track",
    ]);
    for row in Row::all(results) {
        let all = || row.measured().map(|m| &m.judgement.trajectory);
        table.add_row(row.heads().into_iter().chain([
            spread(all().map(|t| t.ate_rmse_m)),
            row.ransac_deviation_m().map_or_else(|| "–".into(), |m| format!("± {}", metres(m))),
            spread(all().map(|t| t.scaled_rmse_m)),
            format!("{:.4}", mean(all().map(|t| t.scale))),
            spread(all().map(|t| t.unaligned_rmse_m)),
            match row.configuration {
                Configuration::Default => "–".into(),
                _ => format!("{:.0} %", 100.0 * row.mean(|m| m.singular)),
            },
            row.lost(),
        ]));
    }
    table
}

/// Paragraphs and tables, in the order of the page.
pub fn section(results: &Results, images: &str) -> Vec<String> {
    let ours = "`--config paper` is what the paper's text says, equation by equation (`slam-core/src/paper/`, which reads in
        their order). What the text leaves open is ours: RANSAC's draws and thresholds, the gate of the association, when a
        system counts as singular. These values were set where the algorithm with the weighted merge does best in hall and
        corridor, on other seeds. Two deviations have names of their own: `paper-weighted` weighs the end points of a merge
        by the points they stand for, and `paper-partial`, in addition, corrects of a singular system what it does
        determine.";
    let how = format!(
        "The wheels are once as the robot file says, but for slip, as the paper's must have been, and once wrong as those of the ideal kind.
        Each drive is replayed with {} RANSAC seeds; ± is the standard deviation over all drives and RANSAC seeds. The paper
        lays its map over the blueprint, so equation (11) is here with the map laid so, too: by the rotation and the
        translation with which most corners are found, and of these with the least error. A corner that is 0.35 m off is not
        found: an error counts only together with the share found. A robot whose scanner has an error of scale cannot tell it
        from one of its wheels; for such drives there is the alignment with a scale.",
        results.ransac_seeds
    );
    let about_ways = format!(
        "Error of the trajectory, rmse in metres, aligned by SE(2), by a scale, too, and not at all, and how much of its
        spread is that of RANSAC on one and the same drive. Singular are scans that had pairs, and yet left the whole pose, or
        for `paper-partial`, whose threshold is ten times as high, a direction of it, to the wheels; lost is a drive in which the robot was once farther than
        {LOST_M} m from where it thought it was:"
    );
    let mut page = vec![
        "## The paper's algorithm".into(),
        paragraph(ours),
        paragraph(&how),
        "Corner error, equation (11), metres:".into(),
        corners(results).to_string(),
        paragraph(&about_ways),
        trajectories(results).to_string(),
        "### What loses the corridor".into(),
        paragraph(&what_is_lost(results)),
        format!("![The corridor by the paper's text]({images}/corridor_paper.svg)"),
        paragraph(&what_is_kept(results)),
        format!("![The corridor with partial correction]({images}/corridor_paper-partial.svg)"),
        "### What the merge costs".into(),
        paragraph(&merge(results)),
    ];
    if results.ransac_seeds > 1 {
        page.extend(["### RANSAC's luck".into(), paragraph(&luck(results))]);
    }
    page
}

/// The row of a building with wheels that are calibrated.
fn calibrated<'a>(results: &'a Results, world: &'static str, configuration: Configuration) -> Row<'a> {
    Row { results, world, series: 0, configuration }
}

fn what_is_lost(results: &Results) -> String {
    let percent = |world| {
        format!("{:.0} %", 100.0 * calibrated(results, world, Configuration::Paper).mean(|m| m.singular))
    };
    format!(
        "One sentence of the paper: where the system is singular, the pose is not updated. Two parallel walls do not say how
        far along them the robot is, and in a corridor there often is nothing else: of the corridor's scans {} are singular,
        of the hall's {}. But the same two walls do say how far the robot is from them and which way it looks. The paper lets
        that go, too. The heading is then the wheels', and all that was seen is registered by it: a wall seen from a pose that
        is turned becomes a wall that is turned, and the next scan agrees with it. Nothing in the algorithm doubts it again.
        This is what it draws, there and back:",
        percent("corridor"),
        percent("hall"),
    )
}

fn what_is_kept(results: &Results) -> String {
    let row = |world, configuration| calibrated(results, world, configuration);
    let three = |show: &dyn Fn(Configuration) -> String| Configuration::PAPERS.map(show);
    let [paper, weighted, partial] = three(&|c| metres(row("corridor", c).trajectory_m()));
    let lost = three(&|c| row("corridor", c).lost()).join(", ");
    let hall = three(&|c| metres(row("hall", c).trajectory_m())).join(", ");
    let office = row("office", Configuration::PaperPartial).lost();
    let worse: Vec<&str> = (BUILDINGS.iter().map(|b| b.name))
        .filter(|world| {
            let [partial, default] = [Configuration::PaperPartial, Configuration::Default];
            row(world, default).trajectory_m() > row(world, partial).trajectory_m()
        })
        .collect();
    let worse = match worse[..] {
        [] => String::new(),
        _ => format!(
            "With these wheels the default does worse than `paper-partial` in: {}. ",
            worse.join(", ")
        ),
    };
    let default = ["corridor", "hall"].map(|world| metres(row(world, Configuration::Default).trajectory_m()));
    format!(
        "`paper-partial` corrects the directions that are observed and leaves out the others: those in which the eigenvalue of
        the matrix of equation (9) is a hundredth of the largest or less. Nothing else is changed from `paper-weighted`. With
        calibrated wheels the trajectory's error in the corridor is {paper} m with `paper`, {weighted} m with
        `paper-weighted`, and {partial} m with `paper-partial`; track was lost in {lost} runs. In the hall it is, in this
        order, {hall} m. That is one step from the paper towards the default, which has {} m in the corridor and {} m in
        the hall: its prior leaves the way along a corridor to the wheels, too, but weighs them against what is seen instead
        of cutting at a threshold. {worse}It is not the only step: among the office's small things and walking people
        `paper-partial` lost track in {office} runs. The same corridor,
        the same scans:",
        default[0], default[1]
    )
}

fn merge(results: &Results) -> String {
    let error = |world, configuration| metres(calibrated(results, world, configuration).trajectory_m());
    let (paper, weighted) = (Configuration::Paper, Configuration::PaperWeighted);
    format!(
        "The paper's Fig. 6 lays a plain line through the two ends of the map's segment and the two of the one just seen. A wall
        seen in a hundred scans is moved by the next one as if it had been seen once, and the map keeps the noise of the last
        few looks. With end points that weigh as many points as they stand for, as they do in equation (3), the trajectory's
        error is {} m instead of {} m in the hall and {} m instead of {} m in the corridor, with calibrated wheels.",
        error("hall", weighted),
        error("hall", paper),
        error("corridor", weighted),
        error("corridor", paper),
    )
}

fn luck(results: &Results) -> String {
    let rows = ["hall", "corridor"].map(|world| calibrated(results, world, Configuration::Paper));
    let [hall, corridor] = rows.map(|row| {
        let factors = row.ransac_factors();
        let shown = |value: fn(&Spread) -> f64| factors.as_ref().map_or(f64::NAN, value);
        (shown(|s| s.median), shown(|s| s.worst))
    });
    format!(
        "On one and the same drive the RANSAC seed alone moves the trajectory error of `paper`: between the best and the worst of
        {} seeds lies a factor of {:.1} in the hall and {:.1} in the corridor, as the median of the drives, and of {:.1} and
        {:.1} at worst. A single run of it says little; that is why the tables have means over several.",
        results.ransac_seeds, hall.0, corridor.0, hall.1, corridor.1
    )
}
