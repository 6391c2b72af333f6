//! The update of the filter by a keyframe, spread over the scans that follow.
//!
//! In: observed segments in `base`, the corrected pose, the pairs. Out: a filter and a map that are updated.
//!
//! The measurements are linearized at the pose that tracking found, against the lines as they are then. A few are taken in with each
//! scan; nominal pose and lines stay until [`KeyframeUpdate::commit`], which injects the error state, augments the state by what is
//! new, and merges lines that are one wall.

use heapless::Vec;
use nalgebra::{Isometry2, Point2, Vector3};

use crate::config::SlamConfig;
use crate::ekf::compatibility::jointly_compatible;
use crate::ekf::config::EkfConfig;
use crate::ekf::filter::EkfSlam;
use crate::ekf::line_map::LineMap;
use crate::ekf::measurement::Measurement;
use crate::ekf::merging::merge_walls;
use crate::ekf::state::UpdateScope;
use crate::frontend::extraction::MAX_SEGMENTS;
use crate::geometry::line_noise::{LineNoise, variances, with_variances};
use crate::geometry::line_observation::{LineObservation, ObservationNoise};
use crate::geometry::pose::{difference, is_finite};
use crate::geometry::segment::Segment;
use crate::map::nearby::Nearby;
use crate::map::{MapSegment, SegmentMap};
use crate::tracking::association::Pair;

/// Most lines of a keyframe that are measured.
pub const MAX_UPDATES: usize = 12;
/// Most lines of a keyframe whose ends are extended at the commit; others are at once.
const MAX_EXTENSIONS: usize = 24;

/// When a scan was taken.
#[derive(Clone, Copy, Debug)]
pub struct Stamp {
    /// Number of the scan.
    pub scan: u32,
    /// Way the robot had driven, metres.
    pub way_m: f32,
}

/// What one scan did to the map.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct RegistrationReport {
    /// Segments paired with a line of the map.
    pub matched: u32,
    /// Segments added.
    pub new: u32,
    /// Pairs whose innovation was too large.
    pub doubtful: u32,
    /// Whether the scan is a keyframe; with the paper's registration each is.
    pub keyframe: bool,
    /// Whether the last keyframe's update was committed: pose and map have moved.
    pub committed: bool,
}

/// What the registration is given of a scan.
#[derive(Clone, Copy, Debug)]
pub struct Observed<'a> {
    /// Segments in `base`.
    pub segments: &'a [Segment],
    /// Those that are known.
    pub pairs: &'a [Pair],
    /// When they were seen.
    pub stamp: Stamp,
    /// What saw them.
    pub sensor: SensorModel,
}

/// What the registration must know of the sensor.
#[derive(Clone, Copy, Debug)]
pub struct SensorModel {
    /// How far it sees, metres.
    pub reach_m: f32,
    /// Errors of lines beyond their points' noise.
    pub line_noise: LineNoise,
}

impl SensorModel {
    pub(crate) fn of(config: &SlamConfig) -> Self {
        Self { reach_m: config.sensor.reach_m(), line_noise: config.line_noise }
    }
}

impl Observed<'_> {
    /// The segments without a pair.
    pub(crate) fn unknown(&self) -> impl Iterator<Item = &Segment> {
        let known = |index: usize| self.pairs.iter().any(|p| p.observed == index);
        self.segments.iter().enumerate().filter(move |(index, _)| !known(*index)).map(|(_, s)| s)
    }
}

pub(crate) fn mark_seen(entry: &mut MapSegment, stamp: &Stamp) {
    entry.hits = entry.hits.saturating_add(1);
    entry.last_seen = stamp.scan;
    entry.seen_at_m = stamp.way_m;
}

/// Where the measurements of a keyframe are linearized.
#[derive(Clone, Copy, Debug)]
pub struct LinearizationPoint {
    /// The predicted pose: the filter's nominal one, to which its covariance belongs.
    pub prior: Isometry2<f32>,
    /// The pose that tracking found, through which the pairs were made.
    pub pose: Isometry2<f32>,
}

impl LinearizationPoint {
    /// From the prior's (x, y, θ) to the pose's.
    fn since_prior(&self) -> Vector3<f32> {
        difference(&self.pose, &self.prior)
    }
}

/// A keyframe's measurements on their way into the filter.
#[derive(Clone, Debug, Default)]
pub struct KeyframeUpdate {
    /// In the order of the scan.
    queue: Vec<QueuedUpdate, MAX_UPDATES>,
    /// How many of them the filter has taken in.
    done: usize,
    /// Lines that were seen beyond their ends: the line's slot, and both ends seen, in `base`.
    extensions: Vec<(usize, [Point2<f32>; 2]), MAX_EXTENSIONS>,
    /// Where they are linearized, and the number of the scan, until they are committed.
    pending: Option<(LinearizationPoint, u32)>,
}

