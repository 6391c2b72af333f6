//! `map.svg`: the map for a person's eyes.
//!
//! Bold segments (those seen once or twice thin), the path with arrows, the dead-reckoned path, faint scan points, a
//! scale bar and a legend. North is y of `map`.

use std::collections::HashSet;
use std::fmt::Write;

use nalgebra::{Isometry2, Point2, Vector2};
use slam_core::MapSegment;
use svg::Document;
use svg::node::element::{Circle, Group, Line, Path, Rectangle, Text};

use super::bounds;
use crate::beams::all_in_final_map;
use crate::log::Log;
use crate::replay::{ESTABLISHED_HITS, Replay};
use crate::sim::world::Edge;

pub(super) const PAPER: &str = "#fbfaf7";
const INK: &str = "#1d2b3a";
const FAINT: &str = "#8fa3b5";
pub(super) const WALL: &str = "#16324f";
pub(super) const PATH: &str = "#d1495b";
const ODOMETRY: &str = "#edae49";
const BLUEPRINT: &str = "#cfe3d8";
pub(super) const START: &str = "#2a9d8f";
const FONT: &str = "Inter, Helvetica, Arial, sans-serif";

/// Longer edge of the drawing, pixels.
const LONG_EDGE_PX: f32 = 1400.0;
const MARGIN_PX: f32 = 36.0;
const HEADER_PX: f32 = 74.0;
const FOOTER_PX: f32 = 58.0;
const LEAST_WIDTH_PX: f32 = 1200.0;
/// Scan points are thinned to one a cell of this size, metres, and drawn up to this range.
const POINT_CELL_M: f32 = 0.04;
/// The same for pictures, pixels.
const POINT_CELL_PX: f32 = 1.8;

/// What is drawn beside map and path.
#[derive(Default)]
pub struct Scene<'a> {
    /// The title: name of the log or of the world.
    pub title: &'a str,
    /// What made the map, beneath the title.
    pub subtitle: &'a str,
    /// The true walls in `map`, where they are known.
    pub blueprint: &'a [Edge],
    /// The trajectory to compare with, in `map`, where there is one.
    pub reference: &'a [Isometry2<f32>],
}

/// What was mapped and driven, in `map`.
#[derive(Default)]
pub struct Picture<'a> {
    /// The map.
    pub map: &'a [MapSegment],
    /// The path, scan by scan.
    pub path: Vec<Isometry2<f32>>,
    /// The same by dead reckoning.
    pub odometry: Vec<Isometry2<f32>>,
    /// Points of all scans, or some of them.
    pub points: Vec<Point2<f32>>,
    /// Way driven, metres.
    pub distance_m: f64,
}

impl<'a> Picture<'a> {
    /// Of a replayed log.
    pub fn of(log: &Log, replay: &'a Replay) -> Self {
        let mut points = Vec::new();
        let mut cells = HashSet::new();
        for seen in all_in_final_map(log, replay) {
            points.extend(seen.obstacles().filter(|p| cells.insert(point_cell(p, POINT_CELL_M))));
        }
        Self {
            map: &replay.map,
            path: replay.steps.iter().map(|s| s.pose_in_final_map).collect(),
            odometry: replay.steps.iter().map(|s| s.odometry).collect(),
            points,
            distance_m: replay.distance_m,
        }
    }
}

/// Where `map` lies on the paper.
pub(super) struct View {
    low: Point2<f32>,
    high: Point2<f32>,
    pub(super) px_per_m: f32,
    left_px: f32,
    width_px: f32,
    height_px: f32,
}

impl View {
    fn around(picture: &Picture<'_>, scene: &Scene<'_>) -> Self {
        let mut points: Vec<Point2<f32>> = Vec::new();
        points.extend(
            picture
                .map
                .iter()
                .filter(|s| s.hits >= ESTABLISHED_HITS)
                .flat_map(|s| [s.segment().start, s.segment().end]),
        );
        points.extend(scene.blueprint.iter().flat_map(|e| [e.from, e.to]).map(|p| p.map(|v| v as f32)));
        points.extend(picture.path.iter().map(|pose| Point2::from(pose.translation.vector)));
        Self::of(points.into_iter())
    }

