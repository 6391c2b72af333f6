//! What the robot says, in the words of the page.

use slam_core::map::MapCounters;
use slam_core::mapper::MapperCounters;
use slam_core::odometry::delay::Delay;
use slam_core::slam::Counters;

use crate::link::from_robot::{self, Event, Hello, State};
use crate::link::{Client, MapCopy, words};
use crate::live::source::{Line, Places, Pose, Weight};
use crate::live::status::{Counter, Status, Troubles};

/// A pose.
pub(super) fn pose_of(said: &from_robot::Pose) -> Pose {
    Pose { at: said.pose, covariance: said.covariance, state: words::state_of(said.state) }
}

/// A line of the map in a slot.
pub(super) fn line_of(slot: u16, said: &link::map::Line) -> Line {
    let ([x0, y0], [x1, y1]) = (said.start_m, said.end_m);
    Line { id: slot.into(), ends: [x0, y0, x1, y1], hits: said.hits, wall: said.is_wall }
}

/// The places.
pub(super) fn places_of(map: &MapCopy) -> Places {
    Places {
        at: map.places().map(|[x, y, _]| [*x, *y]).collect(),
        loops: map.loops().iter().map(|(from, to)| [*from, *to]).collect(),
    }
}

/// How much an event matters.
pub(super) fn weight_of(event: &Event) -> Weight {
    match event {
        Event::Started(_)
        | Event::SensorFound
        | Event::LoopClosed
        | Event::Wheels(None)
        | Event::State(State::Tracking) => Weight::Info,
        Event::SensorLost
        | Event::MapFull
        | Event::CountersRestarted
        | Event::ScanRefused
        | Event::State(State::Uncertain) => Weight::Warning,
        Event::Wheels(Some(_)) | Event::State(State::Lost) => Weight::Error,
    }
}

/// How the robot does, put together from what it says of it.
pub(super) struct Health {
    /// Lines and places that it has room for.
    pub room: [u32; 2],
    /// What has been said of it.
    pub troubles: Troubles,
    lines: u32,
    state: State,
    scans_per_s: f32,
    last_scan_us: Option<u64>,
    status: Option<from_robot::Status>,
    health: Option<from_robot::Health>,
    damaged: u32,
}

impl Health {
    /// Of a robot that says so of itself.
    pub fn new(hello: &Hello) -> Self {
        Self {
            room: [hello.lines.into(), hello.places.into()],
            troubles: Troubles::default(),
            lines: 0,
            state: State::Tracking,
            scans_per_s: 0.0,
            last_scan_us: None,
            status: None,
            health: None,
            damaged: 0,
        }
    }

    /// What came of the bytes received.
    pub fn count(&mut self, client: &Client) {
        self.damaged = client.counters().damaged;
    }

    /// A pose.
    pub fn pose(&mut self, pose: &from_robot::Pose) {
        (self.lines, self.state) = (pose.lines.into(), pose.state);
        if pose.cause != from_robot::Cause::Scan {
            return;
        }
        if let Some(before_us) = self.last_scan_us.replace(pose.at_us)
            && pose.at_us > before_us
        {
            let rate = 1e6 / (pose.at_us - before_us) as f32;
            let share = if self.scans_per_s > 0.0 { 0.1 } else { 1.0 };
            self.scans_per_s += share * (rate - self.scans_per_s);
        }
    }

    /// Counters of the mapping.
    pub fn status(&mut self, status: from_robot::Status) {
        self.status = Some(status);
    }

    /// Processor and link.
    pub fn take(&mut self, health: &from_robot::Health) {
        self.health = Some(health.clone());
    }

    /// All of it, once both have been said.
    pub fn whole(&self) -> Option<Status> {
        let (said, health) = (self.status.as_ref()?, self.health.as_ref()?);
        Some(Status {
            state: words::state_of(self.state),
            mapping: said.mapping,
            support: None,
            scans_per_s: if said.sensor { self.scans_per_s } else { 0.0 },
            scan_us: health.scan_us,
            way_m: said.way_m,
            lines: [self.lines, self.room[0]],
            places: [said.places.into(), self.room[1]],
            core: core_of(said),
            map: map_of(said),
            odometry: MapperCounters {
                stamps_refused: said.stamps_refused,
                scans_without_odometry: said.scans_without_odometry,
                impossible_steps: said.impossible_steps,
                counters_restarted: said.counters_restarted,
                ..MapperCounters::default()
            },
            wheel_fault: said.wheel_fault.map(words::fault_of),
            odometry_useless: false,
            delay: said.delay.map(|(delay_s, sigma_s, used)| Delay { delay_s, sigma_s, used }),
            more: self.counters(said, health),
        })
    }

    fn counters(&self, said: &from_robot::Status, health: &from_robot::Health) -> Vec<Counter> {
        let counter =
            |name, count: u32, meaning, remedy| Counter { name, count: count.into(), meaning, remedy };
        vec![
            counter("sensor lost", said.sensor_losses, "times that the scanner went away", ""),
            counter("scans missed", said.sensor_missed, "by the scanner's stamps", ""),
            counter(
                "scans dropped",
                said.sensor_dropped,
                "that came with damaged bytes",
                "Check the scanner's cable and ground.",
            ),
            counter("errors of the scanner's port", said.port_errors, "noise, framing and overruns", ""),
            counter("samples dropped", said.samples_dropped, "of the wheels, that found no room", ""),
            counter("link: pieces damaged", self.damaged, "that came from the robot", ""),
            counter("link: pieces damaged on the way there", health.damaged, "that went to the robot", ""),
            counter("link: poses replaced", health.poses_replaced, "by newer ones before they were sent", ""),
            counter("link: scans not sent", health.scans_unsent, "for want of room", ""),
            counter("link: events not sent", health.events_unsent, "for want of room", ""),
            counter("link: bytes lost there", health.overruns, "times", ""),
        ]
    }
}

fn core_of(said: &from_robot::Status) -> Counters {
    Counters {
        scans: said.scans,
        wrong_beam_count: said.wrong_beam_count,
        without_segments: said.without_segments,
        uncorrected: said.uncorrected,
        coasted: said.coasted,
        loops_closed: said.loops_closed,
        crowded_out: said.crowded_out,
        odometry_left_out: said.odometry_left_out,
        searched: said.searched,
        lost: said.lost,
        relocalised: said.relocalised,
        gave_up: said.gave_up,
        ..Counters::default()
    }
}

fn map_of(said: &from_robot::Status) -> MapCounters {
    MapCounters {
        added: said.lines_added,
        evicted: said.lines_evicted,
        refused: said.lines_refused,
        fused: said.lines_fused,
        forgotten: said.lines_forgotten,
        opened: said.lines_opened,
    }
}
