//! A log, or a simulated drive, as a source: it goes through the core at the pace of its stamps, or another, and the core can be
//! told what a robot can be told.

mod orders;

use std::borrow::Cow;
use std::time::{Duration, Instant};

use nalgebra::Isometry2;
use slam_core::capacity::{PLACES, SEGMENTS};
use slam_core::frontend::deskew::{ScanPoint, deskew};
use slam_core::geometry::pose::components;
use slam_core::odometry::track::ScanMotion;
use slam_core::relocalisation::SearchState;
use slam_core::tracking::TrackingState;
use slam_core::{MapSegment, SlamUpdate};

use super::source::{
    About, Closed, Feed, Kind, Line, Note, PathPoint, Places, Playback, Pose, Scan, Source, Weight, What,
    channel,
};
use super::status::{Status, Troubles};
use crate::configuration::Configuration;
use crate::log::Log;
use crate::replay::{MOST_BEAMS, ReplayError, Run, Start, Taken};
use crate::robot::Robot;
use crate::sim::world::Edge;

/// Longer gaps in a log are passed over after this time.
const LONGEST_GAP: Duration = Duration::from_secs(2);
/// Status is told so often, microseconds of the log.
const STATUS_EVERY_US: u64 = 1_000_000;
/// Stack of the thread that plays it, bytes: the core passes over it when it is made.
const STACK: usize = 16 << 20;
/// Faster than this is as fast as it can.
const FASTEST: f32 = 1000.0;

/// A log and what it is replayed with.
#[derive(Clone, Debug)]
pub struct LogSource {
    /// The log.
    pub log: Log,
    /// The robot.
    pub robot: Robot,
    /// Which algorithm.
    pub configuration: Configuration,
    /// Where the robot begins.
    pub start: Start,
    /// Times as fast as it was recorded; `None` as fast as it can.
    pub speed: Option<f32>,
    /// Its name for people.
    pub title: String,
    /// The true walls in `map`, where the drive was simulated.
    pub blueprint: Option<Vec<Edge>>,
}

impl LogSource {
    /// Starts it on a thread of its own. Fails where the log cannot be replayed with the robot.
    pub fn start(self) -> Result<Source, ReplayError> {
        let (source, feed) = channel(self.about());
        let (begun, has_begun) = std::sync::mpsc::channel();
        let thread = std::thread::Builder::new().name("log".into()).stack_size(STACK);
        let thread = thread.spawn(move || match self.run() {
            Ok(run) => {
                // Whoever started it waits for this.
                let _ = begun.send(Ok(()));
                self.play(run, &feed);
            }
            Err(error) => {
                let _ = begun.send(Err(error));
            }
        });
        thread.map_err(ReplayError::Thread)?;
        has_begun.recv().unwrap_or(Ok(()))?;
        Ok(source)
    }

    fn about(&self) -> About {
        let laser = self.robot.sensor_for(&self.log.layout(0)).mounting.base_from_laser;
        About {
            title: self.title.clone(),
            subtitle: format!("{}, {}", self.robot.name, self.configuration.subtitle()),
            kind: if self.blueprint.is_some() { Kind::Simulation } else { Kind::Log },
            base_from_laser: components(&laser).into(),
            blueprint: self.blueprint.iter().flatten().map(Edge::ends).collect(),
            paced: true,
        }
    }

    fn run(&self) -> Result<Run<'_>, ReplayError> {
        Run::new(&self.start, &self.log, &self.robot, self.configuration.config())
    }

    /// Plays it, and again whenever it is restarted, until nobody listens.
    fn play<'a>(&'a self, mut run: Run<'a>, feed: &'a Feed) {
        let mut speed = self.speed;
        while let Ok(at) = Player::new(self, run, feed, speed).play() {
            speed = at;
            // It has begun like this before.
            let Ok(again) = self.run() else { return };
            run = again;
        }
    }
}

/// The path as the final map has it so far.
#[derive(Clone, Copy)]
struct Driven {
    stamp_us: u64,
    way_m: f32,
    pose: Isometry2<f32>,
}

/// What has been told before, so that only what is new is told.
#[derive(Default)]
struct Told {
    segments: Vec<MapSegment>,
    lines: Vec<Option<Line>>,
    places: Places,
    status_us: Option<u64>,
    state: TrackingState,
    troubles: Troubles,
}

/// One pass through the log.
struct Player<'a> {
    source: &'a LogSource,
    run: Run<'a>,
    feed: &'a Feed,
    speed: Option<f32>,
    /// An instant of the log and when it was played.
    anchor: Option<(u64, Instant)>,
    driven: Vec<Driven>,
    told: Told,
    now_us: u64,
    scans_per_s: f32,
    restarts: bool,
    ended: bool,
}

