//! The drive so far, in bounded memory.
//!
//! In: events. Out: what there was at any instant. Each kind has room for so many entries ([`Thinned`]): the last ones are all
//! there, and of older ones every second, every fourth and so on, evenly over the whole drive. So all of it stays within reach, and
//! memory does not grow however long it lasts:
//!
//! | kind | entries | most memory |
//! |---|---|---|
//! | poses | 20 000 | 1.3 MB |
//! | scans, of at most 1024 points | 4096 | 34 MB |
//! | maps, one each half second at most | 1024 | 25 MB with 1024 lines |
//! | paths as corrected by loops, of at most 20 000 points | 24 | 8 MB |
//! | status | 4096 | 3 MB |
//! | notes | 400 | 0.1 MB |

use std::collections::BTreeMap;
use std::sync::Arc;

use super::source::{Event, Line, Note, PathPoint, Places, Playback, Pose, Scan, What};
use super::status::Status;

/// Points of a path, and poses.
pub const PATH_POINTS: usize = 20_000;
/// Points of a scan.
pub const SCAN_POINTS: usize = 1024;
const SCANS: usize = 4096;
const MAPS: usize = 1024;
const MAP_EVERY_US: u64 = 500_000;
const PATHS: usize = 24;
const STATUSES: usize = 4096;
const NOTES: usize = 400;

/// Stamped entries in the order of their stamps, at most so many.
#[derive(Clone, Debug)]
pub struct Thinned<T> {
    /// The thinned ones, then the last ones.
    entries: Vec<(u64, T)>,
    most: usize,
    /// How many are thinned, at most half of all, and that of so many one was kept.
    thinned: usize,
    stride: usize,
    /// Entries that were thinned or dropped so far.
    passed: usize,
}

impl<T> Thinned<T> {
    /// None; room for at least 8.
    pub fn new(most: usize) -> Self {
        Self { entries: Vec::new(), most: most.max(8), thinned: 0, stride: 1, passed: 0 }
    }

    /// Appends an entry. A stamp before the last is taken as the last.
    pub fn push(&mut self, stamp_us: u64, entry: T) {
        while self.entries.len() >= self.most {
            self.thin();
        }
        let stamp_us = self.entries.last().map_or(stamp_us, |(last_us, _)| stamp_us.max(*last_us));
        self.entries.push((stamp_us, entry));
    }

    /// Thins the older half of what is not yet, and where that is too much all of it, to half.
    fn thin(&mut self) {
        let (from, until) = (self.thinned, self.thinned.midpoint(self.entries.len()));
        let (stride, passed) = (self.stride, self.passed);
        let mut index = 0;
        self.entries.retain(|_| {
            index += 1;
            !(from..until).contains(&(index - 1)) || (passed + index - 1 - from).is_multiple_of(stride)
        });
        let moved = until - from;
        self.thinned = from + (0..moved).filter(|k| (passed + k).is_multiple_of(stride)).count();
        self.passed += moved;
        if self.thinned > self.most / 2 {
            let thinned = self.thinned;
            let mut index = 0;
            self.entries.retain(|_| {
                index += 1;
                // The first entry stays: the drive begins there.
                index > thinned || index % 2 == 1
            });
            self.thinned = thinned.div_ceil(2);
            self.stride *= 2;
        }
    }

    /// The last entry that is not later.
    pub fn at(&self, stamp_us: u64) -> Option<&(u64, T)> {
        self.entries[..self.until(stamp_us)].last()
    }

    /// Number of entries that are not later.
    fn until(&self, stamp_us: u64) -> usize {
        self.entries.partition_point(|(entry_us, _)| *entry_us <= stamp_us)
    }

    /// All of them.
    pub fn entries(&self) -> &[(u64, T)] {
        &self.entries
    }
}

/// A map as it was.
#[derive(Clone, Debug, Default)]
pub struct MapThen {
    /// Its lines.
    pub lines: Arc<[Line]>,
    /// Its places.
    pub places: Arc<Places>,
}

/// A path as a loop left it, by stamps.
type Corrected = Thinned<Arc<[PathPoint]>>;

/// The drive so far.
#[derive(Clone, Debug)]
pub struct History {
    poses: Thinned<Pose>,
    scans: Thinned<Scan>,
    maps: Thinned<MapThen>,
    paths: Corrected,
    statuses: Thinned<Arc<Status>>,
    notes: Thinned<Note>,
    lines: BTreeMap<u32, Line>,
    places: Arc<Places>,
    playback: Playback,
}