    /// Around points, with a margin.
    pub(super) fn of(points: impl Iterator<Item = Point2<f32>>) -> Self {
        let (low, high) = bounds(points);
        // At least two metres, so that a robot that stands still has a picture too.
        let centre = nalgebra::center(&low, &high);
        let half = ((high - low) * 0.5).sup(&Vector2::new(1.0, 1.0)) + Vector2::new(0.4, 0.4);
        let (low, high) = (centre - half, centre + half);
        let px_per_m = LONG_EDGE_PX / (2.0 * half.max());
        let drawn_px = 2.0 * half.x * px_per_m;
        let width_px = (drawn_px + 2.0 * MARGIN_PX).max(LEAST_WIDTH_PX);
        let height_px = 2.0 * half.y * px_per_m + HEADER_PX + FOOTER_PX;
        Self { low, high, px_per_m, left_px: 0.5 * (width_px - drawn_px), width_px, height_px }
    }

    /// An empty sheet with its metre grid.
    pub(super) fn sheet(&self) -> Document {
        Document::new()
            .set("viewBox", (0, 0, self.width_px.round() as i32, self.height_px.round() as i32))
            .set("width", self.width_px.round())
            .set("height", self.height_px.round())
            .set("font-family", FONT)
            .add(Rectangle::new().set("width", "100%").set("height", "100%").set("fill", PAPER))
            .add(metre_grid(self))
    }

    pub(super) fn px(&self, point: Point2<f32>) -> (f32, f32) {
        let x = self.left_px + (point.x - self.low.x) * self.px_per_m;
        let y = HEADER_PX + (self.high.y - point.y) * self.px_per_m;
        ((x * 10.0).round() / 10.0, (y * 10.0).round() / 10.0)
    }

    fn holds(&self, point: Point2<f32>) -> bool {
        point.x > self.low.x && point.x < self.high.x && point.y > self.low.y && point.y < self.high.y
    }
}

/// Renders the drawing, over the blueprint where there is one.
pub fn render(picture: &Picture<'_>, scene: &Scene<'_>) -> String {
    let view = View::around(picture, scene);
    let document = view
        .sheet()
        .add(blueprint_lines(scene.blueprint, &view))
        .add(scan_points(&picture.points, &view))
        .add(dead_reckoning(&picture.odometry, &view))
        .add(walls(picture.map, &view))
        .add(reference_path(scene.reference, &view))
        .add(path(&picture.path, &view))
        .add(header(picture, scene, &view))
        .add(footer(scene, &view));
    format!("{document}\n")
}

fn metre_grid(view: &View) -> Group {
    let step = scale_step(view) as i32;
    let mut d = String::new();
    let lines = |from: f32, to: f32| (from / step as f32).ceil() as i32..=(to / step as f32).floor() as i32;
    for k in lines(view.low.x, view.high.x) {
        let x = (k * step) as f32;
        let ((x1, y1), (x2, y2)) =
            (view.px(Point2::new(x, view.low.y)), view.px(Point2::new(x, view.high.y)));
        let _ = write!(d, "M{x1} {y1}L{x2} {y2}");
    }
    for k in lines(view.low.y, view.high.y) {
        let y = (k * step) as f32;
        let ((x1, y1), (x2, y2)) =
            (view.px(Point2::new(view.low.x, y)), view.px(Point2::new(view.high.x, y)));
        let _ = write!(d, "M{x1} {y1}L{x2} {y2}");
    }
    Group::new()
        .add(Path::new().set("d", d).set("stroke", "#e9e5dc").set("stroke-width", 1).set("fill", "none"))
}

fn blueprint_lines(blueprint: &[Edge], view: &View) -> Path {
    let mut d = String::new();
    for edge in blueprint {
        let ((x1, y1), (x2, y2)) = (view.px(edge.from.map(|v| v as f32)), view.px(edge.to.map(|v| v as f32)));
        let _ = write!(d, "M{x1} {y1}L{x2} {y2}");
    }
    let width = 1.6 * wall_width(view);
    let path = Path::new().set("d", d).set("stroke", BLUEPRINT).set("stroke-width", width);
    path.set("stroke-linecap", "round").set("fill", "none")
}

fn point_cell(point: &Point2<f32>, cell_m: f32) -> (i32, i32) {
    ((point.x / cell_m).floor() as i32, (point.y / cell_m).floor() as i32)
}

