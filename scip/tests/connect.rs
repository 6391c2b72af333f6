//! The driver against the simulated sensor, on a simulated clock.

mod world;

use scip::sim::{BEAMS, Identity, Mode, Quirks, STEPS, SimulatedUrg};
use scip::{Client, ClientConfig, ClientError, Command, Status};
use world::{Port, World, measure};

/// The line rates of the sensor, and one that only its sisters have.
const RATES: [u32; 7] = [19_200, 38_400, 57_600, 115_200, 250_000, 500_000, 750_000];
const MODES: [Mode; 5] = [Mode::Scip11, Mode::Idle, Mode::LaserOff, Mode::Streaming, Mode::ClockAdjustment];

type UrgClient = Client<Port<SimulatedUrg>, World<SimulatedUrg>>;

fn client(world: &World<SimulatedUrg>, config: ClientConfig) -> UrgClient {
    Client::new(Port(world.clone()), world.clone(), config)
}

fn found(rate: u32, mode: Mode) -> World<SimulatedUrg> {
    World::new(SimulatedUrg::found(0, 1, rate, mode))
}

/// The next scan, which must be whole and stamped right.
fn good_scan(world: &World<SimulatedUrg>, client: &mut UrgClient) -> scip::Scan {
    let mut ranges = [0; BEAMS];
    let scan = world.run(client.next_scan(&mut ranges)).expect("a scan");
    assert_eq!((scan.steps, scan.ranges), (STEPS, BEAMS));
    check_scan(&scan, &ranges);
    scan
}

/// Ranges are those measured at the stamp, within the clock's error.
fn check_scan(scan: &scip::Scan, ranges: &[u16; BEAMS]) {
    let mut close =
        (0..5_000).step_by(100).flat_map(|us| [scan.stamp_us.saturating_sub(us), scan.stamp_us + us]);
    let right = close.any(|begin_us| {
        let mut expected = [0; BEAMS];
        measure(begin_us, &mut expected[..1]);
        expected[0] == ranges[0] && {
            measure(begin_us, &mut expected);
            expected == *ranges
        }
    });
    assert!(right, "no scan near {} µs has these ranges", scan.stamp_us);
}

#[test]
fn connects_from_every_state_within_five_seconds() {
    let mut slowest = (0, 0, "".to_owned());
    for rate in RATES {
        // 38 400 is only found by who wants it, and the sensor cannot be asked for it.
        let wanted = if rate == 38_400 { rate } else { ClientConfig::default().baud_rate };
        for mode in MODES {
            let world = found(rate, mode);
            let mut client = client(&world, ClientConfig { baud_rate: wanted, ..ClientConfig::default() });
            let info = world.run(client.connect()).unwrap_or_else(|e| panic!("{rate} {mode:?}: {e}")).clone();
            let connected_us = world.now_us();
            assert!(connected_us < 5_000_000, "{rate} {mode:?}: {connected_us} µs");
            slowest = slowest.max((connected_us, rate, format!("{mode:?}")));
            assert_eq!(info.beams(), BEAMS);
            assert_eq!(client.baud_rate(), wanted);
            if rate != 38_400 {
                good_scan(&world, &mut client);
                assert!(world.now_us() < 5_000_000, "{rate} {mode:?}");
            }
        }
    }
    println!("slowest: {} ms at {} bit/s, {}", slowest.0 / 1000, slowest.1, slowest.2);
}

#[test]
fn connects_with_every_quirk_from_every_state() {
    for (name, quirks) in Quirks::EACH {
        for rate in RATES.into_iter().filter(|rate| *rate != 38_400) {
            for mode in MODES {
                if quirks.knows_no_clock && mode == Mode::ClockAdjustment {
                    // It cannot be in it.
                    continue;
                }
                let world = found(rate, mode);
                world.0.borrow_mut().peer.quirks = quirks;
                let mut client = client(&world, ClientConfig::default());
                let info = world
                    .run(client.connect())
                    .unwrap_or_else(|e| panic!("{name} {rate} {mode:?}: {e}"))
                    .clone();
                assert_eq!((info.beams(), info.revolution_us()), (BEAMS, 100_000), "{name}");
                good_scan(&world, &mut client);
                good_scan(&world, &mut client);
                // What is asked twice and not answered takes its time.
                let limit_us = if quirks.identity == Identity::Silent { 5_700_000 } else { 5_000_000 };
                assert!(world.now_us() < limit_us, "{name} {rate} {mode:?}: {} µs", world.now_us());
                check_info(name, &info, client.decoder_counters().bad_sum);
            }
        }
    }
}

