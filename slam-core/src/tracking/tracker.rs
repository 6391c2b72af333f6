//! From the prior to the hypothesis that explains the scan best.

use heapless::Vec;
use nalgebra::{Isometry2, Matrix3};

use super::heading_search::{self, MAX_PEAKS};
use super::hypothesis::{Hypothesis, tight_score};
use super::search::SearchConfig;
use crate::config::SlamConfig;
use crate::frontend::extraction::MAX_SEGMENTS;
use crate::geometry::math::min;
use crate::geometry::pose::{components, diagonal, difference, pose};
use crate::geometry::segment::Segment;
use crate::map::MapSegment;
use crate::map::nearby::Nearby;
use crate::paper::least_squares::least_squares;
use crate::slam::Stage;
use crate::tracking::association::{AssociationConfig, Pair, Shortlist, View, associate};
use crate::tracking::correction::{
    Correction, CorrectionConfig, GaussNewtonConfig, Prior, Standpoint, Verdict, maximum_a_posteriori,
};

/// Larger Mahalanobis distances from the prediction take no more off a hypothesis.
const MOST_CHI2: f32 = 100.0;
/// Where the scan overrules the prior, the estimate's covariance before it is made to explain the difference d, as adaptive
/// filters do (Mehra, "Approaches to adaptive filtering", IEEE TAC 1972): by so many times d·dᵀ, and at least by these standard
/// deviations, metres and radians.
const LEFT_OUT_FACTOR: f32 = 2.0;
const LEFT_OUT_FLOOR: [f32; 3] = [0.02, 0.02, 0.02];

/// What is matched: a scan's segments in `base`, the map, and how.
#[derive(Clone, Copy, Debug)]
pub struct Scene<'a> {
    /// Observed segments.
    pub observed: &'a [Segment],
    /// Map segments.
    pub map: &'a [MapSegment],
    /// The settings of all stages.
    pub config: &'a SlamConfig,
}

/// The outcome of a scan.
#[derive(Clone, Debug)]
pub struct Tracked {
    /// The winner.
    pub hypothesis: Hypothesis,
    /// Rounds of association and correction of all hypotheses.
    pub iterations: u8,
    /// Set where the prior was left out, as the scan says otherwise: by how much less sure the pose is to be taken before it,
    /// covariance of (x, y, θ).
    pub left_out: Option<Matrix3<f32>>,
    /// Squared Mahalanobis distance of the prediction from what the scan says, three degrees of freedom.
    pub innovation_chi2: f32,
    /// Whether poses were searched for.
    pub searched: bool,
}

/// The candidates among the map's lines, and the rounds through which hypotheses are made.
///
/// RAM: 2·`N` bytes and 1 KiB.
#[derive(Clone, Debug, Default)]
pub struct Tracker<const N: usize> {
    /// Map segments that the scan can touch.
    pub nearby: Nearby<N>,
    /// Which observed segment is which map segment, as seen from the hypothesis looked at last.
    pub pairs: Vec<Pair, MAX_SEGMENTS>,
    shortlist: Shortlist,
    iterations: u8,
    /// Predictions that were suspiciously far off, less those that were not.
    suspicious: u8,
}

impl<const N: usize> Tracker<N> {
    /// No candidates.
    pub const fn new() -> Self {
        Self {
            nearby: Nearby::new(),
            pairs: Vec::new(),
            shortlist: Shortlist::new(),
            iterations: 0,
            suspicious: 0,
        }
    }

    /// Finds the candidates: the map segments that a scan from this pose can touch. The paper looks at all of them.
    #[inline(never)]
    pub fn gather(&mut self, map: &[MapSegment], pose: &Isometry2<f32>, config: &SlamConfig) {
        let reach_m = match config.association {
            AssociationConfig::Bisector(_) => f32::INFINITY,
            AssociationConfig::Gated(_) => config.sensor.reach_m(),
        };
        self.nearby.gather(map, pose, reach_m, |_| true);
        self.shortlist.clear();
    }

