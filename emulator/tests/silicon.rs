//! What silicon does and a kind emulation does not: clocks, supply, probe, watchdog. `docs/silicon.md` has the table.

mod common;

use common::{hall, last_error_m, nothing_lost, robot, run_in, says, scans};
use emulator::record::Event;
use emulator::report::first_difference;
use emulator::run::Outcome;

/// The number before which a line of the log has this text, in the last such line.
fn said_last(outcome: &Outcome, before: &str) -> Option<u32> {
    outcome.log.iter().rev().find_map(|line| {
        let (_, rest) = line.text.split_once(before)?;
        let digits = rest.split(|c: char| !c.is_ascii_digit()).next()?;
        digits.parse().ok()
    })
}

fn resets(outcome: &Outcome) -> Vec<&str> {
    outcome.resets.iter().map(|(_, cause)| cause.as_str()).collect()
}

#[test]
fn a_clock_that_never_comes_is_done_without() {
    let (outcome, judged) = hall(Some(30), &["hse-dead"]);
    assert_eq!(resets(&outcome), [""; 0]);
    assert!(says(&outcome, "INFO", "clock: 180 MHz from the part's own oscillator"));
    assert!(says(&outcome, "WARN", "the ST-LINK's clock does not come"));
    assert!(says(&outcome, "WARN", "off by 1 %"));
    assert!(judged.report.scans_used > 200, "{}", judged.report.scans_used);
    assert!(nothing_lost(&outcome));
    assert!(last_error_m(&judged) < 0.20, "{}", last_error_m(&judged));
    // It was waited for 100 ms, and no longer.
    let banner_us: f64 = outcome.log[0].stamp.parse().expect("a time stamp");
    assert!(banner_us < 0.1, "{}", outcome.log[0]);
    let (with_it, _) = hall(Some(10), &[]);
    assert!(says(&with_it, "INFO", "clock: 180 MHz from the ST-LINK's 8 MHz"));
    assert!(!says(&with_it, "WARN", "clock"));
    // The watchdog and the timers stand while a debugger holds the core: IWDG, WWDG, TIM2 to TIM4.
    assert_eq!(with_it.frozen, 1 << 12 | 1 << 11 | 0b111);
}

#[test]
fn a_clock_that_dies_in_mid_drive_is_replaced_and_the_map_is_kept() {
    let (outcome, judged) = hall(Some(45), &["hse-dies@20.037"]);
    assert_eq!(resets(&outcome), ["Core"]);
    assert!(says(&outcome, "ERROR", "the last run lost the ST-LINK's clock"));
    assert!(says(&outcome, "WARN", "the ST-LINK's clock stopped 1 times since power-up"));
    assert!(says(&outcome, "INFO", "clock: 180 MHz from the part's own oscillator"));
    assert!(says(&outcome, "INFO", "is kept"));
    assert_eq!(said_last(&outcome, "clock lost "), Some(1));
    assert!(last_error_m(&judged) < 0.20, "{}", last_error_m(&judged));
}

/// Has the firmware hang after 20 s, and sees that the watchdog resets it and that its log says so.
fn hang(order: u32, words: &str) -> Outcome {
    let (outcome, judged) = run_in("misbehaves", Some(32), &[&format!("order@20={order}")]);
    assert_eq!(outcome.resets.len(), 1, "{words}: {:?}", outcome.resets);
    let (at_us, cause) = &outcome.resets[0];
    assert!(cause.contains("IWDG"), "{words}: {cause}");
    // Fed up to 0.1 s before; then 3 s.
    assert!((22_800_000..23_300_000).contains(at_us), "{words}: {at_us}");
    assert!(says(&outcome, "INFO", "reset by Watchdog"), "{words}");
    assert!(says(&outcome, "ERROR", words), "{words}");
    assert!(says(&outcome, "INFO", "is kept"), "{words}");
    assert_eq!(said_last(&outcome, "since power-up: watchdog "), Some(1), "{words}");
    // Where nobody read the encoders, three seconds of driving are not known: the pose is off by them.
    let counted = ![1, 5].contains(&order);
    assert!(!counted || last_error_m(&judged) < 0.25, "{words}: {}", last_error_m(&judged));
    outcome
}

