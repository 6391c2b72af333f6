//! Relative errors: how far the motion between two poses is from the reference's, whatever the way to them.

use nalgebra::Isometry2;
use serde::Serialize;

use super::Spread;

/// Ways between the poses of a pair, metres.
const WAYS_M: [f64; 5] = [1.0, 5.0, 10.0, 25.0, 50.0];
/// Pairs of a kind are reported where there are more than this.
const LEAST_PAIRS: usize = 20;
/// Back at a place: closer than this, metres …
const REVISIT_M: f64 = 1.0;
/// … after more than this way, metres …
const REVISIT_WAY_M: f64 = 20.0;
/// … of poses that are this way apart, metres …
const REVISIT_STEP_M: f64 = 0.25;
/// … where there are more pairs than this.
const LEAST_REVISITS: usize = 10;

/// Errors of pairs of poses.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct PairErrors {
    /// Pairs.
    pub n: usize,
    /// Mean error of the translation, metres.
    pub trans_m: f64,
    /// Its standard deviation, metres.
    pub trans_std: f64,
    /// Its median, metres.
    pub trans_med: f64,
    /// Mean error of the rotation, without sign, degrees.
    pub rot_deg: f64,
    /// Its standard deviation, degrees.
    pub rot_std: f64,
}

impl PairErrors {
    /// Of translational errors in metres and rotational errors in degrees. `None` of none.
    pub(super) fn of(errors: &[(f64, f64)]) -> Option<Self> {
        let translation = Spread::of(errors.iter().map(|e| e.0))?;
        let rotation = Spread::of(errors.iter().map(|e| e.1))?;
        Some(Self {
            n: errors.len(),
            trans_m: translation.mean,
            trans_std: translation.deviation,
            trans_med: translation.median,
            rot_deg: rotation.mean,
            rot_std: rotation.deviation,
        })
    }
}

/// Way driven up to each pose, metres.
pub(super) fn ways_m(poses: &[Isometry2<f64>]) -> Vec<f64> {
    let mut way_m = 0.0;
    let steps = poses.windows(2).map(|w| (w[1].translation.vector - w[0].translation.vector).norm());
    let driven = steps.map(|step| {
        way_m += step;
        way_m
    });
    std::iter::once(0.0).chain(driven).take(poses.len()).collect()
}

/// Errors between poses one step apart, some way apart, and back at a place, as far as there are enough of them.
///
/// Work: for the revisits the square of the way in quarter metres.
pub(super) fn pair_errors(
    estimate: &[Isometry2<f64>],
    reference: &[Isometry2<f64>],
) -> Vec<(String, PairErrors)> {
    let error = |&(i, j): &(usize, usize)| {
        let truth = reference[i].inv_mul(&reference[j]);
        let off = truth.inv_mul(&estimate[i].inv_mul(&estimate[j]));
        (off.translation.vector.norm(), off.rotation.angle().abs().to_degrees())
    };
    let all = |pairs: &[(usize, usize)]| PairErrors::of(&pairs.iter().map(error).collect::<Vec<_>>());
    pairs(reference).into_iter().filter_map(|(name, pairs)| Some((name, all(&pairs)?))).collect()
}

/// The pairs of each kind, by the reference.
fn pairs(reference: &[Isometry2<f64>]) -> Vec<(String, Vec<(usize, usize)>)> {
    let n = reference.len();
    let ways_m = ways_m(reference);
    let whole_m = ways_m.last().copied().unwrap_or(0.0);
    let at_way = |way_m: f64| ways_m.partition_point(|w| *w < way_m);
    let mut kinds = vec![("step".to_owned(), (1..n).map(|j| (j - 1, j)).collect())];
    for apart_m in WAYS_M.into_iter().filter(|m| whole_m >= 2.0 * m) {
        // Where a step is long the pose found may lie much farther on.
        let most_beyond_m = f64::max(1.0, 0.2 * apart_m);
        let pairs: Vec<(usize, usize)> = (0..n)
            .map(|i| (i, at_way(ways_m[i] + apart_m)))
            .filter(|&(i, j)| j < n && (ways_m[j] - ways_m[i] - apart_m).abs() < most_beyond_m)
            .collect();
        if pairs.len() > LEAST_PAIRS {
            kinds.push((format!("{apart_m}m"), pairs));
        }
    }
    let mut thinned: Vec<usize> =
        (0..(whole_m / REVISIT_STEP_M).ceil() as usize).map(|k| at_way(k as f64 * REVISIT_STEP_M)).collect();
    thinned.dedup();
    let back = |&(i, j): &(usize, usize)| {
        ways_m[j] - ways_m[i] > REVISIT_WAY_M
            && (reference[i].translation.vector - reference[j].translation.vector).norm() < REVISIT_M
    };
    let both = thinned.iter().flat_map(|i| thinned.iter().map(move |j| (*i, *j)));
    let revisits: Vec<(usize, usize)> = both.filter(|&(i, j)| i < j && j < n).filter(back).collect();
    if revisits.len() > LEAST_REVISITS {
        kinds.push(("revisit".to_owned(), revisits));
    }
    kinds
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Along x and back again: 30 m each way, in steps of 0.5 m.
    fn there_and_back() -> Vec<Isometry2<f64>> {
        let x = |k: i32| 0.5 * f64::from(if k <= 60 { k } else { 120 - k });
        (0..=120).map(|k| Isometry2::translation(x(k), 0.0)).collect()
    }

    #[test]
    fn the_error_of_a_pair_grows_with_the_way_between() {
        let truth = there_and_back();
        // Every metre along x comes out 1 % too long.
        let stretched: Vec<_> =
            truth.iter().map(|p| Isometry2::new(p.translation.vector * 1.01, p.rotation.angle())).collect();
        let errors = pair_errors(&stretched, &truth);
        let names: Vec<&str> = errors.iter().map(|(name, _)| name.as_str()).collect();
        assert_eq!(
            names,
            ["step", "1m", "5m", "10m", "25m", "revisit"],
            "60 m are too few for pairs of 50 m"
        );
        let of = |name: &str| errors.iter().find(|(n, _)| n == name).unwrap().1;
        assert!((of("step").trans_m - 0.005).abs() < 1e-12);
        assert!((of("5m").trans_med - 0.05).abs() < 1e-9);
        assert!(of("revisit").trans_m < 0.01, "coming back hides a wrong scale");
        assert_eq!(of("step").n, 120);
        assert!(errors.iter().all(|(_, e)| e.rot_deg == 0.0));
    }

    #[test]
    fn a_turn_too_many_is_seen_in_rotation_alone_at_the_step() {
        let truth = there_and_back();
        let turned: Vec<_> = truth
            .iter()
            .enumerate()
            .map(|(k, p)| Isometry2::new(p.translation.vector, if k % 2 == 0 { 0.0 } else { 0.02 }))
            .collect();
        let (_, step) = &pair_errors(&turned, &truth)[0];
        assert!((step.rot_deg - 0.02_f64.to_degrees()).abs() < 1e-9 && step.rot_std < 1e-9, "{step:?}");
        // Every other step begins turned by 0.02: its end seems that much to the side.
        assert!(step.trans_m > 0.0 && step.trans_m < 0.5 * 0.02);
    }

    #[test]
    fn nothing_has_no_pairs() {
        assert!(pair_errors(&[], &[]).is_empty());
        let one = [Isometry2::translation(1.0, 2.0)];
        assert!(pair_errors(&one, &one).is_empty());
    }
}
