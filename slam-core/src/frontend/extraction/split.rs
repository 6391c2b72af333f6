//! Split and merge in scan order.
//!
//! The points are cut into clusters where neighbours lie farther apart than a surface at grazing incidence explains.
//! A cluster is cut at the point farthest from its chord, in standard deviations of that point's range, until every
//! piece is straight; neighbouring pieces that are one line after all are joined again; ends that lean off the line
//! (corners, mixed pixels) are trimmed. A cluster that is round is no wall: its chord turns as the robot passes by. Each
//! line is the total-least-squares fit, weighted by range noise.
//!
//! Reference: Nguyen et al., "A comparison of line extraction algorithms using 2D range data" (2007), which found
//! split-and-merge fastest and among the most correct. The chi-square tests are ours.

use heapless::Vec;
use nalgebra::{Point2, Vector2};

use super::strip::{Frame, Sums, VarianceAcross};
use super::{Collector, Viewpoint};
use crate::frontend::deskew::ScanPoint;
use crate::geometry::math::{max, min, sin_cos, sqrt};
use crate::geometry::segment::{Moments, Segment};

/// Pieces waiting to be looked at. Each split adds one; deeper clusters give up their smallest detail.
const STACK: usize = 32;

/// Points nearer than this share of the sensor's range are surely within it.
const FAR_SHARE: f32 = 0.8;
/// Readings this many standard deviations within the sensor's range are not lost.
const LOST_SIGMAS: f32 = 4.0;
/// Parts of a piece, at least, between which a cut is looked for first; of a short one there are up to twice as many.
const PARTS: usize = 8;
/// Fewest points on either side of such a cut.
const LEAST_PART: usize = 3;
/// Fewer points than these do not tell a circle from a corner.
const LEAST_ROUND: usize = 15;
/// χ² by which a circle may be worse than a corner, which has two numbers more to fit.
const MARGIN: f32 = 6.0;
/// A line goes on behind this many points off it.
const MOST_STRAYS: usize = 2;

/// Settings of split and merge.
#[derive(Clone, Copy, Debug, PartialEq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct SplitConfig {
    /// Neighbouring points farther apart than this may belong to different surfaces, metres.
    pub max_gap_m: f32,
    /// A surface seen at a flatter angle than this is not followed across wider spacings, radians.
    pub min_incidence_rad: f32,
    /// Most beams without a distance inside a segment, …
    pub max_missing_beams: u16,
    /// … which may have met no wall at all where they leave a wider gap than this, metres: an opening seen at a slant.
    pub max_unseen_m: f32,
    /// A point this many standard deviations off the chord splits a piece.
    pub split_sigmas: f32,
    /// Neighbouring pieces are one line when joining them costs each point of the smaller piece no more χ² than this.
    pub merge_chi2: f32,
    /// Ends farther off the line than this many standard deviations are trimmed.
    pub trim_sigmas: f32,
    /// Largest mean χ² of a point of a segment.
    pub max_mean_chi2: f32,
    /// Fewest points of a segment.
    pub min_inliers: u32,
    /// Shortest segment, metres.
    pub min_length_m: f32,
    /// A cluster that a circle up to this radius explains, and a line does not, is round, metres.
    pub max_round_radius_m: f32,
    /// A segment whose direction is less sure than this, by its points' noise, is a cluster and no line, radians.
    pub max_sigma_direction_rad: f32,
}

/// χ² with two degrees of freedom that chance reaches once in a hundred times: what a second line saves without need.
const CHANCE_CHI2: f32 = 9.0;

/// What stays the same for a scan.
struct Extraction<'a> {
    view: &'a Viewpoint<'a>,
    config: &'a SplitConfig,
    variance: VarianceAcross,
    /// Distance of neighbouring points of a surface seen at the flattest angle, metres for each metre of range.
    spacing_per_m: f32,
}