fn scan_points(points: &[Point2<f32>], view: &View) -> Path {
    let mut cells = HashSet::new();
    let mut d = String::new();
    // In the picture of a large building finer ones would fall together.
    let cell_m = POINT_CELL_M.max(POINT_CELL_PX / view.px_per_m);
    for p in points {
        if view.holds(*p) && cells.insert(point_cell(p, cell_m)) {
            let (x, y) = view.px(*p);
            let _ = write!(d, "M{x} {y}h0");
        }
    }
    let size = (0.03 * view.px_per_m).clamp(0.7, 2.2);
    Path::new()
        .set("d", d)
        .set("stroke", FAINT)
        .set("stroke-opacity", 0.5)
        .set("stroke-width", size)
        .set("stroke-linecap", "round")
        .set("fill", "none")
}

fn walls(map: &[MapSegment], view: &View) -> Group {
    let (mut once, mut often) = (String::new(), String::new());
    for entry in map {
        let ((x1, y1), (x2, y2)) = (view.px(entry.segment().start), view.px(entry.segment().end));
        let d = if entry.hits >= ESTABLISHED_HITS { &mut often } else { &mut once };
        if view.holds(entry.segment().midpoint()) {
            let _ = write!(d, "M{x1} {y1}L{x2} {y2}");
        }
    }
    let stroke = |d: String, width: f32, opacity: f32| {
        Path::new()
            .set("d", d)
            .set("stroke", WALL)
            .set("stroke-opacity", opacity)
            .set("stroke-width", width)
            .set("stroke-linecap", "round")
            .set("fill", "none")
    };
    let bold = wall_width(view);
    Group::new().add(stroke(once, 0.4 * bold, 0.5)).add(stroke(often, bold, 1.0))
}

fn wall_width(view: &View) -> f32 {
    (0.05 * view.px_per_m).clamp(2.2, 5.0)
}

fn polyline<'a>(poses: impl Iterator<Item = &'a Isometry2<f32>>, view: &View) -> String {
    let mut d = String::new();
    let mut last = None;
    let mut pen_up = true;
    for pose in poses {
        let point = Point2::from(pose.translation.vector);
        if !view.holds(point) {
            pen_up = true;
            continue;
        }
        let at = view.px(point);
        if last != Some(at) || pen_up {
            let _ = write!(d, "{}{} {}", if pen_up { 'M' } else { 'L' }, at.0, at.1);
            (last, pen_up) = (Some(at), false);
        }
    }
    d
}

fn reference_path(reference: &[Isometry2<f32>], view: &View) -> Path {
    let path = Path::new().set("d", polyline(reference.iter(), view)).set("stroke", START);
    path.set("stroke-width", 1.6).set("stroke-linejoin", "round").set("fill", "none")
}

fn dead_reckoning(odometry: &[Isometry2<f32>], view: &View) -> Path {
    Path::new()
        .set("d", polyline(odometry.iter(), view))
        .set("stroke", ODOMETRY)
        .set("stroke-width", 2)
        .set("stroke-dasharray", "7 5")
        .set("stroke-linejoin", "round")
        .set("fill", "none")
}

fn path(path: &[Isometry2<f32>], view: &View) -> Group {
    let poses = || path.iter();
    let line = Path::new()
        .set("d", polyline(poses(), view))
        .set("stroke", PATH)
        .set("stroke-width", 2.2)
        .set("stroke-linejoin", "round")
        .set("fill", "none");
    let mut group = Group::new().add(line).add(arrows(poses(), view));
    if let Some(first) = poses().next() {
        let (x, y) = view.px(first.translation.vector.into());
        let dot = Circle::new().set("cx", x).set("cy", y).set("r", 7).set("fill", START);
        group = group.add(dot.set("stroke", PAPER).set("stroke-width", 2));
    }
    group
}

/// Arrow heads, one for each stretch of the path, pointing where the robot headed.
fn arrows<'a>(poses: impl Iterator<Item = &'a Isometry2<f32>>, view: &View) -> Path {
    let spacing_m = 110.0 / view.px_per_m;
    let (mut d, mut way_m, mut last) = (String::new(), 0.6 * spacing_m, None::<Point2<f32>>);
    for pose in poses {
        let point = Point2::from(pose.translation.vector);
        way_m += last.map_or(0.0, |last| (point - last).norm());
        last = Some(point);
        if way_m < spacing_m || !view.holds(point) {
            continue;
        }
        way_m = 0.0;
        let (x, y) = view.px(point);
        let ahead = pose.rotation * Vector2::new(1.0, 0.0);
        let (fx, fy) = (ahead.x * 8.0, -ahead.y * 8.0);
        let corner = |along: f32, side: f32| (x + fx * along - fy * side, y + fy * along + fx * side);
        let (tip, left, notch, right) =
            (corner(1.0, 0.0), corner(-0.9, 0.75), corner(-0.4, 0.0), corner(-0.9, -0.75));
        let _ = write!(
            d,
            "M{:.1} {:.1}L{:.1} {:.1}L{:.1} {:.1}L{:.1} {:.1}Z",
            tip.0, tip.1, left.0, left.1, notch.0, notch.1, right.0, right.1
        );
    }
    Path::new().set("d", d).set("fill", PATH).set("stroke", PAPER).set("stroke-width", 1)
}

