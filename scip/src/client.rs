//! The driver: finds the sensor, sets it up, hands out scans, and finds it again when it is lost.
//!
//! It works on any [`embedded-io-async`](embedded_io_async) port that can change its bit rate, and any clock. Each call
//! ends in bounded time, whatever comes over the line: a caller that feeds a watchdog between calls need not fear it.

use core::ops::Range;

use embassy_futures::select::{Either, select};
use embedded_io_async::{Read, Write};

use crate::codec::DATA_CHARS;
use crate::command::{Command, Request, Steps, Stream, Width};
use crate::decoder::{self, Decoder, Event, ScanHead};
use crate::info::{InfoBuilder, InfoError, SensorInfo};
pub use crate::rate::RATES;
use crate::rate::RateChoice;
use crate::reply::Status;
use crate::time::SensorClock;

/// A serial port. Its `read` must lose nothing when it is cancelled while waiting, and return as soon as there are any bytes.
///
/// Errors of `read` are counted and survived; the port must go on after one. What is being read when one comes, a scan, say, is
/// dropped: bytes of it are wrong or missing. Noise on a byte that is right all the same is better not reported.
pub trait SerialPort: Read + Write {
    /// Changes the bit rate of both directions, at once.
    fn set_baud_rate(&mut self, bits_per_second: u32) -> Result<(), Self::Error>;
}

/// The host's clock.
#[allow(async_fn_in_trait)] // The client is driven by one task; it asks nothing of other threads.
pub trait Clock {
    /// Microseconds since any fixed instant; never falls.
    fn now_us(&self) -> u64;
    /// Returns at that instant, or at once if it has passed. Can be cancelled.
    async fn wait_until(&mut self, instant_us: u64);
}

/// [`Clock`] of a firmware that uses embassy-time.
#[cfg(feature = "embassy-time")]
#[derive(Clone, Copy, Debug, Default)]
pub struct EmbassyClock;

#[cfg(feature = "embassy-time")]
impl Clock for EmbassyClock {
    fn now_us(&self) -> u64 {
        embassy_time::Instant::now().as_micros()
    }

    async fn wait_until(&mut self, instant_us: u64) {
        embassy_time::Timer::at(embassy_time::Instant::from_micros(instant_us)).await;
    }
}

/// What is asked of the sensor.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct ClientConfig {
    /// Bit rate to work at, bit/s. A sensor that cannot, or needs none as on USB, stays at its own. Where it fails, a lower one
    /// is chosen for good, see [`rate`](crate::rate).
    pub baud_rate: u32,
    /// Steps to measure; `None` for all that the sensor has.
    pub steps: Option<Steps>,
    /// So many scans are left out between two, 0 to 9.
    pub interval: u8,
    /// Whether the clocks are compared by `TM` when connecting. Without, stamps are late by what the sensor needs beyond sweep
    /// and transmission.
    pub compare_clocks: bool,
    /// Without a good scan for so long the sensor counts as lost, microseconds.
    pub silence_us: u64,
    /// Pause after the first failed attempt to connect, microseconds. It doubles with each further one …
    pub least_pause_us: u64,
    /// … up to this, microseconds.
    pub most_pause_us: u64,
}

impl Default for ClientConfig {
    fn default() -> Self {
        Self {
            // The lowest that carries ten full scans of `MD` a second: each takes 85.5 ms. No level shifter is rated for less.
            baud_rate: 250_000,
            steps: None,
            interval: 0,
            compare_clocks: true,
            silence_us: 1_000_000,
            least_pause_us: 100_000,
            most_pause_us: 2_000_000,
        }
    }
}

/// A scan, whose ranges are in the caller's slice.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Scan {
    /// Steps it covers.
    pub steps: Steps,
    /// Number of ranges.
    pub ranges: usize,
    /// When the sensor was at step 0, on the host's clock, microseconds.
    pub stamp_us: u64,
    /// When the scan's end was read, on the host's clock, microseconds.
    pub arrived_us: u64,
    /// One revolution, microseconds, and its steps.
    revolution: (u32, u16),
}

impl Scan {
    /// One revolution on the host's clock, microseconds: as measured.
    pub fn revolution_us(&self) -> u32 {
        self.revolution.0
    }

