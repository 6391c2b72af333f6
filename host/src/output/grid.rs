//! `map.pgm` and `map.yaml`: an occupancy grid as ROS map_server reads it.
//!
//! The grid is drawn from the scans at their estimated poses: a cell that beams ended in is occupied, one that beams
//! only passed through is free, one that no beam touched is unknown.

use image::codecs::pnm::{PnmEncoder, PnmSubtype, SampleEncoding};
use image::{GrayImage, ImageError, Luma};
use nalgebra::Point2;

use super::bounds;
use crate::replay::{Replay, Step};

/// Edge of a cell, metres.
const CELL_M: f32 = 0.05;
/// Longest beam drawn, metres.
const REACH_M: f32 = 15.0;
/// Most cells along an edge; larger buildings get larger cells.
const MOST_CELLS: f32 = 4000.0;
/// Share of the beams touching a cell that must end in it for it to be occupied.
const OCCUPIED_SHARE: f32 = 0.25;

const FREE: u8 = 254;
const OCCUPIED: u8 = 0;
const UNKNOWN: u8 = 205;

/// The two files.
pub struct Grid {
    /// Content of `map.pgm`.
    pub pgm: Vec<u8>,
    /// Content of `map.yaml`.
    pub yaml: String,
}

/// Draws the grid of all scans.
pub fn render(replay: &Replay) -> Result<Grid, ImageError> {
    let mut canvas = Canvas::around(replay);
    for step in &replay.steps {
        let sensor = sensor_at(replay, step);
        for point in &step.points {
            canvas.cast(sensor, step.pose_in_final_map * point);
        }
    }
    let mut pgm = Vec::new();
    // map_server reads P5, binary grey, and nothing newer.
    let encoder = PnmEncoder::new(&mut pgm).with_subtype(PnmSubtype::Graymap(SampleEncoding::Binary));
    canvas.image().write_with_encoder(encoder)?;
    let yaml = format!(
        "image: map.pgm\nresolution: {}\norigin: [{}, {}, 0.0]\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n",
        canvas.cell_m, canvas.origin.x, canvas.origin.y
    );
    Ok(Grid { pgm, yaml })
}

/// Where the scanner was in the final map.
fn sensor_at(replay: &Replay, step: &Step) -> Point2<f32> {
    let base_from_laser = &replay.config.sensor.mounting.base_from_laser;
    step.pose_in_final_map * Point2::from(base_from_laser.translation.vector)
}

struct Canvas {
    origin: Point2<f32>,
    cell_m: f32,
    width: u32,
    height: u32,
    /// Beams that ended in a cell, beams that touched it.
    counts: Vec<[u32; 2]>,
}

impl Canvas {
    fn around(replay: &Replay) -> Self {
        let touched = replay.steps.iter().flat_map(|step| {
            let sensor = sensor_at(replay, step);
            let points = step.points.iter().map(|p| step.pose_in_final_map * p);
            points.filter(move |p| (p - sensor).norm() <= REACH_M).chain([sensor])
        });
        let (low, high) = bounds(touched);
        let extent = (high - low).max() + 2.0 * CELL_M;
        let cell_m = CELL_M.max(extent / MOST_CELLS);
        let origin = Point2::new((low.x / cell_m).floor() - 1.0, (low.y / cell_m).floor() - 1.0) * cell_m;
        let cells = |from: f32, to: f32| ((to - from) / cell_m).ceil() as u32 + 2;
        let (width, height) = (cells(origin.x, high.x), cells(origin.y, high.y));
        Self { origin, cell_m, width, height, counts: vec![[0; 2]; width as usize * height as usize] }
    }

    /// A beam from the sensor to an obstacle: the cells on its way, each once.
    fn cast(&mut self, from: Point2<f32>, to: Point2<f32>) {
        let length = (to - from).norm();
        if length > REACH_M {
            return;
        }
        let samples = (length / (0.5 * self.cell_m)).ceil().max(1.0) as u32;
        let end = self.index(to);
        let mut last = None;
        for k in 0..samples {
            let cell = self.index(from + (to - from) * (k as f32 / samples as f32));
            if cell != last && cell != end {
                self.count(cell, 0);
            }
            last = cell;
        }
        self.count(end, 1);
    }

    fn count(&mut self, cell: Option<usize>, ended: u32) {
        if let Some([ends, touches]) = cell.and_then(|c| self.counts.get_mut(c)) {
            *ends += ended;
            *touches += 1;
        }
    }

    fn index(&self, point: Point2<f32>) -> Option<usize> {
        let cell = (point - self.origin) / self.cell_m;
        let inside =
            cell.x >= 0.0 && cell.y >= 0.0 && cell.x < self.width as f32 && cell.y < self.height as f32;
        inside.then(|| cell.y as usize * self.width as usize + cell.x as usize)
    }

    fn image(&self) -> GrayImage {
        GrayImage::from_fn(self.width, self.height, |x, y| {
            // Images have their first row on top.
            let row = (self.height - 1 - y) as usize;
            let [ends, touches] = self.counts[row * self.width as usize + x as usize];
            Luma([match touches {
                0 => UNKNOWN,
                _ if ends as f32 >= OCCUPIED_SHARE * touches as f32 => OCCUPIED,
                _ => FREE,
            }])
        })
    }
}
