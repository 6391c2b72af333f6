//! Odometry with increasing stamps, of one source or of several, without what no robot can have done.

use std::collections::HashMap;

use slam_core::odometry::{LEAST_UNKNOWN_JUMP_M, MOST_UNKNOWN_SPEED_M_S};

use super::Assembly;
use super::order::increasing;
use super::stamps::{MADE_UP_US, Settled};
use crate::log::Odometry;
use crate::log::records::{OdometryRecord, Source};
use crate::score::Spread;

/// Poses of two sources that are farther apart than this, metres, are not of one odometry: on logs that were corrected afterwards
/// (fhw, freiburg-101) the median is 0.04 m.
const MOST_CONTRADICTION_M: f64 = 0.01;

impl Assembly<'_> {
    /// Odometry with increasing stamps.
    pub(super) fn settle_odometry(&mut self, records: Vec<OdometryRecord>, settled: &Settled) {
        let all = records.len();
        let (beside, own): (Vec<_>, Vec<_>) = records.into_iter().partition(|r| r.source == Source::Scan);
        let beside: Vec<OdometryRecord> = beside
            .into_iter()
            .filter_map(|record| {
                // A scan that was left out for its beams has a stamp of its own still.
                let stamp = settled.stamp_at.get(&record.place).copied();
                let stamp_us = stamp.map_or(Some(record.stamp_us), |s| s.map(|s| s as i64))?;
                Some(OdometryRecord { stamp_us, ..record })
            })
            .collect();
        let own = if !settled.made_up {
            self.unless_contradicted(own, &beside)
        } else if beside.is_empty() {
            between_scans(own, settled)
        } else {
            self.skip("odometry_without_time", own.len());
            Vec::new()
        };
        let mut merged = Vec::new();
        for stream in [beside, own] {
            let stamps: Vec<i64> = stream.iter().map(|record| record.stamp_us).collect();
            let kept = increasing(&stamps);
            self.skip("odometry_time_not_increasing", kept.iter().filter(|kept| !**kept).count());
            merged.extend(stream.into_iter().zip(kept).filter_map(|(record, kept)| kept.then_some(record)));
        }
        // Two streams, each in order. At equal stamps the reading that a scan brings is believed.
        merged.sort_by_key(|record| (record.stamp_us, record.source));
        merged.dedup_by_key(|record| record.stamp_us);
        let readings = merged.into_iter().filter_map(|r| Some((u64::try_from(r.stamp_us).ok()?, r.odometry)));
        self.log.odometry = self.without_jumps(readings.collect());
        self.check_overlap(settled);
        let set_aside: usize = ["odometry_without_time", "odometry_contradicts_scan_records"]
            .iter()
            .filter_map(|reason| self.log.skipped.get(reason))
            .sum();
        let all = all - set_aside;
        if 2 * self.log.odometry.len() < all {
            let message = format!(
                "only {} of {all} readings of the odometry could be used: the stamps of the others are not in order",
                self.log.odometry.len()
            );
            self.warn("odometry_mostly_skipped", message);
        }
    }

    /// Odometry on another clock than the scans is none.
    fn check_overlap(&mut self, settled: &Settled) {
        let ends = |stamps: &mut dyn DoubleEndedIterator<Item = u64>| {
            let first = stamps.next()?;
            Some((first, stamps.next_back().unwrap_or(first)))
        };
        let scans = ends(&mut settled.scans.iter().map(|scan| scan.stamp_us));
        let odometry = ends(&mut self.log.odometry.iter().map(|(stamp_us, _)| *stamp_us));
        let (Some(scans), Some(odometry)) = (scans, odometry) else { return };
        let shared_us = scans.1.min(odometry.1).saturating_sub(scans.0.max(odometry.0));
        if 2 * shared_us < scans.1 - scans.0 {
            let span =
                |(from, to): (u64, u64)| format!("{:.3} to {:.3} s", from as f64 * 1e-6, to as f64 * 1e-6);
            let message = format!(
                "the scans are of {}, the odometry of {}: they seem to be of different clocks, or one of them stopped",
                span(scans),
                span(odometry)
            );
            self.warn("odometry_of_another_time", message);
        }
    }

    /// Odometry of its own records, unless the poses that the scans bring are others at the same time: logs that were corrected
    /// afterwards have both, and one between the other would zigzag.
    fn unless_contradicted(
        &mut self,
        own: Vec<OdometryRecord>,
        beside: &[OdometryRecord],
    ) -> Vec<OdometryRecord> {
        let pose = |record: &OdometryRecord| match record.odometry {
            Odometry::Pose(pose) => Some((record.stamp_us, pose)),
            _ => None,
        };
        let mut known: Vec<(i64, [f64; 3])> = own.iter().filter_map(pose).collect();
        known.sort_by_key(|(stamp_us, _)| *stamp_us);
        let off = beside.iter().filter_map(pose).filter_map(|(stamp_us, said)| {
            let after = known.partition_point(|(known_us, _)| *known_us < stamp_us);
            let (from, to) = (known.get(after.checked_sub(1)?)?, known.get(after)?);
            let share = (stamp_us - from.0) as f64 / (to.0 - from.0).max(1) as f64;
            let at = [0, 1].map(|axis| from.1[axis] + share * (to.1[axis] - from.1[axis]));
            Some((at[0] - said[0]).hypot(at[1] - said[1]))
        });
        let Some(off) = Spread::of(off).filter(|off| off.median > MOST_CONTRADICTION_M) else { return own };
        let message = format!(
            "the {} ODOM poses lie {:.3} m off the poses of the scans (median): the scans' poses alone were used",
            own.len(),
            off.median
        );
        self.warn("odometry_contradicts_scan_records", message);
        self.skip("odometry_contradicts_scan_records", own.len());
        Vec::new()
    }

    /// Leaves out single poses that no robot can have reached, and takes up the odometry where it was after it began anew
    /// somewhere else.
    fn without_jumps(&mut self, readings: Vec<(u64, Odometry)>) -> Vec<(u64, Odometry)> {
        let impossible = |a: &(u64, Odometry), b: &(u64, Odometry)| {
            let (Odometry::Pose(from), Odometry::Pose(to)) = (a.1, b.1) else { return false };
            let step_m = (to[0] - from[0]).hypot(to[1] - from[1]);
            let finite = to.iter().all(|v| v.is_finite());
            let within_s = (b.0 - a.0) as f64 * 1e-6;
            let most_m = f64::from(LEAST_UNKNOWN_JUMP_M) + f64::from(MOST_UNKNOWN_SPEED_M_S) * within_s;
            !finite || step_m > most_m
        };
        let mut kept: Vec<(u64, Odometry)> = Vec::with_capacity(readings.len());
        // What the poses are moved by: rotation and translation.
        let mut moved: Option<nalgebra::Isometry2<f64>> = None;
        let (mut single, mut restarts) = (0, 0);
        let pose = |odometry: Odometry| match odometry {
            Odometry::Pose([x, y, theta]) => Some(nalgebra::Isometry2::new([x, y].into(), theta)),
            _ => None,
        };
        let mut last: Option<(u64, Odometry)> = None;
        for (k, reading) in readings.iter().enumerate() {
            if let Some(before) = last.filter(|before| impossible(before, reading)) {
                let next_fits = readings.get(k + 1).is_none_or(|next| !impossible(&before, next));
                if next_fits || !pose(reading.1).is_some_and(|p| p.translation.vector.norm().is_finite()) {
                    single += 1;
                    continue;
                }
                restarts += 1;
                // Where it was is where it is: what it moved meanwhile is not known.
                let (from, to) = (kept.last().and_then(|r| pose(r.1)), pose(reading.1));
                moved = from.zip(to).map(|(from, to)| from * to.inverse());
            }
            last = Some(*reading);
            let odometry = match (moved, pose(reading.1)) {
                (Some(moved), Some(here)) => {
                    let c = moved * here;
                    Odometry::Pose([c.translation.x, c.translation.y, c.rotation.angle()])
                }
                _ => reading.1,
            };
            kept.push((reading.0, odometry));
        }
        self.skip("odometry_impossible_step", single);
        if restarts > 0 {
            let message = format!(
                "the odometry jumps {restarts} times farther than a robot can drive: taken as begun anew, from where it was"
            );
            self.warn("odometry_restarted", message);
        }
        kept
    }
}

/// Odometry without times, spread evenly between the scans that it stands between.
fn between_scans(own: Vec<OdometryRecord>, settled: &Settled) -> Vec<OdometryRecord> {
    let index = |record: &OdometryRecord| settled.scans.partition_point(|scan| scan.line < record.place);
    let indices: Vec<usize> = own.iter().map(index).collect();
    let mut counts: HashMap<usize, i64> = HashMap::new();
    indices.iter().for_each(|i| *counts.entry(*i).or_default() += 1);
    let mut seen: HashMap<usize, i64> = HashMap::new();
    own.into_iter()
        .zip(indices)
        .map(|(record, i)| {
            let k = seen.entry(i).or_default();
            *k += 1;
            // The first scan has the stamp zero: what stands before it cannot be earlier.
            let stamp_us = (i as i64 - 1) * MADE_UP_US + MADE_UP_US * *k / (counts[&i] + 1);
            OdometryRecord { stamp_us: if i == 0 { *k - counts[&i] } else { stamp_us }, ..record }
        })
        .collect()
}
