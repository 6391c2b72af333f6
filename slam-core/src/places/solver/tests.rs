//! Against dense Gauss-Newton in `f64` over all poses, with Jacobians by differences.

use super::*;
use crate::geometry::pose::{components, pose};
use nalgebra::{DMatrix, DVector, Matrix3, Vector3};
use proptest::prelude::*;

type Pose = Vector3<f64>;

fn compose(a: &Pose, b: &Pose) -> Pose {
    let (s, c) = a.z.sin_cos();
    Pose::new(a.x + c * b.x - s * b.y, a.y + s * b.x + c * b.y, wrap(a.z + b.z))
}

fn between(a: &Pose, b: &Pose) -> Pose {
    let (s, c) = a.z.sin_cos();
    let (x, y) = (b.x - a.x, b.y - a.y);
    Pose::new(c * x + s * y, c * y - s * x, wrap(b.z - a.z))
}

fn wrap(a: f64) -> f64 {
    a.sin().atan2(a.cos())
}

fn log64(x: &Pose) -> Pose {
    let half = 0.5 * x.z;
    let cot = if half.abs() < 1e-6 { 1.0 - half * half / 3.0 } else { half / half.tan() };
    Pose::new(cot * x.x + half * x.y, cot * x.y - half * x.x, x.z)
}

/// Residual of an edge in the frame of its end.
fn residual(from: &Pose, to: &Pose, measured: &Pose) -> Pose {
    log64(&between(&compose(from, measured), to))
}

fn to64(p: &Isometry2<f32>) -> Pose {
    components(p).map(f64::from)
}

/// Every edge: both ends, what was measured, information in the frame of the end.
fn edges<const P: usize>(chain: &Chain<P>, loops: &[Loop]) -> Vec<(usize, usize, Pose, Matrix3<f64>), 400> {
    let mut edges = Vec::new();
    for (k, anchor) in chain.anchors().iter().enumerate().skip(1) {
        let information =
            Matrix3::from_diagonal(&Vector3::from(anchor.variances.map(|v| 1.0 / f64::from(v))));
        edges.push((k - 1, k, to64(&anchor.from_previous), information)).unwrap();
    }
    for l in loops {
        let information = l.covariance.map(f64::from).try_inverse().unwrap();
        edges.push((l.from.into(), l.to.into(), to64(&l.measured), information)).unwrap();
    }
    edges
}

/// Gauss-Newton over all poses but the first.
fn gauss_newton<const P: usize>(chain: &Chain<P>, loops: &[Loop]) -> std::vec::Vec<Pose> {
    let mut poses: std::vec::Vec<Pose> = chain.anchors().iter().map(|a| to64(&a.pose)).collect();
    let edges = edges(chain, loops);
    let n = 3 * poses.len();
    for _ in 0..30 {
        let (mut h, mut g) = (DMatrix::<f64>::zeros(n, n), DVector::<f64>::zeros(n));
        for (from, to, measured, information) in &edges {
            let at = |d: [f64; 6]| {
                let a = poses[*from] + Pose::new(d[0], d[1], d[2]);
                let b = poses[*to] + Pose::new(d[3], d[4], d[5]);
                residual(&a, &b, measured)
            };
            let mut jacobian = nalgebra::SMatrix::<f64, 3, 6>::zeros();
            for k in 0..6 {
                let step = |by: f64| at(core::array::from_fn(|i| if i == k { by } else { 0.0 }));
                jacobian.set_column(k, &((step(1e-6) - step(-1e-6)) / 2e-6));
            }
            let (jtw, r) = (jacobian.transpose() * information, at([0.0; 6]));
            let (hh, gg) = (jtw * jacobian, jtw * r);
            let place = |k: usize| if k < 3 { 3 * from + k } else { 3 * to + k - 3 };
            for i in 0..6 {
                g[place(i)] += gg[i];
                (0..6).for_each(|j| h[(place(i), place(j))] += hh[(i, j)]);
            }
        }
        let (h, g) = (h.view((3, 3), (n - 3, n - 3)).into_owned(), g.rows(3, n - 3).into_owned());
        let step = -h.cholesky().unwrap().solve(&g);
        for (k, pose) in poses.iter_mut().enumerate().skip(1) {
            *pose += step.fixed_rows::<3>(3 * (k - 1));
            pose.z = wrap(pose.z);
        }
        if step.amax() < 1e-10 {
            break;
        }
    }
    poses
}

