//! A simulated sensor, a port and a clock in one room: time passes only when everybody waits, so no test sleeps.
#![allow(dead_code)] // Each test file uses its part.

use std::cell::RefCell;
use std::collections::VecDeque;
use std::future::{Future, poll_fn};
use std::pin::pin;
use std::rc::Rc;
use std::task::{Context, Poll, Waker};

use scip::sim::{Sent, SimulatedUrg};
use scip::{Clock, SerialPort};

/// What a port may say.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LineError;

impl core::fmt::Display for LineError {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str("framing error")
    }
}

impl core::error::Error for LineError {}

impl embedded_io_async::Error for LineError {
    fn kind(&self) -> embedded_io_async::ErrorKind {
        embedded_io_async::ErrorKind::Other
    }
}

/// What is on the other end of the line.
pub trait Peer {
    /// Takes a byte from the host.
    fn receive(&mut self, byte: u8, baud_rate: u32, now_us: u64);
    /// Lets time pass and gives what was sent until now.
    fn transmit(&mut self, now_us: u64) -> Option<Sent>;
    /// When something happens next.
    fn next_us(&self) -> u64;
}

impl Peer for SimulatedUrg {
    fn receive(&mut self, byte: u8, baud_rate: u32, now_us: u64) {
        self.receive(byte, baud_rate, now_us);
    }

    fn transmit(&mut self, now_us: u64) -> Option<Sent> {
        self.advance(now_us, &mut measure);
        self.transmit(now_us)
    }

    fn next_us(&self) -> u64 {
        self.next_us()
    }
}

/// A scan that can be told from every other and checked range by range.
pub fn measure(begin_us: u64, ranges_mm: &mut [u16]) {
    for (range_mm, beam) in ranges_mm.iter_mut().zip(0u64..) {
        *range_mm = (20 + (begin_us / 1000 + beam * 7) % 5580) as u16;
    }
}

pub struct Room<S> {
    pub now_us: u64,
    pub peer: S,
    pub host_rate: u32,
    pub plugged: bool,
    incoming: VecDeque<Result<u8, LineError>>,
    alarm_us: u64,
    /// For what is heard at the wrong bit rate.
    noise: u32,
    /// Noise on the line: one read in so many is an error.
    pub error_one_in: u32,
}

/// A room that port, clock and test share.
pub struct World<S>(pub Rc<RefCell<Room<S>>>);

impl<S> Clone for World<S> {
    fn clone(&self) -> Self {
        Self(self.0.clone())
    }
}

impl<S: Peer> World<S> {
    pub fn new(peer: S) -> Self {
        Self(Rc::new(RefCell::new(Room {
            now_us: 0,
            peer,
            host_rate: 0,
            plugged: true,
            incoming: VecDeque::new(),
            alarm_us: u64::MAX,
            noise: 1,
            error_one_in: 0,
        })))
    }

    pub fn now_us(&self) -> u64 {
        self.0.borrow().now_us
    }

    /// Runs a future to its end on simulated time.
    pub fn run<F: Future>(&self, future: F) -> F::Output {
        let mut future = pin!(future);
        let mut context = Context::from_waker(Waker::noop());
        loop {
            self.0.borrow_mut().alarm_us = u64::MAX;
            if let Poll::Ready(output) = future.as_mut().poll(&mut context) {
                return output;
            }
            self.0.borrow_mut().go_on();
        }
    }

    /// To the next instant at which anything happens.
    pub fn step(&self) {
        self.0.borrow_mut().go_on();
    }
}

impl<S: Peer> Room<S> {
    /// To the next instant at which anything happens.
    fn go_on(&mut self) {
        let next_us = self.peer.next_us().min(self.alarm_us);
        assert_ne!(next_us, u64::MAX, "everybody waits for ever");
        self.now_us = self.now_us.max(next_us);
        while let Some(sent) = self.peer.transmit(self.now_us) {
            self.hear(sent);
        }
    }

