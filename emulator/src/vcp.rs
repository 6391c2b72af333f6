//! The other end of the virtual COM port: nobody, a script, or whoever connects to a socket.

use std::io::{ErrorKind, Read, Write};
use std::net::{Ipv4Addr, SocketAddr, TcpListener, TcpStream};
use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::Context;
use link::from_robot::{Cause, Pose};
use link::{FRAME, FromRobot, Receiver, Request, Sender};
use nalgebra::Isometry2;
use rand_core::{Rng, SeedableRng};
use rand_pcg::Pcg32;
use slam_core::geometry::pose::pose;

use crate::room::Line;

/// Who is at the other end.
pub trait FarEnd: Send {
    /// Once a millisecond: what the board has sent since the last time, and what is sent to it.
    fn exchange(&mut self, now_us: u64, from_board: &[u8], to_board: &mut Vec<u8>) -> anyhow::Result<()>;

    /// Whether the run may end, once the drive is over.
    fn lets_end(&self) -> bool {
        true
    }
}

impl FarEnd for Box<dyn FarEnd> {
    fn exchange(&mut self, now_us: u64, from_board: &[u8], to_board: &mut Vec<u8>) -> anyhow::Result<()> {
        self.as_mut().exchange(now_us, from_board, to_board)
    }

    fn lets_end(&self) -> bool {
        self.as_ref().lets_end()
    }
}

impl Line {
    /// Lets the other end have what has come, and takes what it sends.
    pub fn exchange(&mut self, far_end: &mut dyn FarEnd, now_us: u64) -> anyhow::Result<()> {
        let mut to_board = Vec::new();
        far_end.exchange(now_us, self.from_board.get(self.told..).unwrap_or(&[]), &mut to_board)?;
        self.told = self.from_board.len();
        self.to_board.extend(to_board);
        Ok(())
    }

    /// A byte from the microcontroller.
    pub fn take(&mut self, byte: u8, now_us: u64) {
        let ends = byte == 0 && self.from_board.last().is_some_and(|before| *before != 0);
        self.from_board.push(byte);
        if ends {
            self.frames.push((self.from_board.len(), now_us));
        }
    }

    /// Lets go what the other end has been told.
    pub fn forget(&mut self) {
        self.from_board.drain(..self.told);
        self.frames.clear();
        self.told = 0;
    }

    /// As much noise as the line takes in so many microseconds.
    pub fn noise(&mut self, now_us: u64, for_us: u64) {
        let bytes = u64::from(link::BIT_RATE) / 10 * for_us / 1_000_000 + 1;
        let mut noise = Pcg32::seed_from_u64(now_us);
        self.to_board.extend((0..bytes).map(|_| noise.next_u32() as u8));
    }
}

/// Nobody listens, nobody speaks.
#[derive(Clone, Copy, Debug)]
pub struct Nobody;

impl FarEnd for Nobody {
    fn exchange(&mut self, _: u64, _: &[u8], _: &mut Vec<u8>) -> anyhow::Result<()> {
        Ok(())
    }
}

/// Sends requests at instants of virtual time.
#[derive(Debug, Default)]
pub struct Script {
    sender: Sender,
    /// The latest first.
    requests: Vec<(u64, Request)>,
}

impl Script {
    /// Of these, microseconds each.
    pub fn new(requests: impl IntoIterator<Item = (u64, Request)>) -> Self {
        let mut requests: Vec<_> = requests.into_iter().collect();
        requests.sort_by_key(|(at_us, _)| std::cmp::Reverse(*at_us));
        Self { sender: Sender::default(), requests }
    }
}

impl FarEnd for Script {
    fn exchange(&mut self, now_us: u64, _: &[u8], to_board: &mut Vec<u8>) -> anyhow::Result<()> {
        while let Some((_, request)) = self.requests.pop_if(|(at_us, _)| *at_us <= now_us) {
            let mut frame = [0; FRAME];
            let len = self.sender.frame(&request, &mut frame).map_err(|_| anyhow::anyhow!("{request:?}"))?;
            to_board.extend(frame.get(..len).unwrap_or(&[]));
        }
        Ok(())
    }
}

/// Whoever connects to a socket of this machine, one at a time. As on a real board, nothing waits for who reads slowly: what does not
/// fit is lost. Without a speed virtual time goes as fast as it can, and waits for a reader that is behind.
#[derive(Debug)]
pub struct Socket {
    listener: TcpListener,
    stream: Option<TcpStream>,
    /// What the socket has not taken yet of what was begun.
    rest: Vec<u8>,
    started: Instant,
    speed: Option<f64>,
    hold: Arc<()>,
    /// The board has said something.
    is_up: bool,
}

/// As long as it is there, a run goes on after its drive, with a robot that stands.
#[derive(Clone, Debug)]
pub struct Hold {
    _counted: Arc<()>,
}

