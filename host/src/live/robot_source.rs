//! A robot as a source: what it says over its link is shown, what the page asks goes to it.
//!
//! The thread belongs to the port: it reads messages, asks again for what the map lacks, and carries out orders between two of them. A port
//! that is gone is opened again until it is there; a robot that was reset goes on in time where it was.

mod scan;
mod telling;

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use super::source::{
    About, Answer, Closed, Command as Asked, Feed, Kind, Line, Note, Order, Source, Weight, What, channel,
};
use crate::link::from_robot::{Cause, Event, Hello, KeptMap, Outcome};
use crate::link::{Address, Client, Command, FromRobot, GREETING, LinkError, MapCopy, Streams, words};
use crate::sim::world::Edge;
use scan::Scans;
use telling::Health;

/// An emulated one may be slow to boot on a busy computer.
const EMULATED_GREETING: Duration = Duration::from_secs(30);
/// Messages are waited for no longer than this, so that orders are not late.
const LISTEN: Duration = Duration::from_millis(20);
/// A port that is gone is tried again this often.
const RETRY: Duration = Duration::from_millis(500);
/// A robot that was silent for so long is said to be.
const SILENCE: Duration = Duration::from_secs(3);
/// A robot's clock that is behind by more than this has begun anew, microseconds.
const RESET_US: u64 = 2_000_000;
/// A scan's middle is no longer ago than this when its pose is said, microseconds.
const SCAN_AGE_US: u64 = 500_000;
const STREAMS: Streams = Streams::DEFAULT.with(Streams::SCANS).with(Streams::MAP);

/// What is known of an emulated robot beside what it says.
#[derive(Clone, Debug)]
pub struct Emulated {
    /// What it is called.
    pub title: String,
    /// The true walls, in its map.
    pub blueprint: Vec<Edge>,
}

/// Opens the port and begins to listen. An error where there is no robot.
pub fn start(address: Address) -> Result<Source, LinkError> {
    begin(address, None)
}

/// The same for an emulated robot, which does not come back once it is gone.
pub fn start_emulated(address: Address, emulated: Emulated) -> Result<Source, LinkError> {
    begin(address, Some(emulated))
}

fn begin(address: Address, emulated: Option<Emulated>) -> Result<Source, LinkError> {
    let mut client = Client::connect(&address)?;
    let hello = greet(&mut client, if emulated.is_some() { EMULATED_GREETING } else { GREETING })?;
    let mut about = about(&address, &hello);
    let comes_back = emulated.is_none();
    if let Some(emulated) = emulated {
        about.title = emulated.title;
        about.blueprint = emulated.blueprint.iter().map(Edge::ends).collect();
    }
    let (source, feed) = channel(about);
    let mut robot = Watched::new(feed, &hello);
    std::thread::spawn(move || {
        let mut client = Some(client);
        // It ends when nobody looks any more.
        while let Ok(open) = robot.listen(client.take(), &address, comes_back) {
            client = open;
        }
    });
    Ok(source)
}

fn greet(client: &mut Client, within: Duration) -> Result<Hello, LinkError> {
    // What came before is passed over; the map is to come whole.
    let (hello, _) = client.greet(STREAMS, within)?;
    // It may have booted since.
    subscribe(client, &hello)?;
    client.send(Command::SendMap { blocks: u32::MAX, places: true })?;
    Ok(hello)
}

/// A robot that was reset sends no more than the usual again.
fn subscribe(client: &mut Client, hello: &Hello) -> Result<(), LinkError> {
    if hello.streams != STREAMS {
        client.send(Command::Subscribe(STREAMS))?;
    }
    Ok(())
}

fn about(address: &Address, hello: &Hello) -> About {
    About {
        title: address.to_string(),
        subtitle: format!("robot '{}', lineslam {} on {}", hello.robot, hello.firmware, hello.board),
        kind: Kind::Robot,
        base_from_laser: hello.scanner.base_from_laser,
        blueprint: Vec::new(),
        paced: false,
    }
}

/// A robot, and what has been told of it.
struct Watched {
    feed: Feed,
    /// What the robot's clock is behind the stamps, since it was reset.
    ahead_us: u64,
    last_us: u64,
    map: MapCopy,
    told: BTreeMap<u16, Line>,
    scans: Scans,
    health: Health,
    heard: Instant,
    is_silent: bool,
}

