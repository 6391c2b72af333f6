//! How old a pose is when it is seen: from the last byte of its scan on the sensor's line to the WebSocket of the page.

mod common;
#[path = "../../host/tests/live_bench/mod.rs"]
mod live_bench;

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use common::{hall_with, nothing_lost};
use emulator::vcp::{FarEnd, Hold, Script, Socket, timed_messages};
use lineslam::link::Address;
use lineslam::live::robot_source::{self, Emulated};
use link::from_robot::{Cause, Pose};
use link::{Command, FRAME, FromRobot, Receiver, Request, Streams};
use live_bench::Served;
use serde_json::Value;
use tungstenite::Message;
use tungstenite::client::IntoClientRequest;

/// What the page subscribes to.
const STREAMS: Streams = Streams::DEFAULT.with(Streams::SCANS).with(Streams::MAP);
/// What is asked of the median, microseconds.
const ASKED_US: u64 = 30_000;

fn scan_pose(message: FromRobot) -> Option<Pose> {
    match message {
        FromRobot::Pose(pose) if pose.cause == Cause::Scan => Some(pose),
        _ => None,
    }
}

/// Median, 99 of 100, and most.
fn quantiles(mut all: Vec<u64>) -> [u64; 3] {
    all.sort_unstable();
    [all.len() / 2, all.len() * 99 / 100, all.len() - 1].map(|k| all[k])
}

#[test]
fn a_pose_leaves_the_board_within_30_ms_of_its_scans_last_byte() {
    let request = Request { id: 1, command: Command::Subscribe(STREAMS) };
    let (outcome, _) = hall_with(Script::new([(500_000, request)]), Some(30), &[]);
    assert!(nothing_lost(&outcome));
    let mut replies = outcome.replies_us.iter().copied().peekable();
    let mut reply_us = None;
    let mut ages_us = Vec::new();
    for (said_us, message) in timed_messages(&outcome.vcp, &outcome.frames) {
        if scan_pose(message).is_none() {
            continue;
        }
        while let Some(us) = replies.next_if(|us| *us <= said_us) {
            reply_us = Some(us);
        }
        ages_us.extend(reply_us.map(|us| said_us - us));
    }
    let scans = ages_us.len();
    // A pose that came before its scan's end, or twice for a scan, would be of another scan.
    assert!(
        scans > 250 && outcome.replies_us.len().abs_diff(scans) <= 2,
        "{scans} of {}",
        outcome.replies_us.len()
    );
    let [median, p99, most] = quantiles(ages_us);
    println!(
        "from the last byte of a scan to the last byte of its pose on the virtual COM port, {scans} scans, emulated clock: median {:.1} ms, \
         p99 {:.1} ms, most {:.1} ms",
        median as f64 * 1e-3,
        p99 as f64 * 1e-3,
        most as f64 * 1e-3
    );
    assert!(median <= ASKED_US, "{median} µs");
}

/// When each pose was put on the socket, by its stamp.
type Sent = Arc<Mutex<BTreeMap<u64, Instant>>>;

/// A socket that notes when poses go over it.
struct Noting {
    socket: Socket,
    receiver: Receiver<FRAME>,
    sent: Sent,
}

impl FarEnd for Noting {
    fn exchange(&mut self, now_us: u64, from_board: &[u8], to_board: &mut Vec<u8>) -> anyhow::Result<()> {
        for byte in from_board {
            let message = self.receiver.push(*byte).and_then(FromRobot::decode);
            if let Some(pose) = message.and_then(scan_pose) {
                self.sent.lock().unwrap().insert(pose.at_us, Instant::now());
            }
        }
        self.socket.exchange(now_us, from_board, to_board)
    }

    fn lets_end(&self) -> bool {
        self.socket.lets_end()
    }
}

/// From the socket to a WebSocket of the page's server. The board runs as fast as a real one, for as long as the hold is there.
#[test]
fn a_pose_that_has_left_the_board_is_at_once_on_the_web_socket() {
    let socket = Socket::listen(0, Some(1.0)).unwrap();
    let (hold, address): (Hold, _) = (socket.hold(), socket.address().unwrap());
    let sent = Sent::default();
    let far_end = Noting { socket, receiver: Receiver::default(), sent: sent.clone() };
    let board = std::thread::spawn(move || hall_with(far_end, Some(1), &[]));

    let emulated = Emulated { title: "emulated".into(), blueprint: Vec::new() };
    let source = robot_source::start_emulated(Address::Tcp(address.to_string()), emulated).unwrap();
    let served = Served::new(source);
    let mut request = format!("ws://{}/ws", served.address).into_client_request().unwrap();
    request.headers_mut().insert("origin", format!("http://{}", served.address).parse().unwrap());
    let stream = std::net::TcpStream::connect(served.address).unwrap();
    let (mut page, _) = tungstenite::client(request, stream).unwrap();
    let mut ages_us = Vec::new();
    let begun = Instant::now();
    while ages_us.len() < 100 {
        assert!(begun.elapsed() < Duration::from_secs(60), "{} poses", ages_us.len());
        let Message::Text(text) = page.read().unwrap() else { continue };
        let now = Instant::now();
        let message: Value = serde_json::from_str(&text).unwrap();
        if message["type"] != "frame" {
            continue;
        }
        let sent = sent.lock().unwrap();
        for row in message["poses"].as_array().into_iter().flatten() {
            // Poses without a scan are not noted.
            let at = row[0].as_u64().and_then(|stamp_us| sent.get(&stamp_us));
            ages_us.extend(at.map(|at| (now - *at).as_micros() as u64));
        }
    }
    drop((hold, page, served));
    drop(board.join().unwrap());
    let [median, p99, most] = quantiles(ages_us);
    println!(
        "from the socket to the WebSocket, 100 poses, clock on the wall: median {:.1} ms, p99 {:.1} ms, most {:.1} ms",
        median as f64 * 1e-3,
        p99 as f64 * 1e-3,
        most as f64 * 1e-3
    );
    assert!(median <= ASKED_US, "{median} µs");
}
