//! When a pose is searched for, how far from the prediction, and what it must explain to be taken.

use nalgebra::{Matrix3, Vector2, Vector3};

use super::Hypothesis;
use crate::config::{Checked, not_negative};
use crate::geometry::math::min;
use crate::geometry::pose::{diagonal, perpendicular};

/// Settings of the search for a pose that explains more of a scan than the prediction does.
#[derive(Clone, Copy, Debug, PartialEq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct SearchConfig {
    /// The search is made where the prediction explains less than this share of the scan.
    pub below_score: f32,
    /// How far turns reach to each side, radians, whatever the wheels say.
    pub reach_rad: f32,
    /// What the prior of a hypothesis is widened by: standard deviations of position (m) and heading (rad), …
    pub widen: [f32; 2],
    /// … and of the position, for each metre that the wheels report: they may have slipped.
    pub widen_per_m: f32,
    /// Standard deviations of a proposed pose, by which its first pairs are gated: position (m) and heading (rad).
    pub proposed: [f32; 2],
    /// Share of the scan that must be explained more for another pose to be taken, …
    pub gain: f32,
    /// … and segments, where the prediction explains at least [`Self::something_score`], …
    pub more_segments: f32,
    /// … or less.
    pub more_segments_from_nothing: f32,
    /// See there.
    pub something_score: f32,
    /// What a hypothesis loses for each unit of squared Mahalanobis distance from the prediction, in the widened prior.
    pub loss_per_chi2: f32,
    /// A turn by more than this from the prediction, radians, …
    pub far_rad: f32,
    /// … must explain this share of the scan, …
    pub far_score: f32,
    /// … or this where the prediction explains less than [`Self::nothing_score`].
    pub far_score_from_nothing: f32,
    /// See there.
    pub nothing_score: f32,
    /// The prior is left out where its squared Mahalanobis distance from what the scan says is larger than this.
    pub wild_chi2: f32,
    /// Or where it was larger than this, …
    pub suspicious_chi2: f32,
    /// … in so many scans more than it was not: wheels that slip drag the pose along little by little.
    pub suspicious_scans: u8,
}

impl SearchConfig {
    /// Whether a hypothesis tells enough to be taken instead of the best known, so many radians from the prediction. One pair
    /// fixes no pose, and a few short segments find something to lie on anywhere.
    pub(super) fn is_convincing(&self, hypothesis: &Hypothesis, best: &Hypothesis, turned_rad: f32) -> bool {
        let more = if best.score > self.something_score {
            self.more_segments
        } else {
            self.more_segments_from_nothing
        };
        let far = if best.score > self.nothing_score { self.far_score } else { self.far_score_from_nothing };
        hypothesis.paired >= 2
            && hypothesis.explained >= best.explained + more
            && (turned_rad.abs() <= self.far_rad || hypothesis.score >= far)
    }

    /// What a hypothesis may be off by from the prediction after a motion: an error of the heading, made half before and half
    /// after it, and one of the position.
    pub(super) fn widening(&self, moved: &Vector2<f32>) -> Matrix3<f32> {
        let [position, heading] = self.widen;
        let lever = perpendicular(*moved);
        let (early, late) = (Vector3::new(lever.x, lever.y, 1.0), Vector3::new(0.0, 0.0, 1.0));
        let by_way = self.widen_per_m * self.widen_per_m * moved.norm_squared();
        diagonal([position, position, 0.0])
            + Matrix3::from_diagonal(&Vector3::new(by_way, by_way, 0.0))
            + (early * early.transpose() + late * late.transpose()) * (0.5 * heading * heading)
    }

    pub(crate) fn validate(&self) -> Checked {
        let fields = [
            ("correction.maximum_a_posteriori.search.below_score", self.below_score),
            ("correction.maximum_a_posteriori.search.reach_rad", self.reach_rad),
            ("correction.maximum_a_posteriori.search.widen", min(self.widen[0], self.widen[1])),
            ("correction.maximum_a_posteriori.search.proposed", min(self.proposed[0], self.proposed[1])),
            ("correction.maximum_a_posteriori.search.widen_per_m", self.widen_per_m),
            ("correction.maximum_a_posteriori.search.more_segments", self.more_segments),
            (
                "correction.maximum_a_posteriori.search.more_segments_from_nothing",
                self.more_segments_from_nothing,
            ),
            ("correction.maximum_a_posteriori.search.something_score", self.something_score),
            ("correction.maximum_a_posteriori.search.gain", self.gain),
            ("correction.maximum_a_posteriori.search.loss_per_chi2", self.loss_per_chi2),
            ("correction.maximum_a_posteriori.search.far_rad", self.far_rad),
            ("correction.maximum_a_posteriori.search.far_score", self.far_score),
            ("correction.maximum_a_posteriori.search.far_score_from_nothing", self.far_score_from_nothing),
            ("correction.maximum_a_posteriori.search.nothing_score", self.nothing_score),
            ("correction.maximum_a_posteriori.search.wild_chi2", self.wild_chi2),
            ("correction.maximum_a_posteriori.search.suspicious_chi2", self.suspicious_chi2),
        ];
        fields.into_iter().try_for_each(|(field, value)| not_negative(field, value))
    }
}
