//! Takes the fixed set of scans in as often as it is told to: for callgrind, which counts what a scan takes.

use std::path::Path;

use anyhow::Context;
use lineslam::robot::Robot;
use lineslam::sim::fixed_set::FixedSet;
use slam_core::{Scan, Slam};

/// Segments of the map.
const SEGMENTS: usize = 200;
/// Scans of the set.
const SCANS: usize = 300;

fn main() -> anyhow::Result<()> {
    let times: usize = std::env::args().nth(1).context("how often?")?.parse()?;
    let set =
        FixedSet::new(Path::new("worlds/office.toml"), &Robot::load(Path::new("robots/paper.toml"))?, SCANS)?;
    for _ in 0..times {
        let mut slam = Slam::<512>::new(set.config)?;
        slam.take_up(set.map(SEGMENTS).into_iter(), set.begin);
        for (ranges_mm, motion) in set.ranges_mm.iter().zip(&set.motions) {
            std::hint::black_box(slam.process_scan(&Scan { ranges_mm }, motion));
        }
    }
    Ok(())
}
