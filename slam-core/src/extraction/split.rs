//! Split and merge in scan order.
//!
//! The points are cut into clusters where neighbours lie farther apart than a surface at grazing incidence explains.
//! A cluster is cut at the point farthest from its chord, in standard deviations of that point's range, until every
//! piece is straight; neighbouring pieces that are one line after all are joined again; ends that lean off the line
//! (corners, mixed pixels) are trimmed. Each line is the total-least-squares fit, weighted by range noise.
//!
//! Reference: Nguyen et al., "A comparison of line extraction algorithms using 2D range data" (2007), which found
//! split-and-merge fastest and among the most correct. The chi-square tests are ours.

use heapless::Vec;
use nalgebra::{Point2, Vector2};

use super::{Collector, Viewpoint, variance_across};
use crate::deskew::ScanPoint;
use crate::math::{sin_cos, sqrt};
use crate::pose::perpendicular;
use crate::segment::{Moments, Segment};

/// Pieces waiting to be looked at. Each split adds one; deeper clusters give up their smallest detail.
const STACK: usize = 32;

/// Points nearer than this share of the sensor's range are surely within it.
const FAR_SHARE: f32 = 0.8;
/// Readings this many standard deviations within the sensor's range are not lost.
const LOST_SIGMAS: f32 = 4.0;
/// Parts of a piece between which a cut is looked for first.
const PARTS: usize = 8;
/// Fewest points on either side of such a cut.
const LEAST_PART: usize = 3;
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
    /// Most beams without a distance inside a segment.
    pub max_missing_beams: u16,
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
    /// A segment whose direction is less sure than this, by its points' noise, is a cluster and no line, radians.
    pub max_sigma_direction_rad: f32,
}

/// Extracts segments. Work: two passes over the points for each level of splitting, at most points² in all when every
/// split takes off a single point.
pub(crate) fn extract(
    points: &[ScanPoint],
    view: &Viewpoint<'_>,
    config: &SplitConfig,
    out: &mut Collector<'_>,
) {
    let sin_incidence = sin_cos(config.min_incidence_rad).0.max(1e-3);
    let spacing_per_m = view.sensor.geometry.step_rad() / sin_incidence;
    let mut rest = points;
    while !rest.is_empty() {
        let length = 1 + rest
            .iter()
            .zip(rest.iter().skip(1))
            .take_while(|(a, b)| joined(a, b, view, config, spacing_per_m))
            .count();
        let (cluster, tail) = rest.split_at(length.min(rest.len()));
        split_cluster(cluster, view, config, out);
        rest = tail;
    }
}

/// Whether two neighbouring points may lie on one surface.
fn joined(
    a: &ScanPoint,
    b: &ScanPoint,
    view: &Viewpoint<'_>,
    config: &SplitConfig,
    spacing_per_m: f32,
) -> bool {
    let beams = b.beam.saturating_sub(a.beam);
    let spacing_m = spacing_per_m * a.range_m.min(b.range_m) * f32::from(beams);
    // Noise alone sets neighbours √2·σ apart along the beam; a wall must not end where it happens to.
    let noise_m = config.split_sigmas * sqrt(2.0 * view.sensor.noise.variance(a.range_m.min(b.range_m)));
    let limit_m = config.max_gap_m.max(spacing_m) + noise_m;
    beams <= config.max_missing_beams.saturating_add(1)
        && (b.position - a.position).norm_squared() <= limit_m * limit_m
}

fn split_cluster(cluster: &[ScanPoint], view: &Viewpoint<'_>, config: &SplitConfig, out: &mut Collector<'_>) {
    if (cluster.len() as u32) < config.min_inliers {
        return;
    }
    let mut stack: Vec<(usize, usize), STACK> = Vec::new();
    // The piece that may still grow at its end.
    let mut open: Option<(usize, usize, Moments)> = None;
    let mut next = Some((0, cluster.len()));
    while let Some((from, to)) = next.or_else(|| stack.pop()) {
        next = None;
        let Some(points) = cluster.get(from..to) else { break };
        if let Some(cut) =
            farthest_from_chord(points, view, config.split_sigmas).or_else(|| two_lines(points, view, config))
            && stack.push((from + cut, to)).is_ok()
        {
            next = Some((from, from + cut));
            continue;
        }
        let moments = chord_moments(points, view);
        open = match open {
            Some((open_from, _, sums)) if is_one_line(&sums, &moments, config) => {
                Some((open_from, to, sums.merged(&moments)))
            }
            // A point or two off the line are noise until the next piece says otherwise.
            Some(line) if points.len() <= MOST_STRAYS && line.1 + MOST_STRAYS >= to => Some(line),
            closed => {
                close(cluster, closed, view, config, out);
                Some((from, to, moments))
            }
        };
    }
    close(cluster, open, view, config, out);
}

