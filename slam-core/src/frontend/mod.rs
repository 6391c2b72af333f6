//! A scan as the map's stages want it: ranges to points in `base`, points to segments.

pub mod deskew;
pub mod extraction;

use heapless::Vec;

use crate::config::SlamConfig;
use crate::frontend::deskew::{DeskewReport, ScanPoint, deskew};
use crate::frontend::extraction::{ExtractionReport, MAX_SEGMENTS, extract};
use crate::geometry::segment::Segment;
use crate::odometry::track::ScanMotion;
use crate::sensor::scan::Scan;
use crate::update::Stage;

/// Points and segments of the scan at hand, in `base` at its middle beam.
///
/// RAM: 16 bytes for each beam and 3 KiB.
pub(crate) struct Frontend<const BEAMS: usize> {
    points: Vec<ScanPoint, BEAMS>,
    segments: Vec<Segment, MAX_SEGMENTS>,
}

impl<const BEAMS: usize> Frontend<BEAMS> {
    /// No scan yet.
    pub const fn new() -> Self {
        Self { points: Vec::new(), segments: Vec::new() }
    }

    /// Points that were placed.
    pub fn points(&self) -> &[ScanPoint] {
        &self.points
    }

    /// Segments that were found.
    pub fn segments(&self) -> &[Segment] {
        &self.segments
    }

    /// Takes in a scan that was taken on the way of `motion`. Of points closer to each other than `spacing_m` some may be left out;
    /// `scan_number` seeds RANSAC.
    pub fn observe(
        &mut self,
        scan: &Scan<'_>,
        motion: &ScanMotion,
        spacing_m: f32,
        scan_number: u32,
        config: &SlamConfig,
        watch: &mut impl FnMut(Stage),
    ) -> (DeskewReport, ExtractionReport) {
        watch(Stage::Deskew);
        let still = ScanMotion::instantaneous(motion.since_previous);
        let motion = if motion.is_finite() { motion } else { &still };
        let sensor = &config.sensor;
        let deskewed = deskew(scan, motion, sensor, &config.deskew, spacing_m, &mut self.points);
        watch(Stage::Extraction);
        let extracted = extract(&self.points, sensor, &config.extraction, scan_number, &mut self.segments);
        (deskewed, extracted)
    }
}
