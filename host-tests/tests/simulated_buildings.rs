//! What is promised of the default configuration in simulated buildings, on seeds that nothing was tuned on, and what the
//! experiments' page says of the paper's.

use std::path::Path;

use lineslam::configuration::Configuration;
use lineslam::experiments::papers::{self, PaperRun};
use lineslam::experiments::{Case, FEATURELESS, Run, simulated};
use lineslam::sim::SimKind;
use lineslam::sim::world::World;

const SEEDS: std::ops::Range<u64> = 301..309;

fn drives(name: &'static str, condition: usize) -> Vec<Run> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../worlds").join(format!("{name}.toml"));
    let world = World::load(&path).unwrap();
    let case = Case { condition, ..Case::usual(name, SimKind::Ideal) };
    let drive = |seed: u64| simulated(case, &world, seed).unwrap();
    let (even, odd): (Vec<u64>, Vec<u64>) = SEEDS.partition(|seed| seed % 2 == 0);
    std::thread::scope(|scope| {
        let other = scope.spawn(|| even.into_iter().map(drive).collect::<Vec<Run>>());
        let mut runs: Vec<Run> = odd.into_iter().map(drive).collect();
        runs.extend(other.join().unwrap());
        runs
    })
}

/// Corner error of each drive, metres; no more drives than `most_lost` may lose track, no map may be without corners.
fn corner_errors(runs: &[Run], most_lost: usize) -> Vec<f64> {
    let lost: Vec<_> = runs.iter().filter(|run| run.default.lost()).collect();
    for run in &lost {
        println!("lost: {}: {:?}", run.case.world, run.default.judgement);
    }
    assert!(lost.len() <= most_lost, "{} of {} drives are lost", lost.len(), runs.len());
    runs.iter().map(|r| r.default.judgement.corner_error_m.expect("the map has corners")).collect()
}

fn holds(name: &'static str, mean_m: f64, most_lost: usize) {
    let errors = corner_errors(&drives(name, 0), most_lost);
    let mean = errors.iter().sum::<f64>() / errors.len() as f64;
    let worst = errors.iter().copied().fold(0.0, f64::max);
    println!("{name}: corner error {mean:.3} m, worst {worst:.3} m");
    assert!(mean <= mean_m, "{name}: {mean:.3} m");
    assert!(worst <= 3.0 * mean, "{name}: worst {worst:.3} m, mean {mean:.3} m");
}

#[test]
fn the_hall_is_mapped() {
    holds("hall", 0.065, 0);
}

#[test]
fn the_corridor_is_mapped() {
    holds("corridor", 0.20, 1);
}

#[test]
fn the_office_is_mapped_while_people_walk() {
    holds("office", 0.065, 0);
}

#[test]
fn the_hall_is_mapped_when_the_robot_is_worse() {
    for condition in 1..5 {
        let errors = corner_errors(&drives("hall", condition), 0);
        let mean = errors.iter().sum::<f64>() / errors.len() as f64;
        assert!(mean < 0.08, "condition {condition}: {mean:.3} m");
    }
}

/// χ² with three degrees of freedom over eight drives: 95 % of their mean lies within 1.55 and 4.92; the promise is kept a
/// little wider, as the pose's errors of one drive hang together.
#[test]
fn the_covariance_is_honest() {
    for name in ["hall", "office"] {
        let runs = drives(name, 0);
        let nees = runs.iter().map(|r| r.default.judgement.mean_nees).sum::<f64>() / runs.len() as f64;
        println!("{name}: NEES {nees:.2}");
        assert!((1.0..5.5).contains(&nees), "{name}: {nees}");
    }
}

#[test]
fn between_two_parallel_walls_only_the_way_along_them_drifts() {
    let runs = drives(FEATURELESS, 0);
    let mean = |value: fn(&Run) -> f64| runs.iter().map(value).sum::<f64>() / runs.len() as f64;
    let along = mean(|r| r.default.judgement.trajectory.final_along_error_m);
    let wheels = mean(|r| r.dead_reckoning.final_along_error_m);
    assert!(along <= 1.1 * wheels, "along {along}, dead reckoning {wheels}");
    for run in &runs {
        let judgement = &run.default.judgement;
        assert!(judgement.worst_across_error_m < 0.05, "{judgement:?}");
        assert!(judgement.worst_heading_error_deg < 1.0, "{judgement:?}");
    }
}

/// What loses the corridor is that a singular scan corrects nothing. Measured on these seeds: 0.84 m, 0.43 m and 0.037 m; 8, 8
/// and 1 of 8 lost; 64 % of the scans singular.
#[test]
fn correcting_what_is_observed_keeps_the_corridor_and_the_paper_loses_it() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../worlds/corridor.toml");
    let world = World::load(&path).unwrap();
    let runs: Vec<PaperRun> =
        SEEDS.flat_map(|seed| papers::drive("corridor", &world, 0, seed, 0..1).unwrap()).collect();
    let [paper, weighted, partial] = Configuration::PAPERS.map(|configuration| {
        let own: Vec<&PaperRun> = runs.iter().filter(|r| r.configuration == configuration).collect();
        let errors = own.iter().map(|r| r.measured.judgement.trajectory.ate_rmse_m);
        let mean_m = errors.sum::<f64>() / own.len() as f64;
        let lost = own.iter().filter(|r| r.measured.lost()).count();
        let singular = own.iter().map(|r| r.measured.singular).sum::<f64>() / own.len() as f64;
        println!("corridor, {}: {mean_m:.3} m, {lost} lost, {singular:.2} singular", configuration.name());
        (mean_m, lost, singular)
    });
    assert!(paper.0 > 1.3 * weighted.0 && weighted.0 > 3.0 * partial.0, "{paper:?} {weighted:?} {partial:?}");
    assert!(partial.0 < 0.06 && partial.1 <= 2, "{partial:?}");
    assert!(paper.1 >= 6 && weighted.1 >= 6, "{paper:?} {weighted:?}");
    assert!((0.55..0.75).contains(&paper.2) && (0.55..0.75).contains(&weighted.2), "{paper:?} {weighted:?}");
}