/// What is known of a sensor with a quirk, and how many sums were wrong.
fn check_info(quirk: &str, info: &scip::SensorInfo, bad_sums: u32) {
    let (named, serial) = match quirk {
        "wrong-sum" => (true, ""),
        "vv-refused" | "vv-silent" => (false, ""),
        _ => (true, "H0000000"),
    };
    assert_eq!((info.vendor.starts_with("Hokuyo"), &info.serial[..]), (named, serial), "{quirk}");
    assert_eq!(info.model.is_empty(), quirk == "terse", "{quirk}");
    let most_mm = if matches!(quirk, "far" | "terse") { u16::MAX } else { 5600 };
    assert_eq!((info.min_range_mm, info.max_range_mm), (20, most_mm), "{quirk}");
    // Joints of scans that were let go by may count too.
    assert!(bad_sums >= u32::from(quirk == "wrong-sum"), "{quirk}: {bad_sums}");
}

#[test]
fn connects_after_a_reset_by_command_in_the_middle_of_a_stream() {
    for (name, quirks) in Quirks::EACH.into_iter().chain([("none", Quirks::NONE)]) {
        let world = found(500_000, Mode::Streaming);
        world.0.borrow_mut().peer.quirks = quirks;
        let mut client = client(&world, ClientConfig::default());
        for _ in 0..3 {
            good_scan(&world, &mut client);
        }
        {
            let mut room = world.0.borrow_mut();
            let (rate, now_us) = (room.peer.baud_rate(), room.now_us);
            b"RS\n".iter().for_each(|b| room.peer.receive(*b, rate, now_us));
        }
        let from_us = world.now_us();
        let mut ranges = [0; BEAMS];
        let outcomes = [0; 4].map(|_| world.run(client.next_scan(&mut ranges)).is_ok());
        assert!(outcomes[2] && outcomes[3], "{name}: {outcomes:?}");
        good_scan(&world, &mut client);
        assert!(world.now_us() - from_us < 7_000_000, "{name}: {} µs", world.now_us() - from_us);
        assert_eq!(client.baud_rate(), ClientConfig::default().baud_rate, "{name}");
    }
}

#[test]
fn two_hundred_and_fifty_kilobits_carry_every_scan() {
    let world = found(19_200, Mode::Scip11);
    let mut client = client(&world, ClientConfig::default());
    good_scan(&world, &mut client);
    assert_eq!(client.baud_rate(), 250_000);
    let mut last_us = good_scan(&world, &mut client).stamp_us;
    for _ in 0..100 {
        let scan = good_scan(&world, &mut client);
        assert!((scan.stamp_us - last_us).abs_diff(100_000) < 2_000);
        // The sweep of 70.8 ms, 3 ms of work, 85.5 ms on the line.
        assert!((155_000..165_000).contains(&(scan.arrived_us - scan.stamp_us)), "{scan:?}");
        last_us = scan.stamp_us;
    }
    assert_eq!(client.counters().missed, 0);
}

#[test]
fn a_line_that_is_not_good_for_the_bit_rate_is_used_at_a_lower_one_for_good() {
    for (good_to, asked, kept, steps) in
        [(250_000, 750_000, 250_000, 2), (115_200, 500_000, 115_200, 2), (250_000, 250_000, 250_000, 0)]
    {
        for mode in MODES {
            let world = found(19_200, mode);
            world.0.borrow_mut().peer.faults.good_to = good_to;
            let mut client = client(&world, ClientConfig { baud_rate: asked, ..ClientConfig::default() });
            let mut ranges = [0; BEAMS];
            let tries = (0..12).take_while(|_| world.run(client.next_scan(&mut ranges)).is_err()).count();
            assert!(tries <= 8, "{good_to} {mode:?}: {tries} attempts");
            println!("{asked} to {kept} bit/s, {mode:?}: {tries} attempts, {} ms", world.now_us() / 1000);
            assert_eq!((client.baud_rate(), client.chosen_baud_rate()), (kept, kept));
            assert_eq!(client.counters().slowed, steps);
            // The sensor's power goes and comes: nothing is tried again that failed.
            let now_us = world.now_us();
            world.0.borrow_mut().peer.power_cycle(now_us);
            let errors = (0..3).filter(|_| world.run(client.next_scan(&mut ranges)).is_err()).count();
            assert!(errors <= 1, "{good_to} {mode:?}: {errors} errors");
            assert_eq!((client.baud_rate(), client.counters().slowed), (kept, steps));
        }
    }
}

