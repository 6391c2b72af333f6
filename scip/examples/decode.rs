//! Decodes full `MD` scans, as often as asked: `cargo run --release -p scip --example decode -- 1000`. What
//! `cargo xtask bench` counts the instructions of.

use std::hint::black_box;

use scip::sim::{BEAMS, STEPS};
use scip::{Command, Decoder, Event, Request, Status, Stream, Width, Writer};

/// Bytes that arrive at once: what a DMA buffer hands over.
const CHUNK: usize = 64;

fn main() {
    let times: usize = std::env::args().nth(1).and_then(|n| n.parse().ok()).unwrap_or(1000);
    let request = Request::from(Command::M(Width::Three, Stream { steps: STEPS, interval: 0, scans: 0 }));
    let ranges = (0..BEAMS as u32).map(|beam| 20 + beam * 7919 % 5580);
    let mut bytes = Vec::new();
    Writer::new(|b| bytes.push(b))
        .head(&request, Status::SCAN)
        .stamp(123_456)
        .data(ranges, Width::Three)
        .end();
    let mut decoder = Decoder::new();
    let mut decoded = [0; BEAMS];
    let mut scans = 0;
    for _ in 0..times {
        for mut chunk in black_box(&bytes).chunks(CHUNK) {
            while !chunk.is_empty() {
                let (used, event) = decoder.feed(chunk, &mut decoded);
                scans += usize::from(matches!(event, Some(Event::Scan(_))));
                chunk = &chunk[used..];
            }
        }
        black_box(&decoded);
    }
    assert_eq!(scans, times);
    println!("{scans} scans of {} bytes", bytes.len());
}
