//! Maps that are saved and loaded, and a map that stays as it is.

use nalgebra::Isometry2;

use super::Slam;
use crate::map::store::{MapError, StoredLine, StoredLoop, StoredMap, StoredPlace};
use crate::places::LOOPS;

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

    /// Takes a saved map in place of the one there is. The robot stands at a pose in it, which is taken as certain, or looks for
    /// itself. Fails without having changed anything.
    pub fn load(&mut self, map: &StoredMap<'_>, at: Option<Isometry2<f32>>) -> Result<(), MapError> {
        MapError::check_room("lines", map.lines.len(), N)?;
        MapError::check_room("places", map.places.len(), P)?;
        MapError::check_room("loops", map.loops.len(), LOOPS)?;
        let invalid = |what, index: Option<usize>| match index {
            Some(index) => Err(MapError::Invalid { what, index }),
            None => Ok(()),
        };
        invalid("lines", map.lines.iter().position(|line| line.entry().is_none()))?;
        invalid("places", map.places.iter().position(|place| place.anchor().is_none()))?;
        invalid("loops", map.loops.iter().position(|edge| edge.edge(map.places.len()).is_none()))?;
        if !map.way_m.is_finite() || !map.odometry_bias.0.iter().all(|v| v.is_finite()) {
            return Err(MapError::NotFinite);
        }
        self.map.take_up(map.lines.iter().filter_map(StoredLine::entry));
        let anchors = map.places.iter().filter_map(StoredPlace::anchor);
        let loops = map.loops.iter().filter_map(|edge| edge.edge(map.places.len()));
        self.places.restore(anchors, loops);
        self.places.pass_lost();
        self.estimator.begin_in(map, at.unwrap_or_else(Isometry2::identity), &self.config);
        if at.is_none() {
            self.relocalise();
        }
        Ok(())
    }

    /// Whether the map learns from what is seen, as it does at first, or stays as it is, and the robot only finds its way in it.
    pub fn set_mapping(&mut self, mapping: bool) {
        if mapping && !self.mapping {
            let at = self.estimator.local();
            self.estimator.restart(&at, &self.config, &mut self.map);
            self.places.pass_lost();
        }
        self.mapping = mapping;
    }

    /// See [`Self::set_mapping`].
    pub fn is_mapping(&self) -> bool {
        self.mapping
    }
}
