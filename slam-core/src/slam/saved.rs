//! Maps that are saved and loaded, and a map that stays as it is.

use nalgebra::Isometry2;

use super::Slam;
use super::relocation::THOUGHT;
use crate::geometry::pose::diagonal;
use crate::map::store::{MapError, StoredLine, StoredLoop, StoredMap, StoredPlace};
use crate::places::LOOPS;
use crate::tracking::correction::Prior;

impl<const N: usize, const BEAMS: usize, const P: usize> Slam<N, BEAMS, P> {
    /// The walls of the map, to be saved.
    pub fn stored_lines(&self) -> impl Iterator<Item = StoredLine> {
        self.walls().map(StoredLine::of)
    }

    /// The places, to be saved.
    pub fn stored_places(&self) -> impl Iterator<Item = StoredPlace> {
        self.places.anchors().iter().map(StoredPlace::of)
    }

    /// The loops between them, to be saved.
    pub fn stored_loops(&self) -> impl Iterator<Item = StoredLoop> {
        self.places.loops().iter().map(StoredLoop::of)
    }

    /// Way driven until now, with that of the map that was loaded, metres.
    pub fn way_m(&self) -> f32 {
        self.estimator.travelled_m()
    }

    /// Takes a saved map in place of the one there is. The robot stands near a pose in it, within some 20 cm and 6°, or looks for
    /// itself. Fails without having changed anything.
    pub fn load(&mut self, map: &StoredMap<'_>, at: Option<Isometry2<f32>>) -> Result<(), MapError> {
        MapError::check_room("lines", map.lines.len(), N)?;
        MapError::check_room("places", map.places.len(), P)?;
        MapError::check_room("loops", map.loops.len(), LOOPS)?;
        map.check()?;
        let may_look = self.config.relocalisation.is_some() && !map.places.is_empty();
        if at.is_none() && !may_look {
            return Err(MapError::NowhereToLook);
        }
        self.map.take_up(map.lines.iter().filter_map(StoredLine::entry));
        let anchors = map.places.iter().filter_map(StoredPlace::anchor);
        let loops = map.loops.iter().filter_map(|edge| edge.edge(map.places.len()));
        self.places.restore(anchors, loops);
        self.estimator.take_over(map, &self.config);
        let pose = at.unwrap_or_else(Isometry2::identity);
        self.jump(&Prior { pose, covariance: diagonal(THOUGHT) });
        if at.is_none() {
            self.relocalise();
        }
        Ok(())
    }

    /// Whether the map learns from what is seen, as it does at first, or stays as it is, and the robot only finds its way in it.
    pub fn set_mapping(&mut self, mapping: bool) {
        if mapping != self.mapping {
            // What the last keyframe has still to say is said; the filter goes on from where the robot stands.
            let (estimator, mut around) = self.estimator();
            estimator.commit(&mut around);
            let Self { config, estimator, map, places, .. } = self;
            estimator.restart(&estimator.local(), config, map);
            places.pass_lost();
        }
        self.mapping = mapping;
    }

    /// The robot stands near a pose in its map, within some 20 cm and 6°: it goes on from there, and the scans to come correct it.
    pub fn set_pose(&mut self, pose: Isometry2<f32>) {
        // What the last keyframe has still to say is said from where it was seen.
        let (estimator, mut around) = self.estimator();
        estimator.commit(&mut around);
        self.jump(&Prior { pose, covariance: diagonal(THOUGHT) });
    }

    /// See [`Self::set_mapping`].
    pub fn is_mapping(&self) -> bool {
        self.mapping
    }
}
