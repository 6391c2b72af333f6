//! Frames and messages: there and back, cut, damaged, and among noise.

mod messages;

use link::frame::{ReceiveCounters, TooLarge};
use link::from_robot::{Answer, Outcome, Ticks};
use link::map::{Line, block_check};
use link::ranges::{Packed, RANGES};
use link::to_robot::{Command, Request, Streams};
use link::{BODY, FRAME, FromRobot, Receiver, Sender};
use messages::{bodies, framed, largest, requests};
use proptest::prelude::*;

#[test]
fn the_largest_of_each_message_fits_and_comes_back() {
    let (mut sender, mut receiver) = (Sender::default(), Receiver::<FRAME>::default());
    for message in largest() {
        let frame = framed(&mut sender, &message);
        assert!(frame.len() <= FRAME && frame.iter().filter(|b| **b == 0).count() == 2, "{message:?}");
        let found = bodies(&mut receiver, &frame);
        assert_eq!(found.len(), 1, "{message:?}");
        assert!(found[0].len() <= BODY);
        assert_eq!(FromRobot::decode(&found[0]), Some(message));
    }
    assert_eq!(receiver.counters(), ReceiveCounters { frames: 12, ..ReceiveCounters::default() });
}

#[test]
fn requests_come_back() {
    let (mut sender, mut receiver) = (Sender::default(), Receiver::<FRAME>::default());
    for request in requests() {
        let found = bodies(&mut receiver, &framed(&mut sender, &request));
        assert_eq!(Request::decode(&found[0]), Ok(request));
    }
}

/// The bytes that README.md shows.
#[test]
fn the_worked_examples() {
    let readme = include_str!("../README.md");
    let hex = |bytes: &[u8]| bytes.iter().map(|b| format!("{b:02x}")).collect::<Vec<_>>().join(" ");
    let request = Request { id: 1, command: Command::Subscribe(Streams::ALL) };
    let answer = FromRobot::Answer(Answer { id: 300, outcome: Outcome::Done });
    let mut ticks = Ticks::new(7, (1_000_000, [-3, 70]));
    ticks.steps.push((5000, 2, -1)).unwrap();
    let ranges = link::from_robot::Ranges {
        number: 5,
        at_us: 1_050_000,
        revolution_us: 100_000,
        beams: 682,
        first: 98,
        ranges: Packed::of(&[1000, 1005, 0, 4095]),
    };
    let examples = [
        framed(&mut Sender::default(), &request),
        framed(&mut Sender::default(), &answer),
        framed(&mut Sender::default(), &FromRobot::Ticks(ticks)),
        framed(&mut Sender::default(), &FromRobot::Ranges(ranges)),
    ];
    for frame in examples.iter().map(|frame| hex(frame)) {
        assert!(readme.contains(&frame), "README.md does not show {frame}");
    }
    let line = Line { start_m: [0.0, 0.5], end_m: [2.0, 0.5], sigma_m: 0.01, hits: 300, is_wall: true };
    let check = format!("{:08x}", block_check([&line]));
    assert!(readme.contains(&check), "README.md does not show {check}");
}

#[test]
fn what_is_not_known_is_no_message_and_what_was_added_is_passed_over() {
    assert_eq!(FromRobot::decode(&[12, 1, 2, 3]), None);
    assert_eq!(FromRobot::decode(&[]), None);
    assert_eq!(Request::decode(&[5, 8]), Err(Some(5)));
    assert_eq!(Request::decode(&[]), Err(None));
    let longer = [5, 172, 2, 0, 99, 99];
    assert_eq!(
        FromRobot::decode(&longer),
        Some(FromRobot::Answer(Answer { id: 300, outcome: Outcome::Done }))
    );
}

#[test]
fn a_cut_frame_costs_itself_alone() {
    let mut sender = Sender::default();
    let messages = largest();
    let frames: Vec<Vec<u8>> = messages.iter().map(|message| framed(&mut sender, message)).collect();
    for (number, frame) in frames.iter().enumerate().take(frames.len() - 1) {
        let next = &frames[number + 1];
        // Without its last zero a frame is whole: that of the next one ends it.
        for cut in 2..frame.len() - 1 {
            for piece in [&frame[..cut], &frame[cut..]] {
                let mut receiver = Receiver::<FRAME>::default();
                let mut bytes = frames[0].clone();
                bytes.extend(piece);
                bytes.extend(next);
                let found = bodies(&mut receiver, &bytes);
                let decoded: Vec<_> = found.iter().map(|body| FromRobot::decode(body)).collect();
                assert_eq!(
                    decoded,
                    [Some(messages[0].clone()), Some(messages[number + 1].clone())],
                    "{number} {cut}"
                );
                assert_eq!(receiver.counters().damaged, 1);
                assert_eq!(receiver.counters().missing, number as u32);
            }
        }
    }
}

#[test]
fn no_flipped_bit_or_two_neighbouring_ones_pass() {
    let mut sender = Sender::default();
    for message in largest() {
        let frame = framed(&mut sender, &message);
        for (width, bit) in [1u8, 3].into_iter().flat_map(|w| (0..frame.len() * 8).map(move |bit| (w, bit))) {
            let mut bytes = frame.clone();
            bytes[bit / 8] ^= width << (bit % 8);
            // The zero before the frame is not part of it.
            if bit / 8 == 0 {
                bytes.insert(0, 0);
            }
            // What ends the frame instead.
            bytes.push(0);
            let mut receiver = Receiver::<FRAME>::default();
            let found = bodies(&mut receiver, &bytes);
            assert!(found.is_empty(), "bit {bit} of {message:?}");
            assert!(receiver.counters().damaged >= 1);
        }
    }
}