    /// Share of those of the observed segments that count, by their index, which the map explains from a pose that was just [corrected](Self::corrected_at).
    pub fn score_of(&self, scene: &Scene<'_>, pose: &Isometry2<f32>, counts: impl Fn(usize) -> bool) -> f32 {
        tight_score(scene.observed, &self.pairs, scene.map, pose, &scene.config.line_noise, counts).0
    }

    /// Nothing was matched.
    pub fn forget_pairs(&mut self) {
        self.pairs.clear();
    }

    /// The map's segments have new indices.
    pub fn forget_shortlist(&mut self) {
        self.shortlist.clear();
    }

    /// From the prior to the hypothesis that explains the scan best.
    ///
    /// Work: `max_iterations` rounds of association and correction for the prediction; where that explains too little, a
    /// histogram, and for up to [`MAX_PEAKS`] peaks of it one vote and as many rounds.
    pub fn track(
        &mut self,
        scene: &Scene<'_>,
        previous: &Isometry2<f32>,
        prior: &Prior,
        watch: &mut impl FnMut(Stage),
    ) -> Tracked {
        watch(Stage::Association);
        self.iterations = 0;
        self.gather(scene.map, &prior.pose, scene.config);
        let mut tracked = Tracked {
            hypothesis: Hypothesis::of_prior(prior),
            iterations: 0,
            left_out: None,
            innovation_chi2: 0.0,
            searched: false,
        };
        match &scene.config.correction {
            CorrectionConfig::MaximumAPosteriori(config) => {
                self.track_by_hypotheses(scene, previous, prior, config, &mut tracked, watch);
            }
            CorrectionConfig::LeastSquares(_) => {
                let start = Hypothesis::of_prior(prior);
                tracked.hypothesis = self.refined(scene, prior, start, Kernel::Strict, watch);
            }
        }
        tracked.iterations = self.iterations;
        tracked
    }

    fn track_by_hypotheses(
        &mut self,
        scene: &Scene<'_>,
        previous: &Isometry2<f32>,
        prior: &Prior,
        config: &GaussNewtonConfig,
        tracked: &mut Tracked,
        watch: &mut impl FnMut(Stage),
    ) {
        let first = Kernel::first(prior, config);
        let best = &mut tracked.hypothesis;
        *best = self.refined(scene, prior, Hypothesis::of_prior(prior), first, watch);
        tracked.innovation_chi2 = innovation_chi2(prior, best);
        if self.nearby.all().is_empty() || scene.observed.is_empty() {
            return;
        }
        let search = &config.search;
        let moved = prior.pose.translation.vector - previous.translation.vector;
        let broad = Prior { covariance: prior.covariance + search.widening(&moved), ..*prior };
        let mut by_scan = false;
        let suspicious = tracked.innovation_chi2 > search.suspicious_chi2;
        self.suspicious = if suspicious {
            self.suspicious.saturating_add(1).min(search.suspicious_scans)
        } else {
            self.suspicious.saturating_sub(1)
        };
        let wild = tracked.innovation_chi2 > search.wild_chi2 || self.suspicious >= search.suspicious_scans;
        if wild && best.observability.verdict == Verdict::Full {
            let start = Hypothesis::at(best.pose, best.covariance);
            let free = self.refined(scene, &broad, start, Kernel::Strict, watch);
            if free.score >= best.score {
                (*best, by_scan) = (free, true);
            } else {
                self.associate(scene, best);
            }
        }
        tracked.searched = best.score < search.below_score;
        if tracked.searched {
            let other = self.refined(scene, prior, Hypothesis::of_prior(prior), first.other(), watch);
            if other.score > best.score + search.gain {
                (*best, by_scan) = (other, false);
            }
            if let Some(winner) = self.search(scene, &broad, best, search, watch) {
                (*best, by_scan) = (winner, true);
                self.gather(scene.map, &best.pose, scene.config);
            }
            watch(Stage::Association);
            self.associate(scene, best);
        }
        tracked.left_out = by_scan.then(|| left_out(&best.pose, &prior.pose));
    }

