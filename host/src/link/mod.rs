//! The robot at the other end of a serial port, or the emulated one at a socket: messages come, commands go.
//!
//! ```text
//! port ──► [Client::next] ──► messages ──► whoever shows or keeps them; [MapCopy] makes the map of some of them
//! port ◄── [Client::send] ◄── commands     (and says what to ask for again)
//! ```
//!
//! Nothing here runs by itself: a client belongs to one thread, which calls [`Client::next`] again and again and between two calls sends
//! what it has to. [`Client::request`] does both until the answer is there. A port that is gone is an error; connect again.

mod address;
mod map_copy;
pub mod words;

use std::collections::VecDeque;
use std::hash::{BuildHasher, Hasher, RandomState};
use std::io::{ErrorKind, Read, Write};
use std::net::TcpStream;
use std::time::{Duration, Instant};

use ::link::frame::ReceiveCounters;
pub use ::link::from_robot;
use ::link::from_robot::{Answer, Hello, Outcome};
use ::link::{BIT_RATE, FRAME, Receiver, Request, Sender};
pub use ::link::{Command, FromRobot, Streams};
pub use address::Address;
pub use map_copy::MapCopy;

/// Why there is no robot to speak with.
#[derive(Debug, thiserror::Error)]
pub enum LinkError {
    /// What was given as a port is none.
    #[error("--port {given}: expected a device such as /dev/ttyACM0, or tcp://HOST:PORT")]
    Address {
        /// As given.
        given: String,
    },
    /// The ports of this PC cannot be listed.
    #[error("the serial ports cannot be listed; name one with --port")]
    List(#[source] serialport::Error),
    /// No port of this PC belongs to an ST-LINK.
    #[error("no ST-LINK is plugged in: plug in the board's USB cable, or name its port with --port")]
    NotFound,
    /// More than one does.
    #[error("{} ST-LINKs are plugged in, at {}: choose one with --port", ports.len(), ports.join(", "))]
    Several {
        /// Their ports.
        ports: Vec<String>,
    },
    /// A serial port cannot be opened.
    #[error("{address}")]
    Port {
        /// Which.
        address: Address,
        /// What the system said.
        source: serialport::Error,
    },
    /// A port or socket cannot be opened, or is gone.
    #[error("{address}")]
    Io {
        /// Which.
        address: Address,
        /// What the system said.
        source: std::io::Error,
    },
    /// The robot does not answer.
    #[error("{address}: no answer from the robot within {} s; is its firmware of this version?", waited.as_secs())]
    NoAnswer {
        /// Which.
        address: Address,
        /// For so long.
        waited: Duration,
    },
}

/// A request is sent again after this …
const AGAIN: Duration = Duration::from_millis(400);
/// … and given up after this.
const GIVEN_UP: Duration = Duration::from_secs(4);
/// A robot says who it is within this.
pub const GREETING: Duration = Duration::from_secs(4);
/// It is asked again this often.
const GREET_AGAIN: Duration = Duration::from_millis(500);
/// A read takes no longer than this.
const READ: Duration = Duration::from_millis(20);

trait Port: Read + Write + Send {}
impl<T: Read + Write + Send> Port for T {}

/// A connection to a robot.
pub struct Client {
    address: Address,
    port: Box<dyn Port>,
    receiver: Receiver<FRAME>,
    sender: Sender,
    /// The number of the next request.
    id: u32,
    waiting: VecDeque<FromRobot>,
    bytes: u64,
    unknown: u32,
}

impl Client {
    /// Opens the port. The robot is not asked for anything.
    pub fn connect(address: &Address) -> Result<Self, LinkError> {
        let io = |source| LinkError::Io { address: address.clone(), source };
        let port: Box<dyn Port> = match address {
            Address::Serial(device) => {
                let port = serialport::new(device, BIT_RATE).timeout(READ).open();
                Box::new(port.map_err(|source| LinkError::Port { address: address.clone(), source })?)
            }
            Address::Tcp(place) => {
                let stream = TcpStream::connect(place).map_err(io)?;
                stream.set_read_timeout(Some(READ)).map_err(io)?;
                stream.set_nodelay(true).map_err(io)?;
                Box::new(stream)
            }
        };
        Ok(Self {
            address: address.clone(),
            port,
            receiver: Receiver::default(),
            sender: Sender::default(),
            id: RandomState::new().build_hasher().finish() as u32,
            waiting: VecDeque::new(),
            bytes: 0,
            unknown: 0,
        })
    }