    fn hear(&mut self, sent: Sent) {
        self.noise = self.noise.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        if !self.plugged {
            return;
        }
        if sent.baud_rate != self.host_rate {
            let garbage = (self.noise >> 24) as u8;
            self.incoming.push_back(if garbage & 1 == 0 { Err(LineError) } else { Ok(garbage) });
        } else if self.error_one_in > 0 && (self.noise >> 8).is_multiple_of(self.error_one_in) {
            self.incoming.push_back(Err(LineError));
        } else {
            self.incoming.push_back(Ok(sent.byte));
        }
    }
}

/// The host's end of the line.
pub struct Port<S>(pub World<S>);

impl<S: Peer> embedded_io_async::ErrorType for Port<S> {
    type Error = LineError;
}

impl<S: Peer> embedded_io_async::Read for Port<S> {
    async fn read(&mut self, buffer: &mut [u8]) -> Result<usize, LineError> {
        poll_fn(|_| {
            let mut room = self.0.0.borrow_mut();
            match room.incoming.front() {
                None => return Poll::Pending,
                Some(Err(error)) => {
                    let error = *error;
                    room.incoming.pop_front();
                    return Poll::Ready(Err(error));
                }
                Some(Ok(_)) => {}
            }
            let mut n = 0;
            while n < buffer.len()
                && let Some(Ok(byte)) = room.incoming.front()
            {
                buffer[n] = *byte;
                n += 1;
                room.incoming.pop_front();
            }
            Poll::Ready(Ok(n))
        })
        .await
    }
}

impl<S: Peer> embedded_io_async::Write for Port<S> {
    async fn write(&mut self, bytes: &[u8]) -> Result<usize, LineError> {
        let mut room = self.0.0.borrow_mut();
        let (now_us, rate) = (room.now_us, room.host_rate);
        if room.plugged {
            for &byte in bytes {
                room.peer.receive(byte, rate, now_us);
            }
        }
        Ok(bytes.len())
    }

    async fn flush(&mut self) -> Result<(), LineError> {
        Ok(())
    }
}

impl<S: Peer> SerialPort for Port<S> {
    fn set_baud_rate(&mut self, bits_per_second: u32) -> Result<(), LineError> {
        self.0.0.borrow_mut().host_rate = bits_per_second;
        Ok(())
    }
}

impl<S: Peer> Clock for World<S> {
    fn now_us(&self) -> u64 {
        World::now_us(self)
    }

    async fn wait_until(&mut self, instant_us: u64) {
        poll_fn(|_| {
            let mut room = self.0.borrow_mut();
            if room.now_us >= instant_us {
                return Poll::Ready(());
            }
            room.alarm_us = room.alarm_us.min(instant_us);
            Poll::Pending
        })
        .await;
    }
}

/// A peer that plays back bytes, one every so many microseconds, and hears nothing.
pub struct Tape {
    pub bytes: VecDeque<u8>,
    pub byte_us: u64,
    pub next_us: u64,
    pub rate: u32,
}

impl Tape {
    /// At the rate of a line of 500 000 bit/s.
    pub fn new(bytes: impl IntoIterator<Item = u8>) -> Self {
        Self { bytes: bytes.into_iter().collect(), byte_us: 20, next_us: 20, rate: 0 }
    }
}

impl Peer for Tape {
    fn receive(&mut self, _: u8, rate: u32, _: u64) {
        // Whatever the host speaks: it is always understood.
        self.rate = rate;
    }

    fn transmit(&mut self, now_us: u64) -> Option<Sent> {
        if self.next_us > now_us {
            return None;
        }
        let byte = self.bytes.pop_front()?;
        self.next_us += self.byte_us;
        Some(Sent { byte, baud_rate: self.rate })
    }

    fn next_us(&self) -> u64 {
        if self.bytes.is_empty() { u64::MAX } else { self.next_us }
    }
}
