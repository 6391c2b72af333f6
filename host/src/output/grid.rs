//! `map.pgm` and `map.yaml`: an occupancy grid as ROS map_server reads it.
//!
//! The grid is drawn from the scans at their poses in the final map: a cell that beams ended in is occupied, one that
//! beams only passed through is free, one that no beam touched is unknown.
//!
//! Where two neighbouring beams met nothing in range, the cells between them are free too, as far as the sensor reaches.
//! But glass, black surfaces and flat angles return nothing either: so one such beam alone says nothing, and two say
//! nothing of an occupied cell and of what is behind it. Beams that could not be measured never say anything.

use image::codecs::pnm::{PnmEncoder, PnmSubtype, SampleEncoding};
use image::{GrayImage, ImageError, Luma};
use nalgebra::Point2;

use super::bounds;
use crate::beams::{Beam, REACH_M, Seen, all_in_final_map};
use crate::log::Log;
use crate::replay::Replay;

/// Edge of a cell, metres.
const CELL_M: f32 = 0.05;
/// Most cells along an edge; larger buildings get larger cells.
const MOST_CELLS: f32 = 4000.0;
/// Share of the beams touching a cell that must end in it for it to be occupied.
const OCCUPIED_SHARE: f32 = 0.25;

/// A cell that no beam touched, in [`Grid::cells`].
pub const UNKNOWN: i8 = -1;
/// A cell that beams passed through.
pub const FREE: i8 = 0;
/// A cell that beams ended in.
pub const OCCUPIED: i8 = 100;

/// An occupancy grid in `map`.
#[derive(Clone, Debug, PartialEq)]
pub struct Grid {
    /// Lower left corner, metres.
    pub origin: Point2<f64>,
    /// Edge of a cell, metres.
    pub cell_m: f64,
    /// Cells along x.
    pub width: u32,
    /// Cells along y.
    pub height: u32,
    /// Rows along x, the one of least y first: [`UNKNOWN`], [`FREE`] or [`OCCUPIED`].
    pub cells: Vec<i8>,
}

impl Grid {
    /// Draws the grid of all scans.
    pub fn of(log: &Log, replay: &Replay) -> Self {
        let scans = || all_in_final_map(log, replay).map(within_reach);
        let layout = Layout::around(scans());
        let mut counts = vec![Count::default(); layout.len()];
        scans().for_each(|seen| count_beams(&layout, &seen, &mut counts));
        let mut cells: Vec<i8> = counts.iter().map(Count::verdict).collect();
        scans().for_each(|seen| free_empty_sectors(&layout, &seen, &mut cells));
        // To a micrometre, so that 0.05 is written 0.05.
        let rounded = |metres: f32| (f64::from(metres) * 1e6).round() / 1e6;
        let Layout { origin, cell_m, width, height } = layout;
        Self { origin: origin.map(rounded), cell_m: rounded(cell_m), width, height, cells }
    }

    /// Content of `map.pgm`.
    pub fn pgm(&self) -> Result<Vec<u8>, ImageError> {
        let image = GrayImage::from_fn(self.width, self.height, |x, y| {
            // Images have their first row on top.
            let row = (self.height - 1 - y) as usize;
            Luma([match self.cells[row * self.width as usize + x as usize] {
                UNKNOWN => 205,
                OCCUPIED => 0,
                _ => 254,
            }])
        });
        let mut pgm = Vec::new();
        // map_server reads P5, binary grey, and nothing newer.
        let encoder = PnmEncoder::new(&mut pgm).with_subtype(PnmSubtype::Graymap(SampleEncoding::Binary));
        image.write_with_encoder(encoder)?;
        Ok(pgm)
    }

    /// Content of `map.yaml`.
    pub fn yaml(&self) -> String {
        format!(
            "image: map.pgm\nmode: trinary\nresolution: {}\norigin: [{}, {}, 0.0]\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n",
            self.cell_m, self.origin.x, self.origin.y
        )
    }
}

/// Beams that touched a cell.
#[derive(Clone, Copy, Default)]
struct Count {
    ended: u32,
    touched: u32,
}

