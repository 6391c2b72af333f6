//! Damaged replies: every truncation and every flipped bit of a full scan, random bytes, any chunking.

mod fuzz;
mod world;

use proptest::prelude::*;
use proptest::test_runner::FileFailurePersistence;
use scip::codec;
use scip::sim::STEPS;
use scip::{Command, Counters, Decoder, Event, Request, Status, Stream, Width, Writer};

const BEAMS: usize = 682;

fn request() -> Request {
    Command::M(Width::Three, Stream { steps: STEPS, interval: 0, scans: 0 }).into()
}

/// Ranges that use all bits of `MD` and of a `u16`.
fn ranges(seed: u32) -> Vec<u16> {
    (0..BEAMS as u32).map(|i| ((i + seed).wrapping_mul(2_654_435_761) >> 16) as u16).collect()
}

fn written(ranges: &[u16], stamp_ms: u32) -> Vec<u8> {
    let mut bytes = Vec::new();
    Writer::new(|b| bytes.push(b))
        .head(&request(), Status::SCAN)
        .stamp(stamp_ms)
        .data(ranges.iter().map(|&r| r.into()), Width::Three)
        .end();
    bytes
}

/// All scans that the decoder accepts: stamp and ranges.
fn scans(decoder: &mut Decoder, mut bytes: &[u8]) -> Vec<(u32, Vec<u16>)> {
    let mut found = Vec::new();
    let mut ranges = [0; BEAMS];
    while !bytes.is_empty() {
        let (used, event) = decoder.feed(bytes, &mut ranges);
        if let Some(Event::Scan(head)) = event {
            found.push((head.stamp_ms, ranges[..head.values].to_vec()));
        }
        bytes = &bytes[used..];
    }
    found
}

#[test]
fn a_whole_scan_is_decoded() {
    let bytes = written(&ranges(1), 5);
    assert_eq!(bytes.len(), 2137);
    let mut decoder = Decoder::new();
    assert_eq!(scans(&mut decoder, &bytes), [(5, ranges(1))]);
    assert_eq!(*decoder.counters(), Counters { scans: 1, ..Counters::default() });
}

#[test]
fn every_truncation_is_dropped_and_the_next_scan_decoded() {
    let (first, second) = (written(&ranges(1), 5), written(&ranges(2), 105));
    for length in 0..first.len() {
        let bytes = [&first[..length], &second].concat();
        let mut decoder = Decoder::new();
        assert_eq!(scans(&mut decoder, &bytes), [(105, ranges(2))], "cut at {length}");
        // Before its status has come a scan has not begun.
        let begun = length > 19;
        assert_eq!(decoder.counters().scans_dropped, u32::from(begun), "cut at {length}");
    }
}

#[test]
fn every_flipped_bit_is_noticed_where_it_matters_and_the_next_scan_decoded() {
    let (first, second) = (written(&ranges(1), 5), written(&ranges(2), 105));
    let echo = 15;
    let (mut accepted, mut unseen_by_sum) = (0, 0);
    for at in 0..first.len() {
        for bit in 0..8 {
            let mut damaged = first.clone();
            damaged[at] ^= 1 << bit;
            unseen_by_sum += usize::from(at > echo && sums_are_right(&damaged));
            let bytes = [damaged, second.clone()].concat();
            let mut decoder = Decoder::new();
            let found = scans(&mut decoder, &bytes);
            let (last, others) = found.split_last().unwrap_or_else(|| panic!("byte {at} bit {bit}: nothing"));
            assert_eq!(*last, (105, ranges(2)), "byte {at} bit {bit}");
            // An echo has no sum: a flip that leaves it an echo of as many values changes no range.
            for scan in others {
                assert!(at < echo, "byte {at} bit {bit} is accepted");
                assert_eq!(*scan, (5, ranges(1)), "byte {at} bit {bit}");
                accepted += 1;
            }
        }
    }
    let flips = (first.len() - echo - 1) * 8;
    println!(
        "{unseen_by_sum} of {flips} single flips after the echo leave all sums right; the alphabet shows them all. \
         In the echo {accepted} of {} are accepted, with the ranges unharmed.",
        echo * 8
    );
    // Bits 6 and 7 of every byte that is summed: 2 of the status, 4 of the stamp, 2046 of data. But a J with bit 6
    // flipped is a line end, and its line is two.
    let line_ends = first.split(|&b| b == b'\n').skip(1).filter_map(|l| l.split_last());
    let line_ends = line_ends.flat_map(|(_, body)| body).filter(|&&b| b == b'J').count();
    assert_eq!(unseen_by_sum, (2 + 4 + 2046) * 2 - line_ends);
}