impl<'a> Player<'a> {
    fn new(source: &'a LogSource, run: Run<'a>, feed: &'a Feed, speed: Option<f32>) -> Self {
        Self {
            source,
            feed,
            speed,
            anchor: None,
            driven: Vec::new(),
            told: Told::default(),
            now_us: run.next_us().unwrap_or(0),
            run,
            scans_per_s: 0.0,
            restarts: false,
            ended: false,
        }
    }

    /// Plays to the end, and waits there. The speed at which it shall begin again.
    fn play(mut self) -> Result<Option<f32>, Closed> {
        self.tell(What::Began)?;
        self.tell_playback()?;
        while let Some(next_us) = self.run.next_us() {
            self.wait_for(next_us)?;
            if self.restarts {
                return Ok(self.speed);
            }
            match self.run.step() {
                Ok(Some(taken)) => self.tell_scan(&taken)?,
                Ok(None) => break,
                Err(error) => {
                    self.note(Weight::Error, format!("The log cannot be played on: {error}"))?;
                    break;
                }
            }
        }
        self.ended = true;
        self.tell_playback()?;
        self.note(Weight::Info, "The log has ended.")?;
        while !self.restarts {
            if let Some(order) = self.feed.order(None)? {
                self.obey(order)?;
            }
        }
        Ok(self.speed)
    }

    /// Obeys orders until the scan is due.
    fn wait_for(&mut self, next_us: u64) -> Result<(), Closed> {
        loop {
            let wait = self.due_in(next_us);
            let Some(order) = self.feed.order(wait)? else { return Ok(()) };
            self.obey(order)?;
            if self.restarts {
                return Ok(());
            }
        }
    }

    /// Time until the scan is due; none while paused.
    fn due_in(&mut self, next_us: u64) -> Option<Duration> {
        let speed = match self.speed {
            None => return Some(Duration::ZERO),
            Some(speed) if speed <= 0.0 => return None,
            Some(speed) => speed,
        };
        let now = Instant::now();
        let (from_us, from) = *self.anchor.get_or_insert((self.now_us, now));
        let after = Duration::from_secs_f64(next_us.saturating_sub(from_us) as f64 * 1e-6 / f64::from(speed));
        let due = (from + after).saturating_duration_since(now);
        if due > LONGEST_GAP {
            self.anchor = Some((next_us, now + LONGEST_GAP));
            return Some(LONGEST_GAP);
        }
        Some(due)
    }

    fn tell(&self, what: What) -> Result<(), Closed> {
        self.feed.send(self.now_us, what)
    }

    fn note(&self, weight: Weight, text: impl Into<Cow<'static, str>>) -> Result<(), Closed> {
        self.tell(What::Note(Note::new(weight, text)))
    }

    fn tell_playback(&self) -> Result<(), Closed> {
        self.tell(What::Playback(Playback { speed: self.speed, ended: self.ended }))
    }

    fn tell_scan(&mut self, taken: &Taken) -> Result<(), Closed> {
        let update = &taken.update;
        let stamp_us = self.source.log.scans.get(taken.scan).map_or(self.now_us, |scan| scan.stamp_us);
        let since_s = stamp_us.saturating_sub(self.now_us) as f32 * 1e-6;
        if since_s > 0.0 {
            let share = if self.scans_per_s > 0.0 { 0.1 } else { 1.0 };
            self.scans_per_s += share * (1.0 / since_s - self.scans_per_s);
        }
        self.now_us = self.now_us.max(stamp_us);
        if update.closure.is_some() {
            self.tell_loop()?;
        }
        self.driven.push(Driven { stamp_us, way_m: update.way_m, pose: update.pose });
        self.tell(What::Pose(pose_of(update)))?;
        if update.rejected.is_none() {
            let points_mm = self.points_mm(taken.scan, &taken.motion);
            self.tell(What::Scan(Scan { at: components(&update.pose).into(), points_mm }))?;
        }
        self.tell_map()?;
        self.tell_search(update)?;
        self.tell_status(taken)
    }

    /// The path as the loop has moved it.
    fn tell_loop(&mut self) -> Result<(), Closed> {
        let places = self.run.mapper.slam().places();
        for at in &mut self.driven {
            at.pose = places.moved_pose(at.way_m, &at.pose);
        }
        let point = |at: &Driven| PathPoint { stamp_us: at.stamp_us, at: at.pose.translation.vector.into() };
        self.tell(What::Path(self.driven.iter().map(point).collect()))?;
        let text = "A loop was closed: walls and path have moved to where they fit.".into();
        self.tell(What::Note(Note { weight: Weight::Info, text, is_loop: true }))
    }