fn label(x: f32, y: f32, size: u32, text: impl Into<String>) -> Text {
    Text::new(text).set("x", x).set("y", y).set("font-size", size).set("fill", INK)
}

fn header(picture: &Picture<'_>, scene: &Scene<'_>, view: &View) -> Group {
    let facts = format!(
        "{} · {} scans · {:.0} m driven · {} segments",
        scene.subtitle,
        picture.path.len(),
        picture.distance_m,
        picture.map.len(),
    );
    heading(scene.title, &facts, view)
}

/// Title, what is below it, and a rule.
pub(super) fn heading(title: &str, facts: &str, view: &View) -> Group {
    let title = label(MARGIN_PX, 38.0, 24, title).set("font-weight", 700);
    let rule = Line::new()
        .set("x1", MARGIN_PX)
        .set("x2", view.width_px - MARGIN_PX)
        .set("y1", HEADER_PX - 4.0)
        .set("y2", HEADER_PX - 4.0)
        .set("stroke", "#d8d2c4");
    Group::new().add(title).add(label(MARGIN_PX, 60.0, 15, facts).set("fill-opacity", 0.75)).add(rule)
}

/// Scale bar on the left, legend on the right.
fn footer(scene: &Scene<'_>, view: &View) -> Group {
    let mut entries = vec![
        ("start", START, 0.0, "", 62.0),
        ("path", PATH, 2.2, "", 62.0),
        ("dead reckoning", ODOMETRY, 2.0, "7 5", 136.0),
        ("map segment", WALL, wall_width(view), "", 122.0),
        ("seen once or twice", WALL, 0.4 * wall_width(view), "", 164.0),
        ("scan points", FAINT, 2.0, "0.5 5", 100.0),
    ];
    if !scene.blueprint.is_empty() {
        entries.push(("blueprint", BLUEPRINT, 8.0, "", 80.0));
    }
    if !scene.reference.is_empty() {
        entries.push(("reference", START, 1.6, "", 80.0));
    }
    legend(&entries, view)
}

/// Name, colour, width (zero for a dot), dashes, and the width of the name in pixels.
pub(super) type Entry = (&'static str, &'static str, f32, &'static str, f32);

/// Scale bar and legend.
pub(super) fn legend(entries: &[Entry], view: &View) -> Group {
    let y = view.height_px - 24.0;
    let metres = scale_step(view);
    let length_px = metres * view.px_per_m;
    let bar = format!("M{MARGIN_PX} {}v10h{length_px}v-10", y - 9.0);
    let mut group = Group::new()
        .add(Path::new().set("d", bar).set("stroke", INK).set("stroke-width", 2).set("fill", "none"))
        .add(label(MARGIN_PX + length_px + 10.0, y + 2.0, 15, format!("{metres} m")));
    let mut x = view.width_px - MARGIN_PX - entries.iter().map(|e| e.4 + 32.0).sum::<f32>() + 14.0;
    for &(name, colour, width, dashes, text_px) in entries {
        group = if width > 0.0 {
            let key = Line::new().set("x1", x).set("x2", x + 26.0).set("y1", y - 4.0).set("y2", y - 4.0);
            let key = key.set("stroke", colour).set("stroke-width", width).set("stroke-linecap", "round");
            group.add(if dashes.is_empty() { key } else { key.set("stroke-dasharray", dashes) })
        } else {
            group.add(Circle::new().set("cx", x + 18.0).set("cy", y - 4.0).set("r", 7).set("fill", colour))
        };
        group = group.add(label(x + 34.0, y + 1.0, 15, name));
        x += text_px + 32.0;
    }
    group
}

/// A round length that gives a scale bar of convenient size, metres.
fn scale_step(view: &View) -> f32 {
    let fits = |m: &f32| m * view.px_per_m >= 60.0;
    [1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0, 500.0].into_iter().find(fits).unwrap_or(1000.0)
}
