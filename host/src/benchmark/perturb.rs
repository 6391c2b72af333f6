//! A log with a little more noise on its ranges: what a figure owes to chance shows in how far it moves.

use slam_core::sensor::scan::{RangeCodes, Reading};

use crate::log::Log;
use crate::robot::Robot;
use crate::sim::streams::{Stream, gauss, stream};

/// The log with Gaussian noise of `sigma_m` on every range that is a distance to this robot's scanner, rounded to
/// millimetres. Codes, and values out of the scanner's limits, stay as they are, and no distance becomes one of them.
pub fn perturbed(log: &Log, robot: &Robot, sigma_m: f64, seed: u64) -> Log {
    let mut noise = stream(seed, Stream::Scanner);
    let mut log = log.clone();
    for k in 0..log.scans.len() {
        let codes = robot.sensor_for(&log.layout(k)).codes;
        for range_mm in &mut log.scans[k].ranges_mm {
            if is_distance(&codes, *range_mm) {
                *range_mm = moved(&codes, *range_mm, 1e3 * sigma_m * gauss(&mut noise));
            }
        }
    }
    log
}

fn is_distance(codes: &RangeCodes, range_mm: u16) -> bool {
    matches!(codes.read(range_mm), Reading::Range(_))
}

fn moved(codes: &RangeCodes, range_mm: u16, by_mm: f64) -> u16 {
    // The cast saturates.
    let there = (f64::from(range_mm) + by_mm).round() as u16;
    let there = there.clamp(codes.min_mm, codes.max_mm);
    if is_distance(codes, there) { there } else { range_mm }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::log::LoggedScan;

    /// Two codes, two values out of the limits, then distances.
    fn log() -> Log {
        let ranges_mm: Vec<u16> = [0, 6, 19, 5601].into_iter().chain([2000; 678]).collect();
        let scan = |k: u64| LoggedScan {
            line: 1,
            stamp_us: 100_000 * k,
            ranges_mm: ranges_mm.clone(),
            geometry: None,
        };
        Log { scans: (1..=20).map(scan).collect(), ..Log::default() }
    }

    fn ranges(log: &Log) -> Vec<&[u16]> {
        log.scans.iter().map(|scan| scan.ranges_mm.as_slice()).collect()
    }

    #[test]
    fn noise_is_that_of_the_seed_and_of_the_sigma_and_codes_stay() {
        let (log, robot) = (log(), Robot::usual_for("mines"));
        let noisy = perturbed(&log, &robot, 0.005, 1);
        assert_eq!(ranges(&noisy), ranges(&perturbed(&log, &robot, 0.005, 1)));
        assert_ne!(ranges(&noisy), ranges(&perturbed(&log, &robot, 0.005, 2)));
        assert_eq!(ranges(&perturbed(&log, &robot, 0.0, 1)), ranges(&log));
        assert!(noisy.scans.iter().all(|scan| scan.ranges_mm[..4] == [0, 6, 19, 5601]));
        let off: Vec<f64> =
            noisy.scans.iter().flat_map(|s| &s.ranges_mm[4..]).map(|r| f64::from(*r) - 2000.0).collect();
        let mean = off.iter().sum::<f64>() / off.len() as f64;
        let sigma = (off.iter().map(|d| d * d).sum::<f64>() / off.len() as f64).sqrt();
        assert!(mean.abs() < 0.15 && (sigma - 5.0).abs() < 0.15, "{mean} ± {sigma} mm");
    }

    #[test]
    fn no_distance_becomes_a_code() {
        let codes = RangeCodes { no_echo_mm: [(0, 0), (2003, 2003)], ..RangeCodes::URG_04LX };
        for (range_mm, by_mm, there) in
            [(21, -9.0, 20), (5599, 9.0, 5600), (2000, 3.0, 2000), (2000, 4.4, 2004), (21, -99.0, 20)]
        {
            assert_eq!(moved(&codes, range_mm, by_mm), there, "{range_mm} {by_mm}");
        }
    }
}
