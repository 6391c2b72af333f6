//! Stamps of scans: which scans are in order, and when those were taken whose stamps do not say it.

use std::collections::HashMap;

use super::Assembly;
use super::order::not_decreasing;
use crate::log::records::ScanRecord;
use crate::log::{Defect, Format, LogError, LoggedScan};
use crate::score::Spread;

/// So small a share of the scans may be out of order without being asked about. Ours; no recorded log at hand has any.
const FEW: f64 = 0.02;
/// Scans without stamps are taken to be this far apart, microseconds.
pub(super) const MADE_UP_US: i64 = 100_000;
/// No scanner is faster, …
const LEAST_INTERVAL_US: f64 = 1e3;
/// … and no recording of a drive slower, microseconds from scan to scan.
const MOST_INTERVAL_US: f64 = 60e6;

/// Scans in order, and what was done to their stamps.
#[derive(Default)]
pub(super) struct Settled {
    pub(super) scans: Vec<LoggedScan>,
    /// By a scan's place in the file: its stamp now; none where it was left out for its stamp.
    pub(super) stamp_at: HashMap<usize, Option<u64>>,
    /// Whether the stamps say nothing and the order in the file is all there is.
    pub(super) made_up: bool,
}

impl Assembly<'_> {
    /// Scans with increasing stamps.
    pub(super) fn settle_stamps(&mut self, scans: Vec<ScanRecord>) -> Result<Settled, LogError> {
        let mut settled = Settled::default();
        let scans = self.without_repetitions(scans, &mut settled);
        let stamps: Vec<i64> = scans.iter().map(|scan| scan.stamp_us).collect();
        settled.made_up = stamps.len() > 1 && stamps.iter().all(|stamp| *stamp == stamps[0]);
        let stamps: Vec<Option<i64>> = if settled.made_up {
            let message = format!(
                "all {} scans bear the stamp {:.3} s: the order in the file counts, and the times, a scan each {} ms, are made up",
                stamps.len(),
                stamps[0] as f64 * 1e-6,
                MADE_UP_US / 1000
            );
            self.warn("stamps_made_up", message);
            (0..stamps.len() as i64).map(|k| Some(k * MADE_UP_US)).collect()
        } else {
            let kept = self.in_order(&scans, &stamps)?;
            self.spread_equal(stamps.iter().zip(kept).map(|(stamp, kept)| kept.then_some(*stamp)).collect())
        };
        for (scan, stamp) in scans.into_iter().zip(stamps) {
            let stamp_us = stamp.and_then(|stamp| u64::try_from(stamp).ok());
            settled.stamp_at.insert(scan.place, stamp_us);
            let ScanRecord { place: line, ranges_mm, geometry, .. } = scan;
            if let Some(stamp_us) = stamp_us {
                settled.scans.push(LoggedScan { line, stamp_us, ranges_mm, geometry });
            }
        }
        Ok(settled)
    }

    /// A record that stands twice, one after the other, is one.
    fn without_repetitions(&mut self, scans: Vec<ScanRecord>, settled: &mut Settled) -> Vec<ScanRecord> {
        let mut kept: Vec<ScanRecord> = Vec::with_capacity(scans.len());
        let mut repeated = 0;
        for scan in scans {
            // Scans without stamps may well be equal while the robot stands.
            let again = |last: &ScanRecord| {
                last.stamp_us == scan.stamp_us && scan.stamp_us != 0 && last.ranges_mm == scan.ranges_mm
            };
            if kept.last().is_some_and(again) {
                settled.stamp_at.insert(scan.place, None);
                repeated += 1;
            } else {
                kept.push(scan);
            }
        }
        self.skip("repeated", repeated);
        kept
    }

    /// Which scans are in order; those that are not are an error, or skipped and counted.
    fn in_order(&mut self, scans: &[ScanRecord], stamps: &[i64]) -> Result<Vec<bool>, LogError> {
        let kept = not_decreasing(stamps);
        let out = kept.iter().filter(|kept| !**kept).count();
        let Some(first) = kept.iter().position(|kept| !kept) else { return Ok(kept) };
        let before_us = stamps[..first].iter().copied().max().unwrap_or(0);
        let defect = Defect::TimeNotIncreasing { before_us, stamp_us: stamps[first], scans: out };
        if out as f64 <= FEW * scans.len() as f64 {
            let place = self.format.place(scans[first].place);
            self.warn("time_not_increasing", format!("{place}: {defect}: they were left out"));
            self.skip(defect.reason(), out);
            return Ok(kept);
        }
        // From there on all of them: the recorder was started again.
        if kept[first..].iter().all(|kept| !kept) && out > 1 {
            let message = format!(
                "{}: time begins anew, a second run: the {out} scans from there on were left out, {} were used",
                self.format.place(scans[first].place),
                scans.len() - out
            );
            self.warn("second_run", message);
        }
        self.refuse(scans[first].place, defect)?;
        self.skip("time_not_increasing", out - 1);
        Ok(kept)
    }

    /// Scans with equal stamps lie evenly between that stamp and the next, no farther apart than scans commonly are.
    fn spread_equal(&mut self, mut stamps: Vec<Option<i64>>) -> Vec<Option<i64>> {
        let mut kept: Vec<i64> = stamps.iter().flatten().copied().collect();
        let intervals = kept.windows(2).map(|w| w[1] - w[0]).filter(|d| *d > 0);
        let usual = Spread::of(intervals.map(|d| d as f64)).map_or(MADE_UP_US, |s| s.median as i64);
        let mut moved = 0;
        let mut from = 0;
        while from < kept.len() {
            let stamp = kept[from];
            let to = from + kept[from..].iter().take_while(|s| **s == stamp).count();
            let n = (to - from) as i64;
            let room = kept.get(to).map_or(usual, |next| next - stamp);
            for k in 1..n {
                // A microsecond at least, where there is room for it.
                kept[from + k as usize] = stamp + k * (room / n).min(usual).max(1);
                moved += 1;
            }
            from = to;
        }
        if moved > 0 {
            let message = format!(
                "{moved} scans bear the stamp of the scan before: the order in the file counts, their times are made up"
            );
            self.warn("stamps_made_up", message);
        }
        let mut settled = kept.into_iter();
        stamps.iter_mut().flatten().for_each(|stamp| *stamp = settled.next().unwrap_or(*stamp));
        stamps
    }

    pub(super) fn check_intervals(&mut self, settled: &Settled) -> Result<(), LogError> {
        if settled.made_up || self.options.stamps.is_some() {
            return Ok(());
        }
        let intervals = settled.scans.windows(2).map(|w| (w[1].stamp_us - w[0].stamp_us) as f64);
        let Some(median_us) = Spread::of(intervals).map(|s| s.median) else { return Ok(()) };
        if (LEAST_INTERVAL_US..=MOST_INTERVAL_US).contains(&median_us) || settled.scans.len() < 3 {
            return Ok(());
        }
        let read_as = if self.format == Format::Carmen { 1e6 } else { 1.0 };
        let units = [
            ("s", "seconds", 1e6),
            ("ms", "milliseconds", 1e3),
            ("us", "microseconds", 1.0),
            ("ns", "nanoseconds", 1e-3),
        ];
        let plausible = |us: f64| (10e3..5e6).contains(&us);
        let mend = units.iter().find(|(_, _, us)| plausible(median_us * us / read_as)).map_or_else(
            || "--stamps sets their unit".to_owned(),
            |(option, name, _)| format!("they seem to be {name}; pass --stamps {option}"),
        );
        let message = format!(
            "scans are {} ms apart (median of {}), which no scanner is, if the stamps are read as this format has them: {mend}",
            median_us * 1e-3,
            settled.scans.len()
        );
        if matches!(self.format, Format::Ros1 | Format::Mcap | Format::Db3) {
            self.warn("stamps_in_another_unit", message);
            return Ok(());
        }
        Err(self.suspect("stamps_in_another_unit", message))
    }
}
