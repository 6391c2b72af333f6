//! Between whatever knows of a robot and the server: events with stamps one way, orders the other.
//!
//! A source calls [`channel`], hands the [`Source`] to the server and keeps the [`Feed`] on a thread of its own. A new kind of
//! source needs nothing else. Both queues are bounded. Events: [`Feed::send`] waits for the server, as a log may;
//! [`Feed::try_send`] never waits, and the source counts what was dropped. Orders: while the queue is full the server answers
//! that the source is busy.

use std::borrow::Cow;
use std::sync::mpsc as std_mpsc;
use std::time::Duration;

use serde::{Deserialize, Serialize};
use slam_core::tracking::TrackingState;
use tokio::sync::{mpsc, oneshot};

use super::status::Status;

/// Events that may wait for the server.
const EVENTS: usize = 1024;
/// Orders that may wait for the source.
const ORDERS: usize = 16;

/// What kind of source it is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Kind {
    /// A recorded log.
    Log,
    /// A simulated drive.
    Simulation,
    /// A robot.
    Robot,
}

/// What does not change while a source runs.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct About {
    /// What it is called: the name of the log, the world or the port.
    pub title: String,
    /// What is beneath: robot and configuration.
    pub subtitle: String,
    /// What it is.
    pub kind: Kind,
    /// Pose (x, y in m, θ in rad) of the laser in `base`.
    pub base_from_laser: [f32; 3],
    /// The true walls in `map` (x and y of both ends, m), where they are known.
    pub blueprint: Vec<[f32; 4]>,
    /// Whether it obeys [`Command::Pace`].
    pub paced: bool,
}

/// Something that happened.
#[derive(Clone, Debug, PartialEq)]
pub struct Event {
    /// When, microseconds. Does not go back but with [`What::Began`]: a robot that was reset goes on where it was.
    pub stamp_us: u64,
    /// What.
    pub what: What,
}

/// What happened. Everything is in `map`, in metres and radians.
#[derive(Clone, Debug, PartialEq)]
pub enum What {
    /// All begins anew, the history too.
    Began,
    /// Where the robot is.
    Pose(Pose),
    /// What the scanner saw.
    Scan(Scan),
    /// Lines of the map that are new or have changed, and numbers of those that are gone.
    Lines {
        /// New or changed.
        changed: Vec<Line>,
        /// Gone.
        removed: Vec<u32>,
    },
    /// All places, and which of them loops tie.
    Places(Places),
    /// The whole path as it is known now, stamps and positions: a loop was closed.
    Path(Vec<PathPoint>),
    /// The map was forgotten: no lines, no places, and the path begins here.
    Forgotten,
    /// How the robot does; about once a second, and when its state changes.
    Status(Box<Status>),
    /// Something worth telling.
    Note(Note),
    /// How fast a source that obeys [`Command::Pace`] goes.
    Playback(Playback),
}

/// Where the robot is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pose {
    /// x and y (m) and θ (rad) of `base`.
    pub at: [f32; 3],
    /// Its covariance: xx, xy, xθ, yy, yθ, θθ.
    pub covariance: [f32; 6],
    /// How far it is to be relied on.
    pub state: TrackingState,
}

/// A scan.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Scan {
    /// Pose of `base` at its middle beam.
    pub at: [f32; 3],
    /// Obstacles in `base`, x and y, millimetres.
    pub points_mm: Vec<[i32; 2]>,
}

/// A line of the map.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Line {
    /// Its number, until it is gone.
    pub id: u32,
    /// x and y of both ends.
    pub ends: [f32; 4],
    /// How often it was seen.
    pub hits: u16,
    /// Whether it stands, or is tentative.
    pub wall: bool,
}

/// Places and loops.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Places {
    /// x and y.
    pub at: Vec<[f32; 2]>,
    /// Indices of places that are one, the older first.
    pub loops: Vec<[u16; 2]>,
}

/// A point of the path.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PathPoint {
    /// When the robot was there, microseconds.
    pub stamp_us: u64,
    /// x and y.
    pub at: [f32; 2],
}

/// How much it matters.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Weight {
    /// Good to know.
    Info,
    /// Worth a look.
    Warning,
    /// Something is wrong.
    Error,
}

/// Something worth telling.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Note {
    /// How much it matters.
    pub weight: Weight,
    /// What happened.
    pub text: Cow<'static, str>,
    /// Whether a loop was closed with it: the timeline marks it.
    pub is_loop: bool,
}

impl Note {
    /// A note.
    pub fn new(weight: Weight, text: impl Into<Cow<'static, str>>) -> Self {
        Self { weight, text: text.into(), is_loop: false }
    }
}

/// How fast a source goes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Playback {
    /// Seconds of the log in a second; zero while it is paused, `None` as fast as it can.
    pub speed: Option<f32>,
    /// Whether it has come to its end.
    pub ended: bool,
}