    /// Where the beams of a scan ended, all of them, in `base`.
    fn points_mm(&self, scan: usize, motion: &ScanMotion) -> Vec<[i32; 2]> {
        let config = self.run.mapper.slam().config();
        let still = ScanMotion::instantaneous(motion.since_previous);
        let motion = if motion.is_finite() { motion } else { &still };
        let ranges_mm = self.source.log.scans.get(scan).map_or(&[][..], |scan| &scan.ranges_mm);
        let mut points = heapless::Vec::<ScanPoint, MOST_BEAMS>::new();
        deskew(&slam_core::Scan { ranges_mm }, motion, &config.sensor, &config.deskew, 0.0, &mut points);
        points.iter().map(|p| [p.position.x, p.position.y].map(|v| (v * 1e3).round() as i32)).collect()
    }

    /// Lines and places that are new or have changed.
    fn tell_map(&mut self) -> Result<(), Closed> {
        let slam = self.run.mapper.slam();
        let segments = slam.map().segments();
        let mut changed = Vec::new();
        // Which lines stand is worth asking only where something has changed.
        let news = if segments == self.told.segments { &[][..] } else { segments };
        self.told.segments = segments.to_vec();
        for (index, entry) in news.iter().enumerate() {
            let (start, end) = (entry.segment().start, entry.segment().end);
            let ends = [start.x, start.y, end.x, end.y];
            let wall = slam.is_wall(index);
            let line = Line { id: index as u32, ends, hits: entry.hits, wall };
            if self.told.lines.get(index) != Some(&Some(line)) {
                changed.push(line);
            }
        }
        let gone = segments.len()..self.told.lines.len();
        let removed: Vec<u32> = gone.map(|index| index as u32).collect();
        self.told.lines.resize(segments.len(), None);
        for line in &changed {
            if let Some(told) = self.told.lines.get_mut(line.id as usize) {
                *told = Some(*line);
            }
        }
        let places = Places {
            at: slam
                .places()
                .anchors()
                .iter()
                .map(|anchor| anchor.pose().translation.vector.into())
                .collect(),
            loops: slam.stored_loops().map(|edge| [edge.from, edge.to]).collect(),
        };
        if !changed.is_empty() || !removed.is_empty() {
            self.tell(What::Lines { changed, removed })?;
        }
        if places != self.told.places {
            self.tell(What::Places(places.clone()))?;
            self.told.places = places;
        }
        Ok(())
    }

    fn tell_search(&self, update: &SlamUpdate) -> Result<(), Closed> {
        match update.relocalisation.map(|search| search.state) {
            Some(SearchState::Found) => self.note(Weight::Info, "The robot has found itself in its map."),
            Some(SearchState::GivenUp) => self.note(
                Weight::Warning,
                "Nothing in the map is like what is seen: the robot goes on from where it was thought to be.",
            ),
            _ => Ok(()),
        }
    }

    /// Status once a second and when the state changes, and a note of each trouble that is new.
    fn tell_status(&mut self, taken: &Taken) -> Result<(), Closed> {
        let state = taken.update.state;
        let due = self.told.status_us.is_none_or(|told_us| self.now_us >= told_us + STATUS_EVERY_US);
        if !due && state == self.told.state {
            return Ok(());
        }
        let status = self.status(&taken.update, taken.took);
        for trouble in self.told.troubles.new_in(&status) {
            self.note(trouble.weight, trouble.what)?;
        }
        if state == TrackingState::Tracking && self.told.state != state {
            self.note(Weight::Info, "The robot knows where it is.")?;
        }
        (self.told.status_us, self.told.state) = (Some(self.now_us), state);
        self.tell(What::Status(Box::new(status)))
    }

    fn status(&self, update: &SlamUpdate, took: Duration) -> Status {
        let mapper = &self.run.mapper;
        let slam = mapper.slam();
        Status {
            state: slam.state(),
            mapping: slam.is_mapping(),
            support: Some(update.support),
            scans_per_s: self.scans_per_s,
            scan_us: took.as_micros().try_into().unwrap_or(u32::MAX),
            way_m: slam.way_m(),
            lines: [slam.map().segments().len() as u32, SEGMENTS as u32],
            places: [slam.places().anchors().len() as u32, PLACES as u32],
            core: slam.counters(),
            map: slam.map().counters(),
            odometry: mapper.counters(),
            wheel_fault: slam.wheel_fault(),
            odometry_useless: update.odometry_useless,
            delay: mapper.delay(),
            more: Vec::new(),
        }
    }
}

fn pose_of(update: &SlamUpdate) -> Pose {
    let c = &update.covariance;
    Pose {
        at: components(&update.pose).into(),
        covariance: [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)].map(|at| c[at]),
        state: update.state,
    }
}
