//! `lineslam live` as a browser and a user meet it: what is served, who is refused, what a log tells, what commands do.

mod live_bench;
mod socket_robot;

use std::collections::BTreeMap;
use std::io::{BufRead, BufReader, Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use lineslam::configuration::Configuration;
use lineslam::live::source::{About, Feed, Kind, Line, Pose, What, channel};
use lineslam::replay;
use live_bench::{Served, drive, robot, simulated};
use serde_json::{Value, json};
use slam_core::geometry::pose::components;
use slam_core::tracking::TrackingState;
use tungstenite::client::IntoClientRequest;
use tungstenite::{Message, WebSocket};

const PATIENCE: Duration = Duration::from_secs(60);

/// A request as it goes over the line; the answer, head and body.
fn http(address: SocketAddr, path: &str, host: &str) -> (String, Vec<u8>) {
    let mut stream = TcpStream::connect(address).unwrap();
    stream.set_read_timeout(Some(PATIENCE)).unwrap();
    write!(stream, "GET {path} HTTP/1.1\r\nHost: {host}\r\nConnection: close\r\n\r\n").unwrap();
    let mut answer = Vec::new();
    stream.read_to_end(&mut answer).unwrap();
    let end = answer.windows(4).position(|w| w == b"\r\n\r\n").unwrap() + 4;
    (String::from_utf8(answer[..end].to_vec()).unwrap().to_lowercase(), answer[end..].to_vec())
}

/// A page, as far as the server can tell.
struct Page {
    socket: WebSocket<TcpStream>,
    /// What it has been told.
    path: Vec<(u64, [f64; 2])>,
    lines: BTreeMap<u64, [f64; 4]>,
    walls: BTreeMap<u64, bool>,
    ended: bool,
    speed: Value,
    notes: Vec<String>,
    scenes: usize,
    next: u64,
}

impl Page {
    fn connect(
        address: SocketAddr,
        host: &str,
        origin: Option<&str>,
    ) -> Result<WebSocket<TcpStream>, Box<tungstenite::Error>> {
        let mut request = format!("ws://{address}/ws").into_client_request().unwrap();
        request.headers_mut().insert("host", host.parse().unwrap());
        if let Some(origin) = origin {
            request.headers_mut().insert("origin", origin.parse().unwrap());
        }
        let stream = TcpStream::connect(address).unwrap();
        stream.set_read_timeout(Some(PATIENCE)).unwrap();
        match tungstenite::client(request, stream) {
            Ok((socket, _)) => Ok(socket),
            Err(tungstenite::HandshakeError::Failure(error)) => Err(Box::new(error)),
            Err(other) => panic!("{other}"),
        }
    }

    fn open(address: SocketAddr) -> Self {
        let socket =
            Self::connect(address, &address.to_string(), Some(&format!("http://{address}"))).unwrap();
        let (path, lines, walls, notes) = Default::default();
        let mut page =
            Self { socket, path, lines, walls, ended: false, speed: json!(null), notes, scenes: 0, next: 1 };
        let hello = page.read();
        assert_eq!((&hello["type"], &hello["version"]), (&json!("hello"), &json!(2)));
        page
    }

    fn read(&mut self) -> Value {
        loop {
            match self.socket.read().unwrap() {
                Message::Text(text) => return serde_json::from_str(&text).unwrap(),
                Message::Ping(_) | Message::Pong(_) => {}
                other => panic!("{other:?}"),
            }
        }
    }

    /// Takes messages in until one of this kind.
    fn until(&mut self, kind: &str) -> Value {
        let started = Instant::now();
        loop {
            assert!(started.elapsed() < PATIENCE, "no {kind} came");
            let message = self.read();
            self.take(&message);
            if message["type"] == kind {
                return message;
            }
        }
    }

    fn until_it(&mut self, holds: impl Fn(&Self) -> bool) {
        let started = Instant::now();
        while !holds(self) {
            assert!(started.elapsed() < PATIENCE, "it did not come to that; told: {:?}", self.notes);
            let message = self.read();
            self.take(&message);
        }
    }

    /// As the page's model does.
    fn take(&mut self, message: &Value) {
        let list = |name: &str| message[name].as_array().cloned().unwrap_or_default();
        match message["type"].as_str().unwrap() {
            "scene" => {
                self.scenes += 1;
                let column = |name: &str| message["path"][name].as_array().cloned().unwrap();
                let points = column("x").into_iter().zip(column("y"));
                self.path = column("stamp_us")
                    .iter()
                    .zip(points)
                    .map(|(stamp, (x, y))| {
                        (stamp.as_u64().unwrap(), [x.as_f64().unwrap(), y.as_f64().unwrap()])
                    })
                    .collect();
                (self.lines, self.walls) = Default::default();
                list("lines").iter().for_each(|row| self.line(row));
                self.notes = list("notes").iter().map(text_of).collect();
            }
            "frame" => {
                for row in list("poses") {
                    let at = [row[1][0].as_f64().unwrap(), row[1][1].as_f64().unwrap()];
                    self.path.push((row[0].as_u64().unwrap(), at));
                }
                for id in list("removed") {
                    self.lines.remove(&id.as_u64().unwrap());
                    self.walls.remove(&id.as_u64().unwrap());
                }
                list("changed").iter().for_each(|row| self.line(row));
                self.notes.extend(list("notes").iter().map(text_of));
            }
            _ => {}
        }
        if let Some(playback) = message.get("playback").filter(|p| p.is_object()) {
            self.ended = playback["ended"].as_bool().unwrap();
            self.speed = playback["speed"].clone();
        }
    }

    fn line(&mut self, row: &Value) {
        let id = row[0].as_u64().unwrap();
        self.lines.insert(id, serde_json::from_value(row[1].clone()).unwrap());
        self.walls.insert(id, row[3].as_bool().unwrap());
    }

    fn send(&mut self, text: &str) {
        self.socket.send(Message::text(text)).unwrap();
    }

    /// Gives an order: whether it was done, and the words.
    fn order(&mut self, command: &Value) -> (bool, String) {
        self.next += 1;
        let id = self.next;
        self.send(&json!({"order": {"id": id, "command": command}}).to_string());
        let answer = self.until("answer");
        assert_eq!(answer["id"], json!(id));
        (answer["done"].as_bool().unwrap(), answer["words"].as_str().unwrap().to_owned())
    }

    fn view(&mut self, at_us: u64) -> Value {
        self.send(&json!({"view": {"id": 77, "at_us": at_us}}).to_string());
        let view = self.until("view");
        assert_eq!((&view["id"], &view["at_us"]), (&json!(77), &json!(at_us)));
        view
    }
}

fn text_of(note: &Value) -> String {
    note["text"].as_str().unwrap().to_owned()
}

/// A source that the test itself is.
fn own_source() -> (Served, Feed) {
    let about = About {
        title: "test".into(),
        subtitle: String::new(),
        kind: Kind::Robot,
        base_from_laser: [0.1, 0.0, 0.0],
        blueprint: Vec::new(),
        paced: false,
    };
    let (source, feed) = channel(about);
    (Served::new(source), feed)
}

fn pose_at(x: f32) -> What {
    What::Pose(Pose { at: [x, 0.0, 0.0], covariance: [1e-4; 6], state: TrackingState::Tracking })
}

#[test]
fn the_page_is_served_whole_and_may_use_nothing_from_elsewhere() {
    let (served, _feed) = own_source();
    let host = served.address.to_string();
    let (_, page) = http(served.address, "/", &host);
    let page = String::from_utf8(page).unwrap();
    let mut files = vec!["/".to_owned()];
    let mut next = 0;
    while let Some(path) = files.get(next).cloned() {
        next += 1;
        let (head, body) = http(served.address, &path, &host);
        assert!(head.starts_with("http/1.1 200"), "{path}: {head}");
        let policy = head.lines().find_map(|l| l.strip_prefix("content-security-policy: ")).unwrap();
        for rule in ["default-src 'none'", "script-src 'self'", "style-src 'self'", "frame-ancestors 'none'"]
        {
            assert!(policy.contains(rule), "{path}: {policy}");
        }
        assert!(!policy.contains("unsafe"), "{policy}");
        assert!(head.contains("x-content-type-options: nosniff"), "{path}");
        assert!(head.contains("cross-origin-resource-policy: same-origin"), "{path}");
        let text = String::from_utf8(body).unwrap();
        let foreign = text.replace("http://www.w3.org/2000/svg", "");
        assert!(!foreign.contains("http://") && !foreign.contains("https://"), "{path} refers to elsewhere");
        // What it refers to is served too.
        for quoted in text
            .split('"')
            .filter(|word| word.ends_with(".js") || word.ends_with(".css") || word.ends_with(".svg"))
        {
            let file = format!("/{}", quoted.trim_start_matches("./"));
            if !files.contains(&file) && !file.contains(['$', '`', ' ']) {
                files.push(file);
            }
        }
    }
    assert!(files.len() > 10, "{files:?}");
    assert!(page.contains("<canvas id=\"map\""));
    let (head, _) = http(served.address, "/secret", &host);
    assert!(head.starts_with("http/1.1 404") && head.contains("content-security-policy"), "{head}");
}

#[test]
fn another_sites_page_is_refused_whatever_it_calls_this_computer() {
    let (served, feed) = own_source();
    let (address, own) = (served.address, served.address.to_string());
    let refused = |host: &str, origin: Option<&str>| match Page::connect(address, host, origin) {
        Err(error) => match *error {
            tungstenite::Error::Http(response) => response.status().as_u16(),
            other => panic!("{other}"),
        },
        Ok(_) => 0,
    };
    assert_eq!(refused(&own, Some(&format!("http://{own}"))), 0, "the page itself");
    assert_eq!(refused(&own, Some("http://evil.example")), 403);
    assert_eq!(refused(&own, Some(&format!("http://localhost:{}", address.port()))), 403);
    assert_eq!(refused(&own, Some("null")), 403);
    assert_eq!(refused(&own, None), 403);
    // A name that was made to lead here: origin and host agree.
    let rebound = format!("evil.example:{}", address.port());
    assert_eq!(refused(&rebound, Some(&format!("http://{rebound}"))), 421);
    let (head, body) = http(address, "/", &rebound);
    assert!(head.starts_with("http/1.1 421"), "{head}");
    assert!(!String::from_utf8(body).unwrap().contains("canvas"));
    // Nothing has come to the source.
    assert!(feed.order(Some(Duration::ZERO)).unwrap().is_none());
}

#[test]
fn a_log_streams_to_its_end_and_the_page_has_what_replay_has() {
    let served = Served::new(simulated(None).start().unwrap());
    let mut page = Page::open(served.address);
    page.until_it(|page| page.ended);
    let (_, drive) = drive();
    let replay = replay::run(&drive.log, &robot(), Configuration::Default.config(), || ()).unwrap();
    assert_eq!(page.path.len(), replay.steps.len());
    for ((stamp_us, at), step) in page.path.iter().zip(&replay.steps) {
        let expected = components(&step.pose_in_final_map);
        assert_eq!(*stamp_us, step.stamp_us);
        assert!((at[0] - f64::from(expected.x)).hypot(at[1] - f64::from(expected.y)) < 1e-3, "{stamp_us}");
    }
    let mut walls: Vec<[i64; 4]> =
        page.lines.iter().filter(|(id, _)| page.walls[id]).map(|(_, ends)| ends.map(tenths)).collect();
    let mut expected: Vec<[i64; 4]> = replay
        .map
        .iter()
        .map(|s| {
            [s.segment().start.x, s.segment().start.y, s.segment().end.x, s.segment().end.y]
                .map(|v| tenths(f64::from(v)))
        })
        .collect();
    walls.sort_unstable();
    expected.sort_unstable();
    assert_eq!(walls, expected);

    // Who comes late sees the same, the true walls too.
    let mut late = Page::open(served.address);
    late.until("scene");
    assert_eq!((late.path, late.lines, late.walls), (page.path, page.lines, page.walls));
    assert!(late.ended);
}

/// Tenths of a millimetre.
fn tenths(m: f64) -> i64 {
    (m * 1e4).round() as i64
}

#[test]
fn any_instant_can_be_looked_at() {
    let served = Served::new(simulated(None).start().unwrap());
    let mut page = Page::open(served.address);
    page.until_it(|page| page.ended);
    let (first_us, last_us) = (page.path[0].0, page.path.last().unwrap().0);
    let middle_us = (first_us + last_us) / 2;
    let until = page.path.iter().filter(|(stamp, _)| *stamp <= middle_us).count();
    let view = page.view(middle_us);
    assert_eq!(view["path"]["x"].as_array().unwrap().len(), until);
    let stamp = view["pose"][0].as_u64().unwrap();
    assert!(stamp <= middle_us && stamp > middle_us - 200_000, "{stamp}");
    let lines = |view: &Value| view["lines"].as_array().unwrap().len();
    let begin = page.view(first_us);
    assert!(lines(&begin) < lines(&view), "the map grows: {} {}", lines(&begin), lines(&view));
    assert!(view["scan"]["points_mm"].as_array().unwrap().len() > 100);
    assert!(view["status"]["facts"].as_array().unwrap().iter().any(|fact| fact["name"] == "Driven"));

    let (head, body) = http(served.address, "/map.dxf", &served.address.to_string());
    assert!(head.contains("content-disposition: attachment"), "{head}");
    let drawing = dxf::Drawing::load(&mut std::io::Cursor::new(body)).unwrap();
    let walls = page.walls.values().filter(|wall| **wall).count();
    assert_eq!(drawing.entities().count(), walls + 1, "walls and the path");
}

#[test]
fn commands_are_carried_out_and_answered_with_words() {
    let served = Served::new(simulated(Some(20.0)).start().unwrap());
    let mut page = Page::open(served.address);
    page.until_it(|page| page.path.len() > 30 && page.lines.len() > 2);
    assert_eq!(page.order(&json!({"pace": {"speed": 0}})), (true, "Paused.".into()));
    assert!(page.order(&json!("freeze")).0);
    let (done, words) = page.order(&json!("freeze"));
    assert!(!done && words.contains("frozen already"), "{words}");
    assert!(page.order(&json!("unfreeze")).0);
    let (done, words) = page.order(&json!({"set_pose": {"pose": [1e9, 0, 0]}}));
    assert!(!done && words.contains("no pose"), "{words}");
    let (done, words) = page.order(&json!("ask_map"));
    assert!(done && words.contains("lines were sent"), "{words}");
    let paused_at = page.path.len();

    // A pose that is set is where the next scan begins.
    let (x, y) = (page.path[paused_at - 1].1[0] + 0.05, page.path[paused_at - 1].1[1]);
    let heading = page.view(u64::MAX)["pose"][1][2].clone();
    assert!(page.order(&json!({"set_pose": {"pose": [x, y, heading]}})).0);
    assert!(page.order(&json!("find_yourself")).0);
    page.until_it(|page| page.notes.iter().any(|note| note.starts_with("Find yourself: ")));

    // The map is forgotten: nothing stands, and a new one begins.
    assert!(page.order(&json!("forget")).0);
    page.until_it(|page| page.lines.is_empty());
    assert!(page.path.is_empty());
    assert!(page.order(&json!({"pace": {"speed": null}})).0);
    page.until_it(|page| page.ended && !page.lines.is_empty());

    // At the end what needs scans is refused, and says why.
    for command in ["freeze", "find_yourself"] {
        let (done, words) = page.order(&json!(command));
        assert!(!done && words.contains("has ended"), "{words}");
    }
    // It begins anew, history and all.
    let first_us = drive().1.log.scans[0].stamp_us;
    assert_ne!(page.path[0].0, first_us, "the path began where the map was forgotten");
    assert!(page.order(&json!("restart")).0);
    page.until_it(|page| !page.ended && !page.path.is_empty());
    page.until_it(|page| page.ended);
    assert_eq!(page.path[0].0, first_us);
}

#[test]
fn what_is_no_request_is_answered_and_harms_nothing() {
    let (served, feed) = own_source();
    let mut page = Page::open(served.address);
    for nonsense in ["", "{", "[]", r#"{"order":{"id":1,"command":"explode"}}"#, "\u{0}"] {
        page.send(nonsense);
        let answer = page.until("answer");
        assert_eq!(answer["done"], json!(false), "{nonsense}");
    }
    feed.send(5, pose_at(1.0)).unwrap();
    page.until_it(|page| page.path.len() == 1);
    // One that is too long ends the connection, and no other.
    let mut other = Page::open(served.address);
    page.send(&"x".repeat(100_000));
    let ended = (0..100).any(|_| page.socket.read().is_err());
    assert!(ended);
    feed.send(6, pose_at(2.0)).unwrap();
    other.until_it(|page| page.path.len() == 2);
}

#[test]
fn every_source_speaks_through_the_same_door_and_ends_with_the_server() {
    let (served, feed) = own_source();
    let mut page = Page::open(served.address);
    let line = |id: u32, wall| Line { id, ends: [0.0, 0.0, id as f32, 1.0], hits: 9, wall };
    feed.send(
        1,
        What::Lines { changed: vec![line(1, true), line(2, true), line(3, false)], removed: vec![] },
    )
    .unwrap();
    feed.send(2, What::Lines { changed: vec![line(1, false)], removed: vec![2] }).unwrap();
    feed.send(2, pose_at(0.0)).unwrap();
    page.until_it(|page| page.path.len() == 1);
    assert_eq!(page.walls, BTreeMap::from([(1, false), (3, false)]));

    // Orders come to the source in its own words, and each is answered once.
    let answering = std::thread::spawn(move || {
        let order = feed.order(None).unwrap().unwrap();
        let command = order.command;
        order.answer(Err("The robot is being carried.".into()));
        (feed, command)
    });
    let (done, words) = page.order(&json!({"set_pose": {"pose": [1.0, -2.0, 0.5]}}));
    assert_eq!((done, words.as_str()), (false, "The robot is being carried."));
    let (feed, command) = answering.join().unwrap();
    assert_eq!(command, lineslam::live::source::Command::SetPose { pose: [1.0, -2.0, 0.5] });
    page.until_it(|page| page.notes.iter().any(|note| note.contains("carried")));

    // A source that has gone is said; a server that has gone ends the source.
    drop(served);
    assert!(feed.send(3, pose_at(1.0)).is_err());
    let (served, feed) = own_source();
    let mut page = Page::open(served.address);
    drop(feed);
    page.until_it(|page| page.notes.iter().any(|note| note.contains("source has ended")));
    let (done, words) = page.order(&json!("restart"));
    assert!(!done && words.contains("ended"), "{words}");
}

/// The command, and how it ended.
fn live(arguments: &[&str]) -> (Option<i32>, String) {
    let output = Command::new(env!("CARGO_BIN_EXE_lineslam"))
        .arg("live")
        .args(arguments)
        .arg("--no-open")
        .output()
        .unwrap();
    (output.status.code(), String::from_utf8_lossy(&output.stderr).into_owned())
}

#[test]
fn a_bad_log_is_an_error_with_file_and_line_as_for_replay() {
    let folder = tempfile::tempdir().unwrap();
    let log = folder.path().join("bad.log");
    let (good, bad) =
        ("FLASER 3 1.0 1.0 1.0 0 0 0 0 0 0 1.0 host 1.0", "FLASER 3 1.0 what 1.0 0 0 0 0 0 0 2.0 host 2.0");
    std::fs::write(&log, format!("{good}\n{bad}\n")).unwrap();
    let (code, said) = live(&[log.to_str().unwrap(), "--listen", "127.0.0.1:0"]);
    assert_eq!(code, Some(2), "{said}");
    assert!(said.contains("bad.log: line 2") && said.contains("'what'"), "{said}");
    let replayed = Command::new(env!("CARGO_BIN_EXE_lineslam")).arg("replay").arg(&log).output().unwrap();
    assert_eq!(String::from_utf8_lossy(&replayed.stderr), said, "in the same words");

    let (code, said) = live(&["missing.log", "--listen", "127.0.0.1:0"]);
    assert_eq!(code, Some(2), "{said}");
    let (code, said) = live(&["--listen", "127.0.0.1:0"]);
    assert_eq!(code, Some(2), "{said}");
    assert!(said.contains("LOG") && said.contains("--simulate"), "{said}");
}

#[test]
fn a_port_in_use_is_a_clear_error() {
    let taken = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = taken.local_addr().unwrap().to_string();
    let (code, said) = live(&["whatever.log", "--listen", &address]);
    assert_eq!(code, Some(1), "{said}");
    assert!(said.contains(&format!("{address} is in use")) && said.contains("--listen"), "{said}");
}

#[cfg(unix)]
#[test]
fn the_address_is_printed_whoever_can_see_it_is_said_and_ctrl_c_ends_it() {
    let world = concat!(env!("CARGO_MANIFEST_DIR"), "/../worlds/hall_quarter.toml");
    for (listen, is_open) in [("127.0.0.1:0", false), ("0.0.0.0:0", true)] {
        let mut child = Command::new(env!("CARGO_BIN_EXE_lineslam"))
            .args(["live", "--simulate", world, "--no-open", "--speed", "max", "--listen", listen])
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        let mut line = String::new();
        BufReader::new(child.stdout.take().unwrap()).read_line(&mut line).unwrap();
        let address: SocketAddr =
            line.trim().strip_prefix("http://").and_then(|l| l.strip_suffix('/')).unwrap().parse().unwrap();
        let mut page = Page::open(address);
        page.until_it(|page| page.ended);
        drop(page);
        assert!(Command::new("kill").args(["-INT", &child.id().to_string()]).status().unwrap().success());
        let output = child.wait_with_output().unwrap();
        let said = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(0), "{said}");
        assert_eq!(said.contains("there is no password"), is_open, "{said}");
    }
}