/// A line of the map seen again.
#[derive(Clone, Debug)]
struct QueuedUpdate {
    measurement: Measurement,
    scope: UpdateScope,
}

impl KeyframeUpdate {
    /// Whether there is an update that has not been committed.
    pub fn is_pending(&self) -> bool {
        self.pending.is_some()
    }

    /// Drops it.
    pub fn clear(&mut self) {
        self.queue.clear();
        self.extensions.clear();
        (self.done, self.pending) = (0, None);
    }

    /// Makes the measurements of a keyframe, and adds to the map what is not known, or cannot be what it is paired with.
    ///
    /// Work: for each pair some steps, and two for each other pair.
    pub fn begin<const N: usize>(
        &mut self,
        seen: &Observed<'_>,
        at: &LinearizationPoint,
        config: &EkfConfig,
        filter: &mut EkfSlam,
        map: &mut SegmentMap<N>,
    ) -> RegistrationReport {
        self.clear();
        self.pending = Some((*at, seen.stamp.scan));
        let pairs =
            jointly_compatible(seen.pairs, seen.segments, &seen.sensor.line_noise, config.max_joint_chi2);
        let seen = &Observed { pairs: &pairs, ..*seen };
        let mut report = RegistrationReport { keyframe: true, ..RegistrationReport::default() };
        let ratios = information_ratios(seen, at, config, filter, map);
        for (index, pair) in seen.pairs.iter().enumerate() {
            let (Some(rank), Some(slot)) = (rank(&ratios, index), filter.slot_of(pair.mapped)) else {
                report.doubtful += 1;
                continue;
            };
            if rank < usize::from(config.max_updates)
                && let Some(measurement) = pair.measurement(slot, seen, at, map)
                && let Some(entry) = map.segments().get(pair.mapped)
            {
                let scope = if is_tentative(entry, filter.age_scans(slot), config) {
                    UpdateScope::Line(slot)
                } else if rank < usize::from(config.max_full_updates) {
                    UpdateScope::All
                } else {
                    UpdateScope::RobotAndLine(slot)
                };
                // There is room for as many as are measured.
                let _ = self.queue.push(QueuedUpdate { measurement, scope });
            }
            if let (Some(segment), Some(entry)) = (seen.segments.get(pair.observed), map.get_mut(pair.mapped))
            {
                self.note_seen(entry, slot, segment, &seen.stamp, at, config.merge_gap_m);
            }
            report.matched += 1;
        }
        report.new = add_unknown(seen, at, config, filter, map);
        report
    }

    /// A line is seen again, perhaps beyond its ends.
    fn note_seen(
        &mut self,
        entry: &mut MapSegment,
        slot: usize,
        segment: &Segment,
        stamp: &Stamp,
        at: &LinearizationPoint,
        max_gap_m: f32,
    ) {
        mark_seen(entry, stamp);
        entry.add_inliers(segment);
        let ends = [segment.start, segment.end];
        let ends_in_map = ends.map(|end| at.pose * end);
        if entry.segment().gap_to_m(ends_in_map) > max_gap_m {
            return;
        }
        let extended = entry.segment().extended(ends_in_map);
        if extended.length_m() > entry.length_m() && self.extensions.push((slot, ends)).is_err() {
            entry.set_segment(&extended);
        }
    }

    /// Updates the filter by the next measurements, `most` at most; false where none was left.
    ///
    /// Work: for each of `UpdateScope::All` the square of the number of states, for the others that number.
    pub fn advance(&mut self, most: usize, config: &EkfConfig, filter: &mut EkfSlam) -> bool {
        let end = self.queue.len().min(self.done.saturating_add(most));
        let next = self.queue.get(self.done..end).unwrap_or_default();
        filter.update_all(next.iter().map(|u| (&u.measurement, u.scope)), &config.gate());
        self.done = end;
        !next.is_empty()
    }

