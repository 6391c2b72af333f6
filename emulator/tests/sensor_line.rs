//! The sensor's line and its clock: noise, bytes lost, bit rates, quirks, on the emulated board.

mod common;

use common::{hall, last_error_m, nothing_lost, robot, says, scans};
use emulator::record::Event;
use emulator::report::{Judged, first_difference};
use emulator::run::Outcome;
use scip::sim::Quirks;

/// From a scan's middle beam to its first byte, and what its bytes take at 250 kbit/s, microseconds.
const BEFORE_BYTES_US: u64 = 36_300;
const BYTES_US: u64 = 85_500;

/// The last line of the status that begins so.
fn status<'a>(outcome: &'a Outcome, beginning: &str) -> &'a str {
    let line = outcome.log.iter().rev().find(|line| line.text.starts_with(beginning));
    &line.expect("the firmware says its status").text
}

/// A number of the line's status, by the word before it.
fn counted(outcome: &Outcome, word: &str) -> i64 {
    let (_, rest) = status(outcome, "line: ").split_once(&format!("{word} ")).expect("the word");
    let number = rest.split([',', ';', ' ']).next().expect("a number");
    number.parse().expect("a number")
}

/// Scans that were sent and not used, after the first that was and before the last few.
fn unused(outcome: &Outcome) -> Vec<u64> {
    let used: Vec<&Vec<u16>> = outcome
        .entries
        .iter()
        .filter_map(|entry| match &entry.event {
            Event::Scan { ranges_mm, .. } => Some(ranges_mm),
            _ => None,
        })
        .collect();
    let sent = outcome.scans.iter().skip_while(|scan| !used.contains(&&scan.ranges_mm));
    let sent: Vec<_> = sent.collect();
    let but_the_last = sent.len().saturating_sub(2);
    let lost = sent[..but_the_last].iter().filter(|scan| !used.contains(&&scan.ranges_mm));
    lost.map(|scan| scan.middle_us).collect()
}

/// Whether bytes of the scan whose middle beam was taken then were on the line in that time.
fn was_on_the_line(middle_us: u64, at_us: u64, for_us: u64) -> bool {
    // The instants of faults are a millisecond coarse.
    let (begin, end) = (middle_us + BEFORE_BYTES_US - 2_000, middle_us + BEFORE_BYTES_US + BYTES_US + 2_000);
    begin < at_us + for_us && at_us < end
}

/// Everything else than the line is as ever.
fn is_well(outcome: &Outcome, judged: &Judged) {
    assert_eq!(outcome.resets, []);
    assert!(!says(outcome, "ERROR", ""));
    assert!(last_error_m(judged) < 0.20, "{}", last_error_m(judged));
    assert_eq!(first_difference(&outcome.entries, &robot()).unwrap(), None);
}

#[test]
fn noise_on_bytes_that_are_right_costs_no_scan() {
    // As the port is set up, it raises no flag.
    let (outcome, judged) = hall(Some(20), &["noise=1000"]);
    assert_eq!(unused(&outcome), [] as [u64; 0]);
    assert!(nothing_lost(&outcome));
    assert_eq!(counted(&outcome, "noise"), 0);
    is_well(&outcome, &judged);
    // On start bits it raises one all the same: here on every byte that is hit.
    let (outcome, judged) = hall(Some(40), &["start-noise=1000"]);
    assert_eq!(unused(&outcome), [] as [u64; 0]);
    assert!(nothing_lost(&outcome));
    // 2137 bytes ten times a second.
    let expected = 21.37 * judged.report.scans_used as f64 / 10.0;
    let noise = counted(&outcome, "noise") as f64;
    println!("noise counted {noise}, expected {expected}");
    assert!((0.8..1.2).contains(&(noise / expected)), "{noise} of {expected}");
    is_well(&outcome, &judged);
}

#[test]
fn dma_that_is_held_up_costs_the_scans_it_hits() {
    let faults = [(15_000_000, 20_000), (20_030_000, 60_000), (25_050_000, 300_000)];
    let named: Vec<String> = faults.iter().map(|(at, long)| held("dma-held", *at, *long)).collect();
    let (outcome, judged) = hall(Some(35), &named.iter().map(String::as_str).collect::<Vec<_>>());
    costs_only_what_is_hit(&outcome, &faults, 0);
    assert!(counted(&outcome, "overruns") >= 3, "{}", status(&outcome, "line: "));
    is_well(&outcome, &judged);
}

#[test]
fn a_core_that_is_held_up_costs_the_scans_it_hits() {
    let faults = [(15_000_000, 20_000), (20_030_000, 60_000), (25_050_000, 300_000)];
    let named: Vec<String> = faults.iter().map(|(at, long)| held("held", *at, *long)).collect();
    let (outcome, judged) = hall(Some(35), &named.iter().map(String::as_str).collect::<Vec<_>>());
    // The time driver counts periods of 65.5 ms by interrupts: after 300 ms without, the firmware's own clock is behind. That looks
    // like a sensor's clock that was set, and may cost two scans more.
    costs_only_what_is_hit(&outcome, &faults, 2);
    assert!(counted(&outcome, "overruns") >= 2, "{}", status(&outcome, "line: "));
    is_well(&outcome, &judged);
}

fn held(name: &str, at_us: u64, for_us: u64) -> String {
    format!("{name}@{}+{}", at_us as f64 * 1e-6, for_us as f64 * 1e-6)
}