fn close(
    cluster: &[ScanPoint],
    open: Option<(usize, usize, Moments)>,
    view: &Viewpoint<'_>,
    config: &SplitConfig,
    out: &mut Collector<'_>,
) {
    if let Some((from, to, moments)) = open
        && let Some(points) = cluster.get(from..to)
    {
        finish(points, &moments, view, config, out);
    }
}

/// Index at which to cut: the point farthest from the chord, if any is more than `sigmas` standard deviations off.
fn farthest_from_chord(points: &[ScanPoint], view: &Viewpoint<'_>, sigmas: f32) -> Option<usize> {
    let first = points.first()?;
    let normal = chord_normal(points)?;
    if points.len() < 3 {
        return None;
    }
    let (mut worst, mut cut) = (sigmas * sigmas, None);
    for (i, point) in points.iter().enumerate().skip(1).take(points.len() - 2) {
        let off = normal.dot(&(point.position - first.position));
        let chi2 = off * off / variance_across(point, normal, view);
        if chi2 > worst {
            (worst, cut) = (chi2, Some(i));
        }
    }
    cut
}

/// Index at which to cut a piece that two lines fit better than one: a step in a wall, too low for any single point to
/// show it.
fn two_lines(points: &[ScanPoint], view: &Viewpoint<'_>, config: &SplitConfig) -> Option<usize> {
    let coarse = (points.len() / PARTS).max(1);
    let normal = chord_normal(points)?;
    let all = weighed_moments(points, normal, view);
    // χ² saved by two lines over what two lines of chance would save; positive where a cut is due.
    let saved = |cut: usize| {
        let (a, b) = points.split_at_checked(cut).filter(|(a, b)| a.len().min(b.len()) >= LEAST_PART)?;
        let (a, b) = (weighed_moments(a, normal, view), weighed_moments(b, normal, view));
        let cost = all.residual() - a.residual() - b.residual();
        let due = cost - joining_limit(&a, &b, config);
        (due > 0.0).then_some((cut, cost))
    };
    let best = |cuts: &mut dyn Iterator<Item = usize>| {
        cuts.filter_map(saved).max_by(|a, b| a.1.total_cmp(&b.1)).map(|(cut, _)| cut)
    };
    let near = best(&mut (coarse..points.len()).step_by(coarse))?;
    best(&mut (near.saturating_sub(coarse) + 1..near + coarse))
}

/// Unit normal of the line through the first and last point; `None` where they coincide.
fn chord_normal(points: &[ScanPoint]) -> Option<Vector2<f32>> {
    let chord = perpendicular(points.last()?.position - points.first()?.position);
    let length = sqrt(chord.norm_squared());
    (length > 0.0).then(|| chord / length)
}

/// Weighted sums over a run of points whose surface lies along its chord.
fn chord_moments(points: &[ScanPoint], view: &Viewpoint<'_>) -> Moments {
    // A run that ends where it began has no surface; x serves as well as any.
    let normal = chord_normal(points).unwrap_or_else(Vector2::x);
    weighed_moments(points, normal, view)
}

/// Sums over points of a surface with this normal, each weighed by its noise across it.
fn weighed_moments(points: &[ScanPoint], normal: Vector2<f32>, view: &Viewpoint<'_>) -> Moments {
    Moments::from_points(points.iter().map(|p| (p.position, 1.0 / variance_across(p, normal, view))))
}

