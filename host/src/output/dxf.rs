//! `map.dxf`: segments and path for CAD programs, metres in `map`.
//!
//! How often a segment was seen is told by its layer. `PATH` is where the robot drove, in the final map.

use std::io::Cursor;

use dxf::entities::{Entity, EntityType, Line, LwPolyline};
use dxf::enums::{AcadVersion, DrawingUnits, Units};
use dxf::tables::Layer;
use dxf::{Color, Drawing, DxfError, LwPolylineVertex, Point};
use nalgebra::{Isometry2, Point2};
use slam_core::MapSegment;

use super::bounds;
use crate::replay::ESTABLISHED_HITS;

/// Segments seen in at least so many scans are sure.
const SURE_HITS: u16 = 10;

/// Layer of segments that were seen often.
pub const SURE: &str = "WALLS_SURE";
/// Layer of segments that were seen a few times.
pub const WALLS: &str = "WALLS";
/// Layer of segments that were seen once or twice.
pub const TENTATIVE: &str = "WALLS_TENTATIVE";
/// Layer of the path.
pub const PATH: &str = "PATH";

/// Layers with their colours by AutoCAD's index: black or white, grey, light grey, red.
const LAYERS: [(&str, u8); 4] = [(SURE, 7), (WALLS, 8), (TENTATIVE, 9), (PATH, 1)];

/// Points of the path nearer to the last one than this are left out, metres.
const PATH_STEP_M: f32 = 0.01;

/// Renders the drawing.
pub fn render<'a>(
    map: &[MapSegment],
    path: impl Iterator<Item = &'a Isometry2<f32>>,
) -> Result<Vec<u8>, DxfError> {
    let path = thinned(path);
    let mut drawing = Drawing::new();
    let header = &mut drawing.header;
    header.version = AcadVersion::R2000;
    header.default_drawing_units = Units::Meters;
    header.drawing_units = DrawingUnits::Metric;
    // The same map gives the same bytes.
    (header.creation_date, header.creation_date_universal) = Default::default();
    (header.update_date, header.update_date_universal) = Default::default();
    (header.fingerprint_guid, header.version_guid) = Default::default();
    let ends = map.iter().flat_map(|entry| [entry.segment().start, entry.segment().end]);
    let (low, high) = bounds(ends.chain(path.iter().copied()));
    header.minimum_drawing_extents = point(low);
    header.maximum_drawing_extents = point(high);
    for (name, colour) in LAYERS {
        let (name, color) = (name.to_owned(), Color::from_index(colour));
        drawing.add_layer(Layer { name, color, ..Layer::default() });
    }
    for entry in map {
        let segment = entry.segment();
        let line = Line::new(point(segment.start), point(segment.end));
        add(&mut drawing, layer(entry.hits), EntityType::Line(line));
    }
    if path.len() > 1 {
        let vertex =
            |p: &Point2<f32>| LwPolylineVertex { x: p.x.into(), y: p.y.into(), ..Default::default() };
        let vertices = path.iter().map(vertex).collect();
        add(&mut drawing, PATH, EntityType::LwPolyline(LwPolyline { vertices, ..LwPolyline::default() }));
    }
    let mut bytes = Cursor::new(Vec::new());
    drawing.save(&mut bytes)?;
    Ok(bytes.into_inner())
}

/// The layer of a segment that so many scans saw.
pub fn layer(hits: u16) -> &'static str {
    if hits >= SURE_HITS {
        SURE
    } else if hits >= ESTABLISHED_HITS {
        WALLS
    } else {
        TENTATIVE
    }
}

fn add(drawing: &mut Drawing, layer: &str, specific: EntityType) {
    let mut entity = Entity::new(specific);
    entity.common.layer = layer.to_owned();
    drawing.add_entity(entity);
}

fn point(point: Point2<f32>) -> Point {
    Point::new(point.x.into(), point.y.into(), 0.0)
}

fn thinned<'a>(path: impl Iterator<Item = &'a Isometry2<f32>>) -> Vec<Point2<f32>> {
    let mut points: Vec<Point2<f32>> = Vec::new();
    for pose in path {
        let at = Point2::from(pose.translation.vector);
        if points.last().is_none_or(|last| (at - last).norm() >= PATH_STEP_M) {
            points.push(at);
        }
    }
    points
}

#[cfg(test)]
mod tests {
    use super::*;
    use slam_core::geometry::pose::pose;

    #[test]
    fn the_path_reads_back_in_metres() {
        let poses = [pose(0.0, 0.0, 0.0), pose(0.005, 0.0, 0.0), pose(1.5, -2.0, 0.0)];
        let bytes = render(&[], poses.iter()).unwrap();
        let drawing = Drawing::load(&mut Cursor::new(&bytes)).unwrap();
        assert_eq!(drawing.header.default_drawing_units, Units::Meters);
        let entity = drawing.entities().next().unwrap();
        let EntityType::LwPolyline(path) = &entity.specific else { panic!("{entity:?}") };
        assert_eq!(entity.common.layer, PATH);
        let ends: Vec<(f64, f64)> = path.vertices.iter().map(|v| (v.x, v.y)).collect();
        assert_eq!(ends, [(0.0, 0.0), (1.5, -2.0)]);
        assert_eq!(render(&[], poses.iter()).unwrap(), bytes, "the same map gives the same bytes");
    }

    #[test]
    fn hits_choose_the_layer() {
        let layers = [1, 2, 3, 9, 10, u16::MAX].map(layer);
        assert_eq!(layers, [TENTATIVE, TENTATIVE, WALLS, WALLS, SURE, SURE]);
    }
}
