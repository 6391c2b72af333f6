//! Worlds: a building, what stands and walks in it, and the path a robot takes, in TOML.

use std::path::Path;

use nalgebra::{Isometry2, Point2, Vector2};
use serde::Deserialize;

use crate::toml_file::{self, Checked, FileError, Impossible, not_negative, positive};

/// A world, as its file describes it. Metres and degrees, in the frame of the blueprint.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct World {
    /// What it is called.
    pub name: String,
    /// The building's walls.
    #[serde(default, rename = "wall")]
    pub walls: Vec<Wall>,
    /// Things with straight sides.
    #[serde(default, rename = "box")]
    pub boxes: Vec<Cuboid>,
    /// Round things.
    #[serde(default, rename = "pillar")]
    pub pillars: Vec<Pillar>,
    /// Chairs and tables, of which the scanner sees four legs.
    #[serde(default, rename = "legs")]
    pub legs: Vec<Legs>,
    /// Radiators before walls.
    #[serde(default, rename = "radiator")]
    pub radiators: Vec<Radiator>,
    /// Curtains.
    #[serde(default, rename = "curtain")]
    pub curtains: Vec<Curtain>,
    /// Frames of doors.
    #[serde(default, rename = "door")]
    pub doors: Vec<Door>,
    /// Sills over which the robot tilts.
    #[serde(default, rename = "sill")]
    pub sills: Vec<Sill>,
    /// People on their way.
    #[serde(default, rename = "person")]
    pub people: Vec<Person>,
    /// Corners of the blueprint by which a map is judged (eq. 11).
    #[serde(default, rename = "corner")]
    pub corners: Vec<Corner>,
    /// What the robot does.
    pub path: DrivenPath,
}

/// Walls along a polyline.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Wall {
    /// Corners of the polyline.
    pub points: Vec<[f64; 2]>,
    /// Whether the last point joins the first.
    #[serde(default)]
    pub closed: bool,
    /// Glass: an ideal scanner sees nothing of it, nor beyond; a real one sees through, except at right angles.
    #[serde(default)]
    pub glass: bool,
    /// What its surface is like.
    #[serde(default)]
    pub finish: Finish,
}

pub use super::things::{Curtain, Door, Finish, Radiator, Sill};

/// A thing with a rectangular outline.
#[derive(Clone, Copy, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Cuboid {
    /// Its middle.
    pub centre: [f64; 2],
    /// Edge lengths.
    pub size: [f64; 2],
    /// Turn, degrees.
    #[serde(default)]
    pub yaw_deg: f64,
    /// What its surface is like.
    #[serde(default)]
    pub finish: Finish,
}

/// A thing with a round outline.
#[derive(Clone, Copy, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Pillar {
    /// Its middle.
    pub centre: [f64; 2],
    /// Its radius.
    pub radius: f64,
    /// What its surface is like.
    #[serde(default)]
    pub finish: Finish,
}

/// Four round legs at the corners of a rectangle.
#[derive(Clone, Copy, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Legs {
    /// Middle of the rectangle.
    pub centre: [f64; 2],
    /// Edge lengths.
    pub size: [f64; 2],
    /// Turn, degrees.
    #[serde(default)]
    pub yaw_deg: f64,
    /// Radius of a leg.
    pub radius: f64,
    /// What they are like.
    #[serde(default)]
    pub finish: Finish,
}

/// A person walking to and fro on a polyline.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Person {
    /// Radius of the disc the scanner sees.
    pub radius: f64,
    /// Way points.
    pub points: Vec<[f64; 2]>,
    /// Walking speed, m/s.
    pub speed: f64,
    /// Way ahead at the start, metres.
    #[serde(default)]
    pub ahead: f64,
}

/// A corner where two walls meet.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Corner {
    /// What it is called.
    pub name: String,
    /// Where it is.
    pub at: [f64; 2],
}

/// The robot's path.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DrivenPath {
    /// Heading at the first way point, degrees.
    pub heading_deg: f64,
    /// Speed where a way point states none, m/s.
    pub speed: f64,
    /// Time the robot stands before it drives, as robots do while they wake up, seconds. 2 where the file says nothing.
    #[serde(default = "usual_pause_s")]
    pub pause_s: f64,
    /// Way points, the first of which is the start.
    pub points: Vec<[f64; 2]>,
}