#[test]
fn each_task_that_hangs_is_reset_and_named() {
    for (order, task) in [(1, "encoders"), (2, "lidar"), (3, "mapping"), (4, "link")] {
        let outcome = hang(order, &format!("no word from the task {task}"));
        assert_eq!(
            outcome.log.iter().filter(|line| line.text.contains("the last run hung")).count(),
            1,
            "{task}"
        );
    }
}

#[test]
fn an_executor_that_is_stuck_is_reset_and_named() {
    hang(5, "the last run hung: the urgent executor is stuck");
    hang(6, "the last run hung: thread mode is stuck");
}

#[test]
fn a_probe_that_goes_away_stops_nothing_and_what_it_missed_is_counted() {
    let (outcome, judged) = hall(Some(50), &["probe-gone@15+20"]);
    assert_eq!(resets(&outcome), [""; 0]);
    // Not a scan is lost or late.
    assert!(nothing_lost(&outcome));
    assert!(judged.report.scans_sent - judged.report.scans_used <= 1);
    let mut times = scans(&outcome.entries).map(|e| e.read_us).collect::<Vec<_>>();
    times.dedup();
    let longest_us = times.windows(2).map(|pair| pair[1] - pair[0]).max();
    assert!(longest_us < Some(110_000), "{longest_us:?}");
    assert_eq!(first_difference(&outcome.entries, &robot()).unwrap(), None);
    // The status says how many lines are missing beside an undisturbed run.
    let (undisturbed, _) = hall(Some(50), &[]);
    let lost = said_last(&outcome, "log frames lost ").expect("the status says how many");
    let lines = |outcome: &Outcome| outcome.log.iter().rposition(|line| line.text.starts_with("health: "));
    let missing = lines(&undisturbed).unwrap() - lines(&outcome).unwrap();
    assert!(lost >= 5 && lost as usize == missing, "{lost} {missing}");
    assert_eq!(said_last(&undisturbed, "log frames lost "), Some(0));
    // It comes back, and reads whole frames from then on.
    let seconds = |line: &emulator::firmware::LogLine| line.stamp.parse::<f64>().unwrap_or(f64::NAN);
    let status = |from: f64, to: f64| {
        outcome
            .log
            .iter()
            .filter(|l| l.text.starts_with("health: ") && (from..to).contains(&seconds(l)))
            .count()
    };
    assert_eq!(status(36.0, 46.0), 10);
    assert!(status(15.0, 35.0) < 20);
}

#[test]
fn a_log_call_that_panics_or_faults_does_not_recurse_and_its_words_come_out() {
    for (order, words) in [(7, "the last run panicked, at line"), (8, "the last run faulted, at 0x")] {
        let (outcome, judged) = run_in("misbehaves", Some(36), &[&format!("order@20={order}")]);
        assert_eq!(resets(&outcome), ["Core"], "{words}");
        assert!(outcome.resets[0].0 < 20_200_000, "{:?}", outcome.resets);
        assert!(says(&outcome, "ERROR", words), "{words}");
        assert!(order != 7 || says(&outcome, "ERROR", "of src/orders.rs"));
        assert!(says(&outcome, "INFO", "is kept"), "{words}");
        assert_eq!(said_last(&outcome, "failures "), Some(1), "{words}");
        assert!(last_error_m(&judged) < 0.20, "{words}: {}", last_error_m(&judged));
    }
}

#[test]
fn ram_that_had_no_power_is_not_believed() {
    // Even where not a bit has changed and the seal fits.
    for permille in [0, 2, 50, 500] {
        let (outcome, _) = hall(Some(40), &[&format!("power@20={permille}")]);
        assert_eq!(outcome.resets.len(), 1, "{permille}: {:?}", outcome.resets);
        assert!(says(&outcome, "INFO", "reset by Power"), "{permille}");
        assert!(says(&outcome, "INFO", "a new map begins; kept memory: PowerWasAway"), "{permille}");
        assert!(!says(&outcome, "INFO", "is kept"), "{permille}");
        assert!(!says(&outcome, "ERROR", ""), "{permille}");
        let after = scans(&outcome.entries).filter(|e| e.read_us > 26_000_000).count();
        assert!(after > 100, "{permille}: {after} scans");
        assert_eq!(said_last(&outcome, "since power-up: watchdog "), Some(0), "{permille}");
    }
}