/// Each scan that was not used was on the line in one of those times, but for so many whose stamps were doubted after the last; some
/// were.
fn costs_only_what_is_hit(outcome: &Outcome, faults: &[(u64, u64)], doubted: usize) {
    let lost = unused(outcome);
    println!("{} scans lost: {lost:?}", lost.len());
    println!("{}", status(outcome, "line: "));
    let is_hit = |us: u64| faults.iter().any(|(at, long)| was_on_the_line(us, *at, *long));
    let not_hit: Vec<u64> = lost.iter().copied().filter(|us| !is_hit(*us)).collect();
    assert!(not_hit.len() <= doubted && not_hit.len() as i64 <= counted(outcome, "doubted"), "{not_hit:?}");
    let last_us = faults.last().map_or(0, |(at, long)| at + long);
    let after = last_us - 100_000..last_us + 400_000;
    assert!(not_hit.iter().all(|us| after.contains(us)), "{not_hit:?}");
    assert!(lost.len() > not_hit.len());
    assert!(says(outcome, "WARN", "missed"));
}

#[test]
fn a_framing_error_costs_the_scan_it_hits() {
    let (outcome, judged) = hall(Some(40), &["line=20"]);
    let (framing, lost) = (counted(&outcome, "framing"), unused(&outcome).len() as i64);
    println!("{framing} framing errors, {lost} scans lost; {}", status(&outcome, "line: "));
    // Of noise, whose bytes are flipped here too, there is as much.
    assert!(framing >= 4 && lost <= 2 * framing + 10, "{framing} {lost}");
    assert!(lost > 0);
    is_well(&outcome, &judged);
}

#[test]
fn a_line_that_is_not_good_for_the_bit_rate_is_used_at_a_lower_one() {
    let (outcome, judged) = hall(Some(45), &["good-to=115200"]);
    assert!(says(&outcome, "WARN", "250000 bit/s fails; from now on 115200"));
    assert_eq!(counted(&outcome, "line:"), 115_200);
    // Every second scan from then on. Where the map begins nobody can say: by then the base has driven off.
    let used = judged.report.scans_used;
    assert!(used > 80, "{used}");
    let periods: Vec<u64> = scans(&outcome.entries).map(|e| e.read_us).collect();
    let slow = periods.windows(2).filter(|pair| pair[1] - pair[0] > 150_000).count();
    assert!(slow + 3 >= used - 1, "{slow} of {used}");
    assert_eq!(outcome.resets, []);
    assert_eq!(first_difference(&outcome.entries, &robot()).unwrap(), None);
}

#[test]
fn every_quirk_of_a_sensor_is_taken() {
    for (name, _) in Quirks::EACH {
        let (outcome, judged) = hall(Some(9), &[&format!("quirk={name}")]);
        assert!(judged.report.scans_used > 45, "{name}: {}", judged.report.scans_used);
        assert!(nothing_lost(&outcome), "{name}");
        assert!(says(&outcome, "INFO", "682 beams, 250000 bit/s"), "{name}");
        is_well(&outcome, &judged);
    }
}

#[test]
fn a_sensor_s_clock_that_is_set_costs_two_scans_at_most() {
    for by_ms in [-600_000, 600_000, -40, 40] {
        let (outcome, judged) = hall(Some(30), &[&format!("clock@20={by_ms}")]);
        assert!(says(&outcome, "WARN", "the sensor's clock was set"), "{by_ms}");
        let lost = unused(&outcome);
        assert!(lost.len() <= 2 && lost.len() as i64 <= counted(&outcome, "doubted"), "{by_ms}: {lost:?}");
        stamps_are_right(&outcome);
        is_well(&outcome, &judged);
    }
}

#[test]
fn a_clock_that_is_one_per_cent_off_and_a_slow_motor_are_measured() {
    for (skew, slow) in [(10_000, 0), (-10_000, 0), (0, 30_000)] {
        let (outcome, judged) = hall(Some(40), &[&format!("skew={skew}"), &format!("slow={slow}")]);
        assert!(nothing_lost(&outcome));
        stamps_are_right(&outcome);
        assert!((counted(&outcome, "clock") + skew).abs() < 300, "{}", status(&outcome, "line: "));
        for entry in scans(&outcome.entries).skip(40) {
            let Event::Scan { revolution_us, .. } = entry.event else { continue };
            let truth_us = 100_000 + slow / 10;
            assert!((i64::from(revolution_us) - truth_us).abs() < 250, "{revolution_us}");
        }
        is_well(&outcome, &judged);
    }
}

/// Each scan's middle beam is where it was taken, within 10 ms, but for the first two seconds of scans, and in order.
fn stamps_are_right(outcome: &Outcome) {
    let mut last_us = 0;
    let mut compared = 0;
    for entry in scans(&outcome.entries).skip(20) {
        let Event::Scan { middle_us, ranges_mm, .. } = &entry.event else { continue };
        assert!(*middle_us > last_us);
        last_us = *middle_us;
        let near = |us: u64| us.abs_diff(*middle_us) < 200_000;
        let sent = outcome.scans.iter().find(|scan| near(scan.middle_us) && scan.ranges_mm == *ranges_mm);
        let sent = sent.expect("a scan that was sent, within 0.2 s of its stamp");
        let off_us = sent.middle_us.abs_diff(*middle_us);
        assert!(off_us < 45_000, "{off_us} us off at {middle_us}");
        compared += usize::from(off_us < 10_000);
    }
    assert!(compared + 3 >= scans(&outcome.entries).skip(20).count(), "{compared}");
}
