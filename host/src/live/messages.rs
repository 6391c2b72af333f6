//! What goes over the WebSocket, as JSON.
//!
//! | to the page | when | what |
//! |---|---|---|
//! | `hello` | first | [`About`], and the version of these messages |
//! | `scene` | then, and whenever all is new: a loop was closed, the map forgotten, the source begun anew, or the page was too slow | everything as it is now |
//! | `frame` | as things happen, at most 60 a second | what is new since the last one |
//! | `view` | asked for by `view` | everything as it was at an instant |
//! | `answer` | to an order | what became of it |
//! | `beat` | each second without anything else | |
//!
//! From the page come `order` and `view`. Stamps are microseconds, lengths metres, angles radians; points of a scan are
//! millimetres in `base`.

use serde::{Deserialize, Serialize};
use slam_core::tracking::TrackingState;

use super::history::History;
use super::source::{About, Answer, Command, Event, Line, Note, Places, Playback, Pose, Scan, What};
use super::status::{Counted, Fact, Status, Trouble};

/// Version of the messages: a page that was loaded from another version loads itself again.
pub const VERSION: u32 = 2;
/// Points of the path in a view: enough for any screen.
const VIEW_PATH_POINTS: usize = 4000;

/// From the page, as `{"order": {…}}`: an enum that is told by a field inside (`tag`) could not be read where another crate
/// of the build asks `serde_json` for numbers of any precision.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum Request {
    /// Do this.
    Order {
        /// Comes back with the answer.
        id: u32,
        /// What.
        command: Command,
    },
    /// Show that instant.
    View {
        /// Comes back with the view.
        id: u32,
        /// When, microseconds.
        at_us: u64,
    },
}

/// To the page.
#[derive(Clone, Debug, Serialize)]
#[serde(tag = "type", rename_all = "snake_case")]
pub enum Message {
    /// Who is there.
    Hello {
        /// Of the messages.
        version: u32,
        /// The source.
        about: About,
    },
    /// Everything as it is now.
    Scene(Box<Scene>),
    /// What is new.
    Frame(Box<Frame>),
    /// Everything as it was.
    View {
        /// Of the request.
        id: u32,
        /// When, microseconds.
        at_us: u64,
        /// What there was.
        #[serde(flatten)]
        scene: Box<Scene>,
    },
    /// What became of an order.
    Answer {
        /// Of the order.
        id: u32,
        /// Whether it was done.
        done: bool,
        /// In words.
        words: String,
    },
    /// Nothing is new.
    Beat,
}

impl Message {
    /// What became of an order.
    pub fn answer(id: u32, answer: Answer) -> Self {
        let (done, words) = match answer {
            Ok(words) => (true, words),
            Err(words) => (false, words),
        };
        Self::Answer { id, done, words }
    }

    /// As text.
    pub fn render(&self) -> String {
        // Numbers, texts and lists of them have a JSON, all of them; a number that is not finite is null.
        serde_json::to_string(self).unwrap_or_default()
    }
}

/// Stamp; x, y, θ; covariance xx, xy, yy, θθ; state.
type PoseRow = (u64, [f64; 3], [f32; 4], TrackingState);
/// Number; x and y of both ends; hits; whether it stands.
type LineRow = (u32, [f64; 4], u16, bool);

/// A scan.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ScanMessage {
    stamp_us: u64,
    at: [f64; 3],
    points_mm: Vec<[i32; 2]>,
}

/// A path, by columns.
#[derive(Clone, Debug, Default, Serialize)]
pub struct PathMessage {
    stamp_us: Vec<u64>,
    x: Vec<f64>,
    y: Vec<f64>,
}

/// Places, and pairs of them that are one.
#[derive(Clone, Debug, Serialize)]
pub struct PlacesMessage {
    at: Vec<[f64; 2]>,
    loops: Vec<[u16; 2]>,
}

/// How the robot does, in words.
#[derive(Clone, Debug, Serialize)]
pub struct StatusMessage {
    state: TrackingState,
    mapping: bool,
    facts: Vec<Fact>,
    troubles: Vec<Trouble>,
    counters: Vec<Counted>,
}