impl Count {
    fn verdict(&self) -> i8 {
        match self.touched {
            0 => UNKNOWN,
            touched if self.ended as f32 >= OCCUPIED_SHARE * touched as f32 => OCCUPIED,
            _ => FREE,
        }
    }
}

/// Counts the beams of a scan that met something, in all cells that they touch.
fn count_beams(layout: &Layout, seen: &Seen, counts: &mut [Count]) {
    for end in seen.obstacles() {
        let mut last = None;
        for cell in layout.cells_between(seen.sensor, end) {
            counts[cell].touched += 1;
            last = Some(cell);
        }
        if let Some(cell) = last {
            counts[cell].ended += 1;
        }
    }
}

/// Frees the unknown cells between neighbouring beams that met nothing, as far as the next obstacle.
fn free_empty_sectors(layout: &Layout, seen: &Seen, cells: &mut [i8]) {
    for pair in seen.beams.windows(2) {
        let [first, second] = pair else { continue };
        if !both_empty(first, second) {
            continue;
        }
        let across = second.end - first.end;
        let ways = (across.norm() / layout.cell_m).ceil().max(1.0);
        for k in 0..=ways as u32 {
            let end = first.end + across * (k as f32 / ways);
            for cell in layout.cells_between(seen.sensor, end) {
                match &mut cells[cell] {
                    &mut OCCUPIED => break,
                    cell => *cell = FREE,
                }
            }
        }
    }
}

/// Whether two beams are neighbours and neither met anything.
fn both_empty(one: &Beam, other: &Beam) -> bool {
    !one.obstacle && !other.obstacle && one.index.abs_diff(other.index) == 1
}

/// Beams are followed no farther than the reach; that there is something beyond is another matter.
fn within_reach(mut seen: Seen) -> Seen {
    for beam in &mut seen.beams {
        let way = beam.end - seen.sensor;
        let length = way.norm();
        if length > REACH_M {
            beam.end = seen.sensor + way * (REACH_M / length);
            beam.obstacle = false;
        }
    }
    seen
}

/// Where the cells lie.
#[derive(Clone, Copy)]
struct Layout {
    origin: Point2<f32>,
    cell_m: f32,
    width: u32,
    height: u32,
}

impl Layout {
    fn around(scans: impl Iterator<Item = Seen>) -> Self {
        let touched = scans.flat_map(|seen| {
            let Seen { sensor, beams } = seen;
            beams.into_iter().map(|beam| beam.end).chain([sensor])
        });
        let (low, high) = bounds(touched);
        let extent = (high - low).max() + 2.0 * CELL_M;
        let cell_m = CELL_M.max(extent / MOST_CELLS);
        let origin = Point2::new((low.x / cell_m).floor() - 1.0, (low.y / cell_m).floor() - 1.0) * cell_m;
        let cells = |from: f32, to: f32| ((to - from) / cell_m).ceil() as u32 + 2;
        let (width, height) = (cells(origin.x, high.x), cells(origin.y, high.y));
        Self { origin, cell_m, width, height }
    }

    fn len(&self) -> usize {
        self.width as usize * self.height as usize
    }

    /// The cells on a straight way, each once, the one at its end last. One step for each row or column crossed, whichever
    /// are more.
    fn cells_between(self, from: Point2<f32>, to: Point2<f32>) -> impl Iterator<Item = usize> {
        let [from, to] = [from, to].map(|point| (point - self.origin.coords) / self.cell_m);
        let way = to - from;
        let steps = way.amax().ceil().max(1.0);
        let step = way / steps;
        let mut last = None;
        (0..=steps as u32)
            .filter_map(move |k| self.index(if k < steps as u32 { from + step * k as f32 } else { to }))
            .filter(move |cell| last.replace(*cell) != Some(*cell))
    }

    /// The cell around a point that is given in cells.
    fn index(&self, at: Point2<f32>) -> Option<usize> {
        let inside = at.x >= 0.0 && at.y >= 0.0 && at.x < self.width as f32 && at.y < self.height as f32;
        inside.then(|| at.y as usize * self.width as usize + at.x as usize)
    }
}
