//! What a scan says of the pose that was found: how far its segments lie off the map, and what the map has there that it does not see.

use nalgebra::Isometry2;

use super::Tracker;
use super::state::Evidence;
use super::tracker::Scene;
use crate::geometry::math::sqrt;
use crate::map::visibility::{View, confirmed_and_contradicted};
use crate::odometry::Increment;
use crate::sensor::scan::Scan;

impl<const N: usize> Tracker<N> {
    /// Root mean square distance of the observed segments from their map lines, seen from this pose and weighted by inliers, metres. Zero
    /// without pairs.
    pub fn residual_m(&self, scene: &Scene<'_>, pose: &Isometry2<f32>) -> f32 {
        let (mut sum, mut points) = (0.0, 0.0);
        for pair in &self.pairs {
            let (Some(seen), Some(entry)) = (scene.observed.get(pair.observed), scene.map.get(pair.mapped))
            else {
                continue;
            };
            let n = seen.moments.inliers as f32;
            let distance = entry.signed_distance(pose * seen.moments.centroid);
            sum += n * distance * distance;
            points += n;
        }
        if points > 0.0 { sqrt(sum / points) } else { 0.0 }
    }

    /// What the scan says of the pose, which explains this share of it. Whether the map contradicts the scan is looked up only where
    /// that is not good.
    pub fn evidence(
        &self,
        scene: &Scene<'_>,
        scan: &Scan<'_>,
        pose: &Isometry2<f32>,
        score: f32,
        motion: &Increment,
    ) -> Evidence {
        let is_good = score >= scene.config.state.good_score;
        let contradicted_share = if is_good { 0.0 } else { self.contradicted_share(scene, scan, pose) };
        let way_m = motion.distance_m + motion.turn_rad;
        Evidence { score, contradicted_share, segments: scene.observed.len() as u16, way_m }
    }
    /// Share of the candidates that should be seen from a pose, and are seen through instead, 0 to 1.
    pub fn contradicted_share(&self, scene: &Scene<'_>, scan: &Scan<'_>, pose: &Isometry2<f32>) -> f32 {
        let Some(config) = &scene.config.forgetting else { return 0.0 };
        let view = View::new(scan, pose, &scene.config.sensor, config);
        let [confirmed, contradicted] = confirmed_and_contradicted(&view, self.nearby.all(), scene.map);
        f32::from(contradicted) / f32::from(confirmed.saturating_add(contradicted).max(1))
    }
}
