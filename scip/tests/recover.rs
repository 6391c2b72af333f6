//! What the driver does when the sensor, the line or the caller fails, on a simulated clock.

mod world;

use std::future::Future;
use std::pin::pin;
use std::task::{Context, Poll, Waker};

use scip::sim::{BEAMS, Faults, Mode, SimulatedUrg};
use scip::{Client, ClientConfig, ClientError, Status};
use world::{LineError, Port, Tape, World, measure};

type UrgClient = Client<Port<SimulatedUrg>, World<SimulatedUrg>>;

/// No call lasts longer: a connection, the longest pause, the longest silence.
const LONGEST_CALL_US: u64 = 6_000_000 + 2_000_000 + 2_000_000;

fn driving(faults: Faults) -> (World<SimulatedUrg>, UrgClient) {
    let world = World::new(SimulatedUrg::new(0, 7));
    world.0.borrow_mut().peer.faults = faults;
    let client = Client::new(Port(world.clone()), world.clone(), ClientConfig::default());
    (world, client)
}

type Outcome = Result<scip::Scan, ClientError<LineError>>;

/// Calls for scans until an instant. Every scan must be one that was measured; no call may last too long.
fn run_until(world: &World<SimulatedUrg>, client: &mut UrgClient, until_us: u64) -> Vec<Outcome> {
    let mut outcomes = Vec::new();
    while world.now_us() < until_us {
        let mut ranges = [0; BEAMS];
        let before_us = world.now_us();
        let outcome = world.run(client.next_scan(&mut ranges));
        let lasted_us = world.now_us() - before_us;
        assert!(lasted_us < LONGEST_CALL_US, "{lasted_us} µs: {outcome:?}");
        if outcome.is_ok() {
            assert!(was_measured(&ranges), "ranges that the sensor never measured");
        }
        outcomes.push(outcome);
    }
    outcomes
}

/// The ranges tell their instant modulo 5.58 s, which tells all of them.
fn was_measured(ranges: &[u16; BEAMS]) -> bool {
    let mut expected = [0; BEAMS];
    measure(u64::from(ranges[0] - 20) * 1000, &mut expected);
    expected == *ranges
}

fn scans(outcomes: &[Outcome]) -> usize {
    outcomes.iter().filter(|o| o.is_ok()).count()
}

#[test]
fn a_quiet_line_gives_ten_scans_a_second_with_stamps_within_two_milliseconds() {
    for drift_ppm in [-100, 100] {
        let (world, mut client) = driving(Faults { drift_ppm, ..Faults::default() });
        world.0.borrow_mut().peer.set_timer_ms(0, 0xFF_0000);
        run_until(&world, &mut client, 5_000_000);
        let from_us = world.now_us();
        let outcomes = run_until(&world, &mut client, from_us + 120_000_000);
        assert!((1199..=1201).contains(&outcomes.len()), "{}", outcomes.len());
        for scan in outcomes {
            let scan = scan.unwrap();
            // Revolutions begin every 100 ms, 300 ms after power-up.
            let error_us = (scan.stamp_us % 100_000).min(100_000 - scan.stamp_us % 100_000);
            assert!(error_us < 2_000, "{drift_ppm} ppm: {error_us} µs at {}", scan.stamp_us);
        }
        assert_eq!(client.counters().missed, 0);
        assert_eq!(client.sensor_clock().rejected(), 0);
        assert_eq!(client.counters().connections, 1);
    }
}

/// How far a stamp is from where the ranges say that the scan was.
fn error_us(scan: &scip::Scan, ranges: &[u16; BEAMS]) -> u64 {
    let begin_us = u64::from(ranges[0] - 20) * 1000;
    // The ranges tell it modulo 5.58 s.
    let off_us = (scan.stamp_us % 5_580_000).abs_diff(begin_us);
    off_us.min(5_580_000 - off_us)
}