    /// Takes in the measurements that are left, injects the error state into pose and lines, augments the state by new lines, and
    /// merges walls. Returns the pose that tracking had found at the keyframe, and the filter's; in `near` the lines around it.
    /// `None` where nothing is pending.
    ///
    /// Work: for the lines in the state one step each; for each new line the number of states; for merging, one step for each line
    /// that was seen and each one around the robot, and one for each line of the map.
    pub fn commit<const N: usize>(
        &mut self,
        sensor: &SensorModel,
        config: &EkfConfig,
        filter: &mut EkfSlam,
        map: &mut SegmentMap<N>,
        near: &mut Nearby<N>,
    ) -> Option<[Isometry2<f32>; 2]> {
        self.advance(MAX_UPDATES, config, filter);
        let (LinearizationPoint { prior, pose }, scan) = self.pending.take()?;
        let mut committed = filter.commit(&prior, map);
        for &(slot, ends) in &self.extensions {
            if let Some(entry) = filter.line_id(slot).and_then(|index| map.get_mut(index)) {
                let extended = entry.segment().extended(ends.map(|end| committed * end));
                if extended.is_finite() {
                    entry.set_segment(&extended);
                }
            }
        }
        // A new line lies as it was seen from where the robot was.
        let moved = committed * pose.inverse();
        for index in 0..map.segments().len() {
            let Some(entry) = map.get_mut(index).filter(|e| e.last_seen == scan && e.hits == 1) else {
                continue;
            };
            let segment = entry.segment().transformed(&moved);
            if segment.is_finite() {
                entry.set_segment(&segment);
                filter.augment(index, committed.translation.vector, map);
            }
        }
        merge_walls(scan, sensor, config, &mut committed, filter, map, near);
        Some([pose, if is_finite(&committed) { committed } else { pose }])
    }
}

/// Of each pair, the sum of both information ratios; none where the gate rejects it, or the line finds no slot. As many pairs as
/// observed segments at most.
fn information_ratios<const N: usize>(
    seen: &Observed<'_>,
    at: &LinearizationPoint,
    config: &EkfConfig,
    filter: &mut EkfSlam,
    map: &mut SegmentMap<N>,
) -> Vec<Option<f32>, MAX_SEGMENTS> {
    let mut ratios = Vec::new();
    for pair in seen.pairs {
        let slot = filter.activate(pair.mapped, config.reactivation_inflation, map);
        let ratio = slot.and_then(|slot| {
            let test = filter.test(&pair.measurement(slot, seen, at, map)?);
            (test.nis <= config.max_nis).then(|| test.information_ratio.iter().sum())
        });
        let _ = ratios.push(ratio);
    }
    ratios
}

/// How many pairs have a larger information ratio than one of them, which must have one. Only the choice goes by it: taken in in that
/// order, lines that are least known, and may be wrong, would come first.
fn rank(ratios: &[Option<f32>], index: usize) -> Option<usize> {
    let ratio = ratios.get(index).copied().flatten()?;
    let more =
        |(i, other): &(usize, &Option<f32>)| other.is_some_and(|o| o > ratio || o == ratio && *i < index);
    Some(ratios.iter().enumerate().filter(more).count())
}

/// Whether a line is new and is seen only now and then.
fn is_tentative(entry: &MapSegment, age_scans: f32, config: &EkfConfig) -> bool {
    entry.hits < config.tentative_hits && age_scans > config.tentative_scans_per_hit * f32::from(entry.hits)
}

/// Adds to the map what is not part of a line there. Returns how many segments.
fn add_unknown<const N: usize>(
    seen: &Observed<'_>,
    at: &LinearizationPoint,
    config: &EkfConfig,
    filter: &mut EkfSlam,
    map: &mut SegmentMap<N>,
) -> u32 {
    let mut new = 0;
    for (index, segment) in seen.segments.iter().enumerate() {
        // One with a pair may stand apart from it, behind an opening of the same wall.
        let pair = seen.pairs.iter().find(|pair| pair.observed == index);
        let ends = [segment.start, segment.end].map(|end| at.pose * end);
        let goes_on = |line: &MapSegment| line.segment().gap_to_m(ends) <= config.merge_gap_m;
        if pair.is_some_and(|pair| map.segments().get(pair.mapped).is_some_and(goes_on)) {
            continue;
        }
        let [var_offset, var_direction] =
            seen.sensor.line_noise.added_to(variances(segment), segment.length_m());
        let segment = with_variances(&segment.transformed(&at.pose), var_offset, var_direction);
        if segment.is_finite() && (LineMap { map, filter }).insert(segment, &seen.stamp).is_some() {
            new += 1;
        }
    }
    new
}

impl Pair {
    /// The measurement of the line in a slot.
    fn measurement<const N: usize>(
        &self,
        slot: usize,
        seen: &Observed<'_>,
        at: &LinearizationPoint,
        map: &SegmentMap<N>,
    ) -> Option<Measurement> {
        let segment = seen.segments.get(self.observed)?;
        let mapped = &map.segments().get(self.mapped)?.segment();
        let noise = ObservationNoise::new(segment, mapped, &seen.sensor.line_noise);
        let position = at.prior.translation.vector.into();
        let seen = LineObservation::new(&segment.transformed(&at.pose), mapped, position, noise);
        Measurement::of_line(slot, &seen, &at.since_prior())
    }
}

#[cfg(test)]
mod tests;
