//! The sensor's line, received into a ring: an error on it costs what it spoilt and no more.
//!
//! embassy-stm32 makes pins, rates, the transmitter and the DMA's ring. Its own receiver over such a ring, `RingBufferedUartRx`, is
//! not used, for on this part (0.6.0) it makes much of little:
//! - `usart/mod.rs`, `on_interrupt`: a noise, framing or overrun flag, even on a byte that is right, turns the DMA's requests off;
//!   what comes until the task runs again is lost.
//! - `usart/ringbuffered.rs`, `read` and `start_uart`: after an error the DMA's stream is stopped and enabled again as it is. The
//!   hardware then begins at the ring's first byte with a full count (RM0090, DMA_SxNDTR), the reader goes on where it was, and
//!   `dma_sync` of `dma/ringbuffer/mod.rs` takes a position before the last for a pass of the ring: stale bytes are handed out.
//! - `usart/ringbuffered.rs`, `check_idle_and_errors`: the task reads the data register to clear flags, at whatever time; a byte that
//!   has come just then is taken from under the DMA's nose.
//! - `dma/dma_bdma.rs`, `on_irq`: passes of the ring are counted one for an interrupt. Held up over two, it counts one, and what
//!   `ReadableDmaRingBuffer::len` makes of it may look whole.
//!
//! Here the DMA never stops. Flags are cleared in the interrupt, right after the byte that set them, or at the end of a burst, when
//! no byte can be on its way to the register; handlers before and after embassy's hide errors from it, which it needs for the
//! transmitter alone. An error is handed to the reader where it lies among the bytes. Both flags of the DMA at once, that of the
//! half and that of the whole ring, mean that the interrupt was held up for half a ring or more: what is in it counts as lost.

use core::future::poll_fn;
use core::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use core::task::Poll;

use embassy_stm32::dma::{self, ReadableRingBuffer};
use embassy_stm32::interrupt::typelevel::{self, Handler};
use embassy_stm32::usart;
use embassy_sync::waitqueue::AtomicWaker;

use super::{LIDAR_STREAM, LIDAR_USART};

/// Bytes that DMA may hold for the lidar task: 20 ms at 250 kbit/s, twenty times its longest wait.
pub const RING: usize = 512;

/// More bytes cannot have come while some were read.
const JUST_BEHIND: usize = 16;

/// Wakes the reader at the end of a burst, or for an error.
static WAKER: AtomicWaker = AtomicWaker::new();
/// The first error that the reader has not seen: its place in the ring and its kind, see [`Broken`].
static BROKEN: AtomicU32 = AtomicU32::new(0);
/// The DMA has gone round the ring uncounted.
static LAPPED: AtomicBool = AtomicBool::new(false);
static NOISE: AtomicU32 = AtomicU32::new(0);
static FRAMING: AtomicU32 = AtomicU32::new(0);
static OVERRUNS: AtomicU32 = AtomicU32::new(0);

/// Errors on the line since the start. All wrap.
#[derive(Clone, Copy, Default)]
pub struct LineErrors {
    /// Noise, on bytes that may be right all the same; with one sample for a bit only start bits show it.
    pub noise: u32,
    /// Bytes without a stop bit.
    pub framing: u32,
    /// Times that bytes were lost: the DMA came late for one, or the reader for a ring of them.
    pub overruns: u32,
}

/// What has been counted.
pub fn line_errors() -> LineErrors {
    let [noise, framing, overruns] = [&NOISE, &FRAMING, &OVERRUNS].map(|n| n.load(Ordering::Relaxed));
    LineErrors { noise, framing, overruns }
}

/// Where the DMA writes next.
fn place() -> u32 {
    let (dma, stream) = LIDAR_STREAM;
    RING as u32 - u32::from(dma.st(stream).ndtr().read().ndt()).min(RING as u32)
}

/// An error among the bytes.
#[derive(Clone, Copy)]
enum Broken {
    Framing,
    Overrun,
}

impl Broken {
    const SHIFT: u32 = 16;

    fn set(self) {
        let mark = (self as u32 + 1) << Self::SHIFT | place();
        // One that the reader has not seen yet stands: it lies before this one.
        let _ = BROKEN.compare_exchange(0, mark, Ordering::Relaxed, Ordering::Relaxed);
    }

    /// The first that was not seen yet, and its place in the ring.
    fn first() -> Option<(Self, usize)> {
        let mark = BROKEN.load(Ordering::Relaxed);
        let kind = match mark >> Self::SHIFT {
            0 => return None,
            1 => Self::Framing,
            _ => Self::Overrun,
        };
        Some((kind, mark as usize % (1 << Self::SHIFT)))
    }
}

/// Goes before embassy's handler of the port: counts and clears what it is not to see.
pub struct BeforePort;