/// Scans until an instant, which must all come without an error and in order; their errors.
fn errors_until(world: &World<SimulatedUrg>, client: &mut UrgClient, until_us: u64) -> Vec<u64> {
    let (mut errors, mut last_us) = (Vec::new(), 0);
    while world.now_us() < until_us {
        let mut ranges = [0; BEAMS];
        let scan = world.run(client.next_scan(&mut ranges)).expect("a scan");
        assert!(scan.stamp_us > last_us, "out of order");
        last_us = scan.stamp_us;
        errors.push(error_us(&scan, &ranges));
    }
    errors
}

#[test]
fn a_host_on_an_rc_oscillator_has_its_stamps_right_within_four_milliseconds() {
    for drift_ppm in [-10_000, 10_000] {
        let (world, mut client) = driving(Faults { drift_ppm, ..Faults::default() });
        run_until(&world, &mut client, 5_000_000);
        let errors = errors_until(&world, &mut client, 125_000_000);
        assert_eq!(errors.len(), 1200);
        assert!(errors.iter().all(|us| *us < 4_000), "{drift_ppm} ppm: {:?}", errors.iter().max());
        assert!((client.sensor_clock().skew_ppm() + drift_ppm as f32).abs() < 200.0);
    }
}

#[test]
fn a_sensor_s_clock_that_is_set_costs_two_scans_at_most_and_no_wrong_stamp() {
    for by_ms in [-600_000, 600_000, -40, 40, 100, -100] {
        let (world, mut client) = driving(Faults::default());
        run_until(&world, &mut client, 10_000_000);
        world.0.borrow_mut().peer.shift_timer_ms(by_ms);
        let from_us = world.now_us();
        let errors = errors_until(&world, &mut client, from_us + 10_000_000);
        assert!(errors.len() >= 97, "{by_ms} ms: {} scans", errors.len());
        assert!(errors.iter().all(|us| *us < 100_000), "{by_ms} ms: {errors:?}");
        assert!(errors[2..].iter().all(|us| *us < 3_000), "{by_ms} ms: {errors:?}");
        let clock = client.sensor_clock();
        assert_eq!((clock.jumps(), client.counters().losses), (1, 0), "{by_ms} ms");
        println!("{by_ms} ms: {} doubted", client.counters().doubted);
    }
}

#[test]
fn a_motor_that_wanders_is_measured_and_misses_no_scan() {
    let (world, mut client) = driving(Faults::default());
    run_until(&world, &mut client, 5_000_000);
    for slow_ppm in (0..60).map(|k: i32| 30_000 - (k - 30).abs() * 1_000) {
        world.0.borrow_mut().peer.faults.slow_ppm = slow_ppm;
        for _ in 0..20 {
            let mut ranges = [0; BEAMS];
            let scan = world.run(client.next_scan(&mut ranges)).unwrap();
            let truth_us = 100_000 + slow_ppm / 10;
            assert!((scan.revolution_us() as i32 - truth_us).abs() < 300, "{scan:?} at {slow_ppm} ppm");
        }
    }
    assert_eq!(client.counters().missed, 0);
}

#[test]
fn one_garbled_byte_in_ten_thousand_costs_single_scans_and_no_connection() {
    let (world, mut client) = driving(Faults::default());
    run_until(&world, &mut client, 5_000_000);
    world.0.borrow_mut().peer.faults.garbled_one_in = 10_000;
    let from_us = world.now_us();
    let outcomes = run_until(&world, &mut client, from_us + 120_000_000);
    let (good, counters) = (scans(&outcomes), *client.decoder_counters());
    println!("{good} of 1200 scans; {counters:?}");
    // A scan of 2137 bytes is hit with a chance of 19 %.
    assert!((800..1050).contains(&good), "{good}");
    assert_eq!(outcomes.len(), good, "no call failed");
    assert_eq!(client.counters().losses, 0);
    assert!(client.counters().missed as usize + good >= 1195);
    assert!(counters.bad_sum > 100);
}

