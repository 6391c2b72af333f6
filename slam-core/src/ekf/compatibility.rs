//! Whether pairs of a scan can all be right: observed segments that are one line of the map must be on one line themselves.
//!
//! A door niche and the wall beside it may each agree with a line that is not sure of its direction, and together they would tilt it.
//! No error of the pose is in the difference between two segments of one scan, so that it tells a step of a few centimetres.
//!
//! Reference: Neira and Tardós, "Data Association in Stochastic Mapping Using the Joint Compatibility Test" (2001). They search the
//! largest set of pairs that agree; here the segment with more points decides, and only segments of the same line are compared.

use heapless::Vec;
use nalgebra::{Matrix3, Point2};

use crate::frontend::extraction::MAX_SEGMENTS;
use crate::geometry::line_noise::LineNoise;
use crate::geometry::line_observation::Residual;
use crate::geometry::segment::Segment;
use crate::tracking::association::Pair;

/// The pairs but those that another pair of the same line, with more points, rules out. `observed` are the segments in any one frame.
///
/// Work: pairs² comparisons of two numbers, and one χ² for each two pairs of a line.
pub(super) fn jointly_compatible(
    pairs: &[Pair],
    observed: &[Segment],
    noise: &LineNoise,
    max_chi2: f32,
) -> Vec<Pair, MAX_SEGMENTS> {
    let rules_out = |first: usize, second: usize| {
        let (Some(a), Some(b)) = (pairs.get(first), pairs.get(second)) else { return false };
        if first == second || a.mapped != b.mapped {
            return false;
        }
        let (Some(a), Some(b)) = (observed.get(a.observed), observed.get(b.observed)) else { return false };
        let says_more = (a.moments.inliers, second) > (b.moments.inliers, first);
        says_more && chi2(a, b, noise).is_some_and(|chi2| chi2 > max_chi2)
    };
    let stays = |(index, _): &(usize, &Pair)| !(0..pairs.len()).any(|other| rules_out(other, *index));
    pairs.iter().enumerate().filter(stays).map(|(_, pair)| *pair).take(MAX_SEGMENTS).collect()
}

/// χ² of two segments being on one line, with two degrees of freedom. `None` for segments without extent.
fn chi2(a: &Segment, b: &Segment, noise: &LineNoise) -> Option<f32> {
    // Where the robot is does not matter: its pose is not in question.
    let residual = Residual::new(b, a, Point2::origin(), noise)?;
    Some(residual.chi2(&Matrix3::zeros()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::segment::Moments;

    const NOISE: LineNoise = LineNoise { sigma_offset_m: 0.01, sigma_direction_rad: 0.002 };

    /// A wall along x with a point every centimetre, each with σ = 1 cm.
    fn wall(from_x: f32, to_x: f32, y: f32) -> Segment {
        let points = ((to_x - from_x) * 100.0) as usize;
        let points = (0..=points).map(|i| (Point2::new(from_x + i as f32 * 0.01, y), 1e4));
        Segment::fitted(
            Moments::from_points(points),
            &[Point2::new(from_x, y), Point2::new(to_x, y)],
            Point2::new(0.0, 5.0),
        )
    }

    fn kept(observed: &[Segment], mapped: &[usize]) -> std::vec::Vec<usize> {
        let pairs: std::vec::Vec<Pair> =
            (0..).zip(mapped).map(|(observed, &mapped)| Pair { observed, mapped }).collect();
        jointly_compatible(&pairs, observed, &NOISE, 9.2).iter().map(|pair| pair.observed).collect()
    }

    #[test]
    fn a_niche_and_the_wall_beside_it_are_not_one_line() {
        let [niche, wall_behind] = [wall(0.0, 0.9, 0.1), wall(0.9, 3.0, 0.0)];
        assert_eq!(kept(&[niche, wall_behind], &[4, 4]), [1], "the longer one says more");
        assert_eq!(kept(&[wall_behind, niche], &[4, 4]), [0]);
        assert_eq!(kept(&[niche, wall_behind], &[4, 5]), [0, 1], "of two lines");
    }

    #[test]
    fn a_wall_behind_an_opening_goes_on() {
        let [before, behind] = [wall(0.0, 1.0, 0.005), wall(2.0, 3.0, 0.0)];
        assert_eq!(kept(&[before, behind], &[4, 4]), [0, 1]);
    }

    #[test]
    fn of_two_that_say_as_much_the_first_stays() {
        let [a, b] = [wall(0.0, 1.0, 0.0), wall(1.0, 2.0, 0.1)];
        assert_eq!(kept(&[a, b], &[4, 4]), [0]);
        assert_eq!(kept(&[], &[]), std::vec::Vec::<usize>::new());
    }
}