/// What a source can be told.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum Command {
    /// Forget the map and begin a new one.
    Forget,
    /// The robot stands here.
    SetPose {
        /// x and y (m) and θ (rad) of `base` in `map`.
        pose: [f32; 3],
    },
    /// The map stays as it is.
    Freeze,
    /// The map learns again.
    Unfreeze,
    /// The robot may be anywhere in its map: it looks for itself.
    FindYourself,
    /// Send the whole map again.
    AskMap,
    /// Begin anew: a robot boots, a log plays from its first scan.
    Restart,
    /// Go so many times as fast as time; zero pauses, no number is as fast as it can.
    Pace {
        /// Times as fast.
        speed: Option<f32>,
    },
}

impl Command {
    /// Its name for people.
    pub fn name(&self) -> &'static str {
        match self {
            Self::Forget => "Forget the map",
            Self::SetPose { .. } => "Set pose",
            Self::Freeze => "Freeze the map",
            Self::Unfreeze => "Let the map learn",
            Self::FindYourself => "Find yourself",
            Self::AskMap => "Ask for the map",
            Self::Restart => "Restart",
            Self::Pace { .. } => "Pace",
        }
    }
}

/// What became of an order, in words: what was done, or why not.
pub type Answer = Result<String, String>;

/// A command on its way, and where its answer goes.
#[derive(Debug)]
pub struct Order {
    /// What is asked.
    pub command: Command,
    answer: oneshot::Sender<Answer>,
}

impl Order {
    /// Answers it, once.
    pub fn answer(self, answer: Answer) {
        // Whoever asked may have gone; the order was carried out all the same.
        let _ = self.answer.send(answer);
    }
}

/// The server's end.
#[derive(Debug)]
pub struct Source {
    /// What it is.
    pub about: About,
    pub(super) events: mpsc::Receiver<Event>,
    pub(super) orders: Orders,
}

impl Source {
    /// The next event, where one has come. An error once there are no more.
    pub fn try_next(&mut self) -> Result<Option<Event>, Closed> {
        match self.events.try_recv() {
            Ok(event) => Ok(Some(event)),
            Err(mpsc::error::TryRecvError::Empty) => Ok(None),
            Err(mpsc::error::TryRecvError::Disconnected) => Err(Closed),
        }
    }
}

/// The server has gone: a source ends.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("nobody listens any more")]
pub struct Closed;

/// The source's end.
#[derive(Debug)]
pub struct Feed {
    events: mpsc::Sender<Event>,
    orders: std_mpsc::Receiver<Order>,
}

/// The two ends.
pub fn channel(about: About) -> (Source, Feed) {
    let (events_in, events) = mpsc::channel(EVENTS);
    let (orders, orders_out) = std_mpsc::sync_channel(ORDERS);
    (Source { about, events, orders: Orders(orders) }, Feed { events: events_in, orders: orders_out })
}

impl Feed {
    /// Hands over an event; waits while the server is behind. Not to be called on the server's own thread.
    pub fn send(&self, stamp_us: u64, what: What) -> Result<(), Closed> {
        self.events.blocking_send(Event { stamp_us, what }).map_err(|_| Closed)
    }

    /// The same without waiting. False where the event found no room and was dropped.
    pub fn try_send(&self, stamp_us: u64, what: What) -> Result<bool, Closed> {
        match self.events.try_send(Event { stamp_us, what }) {
            Ok(()) => Ok(true),
            Err(mpsc::error::TrySendError::Full(_)) => Ok(false),
            Err(mpsc::error::TrySendError::Closed(_)) => Err(Closed),
        }
    }

    /// The next order, waited for so long; without a limit where there is none.
    pub fn order(&self, wait: Option<Duration>) -> Result<Option<Order>, Closed> {
        match wait {
            None => self.orders.recv().map(Some).map_err(|_| Closed),
            Some(wait) => match self.orders.recv_timeout(wait) {
                Ok(order) => Ok(Some(order)),
                Err(std_mpsc::RecvTimeoutError::Timeout) => Ok(None),
                Err(std_mpsc::RecvTimeoutError::Disconnected) => Err(Closed),
            },
        }
    }
}

/// Where orders go in.
#[derive(Clone, Debug)]
pub(super) struct Orders(std_mpsc::SyncSender<Order>);

impl Orders {
    /// Gives an order and waits for what becomes of it.
    pub async fn give(&self, command: Command) -> Answer {
        let (answer, answered) = oneshot::channel();
        match self.0.try_send(Order { command, answer }) {
            Ok(()) => answered.await.unwrap_or_else(|_| Err("the source has ended".into())),
            Err(std_mpsc::TrySendError::Full(_)) => Err("the source is busy: try again".into()),
            Err(std_mpsc::TrySendError::Disconnected(_)) => Err("the source has ended".into()),
        }
    }
}