    /// When a range was measured, on the host's clock, microseconds. Of a cluster, its first step.
    pub fn beam_us(&self, range: usize) -> u64 {
        let step = u64::from(self.steps.first) + (range * usize::from(self.steps.cluster.max(1))) as u64;
        let (revolution_us, steps) = self.revolution;
        self.stamp_us + step * u64::from(revolution_us) / u64::from(steps.max(1))
    }
}

/// Why there is no scan.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[non_exhaustive]
pub enum ClientError<E> {
    /// The port fails.
    Port(E),
    /// Nothing that speaks SCIP answers at any bit rate.
    NotFound,
    /// The sensor answered `QT`, but not this.
    NoReply {
        /// What was asked.
        command: Command,
    },
    /// The sensor refuses.
    Refused {
        /// What was asked.
        command: Command,
        /// What it says to it.
        status: Status,
    },
    /// What the sensor says of itself cannot be.
    BadInfo(InfoError),
    /// A scan has more ranges than the caller's slice has room for.
    NoRoom {
        /// Ranges of a scan.
        ranges: usize,
        /// Room in the slice.
        room: usize,
    },
    /// Scans have stopped and nothing comes.
    Silent,
    /// Bytes come, but no scan among them.
    Babbling,
    /// The sensor stopped measuring: 21 to 49 verifying an error, 50 to 97 hardware.
    Stopped {
        /// What it says.
        status: Status,
    },
}

impl<E: core::fmt::Debug> core::fmt::Display for ClientError<E> {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        match self {
            Self::Port(error) => write!(f, "the port fails: {error:?}"),
            Self::NotFound => f.write_str("no sensor answers at any bit rate"),
            Self::NoReply { command } => write!(f, "the sensor does not answer {command:?}"),
            Self::Refused { command, status } => {
                write!(f, "the sensor refuses {command:?} with status {status}")
            }
            Self::BadInfo(error) => write!(f, "{error}"),
            Self::NoRoom { ranges, room } => {
                write!(f, "a scan has {ranges} ranges, there is room for {room}")
            }
            Self::Silent => f.write_str("the sensor has fallen silent"),
            Self::Babbling => f.write_str("the sensor sends bytes, but no scan among them"),
            Self::Stopped { status } => write!(f, "the sensor stopped measuring with status {status}"),
        }
    }
}

impl<E: core::fmt::Debug> core::error::Error for ClientError<E> {}

/// What happened since the client was made. All wrap.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct ClientCounters {
    /// Scans handed out.
    pub scans: u32,
    /// Scans that stamps show to be missing while connected.
    pub missed: u32,
    /// Attempts to connect.
    pub attempts: u32,
    /// Attempts that succeeded.
    pub connections: u32,
    /// Times that a connection was lost.
    pub losses: u32,
    /// Errors of the port, each of which costs what was being read.
    pub port_errors: u32,
    /// Scans of other steps than asked for.
    pub foreign_scans: u32,
    /// Times that a lower bit rate was chosen because the one before failed.
    pub slowed: u32,
    /// Scans that were not handed out because their stamps may have been more than 0.1 s off.
    pub doubted: u32,
}

/// Bytes read at once.
const CHUNK: usize = 128;
/// Answers to `QT` and other short commands come within this, microseconds.
const REPLY_US: u64 = 140_000;
/// A reply of `VV` or `PP` comes within this: 250 bytes at the lowest bit rate.
const INFO_US: u64 = 300_000;
/// A scan of 682 steps lasts 1.12 s at the lowest bit rate; a stream is silent after `QT` within this.
const STREAM_US: u64 = 1_400_000;
/// After a change of bit rate the sensor is left alone for so long.
const RATE_US: u64 = 150_000;
/// What is still on the line is let go by for so long.
const DRAIN_US: u64 = 20_000;
/// The first scan of a stream comes within this.
const FIRST_SCAN_US: u64 = 2_000_000;
/// After so many errors of the port in a row …
const ERRORS: u8 = 32;
/// … nothing is read for so long.
const ERROR_US: u64 = 1_000;
/// Writing a command's line lasts 18 ms at the lowest bit rate.
const WRITE_US: u64 = 100_000;
/// Commands are asked so often before the sensor counts as not answering.
const TRIES: usize = 2;
/// Answers to `TM1` that are compared; the one that came fastest counts.
const EXCHANGES: usize = 3;

/// A [`decoder::Event`] without its borrowed text.
#[derive(Clone, Copy)]
enum Heard {
    Reply(Request, Status),
    Time(u32),
    Scan(ScanHead),
    Scip11,
}