impl Watched {
    fn new(feed: Feed, hello: &Hello) -> Self {
        Self {
            feed,
            ahead_us: 0,
            last_us: hello.uptime_us.saturating_sub(SCAN_AGE_US),
            map: MapCopy::default(),
            told: BTreeMap::new(),
            scans: Scans::new(hello.scanner),
            health: Health::new(hello),
            heard: Instant::now(),
            is_silent: false,
        }
    }

    /// Listens, or opens the port again, for a while. The port if it is there.
    fn listen(
        &mut self,
        client: Option<Client>,
        address: &Address,
        comes_back: bool,
    ) -> Result<Option<Client>, Closed> {
        let Some(mut client) = client else {
            return if comes_back { self.reopen(address) } else { self.mourn() };
        };
        match self.exchange(&mut client)? {
            Ok(()) => Ok(Some(client)),
            Err(_) if !comes_back => {
                self.note(
                    Weight::Info,
                    "The emulated robot has ended. What is shown is how it was at last.",
                )?;
                Ok(None)
            }
            Err(error) => {
                self.note(Weight::Error, format!("{}: waiting for it to come back.", in_full(error)))?;
                Ok(None)
            }
        }
    }

    /// What was shown stays to be looked at; nothing can be asked of the robot any more.
    fn mourn(&self) -> Result<Option<Client>, Closed> {
        if let Some(order) = self.feed.order(None)? {
            order.answer(Err("The emulated robot has ended.".into()));
        }
        Ok(None)
    }

    fn reopen(&mut self, address: &Address) -> Result<Option<Client>, Closed> {
        if let Some(order) = self.feed.order(Some(RETRY))? {
            order.answer(Err("The robot is not connected.".into()));
        }
        let again = Client::connect(address)
            .and_then(|mut client| greet(&mut client, GREETING).map(|hello| (client, hello)));
        let Ok((client, hello)) = again else { return Ok(None) };
        self.note(Weight::Info, format!("{address}: connected again."))?;
        self.greeted(&hello)?;
        (self.heard, self.is_silent) = (Instant::now(), false);
        Ok(Some(client))
    }

    /// A message and an order, if there are any. The inner error: the port is gone.
    fn exchange(&mut self, client: &mut Client) -> Result<Result<(), LinkError>, Closed> {
        while let Some(order) = self.feed.order(Some(Duration::ZERO))? {
            if let Err(error) = obey(client, order) {
                return Ok(Err(error));
            }
        }
        match client.next(LISTEN) {
            Ok(Some(message)) => {
                (self.heard, self.is_silent) = (Instant::now(), false);
                if let Some(again) = self.map.take(&message)
                    && let Err(error) = client.send(again)
                {
                    return Ok(Err(error));
                }
                if let FromRobot::Hello(hello) = &message
                    && let Err(error) = subscribe(client, hello)
                {
                    return Ok(Err(error));
                }
                self.health.count(client);
                self.take(&message)?;
            }
            Ok(None) if self.heard.elapsed() > SILENCE && !self.is_silent => {
                self.is_silent = true;
                self.note(Weight::Warning, "Nothing is heard from the robot: what is shown is old.")?;
            }
            Ok(None) => {}
            Err(error) => return Ok(Err(error)),
        }
        Ok(Ok(()))
    }

    /// The instant of a pose as a stamp, which does not go back. All else is told at the stamp of the last pose.
    fn stamp_us(&mut self, at_us: u64) -> u64 {
        if at_us + self.ahead_us + RESET_US < self.last_us {
            self.ahead_us = self.last_us - at_us;
        }
        self.last_us = self.last_us.max(at_us + self.ahead_us);
        self.last_us
    }

    fn tell(&self, what: What) -> Result<(), Closed> {
        self.feed.send(self.last_us, what)
    }

    fn note(&self, weight: Weight, text: impl Into<std::borrow::Cow<'static, str>>) -> Result<(), Closed> {
        self.tell(What::Note(Note::new(weight, text)))
    }

