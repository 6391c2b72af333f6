//! The firmware on the emulated board: the very ELF that is flashed, in the hall.

mod common;

use common::{hall, hall_in_cycles, last_error_m, nothing_lost, robot, run_in, says, scans};
use emulator::board::check_assumed_cycles;
use emulator::record::Event;
use emulator::report::first_difference;
use emulator::vcp::scan_poses;
use slam_core::tracking::TrackingState;

#[test]
fn the_hall_is_mapped_every_scan_used_and_the_watchdog_quiet() {
    let (outcome, judged) = hall(None, &[]);
    let report = &judged.report;
    println!("{report:#?}");
    assert!(outcome.arrived);
    assert!(report.corner_error_m.is_some_and(|e| e <= 0.070), "{:?}", report.corner_error_m);
    assert!(report.corners_found * 2 >= report.corners);
    assert!(report.worst_position_error_m < 0.30);
    // The one that is on its way at the end.
    assert!(report.scans_sent - report.scans_used <= 1, "{} of {}", report.scans_used, report.scans_sent);
    assert!(nothing_lost(&outcome));
    assert!(!says(&outcome, "WARN", "dropped") && !says(&outcome, "ERROR", ""));
    assert_eq!(outcome.resets, []);
    // A poll of the counters each 5 ms has seen them wrap.
    let ticks = outcome.entries.iter().flat_map(|e| &e.samples).map(|s| s.left).max();
    assert!(ticks.is_some_and(|t| t > 3 * 65_536), "{ticks:?}");
    // The virtual COM port has a pose for each scan, without anyone having asked.
    let poses = scan_poses(&outcome.vcp).len();
    assert!(poses + 1 >= report.scans_used, "{poses} of {}", report.scans_used);
    assert!(outcome.led_changes > 100);
    assert!(outcome.flash_accelerated);
    // Variables and stack, of the executor in thread mode with all interrupts on top.
    let [stack, thread, urgent] = report.stack_bytes;
    assert!(thread > 2000 && urgent > 200, "{thread} {urgent}");
    assert!((thread..=thread + urgent + 1024).contains(&stack), "{stack} {thread} {urgent}");
    let bytes = report.static_bytes + u64::from(stack);
    assert!(bytes <= 190 * 1024, "{bytes} bytes of RAM");
}

#[test]
fn the_board_and_the_pc_agree_bit_for_bit_over_sixty_seconds() {
    let (outcome, judged) = hall(Some(60), &[]);
    assert!(judged.report.scans_used > 560, "{}", judged.report.scans_used);
    // The firmware stamps its scans within a millisecond or two; it does not know, and says how unsure it is.
    let [delay_s, sigma_s] = judged.report.estimated_delay_s.expect("the status says the delay");
    assert!(sigma_s > 0.0 && delay_s.abs() <= 3.0 * sigma_s, "{delay_s} {sigma_s}");
    assert_eq!(first_difference(&outcome.entries, &robot()).unwrap(), None);
    // The comparison can fail: one range changed by a millimetre is noticed.
    let mut entries = outcome.entries;
    let changed = entries.iter_mut().rev().nth(20).unwrap();
    if let Event::Scan { ranges_mm, .. } = &mut changed.event {
        ranges_mm.iter_mut().for_each(|r| *r += 1);
    }
    assert!(first_difference(&entries, &robot()).unwrap().is_some());
    // And so is a state that is another, though the pose is the same.
    let (number, state) = (entries.len() - 30, TrackingState::Lost);
    entries[number].state = state;
    let difference = first_difference(&entries, &robot()).unwrap().unwrap();
    assert_eq!((difference.entry, difference.here, difference.states[1]), (number, difference.board, state));
}

#[test]
fn a_core_that_takes_its_time_does_the_same_in_the_time_that_is_assumed() {
    let (outcome, judged) = hall_in_cycles(Some(20));
    assert!(judged.report.scans_used > 160, "{}", judged.report.scans_used);
    assert_eq!(first_difference(&outcome.entries, &robot()).unwrap(), None);
    assert!(nothing_lost(&outcome));
    check_assumed_cycles(outcome.cycles_per_instruction).unwrap();
}

#[test]
fn a_sensor_unplugged_for_five_seconds_is_bridged_by_odometry() {
    let (outcome, judged) = hall(Some(45), &["unplug@20+5"]);
    assert!(says(&outcome, "WARN", "going on by odometry"));
    assert!(says(&outcome, "INFO", "scans again"));
    assert_eq!(outcome.resets, []);
    assert!(
        outcome.entries.iter().any(|e| matches!(e.event, Event::Coasted { .. }) && e.read_us > 20_000_000)
    );
    let gap = scans(&outcome.entries).filter(|e| (22_000_000..24_000_000).contains(&e.read_us)).count();
    assert_eq!(gap, 0);
    assert!(last_error_m(&judged) < 0.20, "{}", last_error_m(&judged));
    assert_eq!(first_difference(&outcome.entries, &robot()).unwrap(), None);
}