/// The driver. See the [crate's documentation](crate) for an example.
#[derive(Debug)]
pub struct Client<P, C> {
    port: P,
    clock: C,
    config: ClientConfig,
    decoder: Decoder,
    chunk: [u8; CHUNK],
    /// Bytes of the chunk that are still to be decoded.
    held: Range<usize>,
    info: Option<SensorInfo>,
    /// What is spoken now.
    rate: u32,
    /// What is to be spoken.
    choice: RateChoice,
    connected: bool,
    stream: Option<Stream>,
    sensor_clock: SensorClock,
    last_stamp_us: Option<u64>,
    pause_us: u64,
    not_before_us: u64,
    counters: ClientCounters,
    bytes: u32,
    /// Scans dropped when the last one was handed out.
    dropped: u32,
    errors_in_a_row: u8,
}

impl<P: SerialPort, C: Clock> Client<P, C> {
    /// Nothing is sent yet.
    pub fn new(port: P, clock: C, config: ClientConfig) -> Self {
        Self {
            port,
            clock,
            decoder: Decoder::new(),
            chunk: [0; CHUNK],
            held: 0..0,
            info: None,
            rate: config.baud_rate,
            choice: RateChoice::new(config.baud_rate),
            connected: false,
            stream: None,
            sensor_clock: SensorClock::default(),
            last_stamp_us: None,
            pause_us: config.least_pause_us,
            not_before_us: 0,
            counters: ClientCounters::default(),
            bytes: 0,
            dropped: 0,
            errors_in_a_row: 0,
            config,
        }
    }

    /// Looks for the sensor at every bit rate and in every state, and sets it up; scans do not run yet. Ends within 9 s.
    pub async fn connect(&mut self) -> Result<&SensorInfo, ClientError<P::Error>> {
        self.connected = false;
        self.stream = None;
        self.counters.attempts = self.counters.attempts.wrapping_add(1);
        self.find().await?;
        let info = self.set_up().await?;
        self.connected = true;
        self.counters.connections = self.counters.connections.wrapping_add(1);
        Ok(self.info.insert(info))
    }

    /// The next scan, its ranges in `ranges_mm`, first step first: millimetres, or a code below the sensor's least range.
    ///
    /// Connects where there is no connection, after a pause if the last attempt failed. After any error the next call
    /// connects anew, so calling this for ever is all that is needed. It ends within
    /// 9 s, the longest pause and the longest silence; cancelling it costs the scan that is being read.
    pub async fn next_scan(&mut self, ranges_mm: &mut [u16]) -> Result<Scan, ClientError<P::Error>> {
        let was_connected = self.connected;
        if !was_connected {
            self.clock.wait_until(self.not_before_us).await;
        }
        let result = self.try_next_scan(ranges_mm).await;
        match &result {
            Ok(scan) => {
                self.pause_us = self.config.least_pause_us;
                self.judge_rate(scan);
            }
            Err(error) => {
                if self.rate == self.choice.rate() && is_of_the_rate(error) && self.choice.failed() {
                    self.counters.slowed = self.counters.slowed.wrapping_add(1);
                }
                if was_connected {
                    self.counters.losses = self.counters.losses.wrapping_add(1);
                } else {
                    self.not_before_us = self.clock.now_us().saturating_add(self.pause_us);
                    self.pause_us = (self.pause_us * 2).min(self.config.most_pause_us);
                }
                self.connected = false;
            }
        }
        result
    }

    /// Where too many scans are dropped at this bit rate, the next call connects anew at a lower one.
    fn judge_rate(&mut self, scan: &Scan) {
        let dropped = self.decoder.counters().scans_dropped;
        let newly = dropped.wrapping_sub(core::mem::replace(&mut self.dropped, dropped));
        if self.rate != self.choice.rate() {
            return;
        }
        let period_us = u64::from(scan.revolution.0) * (u64::from(self.config.interval) + 1);
        let carrying = wire_bytes(&scan.steps) * 10_000_000 / period_us.max(1);
        if self.choice.took(newly, u32::try_from(carrying).unwrap_or(u32::MAX)) {
            self.counters.slowed = self.counters.slowed.wrapping_add(1);
            self.connected = false;
        }
    }

    /// Stops the scans and the laser. The next scan begins anew.
    pub async fn stop(&mut self) -> Result<(), ClientError<P::Error>> {
        self.stream = None;
        self.ask(Command::Qt, STREAM_US).await.map(|_| ())
    }