impl Default for History {
    fn default() -> Self {
        Self {
            poses: Thinned::new(PATH_POINTS),
            scans: Thinned::new(SCANS),
            maps: Thinned::new(MAPS),
            paths: Thinned::new(PATHS),
            statuses: Thinned::new(STATUSES),
            notes: Thinned::new(NOTES),
            lines: BTreeMap::new(),
            places: Arc::default(),
            playback: Playback::default(),
        }
    }
}

impl History {
    /// Takes in an event.
    pub fn take(&mut self, event: &Event) {
        let stamp_us = event.stamp_us;
        match &event.what {
            What::Began => *self = Self { playback: self.playback, ..Self::default() },
            What::Pose(pose) => self.poses.push(stamp_us, *pose),
            What::Scan(scan) => self.scans.push(stamp_us, thinned_scan(scan)),
            What::Lines { changed, removed } => {
                for id in removed {
                    self.lines.remove(id);
                }
                self.lines.extend(changed.iter().map(|line| (line.id, *line)));
                self.keep_map(stamp_us);
            }
            What::Places(places) => {
                self.places = Arc::new(places.clone());
                self.keep_map(stamp_us);
            }
            What::Path(points) => self.paths.push(stamp_us, evenly(points, PATH_POINTS).collect()),
            What::Forgotten => {
                self.lines.clear();
                self.places = Arc::default();
                self.maps.push(stamp_us, MapThen::default());
                self.paths.push(stamp_us, Arc::default());
            }
            What::Status(status) => self.statuses.push(stamp_us, Arc::new(Status::clone(status))),
            What::Note(note) => self.notes.push(stamp_us, note.clone()),
            What::Playback(playback) => self.playback = *playback,
        }
    }

    /// Keeps the map as it is now. One that was kept a moment ago is replaced, and counts from then.
    fn keep_map(&mut self, stamp_us: u64) {
        let map = MapThen { lines: self.lines.values().copied().collect(), places: Arc::clone(&self.places) };
        match self.maps.entries.last_mut() {
            Some((last_us, last))
                if !last.lines.is_empty() && stamp_us < last_us.saturating_add(MAP_EVERY_US) =>
            {
                *last = map;
            }
            _ => self.maps.push(stamp_us, map),
        }
    }

    /// Stamps of the first pose and of the last; `None` before the first.
    pub fn span_us(&self) -> Option<(u64, u64)> {
        Some((self.poses.entries.first()?.0, self.poses.entries.last()?.0))
    }

    /// Where the robot was.
    pub fn pose(&self, at_us: u64) -> Option<&(u64, Pose)> {
        self.poses.at(at_us)
    }

    /// What was seen.
    pub fn scan(&self, at_us: u64) -> Option<&(u64, Scan)> {
        self.scans.at(at_us)
    }

    /// What the map was; that of now, where the instant is not before the last change.
    pub fn map(&self, at_us: u64) -> MapThen {
        if self.maps.entries.last().is_none_or(|(last_us, _)| *last_us <= at_us) {
            return MapThen {
                lines: self.lines.values().copied().collect(),
                places: Arc::clone(&self.places),
            };
        }
        self.maps.at(at_us).map_or_else(MapThen::default, |(_, map)| map.clone())
    }

    /// The path until then, as it was known then: as the last loop left it, and the poses since. At most so many points.
    pub fn path(&self, at_us: u64, most: usize) -> Vec<PathPoint> {
        let (since, corrected) = match self.paths.at(at_us) {
            Some((stamp_us, points)) => (self.poses.until(*stamp_us), &points[..]),
            None => (0, &[][..]),
        };
        let until = self.poses.until(at_us).max(since);
        let poses = &self.poses.entries[since..until];
        let all: Vec<PathPoint> = corrected
            .iter()
            .copied()
            .chain(
                poses
                    .iter()
                    .map(|(stamp_us, pose)| PathPoint { stamp_us: *stamp_us, at: [pose.at[0], pose.at[1]] }),
            )
            .collect();
        evenly(&all, most).collect()
    }

    /// How the robot did.
    pub fn status(&self, at_us: u64) -> Option<&Arc<Status>> {
        self.statuses.at(at_us).map(|(_, status)| status)
    }

    /// What was told until then.
    pub fn notes(&self, at_us: u64) -> &[(u64, Note)] {
        &self.notes.entries[..self.notes.until(at_us)]
    }