#[test]
fn a_robot_is_shown_and_told_what_to_do() {
    let (address, robot) = socket_robot::robot(0);
    let source = lineslam::live::robot_source::start(address.parse().unwrap()).unwrap();
    assert_eq!((source.about.kind, source.about.paced), (Kind::Robot, false));
    assert!(source.about.subtitle.contains("robot 'paper', lineslam 0.1.0"), "{}", source.about.subtitle);
    let served = Served::new(source);
    let mut page = Page::open(served.address);
    // A message of its lines was lost at first.
    page.until_it(|page| page.lines.len() == 40 && page.path.len() > 20);
    assert_eq!(page.lines[&8], [8.0, 0.0, 8.0, 2.5]);
    assert_eq!(page.walls.values().filter(|wall| **wall).count(), 20);
    assert!(page.path.iter().all(|(_, at)| *at == [0.5, -0.25]));
    assert!(page.path.windows(2).all(|two| two[0].0 < two[1].0));
    assert!(page.order(&json!("freeze")).0);
    let (done, words) = page.order(&json!({"set_pose": {"pose": [1e9, 0, 0]}}));
    assert!(!done && words.contains("a number makes no sense"), "{words}");
    assert!(!page.order(&json!({"pace": {"speed": 2}})).0, "a robot is not paced");
    drop(page);
    drop(served);
    let requests = robot.join().unwrap();
    let freezes = requests.iter().filter(|r| r.command == link::Command::SetMapping(false)).count();
    assert_eq!(freezes, 1);
}

#[test]
fn where_no_robot_answers_that_is_said() {
    let (address, deaf) = socket_robot::robot(usize::MAX);
    let output = Command::new(env!("CARGO_BIN_EXE_lineslam"))
        .args(["live", "--no-open", "--listen", "127.0.0.1:0", "--port", &address])
        .output()
        .unwrap();
    assert_eq!(output.status.code(), Some(1));
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(said.contains("no answer from the robot within 4 s"), "{said}");
    deaf.join().unwrap();
}