/// Extracts segments. Work: two passes over the points, one more for each level of splitting; at most points² in all, when
/// every split takes off a single point.
pub(crate) fn extract(
    points: &[ScanPoint],
    view: &Viewpoint<'_>,
    config: &SplitConfig,
    out: &mut Collector<'_>,
) {
    let sin_incidence = max(sin_cos(config.min_incidence_rad).0, 1e-3);
    let spacing_per_m = view.sensor.geometry.step_rad() / sin_incidence;
    let extraction = Extraction { view, config, variance: VarianceAcross::new(view), spacing_per_m };
    let mut rest = points;
    while !rest.is_empty() {
        let pairs = rest.iter().zip(rest.iter().skip(1));
        let length = 1 + pairs.take_while(|(a, b)| extraction.joined(a, b)).count();
        let (cluster, tail) = rest.split_at(length.min(rest.len()));
        extraction.split_cluster(cluster, out);
        rest = tail;
    }
}

impl Extraction<'_> {
    /// Whether two neighbouring points may lie on one surface.
    fn joined(&self, a: &ScanPoint, b: &ScanPoint) -> bool {
        let beams = b.beam.saturating_sub(a.beam);
        if beams > self.config.max_missing_beams.saturating_add(1) {
            return false;
        }
        let apart2 = (b.position - a.position).norm_squared();
        if apart2 <= self.config.max_gap_m * self.config.max_gap_m {
            return true;
        }
        if beams > 1 && apart2 > self.config.max_unseen_m * self.config.max_unseen_m {
            return false;
        }
        let range_m = min(a.range_m, b.range_m);
        let gap_m = max(self.spacing_per_m * range_m * f32::from(beams), self.config.max_gap_m);
        // Noise alone sets neighbours √2·σ apart along the beam; a wall must not end where it happens to.
        let variance = 2.0 * self.view.sensor.noise.variance(range_m);
        let limit_m = gap_m + self.config.split_sigmas * sqrt(variance);
        apart2 <= limit_m * limit_m
    }

    fn split_cluster(&self, cluster: &[ScanPoint], out: &mut Collector<'_>) {
        if (cluster.len() as u32) < self.config.min_inliers || self.is_round(cluster) {
            return;
        }
        let mut stack: Vec<(usize, usize), STACK> = Vec::new();
        // The piece that may still grow at its end.
        let mut open: Option<(usize, usize, Moments)> = None;
        let mut next = Some((0, cluster.len()));
        while let Some((from, to)) = next.or_else(|| stack.pop()) {
            next = None;
            let Some(points) = cluster.get(from..to) else { break };
            let moments = match self.cut_or_sums(points) {
                Ok(cut) if stack.push((from + cut, to)).is_ok() => {
                    next = Some((from, from + cut));
                    continue;
                }
                Ok(_) => self.chord_moments(points),
                Err(moments) => moments,
            };
            open = match open {
                Some((open_from, _, sums)) if is_one_line(&sums, &moments, self.config) => {
                    Some((open_from, to, sums.merged(&moments)))
                }
                // A point or two off the line are noise until the next piece says otherwise.
                Some(line) if points.len() <= MOST_STRAYS && line.1 + MOST_STRAYS >= to => Some(line),
                closed => {
                    self.close(cluster, closed, out);
                    Some((from, to, moments))
                }
            };
        }
        self.close(cluster, open, out);
    }

    /// Whether a cluster is a pillar, a leg or a person: small, and better explained by a circle (Kåsa's fit) than by a line, or by
    /// two that meet in a corner.
    fn is_round(&self, cluster: &[ScanPoint]) -> bool {
        // The first and the last may be mixed with what lies behind.
        let Some([_, points @ .., _]) = Some(cluster).filter(|c| c.len() >= LEAST_ROUND + 2) else {
            return false;
        };
        let most_m = self.config.max_round_radius_m;
        let (Some(chord), Some([first, .., last])) = (Frame::of_chord(points, self.view), Some(points))
        else {
            return false;
        };
        if (last.position - first.position).norm_squared() > 4.0 * most_m * most_m {
            return false;
        }
        let weight = 1.0 / self.view.sensor.noise.variance(first.range_m);
        let moments =
            |points: &[ScanPoint]| Moments::from_points(points.iter().map(|p| (p.position, weight)));
        let all = moments(points);
        let [xx, xy, yy] = all.scatter;
        let third = points.iter().fold(Vector2::zeros(), |sum, point| {
            let off = point.position - all.centroid;
            sum + off * (weight * off.norm_squared())
        });
        let to_centre = Vector2::new(third.x * yy - third.y * xy, third.y * xx - third.x * xy)
            * (0.5 / (xx * yy - xy * xy));
        let radius_m = sqrt(to_centre.norm_squared() + (xx + yy) / all.weight);
        // Seen from outside it is a thing, from inside a niche. False where the points lie on a line, and there is no circle.
        let is_thing = radius_m <= most_m && to_centre.dot(&(all.centroid - self.view.position)) > 0.0;
        if !is_thing {
            return false;
        }
        let centre = all.centroid + to_centre;
        let off_circle = |point: &ScanPoint| sqrt((point.position - centre).norm_squared()) - radius_m;
        let circle: f32 = points.iter().map(off_circle).map(|off| weight * off * off).sum();
        if all.residual() - circle < CHANCE_CHI2 {
            return false;
        }
        let (mut farthest, mut at) = (0.0, 0);
        for (index, point) in points.iter().enumerate() {
            let off = chord.off(point).abs();
            if off > farthest {
                (farthest, at) = (off, index);
            }
        }
        let (before, behind) = points.split_at(at.min(points.len()));
        circle <= moments(before).residual() + moments(behind).residual() + MARGIN
    }

    fn close(&self, cluster: &[ScanPoint], open: Option<(usize, usize, Moments)>, out: &mut Collector<'_>) {
        if let Some((from, to, moments)) = open
            && let Some(points) = cluster.get(from..to)
        {
            self.finish(points, &moments, out);
        }
    }

    /// Where to cut a piece, or its sums if it is straight.
    fn cut_or_sums(&self, points: &[ScanPoint]) -> Result<usize, Moments> {
        let Some(frame) = Frame::of_chord(points, self.view) else { return Err(self.chord_moments(points)) };
        match self.farthest_from_chord(points, &frame) {
            Some(cut) => Ok(cut),
            None => self.two_lines(points, &frame),
        }
    }

    /// Weighted sums over a run of points whose surface lies along its chord.
    fn chord_moments(&self, points: &[ScanPoint]) -> Moments {
        let Some(first) = points.first() else { return Moments::EMPTY };
        // A run that ends where it began has no surface; any direction serves.
        let frame =
            Frame::of_chord(points, self.view).unwrap_or_else(|| Frame::of_point(first.position, self.view));
        frame.moments(&frame.sums(points, &self.variance))
    }

    /// Index at which to cut: the point farthest from the chord, in standard deviations, if any is too far off.
    fn farthest_from_chord(&self, points: &[ScanPoint], frame: &Frame) -> Option<usize> {
        let inner = points.get(1..points.len().checked_sub(1)?)?;
        let (mut worst, mut cut) = (self.config.split_sigmas * self.config.split_sigmas, None);
        for (i, point) in inner.iter().enumerate() {
            let off = frame.off(point);
            let range2 = point.range_m * point.range_m;
            let distance = frame.distance_m + off;
            let scaled = self.variance.times_range2(range2, distance * distance);
            let off2 = off * off * range2;
            if off2 > worst * scaled {
                (worst, cut) = (off2 / scaled, Some(i + 1));
            }
        }
        cut
    }

    /// Index at which to cut a piece that two lines fit better than one: a step in a wall, too low for any single point
    /// to show it. Otherwise the sums over the piece.
    fn two_lines(&self, points: &[ScanPoint], frame: &Frame) -> Result<usize, Moments> {
        let coarse = (points.len() / PARTS).max(1);
        // Over the points before each place where a cut is looked for first.
        let mut before: Vec<Sums, { 2 * PARTS }> = Vec::new();
        let mut all = Sums::default();
        for part in points.chunks(coarse) {
            // Fewer parts than twice PARTS: a piece shorter than that has parts of one point each.
            let _ = before.push(all);
            part.iter().for_each(|point| frame.add(point, &self.variance, &mut all));
        }
        let total = all.residual();
        // No cut saves more than all there is.
        if total <= CHANCE_CHI2 {
            return Err(frame.moments(&all));
        }
        let mut best: Option<(usize, f32)> = None;
        for (part, first) in before.iter().enumerate() {
            self.consider(part * coarse, first, &all, total, &mut best);
        }
        let Some((near, _)) = best else { return Err(frame.moments(&all)) };
        let from = near.saturating_sub(coarse);
        let mut first = before.get(from / coarse).copied().unwrap_or_default();
        best = None;
        for (i, point) in points.iter().enumerate().skip(from).take(2 * coarse - 1) {
            frame.add(point, &self.variance, &mut first);
            self.consider(i + 1, &first, &all, total, &mut best);
        }
        best.map(|(cut, _)| cut).ok_or_else(|| frame.moments(&all))
    }

    /// Takes a cut for the best if it is: given are the sums before it and over all, and the χ² of all.
    fn consider(&self, cut: usize, first: &Sums, all: &Sums, total: f32, best: &mut Option<(usize, f32)>) {
        let second = all.without(first);
        let fewer = first.inliers.min(second.inliers);
        if (fewer as usize) < LEAST_PART {
            return;
        }
        let saved = total - first.residual() - second.residual();
        if saved > joining_limit(fewer, self.config) && best.is_none_or(|(_, most)| saved >= most) {
            *best = Some((cut, saved));
        }
    }

    /// Whether the line lies so near the end of the sensor's range at a point that farther readings of it were lost: what
    /// remains there is too near on average.
    fn beyond_sight(&self, point: &ScanPoint, off: f32, frame: &Frame) -> bool {
        let max_m = f32::from(self.view.sensor.codes.max_mm) * 1e-3;
        if point.range_m < FAR_SHARE * max_m {
            return false;
        }
        let line_range_m = point.range_m * frame.distance_m / (frame.distance_m + off);
        let limit_m = max_m - LOST_SIGMAS * sqrt(self.view.sensor.noise.variance(max_m));
        line_range_m > limit_m
    }

    /// Trims the ends, tests and keeps a piece.
    fn finish(&self, points: &[ScanPoint], fit: &Moments, out: &mut Collector<'_>) {
        let config = self.config;
        if fit.inliers < config.min_inliers {
            return;
        }
        let frame = Frame::of_fit(fit, self.view);
        let off_line = |point: &&ScanPoint| {
            let off = frame.off(point);
            let (range2, distance) = (point.range_m * point.range_m, frame.distance_m + off);
            let limit = config.trim_sigmas
                * config.trim_sigmas
                * self.variance.times_range2(range2, distance * distance);
            off * off * range2 > limit || self.beyond_sight(point, off, &frame)
        };
        let leading = points.iter().take_while(off_line).count();
        let trailing = points.iter().rev().take_while(off_line).count();
        let Some(kept) = points.get(leading..points.len().saturating_sub(trailing)) else { return };
        let sums = frame.refined_sums(kept, self.view, &self.variance, config.split_sigmas);
        let moments = frame.moments(&sums);
        let (Some(first), Some(last)) = (kept.first(), kept.last()) else { return };
        let ends: [Point2<f32>; 2] = [first.position, last.position];
        let segment = Segment::fitted(moments, &ends, self.view.position);
        let straight = sums.residual() <= config.max_mean_chi2 * moments.inliers as f32;
        let directed = moments.scatter_along(segment.direction)
            * config.max_sigma_direction_rad
            * config.max_sigma_direction_rad
            >= 1.0;
        let long = moments.inliers >= config.min_inliers && segment.length_m() >= config.min_length_m;
        if long && straight && directed {
            out.push(segment);
        }
    }
}

/// Whether two neighbouring pieces are one line: their common fit must not be worse than their own.
fn is_one_line(a: &Moments, b: &Moments, config: &SplitConfig) -> bool {
    let cost = a.merged(b).residual() - a.residual() - b.residual();
    cost <= joining_limit(a.inliers.min(b.inliers), config)
}

/// χ² that joining two pieces of one line may cost, by the points of the smaller.
fn joining_limit(fewer: u32, config: &SplitConfig) -> f32 {
    max(config.merge_chi2 * fewer as f32, CHANCE_CHI2)
}
