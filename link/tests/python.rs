//! `client.py`, run as anyone would run it, beside the other end of a socket.

mod messages;

use std::io::{Read, Write};
use std::net::TcpListener;
use std::process::{Command, Stdio};

use link::from_robot::Ranges;
use link::ranges::Packed;
use link::to_robot::{Request, Streams};
use link::{FRAME, FromRobot, Receiver, Sender};
use messages::{bodies, framed, largest};

#[test]
fn the_python_client_understands_the_robot_and_is_understood() {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = format!("tcp://{}", listener.local_addr().unwrap());
    let client = concat!(env!("CARGO_MANIFEST_DIR"), "/client.py");
    let started = Command::new("python3").args(["-u", client, &address]).stdout(Stdio::piped()).spawn();
    let Ok(child) = started else {
        println!("SKIPPED the Python client: there is no python3");
        return;
    };
    let (mut stream, _) = listener.accept().unwrap();
    let mut receiver = Receiver::<FRAME>::default();
    let mut request = Vec::new();
    while request.is_empty() {
        let mut byte = [0];
        stream.read_exact(&mut byte).unwrap();
        request = bodies(&mut receiver, &byte);
    }
    let wanted = Streams::POSES.with(Streams::TICKS).with(Streams::SCANS);
    let request = Request::decode(&request[0]).unwrap();
    assert_eq!(request.command, link::Command::Subscribe(wanted));

    let mut sender = Sender::default();
    let ranges_mm: Vec<u16> = (0..98).map(|k| 5 + k * 57).collect();
    let ranges = Packed::of(&ranges_mm);
    let ranges = Ranges { number: 4, at_us: 9, revolution_us: 100_000, beams: 682, first: 196, ranges };
    let FromRobot::Pose(pose) = &largest()[1] else { unreachable!() };
    let pose = link::from_robot::Pose { number: 4, at_us: 77_000_123, pose: [1.25, -2.5, 0.125], ..*pose };
    for message in largest().into_iter().chain([FromRobot::Pose(pose), FromRobot::Ranges(ranges)]) {
        stream.write_all(b"noise\0").unwrap();
        stream.write_all(&framed(&mut sender, &message)).unwrap();
    }
    let mut damaged = framed(&mut sender, &FromRobot::Pose(pose));
    damaged[9] ^= 1;
    stream.write_all(&damaged).unwrap();
    drop(stream);
    let output = child.wait_with_output().unwrap();
    assert!(output.status.success());
    let text = String::from_utf8(output.stdout).unwrap();
    let lines: Vec<&str> = text.lines().collect();
    let words: Vec<String> = ranges_mm.iter().map(u16::to_string).collect();
    assert_eq!(lines.len(), 5, "{text}");
    assert_eq!(lines[1], format!("ticks {} {} {min} {min} and 14 more", u32::MAX, u64::MAX, min = i32::MIN));
    assert_eq!(lines[3], "pose 4 77000123 1.250000 -2.500000 0.125000");
    assert_eq!(lines[4], format!("ranges 4 196 {}", words.join(" ")));
}