    /// Rounds of association and correction from a start, and the score of what they end with.
    pub fn refined(
        &mut self,
        scene: &Scene<'_>,
        prior: &Prior,
        start: Hypothesis,
        kernel: Kernel,
        watch: &mut impl FnMut(Stage),
    ) -> Hypothesis {
        let mut hypothesis = self.converged(scene, prior, start, kernel, watch);
        let line_noise = &scene.config.line_noise;
        (hypothesis.score, hypothesis.explained) =
            tight_score(scene.observed, &self.pairs, scene.map, &hypothesis.pose, line_noise, |_| true);
        hypothesis.paired = self.pairs.len() as u8;
        hypothesis
    }

    /// The same without the score.
    #[inline(never)]
    fn converged(
        &mut self,
        scene: &Scene<'_>,
        prior: &Prior,
        start: Hypothesis,
        kernel: Kernel,
        watch: &mut impl FnMut(Stage),
    ) -> Hypothesis {
        let mut hypothesis = start;
        let (rounds, converged_step) = match &scene.config.correction {
            CorrectionConfig::LeastSquares(_) => (1, f32::INFINITY),
            CorrectionConfig::MaximumAPosteriori(config) => (config.max_iterations, config.converged_step),
        };
        for _ in 0..rounds {
            watch(Stage::Association);
            self.associate(scene, &hypothesis);
            watch(Stage::Correction);
            self.iterations = self.iterations.saturating_add(1);
            let Some(correction) = step(scene, prior, &hypothesis, &self.pairs, kernel) else { break };
            hypothesis.corrected |= !self.pairs.is_empty();
            hypothesis.pose = correction.pose;
            hypothesis.covariance = correction.covariance;
            hypothesis.observability = correction.observability;
            if correction.step <= converged_step {
                break;
            }
        }
        hypothesis
    }

    /// Finds the pairs as seen from a hypothesis.
    #[inline(never)]
    pub fn associate(&mut self, scene: &Scene<'_>, hypothesis: &Hypothesis) {
        let config = scene.config;
        let view = View {
            pose: &hypothesis.pose,
            covariance: &hypothesis.covariance,
            line_noise: &config.line_noise,
        };
        let (nearby, shortlist) = (&self.nearby, &mut self.shortlist);
        associate(scene.observed, &view, scene.map, nearby, &config.association, shortlist, &mut self.pairs);
    }

    /// The best pose that the scan itself proposes, if it is so much better than the best known.
    fn search(
        &mut self,
        scene: &Scene<'_>,
        broad: &Prior,
        best: &Hypothesis,
        config: &SearchConfig,
        watch: &mut impl FnMut(Stage),
    ) -> Option<Hypothesis> {
        let weight = broad.covariance.try_inverse()?;
        let mut least = best.score + config.gain;
        let mut winner = None;
        self.propose(scene, broad, config, watch, &mut |hypothesis| {
            let off = difference(&hypothesis.pose, &broad.pose);
            let score = hypothesis.score - config.loss_per_chi2 * min(off.dot(&(weight * off)), MOST_CHI2);
            if score > least && config.is_convincing(&hypothesis, best, off.z) {
                (least, winner) = (score, Some(hypothesis));
            }
        });
        winner
    }

    /// A pose that somebody proposes, corrected in the map around it; [`score_of`](Self::score_of) tells its score.
    pub fn corrected_at(
        &mut self,
        scene: &Scene<'_>,
        prior: &Prior,
        watch: &mut impl FnMut(Stage),
    ) -> Hypothesis {
        self.gather(scene.map, &prior.pose, scene.config);
        self.converged(scene, prior, Hypothesis::of_prior(prior), Kernel::Strict, watch)
    }