#[test]
fn a_kept_map_that_fails_early_three_times_is_given_up() {
    let (outcome, _) = run_in("misbehaves", Some(50), &["order@19=9", "reset@20"]);
    assert_eq!(resets(&outcome), ["Pin", "Core", "Core", "Core"]);
    assert!(says(&outcome, "ERROR", "failed early 3 times running: the kept map is given up"));
    assert!(says(&outcome, "INFO", "a new map begins; kept memory: GivenUp"));
    let kept = outcome.log.iter().filter(|line| line.text.contains("is kept")).count();
    assert_eq!(kept, 3);
    let after = scans(&outcome.entries).filter(|e| e.read_us > 38_000_000).count();
    assert!(after > 80, "{after} scans");
}

#[test]
fn failures_that_come_late_do_not_cost_the_map() {
    let (outcome, _) =
        run_in("misbehaves", Some(76), &["order@16=7", "order@32=7", "order@48=7", "order@64=7"]);
    assert_eq!(resets(&outcome), ["Core"; 4]);
    assert!(!says(&outcome, "ERROR", "given up"));
    assert_eq!(said_last(&outcome, "failures "), Some(4));
}

#[test]
fn the_button_held_for_three_seconds_has_the_map_forgotten() {
    let (outcome, _) = hall(Some(40), &["hold@20+4"]);
    assert!(says(&outcome, "WARN", "the map is forgotten, as the button asks"));
    let at = outcome.entries.iter().position(|e| e.event == Event::Forgotten).expect("the record says so");
    assert!(
        (22_950_000..23_200_000).contains(&outcome.entries[at].read_us),
        "{}",
        outcome.entries[at].read_us
    );
    assert!(outcome.entries[at - 1].segments > 3);
    assert_eq!(outcome.entries[at].segments, 0);
    assert!(outcome.entries.last().unwrap().segments > 3);
    // The PC does the same.
    assert_eq!(first_difference(&outcome.entries, &robot()).unwrap(), None);
    // A press that is not long enough prints, and forgets nothing.
    let (outcome, _) = hall(Some(30), &["hold@20+2.5"]);
    assert!(!says(&outcome, "WARN", "the map is forgotten"));
    assert_eq!(outcome.log.iter().filter(|line| line.text == "end of map").count(), 2);
}

#[test]
fn a_supply_that_falls_leaves_the_map_sealed_until_it_is_well() {
    let (outcome, judged) = hall(Some(35), &["sag@20+0.5"]);
    assert_eq!(resets(&outcome), [""; 0]);
    assert!(says(&outcome, "WARN", "the supply is low; the map is left as it is"));
    assert!(says(&outcome, "INFO", "the supply is well again"));
    assert_eq!(said_last(&outcome, "supply dips "), Some(1));
    let during = outcome.entries.iter().filter(|e| (20_005_000..20_500_000).contains(&e.read_us)).count();
    assert_eq!(during, 0);
    assert!(last_error_m(&judged) < 0.20, "{}", last_error_m(&judged));
}

#[test]
fn pulses_shorter_than_the_filter_do_not_count() {
    let left_ticks = |faults: &[&str]| {
        let (outcome, _) = hall(Some(40), faults);
        outcome.entries.iter().flat_map(|e| &e.samples).map(|s| s.left).max().expect("the robot drives")
    };
    let undisturbed = left_ticks(&[]);
    assert!(undisturbed > 10_000, "{undisturbed}");
    let (short, long) = (left_ticks(&["glitch=2000"]), left_ticks(&["glitch=20000"]));
    assert!((short - undisturbed).abs() <= 2, "{short} {undisturbed}");
    // The test can fail: a pulse that the filter lets through costs four ticks.
    assert!((long - undisturbed).abs() > 1000, "{long} {undisturbed}");
}

#[test]
fn the_firmware_measures_what_a_scan_takes() {
    let (outcome, judged) = hall(Some(30), &[]);
    let median = said_last(&outcome, "health: scan ").expect("the status says it");
    let most = said_last(&outcome, "cycles at the median, ").expect("the status says it");
    // The record has the same by another clock, in microseconds at 180 MHz.
    let [by_timer, _, _] = judged.report.update_us.map(|us| us * 180);
    assert!(median <= most && (by_timer / 2..by_timer * 2).contains(&median), "{median} {most} {by_timer}");
    let urgent = said_last(&outcome, "urgent executor ").expect("the status says it");
    assert!((1..200).contains(&urgent), "{urgent} permille");
}
