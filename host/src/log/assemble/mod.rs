//! From records to a log: the same for all formats.
//!
//! In: what a reader found, in the order of the file. Out: scans and odometry with increasing stamps. Nothing is sorted into the
//! past: a reading whose stamp is not later than those before it is left out and counted. What the numbers themselves say
//! against the unit they are read in is an error that names the option to pass.

mod odometry;
mod order;
mod stamps;

use std::collections::HashMap;
use std::path::Path;

use slam_core::config::MOST_OF_A_TURN;

use super::records::{Records, ScanRecord};
use super::{Defect, Format, Log, LogError, ReadOptions, Warning, robot};

/// No scanner of a building sees this far half of the time, millimetres, …
const MOST_MEDIAN_MM: f64 = 200e3;
/// … nor as near as this; …
const LEAST_MEDIAN_MM: f64 = 10.0;
/// … in one room half of what is seen is farther than this.
const USUAL_MEDIAN_MM: f64 = 700.0;
/// Scans whose beams are not described may have this share of beams more or fewer than most.
const BEAMS_VARY: f64 = 0.1;

/// The number that occurs most often, the smallest of several; zero of none.
pub fn commonest(numbers: impl Iterator<Item = usize>) -> usize {
    let mut counts: HashMap<usize, usize> = HashMap::new();
    numbers.for_each(|n| *counts.entry(n).or_default() += 1);
    counts.into_iter().max_by_key(|(n, count)| (*count, std::cmp::Reverse(*n))).map_or(0, |(n, _)| n)
}

/// Settles units, beams, order and stamps.
pub fn log(
    path: &Path,
    format: Format,
    records: Records,
    options: &ReadOptions<'_>,
) -> Result<Log, LogError> {
    let Records { scans, odometry, geometries, wheels, distances, skipped, warnings, course } = records;
    let mut assembly = Assembly {
        path,
        format,
        options,
        log: Log {
            geometries,
            wheels,
            skipped,
            warnings,
            format: if course.is_some() { robot::FORMAT } else { format.name() },
            course,
            ..Log::default()
        },
    };
    let in_file = scans.len() + assembly.unreadable();
    if scans.is_empty() {
        let read = if in_file == 0 { "none was there".into() } else { assembly.reasons() };
        return Err(LogError::NoScan { path: path.to_owned(), read });
    }
    assembly.check_ranges(distances.median())?;
    let scans = assembly.settle_beams(scans)?;
    let settled = assembly.settle_stamps(scans)?;
    assembly.check_intervals(&settled)?;
    assembly.settle_odometry(odometry, &settled);
    let used = settled.scans.len();
    if 2 * used < in_file {
        let reasons = assembly.reasons();
        return Err(LogError::MostlyUnusable { path: path.to_owned(), used, all: in_file, reasons });
    }
    assembly.log.scans = settled.scans;
    Ok(assembly.log)
}

struct Assembly<'a> {
    path: &'a Path,
    format: Format,
    options: &'a ReadOptions<'a>,
    log: Log,
}

impl Assembly<'_> {
    fn skip(&mut self, reason: &'static str, records: usize) {
        if records > 0 {
            *self.log.skipped.entry(reason).or_default() += records;
        }
    }

    fn warn(&mut self, suspected: &'static str, message: String) {
        self.log.warnings.push(Warning::new(suspected, message));
    }

    fn suspect(&self, suspected: &'static str, message: String) -> LogError {
        LogError::Suspect { path: self.path.to_owned(), warning: Warning::new(suspected, message) }
    }

    /// Records that could not be read, most of which are scans.
    fn unreadable(&self) -> usize {
        let reasons = ["truncated", "too_long", "not_a_number", "malformed", "cut_off"];
        reasons.iter().filter_map(|reason| self.log.skipped.get(reason)).sum()
    }

    fn reasons(&self) -> String {
        let skipped: Vec<String> =
            self.log.skipped.iter().map(|(reason, n)| format!("{n} {reason}")).collect();
        if skipped.is_empty() {
            "nothing was skipped".into()
        } else {
            format!("skipped: {}", skipped.join(", "))
        }
    }

    /// A scan that cannot be used: an error, or skipped and counted.
    fn refuse(&mut self, place: usize, defect: Defect) -> Result<(), LogError> {
        if !self.options.lenient {
            let place = self.format.place(place);
            return Err(LogError::Record { path: self.path.to_owned(), place, defect });
        }
        self.skip(defect.reason(), 1);
        Ok(())
    }

    fn check_ranges(&mut self, median: Option<f64>) -> Result<(), LogError> {
        // Lines of the plain format each say their unit.
        let stated = self.options.ranges.is_some() || self.format == Format::Plain;
        let Some(median) = median.filter(|_| !stated) else { return Ok(()) };
        let median_mm = median * if self.format == Format::Mines { 1.0 } else { 1e3 };
        if median_mm > MOST_MEDIAN_MM {
            // The smaller of the units with which it is a distance in a building.
            let (suspected, unit, option) = if median > USUAL_MEDIAN_MM {
                ("ranges_in_millimetres", "millimetres", "mm")
            } else {
                ("ranges_in_centimetres", "centimetres", "cm")
            };
            let message = format!(
                "the median range is {:.0} m: the ranges seem to be in {unit}; pass --ranges {option}",
                median_mm * 1e-3
            );
            return Err(self.suspect(suspected, message));
        }
        if median_mm < LEAST_MEDIAN_MM {
            let message = format!(
                "the median range is {median_mm} mm: the ranges may be in another unit; --ranges sets it"
            );
            self.warn("ranges_in_another_unit", message);
        }
        Ok(())
    }

    /// Leaves out scans whose beams nobody can place.
    fn settle_beams(&mut self, scans: Vec<ScanRecord>) -> Result<Vec<ScanRecord>, LogError> {
        let most = commonest(scans.iter().map(|scan| scan.ranges_mm.len()));
        self.log.commonest_beams = most;
        let mut odd = 0;
        let mut kept = Vec::with_capacity(scans.len());
        for scan in scans {
            let actual = scan.ranges_mm.len();
            let expected = self.options.beams.unwrap_or(most);
            let fits = match self.options.beams {
                Some(beams) => actual == beams,
                None => (actual as f64 - most as f64).abs() <= BEAMS_VARY * most as f64,
            };
            if actual < 2 {
                // As some drivers send while the scanner starts.
                self.skip("empty", 1);
                continue;
            }
            if scan.geometry.is_none() && !fits {
                self.refuse(scan.place, Defect::BeamCount { expected, actual })?;
                continue;
            }
            let step_rad =
                scan.geometry.and_then(|g| self.log.geometries.get(g)).map_or(0.0, |g| g.step_rad.abs());
            let turns = step_rad * (actual - 1) as f32 / std::f32::consts::TAU;
            if turns > MOST_OF_A_TURN {
                let what =
                    format!("{actual} beams {}° apart go round {turns:.2} times", step_rad.to_degrees());
                self.refuse(scan.place, Defect::Malformed(what))?;
                continue;
            }
            odd += usize::from(actual != most);
            kept.push(scan);
        }
        if odd > 0 {
            let message = format!("{odd} scans have another number of beams than the {most} that most have");
            self.warn("beam_counts_vary", message);
        }
        Ok(kept)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_commonest_number_is_found() {
        assert_eq!(commonest([181, 180, 180].into_iter()), 180);
        assert_eq!(commonest(std::iter::empty()), 0);
    }
}
