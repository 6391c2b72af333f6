//! Takes events in, keeps the history, and tells every page what is new.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use axum::extract::ws::Utf8Bytes;
use tokio::sync::{broadcast, mpsc};
use tokio::time::{Instant, sleep_until, timeout};

use super::history::History;
use super::messages::{Frame, Message, Scene};
use super::source::{About, Event, Note, Orders, Weight, What};

/// Frames are no nearer together than this: what comes in between goes with the next.
const FRAME_EVERY: Duration = Duration::from_millis(16);
/// Something is sent at least so often.
const BEAT_EVERY: Duration = Duration::from_secs(1);
/// Events that are taken in at once.
const AT_ONCE: usize = 4096;
/// Messages that a page may be behind. A slower one is told all anew.
const BEHIND: usize = 64;

/// What the hub and all connections share.
#[derive(Debug)]
pub(super) struct Shared {
    pub about: About,
    pub orders: Orders,
    history: Mutex<History>,
    messages: broadcast::Sender<Utf8Bytes>,
}

impl Shared {
    pub fn new(about: About, orders: Orders) -> Self {
        Self { about, orders, history: Mutex::default(), messages: broadcast::Sender::new(BEHIND) }
    }

    pub fn history(&self) -> MutexGuard<'_, History> {
        // It is whole between two events, whatever else went wrong.
        self.history.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// All there is, and all that comes after it: nothing is told twice, nothing left out.
    pub fn joined(&self) -> (Message, broadcast::Receiver<Utf8Bytes>) {
        let history = self.history();
        (Message::Scene(Box::new(Scene::now(&history))), self.messages.subscribe())
    }

    /// Pages that listen.
    pub fn pages(&self) -> usize {
        self.messages.receiver_count()
    }

    /// Takes in events, and tells what is new.
    fn take(&self, events: &[Event]) {
        let mut history = self.history();
        let mut frame = Frame::default();
        let mut is_all_new = false;
        for event in events {
            history.take(event);
            is_all_new |= !frame.take(event);
        }
        self.send(&match is_all_new {
            true => Message::Scene(Box::new(Scene::now(&history))),
            false => Message::Frame(Box::new(frame)),
        });
    }

    /// Notes something that did not come from the source.
    pub fn note(&self, note: Note) {
        let stamp_us = self.history().span_us().map_or(0, |(_, to_us)| to_us);
        self.take(&[Event { stamp_us, what: What::Note(note) }]);
    }

    fn send(&self, message: &Message) {
        if self.messages.receiver_count() > 0 {
            // Nobody may have stayed.
            let _ = self.messages.send(message.render().into());
        }
    }
}

/// Runs until the source has gone.
pub(super) async fn run(mut events: mpsc::Receiver<Event>, shared: Arc<Shared>) {
    let mut batch = Vec::new();
    loop {
        match timeout(BEAT_EVERY, events.recv_many(&mut batch, AT_ONCE)).await {
            Err(_) => shared.send(&Message::Beat),
            Ok(0) => break,
            Ok(_) => {
                let next = Instant::now() + FRAME_EVERY;
                shared.take(&batch);
                batch.clear();
                sleep_until(next).await;
            }
        }
    }
    shared.note(Note::new(Weight::Error, "The source has ended. Start the command again to go on."));
    loop {
        tokio::time::sleep(BEAT_EVERY).await;
        shared.send(&Message::Beat);
    }
}
