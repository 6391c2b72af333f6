//! A robot that is a socket.

#![allow(dead_code)]

use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use link::from_robot::*;
use link::map::{BLOCK, Line, block_check, places_check};
use link::{Command, FRAME, FromRobot, Receiver, Request, Sender, Streams};

/// A robot with a map of 40 lines, which it says as the firmware does.
struct Robot {
    stream: TcpStream,
    receiver: Receiver<FRAME>,
    sender: Sender,
    /// Requests as they came.
    requests: Vec<Request>,
    lines: Vec<Line>,
    /// So many requests go unanswered.
    deaf: usize,
    /// Of a message of lines the first time.
    loses_lines: bool,
    streams: Streams,
}

impl Robot {
    fn say(&mut self, message: &FromRobot) {
        let mut frame = [0; FRAME];
        let len = self.sender.frame(message, &mut frame).unwrap();
        // Whoever has what it wants hangs up.
        let _ = self.stream.write_all(&frame[..len]);
    }

    fn say_map(&mut self, blocks: u32) {
        let slots: Vec<(u16, Line)> = (0..).zip(self.lines.iter().copied()).collect();
        for (block, lines) in slots.chunks(BLOCK).enumerate().filter(|(block, _)| blocks >> block & 1 != 0) {
            for some in lines.chunks(8) {
                if !(some[0].0 == 8 && std::mem::take(&mut self.loses_lines)) {
                    self.say(&FromRobot::Lines(Lines(some.iter().copied().collect())));
                }
            }
            let check = block_check(lines.iter().map(|(_, line)| line));
            self.say(&FromRobot::Block(Block { block: block as u8, lines: slots.len() as u16, check }));
        }
        let check = places_check([]);
        self.say(&FromRobot::PlacesEnd(PlacesEnd { places: 0, check, ..PlacesEnd::default() }));
    }

    fn obey(&mut self, request: Request) {
        self.requests.push(request);
        if self.deaf > 0 {
            self.deaf -= 1;
            return;
        }
        let is_bad = matches!(request.command, Command::SetPose([x, ..]) if !x.is_finite() || x > 1e5);
        let outcome = if is_bad { Outcome::OutOfRange } else { Outcome::Done };
        self.say(&FromRobot::Answer(Answer { id: request.id, outcome }));
        match request.command {
            Command::Subscribe(streams) => self.streams = streams,
            Command::SendMap { blocks, .. } if self.streams.has(Streams::MAP) => self.say_map(blocks),
            Command::Hello => self.say(&FromRobot::Hello(hello())),
            _ => {}
        }
    }

    /// Lives until the other side hangs up.
    fn live(mut self) -> Vec<Request> {
        let begun = Instant::now();
        let mut number = 0;
        loop {
            let mut bytes = [0; 64];
            match self.stream.read(&mut bytes) {
                Ok(0) => return self.requests,
                Ok(count) => {
                    let bodies: Vec<_> = bytes[..count]
                        .iter()
                        .filter_map(|byte| {
                            self.receiver.push(*byte).and_then(|body| Request::decode(body).ok())
                        })
                        .collect();
                    bodies.into_iter().for_each(|request| self.obey(request));
                }
                Err(error)
                    if matches!(
                        error.kind(),
                        std::io::ErrorKind::WouldBlock | std::io::ErrorKind::TimedOut
                    ) => {}
                Err(_) => return self.requests,
            }
            if self.streams.has(Streams::POSES) {
                number += 1;
                self.say(&FromRobot::Pose(pose(number)));
            }
            if self.streams.has(Streams::STATUS) && number % 10 == 0 {
                self.say(&FromRobot::Status(Status {
                    scans: number,
                    mapping: true,
                    sensor: true,
                    ..Status::default()
                }));
                self.say(&FromRobot::Health(Health {
                    uptime_us: 1_000_000,
                    scan_us: 4200,
                    ..Health::default()
                }));
            }
            assert!(begun.elapsed() < Duration::from_secs(60), "nobody hangs up");
        }
    }
}

fn pose(number: u32) -> Pose {
    Pose {
        number,
        at_us: 1_000_000 + u64::from(number) * 100_000,
        samples: 0,
        pose: [0.5, -0.25, 0.0],
        covariance: [1e-4, 0.0, 0.0, 1e-4, 0.0, 1e-4],
        state: State::Tracking,
        lines: 40,
        took_us: 4000,
        cause: Cause::Scan,
    }
}

fn hello() -> Hello {
    Hello {
        uptime_us: 1_000_000,
        firmware: "0.1.0".try_into().unwrap(),
        board: "a socket".try_into().unwrap(),
        robot: "paper".try_into().unwrap(),
        lines: 512,
        places: 96,
        reset: ResetCause::Pin,
        kept: KeptMap::Whole,
        scanner: Scanner { beams: 682, ..Scanner::default() },
        wheels: Wheels::default(),
        streams: Streams::DEFAULT,
    }
}

/// Its address, and the requests that it got once whoever called hangs up. So many of them it does not hear.
pub fn robot(deaf: usize) -> (String, JoinHandle<Vec<Request>>) {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = format!("tcp://{}", listener.local_addr().unwrap());
    let robot = std::thread::spawn(move || {
        let (stream, _) = listener.accept().unwrap();
        stream.set_read_timeout(Some(Duration::from_millis(20))).unwrap();
        let line = |k: u8| Line {
            start_m: [k.into(), 0.0],
            end_m: [k.into(), 2.5],
            sigma_m: 0.01,
            hits: 9,
            is_wall: k.is_multiple_of(2),
        };
        Robot {
            stream,
            receiver: Receiver::default(),
            sender: Sender::default(),
            requests: Vec::new(),
            lines: (0..40).map(line).collect(),
            deaf,
            loses_lines: true,
            streams: Streams::DEFAULT,
        }
        .live()
    });
    (address, robot)
}
