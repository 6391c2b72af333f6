//! Lines of the map that are one wall become one line.
//!
//! That two lines are one is a measurement of their difference, with the noise of a line: the filter takes it in, so that pose and
//! all lines follow; then one takes over the other's extent.

use nalgebra::{Isometry2, Matrix3, Point2};

use crate::ekf::config::EkfConfig;
use crate::ekf::filter::EkfSlam;
use crate::ekf::keyframe_update::SensorModel;
use crate::ekf::line_map::LineMap;
use crate::ekf::measurement::Measurement;
use crate::ekf::state::UpdateScope;
use crate::geometry::line_noise::LineNoise;
use crate::geometry::line_observation::Residual;
use crate::geometry::math::{max, min};
use crate::geometry::pose::cross;
use crate::geometry::segment::Segment;
use crate::map::nearby::Nearby;
use crate::map::{MapSegment, SegmentMap};

/// Merges each line that a scan saw with those that are the same wall. Leaves the lines around the robot in `near`.
pub(super) fn merge_walls<const N: usize>(
    scan: u32,
    sensor: &SensorModel,
    config: &EkfConfig,
    pose: &mut Isometry2<f32>,
    filter: &mut EkfSlam,
    map: &mut SegmentMap<N>,
    near: &mut Nearby<N>,
) {
    near.gather(map.segments(), pose, sensor.reach_m, |_| true);
    let mut next = 0;
    while let Some(index) = near.all().get(next).copied().map(usize::from) {
        let Some(changed) = map.segments().get(index).copied() else { break };
        let related = |relation: Relation| {
            let position = pose.translation.vector.into();
            let is_related = |other: &usize| {
                *other != index
                    && map.segments().get(*other).is_some_and(|s| {
                        Relation::of(&changed, s, &position, &sensor.line_noise, config) == Some(relation)
                    })
            };
            let mut along = near.along(changed.direction(), config.merge_max_angle_rad).map(usize::from);
            along.find(is_related)
        };
        if changed.last_seen != scan {
            next += 1;
            continue;
        }
        let Some(twin) = related(Relation::OnePiece) else {
            // That a line goes on behind an opening is learnt once, when it is no longer tentative: what is seen once may be a bridge.
            if changed.hits == config.tentative_hits
                && let Some(other) = related(Relation::OneWall)
                && let Some(updated) = update_by_twins([other, index], sensor, config, pose, filter, map)
            {
                *pose = updated;
            }
            next += 1;
            continue;
        };
        let inliers = |i: usize| map.segments().get(i).map_or(0, |s| s.inliers());
        let (kept, gone) = if inliers(twin) > inliers(index) { (twin, index) } else { (index, twin) };
        if let Some(updated) = update_by_twins([kept, gone], sensor, config, pose, filter, map) {
            *pose = updated;
        }
        // The merged line is looked at again, wherever it went.
        let merged = LineMap { map, filter }.merge(kept, gone);
        near.gather(map.segments(), pose, sensor.reach_m, |_| true);
        let all = near.all();
        next = all.iter().position(|i| usize::from(*i) >= merged).unwrap_or(all.len());
    }
}

/// Updates the filter by two lines being one, unless the gate rejects it. Returns the pose by that.
fn update_by_twins<const N: usize>(
    twins: [usize; 2],
    sensor: &SensorModel,
    config: &EkfConfig,
    pose: &Isometry2<f32>,
    filter: &mut EkfSlam,
    map: &mut SegmentMap<N>,
) -> Option<Isometry2<f32>> {
    let [kept, gone] = twins.map(|index| filter.activate(index, config.reactivation_inflation, map));
    let [a, b] = twins.map(|index| map.segments().get(index).map(MapSegment::segment));
    let (a, b) = (a?, b?);
    let noise = sensor.line_noise.added_to([0.0, 0.0], min(a.length_m(), b.length_m()));
    let measurement = Measurement::of_twins((&a, kept?), (&b, gone?), noise);
    filter.update(&measurement, &config.merge_gate(), UpdateScope::All).then(|| filter.commit(pose, map))
}

/// What two lines have to do with each other.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Relation {
    /// They are one: they overlap or touch.
    OnePiece,
    /// They are parts of one wall, with an opening between them.
    OneWall,
}

impl Relation {
    /// Lines are of one wall where they agree within their uncertainty. They are one piece, too, where they lie so close behind each
    /// other that one would hide the other; a scan that saw both tells that it does not.
    fn of(
        a: &MapSegment,
        b: &MapSegment,
        position: &Point2<f32>,
        noise: &LineNoise,
        config: &EkfConfig,
    ) -> Option<Self> {
        let seen_beside = a.last_seen == b.last_seen;
        let (a, b) = (&a.segment(), &b.segment());
        let facing = a.direction.dot(&b.direction) > 0.0;
        if !facing || cross(a.direction, b.direction).abs() > config.merge_max_angle_rad {
            return None;
        }
        // The shorter one is judged by the longer one's line.
        let [long, short] = Segment::longer_first(a, b);
        let distance = long.farther_end_m(short);
        if distance > config.merge_max_distance_m {
            return None;
        }
        let gap_m = -long.overlap_m(short);
        let hides = !seen_beside
            && -gap_m >= config.merge_overlap * short.length_m()
            && distance <= config.merge_sigmas * noise.sigma_offset_m;
        let agrees = || {
            Residual::new(short, long, *position, noise)
                .is_some_and(|r| r.chi2(&Matrix3::zeros()) <= config.merge_max_nis)
        };
        // A long wall goes on behind a door; a short thing beside another is another thing.
        let widest_m = max(config.merge_gap_m, min(short.length_m(), config.wall_max_gap_m));
        match () {
            () if hides => Some(Self::OnePiece),
            () if gap_m > widest_m || !agrees() => None,
            () if gap_m > config.merge_gap_m => Some(Self::OneWall),
            () => Some(Self::OnePiece),
        }
    }
}