impl DrivenPath {
    /// Where the base stands before it drives, in the world.
    pub fn start(&self) -> Isometry2<f64> {
        let at = self.points.first().map_or_else(Vector2::zeros, |at| Vector2::from(*at));
        Isometry2::new(at, self.heading_deg.to_radians())
    }
}

fn usual_pause_s() -> f64 {
    2.0
}

/// A straight piece of a surface.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Edge {
    /// One end.
    pub from: Point2<f64>,
    /// The other end.
    pub to: Point2<f64>,
    /// Whether it is glass.
    pub glass: bool,
}

impl Edge {
    /// x and y of both ends, as pages and pictures have them.
    pub fn ends(&self) -> [f32; 4] {
        [self.from.x, self.from.y, self.to.x, self.to.y].map(|v| v as f32)
    }
}

/// A round surface.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Disc {
    /// Its middle.
    pub centre: Point2<f64>,
    /// Its radius.
    pub radius: f64,
}

impl Checked for World {
    fn check(&self) -> Result<(), Impossible> {
        let finite = |key: &str, points: &[[f64; 2]]| match points.iter().flatten().find(|v| !v.is_finite()) {
            Some(v) => Err((key.to_owned(), format!("{v} is not finite"))),
            None => Ok(()),
        };
        for (i, wall) in self.walls.iter().enumerate() {
            finite(&format!("wall {}", i + 1), &wall.points)?;
            if wall.points.len() < 2 {
                return Err((format!("wall {}", i + 1), "has fewer than two points".into()));
            }
        }
        for (i, b) in self.boxes.iter().enumerate() {
            finite(&format!("box {}", i + 1), &[b.centre])?;
            b.size.into_iter().try_for_each(|v| positive(format!("box {}: size", i + 1), v))?;
        }
        for (i, p) in self.pillars.iter().enumerate() {
            finite(&format!("pillar {}", i + 1), &[p.centre])?;
            positive(format!("pillar {}: radius", i + 1), p.radius)?;
        }
        for (i, l) in self.legs.iter().enumerate() {
            finite(&format!("legs {}", i + 1), &[l.centre])?;
            positive(format!("legs {}: radius", i + 1), l.radius)?;
            l.size.into_iter().try_for_each(|v| positive(format!("legs {}: size", i + 1), v))?;
        }
        for (i, p) in self.people.iter().enumerate() {
            finite(&format!("person {}", i + 1), &p.points)?;
            positive(format!("person {}: radius", i + 1), p.radius)?;
            positive(format!("person {}: speed", i + 1), p.speed)?;
            if p.points.len() < 2 {
                return Err((format!("person {}", i + 1), "has fewer than two way points".into()));
            }
        }
        self.check_things()?;
        finite("path.points", &self.path.points)?;
        positive("path.speed", self.path.speed)?;
        not_negative("path.pause_s", self.path.pause_s)?;
        if self.path.points.len() < 2 {
            return Err(("path.points".into(), "has fewer than two way points".into()));
        }
        for corner in &self.corners {
            let directions = self.directions_at(corner.at.into());
            if directions.len() < 2 {
                return Err((format!("corner '{}'", corner.name), "no two walls meet there".into()));
            }
        }
        Ok(())
    }
}

impl World {
    /// Reads and checks a world file.
    pub fn load(path: &Path) -> Result<Self, FileError> {
        toml_file::load(path)
    }

    /// Every straight surface.
    pub fn edges(&self) -> Vec<Edge> {
        self.finished_edges().into_iter().map(|(edge, _)| edge).collect()
    }

    /// The same, with what they are like: those of walls first.
    pub fn finished_edges(&self) -> Vec<(Edge, Finish)> {
        let mut edges = self.wall_edges();
        for b in &self.boxes {
            let c = rectangle(b.centre, b.size, b.yaw_deg);
            edges.extend((0..4).map(|i| (Edge { from: c[i], to: c[(i + 1) % 4], glass: false }, b.finish)));
        }
        edges.extend(self.thing_edges());
        edges
    }