fn solved<const P: usize>(chain: &mut Chain<P>, loops: &[Loop]) -> bool {
    let mut solver = std::boxed::Box::new(Solver::<P>::new());
    solver.begin(chain);
    for _ in 0..200 {
        match solver.step(chain, loops) {
            Progress::Going => {}
            Progress::Done => {
                solver.swap_in(chain);
                return true;
            }
            Progress::Failed => return false,
        }
    }
    panic!("it takes too long");
}

/// Largest distance of two sets of poses, metres and radians.
fn apart<const P: usize>(chain: &Chain<P>, poses: &[Pose]) -> (f64, f64) {
    let off = chain.anchors().iter().zip(poses).map(|(a, b)| to64(&a.pose) - b);
    off.fold((0.0, 0.0), |(m, r), d| (d.xy().norm().max(m), wrap(d.z).abs().max(r)))
}

/// A number in [-1, 1] by its seed.
fn noise(seed: &mut u64) -> f32 {
    *seed = seed.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
    ((*seed >> 40) as f32 / (1u64 << 23) as f32) - 1.0
}

const VARIANCES: [f32; 3] = [4e-4, 4e-4, 1e-4];

/// A chain that drifts from a true one; the true poses.
fn drifting<const P: usize>(
    truth: &[Isometry2<f32>],
    mut drift: impl FnMut(usize) -> Vector3<f32>,
) -> Chain<P> {
    let mut chain = Chain::new();
    let mut at = truth[0];
    assert!(chain.push(at, 0.0, VARIANCES));
    for (k, two) in truth.windows(2).enumerate() {
        at = normalized(&(at * two[0].inv_mul(&two[1]) * exp(&drift(k))));
        assert!(chain.push(at, 4.0 * (k + 1) as f32, VARIANCES));
    }
    chain
}

fn edge(truth: &[Isometry2<f32>], from: usize, to: usize) -> Loop {
    let covariance = Matrix3::from_diagonal(&Vector3::new(1e-4, 1e-4, 1e-5));
    Loop { from: from as u16, to: to as u16, measured: truth[from].inv_mul(&truth[to]), covariance }
}

/// Round a block of 150 m, two places past where it began.
fn block(from_m: f32) -> std::vec::Vec<Isometry2<f32>> {
    (0..40)
        .map(|k| {
            let along = 4.0 * k as f32 % 150.0;
            let (x, y, heading) = match along {
                a if a < 45.0 => (a, 0.0, 0.0),
                a if a < 75.0 => (45.0, a - 45.0, 0.25),
                a if a < 120.0 => (120.0 - a, 30.0, 0.5),
                a => (0.0, 150.0 - a, 0.75),
            };
            pose(from_m + x, y, heading * core::f32::consts::TAU)
        })
        .collect()
}

#[test]
fn a_loop_of_150_m_closes() {
    let truth = block(0.0);
    // A degree in 25 m, and two per cent of the way.
    let mut chain = drifting::<64>(&truth, |_| Vector3::new(0.08, 0.01, 0.003));
    let loops = [edge(&truth, 0, 38), edge(&truth, 1, 39)];
    let gap = |chain: &Chain<64>| {
        let at = |k: usize| chain.anchors()[k].pose;
        (at(0).inv_mul(&at(38)).translation.vector - loops[0].measured.translation.vector).norm()
    };
    assert!(gap(&chain) > 1.0, "{}", gap(&chain));
    assert!(solved(&mut chain, &loops));
    assert!(gap(&chain) < 0.02, "{}", gap(&chain));
}

