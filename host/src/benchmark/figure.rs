//! The picture of a replayed log.

use nalgebra::Isometry2;

use crate::log::Log;
use crate::output::svg::{self, Picture, Scene};
use crate::replay::Replay;
use crate::score::{self, StampedPose};

/// The final map of a log and the path in it, with the reference trajectory laid on where there is one.
pub fn draw(
    name: &str,
    log: &Log,
    replay: &Replay,
    in_final_map: &[StampedPose],
    reference: Option<&[StampedPose]>,
) -> String {
    let laid = |reference: &[StampedPose]| {
        let map_from_reference = score::align(reference, in_final_map)?.reference_from_estimate;
        let carried = |p: &StampedPose| nalgebra::convert_unchecked(map_from_reference * p.pose);
        Some(reference.iter().map(carried).collect::<Vec<Isometry2<f32>>>())
    };
    let reference = reference.and_then(laid).unwrap_or_default();
    let title = format!("{name} ({})", log.format);
    let scene =
        Scene { title: &title, subtitle: "default configuration", reference: &reference, ..Scene::default() };
    svg::render(&Picture::of(log, replay), &scene)
}