/// Whether two neighbouring pieces are one line: their common fit must not be worse than their own.
fn is_one_line(a: &Moments, b: &Moments, config: &SplitConfig) -> bool {
    let cost = a.merged(b).residual() - a.residual() - b.residual();
    cost <= joining_limit(a, b, config)
}

/// χ² that joining two pieces of one line may cost.
fn joining_limit(a: &Moments, b: &Moments, config: &SplitConfig) -> f32 {
    // 9: the 99 % point of χ² with the two degrees of freedom that a second line has.
    (config.merge_chi2 * a.inliers.min(b.inliers) as f32).max(9.0)
}

/// Sums over the points of a line that is nearly known, free of two biases of a plain fit.
///
/// Range noise moves a point along its beam: off the line, and along it by an amount that depends on the first. Seen at an
/// angle, that correlation turns a total-least-squares line by σ²·sinβ·cosβ over the variance along it, always the
/// same way. So each point is taken where its beam meets the known line, off it by what it was off. And the noise is taken
/// for the range of the known line: taken for the range measured, points too near would weigh more.
fn refined(points: &[ScanPoint], line: &Moments, view: &Viewpoint<'_>, config: &SplitConfig) -> Moments {
    let normal = perpendicular(line.direction());
    let to_line = normal.dot(&(line.centroid - view.position));
    let on_line = points.iter().filter_map(|point| {
        let from_view = point.position - view.position;
        let share = to_line / normal.dot(&from_view);
        let known = ScanPoint {
            position: view.position + from_view * share,
            range_m: point.range_m * share,
            ..*point
        };
        let off = normal.dot(&(point.position - line.centroid));
        let variance = variance_across(&known, normal, view);
        let stray = off * off > config.split_sigmas * config.split_sigmas * variance;
        (variance.is_finite() && !stray).then(|| (known.position + normal * off, 1.0 / variance))
    });
    Moments::from_points(on_line)
}

/// Whether the line lies so near the end of the sensor's range at a point that farther readings of it were lost: what
/// remains there is too near on average.
fn beyond_sight(point: &ScanPoint, normal: Vector2<f32>, line: &Moments, view: &Viewpoint<'_>) -> bool {
    let max_m = f32::from(view.sensor.codes.max_mm) * 1e-3;
    if point.range_m < FAR_SHARE * max_m {
        return false;
    }
    let along_beam = normal.dot(&(point.position - view.position));
    let to_line = normal.dot(&(line.centroid - view.position));
    let line_range_m = point.range_m * to_line / along_beam;
    let limit_m = max_m - LOST_SIGMAS * sqrt(view.sensor.noise.variance(max_m));
    line_range_m > limit_m
}

/// Trims the ends, tests and keeps a piece.
fn finish(
    points: &[ScanPoint],
    fit: &Moments,
    view: &Viewpoint<'_>,
    config: &SplitConfig,
    out: &mut Collector<'_>,
) {
    if fit.inliers < config.min_inliers {
        return;
    }
    let normal = perpendicular(fit.direction());
    let off_line = |point: &ScanPoint| {
        let off = normal.dot(&(point.position - fit.centroid));
        let limit = config.trim_sigmas * config.trim_sigmas * variance_across(point, normal, view);
        off * off > limit || beyond_sight(point, normal, fit, view)
    };
    let leading = points.iter().take_while(|p| off_line(p)).count();
    let trailing = points.iter().rev().take_while(|p| off_line(p)).count();
    let Some(kept) = points.get(leading..points.len().saturating_sub(trailing)) else { return };
    let moments = refined(kept, fit, view, config);
    let moments = refined(kept, &moments, view, config);
    let (Some(first), Some(last)) = (kept.first(), kept.last()) else { return };
    let ends: [Point2<f32>; 2] = [first.position, last.position];
    let segment = Segment::fitted(moments, &ends, view.position);
    let straight = moments.residual() <= config.max_mean_chi2 * moments.inliers as f32;
    let directed = moments.scatter_along(segment.direction)
        * config.max_sigma_direction_rad
        * config.max_sigma_direction_rad
        >= 1.0;
    let long = moments.inliers >= config.min_inliers && segment.length_m() >= config.min_length_m;
    if long && straight && directed {
        out.push(segment);
    }
}