    /// Where the robot is.
    pub fn address(&self) -> &Address {
        &self.address
    }

    /// Bytes received so far.
    pub fn bytes(&self) -> u64 {
        self.bytes
    }

    /// What came of them.
    pub fn counters(&self) -> ReceiveCounters {
        self.receiver.counters()
    }

    /// Messages that this version does not know, which were passed over.
    pub fn unknown(&self) -> u32 {
        self.unknown
    }

    /// The next message, or none within the time. An error once the port is gone.
    pub fn next(&mut self, within: Duration) -> Result<Option<FromRobot>, LinkError> {
        let until = Instant::now() + within;
        loop {
            if let Some(message) = self.waiting.pop_front() {
                return Ok(Some(message));
            }
            self.read()?;
            if self.waiting.is_empty() && Instant::now() >= until {
                return Ok(None);
            }
        }
    }

    fn read(&mut self) -> Result<(), LinkError> {
        let mut bytes = [0; 4096];
        let count = match self.port.read(&mut bytes) {
            Ok(0) => return Err(self.gone(ErrorKind::UnexpectedEof.into())),
            Ok(count) => count,
            Err(error)
                if matches!(
                    error.kind(),
                    ErrorKind::WouldBlock | ErrorKind::TimedOut | ErrorKind::Interrupted
                ) =>
            {
                return Ok(());
            }
            Err(error) => return Err(self.gone(error)),
        };
        self.bytes += count as u64;
        for byte in &bytes[..count] {
            let Some(body) = self.receiver.push(*byte) else { continue };
            match FromRobot::decode(body) {
                Some(message) => self.waiting.push_back(message),
                None => self.unknown += 1,
            }
        }
        Ok(())
    }

    fn gone(&self, source: std::io::Error) -> LinkError {
        LinkError::Io { address: self.address.clone(), source }
    }

    /// Sends a request and returns its number, which the [`Answer`] among the messages will have.
    pub fn send(&mut self, command: Command) -> Result<u32, LinkError> {
        let id = self.id;
        self.id = self.id.wrapping_add(1);
        self.put(Request { id, command })?;
        Ok(id)
    }

    /// Asks for these streams and who is there, until the robot says it. That, and what else it said meanwhile, in order.
    pub fn greet(
        &mut self,
        streams: Streams,
        within: Duration,
    ) -> Result<(Hello, Vec<FromRobot>), LinkError> {
        let begun = Instant::now();
        let mut heard = Vec::new();
        while begun.elapsed() < within {
            self.send(Command::Subscribe(streams))?;
            self.send(Command::Hello)?;
            let asked = Instant::now();
            while asked.elapsed() < GREET_AGAIN {
                match self.next(READ)? {
                    Some(FromRobot::Hello(hello)) => return Ok((hello, heard)),
                    Some(message) => heard.push(message),
                    None => {}
                }
            }
        }
        Err(LinkError::NoAnswer { address: self.address.clone(), waited: within })
    }

    fn put(&mut self, request: Request) -> Result<(), LinkError> {
        let mut frame = [0; FRAME];
        let len = self.sender.frame(&request, &mut frame).expect("every request fits into a frame");
        self.port.write_all(&frame[..len]).and_then(|()| self.port.flush()).map_err(|error| self.gone(error))
    }

    /// Asks until there is an answer; the robot does it once. Other messages wait for [`Self::next`].
    pub fn request(&mut self, command: Command) -> Result<Outcome, LinkError> {
        let id = self.send(command)?;
        let (begun, mut sent) = (Instant::now(), Instant::now());
        let mut others = std::mem::take(&mut self.waiting);
        let outcome = loop {
            match self.next(READ)? {
                Some(FromRobot::Answer(Answer { id: answered, outcome })) if answered == id => break outcome,
                Some(other) => others.push_back(other),
                None => {}
            }
            if begun.elapsed() > GIVEN_UP {
                return Err(LinkError::NoAnswer { address: self.address.clone(), waited: GIVEN_UP });
            }
            // A restarted robot would do it again.
            if sent.elapsed() > AGAIN && command != Command::Restart {
                sent = Instant::now();
                self.put(Request { id, command })?;
            }
        };
        others.append(&mut self.waiting);
        self.waiting = others;
        Ok(outcome)
    }
}