/// A note and its stamp.
#[derive(Clone, Debug, Serialize)]
pub struct NoteMessage {
    stamp_us: u64,
    #[serde(flatten)]
    note: Note,
}

/// The whole drive on one line.
#[derive(Clone, Debug, Serialize)]
pub struct Timeline {
    from_us: u64,
    to_us: u64,
    states: Vec<(u64, TrackingState)>,
}

/// Everything at an instant.
#[derive(Clone, Debug, Serialize)]
pub struct Scene {
    pose: Option<PoseRow>,
    scan: Option<ScanMessage>,
    lines: Vec<LineRow>,
    places: PlacesMessage,
    path: PathMessage,
    status: Option<StatusMessage>,
    notes: Vec<NoteMessage>,
    playback: Playback,
    #[serde(skip_serializing_if = "Option::is_none")]
    timeline: Option<Timeline>,
}

impl Scene {
    /// As it is now, and where it came from.
    pub fn now(history: &History) -> Self {
        let timeline =
            history.span_us().map(|(from_us, to_us)| Timeline { from_us, to_us, states: history.states() });
        Self { timeline, ..Self::at(history, u64::MAX, super::history::PATH_POINTS) }
    }

    /// As it was at an instant, and how to answer with it.
    pub fn view(history: &History, id: u32, at_us: u64) -> Message {
        Message::View { id, at_us, scene: Box::new(Self::at(history, at_us, VIEW_PATH_POINTS)) }
    }

    fn at(history: &History, at_us: u64, path_points: usize) -> Self {
        let map = history.map(at_us);
        let path = history.path(at_us, path_points);
        Self {
            pose: history.pose(at_us).map(|(stamp_us, pose)| pose_row(*stamp_us, pose)),
            scan: history.scan(at_us).map(|(stamp_us, scan)| scan_message(*stamp_us, scan)),
            lines: map.lines.iter().map(line_row).collect(),
            places: places_message(&map.places),
            path: PathMessage {
                stamp_us: path.iter().map(|p| p.stamp_us).collect(),
                x: path.iter().map(|p| rounded(p.at[0])).collect(),
                y: path.iter().map(|p| rounded(p.at[1])).collect(),
            },
            status: history.status(at_us).map(|status| status_message(status)),
            notes: history
                .notes(at_us)
                .iter()
                .map(|(stamp_us, note)| note_message(*stamp_us, note))
                .collect(),
            playback: history.playback(),
            timeline: None,
        }
    }
}

/// What is new. Of scans, places and status the latest wins; poses, lines and notes are all there.
#[derive(Clone, Debug, Default, Serialize)]
pub struct Frame {
    #[serde(skip_serializing_if = "Vec::is_empty")]
    poses: Vec<PoseRow>,
    #[serde(skip_serializing_if = "Option::is_none")]
    scan: Option<ScanMessage>,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    changed: Vec<LineRow>,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    removed: Vec<u32>,
    #[serde(skip_serializing_if = "Option::is_none")]
    places: Option<PlacesMessage>,
    #[serde(skip_serializing_if = "Option::is_none")]
    status: Option<StatusMessage>,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    notes: Vec<NoteMessage>,
    #[serde(skip_serializing_if = "Option::is_none")]
    playback: Option<Playback>,
}

impl Frame {
    /// Takes in an event. False where it makes everything new, and a [`Scene`] must be sent.
    pub fn take(&mut self, event: &Event) -> bool {
        let stamp_us = event.stamp_us;
        match &event.what {
            What::Began | What::Path(_) | What::Forgotten => return false,
            What::Pose(pose) => self.poses.push(pose_row(stamp_us, pose)),
            What::Scan(scan) => self.scan = Some(scan_message(stamp_us, scan)),
            What::Lines { changed, removed } => {
                // As if the page had taken them one after the other: what was removed may have come again, and the other way round.
                let is_new = |id: &u32| changed.iter().any(|line| line.id == *id) || removed.contains(id);
                self.changed.retain(|row| !is_new(&row.0));
                self.removed.retain(|id| !is_new(id));
                self.changed.extend(changed.iter().map(line_row));
                let stays = |id: &&u32| !changed.iter().any(|line| line.id == **id);
                self.removed.extend(removed.iter().filter(stays));
            }
            What::Places(places) => self.places = Some(places_message(places)),
            What::Status(status) => self.status = Some(status_message(status)),
            What::Note(note) => self.notes.push(note_message(stamp_us, note)),
            What::Playback(playback) => self.playback = Some(*playback),
        }
        true
    }
}