    /// The same with its score.
    pub fn refined_at(
        &mut self,
        scene: &Scene<'_>,
        prior: &Prior,
        watch: &mut impl FnMut(Stage),
    ) -> Hypothesis {
        self.gather(scene.map, &prior.pose, scene.config);
        self.refined(scene, prior, Hypothesis::of_prior(prior), Kernel::Strict, watch)
    }

    /// Makes a hypothesis of each pose that the scan itself proposes around a prior.
    fn propose(
        &mut self,
        scene: &Scene<'_>,
        broad: &Prior,
        config: &SearchConfig,
        watch: &mut impl FnMut(Stage),
        take: &mut dyn FnMut(Hypothesis),
    ) {
        let (centre, [position, heading]) = (components(&broad.pose), config.proposed);
        let (observed, map) = (scene.observed, scene.map);
        let turns: Vec<f32, MAX_PEAKS> =
            heading_search::turns(observed, &broad.pose, map, &self.nearby, config.reach_rad);
        for turn in turns {
            let turned = pose(centre.x, centre.y, centre.z + turn);
            let shift = heading_search::shift(observed, &turned, map, &self.nearby);
            let proposed = pose(centre.x + shift.x, centre.y + shift.y, centre.z + turn);
            let start = Hypothesis::at(proposed, diagonal([position, position, heading]));
            take(self.refined(scene, broad, start, Kernel::Strict, watch));
        }
    }
}

fn step(
    scene: &Scene<'_>,
    prior: &Prior,
    at: &Hypothesis,
    pairs: &[Pair],
    kernel: Kernel,
) -> Option<Correction> {
    let (observed, map, config) = (scene.observed, scene.map, scene.config);
    match &config.correction {
        CorrectionConfig::LeastSquares(least) => {
            least_squares(observed, pairs, map, prior, config.sensor.noise.variance(0.0), least)
        }
        CorrectionConfig::MaximumAPosteriori(map_config) => {
            let forgiven = (kernel == Kernel::Forgiving).then_some(&at.covariance);
            let from = Standpoint { pose: &at.pose, forgiven };
            maximum_a_posteriori(observed, pairs, map, prior, &from, &config.line_noise, map_config)
        }
    }
}

/// By how much less sure a prior is to be taken that a scan overrules: covariance of (x, y, θ).
fn left_out(by_scan: &Isometry2<f32>, prior: &Isometry2<f32>) -> Matrix3<f32> {
    let off = difference(by_scan, prior);
    off * off.transpose() * LEFT_OUT_FACTOR + diagonal(LEFT_OUT_FLOOR)
}

/// Squared Mahalanobis distance of the prediction from what the scan says. The correction that a Kalman update makes has the
/// covariance P⁻ − P⁺.
fn innovation_chi2(prior: &Prior, posterior: &Hypothesis) -> f32 {
    let step = difference(&posterior.pose, &prior.pose);
    // Directions in which the scan says nothing have none of it.
    let floor = Matrix3::from_diagonal(&(0.01 * prior.covariance.diagonal()));
    let gained = prior.covariance - posterior.covariance + floor;
    gained.cholesky().map_or(0.0, |c| step.dot(&c.solve(&step)))
}

/// What the robust kernel holds against a pair.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kernel {
    /// Its misfit: pairs that agree with the pose as it stands lead.
    Strict,
    /// What of its misfit the pose's own uncertainty does not explain: what most pairs agree on leads.
    Forgiving,
}

impl Kernel {
    /// The one to begin with.
    fn first(prior: &Prior, config: &GaussNewtonConfig) -> Self {
        let is_close = prior.covariance.m33 < config.close_heading_rad * config.close_heading_rad;
        if is_close { Self::Forgiving } else { Self::Strict }
    }

    fn other(self) -> Self {
        match self {
            Self::Strict => Self::Forgiving,
            Self::Forgiving => Self::Strict,
        }
    }
}
