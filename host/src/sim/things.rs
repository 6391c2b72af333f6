//! What a building has besides walls: radiators, curtains, frames of doors, sills; and what surfaces are like.

use nalgebra::{Point2, Vector2};
use serde::Deserialize;

use super::world::{Edge, World};
use crate::toml_file::{Impossible, positive};

/// Ribs of a radiator: one in so many metres.
const RIB_M: f64 = 0.08;
/// The gaps between ribs are so deep, as a share of the radiator's depth.
const GAP: f64 = 0.4;
/// Straight pieces of a fold of a curtain.
const FOLD_PIECES: f64 = 6.0;
/// Width of a door frame's post along the wall, metres, and how far it stands out of the wall.
const POST_M: [f64; 2] = [0.07, 0.02];

/// What a surface is like, for a scanner.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Finish {
    /// Paint, wood, paper.
    #[default]
    Plain,
    /// Black: a real scanner sees it near only.
    Dark,
    /// Metal, varnish: seen flat it sends the beam elsewhere.
    Shiny,
    /// Glass.
    Glass,
}

/// A radiator with ribs. It stands out to the left of the way from one end to the other.
#[derive(Clone, Copy, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Radiator {
    /// One end, at the wall.
    pub from: [f64; 2],
    /// The other end.
    pub to: [f64; 2],
    /// How far it stands out.
    pub depth: f64,
}

/// A curtain in folds, to the left of the way from one end to the other.
#[derive(Clone, Copy, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Curtain {
    /// One end.
    pub from: [f64; 2],
    /// The other end.
    pub to: [f64; 2],
    /// Depth of the folds.
    pub depth: f64,
    /// Length of a fold.
    pub fold: f64,
    /// What it is like.
    #[serde(default)]
    pub finish: Finish,
}

/// The frame of a door: posts on both sides of an opening in a wall.
#[derive(Clone, Copy, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Door {
    /// One side of the opening, in the middle of the wall.
    pub from: [f64; 2],
    /// The other side.
    pub to: [f64; 2],
    /// Thickness of the wall.
    pub thickness: f64,
}

/// A sill on the floor, straight.
#[derive(Clone, Copy, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Sill {
    /// One end.
    pub from: [f64; 2],
    /// The other end.
    pub to: [f64; 2],
    /// How high it is.
    pub height: f64,
}

impl World {
    /// Straight surfaces of radiators, curtains and door frames.
    pub(super) fn thing_edges(&self) -> Vec<(Edge, Finish)> {
        let mut edges = Vec::new();
        for r in &self.radiators {
            edges.extend(polyline(&r.outline(), Finish::Plain));
        }
        for c in &self.curtains {
            edges.extend(polyline(&c.outline(), c.finish));
        }
        for d in &self.doors {
            for post in d.posts() {
                edges.extend(polyline(&post, Finish::Plain));
            }
        }
        edges
    }

    /// Says which of them is impossible.
    pub(super) fn check_things(&self) -> Result<(), Impossible> {
        let ends = |what: &str, i: usize, ends: [[f64; 2]; 2], sizes: &[(&str, f64)]| {
            let name = format!("{what} {}", i + 1);
            if let Some(v) = ends.iter().flatten().find(|v| !v.is_finite()) {
                return Err((name, format!("{v} is not finite")));
            }
            if ends[0] == ends[1] {
                return Err((name, "begins where it ends".into()));
            }
            sizes.iter().try_for_each(|(key, value)| positive(format!("{name}: {key}"), *value))
        };
        for (i, r) in self.radiators.iter().enumerate() {
            ends("radiator", i, [r.from, r.to], &[("depth", r.depth)])?;
        }
        for (i, c) in self.curtains.iter().enumerate() {
            ends("curtain", i, [c.from, c.to], &[("depth", c.depth), ("fold", c.fold)])?;
        }
        for (i, d) in self.doors.iter().enumerate() {
            ends("door", i, [d.from, d.to], &[("thickness", d.thickness)])?;
        }
        for (i, s) in self.sills.iter().enumerate() {
            ends("sill", i, [s.from, s.to], &[("height", s.height)])?;
        }
        Ok(())
    }
}

