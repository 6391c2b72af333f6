//! A scanner among walls, for tests.

use nalgebra::{Isometry2, Point2, Vector2};
use slam_core::SlamConfig;

/// Beams of the default scanner.
pub const BEAMS: usize = 682;

/// Both ends of a wall.
pub type Wall = ((f32, f32), (f32, f32));

/// Ranges among these walls, seen from `map_from_base`; beyond `reach_m` there is no echo.
pub fn ranges_mm(
    walls: &[Wall],
    config: &SlamConfig,
    map_from_base: &Isometry2<f32>,
    reach_m: f32,
) -> Vec<u16> {
    let map_from_laser = map_from_base * config.sensor.mounting.base_from_laser;
    let cross = |a: Vector2<f32>, b: Vector2<f32>| a.x * b.y - a.y * b.x;
    let range_mm = |beam| {
        let bearing = config.sensor.geometry.bearing(beam);
        let direction = map_from_laser.rotation * Vector2::new(bearing.cos(), bearing.sin());
        let hits = walls.iter().filter_map(|&((x1, y1), (x2, y2))| {
            let from = Point2::new(x1, y1) - Point2::from(map_from_laser.translation.vector);
            let along = Vector2::new(x2 - x1, y2 - y1);
            let denominator = cross(direction, along);
            let (range, share) = (cross(from, along) / denominator, cross(from, direction) / denominator);
            ((0.0..=1.0).contains(&share) && range > 0.02).then_some(range)
        });
        let range = hits.fold(f32::INFINITY, f32::min);
        if range < reach_m { (range * 1000.0).round() as u16 } else { 0 }
    };
    (0..BEAMS).map(range_mm).collect()
}