#[test]
fn lost_and_doubled_bytes_cuts_and_wrong_sums_are_survived() {
    let cases = [
        ("lost", Faults { lost_one_in: 10_000, ..Faults::default() }),
        ("doubled", Faults { doubled_one_in: 10_000, ..Faults::default() }),
        ("wrong sums", Faults { wrong_sum_one_in: 5, ..Faults::default() }),
        ("cut", Faults { cut_one_in: 5, ..Faults::default() }),
        (
            "all of it",
            Faults {
                garbled_one_in: 8_000,
                lost_one_in: 8_000,
                doubled_one_in: 8_000,
                wrong_sum_one_in: 10,
                cut_one_in: 10,
                ..Faults::default()
            },
        ),
    ];
    for (name, faults) in cases {
        let (world, mut client) = driving(Faults::default());
        run_until(&world, &mut client, 5_000_000);
        world.0.borrow_mut().peer.faults = faults;
        let from_us = world.now_us();
        let outcomes = run_until(&world, &mut client, from_us + 60_000_000);
        let good = scans(&outcomes);
        println!("{name}: {good} of 600 scans, {:?}", client.decoder_counters());
        // What is left by chance alone: four in five, but 36 % where everything comes together.
        let (least, losses) = if name == "all of it" { (150, 5) } else { (420, 0) };
        assert!((least..590).contains(&good), "{name}: {good}");
        assert!(client.counters().losses <= losses, "{name}");
    }
}

#[test]
fn noise_on_the_line_is_counted_and_survived() {
    let (world, mut client) = driving(Faults::default());
    run_until(&world, &mut client, 5_000_000);
    world.0.borrow_mut().error_one_in = 5_000;
    let from_us = world.now_us();
    let outcomes = run_until(&world, &mut client, from_us + 60_000_000);
    assert!((300..500).contains(&scans(&outcomes)), "{}", scans(&outcomes));
    assert_eq!(outcomes.len(), scans(&outcomes), "no call failed");
    assert!(client.counters().port_errors > 100);
}

#[test]
fn unplugged_for_five_seconds_and_powered_up_again() {
    let (world, mut client) = driving(Faults::default());
    run_until(&world, &mut client, 10_000_000);
    world.0.borrow_mut().plugged = false;
    let outcomes = run_until(&world, &mut client, 15_000_000);
    assert!(outcomes.contains(&Err(ClientError::Silent)), "{outcomes:?}");
    assert!(outcomes.contains(&Err(ClientError::NotFound)), "{outcomes:?}");
    let plugged_us = world.now_us();
    world.0.borrow_mut().plugged = true;
    world.0.borrow_mut().peer.power_cycle(plugged_us);
    let outcomes = run_until(&world, &mut client, plugged_us + 8_000_000);
    assert!(outcomes.iter().flatten().next().unwrap().arrived_us < plugged_us + 8_000_000);
    assert!(outcomes.last().unwrap().is_ok());
    assert_eq!((client.counters().losses, client.counters().connections), (1, 2));
}

#[test]
fn a_power_cycle_while_streaming_is_noticed() {
    let (world, mut client) = driving(Faults::default());
    run_until(&world, &mut client, 10_000_000);
    world.0.borrow_mut().peer.power_cycle(10_050_000);
    let outcomes = run_until(&world, &mut client, 20_000_000);
    assert_eq!(outcomes.iter().filter(|o| o.is_err()).count(), 1);
    assert!(scans(&outcomes) > 60);
}

#[test]
fn a_babbling_sensor_is_left_and_found_again() {
    let (world, mut client) = driving(Faults::default());
    run_until(&world, &mut client, 5_000_000);
    world.0.borrow_mut().peer.faults.babble = true;
    let outcomes = run_until(&world, &mut client, 15_000_000);
    assert!(outcomes.contains(&Err(ClientError::Babbling)), "{outcomes:?}");
    world.0.borrow_mut().peer.faults.babble = false;
    let outcomes = run_until(&world, &mut client, 25_000_000);
    assert!(outcomes.last().unwrap().is_ok());
}

#[test]
fn a_sensor_that_stops_measuring_says_why() {
    for status in [*b"21", *b"50", *b"97"] {
        let (world, mut client) = driving(Faults::default());
        run_until(&world, &mut client, 5_000_000);
        let status = Status::new(status);
        world.0.borrow_mut().peer.faults.stop_with = Some(status);
        let outcomes = run_until(&world, &mut client, 8_000_000);
        let errors: Vec<_> = outcomes.iter().filter(|o| o.is_err()).collect();
        assert_eq!(errors, [&Err(ClientError::Stopped { status })]);
        assert!(outcomes.last().unwrap().is_ok());
    }
}