fn polyline(points: &[Point2<f64>], finish: Finish) -> Vec<(Edge, Finish)> {
    points.windows(2).map(|w| (Edge { from: w[0], to: w[1], glass: false }, finish)).collect()
}

/// Start, unit direction, unit normal to the left, and length.
fn axes(from: [f64; 2], to: [f64; 2]) -> (Point2<f64>, Vector2<f64>, Vector2<f64>, f64) {
    let (from, to): (Point2<f64>, Point2<f64>) = (from.into(), to.into());
    let length = (to - from).norm();
    let along = (to - from) / length;
    (from, along, Vector2::new(-along.y, along.x), length)
}

impl Radiator {
    fn outline(&self) -> Vec<Point2<f64>> {
        let (from, along, out, length) = axes(self.from, self.to);
        let ribs = (length / RIB_M).round().max(1.0) as usize;
        let pitch = length / ribs as f64;
        let mut points = vec![from];
        for rib in 0..ribs {
            let at = |share: f64, depth: f64| from + along * ((rib as f64 + share) * pitch) + out * depth;
            points.extend([at(0.0, self.depth), at(0.7, self.depth)]);
            if rib + 1 < ribs {
                points.extend([at(0.7, self.depth * (1.0 - GAP)), at(1.0, self.depth * (1.0 - GAP))]);
            }
        }
        points.extend([from + along * length + out * self.depth, from + along * length]);
        points
    }
}

impl Curtain {
    fn outline(&self) -> Vec<Point2<f64>> {
        let (from, along, out, length) = axes(self.from, self.to);
        let pieces = (length / self.fold * FOLD_PIECES).ceil().max(1.0) as usize;
        let point = |k: usize| {
            let way = length * k as f64 / pieces as f64;
            let off = 0.5 * (1.0 - libm::cos(2.0 * std::f64::consts::PI * way / self.fold));
            from + along * way + out * (self.depth * off)
        };
        (0..=pieces).map(point).collect()
    }
}

impl Door {
    fn posts(&self) -> [[Point2<f64>; 5]; 2] {
        let (from, along, out, length) = axes(self.from, self.to);
        let reach = 0.5 * self.thickness + POST_M[1];
        let post = |begin: f64, end: f64| {
            let at = |way: f64, off: f64| from + along * way + out * off;
            [at(begin, -reach), at(end, -reach), at(end, reach), at(begin, reach), at(begin, -reach)]
        };
        [post(-POST_M[0], 0.0), post(length, length + POST_M[0])]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn things_stand_where_they_are_put() {
        let radiator = Radiator { from: [1.0, 0.0], to: [2.0, 0.0], depth: 0.1 };
        let outline = radiator.outline();
        assert!(
            outline
                .iter()
                .all(|p| (1.0 - 1e-9..2.0 + 1e-9).contains(&p.x) && (0.0..0.1 + 1e-9).contains(&p.y))
        );
        assert!(outline.iter().filter(|p| (p.y - 0.06).abs() < 1e-9).count() >= 20, "gaps between ribs");
        let curtain =
            Curtain { from: [0.0, 3.0], to: [0.0, 1.0], depth: 0.06, fold: 0.2, finish: Finish::Plain };
        let outline = curtain.outline();
        let deepest = outline.iter().map(|p| p.x).fold(0.0, f64::max);
        assert!((deepest - 0.06).abs() < 1e-6 && outline.iter().all(|p| p.x > -1e-9), "{deepest}");
        let door = Door { from: [0.0, 0.0], to: [0.9, 0.0], thickness: 0.1 };
        // The opening stays as wide as it was, and the posts stand out of the wall.
        for post in door.posts() {
            assert!(post.iter().all(|p| p.x <= 1e-9 || p.x >= 0.9 - 1e-9));
            assert!(post.iter().all(|p| (p.y.abs() - 0.07).abs() < 1e-9));
        }
    }
}