/// Whether each line after the echo still ends in its sum.
fn sums_are_right(reply: &[u8]) -> bool {
    let lines: Vec<_> = reply.split(|&b| b == b'\n').skip(1).collect();
    lines.len() == 36 && lines[..34].iter().all(|l| codec::without_sum(l).is_some())
}

#[test]
fn a_million_random_bytes_give_nothing_and_then_a_scan() {
    let mut state = 1u64;
    let mut random = || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 56) as u8
    };
    let noise: Vec<u8> = (0..1_000_000).map(|_| random()).collect();
    let mut decoder = Decoder::new();
    assert_eq!(scans(&mut decoder, &noise), []);
    // The noise ends within a line; the scan's echo begins behind it.
    assert_eq!(scans(&mut decoder, &written(&ranges(3), 7)), [(7, ranges(3))]);
}

proptest! {
    #![proptest_config(ProptestConfig {
        failure_persistence: Some(Box::new(FileFailurePersistence::WithSource("proptest-regressions"))),
        ..ProptestConfig::default()
    })]

    /// Letters of the alphabet, line ends and pieces of replies: much closer to sense than random bytes.
    #[test]
    fn pieces_of_replies_never_panic_and_never_hide_the_next_scan(
        pieces in prop::collection::vec(
            prop_oneof![
                prop::collection::vec(b'0'..=b'o', 0..70),
                Just(b"\n".to_vec()),
                Just(b"\n\n".to_vec()),
                Just(b"MD0044072501000\n99b\n".to_vec()),
                Just(b"GD0044072501\n00P\n".to_vec()),
                Just(b"PP\n00P\n".to_vec()),
                Just(b"VV\n00P\nSERI:".to_vec()),
                Just(b"TM1\n00P\n".to_vec()),
                prop::collection::vec(any::<u8>(), 0..200),
            ],
            0..40,
        ),
    ) {
        let mut decoder = Decoder::new();
        let noise = pieces.concat();
        scans(&mut decoder, &noise);
        // Two: noise may end in what looks like the beginning of a reply and takes the first with it.
        let two = [written(&ranges(1), 5), written(&ranges(2), 105)].concat();
        let found = scans(&mut decoder, &two);
        prop_assert_eq!(found.last(), Some(&(105, ranges(2))));
    }

    #[test]
    fn chunks_do_not_matter(
        cuts in prop::collection::vec(0usize..4300, 0..60),
        flip in prop::option::of((0usize..4200, 0u8..8)),
    ) {
        let mut bytes = [written(&ranges(1), 5), b"PP\n00P\nAMAX:725;o\n\n".to_vec(), written(&ranges(2), 105)].concat();
        if let Some((at, bit)) = flip {
            bytes[at] ^= 1 << bit;
        }
        let whole = fuzz::log_of_events([&bytes[..]]);
        let mut cuts: Vec<_> = cuts.into_iter().filter(|c| *c < bytes.len()).collect();
        cuts.sort_unstable();
        let mut chunks = Vec::new();
        let mut rest = &bytes[..];
        for pair in std::iter::once(0).chain(cuts.iter().copied()).collect::<Vec<_>>().windows(2) {
            let (chunk, after) = rest.split_at(pair[1] - pair[0]);
            chunks.push(chunk);
            rest = after;
        }
        chunks.push(rest);
        prop_assert_eq!(fuzz::log_of_events(chunks), whole);
        prop_assert_eq!(fuzz::log_of_events(bytes.chunks(1)), fuzz::log_of_events([&bytes[..]]));
    }

    #[test]
    fn what_is_written_is_read(
        first in 0u16..1000, count in 1u16..1000, cluster in 0u8..=99, stamp_ms in 0u32..1 << 24,
        three: bool, scans_left in 0u8..=99,
    ) {
        let steps = scip::Steps { first, last: first + count - 1, cluster };
        let width = if three { Width::Three } else { Width::Two };
        let request = Request::from(Command::M(width, Stream { steps, interval: 0, scans: scans_left }));
        let ranges: Vec<u16> = (0..steps.values() as u16).map(|i| i.wrapping_mul(7919) % 4096).collect();
        let mut bytes = Vec::new();
        Writer::new(|b| bytes.push(b))
            .head(&request, Status::SCAN)
            .stamp(stamp_ms)
            .data(ranges.iter().map(|&r| r.into()), width)
            .end();
        let mut slice = vec![0; 1000];
        let mut decoder = Decoder::new();
        let (used, event) = decoder.feed(&bytes, &mut slice);
        prop_assert_eq!(used, bytes.len());
        let head = scip::ScanHead { request, steps, values: ranges.len(), stamp_ms };
        prop_assert_eq!(event, Some(Event::Scan(head)));
        prop_assert_eq!(&slice[..ranges.len()], &ranges[..]);
    }
}
