//! What the experiments' page makes of drives: limits, drives that lost track, the band of the NEES, robots that were lifted.

use std::path::Path;
use std::sync::OnceLock;

use lineslam::experiments::document::{honesty, nees_band};
use lineslam::experiments::kidnapped::{Kidnapped, Moment, summed_up};
use lineslam::experiments::limits::{self, Quantity};
use lineslam::experiments::{Case, Results, Run, kinds_page, simulated};
use lineslam::sim::SimKind;
use lineslam::sim::world::World;
use slam_core::tracking::TrackingState;

/// A drive with nothing wrong, as if in another world; each test changes what it is about.
fn run(world: &'static str, kind: SimKind) -> Run {
    static DRIVEN: OnceLock<Run> = OnceLock::new();
    let drive = || {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../worlds/corridor_short.toml");
        simulated(Case::usual("corridor", SimKind::Ideal), &World::load(&path).unwrap(), 7).unwrap()
    };
    let mut run = DRIVEN.get_or_init(drive).clone();
    run.case = Case::usual(world, kind);
    run.default.judgement.corner_error_m = Some(0.0);
    run.default.judgement.laid_with_scale.corner_error_m = Some(0.0);
    run.default.judgement.trajectory.scaled_rmse_m = 0.0;
    run.default.judgement.worst_position_error_m = 0.0;
    run
}

fn results(runs: Vec<Run>) -> Results {
    let (kidnapped, papers, figures) = Default::default();
    Results { seeds: 1..3, runs, kidnapped, papers, ransac_seeds: 1, figures }
}

#[test]
fn a_limit_is_for_the_mean_over_the_drives_of_its_kind() {
    let with = |kind, error_m| {
        let mut run = run("hall", kind);
        run.default.judgement.corner_error_m = Some(error_m);
        run
    };
    let mut runs = vec![with(SimKind::Ideal, 0.010), with(SimKind::Ideal, 0.046), with(SimKind::Real, 9.0)];
    let of = |runs: &[Run]| {
        limits::held(runs, Case::usual("hall", SimKind::Ideal), Quantity::Corners).expect("there is a limit")
    };
    assert!((of(&runs).measured - 0.028).abs() < 1e-12 && of(&runs).holds(), "{:?}", of(&runs));
    assert_eq!(
        kinds_page::missed(&runs),
        "All 5 limits are kept.",
        "two of the ideal kind, three of the real"
    );
    runs.push(with(SimKind::Ideal, 0.043));
    assert!((of(&runs).measured - 0.033).abs() < 1e-12 && !of(&runs).holds(), "{:?}", of(&runs));
    let said = kinds_page::missed(&runs);
    let named = "Of 5 limits 1 is missed:\n\n- hall, ideal kind, corner error as the map lies: 0.033 m, where 0.030 m is the limit";
    assert_eq!(said, named);
    assert!(kinds_page::corners(&results(runs)).to_string().contains("**0.033** > 0.030"));
}

#[test]
fn a_drive_that_lost_track_is_counted_and_one_is_too_many() {
    let mut runs = vec![run("lab", SimKind::Real), run("lab", SimKind::Real), run("twins", SimKind::Real)];
    let case = Case::usual("lab", SimKind::Real);
    assert!(limits::held(&runs, case, Quantity::Lost).is_some_and(|held| held.holds()));
    runs[1].default.judgement.worst_position_error_m = 0.51;
    runs[2].default.judgement.worst_position_error_m = 0.51;
    let held = limits::held(&runs, case, Quantity::Lost).unwrap();
    assert!(held.measured == 1.0 && !held.holds(), "{held:?}");
    assert!(kinds_page::missed(&runs).ends_with("lab, real kind, drives that lost track: 1, and none may"));
    let table = kinds_page::trajectories(&results(runs)).to_string();
    let row =
        |world: &str| table.lines().find(|l| l.contains(world) && l.contains("real")).unwrap().to_owned();
    assert!(row("lab").contains("**1 of 2**") && row("twins").contains(" 1 of 1 "), "{table}");
}

