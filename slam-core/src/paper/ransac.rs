//! RANSAC lines, section 2.1 of the paper.
//!
//! Again and again the line through two points drawn at random with the most points near it is taken out of the
//! scan. Its inliers, in beam order, are cut where two consecutive ones are farther apart than a threshold; each part
//! gives a segment whose ends are the feet of the perpendiculars from its first and last inlier, and whose weight is
//! its number of inliers n. The paper does not say how many lines are drawn for each winner, nor its thresholds: those of
//! [`SlamConfig::paper`](crate::SlamConfig::paper) are ours.

use heapless::Vec;
use nalgebra::Point2;
use rand_core::{Rng, SeedableRng};
use rand_pcg::Pcg32;

use crate::frontend::deskew::ScanPoint;
use crate::frontend::extraction::{Collector, MAX_SEGMENTS, Viewpoint};
use crate::geometry::math::sqrt;
use crate::geometry::pose::perpendicular;
use crate::geometry::segment::{Line, Moments, Segment};

/// Most beams of a scan that RANSAC can tell apart; points of later beams are left out.
const MAX_BEAMS: usize = 2048;

/// Settings of RANSAC.
#[derive(Clone, Copy, Debug, PartialEq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct RansacConfig {
    /// Lines drawn at random for each line taken.
    pub draws: u16,
    /// A point is an inlier when its distance to the line is at most this, metres.
    pub inlier_distance_m: f32,
    /// Two consecutive inliers farther apart than this belong to two segments, metres.
    pub max_gap_m: f32,
    /// Fewest inliers of a segment.
    pub min_inliers: u16,
    /// Seed of the draws, to which the scan's number is added; see [`SlamConfig::with_ransac_seed`](crate::SlamConfig::with_ransac_seed).
    pub seed: u64,
}

/// Which points are still to be explained, a bit for each.
struct Free {
    words: [u32; MAX_BEAMS / 32],
    count: usize,
}

impl Free {
    fn new(points: usize) -> Self {
        let mut free = Self { words: [0; MAX_BEAMS / 32], count: points.min(MAX_BEAMS) };
        for index in 0..free.count {
            if let Some(word) = free.words.get_mut(index / 32) {
                *word |= 1 << (index % 32);
            }
        }
        free
    }

    fn contains(&self, index: usize) -> bool {
        self.words.get(index / 32).is_some_and(|word| word & (1 << (index % 32)) != 0)
    }

    fn remove(&mut self, index: usize) {
        if self.contains(index)
            && let Some(word) = self.words.get_mut(index / 32)
        {
            *word &= !(1 << (index % 32));
            self.count -= 1;
        }
    }

    /// A free point drawn at random.
    fn draw<'a>(&self, points: &'a [ScanPoint], rng: &mut Pcg32) -> Option<&'a ScanPoint> {
        // `count` > 0 is the caller's; a uniform index with rejection takes points/free draws on average.
        for _ in 0..64 * MAX_BEAMS {
            let index = ((u64::from(rng.next_u32()) * points.len().min(MAX_BEAMS) as u64) >> 32) as usize;
            if self.contains(index) {
                return points.get(index);
            }
        }
        None
    }
}

/// Extracts segments. Work: at most [`MAX_SEGMENTS`] lines of `draws` passes over the points.
// Not inlined: it takes 17 KiB of stack, which the default is not to pay for.
#[inline(never)]
pub(crate) fn extract(
    points: &[ScanPoint],
    view: &Viewpoint<'_>,
    config: &RansacConfig,
    scan_number: u32,
    out: &mut Collector<'_>,
) {
    let mut rng = Pcg32::seed_from_u64(config.seed.wrapping_add(u64::from(scan_number)));
    let mut free = Free::new(points.len());
    for _ in 0..MAX_SEGMENTS {
        if free.count < usize::from(config.min_inliers).max(2) {
            return;
        }
        let Some(line) = best_line(points, &free, config, &mut rng) else { return };
        take_line(points, &mut free, &line, view, config, out);
    }
}

fn inliers<'a>(
    points: &'a [ScanPoint],
    free: &'a Free,
    line: &'a Line,
    distance_m: f32,
) -> impl Iterator<Item = (usize, &'a ScanPoint)> {
    points
        .iter()
        .enumerate()
        .filter(move |(i, p)| free.contains(*i) && line.signed_distance(p.position).abs() <= distance_m)
}