    /// Since when the state has been which, over the whole drive.
    pub fn states(&self) -> Vec<(u64, slam_core::tracking::TrackingState)> {
        let mut states: Vec<(u64, _)> = Vec::new();
        for (stamp_us, pose) in &self.poses.entries {
            if states.last().is_none_or(|(_, state)| *state != pose.state) {
                states.push((*stamp_us, pose.state));
            }
        }
        states
    }

    /// How fast the source goes.
    pub fn playback(&self) -> Playback {
        self.playback
    }
}

/// All points, or so many of them, evenly taken, the first and the last among them.
fn evenly(points: &[PathPoint], most: usize) -> impl Iterator<Item = PathPoint> {
    let (last, most) = (points.len().saturating_sub(1), most.max(2));
    let taken = points.len().min(most);
    (0..taken).filter_map(move |k| points.get(if taken < most { k } else { k * last / (most - 1) })).copied()
}

fn thinned_scan(scan: &Scan) -> Scan {
    let step = scan.points_mm.len().div_ceil(SCAN_POINTS).max(1);
    Scan { at: scan.at, points_mm: scan.points_mm.iter().step_by(step).copied().collect() }
}

#[cfg(test)]
mod tests {
    use super::*;
    use slam_core::tracking::TrackingState;

    fn pose(x: f32) -> What {
        What::Pose(Pose { at: [x, 0.0, 0.0], covariance: [0.0; 6], state: TrackingState::Tracking })
    }

    fn line(id: u32, x: f32) -> Line {
        Line { id, ends: [x, 0.0, x, 1.0], hits: 3, wall: true }
    }

    fn take(history: &mut History, stamp_us: u64, what: What) {
        history.take(&Event { stamp_us, what });
    }

    #[test]
    fn memory_is_bounded_and_the_whole_drive_stays_within_reach() {
        let mut thinned = Thinned::new(100);
        for k in 0..100_000u64 {
            thinned.push(k, k);
            assert!(thinned.entries().len() <= 100);
        }
        assert_eq!(thinned.entries()[0], (0, 0), "the beginning stays");
        assert_eq!(thinned.at(u64::MAX), Some(&(99_999, 99_999)));
        let recent: Vec<u64> = thinned.entries().iter().rev().take(25).map(|(stamp, _)| *stamp).collect();
        assert!(
            recent.windows(2).all(|pair| pair[0] - pair[1] == 1),
            "the last ones are all there: {recent:?}"
        );
    }

    #[test]
    fn each_instant_has_its_own_map_and_path() {
        let mut history = History::default();
        for k in 0..10u64 {
            take(&mut history, k * 1_000_000, pose(k as f32));
            let removed = if k > 3 { vec![k as u32 - 4] } else { vec![] };
            take(
                &mut history,
                k * 1_000_000,
                What::Lines { changed: vec![line(k as u32, k as f32)], removed },
            );
        }
        assert_eq!(history.span_us(), Some((0, 9_000_000)));
        let ids = |at_us: u64| history.map(at_us).lines.iter().map(|line| line.id).collect::<Vec<_>>();
        assert_eq!(ids(2_500_000), [0, 1, 2]);
        assert_eq!(ids(9_000_000), [6, 7, 8, 9]);
        assert_eq!(history.path(4_200_000, 100).len(), 5);
        assert_eq!(
            history.path(9_000_000, 3).last().map(|p| p.at[0]),
            Some(9.0),
            "the last point is always there"
        );
        assert!(history.path(9_000_000, 3).len() <= 3);
        assert_eq!(history.pose(4_999_999).map(|(_, pose)| pose.at[0]), Some(4.0));
    }

    #[test]
    fn a_closed_loop_moves_the_path_from_then_on_and_not_before() {
        let mut history = History::default();
        for k in 0..4u64 {
            take(&mut history, k, pose(k as f32));
        }
        let corrected = (0..4u64).map(|k| PathPoint { stamp_us: k, at: [10.0 + k as f32, 0.0] }).collect();
        take(&mut history, 3, What::Path(corrected));
        take(&mut history, 4, pose(14.0));
        let x = |at_us: u64| history.path(at_us, 100).iter().map(|p| p.at[0]).collect::<Vec<_>>();
        assert_eq!(x(2), [0.0, 1.0, 2.0]);
        assert_eq!(x(4), [10.0, 11.0, 12.0, 13.0, 14.0]);
        take(&mut history, 5, What::Forgotten);
        take(&mut history, 6, pose(0.5));
        let x = history.path(6, 100).iter().map(|p| p.at[0]).collect::<Vec<_>>();
        assert_eq!(x, [0.5]);
        take(&mut history, 0, What::Began);
        assert_eq!(history.span_us(), None);
    }
}