#[test]
fn a_map_without_corners_keeps_no_limit_and_what_was_not_driven_has_none() {
    let mut runs = vec![run("office", SimKind::Real), run("office", SimKind::Real)];
    runs[0].default.judgement.laid_with_scale.corner_error_m = None;
    let case = Case::usual("office", SimKind::Real);
    let held = limits::held(&runs, case, Quantity::ScaledCorners).unwrap();
    assert!(!held.holds(), "{held:?}");
    assert!(kinds_page::missed(&runs).contains("without any corner"));
    assert!(
        limits::held(&runs, case, Quantity::Corners).is_none(),
        "as the map lies the real kind has no limit"
    );
    assert!(limits::held(&runs, Case::usual("flat", SimKind::Real), Quantity::Lost).is_none());
    assert_eq!((limits::all_held(&[]).len(), limits::all().count()), (0, 3 + 2 * 5 + 2 * 5));
}

#[test]
fn the_scale_is_that_of_the_drives_beside_that_of_the_units() {
    let with = |scale, range_scale| {
        let mut run = run("flat", SimKind::Real);
        run.default.judgement.trajectory.scale = scale;
        run.unit.range_scale = range_scale;
        run
    };
    let table = kinds_page::trajectories(&results(vec![with(0.99, 1.0 / 0.992), with(1.012, 1.0 / 1.01)]))
        .to_string();
    assert!(table.contains("1.0010 (0.9900 to 1.0120)"), "{table}");
    assert!(table.contains("1.0010 (0.9920 to 1.0100)"), "{table}");
}

/// χ² of 18 and of 60 degrees of freedom at 2.5 % and 97.5 %, from tables.
#[test]
fn instants_are_within_the_band_of_the_mean_over_as_many_drives() {
    for (n, low, high) in [(6, 8.231, 31.526), (20, 40.482, 83.298)] {
        let band = nees_band(n);
        let n = n as f64;
        assert!((band.0 - low / n).abs() < 0.01 && (band.1 - high / n).abs() < 0.01, "{n}: {band:?}");
    }
    // The mean over two drives at an instant is within 0.62 and 7.22 (χ² of 6: 1.237 and 14.449) at 30 of them.
    let with = |nees: [f64; 2]| {
        let mut run = run("corridor", SimKind::Real);
        let judgement = &mut run.default.judgement;
        for (instant, value) in judgement.nees.iter_mut().enumerate() {
            *value = if instant < 30 { nees[0] } else { nees[1] };
        }
        run
    };
    let table = honesty(&results(vec![with([1.0, 1.0]), with([13.0, 14.0])])).to_string();
    let row = table.lines().find(|l| l.contains("corridor") && l.contains("real")).unwrap();
    assert!(row.contains("30 of 50") && row.contains(" 2 "), "{row}");
}

#[test]
fn a_lifted_robot_is_found_from_when_on_it_is_never_wrong_again() {
    use TrackingState::{Lost, Tracking, Uncertain};
    let sum = |said: &[(bool, TrackingState)]| {
        // One scan a second, two of them in somebody's hands.
        let moment = |(k, (is_wrong, state)): (usize, &(bool, TrackingState))| Moment {
            since_s: k as f64 - 2.0,
            is_wrong: *is_wrong,
            state: *state,
        };
        summed_up("hall", 0, &said.iter().enumerate().map(moment).collect::<Vec<Moment>>(), [9, 1])
    };
    let (right, wrong) = (false, true);
    let in_hands = [(wrong, Tracking), (wrong, Uncertain)];
    let after = |rest: &[(bool, TrackingState)]| sum(&[&in_hands, rest].concat());

    let Kidnapped { said_lost_s, found_s, .. } = after(&[(right, Tracking), (right, Tracking)]);
    assert_eq!((said_lost_s, found_s), (None, Some(0.0)), "put down where it thought it was");
    let luck = [
        (wrong, Tracking),
        (wrong, Uncertain),
        (wrong, Lost),
        (right, Lost),
        (wrong, Lost),
        (right, Tracking),
    ];
    let found = after(&luck);
    assert_eq!((found.said_lost_s, found.found_s), (Some(2.0), Some(5.0)), "right once by luck is not found");
    assert!((found.wrong_and_sure_s - 5.0 / 6.0).abs() < 1e-12 && found.rest_s == 5.0, "{found:?}");
    assert_eq!(after(&[(right, Tracking), (wrong, Tracking)]).found_s, None, "wrong at the end");
    assert_eq!(sum(&[(wrong, Lost), (wrong, Lost), (wrong, Lost)]).said_lost_s, Some(0.0), "said in hands");
}
