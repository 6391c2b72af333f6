//! `scan.svg`: one scan for a person's eyes, the sensor in the middle, x of `laser` to the right.

use std::fmt::Write;

use nalgebra::{Isometry2, Point2};
use slam_core::sensor::scan::{RangeCodes, Reading, ScanGeometry};
use svg::node::element::{Circle, Path};

use super::svg::{PAPER, PATH, START, View, WALL, heading, legend};

/// Neighbouring points farther apart than this are not joined, as a share of the range.
const GAP: f32 = 0.1;

/// Counts of a scan's beams.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Beams {
    /// With a range.
    pub ranges: usize,
    /// With nothing in range.
    pub no_echo: usize,
    /// That the sensor could not measure.
    pub bad: usize,
}

impl Beams {
    /// Counts them.
    pub fn count(ranges_mm: &[u16], codes: &RangeCodes) -> Self {
        let mut beams = Self::default();
        for &range_mm in ranges_mm {
            match codes.read(range_mm) {
                Reading::Range(_) => beams.ranges += 1,
                Reading::NoEcho => beams.no_echo += 1,
                Reading::Bad => beams.bad += 1,
            }
        }
        beams
    }
}

/// Renders the drawing. The field of view is shaded as far as each beam saw; `facts` goes below the title.
pub fn render(
    title: &str,
    facts: &str,
    geometry: &ScanGeometry,
    codes: &RangeCodes,
    ranges_mm: &[u16],
) -> String {
    let points: Vec<Option<Point2<f32>>> = ranges_mm
        .iter()
        .enumerate()
        .map(|(beam, &range_mm)| match codes.read(range_mm) {
            Reading::Range(range) => {
                Some(Isometry2::rotation(geometry.bearing(beam)) * Point2::new(range, 0.0))
            }
            _ => None,
        })
        .collect();
    let origin = Point2::origin();
    let view = View::of(points.iter().flatten().copied().chain([origin]));
    let (x0, y0) = view.px(origin);
    let mut seen = format!("M{x0} {y0}");
    let (mut dots, mut walls) = (String::new(), String::new());
    let mut last: Option<Point2<f32>> = None;
    for point in &points {
        let Some(point) = point else {
            let _ = write!(seen, "L{x0} {y0}");
            last = None;
            continue;
        };
        let (x, y) = view.px(*point);
        let _ = write!(seen, "L{x} {y}");
        let _ = write!(dots, "M{x} {y}h0");
        match last.filter(|l| (point - l).norm() < GAP * point.coords.norm().max(0.2)) {
            Some(_) => drop(write!(walls, "L{x} {y}")),
            None => drop(write!(walls, "M{x} {y}")),
        }
        last = Some(*point);
    }
    let line = |d: String, colour: &str, width: f32| {
        Path::new()
            .set("d", d)
            .set("stroke", colour)
            .set("stroke-width", width)
            .set("stroke-linecap", "round")
            .set("stroke-linejoin", "round")
            .set("fill", "none")
    };
    let ahead = view.px(Point2::new(24.0 / view.px_per_m, 0.0));
    let sensor = Circle::new().set("cx", x0).set("cy", y0).set("r", 7).set("fill", START);
    let document = view
        .sheet()
        .add(Path::new().set("d", seen + "Z").set("fill", "#ffffff").set("fill-opacity", 0.85))
        .add(line(walls, WALL, 1.2).set("stroke-opacity", 0.45))
        .add(line(dots, WALL, 3.4))
        .add(line(format!("M{x0} {y0}L{} {}", ahead.0, ahead.1), PATH, 2.5))
        .add(sensor.set("stroke", PAPER).set("stroke-width", 2))
        .add(heading(title, facts, &view))
        .add(legend(
            &[
                ("sensor", START, 0.0, "", 76.0),
                ("ahead", PATH, 2.5, "", 72.0),
                ("range", WALL, 3.4, "0.5 7", 60.0),
            ],
            &view,
        ));
    format!("{document}\n")
}