/// To a tenth of a millimetre: a page needs no more, and the text is half as long.
fn rounded(value: f32) -> f64 {
    (f64::from(value) * 1e4).round() / 1e4
}

fn pose_row(stamp_us: u64, pose: &Pose) -> PoseRow {
    let [xx, xy, _, yy, _, tt] = pose.covariance;
    (stamp_us, pose.at.map(rounded), [xx, xy, yy, tt], pose.state)
}

fn line_row(line: &Line) -> LineRow {
    (line.id, line.ends.map(rounded), line.hits, line.wall)
}

fn scan_message(stamp_us: u64, scan: &Scan) -> ScanMessage {
    ScanMessage { stamp_us, at: scan.at.map(rounded), points_mm: scan.points_mm.clone() }
}

fn places_message(places: &Places) -> PlacesMessage {
    PlacesMessage { at: places.at.iter().map(|at| at.map(rounded)).collect(), loops: places.loops.clone() }
}

fn status_message(status: &Status) -> StatusMessage {
    StatusMessage {
        state: status.state,
        mapping: status.mapping,
        facts: status.facts(),
        troubles: status.troubles(),
        counters: status.counted(),
    }
}

fn note_message(stamp_us: u64, note: &Note) -> NoteMessage {
    NoteMessage { stamp_us, note: note.clone() }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn lines(changed: &[u32], removed: &[u32]) -> Event {
        let changed = changed.iter().map(|&id| Line { id, ends: [0.0, 0.0, 1.0, 0.0], hits: 3, wall: true });
        Event { stamp_us: 0, what: What::Lines { changed: changed.collect(), removed: removed.to_vec() } }
    }

    #[test]
    fn changes_of_a_frame_come_to_the_same_as_one_after_the_other() {
        let mut frame = Frame::default();
        for event in [lines(&[1, 2, 3], &[]), lines(&[2], &[1]), lines(&[], &[3]), lines(&[3], &[2])] {
            assert!(frame.take(&event));
        }
        assert_eq!(frame.changed.iter().map(|row| row.0).collect::<Vec<_>>(), [3]);
        assert_eq!(frame.removed, [1, 2]);
        assert!(!frame.take(&Event { stamp_us: 0, what: What::Began }));
    }

    #[test]
    fn requests_are_read_strictly() {
        let read = |text: &str| serde_json::from_str::<Request>(text);
        let order = read(r#"{"order":{"id":7,"command":{"set_pose":{"pose":[1,2.5,-0.1]}}}}"#);
        assert_eq!(
            order.unwrap(),
            Request::Order { id: 7, command: Command::SetPose { pose: [1.0, 2.5, -0.1] } }
        );
        let fast = read(r#"{"order":{"id":1,"command":{"pace":{"speed":null}}}}"#).unwrap();
        assert_eq!(fast, Request::Order { id: 1, command: Command::Pace { speed: None } });
        for bad in [
            "",
            "{}",
            r#"{"order":{"id":7}}"#,
            r#"{"order":{"id":7,"command":"fly"}}"#,
            r#"{"order":{"id":7,"command":{"set_pose":{"pose":[1,2]}}}}"#,
            r#"{"view":{"id":1,"at_us":-4}}"#,
            r#"{"view":{"id":1,"at_us":4,"more":1}}"#,
        ] {
            assert!(read(bad).is_err(), "{bad}");
        }
    }
}