    /// What the sensor said of itself when it was last connected.
    pub fn info(&self) -> Option<&SensorInfo> {
        self.info.as_ref()
    }

    /// The bit rate that is spoken now, bit/s.
    pub fn baud_rate(&self) -> u32 {
        self.rate
    }

    /// The bit rate to work at, bit/s: that of the configuration, or a lower one since that failed. Another than
    /// [`Self::baud_rate`] where there is no connection, or the sensor cannot.
    pub fn chosen_baud_rate(&self) -> u32 {
        self.choice.rate()
    }

    /// What happened so far.
    pub fn counters(&self) -> &ClientCounters {
        &self.counters
    }

    /// What was read and dropped so far.
    pub fn decoder_counters(&self) -> &decoder::Counters {
        self.decoder.counters()
    }

    /// What is known of the sensor's clock, since it was last connected.
    pub fn sensor_clock(&self) -> &SensorClock {
        &self.sensor_clock
    }

    /// Gives the port back.
    pub fn into_port(self) -> P {
        self.port
    }

    async fn try_next_scan(&mut self, ranges_mm: &mut [u16]) -> Result<Scan, ClientError<P::Error>> {
        if !self.connected {
            self.connect().await?;
        }
        if self.decoder.is_within_scan() {
            // A call was cancelled: the first values of this scan are in another slice.
            self.decoder.abandon();
        }
        let mut silence_us = self.config.silence_us;
        let stream = match self.stream {
            Some(stream) => stream,
            None => {
                silence_us = silence_us.max(FIRST_SCAN_US);
                self.start(ranges_mm.len()).await?
            }
        };
        let bytes = self.bytes;
        let until_us = self.clock.now_us() + silence_us;
        loop {
            match self.hear(ranges_mm, None, until_us).await {
                Some(Heard::Scan(head)) if is_of(&head, &stream) => {
                    if let Some(scan) = self.hand_out(&head, &stream) {
                        return Ok(scan);
                    }
                    self.counters.doubted = self.counters.doubted.wrapping_add(1);
                }
                Some(Heard::Scan(_)) => {
                    self.counters.foreign_scans = self.counters.foreign_scans.wrapping_add(1);
                }
                Some(Heard::Reply(request, status))
                    if matches!(request.command, Command::M(..)) && stops(status) =>
                {
                    return Err(ClientError::Stopped { status });
                }
                Some(Heard::Scip11) => return Err(ClientError::Silent),
                Some(_) => {}
                None if self.bytes == bytes => return Err(ClientError::Silent),
                None => return Err(ClientError::Babbling),
            }
        }
    }

    /// Laser on, stream on.
    async fn start(&mut self, room: usize) -> Result<Stream, ClientError<P::Error>> {
        let steps = match (self.config.steps, &self.info) {
            (Some(steps), _) => steps,
            (None, Some(info)) => info.all_steps(),
            (None, None) => return Err(ClientError::NotFound),
        };
        let ranges = steps.values();
        if ranges > room {
            return Err(ClientError::NoRoom { ranges, room });
        }
        let stream = Stream { steps, interval: self.config.interval, scans: 0 };
        self.demand(Command::Bm, REPLY_US).await?;
        self.demand(Command::M(Width::Three, stream), REPLY_US).await?;
        self.stream = Some(stream);
        self.last_stamp_us = None;
        Ok(stream)
    }

    /// `None` where nobody knows well enough when the scan was.
    fn hand_out(&mut self, head: &ScanHead, stream: &Stream) -> Option<Scan> {
        let arrived_us = self.clock.now_us();
        // No stream begins before the sensor has said how it turns.
        let info = self.info.as_ref()?;
        let least_delay_us = info.step_us(head.steps.last)
            + wire_bytes(&head.steps) * 10_000_000 / u64::from(self.rate.max(1));
        let stamped =
            self.sensor_clock.scan(head.stamp_ms, arrived_us, least_delay_us, info.revolution_us())?;
        let (stamp_us, revolution) = (stamped.at_us, (stamped.revolution_us, info.steps_per_revolution));
        if let Some(last_us) = self.last_stamp_us.replace(stamp_us) {
            let period_us = (u64::from(revolution.0) * (u64::from(stream.interval) + 1)).max(1);
            let periods = (stamp_us.saturating_sub(last_us) + period_us / 2) / period_us;
            self.counters.missed = self.counters.missed.wrapping_add(periods.saturating_sub(1) as u32);
        }
        self.counters.scans = self.counters.scans.wrapping_add(1);
        Some(Scan { steps: head.steps, ranges: head.values, stamp_us, arrived_us, revolution })
    }