/// The drawn line with the most inliers, if it has enough of them.
fn best_line(points: &[ScanPoint], free: &Free, config: &RansacConfig, rng: &mut Pcg32) -> Option<Line> {
    let mut best: Option<(usize, Line)> = None;
    for _ in 0..config.draws {
        let (a, b) = (free.draw(points, rng)?, free.draw(points, rng)?);
        let chord = b.position - a.position;
        let length = sqrt(chord.norm_squared());
        if length < 1e-3 {
            continue;
        }
        let normal = perpendicular(chord / length);
        let line = Line { normal, distance_m: normal.dot(&a.position.coords) };
        let count = inliers(points, free, &line, config.inlier_distance_m).count();
        if best.as_ref().is_none_or(|(most, _)| count > *most) {
            best = Some((count, line));
        }
    }
    best.filter(|(count, _)| *count >= usize::from(config.min_inliers)).map(|(_, line)| line)
}

/// Cuts the inliers of a line into segments and takes all of them out of the free points.
fn take_line(
    points: &[ScanPoint],
    free: &mut Free,
    line: &Line,
    view: &Viewpoint<'_>,
    config: &RansacConfig,
    out: &mut Collector<'_>,
) {
    let mut run: Vec<Point2<f32>, MAX_BEAMS> = Vec::new();
    let mut taken = [0u32; MAX_BEAMS / 32];
    for (index, point) in inliers(points, free, line, config.inlier_distance_m) {
        if let Some(word) = taken.get_mut(index / 32) {
            *word |= 1 << (index % 32);
        }
        if let Some(last) = run.last()
            && (point.position - last).norm_squared() > config.max_gap_m * config.max_gap_m
        {
            finish(&run, view, config, out);
            run.clear();
        }
        // The run cannot be longer than the points, of which there are at most as many.
        let _ = run.push(point.position);
    }
    finish(&run, view, config, out);
    for index in 0..points.len() {
        if taken.get(index / 32).is_some_and(|word| word & (1 << (index % 32)) != 0) {
            free.remove(index);
        }
    }
}

/// A run of inliers becomes a segment: the least-squares line, ended by the feet of the first and the last of them.
fn finish(run: &[Point2<f32>], view: &Viewpoint<'_>, config: &RansacConfig, out: &mut Collector<'_>) {
    let (Some(first), Some(last)) = (run.first(), run.last()) else { return };
    if run.len() < usize::from(config.min_inliers) {
        return;
    }
    let weight = 1.0 / view.sensor.noise.variance(0.0);
    let moments = Moments::from_points(run.iter().map(|&p| (p, weight)));
    out.push(Segment::fitted(moments, &[*first, *last], view.position));
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::SlamConfig;
    use crate::frontend::extraction::extract;
    use std::vec::Vec as StdVec;

    /// What is seen of two walls that meet, every point a little off.
    fn corner() -> StdVec<ScanPoint> {
        let off = |k: u16| 0.02 * (f32::from(k % 7) / 3.0 - 1.0);
        let point = |k: u16| {
            let along = f32::from(k % 60) * 0.05;
            let position = if k < 60 {
                Point2::new(3.0 + off(k), along - 3.0)
            } else {
                Point2::new(3.0 - along, off(k))
            };
            ScanPoint { position, range_m: position.coords.norm(), beam: k }
        };
        (0..120).map(point).collect()
    }

    fn segments(seed: u64, scan_number: u32) -> StdVec<Segment> {
        let config = SlamConfig::paper().with_ransac_seed(seed);
        let mut segments: Vec<Segment, MAX_SEGMENTS> = Vec::new();
        extract(&corner(), &config.sensor, &config.extraction, scan_number, &mut segments);
        segments.iter().copied().collect()
    }

    #[test]
    fn another_seed_draws_other_lines_and_the_same_one_the_same() {
        assert_eq!(segments(1, 7), segments(1, 7));
        assert_ne!(segments(1, 7), segments(1_000_001, 7));
        assert_ne!(segments(1, 7), segments(1, 8), "each scan has draws of its own");
        let default = SlamConfig::default();
        assert_eq!(default.with_ransac_seed(5), default, "nothing to draw");
    }
}