    /// Straight surfaces of walls.
    pub fn wall_edges(&self) -> Vec<(Edge, Finish)> {
        let mut edges = Vec::new();
        for wall in &self.walls {
            let n = wall.points.len();
            let pieces = if wall.closed { n } else { n - 1 };
            let finish = if wall.glass { Finish::Glass } else { wall.finish };
            edges.extend((0..pieces).map(|i| {
                let (from, to) = (wall.points[i].into(), wall.points[(i + 1) % n].into());
                (Edge { from, to, glass: finish == Finish::Glass }, finish)
            }));
        }
        edges
    }

    /// Every round surface that stays where it is.
    pub fn discs(&self) -> Vec<Disc> {
        self.finished_discs().into_iter().map(|(disc, _)| disc).collect()
    }

    /// The same, with what they are like.
    pub fn finished_discs(&self) -> Vec<(Disc, Finish)> {
        let pillar = |p: &Pillar| (Disc { centre: p.centre.into(), radius: p.radius }, p.finish);
        let mut discs: Vec<(Disc, Finish)> = self.pillars.iter().map(pillar).collect();
        for l in &self.legs {
            let leg = |centre| (Disc { centre, radius: l.radius }, l.finish);
            discs.extend(rectangle(l.centre, l.size, l.yaw_deg).map(leg));
        }
        discs
    }

    /// Unit directions, away from a point, of the walls that end there.
    pub fn directions_at(&self, point: Point2<f64>) -> Vec<Vector2<f64>> {
        let mut directions = Vec::new();
        for (edge, _) in self.wall_edges() {
            for (end, other) in [(edge.from, edge.to), (edge.to, edge.from)] {
                if (end - point).norm() < 1e-6 {
                    directions.push((other - end).normalize());
                }
            }
        }
        directions
    }

    /// Where people are at a time.
    pub fn people_at(&self, time_s: f64) -> Vec<Disc> {
        self.people
            .iter()
            .map(|p| Disc { centre: along(&p.points, p.ahead + p.speed * time_s), radius: p.radius })
            .collect()
    }

    /// Pose (x, y, θ) of the robot at the start.
    pub fn start(&self) -> [f64; 3] {
        let [x, y] = self.path.points[0];
        [x, y, self.path.heading_deg.to_radians()]
    }
}

fn rectangle(centre: [f64; 2], size: [f64; 2], yaw_deg: f64) -> [Point2<f64>; 4] {
    let (s, c) = (libm::sin(yaw_deg.to_radians()), libm::cos(yaw_deg.to_radians()));
    [(-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)].map(|(u, v)| {
        let (x, y) = (u * size[0], v * size[1]);
        Point2::new(centre[0] + c * x - s * y, centre[1] + s * x + c * y)
    })
}

/// The point after a way to and fro on a polyline.
fn along(points: &[[f64; 2]], way: f64) -> Point2<f64> {
    let points: Vec<Point2<f64>> = points.iter().map(|&p| p.into()).collect();
    let total: f64 = points.windows(2).map(|w| (w[1] - w[0]).norm()).sum();
    if total <= 0.0 {
        return points[0];
    }
    let mut rest = way.rem_euclid(2.0 * total);
    if rest > total {
        rest = 2.0 * total - rest;
    }
    for w in points.windows(2) {
        let length = (w[1] - w[0]).norm();
        if rest <= length && length > 0.0 {
            return w[0] + (w[1] - w[0]) * (rest / length);
        }
        rest -= length;
    }
    points[points.len() - 1]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn people_walk_to_and_fro() {
        let points = [[0.0, 0.0], [2.0, 0.0], [2.0, 1.0]];
        for (way, x, y) in
            [(0.0, 0.0, 0.0), (2.5, 2.0, 0.5), (3.5, 2.0, 0.5), (5.0, 1.0, 0.0), (6.5, 0.5, 0.0)]
        {
            assert!((along(&points, way) - Point2::new(x, y)).norm() < 1e-12, "{way}");
        }
    }
}
