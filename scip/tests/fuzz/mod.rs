//! What the fuzz targets do with their bytes. The targets in `scip/fuzz` and the replay of their corpus share it.
#![allow(dead_code)] // Each user needs its part.

use scip::{Client, ClientConfig, Decoder};

use crate::world::{Port, Tape, World};

/// All that the decoder says to these chunks, as text, and what it counted.
pub fn log_of_events<'a>(chunks: impl IntoIterator<Item = &'a [u8]>) -> Vec<String> {
    let mut decoder = Decoder::new();
    let mut ranges = [0u16; 1024];
    let mut log = Vec::new();
    for mut chunk in chunks {
        while !chunk.is_empty() {
            let (used, event) = decoder.feed(chunk, &mut ranges);
            assert!(used > 0 && used <= chunk.len(), "no progress");
            if let Some(event) = event {
                log.push(format!("{event:?}"));
            }
            if log.last().is_some_and(|e| e.starts_with("Scan(")) {
                log.push(format!("{ranges:?}"));
                ranges = [0; 1024];
            }
            chunk = &chunk[used..];
        }
    }
    log.push(format!("{:?}", decoder.counters()));
    log
}

/// The first byte says how the others are cut; whole or cut, the decoder must say the same.
pub fn decoder(data: &[u8]) {
    let Some((&size, bytes)) = data.split_first() else { return };
    let cut = log_of_events(bytes.chunks(usize::from(size).max(1)));
    assert_eq!(cut, log_of_events([bytes]));
}

/// Bytes as a sensor's answers to a client: every call must end in time.
pub fn client(data: &[u8]) {
    let world = World::new(Tape::new(data.iter().copied()));
    let mut client = Client::new(Port(world.clone()), world.clone(), ClientConfig::default());
    let mut ranges = [0; 682];
    for _ in 0..8 {
        let before_us = world.now_us();
        let _ = world.run(client.next_scan(&mut ranges));
        let lasted_us = world.now_us() - before_us;
        assert!(lasted_us < 10_000_000, "{lasted_us} µs");
    }
}