    /// Finds the bit rate and brings the sensor to an idle SCIP 2.0.
    async fn find(&mut self) -> Result<(), ClientError<P::Error>> {
        let bytes = self.bytes;
        let errors = self.counters.port_errors;
        let mut failure = None;
        for rate in rates(self.choice.rate(), self.rate) {
            match self.probe(rate).await {
                Ok(true) => return Ok(()),
                Ok(false) => {}
                // One rate may be more than the port can do.
                Err(error) => failure = Some(error),
            }
        }
        match failure {
            Some(error) if self.bytes == bytes || self.counters.port_errors == errors => {
                Err(ClientError::Port(error))
            }
            _ => Err(ClientError::NotFound),
        }
    }

    /// Whether a sensor answers at this bit rate; it is idle then.
    async fn probe(&mut self, rate: u32) -> Result<bool, P::Error> {
        self.set_rate(rate)?;
        // Ends whatever half line the sensor has heard from earlier attempts.
        self.send_bytes(b"\n").await?;
        self.drain().await;
        let mut wait_us = REPLY_US;
        let before = self.bytes;
        for attempt in 0..=TRIES {
            if attempt == TRIES && self.bytes == before {
                break;
            }
            let strays = self.decoder.counters().stray_data;
            let mut streams = false;
            self.send(Command::Qt).await?;
            let until_us = self.clock.now_us() + wait_us;
            while let Some(heard) = self.hear(&mut [], None, until_us).await {
                match heard {
                    Heard::Reply(Request { command: Command::Qt, .. }, Status::SCIP11_UNKNOWN)
                    | Heard::Scip11 => return self.leave_scip11().await,
                    Heard::Reply(Request { command: Command::Qt, .. }, Status::UNDEFINED) => {
                        // Clock adjustment knows no `QT`.
                        self.send(Command::Tm2).await?;
                        break;
                    }
                    Heard::Reply(Request { command: Command::Qt, .. }, _) => return Ok(true),
                    _ => streams = true,
                }
            }
            // Two data lines with a right sum do not come about by chance.
            if streams || self.decoder.counters().stray_data.wrapping_sub(strays) >= 2 {
                wait_us = STREAM_US;
            }
        }
        Ok(false)
    }

    async fn leave_scip11(&mut self) -> Result<bool, P::Error> {
        for _ in 0..TRIES {
            self.send(Command::Scip20).await?;
            let until_us = self.clock.now_us() + REPLY_US;
            while let Some(heard) = self.hear(&mut [], None, until_us).await {
                if matches!(heard, Heard::Reply(Request { command: Command::Scip20, .. }, _)) {
                    return Ok(true);
                }
            }
        }
        Ok(false)
    }

    /// Bit rate, identity, clock.
    async fn set_up(&mut self) -> Result<SensorInfo, ClientError<P::Error>> {
        let wanted = self.choice.rate();
        if self.rate != wanted {
            let status = self.ask(Command::Ss(wanted), REPLY_US).await?;
            if status == Status::OK {
                let until_us = self.clock_after(WRITE_US);
                let flushed = select(self.port.flush(), self.clock.wait_until(until_us)).await;
                if let Either::First(Err(error)) = flushed {
                    return Err(ClientError::Port(error));
                }
                self.set_rate(wanted).map_err(ClientError::Port)?;
                self.drain().await;
                self.clock.wait_until(self.clock_after(RATE_US)).await;
            }
        }
        let mut builder = InfoBuilder::default();
        match self.ask_fields(Command::Vv, &mut builder).await {
            // Who made the sensor need not be known to measure.
            Ok(()) | Err(ClientError::Refused { .. } | ClientError::NoReply { .. }) => {}
            Err(error) => return Err(error),
        }
        self.ask_fields(Command::Pp, &mut builder).await?;
        let info = builder.build().map_err(ClientError::BadInfo)?;
        self.sensor_clock = SensorClock::default();
        if self.config.compare_clocks {
            self.compare_clocks().await?;
        }
        Ok(info)
    }

