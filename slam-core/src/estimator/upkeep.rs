//! What becomes of the map's lines beside the filter's updates: they move with the places, are cut where they are open, and are forgotten.

use nalgebra::Isometry2;

use super::{Estimator, Surroundings};
use crate::config::SlamConfig;
use crate::ekf::line_map::LineMap;
use crate::geometry::pose::{heading, normalized, rotate_covariance};
use crate::map::SegmentMap;
use crate::map::openings::opening;
use crate::map::visibility::View;
use crate::map::walls::{Fate, WallConfig};
use crate::places::Places;

/// Where updates of the filter follow each other, lines are looked at once the robot has gone on by more than this, metres.
const LONG_WAY_M: f32 = 0.2;

impl Estimator {
    /// Moves with the places, which loops have corrected: the pose, the filter and what was seen on the last `local_m` by `moved`, as
    /// one, so that tracking notices nothing; older lines with the places around which they were seen. Those leave the filter's state:
    /// what they have in common with the pose is not known any more.
    pub fn carry<const N: usize, const P: usize>(
        &mut self,
        moved: &Isometry2<f32>,
        places: &Places<P>,
        around: &mut Surroundings<'_, N>,
    ) {
        let Some(config) = around.config.places else { return };
        self.commit(around);
        for index in 0..around.map.segments().len() {
            let Some(entry) = around.map.get_mut(index) else { continue };
            let is_local =
                self.travelled_m - entry.seen_at_m <= config.local_m && entry.seen_at_m >= self.jumped_at_m;
            let by = if is_local { *moved } else { places.moved(entry.seen_at_m, &entry.midpoint()) };
            let segment = entry.segment().transformed(&by);
            if segment.is_finite() {
                entry.set_segment(&segment);
            }
            if let Some(filter) = self.filter.as_mut().filter(|_| !is_local) {
                filter.decouple_line(index, around.map);
            }
        }
        if let Some(filter) = &mut self.filter {
            filter.turn_pose(heading(moved));
        }
        self.local_covariance = rotate_covariance(moved, &self.local_covariance);
        self.keyframe.map_from_base = normalized(&(moved * self.keyframe.map_from_base));
        self.map_from_base = normalized(&(moved * self.map_from_base));
        self.set_anchor();
        self.restart_way();
    }

    /// Forgets a line of the map.
    pub fn forget_line<const N: usize>(&mut self, index: usize, map: &mut SegmentMap<N>) {
        match &mut self.filter {
            Some(filter) => LineMap { map, filter }.remove(index),
            None => map.forget(index),
        }
    }

    /// Of the next few lines out of sight forgets what is tentative, and makes one of what is the same wall.
    ///
    /// Work: that of [`WallConfig::fate`] for [`WallConfig::lines_per_keyframe`] lines.
    pub fn tidy<const N: usize>(&mut self, config: &WallConfig, map: &mut SegmentMap<N>) {
        for _ in 0..config.lines_per_keyframe {
            let index = usize::from(self.next_tidied).min(map.segments().len());
            self.next_tidied = if index < map.segments().len() { index as u16 + 1 } else { 0 };
            let hits = |index: usize| map.segments().get(index).map_or(0, |entry| entry.hits);
            match (config.fate(index, map.segments(), self.travelled_m), &mut self.filter) {
                (Fate::Forgotten, _) => self.forget_line(index, map),
                (Fate::IsOneWith(twin), Some(filter)) => {
                    let (kept, gone) = if hits(twin) > hits(index) { (twin, index) } else { (index, twin) };
                    LineMap { map, filter }.merge(kept, gone);
                }
                _ => {}
            }
        }
    }

    /// The pose has jumped: that is no way on which lines were crossed.
    pub fn restart_way(&mut self) {
        self.opened_from = self.map_from_base.translation.vector.into();
    }

    /// Whether the robot has gone on so far since lines were looked at last that its way is hardly straight any more.
    pub fn is_way_long(&self) -> bool {
        let way = self.map_from_base.translation.vector - self.opened_from.coords;
        way.norm_squared() > LONG_WAY_M * LONG_WAY_M
    }

    /// Opens the lines nearby that the robot has crossed since they were looked at last, or that beams went through in part. While an
    /// update of the filter is pending, that waits.
    ///
    /// Work: two steps for each line, and the look-ups of [`lines_per_scan`](crate::map::openings::OpeningConfig::lines_per_scan) of them.
    pub fn open_lines<const N: usize>(
        &mut self,
        config: &SlamConfig,
        nearby: &[u16],
        view: Option<&View<'_, '_>>,
        map: &mut SegmentMap<N>,
    ) {
        let SlamConfig { openings: Some(config), line_noise, .. } = config else { return };
        if self.update.is_pending() {
            return;
        }
        let stamp = self.stamp();
        let first = usize::from(self.next_opened);
        if view.is_some() {
            self.next_opened = self.next_opened.wrapping_add(config.lines_per_scan.into());
        }
        let here = self.map_from_base.translation.vector.into();
        let way = [core::mem::replace(&mut self.opened_from, here), here];
        for (rank, index) in nearby.iter().copied().map(usize::from).enumerate() {
            let Some(entry) = map.segments().get(index).filter(|e| e.hits >= config.min_hits) else {
                continue;
            };
            let segment = entry.segment();
            let view = view.filter(|_| config.looks_at(rank, nearby.len(), first));
            let Some(opening) = opening(&segment, way, view, config) else { continue };
            let parts = opening.cut(&segment);
            match &mut self.filter {
                Some(filter) => LineMap { map, filter }.cut(index, parts, line_noise, &stamp),
                None => _ = map.cut(index, parts, stamp.scan),
            }
        }
    }
}
