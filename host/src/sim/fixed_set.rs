//! A fixed set of scans to measure work with: consecutive scans of a simulated drive, the motion that led to each, and a map
//! of any size in which they can be recognised.

use std::path::Path;

use anyhow::Context;
use nalgebra::Isometry2;
use slam_core::geometry::pose::pose;
use slam_core::{MapSegment, ScanMotion, SlamConfig};

use crate::replay;
use crate::robot::Robot;
use crate::sim::world::World;
use crate::sim::{SimConfig, drive};

/// Copies of the building stand so far apart, metres.
const APART_M: f32 = 60.0;

/// The set.
#[derive(Clone, Debug)]
pub struct FixedSet {
    /// Ranges of each scan, millimetres.
    pub ranges_mm: Vec<Vec<u16>>,
    /// The motion that led to each.
    pub motions: Vec<ScanMotion>,
    /// Where the robot was a scan before.
    pub begin: Isometry2<f32>,
    /// The configuration, with the robot's sensor.
    pub config: SlamConfig,
    /// The building's segments, nearest to the way first.
    own: Vec<MapSegment>,
}

impl FixedSet {
    /// So many scans from the middle of a drive through the world, seed 1.
    pub fn new(world: &Path, robot: &Robot, scans: usize) -> anyhow::Result<Self> {
        let world = World::load(world)?;
        let driven = drive(&world, robot, &SimConfig::default(), 1)?;
        let replayed = replay::run(&driven.log, robot, SlamConfig::default(), || {})?;
        let from = replayed.steps.len().checked_sub(scans).context("the drive has fewer scans")? / 2;
        let steps = replayed.steps.get(from..from + scans).context("the drive has fewer scans")?;
        let logged = driven.log.scans.get(from..from + scans).context("the drive has fewer scans")?;
        let before = from.checked_sub(1).and_then(|k| replayed.steps.get(k)).context("no scan before")?;
        let from_way = |entry: &MapSegment| {
            let middle = entry.segment().midpoint().coords;
            let apart = steps.iter().map(|s| (middle - s.pose_in_final_map.translation.vector).norm());
            apart.fold(f32::MAX, f32::min)
        };
        let mut own = replayed.local_map;
        own.sort_by(|a, b| from_way(a).total_cmp(&from_way(b)));
        Ok(Self {
            ranges_mm: logged.iter().map(|scan| scan.ranges_mm.clone()).collect(),
            motions: steps.iter().map(|step| step.motion).collect(),
            begin: before.pose_in_final_map,
            config: replayed.config,
            own,
        })
    }

    /// A map of so many segments: the building's, nearest to the way first, then those of copies of it, which stand beside it.
    pub fn map(&self, segments: usize) -> Vec<MapSegment> {
        let copies = (0..).flat_map(|copy| {
            let beside = pose(0.0, copy as f32 * APART_M, 0.0);
            self.own.iter().map(move |entry| entry.with_segment(&entry.segment().transformed(&beside)))
        });
        if self.own.is_empty() { Vec::new() } else { copies.take(segments).collect() }
    }
}