#[test]
fn loops_that_share_nothing_do_not_disturb_each_other() {
    let truth: std::vec::Vec<_> = (0..30).map(|k| pose(3.0 * k as f32, 0.0, 0.0)).collect();
    let mut seed = 5;
    let mut drift = |_| Vector3::new(noise(&mut seed), noise(&mut seed), noise(&mut seed)) * 0.02;
    let chain = drifting::<32>(&truth, &mut drift);
    let (early, late) = (edge(&truth, 2, 9), edge(&truth, 15, 25));
    let (mut one, mut both) = (chain.clone(), chain.clone());
    assert!(solved(&mut one, &[early]) && solved(&mut both, &[early, late]));
    for k in 0..=15 {
        let off = components(&one.anchors[k].pose) - components(&both.anchors[k].pose);
        assert!(off.norm() < 1e-5, "{k}: {off}");
    }
    let before = components(&chain.anchors[2].pose) - components(&one.anchors[2].pose);
    assert!(before.norm() < 1e-6, "what lies before all loops stays");
}

#[test]
fn without_a_loop_nothing_moves() {
    let mut chain = drifting::<64>(&block(0.0), |_| Vector3::new(0.01, 0.0, 0.002));
    let before = chain.clone();
    assert!(solved(&mut chain, &[]));
    for (a, b) in chain.anchors.iter().zip(&before.anchors) {
        assert!((components(&a.pose) - components(&b.pose)).xy().norm() < 1e-4);
    }
}

#[test]
fn a_kilometre_from_the_origin_it_is_as_good() {
    let (near, far) = (block(0.0), block(1000.0));
    let drift = |_| Vector3::new(0.02, 0.01, 0.003);
    let (mut here, mut there) = (drifting::<64>(&near, drift), drifting::<64>(&far, drift));
    let edges: [(usize, usize); 4] = [(0, 38), (1, 39), (2, 36), (12, 30)];
    assert!(solved(&mut here, &edges.map(|(a, b)| edge(&near, a, b))));
    assert!(solved(&mut there, &edges.map(|(a, b)| edge(&far, a, b))));
    for (a, b) in here.anchors.iter().zip(&there.anchors) {
        let off = a.pose.translation.vector + nalgebra::Vector2::new(1000.0, 0.0) - b.pose.translation.vector;
        assert!(off.norm() < 0.01, "{off}");
    }
}

#[test]
fn full_to_the_brim_it_does_not_panic() {
    let truth: std::vec::Vec<_> =
        (0..96).map(|k| pose(3.0 * (k % 24) as f32, 0.02 * k as f32, 0.0)).collect();
    let mut seed = 1;
    let mut chain = drifting::<96>(&truth, |_| Vector3::new(noise(&mut seed), noise(&mut seed), 0.0) * 0.02);
    assert!(!chain.push(pose(0.0, 0.0, 0.0), 400.0, VARIANCES));
    let loops: std::vec::Vec<_> = (0..LOOPS).map(|k| edge(&truth, k, 95 - 2 * k)).collect();
    assert!(solved(&mut chain, &loops));
    let bad = Loop { covariance: Matrix3::identity() * f32::NAN, ..loops[0] };
    assert!(!solved(&mut chain, &[bad]));
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]
    #[test]
    fn it_finds_what_dense_gauss_newton_finds(seed in any::<u64>(), turn in -0.4f32..0.4, edges in 1usize..8) {
        let mut seed = seed;
        let mut at = pose(20.0, -10.0, 1.0);
        let truth: std::vec::Vec<_> = (0..36)
            .map(|_| {
                at = normalized(&(at * exp(&Vector3::new(4.0, 0.0, turn + 0.3 * noise(&mut seed)))));
                at
            })
            .collect();
        let drift = |_| Vector3::new(0.03 * noise(&mut seed), 0.03 * noise(&mut seed), 0.015 * noise(&mut seed));
        let mut chain = drifting::<40>(&truth, drift);
        let mut loops = std::vec::Vec::new();
        for k in 0..edges {
            let from = (k * 5) % 20;
            loops.push(edge(&truth, from, from + 6 + (k * 7) % 10));
        }
        let exact = gauss_newton(&chain, &loops);
        prop_assert!(solved(&mut chain, &loops));
        let (m, rad) = apart(&chain, &exact);
        prop_assert!(m < 0.01 && rad < 1e-3, "{m} m, {rad} rad");
    }
}