/// So much may wait for a reader, as in the ST-LINK and the driver of a PC.
const WAITING: usize = 16 * 1024;
/// Virtual time may be so far ahead.
const AHEAD: Duration = Duration::from_millis(2);
/// A reader is waited for no longer than this.
const PATIENCE: Duration = Duration::from_secs(1);
/// It is looked at again after this.
const AGAIN: Duration = Duration::from_millis(1);

impl Socket {
    /// On this port of 127.0.0.1, or any where it is zero. The speed: times as fast as the clock on the wall.
    pub fn listen(port: u16, speed: Option<f64>) -> anyhow::Result<Self> {
        let place = SocketAddr::from((Ipv4Addr::LOCALHOST, port));
        let listener = TcpListener::bind(place).with_context(|| format!("--vcp: {place}"))?;
        listener.set_nonblocking(true).with_context(|| format!("--vcp: {place}"))?;
        let (rest, started) = (Vec::new(), Instant::now());
        Ok(Self { listener, stream: None, rest, started, speed, hold: Arc::default(), is_up: false })
    }

    /// Has the run go on after its drive.
    pub fn hold(&self) -> Hold {
        Hold { _counted: self.hold.clone() }
    }

    /// Where it listens.
    pub fn address(&self) -> anyhow::Result<SocketAddr> {
        self.listener.local_addr().context("--vcp")
    }

    /// False once the other side has gone.
    fn pass(&mut self, from_board: &[u8], to_board: &mut Vec<u8>) -> bool {
        let Some(stream) = &mut self.stream else { return true };
        if self.rest.len() < WAITING {
            self.rest.extend(from_board);
        }
        let begun = Instant::now();
        loop {
            match stream.write(&self.rest) {
                Ok(count) => drop(self.rest.drain(..count)),
                Err(error) if error.kind() == ErrorKind::WouldBlock => {}
                Err(_) => return false,
            }
            if self.speed.is_some() || self.rest.len() < WAITING || begun.elapsed() > PATIENCE {
                break;
            }
            std::thread::sleep(AGAIN);
        }
        let mut bytes = [0; 256];
        match stream.read(&mut bytes) {
            Ok(0) => return false,
            Ok(count) => to_board.extend(bytes.get(..count).unwrap_or(&[])),
            Err(error) if error.kind() == ErrorKind::WouldBlock => {}
            Err(_) => return false,
        }
        true
    }
}

impl FarEnd for Socket {
    fn exchange(&mut self, now_us: u64, from_board: &[u8], to_board: &mut Vec<u8>) -> anyhow::Result<()> {
        if self.stream.is_none()
            && let Ok((stream, _)) = self.listener.accept()
        {
            stream.set_nonblocking(true).context("--vcp")?;
            // A byte at a time, as a serial port.
            stream.set_nodelay(true).context("--vcp")?;
            (self.stream, self.rest) = (Some(stream), Vec::new());
        }
        if !self.pass(from_board, to_board) {
            self.stream = None;
        }
        // What comes before a board has booted is not kept for it.
        self.is_up |= !from_board.is_empty();
        if !self.is_up {
            to_board.clear();
        }
        if let Some(speed) = self.speed {
            let due = Duration::from_secs_f64(now_us as f64 * 1e-6 / speed);
            let ahead = due.saturating_sub(self.started.elapsed());
            if ahead > AHEAD {
                std::thread::sleep(ahead);
            }
        }
        Ok(())
    }

    fn lets_end(&self) -> bool {
        Arc::strong_count(&self.hold) == 1
    }
}

/// All messages in what came over the port, with the instants at which their last bytes had come, virtual microseconds.
pub fn timed_messages(bytes: &[u8], frames: &[(usize, u64)]) -> Vec<(u64, FromRobot)> {
    let mut receiver = Receiver::<FRAME>::default();
    let mut from = 0;
    let mut all = Vec::new();
    for (to, at_us) in frames {
        let frame = bytes.get(std::mem::replace(&mut from, *to)..*to).unwrap_or(&[]);
        let messages = frame.iter().filter_map(|byte| receiver.push(*byte).and_then(FromRobot::decode));
        all.extend(messages.map(|message| (*at_us, message)));
    }
    all
}

/// All messages in what came over the port.
pub fn messages(bytes: &[u8]) -> Vec<FromRobot> {
    let mut receiver = Receiver::<FRAME>::default();
    bytes.iter().filter_map(|byte| receiver.push(*byte).and_then(FromRobot::decode)).collect()
}

/// The poses among them.
pub fn poses(bytes: &[u8]) -> impl Iterator<Item = Pose> {
    messages(bytes).into_iter().filter_map(|message| match message {
        FromRobot::Pose(pose) => Some(pose),
        _ => None,
    })
}

/// Those of scans, with their stamps.
pub fn scan_poses(bytes: &[u8]) -> Vec<(u64, Isometry2<f32>)> {
    let of_scan = poses(bytes).filter(|pose| pose.cause == Cause::Scan);
    of_scan.map(|of| (of.at_us, pose(of.pose[0], of.pose[1], of.pose[2]))).collect()
}
