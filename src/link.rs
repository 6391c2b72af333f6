//! The virtual COM port: what the map's thread says goes out frame by frame, what a PC asks comes in.
//!
//! ```text
//! mapping ──► Outbox ──a frame, made only when the port has room──► send ──DMA──► PC
//! mapping ◄──requests: a queue of two, what is too much is dropped; the PC asks again── receive ◄──DMA── PC
//! ```
//!
//! All of it runs in thread mode, beneath everything urgent. Nothing waits for a reader: the port sends at its bit rate whether
//! anyone listens or not. The package `link` says what the bytes are.

mod commands;
mod map;
mod outbox;
mod telemetry;

use core::sync::atomic::{AtomicU32, Ordering};

use ::link::{FRAME, Receiver, Request};
use embassy_futures::yield_now;
use embassy_stm32::mode::Async;
use embassy_stm32::usart::{RingBufferedUartRx, UartTx};
use embassy_sync::blocking_mutex::raw::CriticalSectionRawMutex;
use embassy_sync::channel::Channel;
use embassy_sync::zerocopy_channel;
use embassy_time::{Duration, with_timeout};

use crate::liveness::{self, Task};

pub use commands::Restart;
pub use outbox::{Outbox, View};
pub use telemetry::{Load, fault_of, pose_of, state_of};

/// Bytes of the largest request in its frame: a pose is set with 28.
const REQUEST: usize = 48;

/// Without a frame to send for so long, the task comes by all the same.
const IDLE: Duration = Duration::from_millis(500);

/// A frame on its way to the port.
pub struct Frame {
    bytes: [u8; FRAME],
    len: usize,
}

impl Frame {
    /// Room for one.
    pub const EMPTY: Self = Self { bytes: [0; FRAME], len: 0 };
}

/// What has come from a PC.
#[derive(Clone, Copy)]
pub enum Incoming {
    /// A request.
    Request(Request),
    /// One that this firmware does not know, by its number.
    Unknown(u32),
}

/// Requests on their way to the map's thread. A queue; one that finds no room is dropped, and the PC, which hears no answer, asks again.
pub static REQUESTS: Channel<CriticalSectionRawMutex, Incoming, 2> = Channel::new();

/// What came of the bytes received. Latest wins.
struct Received {
    frames: AtomicU32,
    damaged: AtomicU32,
    overruns: AtomicU32,
}

static RECEIVED: Received =
    Received { frames: AtomicU32::new(0), damaged: AtomicU32::new(0), overruns: AtomicU32::new(0) };

/// Sends frames for ever.
#[embassy_executor::task]
pub async fn send(
    mut port: UartTx<'static, Async>,
    mut frames: zerocopy_channel::Receiver<'static, CriticalSectionRawMutex, Frame>,
) {
    loop {
        liveness::here(Task::Link).await;
        // Where nothing is to be sent it says that it lives all the same.
        let Ok(frame) = with_timeout(IDLE, frames.receive()).await else { continue };
        if let Err(error) = port.write(frame.bytes.get(..frame.len).unwrap_or(&[])).await {
            defmt::warn!("link: {}", error);
        }
        frames.receive_done();
    }
}

/// Receives for ever. Bytes that come while the map is worked on wait in the ring, as many as it has room for.
#[embassy_executor::task]
pub async fn receive(mut port: RingBufferedUartRx<'static>) {
    let mut receiver = Receiver::<REQUEST>::default();
    let mut bytes = [0; 32];
    loop {
        match port.read(&mut bytes).await {
            Ok(count) => {
                for &byte in bytes.get(..count).unwrap_or(&[]) {
                    take(&mut receiver, byte);
                }
                let counters = receiver.counters();
                RECEIVED.frames.store(counters.frames, Ordering::Relaxed);
                RECEIVED.damaged.store(counters.damaged, Ordering::Relaxed);
            }
            // The next read begins anew.
            Err(_) => {
                RECEIVED.overruns.fetch_add(1, Ordering::Relaxed);
            }
        }
        // Noise at full rate shall not keep the map waiting.
        yield_now().await;
    }
}

fn take(receiver: &mut Receiver<REQUEST>, byte: u8) {
    let Some(body) = receiver.push(byte) else { return };
    let incoming = match Request::decode(body) {
        Ok(request) => Incoming::Request(request),
        Err(Some(id)) => Incoming::Unknown(id),
        Err(None) => return,
    };
    if REQUESTS.try_send(incoming).is_err() {
        defmt::warn!("link: requests come faster than they are answered");
    }
}