    /// Asks the sensor for its time. A sensor that knows no `TM` is left at that.
    async fn compare_clocks(&mut self) -> Result<(), ClientError<P::Error>> {
        match self.ask(Command::Tm0, REPLY_US).await {
            Ok(status) if status.is_fine_for(&Command::Tm0) => {}
            Ok(_) => return Ok(()),
            // Where the answer was lost it is in clock adjustment all the same.
            Err(ClientError::NoReply { .. }) => {
                return self.send(Command::Tm2).await.map_err(ClientError::Port);
            }
            Err(error) => return Err(error),
        }
        let mut best: Option<(u64, u64, u32)> = None;
        for _ in 0..EXCHANGES {
            let asked_us = self.clock.now_us();
            self.send(Command::Tm1).await.map_err(ClientError::Port)?;
            let until_us = asked_us + REPLY_US;
            while let Some(heard) = self.hear(&mut [], None, until_us).await {
                if let Heard::Time(stamp_ms) = heard {
                    let round_us = self.clock.now_us() - asked_us;
                    if best.is_none_or(|(least_us, ..)| round_us < least_us) {
                        best = Some((round_us, asked_us, stamp_ms));
                    }
                    break;
                }
            }
        }
        if let Some((round_us, asked_us, stamp_ms)) = best {
            self.sensor_clock.exchange(asked_us, asked_us + round_us, stamp_ms);
        }
        self.demand(Command::Tm2, REPLY_US).await
    }

    /// Sends a command until it is answered.
    async fn ask(&mut self, command: Command, wait_us: u64) -> Result<Status, ClientError<P::Error>> {
        for _ in 0..TRIES {
            self.send(command).await.map_err(ClientError::Port)?;
            let until_us = self.clock.now_us() + wait_us;
            while let Some(heard) = self.hear(&mut [], None, until_us).await {
                match heard {
                    Heard::Reply(request, status) if request.command == command => return Ok(status),
                    _ => {}
                }
            }
        }
        Err(ClientError::NoReply { command })
    }

    async fn demand(&mut self, command: Command, wait_us: u64) -> Result<(), ClientError<P::Error>> {
        let status = self.ask(command, wait_us).await?;
        if status.is_fine_for(&command) { Ok(()) } else { Err(ClientError::Refused { command, status }) }
    }

    async fn ask_fields(
        &mut self,
        command: Command,
        builder: &mut InfoBuilder,
    ) -> Result<(), ClientError<P::Error>> {
        for _ in 0..TRIES {
            self.send(command).await.map_err(ClientError::Port)?;
            let until_us = self.clock.now_us() + INFO_US;
            while let Some(heard) = self.hear(&mut [], Some(builder), until_us).await {
                match heard {
                    Heard::Reply(request, Status::OK) if request.command == command => return Ok(()),
                    Heard::Reply(request, status) if request.command == command => {
                        return Err(ClientError::Refused { command, status });
                    }
                    _ => {}
                }
            }
        }
        Err(ClientError::NoReply { command })
    }

    /// The next event before an instant, `None` when it has passed. Fields go to the builder.
    async fn hear(
        &mut self,
        ranges_mm: &mut [u16],
        mut builder: Option<&mut InfoBuilder>,
        until_us: u64,
    ) -> Option<Heard> {
        loop {
            while let Some(bytes) = self.chunk.get(self.held.clone()).filter(|b| !b.is_empty()) {
                let (used, event) = self.decoder.feed(bytes, ranges_mm);
                self.held.start += used;
                match (event, &mut builder) {
                    (None, _) => {}
                    (Some(Event::Field { field, .. }), Some(builder)) => builder.take(field),
                    (Some(Event::Field { .. }), None) => {}
                    (Some(Event::Reply { request, status }), _) => {
                        return Some(Heard::Reply(request, status));
                    }
                    (Some(Event::Time { stamp_ms, .. }), _) => return Some(Heard::Time(stamp_ms)),
                    (Some(Event::Scan(head)), _) => return Some(Heard::Scan(head)),
                    (Some(Event::Scip11), _) => return Some(Heard::Scip11),
                }
            }
            // A line that is never idle must not keep us here.
            if self.clock.now_us() >= until_us {
                return None;
            }
            self.read(until_us).await;
        }
    }

