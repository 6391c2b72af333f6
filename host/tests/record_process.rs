//! `lineslam record` as anyone runs it, beside a robot that is a socket: killed, interrupted, through a pulled cable and a reset.
#![cfg(unix)]

mod recorded;

use std::io::{ErrorKind, Read, Write};
use std::net::{TcpListener, TcpStream};
use std::path::{Path, PathBuf};
use std::process::{Child, Command as Process, Output, Stdio};
use std::time::{Duration, Instant};

use link::from_robot::{Answer, Cause, Outcome};
use link::{Command, FRAME, FromRobot, Receiver, Request, Sender, Streams};
use recorded::{Driven, robot_file};

/// Messages between two looks for requests, some milliseconds apart.
const MESSAGES: usize = 4;

/// Says what was said on a drive, much faster than it was driven, to whoever connects; goes on where it was when that one has gone.
struct Robot {
    said: Vec<FromRobot>,
    next: usize,
    /// Before these messages the cable is pulled, and so many are said to nobody.
    pulls: Vec<(usize, usize)>,
    streams: Streams,
    sender: Sender,
}

impl Robot {
    /// Its address. It lives as long as the test.
    fn start(said: Vec<FromRobot>, pulls: &[(usize, usize)]) -> String {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let address = format!("tcp://{}", listener.local_addr().unwrap());
        let (streams, sender) = (Streams::DEFAULT, Sender::default());
        let mut robot = Self { said, next: 1, pulls: pulls.to_vec(), streams, sender };
        std::thread::spawn(move || {
            for stream in listener.incoming() {
                robot.speak(stream.unwrap());
            }
        });
        address
    }

    fn say(&mut self, stream: &mut TcpStream, message: &FromRobot) {
        let mut frame = [0; FRAME];
        let len = self.sender.frame(message, &mut frame).unwrap();
        // Whoever has enough hangs up.
        let _ = stream.write_all(&frame[..len]);
    }

    fn speak(&mut self, mut stream: TcpStream) {
        stream.set_read_timeout(Some(Duration::from_millis(1))).unwrap();
        let mut receiver = Receiver::<FRAME>::default();
        let mut bytes = [0; 256];
        loop {
            match stream.read(&mut bytes) {
                Ok(0) => return,
                Ok(count) => {
                    for byte in &bytes[..count] {
                        let request = receiver.push(*byte).and_then(|body| Request::decode(body).ok());
                        request.into_iter().for_each(|request| self.obey(&mut stream, request));
                    }
                }
                Err(error) if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut) => {}
                Err(_) => return,
            }
            if !self.streams.has(Streams::SCANS) {
                continue;
            }
            if let Some((_, lost)) = self.pulls.pop_if(|(at, _)| *at <= self.next) {
                self.next += lost;
                return;
            }
            for _ in 0..MESSAGES {
                let Some(message) = self.said.get(self.next).cloned() else { break };
                self.next += 1;
                self.say(&mut stream, &message);
            }
        }
    }

    fn obey(&mut self, stream: &mut TcpStream, Request { id, command }: Request) {
        self.say(stream, &FromRobot::Answer(Answer { id, outcome: Outcome::Done }));
        match command {
            Command::Subscribe(streams) => self.streams = streams,
            Command::Hello => {
                let hello = self.hello();
                self.say(stream, &hello);
            }
            Command::Forget => {
                let is_new = |message: &FromRobot| matches!(message, FromRobot::Pose(pose) if pose.cause == Cause::Forgotten);
                self.next = self.said.iter().position(is_new).unwrap();
            }
            _ => {}
        }
    }

    /// As it is now.
    fn hello(&self) -> FromRobot {
        let before = &self.said[..self.next];
        let began = before.iter().rposition(|message| matches!(message, FromRobot::Hello(_))).unwrap();
        let FromRobot::Hello(mut hello) = before[began].clone() else { unreachable!() };
        let stamps = before[began..].iter().map(|message| match message {
            FromRobot::Pose(pose) => pose.at_us,
            FromRobot::Ticks(ticks) => ticks.samples().last().unwrap().0,
            _ => 0,
        });
        hello.uptime_us = stamps.max().unwrap().max(hello.uptime_us) + 1;
        hello.streams = self.streams;
        FromRobot::Hello(hello)
    }
}

fn recording(address: &str, out: &Path, arguments: &[&str]) -> Child {
    let mut process = Process::new(env!("CARGO_BIN_EXE_lineslam"));
    process.arg("record").arg(out).args(["--port", address]).args(arguments);
    process.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap()
}

fn ended(child: Child) -> (Output, String) {
    let output = child.wait_with_output().unwrap();
    let text = [&output.stdout[..], &output.stderr[..]].concat();
    (output, String::from_utf8_lossy(&text).into_owned())
}

fn until_it_has(path: &Path, bytes: u64) {
    let begun = Instant::now();
    while std::fs::metadata(path).map_or(0, |file| file.len()) < bytes {
        assert!(begun.elapsed() < Duration::from_secs(60), "{} does not grow", path.display());
        std::thread::sleep(Duration::from_millis(10));
    }
}

/// What `lineslam replay` says of a file in its report.
fn report(file: &Path, out: &Path) -> serde_json::Value {
    let mut process = Process::new(env!("CARGO_BIN_EXE_lineslam"));
    process.arg("replay").arg(file).arg("--robot").arg(robot_file()).arg("--out").arg(out);
    let output = process.output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&std::fs::read(out.join("report.json")).unwrap()).unwrap()
}