#[test]
fn another_version_is_counted_and_missing_numbers_too() {
    let mut sender = Sender::default();
    let message = FromRobot::Answer(Answer { id: 1, outcome: Outcome::Done });
    let frames: Vec<Vec<u8>> = (0..6).map(|_| framed(&mut sender, &message)).collect();
    let mut receiver = Receiver::<FRAME>::default();
    for number in [0, 1, 4, 5] {
        bodies(&mut receiver, &frames[number]);
    }
    assert_eq!(receiver.counters().missing, 2);
    // A robot that was reset counts from 0.
    bodies(&mut receiver, &frames[0]);
    assert_eq!(receiver.counters(), ReceiveCounters { frames: 5, missing: 2, ..ReceiveCounters::default() });
    let mut raw = [0; 12];
    raw[0] = link::VERSION + 1;
    let check = crc::Crc::<u32>::new(&crc::CRC_32_ISO_HDLC).checksum(&raw[..8]);
    raw[8..].copy_from_slice(&check.to_le_bytes());
    let mut coded = vec![0; 16];
    let len = cobs::encode(&raw, &mut coded);
    coded.truncate(len);
    coded.push(0);
    assert!(bodies(&mut receiver, &coded).is_empty());
    assert_eq!(receiver.counters().other_versions, 1);
}

#[test]
fn what_is_too_large_is_refused_and_takes_no_number() {
    let mut sender = Sender::default();
    assert_eq!(sender.frame(&[[0xFFu8; 31]; 8], &mut [0; FRAME]), Err(TooLarge));
    assert_eq!(sender.sequence(), 0);
    assert!(sender.frame(&[[0xFFu8; 30]; 8], &mut [0; FRAME]).is_ok());
    assert_eq!(sender.sequence(), 1);
}

#[test]
fn a_receiver_that_expects_little_passes_over_much() {
    let mut sender = Sender::default();
    let mut receiver = Receiver::<48>::default();
    let mut found = 0;
    for bytes in [framed(&mut sender, &largest()[0]), framed(&mut sender, &requests()[3])] {
        found += bytes.iter().filter(|byte| receiver.push(**byte).is_some()).count();
    }
    assert_eq!((found, receiver.counters().damaged), (1, 1));
}

#[test]
fn the_streams_take_less_than_half_of_the_line() {
    let of = |message: FromRobot| framed(&mut Sender::default(), &message).len() as f64;
    let [_, pose, status, health, _, _, ticks, ranges, lines, block, places, places_end] = largest().map(of);
    // At the worst: 16 bits for each range, every number at its largest; ten scans, 200 samples, a keyframe each second scan that
    // changes 40 lines, 30 blocks a second, and once a second all places.
    let scans = 10.0 * 7.0 * ranges;
    let wheels = 10.0 * 2.0 * ticks;
    let map = 5.0 * 5.0 * lines + 30.0 * block + 96.0 / 18.0 * places + places_end;
    let rest = 10.0 * pose + status + health;
    let sum = scans + wheels + map + rest;
    let line = f64::from(link::BIT_RATE) / 10.0;
    println!("scans {scans} wheels {wheels} map {map:.0} rest {rest}: {sum:.0} of {line} bytes a second");
    assert!(sum < 0.5 * line, "{sum}");
}

proptest! {
    #[test]
    fn ranges_come_back(ranges in prop::collection::vec(any::<u16>(), 0..=RANGES), limit in 0u32..=16) {
        let most = ((1u32 << limit) - 1) as u16;
        let ranges: Vec<u16> = ranges.into_iter().map(|range| range & most).collect();
        let packed = Packed::of(&ranges);
        prop_assert_eq!(&packed.ranges_mm().unwrap()[..], &ranges[..]);
    }

    #[test]
    fn samples_come_back(first in any::<u64>(), steps in prop::collection::vec(any::<(u32, i32, i32)>(), 0..=14)) {
        let mut ticks = Ticks::new(3, (first, [5, -5]));
        ticks.steps = steps.iter().copied().collect();
        let samples: Vec<_> = ticks.samples().collect();
        prop_assert_eq!(samples.len(), steps.len() + 1);
        for (pair, step) in samples.windows(2).zip(&steps) {
            prop_assert_eq!(pair[1].0.wrapping_sub(pair[0].0), u64::from(step.0));
            prop_assert_eq!(pair[1].1[0].wrapping_sub(pair[0].1[0]), step.1);
            prop_assert_eq!(pair[1].1[1].wrapping_sub(pair[0].1[1]), step.2);
        }
    }

    #[test]
    fn noise_between_frames_costs_no_frame(noise in prop::collection::vec(prop::collection::vec(any::<u8>(), 0..600), 13)) {
        let (mut sender, mut receiver) = (Sender::default(), Receiver::<FRAME>::default());
        let mut found = Vec::new();
        for (message, noise) in largest().iter().zip(&noise) {
            found.extend(bodies(&mut receiver, noise));
            found.extend(bodies(&mut receiver, &framed(&mut sender, message)));
        }
        let decoded: Vec<_> = found.iter().map(|body| FromRobot::decode(body)).collect();
        prop_assert_eq!(decoded, largest().map(Some).to_vec());
    }

    #[test]
    fn any_body_is_decoded_or_not_but_never_a_panic(body in prop::collection::vec(any::<u8>(), 0..=BODY)) {
        let _ = Request::decode(&body);
        if let Some(FromRobot::Ranges(ranges)) = FromRobot::decode(&body) {
            let _ = ranges.ranges.ranges_mm();
        }
    }
}