#[test]
fn a_number_that_measuring_needs_is_strict() {
    use scip::info::{InfoBuilder, InfoError};
    use scip::{Decoder, Event};
    // AMAX says 726 with the sum of 725: as if it were not there.
    let told = b"PP\n00P\nARES:1024;\\\nAMIN:44;7\nAMAX:726;o\nAFRT:384;6\nSCAN:600;e\n\n";
    let (mut decoder, mut builder, mut rest) = (Decoder::new(), InfoBuilder::default(), &told[..]);
    while !rest.is_empty() {
        let (used, event) = decoder.feed(rest, &mut []);
        if let Some(Event::Field { field, .. }) = event {
            builder.take(field);
        }
        rest = &rest[used..];
    }
    assert_eq!(builder.build(), Err(InfoError::Missing { key: "AMAX" }));
    assert_eq!((decoder.counters().bad_sum, decoder.counters().replies), (1, 1));
}

#[test]
fn connects_whenever_the_host_starts_and_when_the_first_qt_is_ignored() {
    for mode in MODES {
        for phase_ms in (0..300).step_by(7) {
            let world = found(RATES[phase_ms % 7 / 2 * 2], mode);
            world.0.borrow_mut().now_us = phase_ms as u64 * 1000;
            world.0.borrow_mut().peer.faults.ignored_qt = (phase_ms % 2) as u32;
            let mut client = client(&world, ClientConfig::default());
            if let Err(error) = world.run(client.connect()) {
                panic!("{mode:?} from {phase_ms} ms: {error}");
            }
            good_scan(&world, &mut client);
            assert!(world.now_us() < 5_300_000, "{mode:?} from {phase_ms} ms: {} µs", world.now_us());
        }
    }
}

#[test]
fn connects_while_the_sensor_powers_up() {
    let world = World::new(SimulatedUrg::new(0, 1));
    let mut client = client(&world, ClientConfig::default());
    good_scan(&world, &mut client);
    assert!(world.now_us() < 5_000_000);
    let info = client.info().unwrap();
    assert_eq!(info.serial, "H0000000");
    assert_eq!(info.protocol, "SCIP 2.0");
    assert_eq!(client.decoder_counters().bad_sum, 0);
}

#[test]
fn a_sensor_that_refuses_the_bit_rate_is_used_at_its_own() {
    let world = found(19_200, Mode::LaserOff);
    let mut client = client(&world, ClientConfig { baud_rate: 38_400, ..ClientConfig::default() });
    world.run(client.connect()).unwrap();
    assert_eq!(client.baud_rate(), 19_200);
    good_scan(&world, &mut client);
}

#[test]
fn streams_what_is_asked_for() {
    let world = found(500_000, Mode::Idle);
    let steps = scip::Steps { first: 100, last: 399, cluster: 3 };
    let config = ClientConfig { steps: Some(steps), interval: 1, ..ClientConfig::default() };
    let mut client = client(&world, config);
    let mut ranges = [0; 100];
    let first = world.run(client.next_scan(&mut ranges)).unwrap();
    let second = world.run(client.next_scan(&mut ranges)).unwrap();
    assert_eq!((first.steps, first.ranges), (steps, 100));
    assert!((second.stamp_us - first.stamp_us).abs_diff(200_000) < 2_000);
    assert_eq!(client.counters().missed, 0);
    // Step 100 of 1024, then three steps further.
    assert_eq!(first.beam_us(0) - first.stamp_us, 9_765);
    assert_eq!(first.beam_us(1) - first.stamp_us, 10_058);
    // The least of each group of three.
    assert!(ranges.iter().all(|&r| r >= 20));
    world.run(client.stop()).unwrap();
    assert!(!world.0.borrow().peer.laser_is_on());
}

#[test]
fn what_the_sensor_refuses_is_said() {
    let world = found(500_000, Mode::LaserOff);
    world.0.borrow_mut().peer.faults.laser_fault = true;
    let mut client = client(&world, ClientConfig::default());
    let mut ranges = [0; BEAMS];
    let refused = ClientError::Refused { command: Command::Bm, status: Status::new(*b"01") };
    assert_eq!(world.run(client.next_scan(&mut ranges)), Err(refused));
    let mut small = [0; 681];
    world.0.borrow_mut().peer.faults.laser_fault = false;
    let no_room = ClientError::NoRoom { ranges: 682, room: 681 };
    assert_eq!(world.run(client.next_scan(&mut small)), Err(no_room));
    good_scan(&world, &mut client);
}