#[test]
fn without_a_sensor_attempts_become_rarer_but_never_end() {
    let (world, mut client) = driving(Faults { deaf: true, ..Faults::default() });
    let outcomes = run_until(&world, &mut client, 120_000_000);
    assert!(outcomes.iter().all(|o| *o == Err(ClientError::NotFound)));
    // About 2 s of search and 2 s of pause.
    assert!((25..40).contains(&outcomes.len()), "{}", outcomes.len());
    world.0.borrow_mut().peer.faults.deaf = false;
    let from_us = world.now_us();
    let outcomes = run_until(&world, &mut client, from_us + 8_000_000);
    assert!(outcomes.last().unwrap().is_ok());
}

#[test]
fn a_cancelled_call_never_mixes_two_scans() {
    let (world, mut client) = driving(Faults::default());
    run_until(&world, &mut client, 5_000_000);
    let mut context = Context::from_waker(Waker::noop());
    for cut in 0..200 {
        {
            // Some bytes of a scan go into this slice, then the call is dropped.
            let mut other = [0; BEAMS];
            let mut call = pin!(client.next_scan(&mut other));
            for _ in 0..cut * 11 {
                if let Poll::Ready(scan) = call.as_mut().poll(&mut context) {
                    scan.unwrap();
                    break;
                }
                world.step();
            }
        }
        let mut ranges = [0; BEAMS];
        world.run(client.next_scan(&mut ranges)).unwrap();
        assert!(was_measured(&ranges), "cut {cut}");
    }
}

#[test]
fn a_port_that_only_fails_is_reported_in_bounded_time() {
    struct Broken;
    impl embedded_io_async::ErrorType for Broken {
        type Error = LineError;
    }
    impl embedded_io_async::Read for Broken {
        async fn read(&mut self, _: &mut [u8]) -> Result<usize, LineError> {
            Err(LineError)
        }
    }
    impl embedded_io_async::Write for Broken {
        async fn write(&mut self, _: &[u8]) -> Result<usize, LineError> {
            Err(LineError)
        }
        async fn flush(&mut self) -> Result<(), LineError> {
            Err(LineError)
        }
    }
    impl scip::SerialPort for Broken {
        fn set_baud_rate(&mut self, _: u32) -> Result<(), LineError> {
            Ok(())
        }
    }
    let world = World::new(Tape::new([]));
    let mut client = Client::new(Broken, world.clone(), ClientConfig::default());
    for _ in 0..5 {
        let before_us = world.now_us();
        let outcome = world.run(client.next_scan(&mut [0; BEAMS]));
        assert_eq!(outcome, Err(ClientError::Port(LineError)));
        assert!(world.now_us() - before_us < LONGEST_CALL_US);
    }
}

#[test]
fn scans_that_are_mostly_dropped_step_the_bit_rate_down_once() {
    let world = World::new(SimulatedUrg::new(0, 7));
    let config = ClientConfig { baud_rate: 500_000, ..ClientConfig::default() };
    let mut client = Client::new(Port(world.clone()), world.clone(), config);
    run_until(&world, &mut client, 5_000_000);
    // Three in eight are left.
    world.0.borrow_mut().peer.faults = Faults { wrong_sum_one_in: 2, cut_one_in: 4, ..Faults::default() };
    let from_us = world.now_us();
    let outcomes = run_until(&world, &mut client, from_us + 60_000_000);
    assert_eq!((client.counters().slowed, client.baud_rate()), (1, 250_000));
    assert!((170..290).contains(&scans(&outcomes)), "{}", scans(&outcomes));
}

#[test]
fn found_streaming_the_client_takes_over() {
    let world = World::new(SimulatedUrg::found(0, 3, 750_000, Mode::Streaming));
    let mut client = Client::new(Port(world.clone()), world.clone(), ClientConfig::default());
    let outcomes = run_until(&world, &mut client, 10_000_000);
    assert_eq!(outcomes.len(), scans(&outcomes));
    assert!(outcomes.len() > 60);
}