impl Handler<typelevel::USART6> for BeforePort {
    unsafe fn on_interrupt() {
        let flags = LIDAR_USART.sr().read();
        // It must not find errors that rise after this.
        LIDAR_USART.cr3().modify(|w| w.set_eie(false));
        if !(flags.ne() || flags.fe() || flags.ore() || flags.idle()) {
            return;
        }
        // After the status, the data: this clears the flags. The DMA has had its byte long since, but of one that overran.
        let _ = LIDAR_USART.dr().read();
        for (counter, raised) in [(&NOISE, flags.ne()), (&FRAMING, flags.fe()), (&OVERRUNS, flags.ore())] {
            counter.fetch_add(raised.into(), Ordering::Relaxed);
        }
        if flags.ore() {
            Broken::Overrun.set();
        } else if flags.fe() {
            Broken::Framing.set();
        }
        WAKER.wake();
    }
}

/// Goes after embassy's handler of the port: whatever that has turned off is on again. A flag that has risen in between raises the
/// interrupt anew.
pub struct AfterPort;

impl Handler<typelevel::USART6> for AfterPort {
    unsafe fn on_interrupt() {
        listen();
    }
}

/// Goes before embassy's handler of the DMA's stream.
pub struct BeforeRing;

impl Handler<typelevel::DMA2_STREAM1> for BeforeRing {
    unsafe fn on_interrupt() {
        let (dma, stream) = LIDAR_STREAM;
        let flags = dma.isr(stream / 4).read();
        if flags.htif(stream % 4) && flags.tcif(stream % 4) {
            LAPPED.store(true, Ordering::Relaxed);
        }
    }
}

/// Interrupts and DMA of the receiver on.
fn listen() {
    LIDAR_USART.cr1().modify(|w| w.set_idleie(true));
    LIDAR_USART.cr3().modify(|w| {
        w.set_dmar(true);
        w.set_eie(true);
    });
}

/// The receiving end of the port.
pub struct Receiver {
    /// Holds the pin, and sets the rate. None of its reading functions is called.
    port: usart::UartRx<'static, embassy_stm32::mode::Async>,
    ring: ReadableRingBuffer<'static, u8>,
    /// Where in the ring the next byte is read.
    at: usize,
}

impl Receiver {
    /// Listens from now on.
    ///
    /// # Safety
    ///
    /// The channel is that of the port, which uses it no more, and the request that of the port's receiver on it.
    pub unsafe fn new(
        port: usart::UartRx<'static, embassy_stm32::mode::Async>,
        channel: dma::Channel<'static>,
        request: dma::Request,
        buffer: &'static mut [u8; RING],
    ) -> Self {
        let data = LIDAR_USART.dr().as_ptr().cast();
        // SAFETY: the caller's; and the buffer is the ring's alone, for ever.
        let mut ring = unsafe { ReadableRingBuffer::new(channel, request, data, buffer, Default::default()) };
        ring.start();
        listen();
        Self { port, ring, at: 0 }
    }

    /// Bytes that have come, or waits for some: until the line rests, or half of the ring is full. An error comes where it lies among
    /// the bytes; reading goes on behind it. Loses nothing when it is cancelled.
    pub async fn read(&mut self, buffer: &mut [u8]) -> Result<usize, usart::Error> {
        poll_fn(|context| {
            // First the wakers: what comes after this wakes.
            WAKER.register(context.waker());
            self.ring.set_waker(context.waker());
            match self.take(buffer) {
                Ok(0) => Poll::Pending,
                taken => Poll::Ready(taken),
            }
        })
        .await
    }

    fn take(&mut self, buffer: &mut [u8]) -> Result<usize, usart::Error> {
        if LAPPED.swap(false, Ordering::Relaxed) {
            return Err(self.begin_anew());
        }
        let mut room = buffer.len();
        if let Some((kind, place)) = Broken::first() {
            let ahead = (place + RING - self.at) % RING;
            // It may have come up while its byte was being read, and lie just behind.
            room = if ahead > RING - JUST_BEHIND { 0 } else { room.min(ahead) };
            if room == 0 {
                BROKEN.store(0, Ordering::Relaxed);
                return Err(match kind {
                    Broken::Framing => usart::Error::Framing,
                    Broken::Overrun => usart::Error::Overrun,
                });
            }
        }
        match self.ring.read(buffer.get_mut(..room).unwrap_or_default()) {
            Ok((taken, _)) => {
                self.at = (self.at + taken) % RING;
                Ok(taken)
            }
            Err(_) => Err(self.begin_anew()),
        }
    }

    /// The ring has been written over: what comes from now on is read.
    fn begin_anew(&mut self) -> usart::Error {
        OVERRUNS.fetch_add(1, Ordering::Relaxed);
        BROKEN.store(0, Ordering::Relaxed);
        // Until no byte has come in between; one comes every 13 µs at most.
        loop {
            let before = place();
            self.ring.clear();
            if place() == before {
                self.at = before as usize % RING;
                return usart::Error::Overrun;
            }
        }
    }

    /// Changes the bit rate of both directions.
    pub fn set_baud_rate(&mut self, bits_per_second: u32) -> Result<(), usart::ConfigError> {
        self.port.set_baudrate(bits_per_second)
    }
}
