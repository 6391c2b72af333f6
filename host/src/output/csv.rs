//! `map.csv`: a segment a line, metres in `map`.

use slam_core::MapSegment;

#[derive(serde::Serialize)]
struct Row {
    x1_m: f32,
    y1_m: f32,
    x2_m: f32,
    y2_m: f32,
    inliers: u32,
}

/// Renders the segments, with their header even when there is none.
pub fn render(map: &[MapSegment]) -> Result<Vec<u8>, csv::Error> {
    let mut writer = csv::WriterBuilder::new().has_headers(false).from_writer(Vec::new());
    writer.write_record(["x1_m", "y1_m", "x2_m", "y2_m", "inliers"])?;
    for segment in map.iter().map(MapSegment::segment) {
        writer.serialize(Row {
            x1_m: segment.start.x,
            y1_m: segment.start.y,
            x2_m: segment.end.x,
            y2_m: segment.end.y,
            inliers: segment.moments.inliers,
        })?;
    }
    writer.into_inner().map_err(|e| e.into_error().into())
}