#[test]
fn one_garbled_byte_in_ten_thousand_costs_scans_but_not_the_pose() {
    let (outcome, judged) = hall(Some(60), &["garble=10000"]);
    assert!(says(&outcome, "WARN", "a scan was dropped"));
    let share = judged.report.scans_used as f64 / judged.report.scans_sent as f64;
    assert!((0.6..0.95).contains(&share), "{share}");
    assert!(judged.report.worst_position_error_m < 0.20, "{}", judged.report.worst_position_error_m);
    assert_eq!(outcome.resets, []);
}

#[test]
fn noise_and_framing_errors_on_the_line_are_counted_and_survived() {
    let (outcome, judged) = hall(Some(60), &["line=30"]);
    let counted = outcome.log.iter().rev().find_map(|line| {
        let (_, rest) = line.text.split_once("port errors ")?;
        rest.split(',').next()?.parse::<u32>().ok()
    });
    assert!(counted.is_some_and(|n| n > 10), "{counted:?}");
    assert!(judged.report.scans_used * 2 > judged.report.scans_sent);
    assert!(judged.report.worst_position_error_m < 0.20, "{}", judged.report.worst_position_error_m);
    assert_eq!(outcome.resets, []);
}

#[test]
fn a_sensor_that_streams_at_another_bit_rate_is_taken_over() {
    let (outcome, judged) = hall(Some(30), &["streaming=750000"]);
    assert!(says(&outcome, "INFO", "250000 bit/s"));
    assert!(judged.report.scans_used > 200);
    assert!(last_error_m(&judged) < 0.20, "{}", last_error_m(&judged));
}

#[test]
fn a_reset_by_pin_while_driving_keeps_map_and_pose() {
    let mut half_done = 0;
    // Over one period of the scans: in the middle of the work on one, which takes some 4 ms and is read up to 1 ms after its end, and
    // between two of them.
    let (undisturbed, _) = hall(Some(26), &[]);
    let read_us = scans(&undisturbed.entries).map(|e| e.read_us).find(|us| *us >= 25_000_000).unwrap();
    for at in [0.0, 0.02, 0.04, 0.06, 0.08].map(|later_s| (read_us - 2_500) as f64 * 1e-6 + later_s) {
        let (outcome, judged) = hall(Some(40), &[&format!("reset@{at:.4}")]);
        assert_eq!(outcome.resets.len(), 1, "{at}");
        assert!(says(&outcome, "INFO", "reset by Pin"), "{at}");
        assert!(says(&outcome, "INFO", "is kept"), "{at}");
        let recovered = outcome.entries.iter().any(|e| e.event == Event::Recovered);
        let resumed = outcome.entries.iter().any(|e| e.event == Event::Resumed);
        assert!(recovered != resumed, "{at}");
        half_done += usize::from(recovered);
        assert!(last_error_m(&judged) < 0.20, "{at}: {}", last_error_m(&judged));
        assert!(
            judged.report.worst_position_error_m < 0.30,
            "{at}: {}",
            judged.report.worst_position_error_m
        );
        // The map goes on where it was.
        let before = outcome.entries.iter().rev().find(|e| (e.read_us as f64) < at * 1e6).unwrap().segments;
        assert!(outcome.entries.last().unwrap().segments + 5 >= before, "{at}");
        assert_eq!(first_difference(&outcome.entries, &robot()).unwrap(), None, "{at}");
    }
    assert!((1..5).contains(&half_done), "{half_done} of 5 in the middle of the work");
}

#[test]
fn stamps_of_the_sensor_wrap_without_notice() {
    let (outcome, judged) = hall(Some(40), &["stamp-wrap"]);
    assert!(nothing_lost(&outcome));
    assert!(judged.report.worst_position_error_m < 0.20, "{}", judged.report.worst_position_error_m);
    assert!(judged.report.scans_sent - judged.report.scans_used <= 1);
}

/// The timer's model raises compare flags where the silicon does not; the board undoes it. Without, alarms come up to a
/// counter period late.
#[test]
fn a_thousand_sleeps_of_odd_lengths_end_in_time() {
    let (outcome, _) = run_in("sleeps", Some(226), &[]);
    let said =
        outcome.log.iter().find(|l| l.text.starts_with("slept ")).expect("the firmware says how it slept");
    // slept 1000 times; woke at the latest 3 us after the end
    let words: Vec<&str> = said.text.split(' ').collect();
    assert_eq!(words[1], "1000");
    let latest_us: u64 = words[7].parse().unwrap();
    // A tick of a microsecond, and the instructions from the alarm to the task.
    assert!(latest_us <= 4, "{}", said.text);
    // Later it panics: it says where, is reset, and says so again.
    assert!(says(&outcome, "ERROR", "panic at src/start.rs:"));
    assert!(says(&outcome, "INFO", "reset by Software"));
    assert!(says(&outcome, "ERROR", "the last run panicked, at line"));
}

#[test]
fn an_hour_passes_without_a_trace() {
    let (outcome, judged) = hall(Some(3600), &["stamp-wrap"]);
    let report = &judged.report;
    assert!(outcome.arrived && report.virtual_s >= 3600.0);
    assert!(report.scans_used > 35_950, "{}", report.scans_used);
    assert!(report.scans_sent - report.scans_used <= 1);
    assert_eq!(outcome.resets, []);
    assert!(last_error_m(&judged) < 0.20, "{}", last_error_m(&judged));
    assert!(nothing_lost(&outcome));
}