    fn take(&mut self, message: &FromRobot) -> Result<(), Closed> {
        match message {
            FromRobot::Hello(hello) => self.greeted(hello),
            FromRobot::Pose(pose) => {
                let stamp_us = self.stamp_us(pose.at_us);
                if pose.cause == Cause::Forgotten {
                    self.forgotten()?;
                }
                self.scans.remember(pose);
                self.health.pose(pose);
                self.feed.send(stamp_us, What::Pose(telling::pose_of(pose)))
            }
            FromRobot::Ranges(part) => match self.scans.take(part) {
                Some(scan) => self.tell(What::Scan(scan)),
                None => Ok(()),
            },
            FromRobot::Block(_) => self.tell_lines(),
            FromRobot::PlacesEnd(_) => self.tell(What::Places(telling::places_of(&self.map))),
            FromRobot::Status(status) => {
                self.health.status(status.clone());
                Ok(())
            }
            FromRobot::Health(of) => {
                self.health.take(of);
                self.tell_status()
            }
            FromRobot::Event(happened) => {
                let is_loop = happened.event == Event::LoopClosed;
                let text = format!("{}.", words::of_event(&happened.event)).into();
                self.tell(What::Note(Note { weight: telling::weight_of(&happened.event), text, is_loop }))
            }
            FromRobot::Lines(_) | FromRobot::Places(_) | FromRobot::Ticks(_) | FromRobot::Answer(_) => Ok(()),
        }
    }

    fn greeted(&mut self, hello: &Hello) -> Result<(), Closed> {
        let was_reset = hello.uptime_us + self.ahead_us + RESET_US < self.last_us;
        self.scans = Scans::new(hello.scanner);
        self.health.room = [hello.lines.into(), hello.places.into()];
        if was_reset && matches!(hello.kept, KeptMap::None | KeptMap::Damaged | KeptMap::GivenUp) {
            self.forgotten()?;
        }
        Ok(())
    }

    fn forgotten(&mut self) -> Result<(), Closed> {
        self.told.clear();
        self.map = MapCopy::default();
        self.tell(What::Forgotten)
    }

    /// Lines that are new or have changed, and those that are gone.
    fn tell_lines(&mut self) -> Result<(), Closed> {
        let now: BTreeMap<u16, Line> =
            self.map.lines().map(|(slot, line)| (slot, telling::line_of(slot, line))).collect();
        let changed: Vec<Line> =
            now.iter().filter(|(slot, line)| self.told.get(slot) != Some(line)).map(|(_, l)| *l).collect();
        let removed: Vec<u32> =
            self.told.keys().filter(|slot| !now.contains_key(slot)).map(|s| u32::from(*s)).collect();
        self.told = now;
        if changed.is_empty() && removed.is_empty() {
            return Ok(());
        }
        self.tell(What::Lines { changed, removed })
    }

    fn tell_status(&mut self) -> Result<(), Closed> {
        let Some(status) = self.health.whole() else { return Ok(()) };
        for trouble in self.health.troubles.new_in(&status) {
            self.note(trouble.weight, trouble.what)?;
        }
        self.tell(What::Status(Box::new(status)))
    }
}

fn in_full(error: LinkError) -> String {
    format!("{:#}", anyhow::Error::from(error))
}

/// Has the robot do what is asked, and answers. An error once the port is gone.
fn obey(client: &mut Client, order: Order) -> Result<(), LinkError> {
    let (command, done) = match order.command {
        Asked::Forget => (Command::Forget, "The map is empty; its origin is where the robot stands."),
        Asked::SetPose { pose } => (Command::SetPose(pose), "The robot goes on from there."),
        Asked::Freeze => {
            (Command::SetMapping(false), "The map stays as it is; the robot finds its way in it.")
        }
        Asked::Unfreeze => (Command::SetMapping(true), "The map learns again."),
        Asked::FindYourself => {
            (Command::Relocalise, "The robot may be anywhere in its map, and looks for itself.")
        }
        Asked::AskMap => {
            (Command::SendMap { blocks: u32::MAX, places: true }, "The robot sends its map again.")
        }
        Asked::Restart => (Command::Restart, "The board restarts; its map is kept."),
        Asked::Pace { .. } => {
            order.answer(Err("A robot goes as fast as it is driven.".into()));
            return Ok(());
        }
    };
    match client.request(command) {
        Ok(outcome) => order.answer(answered(outcome, done)),
        // It may be busy; the port is there.
        Err(error @ LinkError::NoAnswer { .. }) => order.answer(Err(in_full(error))),
        Err(error) => {
            order.answer(Err("The robot is not connected.".into()));
            return Err(error);
        }
    }
    Ok(())
}

fn answered(outcome: Outcome, done: &str) -> Answer {
    match words::of_refusal(outcome) {
        None => Ok(done.into()),
        Some(why) => Err(format!("{why}.")),
    }
}