    /// Reads what there is, waiting no longer than until an instant.
    async fn read(&mut self, until_us: u64) {
        self.held = 0..0;
        match select(self.port.read(&mut self.chunk), self.clock.wait_until(until_us)).await {
            Either::First(Ok(n)) if n > 0 => {
                self.held = 0..n.min(CHUNK);
                self.bytes = self.bytes.wrapping_add(n as u32);
                self.errors_in_a_row = 0;
            }
            Either::First(_) => {
                self.counters.port_errors = self.counters.port_errors.wrapping_add(1);
                self.decoder.abandon();
                self.errors_in_a_row += 1;
                // Noise is read over at once. A port that has nothing but errors must not keep us busy.
                if self.errors_in_a_row >= ERRORS {
                    self.errors_in_a_row = 0;
                    let pause_us = self.clock_after(ERROR_US).min(until_us);
                    self.clock.wait_until(pause_us).await;
                }
            }
            Either::Second(()) => {}
        }
    }

    /// Lets go by what is on the line.
    async fn drain(&mut self) {
        let until_us = self.clock_after(DRAIN_US);
        while self.clock.now_us() < until_us {
            self.read(until_us).await;
        }
        self.held = 0..0;
        self.decoder.abandon();
    }

    fn set_rate(&mut self, rate: u32) -> Result<(), P::Error> {
        self.port.set_baud_rate(rate)?;
        self.rate = rate;
        Ok(())
    }

    async fn send(&mut self, command: Command) -> Result<(), P::Error> {
        let line = Request::from(command).line();
        self.send_bytes(&line).await
    }

    /// Gives up after a while: no port may keep us.
    async fn send_bytes(&mut self, bytes: &[u8]) -> Result<(), P::Error> {
        let until_us = self.clock_after(WRITE_US);
        match select(self.port.write_all(bytes), self.clock.wait_until(until_us)).await {
            Either::First(done) => done,
            Either::Second(()) => Ok(()),
        }
    }

    fn clock_after(&self, pause_us: u64) -> u64 {
        self.clock.now_us().saturating_add(pause_us)
    }
}

/// Whether an error speaks against the bit rate at which it came about: the sensor is there and is not understood.
fn is_of_the_rate<E>(error: &ClientError<E>) -> bool {
    matches!(error, ClientError::NoReply { .. } | ClientError::Babbling)
}

/// Bit rates in the order in which they are tried, each once.
fn rates(wanted: u32, last: u32) -> impl Iterator<Item = u32> {
    let others = RATES.into_iter().filter(move |&r| r != wanted && r != last);
    [wanted, last].into_iter().take(if wanted == last { 1 } else { 2 }).chain(others)
}

/// Whether the scan is of the steps that were asked for.
fn is_of(head: &ScanHead, stream: &Stream) -> bool {
    matches!(head.request.command, Command::M(Width::Three, s) if s.steps == stream.steps)
}

/// Statuses 21 to 97 end a stream.
fn stops(status: Status) -> bool {
    ("21".."98").contains(&status.as_str())
}

/// Bytes of a scan by `MD`.
fn wire_bytes(steps: &Steps) -> u64 {
    let chars = steps.values() * 3;
    // Echo, status, stamp, the data with sums and line ends, the empty line.
    (16 + 4 + 6 + chars + 2 * chars.div_ceil(DATA_CHARS) + 1) as u64
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_bit_rate_is_tried_once() {
        let all = |wanted, last| rates(wanted, last).collect::<std::vec::Vec<_>>();
        assert_eq!(all(500_000, 500_000), [500_000, 19_200, 57_600, 115_200, 250_000, 750_000]);
        assert_eq!(all(500_000, 19_200), [500_000, 19_200, 57_600, 115_200, 250_000, 750_000]);
        assert_eq!(all(38_400, 38_400), [38_400, 19_200, 57_600, 115_200, 250_000, 500_000, 750_000]);
    }

    #[test]
    fn a_scan_s_bytes_are_counted_as_they_are() {
        assert_eq!(wire_bytes(&Steps { first: 44, last: 725, cluster: 1 }), 2137);
        assert_eq!(wire_bytes(&Steps { first: 44, last: 725, cluster: 2 }), 1082);
    }

    #[test]
    fn statuses_that_stop_a_stream() {
        for (chars, expected) in
            [(b"21", true), (b"49", true), (b"97", true), (b"98", false), (b"00", false), (b"99", false)]
        {
            assert_eq!(stops(Status::new(*chars)), expected, "{chars:?}");
        }
        assert!(!stops(Status::UNDEFINED));
    }
}