fn suspected(report: &serde_json::Value) -> Vec<&str> {
    report["warnings"].as_array().unwrap().iter().map(|w| w["suspected"].as_str().unwrap()).collect()
}

fn folder() -> (tempfile::TempDir, PathBuf) {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("drive.mcap");
    (folder, out)
}

fn drive(scans: usize) -> Driven {
    let mut driven = Driven::new();
    driven.scans(0..scans);
    driven
}

#[test]
fn a_recording_that_is_killed_is_replayed_bit_for_bit_as_far_as_it_goes() {
    let (folder, out) = folder();
    let address = Robot::start(drive(300).said, &[]);
    for (k, bytes) in [60_000, 140_000].into_iter().enumerate() {
        let out = out.with_file_name(format!("drive{k}.mcap"));
        let mut child = recording(&address, &out, &["--plain"]);
        until_it_has(&out, bytes);
        child.kill().unwrap();
        child.wait().unwrap();
        let report = report(&out, &folder.path().join("replayed"));
        println!("{} bytes: {} scans, {}", bytes, report["scans_used"], report["as_the_robot"]);
        assert!(suspected(&report).contains(&"damaged"), "{:?}", suspected(&report));
        assert!(report["scans_used"].as_u64().unwrap() > 20);
        assert_eq!(report["as_the_robot"]["different"], 0);
        // The second time the robot is in the middle of its drive.
        assert_eq!(report["as_the_robot"]["same"].as_u64().unwrap() > 20, k == 0);
        let text = std::fs::read_to_string(out.with_extension("jsonl")).unwrap();
        assert!(text.ends_with("}\n") && text.lines().count() > 20);
        let plain = self::report(&out.with_extension("jsonl"), &folder.path().join("plain"));
        assert!(plain["scans_used"].as_u64().unwrap() > 20);
    }
}

#[test]
fn ctrl_c_ends_the_file_and_says_what_is_in_it() {
    let (folder, out) = folder();
    let address = Robot::start(drive(200).said, &[]);
    for signal in ["-INT", "-TERM"] {
        let child = recording(&address, &out, &["--force"]);
        std::thread::sleep(Duration::from_millis(1500));
        let sent = Process::new("kill").args([signal, &child.id().to_string()]).status().unwrap();
        assert!(sent.success());
        let (output, text) = ended(child);
        assert!(output.status.success(), "{text}");
        assert!(text.contains("samples of the wheels") && text.contains("nothing missing"), "{text}");
        let report = report(&out, &folder.path().join("replayed"));
        assert!(!suspected(&report).contains(&"damaged"), "{:?}", suspected(&report));
    }
}

#[test]
fn a_pulled_cable_and_a_reset_stay_in_one_file() {
    let (folder, out) = folder();
    let mut driven = drive(40);
    let reset = driven.said.len();
    driven.reset();
    driven.scans(46..80);
    // The cable goes in the second run, for some scans.
    let (pull, all) = (driven.said.len(), 40 + 34 + 40);
    driven.scans(80..120);
    assert!(reset < pull);
    let address = Robot::start(driven.said, &[(pull, 50)]);
    let (output, text) = ended(recording(&address, &out, &["--seconds", "6"]));
    assert!(output.status.success(), "{text}");
    assert!(text.contains("waiting for it to come back") && text.contains("connected again"), "{text}");
    assert!(text.contains("1 reset") && text.contains("missing: replay will not be bit for bit"), "{text}");
    let report = report(&out, &folder.path().join("replayed"));
    println!("{text}{} {:?}", report["as_the_robot"], report["warnings"]);
    assert_eq!(suspected(&report), ["missing_from_recording"]);
    // Up to the pulled cable, the reset included.
    assert_eq!(report["as_the_robot"]["different"], 0);
    assert_eq!(report["as_the_robot"]["same"], 40 + 1 + 34);
    let scans = report["scans_used"].as_u64().unwrap();
    assert!((all - 9..all - 2).contains(&scans), "{scans}");
}

#[test]
fn with_forget_a_drive_that_has_begun_is_known_from_there() {
    let (folder, out) = folder();
    let mut driven = drive(30);
    driven.told(Cause::Forgotten);
    driven.scans(30..60);
    let address = Robot::start(driven.said, &[]);
    let (output, text) = ended(recording(&address, &out, &["--forget", "--seconds", "3"]));
    assert!(output.status.success() && text.contains("nothing missing\n"), "{text}");
    let report = report(&out, &folder.path().join("replayed"));
    assert_eq!(suspected(&report), Vec::<&str>::new());
    assert_eq!(
        (&report["as_the_robot"]["same"], &report["as_the_robot"]["unknown"]),
        (&31.into(), &0.into())
    );
}

#[test]
fn without_a_robot_or_over_a_file_nothing_is_written() {
    let (_folder, out) = folder();
    for (port, says) in [("tcp://127.0.0.1:1", "tcp://127.0.0.1:1: "), ("/dev/nothing", "/dev/nothing: ")] {
        let (output, text) = ended(recording(port, &out, &[]));
        assert_eq!(output.status.code(), Some(1));
        assert!(text.contains(says) && !out.exists(), "{text}");
    }
    std::fs::write(&out, "mine").unwrap();
    let address = Robot::start(drive(1).said, &[]);
    let (output, text) = ended(recording(&address, &out, &[]));
    assert_eq!(output.status.code(), Some(1));
    assert!(text.contains("drive.mcap is there already"), "{text}");
    assert_eq!(std::fs::read(&out).unwrap(), b"mine");
}
