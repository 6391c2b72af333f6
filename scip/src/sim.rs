//! A simulated URG-04LX: bytes in, bytes out at the line's true rate, on any clock, with faults on request.
//!
//! It is a state machine. Whoever drives it tells it the time: [`receive`](SimulatedUrg::receive) takes a byte the host
//! has sent, [`advance`](SimulatedUrg::advance) lets the scanner turn, [`transmit`](SimulatedUrg::transmit) gives each byte
//! when its stop bit has passed, and [`next_us`](SimulatedUrg::next_us) says when something happens next. It powers up
//! as the real one does, in SCIP 1.1 at 19 200 bit/s.

use core::fmt::Write as _;

use heapless::{Deque, String, Vec};
use rand_core::Rng;
use rand_pcg::Pcg32;

use crate::command::{Command, Request, Steps, Stream, Width};
use crate::rate::RATES;
use crate::reply::{Status, Writer};

mod quirks;

pub use quirks::{Identity, Quirks};

/// Values of a full scan.
pub const BEAMS: usize = 682;
/// Steps 44 to 725, each its own.
pub const STEPS: Steps = Steps { first: 44, last: 725, cluster: 1 };
const STEPS_PER_REVOLUTION: u64 = 1024;
const REVOLUTION_US: u64 = 100_000;
/// Bit rate after power-up.
pub const POWER_UP_RATE: u32 = 19_200;

/// From power-up to the first command that is heard.
const BOOT_US: u64 = 300_000;
/// From a command's last byte to its reply's first.
const REPLY_DELAY_US: u64 = 1_000;
/// From a scan's last beam to its reply's first byte.
const SCAN_DELAY_US: u64 = 3_000;
/// Room for what waits to be sent: a scan and replies.
const QUEUE: usize = 4096;
/// Bytes that are spoilt where the line is not good for the bit rate.
const SPOILT_ONE_IN: u32 = 25;
/// Longest line that is heard.
const HEARD: usize = 48;

/// What goes wrong. Rates are one in so many, zero for never; all are drawn from the seed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Faults {
    /// Bytes sent that have a bit flipped.
    pub garbled_one_in: u32,
    /// Bytes sent that are lost.
    pub lost_one_in: u32,
    /// Bytes sent that come twice.
    pub doubled_one_in: u32,
    /// Scans one of whose lines has a wrong sum.
    pub wrong_sum_one_in: u32,
    /// Scans that are cut off somewhere.
    pub cut_one_in: u32,
    /// So many `QT` are not answered.
    pub ignored_qt: u32,
    /// `BM` answers a laser fault.
    pub laser_fault: bool,
    /// The stream ends with this status in place of the next scan; taken once.
    pub stop_with: Option<Status>,
    /// In place of scans, bytes without sense fill the line.
    pub babble: bool,
    /// Nothing is heard or sent, as if unplugged but powered.
    pub deaf: bool,
    /// Above this bit rate one byte in 25 is spoilt, either way: a level shifter or a cable that is not good for more. Zero for
    /// any.
    pub good_to: u32,
    /// How fast the sensor's quartz is, parts per million.
    pub drift_ppm: i32,
    /// How much longer a revolution takes than it should, parts per million.
    pub slow_ppm: i32,
}

/// How a sensor may be found.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Mode {
    /// As after power-up.
    Scip11,
    /// SCIP 2.0, laser on, no stream.
    Idle,
    /// SCIP 2.0, laser off.
    LaserOff,
    /// Full scans by `MD`, without end.
    Streaming,
    /// Clock adjustment, after `TM0`.
    ClockAdjustment,
}

/// A byte on the line.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Sent {
    /// The byte.
    pub byte: u8,
    /// At which bit rate; a host that listens at another hears something else.
    pub baud_rate: u32,
}

/// A stream of scans that is under way.
#[derive(Clone, Copy, Debug)]
struct Running {
    request: Request,
    width: Width,
    stream: Stream,
    /// Revolutions until the next scan is sent.
    wait: u8,
}

/// The sensor.
#[derive(Clone, Debug)]
pub struct SimulatedUrg {
    /// What goes wrong from now on.
    pub faults: Faults,
    /// How it departs from the specification.
    pub quirks: Quirks,
    rng: Pcg32,
    scip11: bool,
    clock_adjustment: bool,
    laser: bool,
    high_sensitivity: bool,
    speed: u8,
    rate: u32,
    /// Taken when all that waits has been sent.
    next_rate: Option<u32>,
    running: Option<Running>,
    /// A `GD` or `GS` that waits for the next scan.
    asked: Option<Request>,
    heard: Vec<u8, HEARD>,
    deaf_until_us: u64,
    queue: Deque<u8, QUEUE>,
    /// When the byte in front of the queue begins, nanoseconds.
    begin_ns: u64,
    doubled: Option<Sent>,
    /// When the sensor's timer was at zero.
    timer_zero_us: u64,
    /// When the revolution that is measured began.
    revolution_us: u64,
    ranges: [u16; BEAMS],
}

impl SimulatedUrg {
    /// Powered up at that instant. The seed is that of its faults.
    pub fn new(now_us: u64, seed: u64) -> Self {
        Self {
            faults: Faults::default(),
            quirks: Quirks::default(),
            rng: Pcg32::new(seed, 0x5C1),
            scip11: true,
            clock_adjustment: false,
            laser: false,
            high_sensitivity: false,
            speed: 0,
            rate: POWER_UP_RATE,
            next_rate: None,
            running: None,
            asked: None,
            heard: Vec::new(),
            deaf_until_us: now_us + BOOT_US,
            queue: Deque::new(),
            begin_ns: 0,
            doubled: None,
            timer_zero_us: now_us,
            revolution_us: now_us + BOOT_US,
            ranges: [0; BEAMS],
        }
    }

    /// As it may be found by a host that starts later: at that bit rate, in that mode, long since powered up.
    pub fn found(now_us: u64, seed: u64, baud_rate: u32, mode: Mode) -> Self {
        let mut this = Self::new(now_us, seed);
        this.rate = baud_rate;
        this.scip11 = mode == Mode::Scip11;
        this.laser = matches!(mode, Mode::Idle | Mode::Streaming);
        this.clock_adjustment = mode == Mode::ClockAdjustment;
        this.deaf_until_us = now_us;
        this.revolution_us = now_us;
        if mode == Mode::Streaming {
            let stream = Stream { steps: STEPS, interval: 0, scans: 0 };
            let request = Command::M(Width::Three, stream).into();
            this.running = Some(Running { request, width: Width::Three, stream, wait: 0 });
        }
        this
    }

    /// Power off and on. Faults and quirks stay.
    pub fn power_cycle(&mut self, now_us: u64) {
        let (faults, quirks, rng) = (self.faults, self.quirks, self.rng.clone());
        *self = Self { faults, quirks, rng, ..Self::new(now_us, 0) };
    }

    /// The bit rate it sends and hears at.
    pub fn baud_rate(&self) -> u32 {
        self.rate
    }

    /// Whether the laser is on.
    pub fn laser_is_on(&self) -> bool {
        self.laser
    }

    /// Whether it streams scans.
    pub fn is_streaming(&self) -> bool {
        self.running.is_some()
    }

    /// Sets the timer, so that its next stamps are near this, milliseconds.
    pub fn set_timer_ms(&mut self, now_us: u64, timer_ms: u32) {
        self.timer_zero_us = now_us.wrapping_sub(u64::from(timer_ms) * 1000);
    }

    /// Sets the timer ahead, or back.
    pub fn shift_timer_ms(&mut self, by_ms: i64) {
        self.timer_zero_us = self.timer_zero_us.wrapping_add_signed(-by_ms * 1000);
    }

    /// One revolution now, microseconds.
    pub fn revolution_us(&self) -> u64 {
        self.period_us()
    }

    /// Takes a byte that the host has sent at that bit rate. At another than the sensor's it is heard as something else.
    pub fn receive(&mut self, byte: u8, baud_rate: u32, now_us: u64) {
        if self.faults.deaf || now_us < self.deaf_until_us {
            return;
        }
        let spoilt = self.is_too_fast() && self.strikes(SPOILT_ONE_IN);
        let heard = rates_agree(baud_rate, self.rate) && !spoilt;
        let byte = if heard { byte } else { self.rng.next_u32() as u8 | 0x80 };
        match byte {
            b'\n' | b'\r' => {
                let line = core::mem::take(&mut self.heard);
                if !line.is_empty() || byte == b'\n' {
                    self.answer(&line, now_us);
                }
            }
            // What is longer than any command stays wrong.
            _ => {
                let _ = self.heard.push(byte);
            }
        }
    }

    /// Lets the scanner turn until now. For each scan that is sent, `measure` is given the instant of step 0 and the
    /// ranges to fill, millimetres or codes, of steps 44 to 725.
    pub fn advance(&mut self, now_us: u64, measure: &mut dyn FnMut(u64, &mut [u16])) {
        while self.sweep_end_us() + SCAN_DELAY_US <= now_us {
            let begin_us = self.revolution_us;
            let ready_us = self.sweep_end_us() + SCAN_DELAY_US;
            self.revolution_us += self.period_us();
            if !self.laser || now_us < self.deaf_until_us {
                continue;
            }
            let due = self.is_due();
            if due || self.asked.is_some() {
                measure(begin_us, &mut self.ranges);
            }
            if let Some(request) = self.asked.take() {
                self.send_scan(&request, Status::OK, begin_us, ready_us);
            }
            if due {
                self.send_next(begin_us, ready_us);
            }
        }
        if self.faults.babble && self.queue.is_empty() && !self.faults.deaf {
            self.start_sending(now_us);
            for _ in 0..64 {
                let byte = self.rng.next_u32() as u8;
                self.push(byte);
            }
        }
    }

    /// The next byte whose stop bit has passed by now, if any.
    pub fn transmit(&mut self, now_us: u64) -> Option<Sent> {
        if let Some(again) = self.doubled.take() {
            return Some(again);
        }
        loop {
            let end_ns = self.begin_ns + self.byte_ns();
            if self.queue.is_empty() || end_ns > now_us.saturating_mul(1000) {
                return None;
            }
            let mut byte = self.queue.pop_front()?;
            let baud_rate = self.rate;
            self.begin_ns = end_ns;
            if self.queue.is_empty()
                && let Some(rate) = self.next_rate.take()
            {
                self.rate = rate;
            }
            if self.faults.deaf || self.strikes(self.faults.lost_one_in) {
                continue;
            }
            let one_in = if self.is_too_fast() { SPOILT_ONE_IN } else { self.faults.garbled_one_in };
            if self.strikes(one_in) {
                byte ^= 1 << (self.rng.next_u32() % 8);
            }
            let sent = Sent { byte, baud_rate };
            if self.strikes(self.faults.doubled_one_in) {
                self.doubled = Some(sent);
            }
            return Some(sent);
        }
    }

    /// When something happens next: a byte has been sent, or a sweep has ended.
    pub fn next_us(&self) -> u64 {
        let sweep_us = self.sweep_end_us() + SCAN_DELAY_US;
        if self.doubled.is_some() {
            return self.begin_ns.div_ceil(1000);
        }
        if self.queue.is_empty() {
            return sweep_us;
        }
        sweep_us.min((self.begin_ns + self.byte_ns()).div_ceil(1000))
    }

    fn answer(&mut self, line: &[u8], now_us: u64) {
        if line.is_empty() {
            // A lone line end: nothing is asked.
            return;
        }
        let request = match Request::parse(line) {
            Ok(request) => request,
            Err(_) if self.scip11 => {
                return self.reply(now_us, |w| w.head_of_bad(line, Status::SCIP11_UNKNOWN).end());
            }
            Err(bad) => return self.reply(now_us, |w| w.head_of_bad(line, Status::of(bad)).end()),
        };
        let command = request.command;
        if command == Command::Qt && self.faults.ignored_qt > 0 {
            self.faults.ignored_qt -= 1;
            return;
        }
        if self.scip11 && command != Command::Scip20 {
            return self.reply(now_us, |w| w.head(&request, Status::SCIP11_UNKNOWN).end());
        }
        match (command, self.quirks.identity) {
            (Command::Vv, Identity::Silent) => return,
            (Command::Vv, Identity::Refused) => {
                return self.reply(now_us, |w| w.head(&request, Status::UNDEFINED).end());
            }
            (Command::Tm0 | Command::Tm1 | Command::Tm2, _) if self.quirks.knows_no_clock => {
                return self.reply(now_us, |w| w.head(&request, Status::UNDEFINED).end());
            }
            _ => {}
        }
        if self.clock_adjustment && !matches!(command, Command::Tm0 | Command::Tm1 | Command::Tm2) {
            return self.reply(now_us, |w| w.head(&request, Status::UNDEFINED).end());
        }
        let status = match command {
            Command::Scip20 => {
                self.scip11 = false;
                Status::SCIP20
            }
            Command::Bm => self.turn_laser_on(),
            Command::Qt => {
                self.stop();
                Status::OK
            }
            Command::Rs => {
                self.stop();
                (self.speed, self.next_rate, self.timer_zero_us) = (0, Some(POWER_UP_RATE), now_us);
                Status::OK
            }
            Command::Ss(rate) => self.change_rate(rate),
            Command::M(width, stream) => self.start(request, width, stream),
            Command::G(_, steps) => match range_status(&steps) {
                Status::OK if self.laser => {
                    self.asked = Some(request);
                    return;
                }
                Status::OK => Status::LASER_OFF,
                bad => bad,
            },
            Command::Tm0 => self.adjust_clock(true, *b"02"),
            Command::Tm2 => self.adjust_clock(false, *b"03"),
            Command::Tm1 if self.clock_adjustment => {
                let stamp_ms = self.timer_ms(now_us);
                return self.reply(now_us, |w| w.head(&request, Status::OK).stamp(stamp_ms).end());
            }
            Command::Tm1 => Status::new(*b"04"),
            Command::Cr(speed) => self.change_speed(speed),
            Command::Hs(on) if on == self.high_sensitivity => Status::new(*b"02"),
            Command::Hs(on) => {
                self.high_sensitivity = on;
                Status::OK
            }
            Command::Vv | Command::Pp | Command::Ii => {
                self.running = None;
                return self.tell(&request, now_us);
            }
        };
        self.reply(now_us, |w| w.head(&request, status).end());
    }

    fn turn_laser_on(&mut self) -> Status {
        if self.faults.laser_fault {
            return Status::new(*b"01");
        }
        if core::mem::replace(&mut self.laser, true) { Status::new(*b"02") } else { Status::OK }
    }

    fn stop(&mut self) {
        self.laser = false;
        self.running = None;
        self.asked = None;
    }

    fn change_rate(&mut self, rate: u32) -> Status {
        match rate {
            _ if rate == self.rate => Status::new(*b"03"),
            _ if RATES.contains(&rate) => {
                self.next_rate = Some(rate);
                Status::OK
            }
            // Hokuyo makes sensors that know it.
            38_400 => Status::new(*b"04"),
            _ => Status::new(*b"02"),
        }
    }

    fn change_speed(&mut self, speed: u8) -> Status {
        let wanted = if speed == 99 { 0 } else { speed };
        match wanted {
            _ if wanted > 10 => Status::new(*b"02"),
            _ if wanted == self.speed => Status::new(*b"03"),
            _ => {
                self.speed = wanted;
                Status::OK
            }
        }
    }

    fn adjust_clock(&mut self, on: bool, already: [u8; 2]) -> Status {
        if self.clock_adjustment == on {
            return Status::new(already);
        }
        self.clock_adjustment = on;
        self.stop();
        Status::OK
    }

    fn start(&mut self, request: Request, width: Width, stream: Stream) -> Status {
        let status = range_status(&stream.steps);
        if status == Status::OK && self.faults.laser_fault {
            return Status::new(*b"50");
        }
        if status == Status::OK {
            self.laser = true;
            self.running = Some(Running { request, width, stream, wait: 0 });
        }
        status
    }

    /// The fields of `VV`, `PP` and `II`.
    fn tell(&mut self, request: &Request, now_us: u64) {
        let mut rate = String::<48>::new();
        let mut time = String::<8>::new();
        // Both have room for the longest number.
        let _ = write!(rate, "{}[bps]<-Default setting by user", self.rate);
        let _ = write!(time, "{:06X}", self.timer_ms(now_us));
        let state = [
            quirks::MODEL,
            ("LASR", if self.laser { "ON" } else { "OFF" }),
            ("SCSP", "Initial(600[rpm])<-Default setting by user"),
            ("MESM", "IDLE"),
            ("SBPS", &rate),
            ("TIME", &time),
            ("STAT", "Sensor works well."),
        ];
        let quirks = self.quirks;
        let geometry = quirks.geometry();
        let (fields, skipped): (&[(&str, &str)], usize) = match request.command {
            Command::Vv => (&quirks::IDENTITY, 0),
            Command::Pp => (&geometry, quirks.geometry_skipped()),
            _ => (&state, 0),
        };
        self.reply(now_us, |w| {
            w.head(request, Status::OK);
            for (key, value) in fields.iter().skip(skipped) {
                w.field_summed(key, value, quirks.field_sum);
            }
            w.end();
        });
        if request.command == Command::Vv && quirks.wrong_sum {
            self.spoil_last_sum();
        }
    }

    /// Makes the sum of the last line of a reply that was just written a wrong one.
    fn spoil_last_sum(&mut self) {
        let from_end = 2 * (1 + usize::from(self.quirks.cr_lf)) + 1;
        let at = self.queue.len().checked_sub(from_end);
        if let Some(sum) = at.and_then(|at| self.queue.iter_mut().nth(at)) {
            *sum = if *sum == b'I' { b'J' } else { b'I' };
        }
    }

    /// Whether the scan of this revolution belongs to the stream; counts down its interval.
    fn is_due(&mut self) -> bool {
        match &mut self.running {
            None => false,
            Some(running) if running.wait > 0 => {
                running.wait -= 1;
                false
            }
            // The line is still busy with the last one: this one is left out, as the sensor does.
            Some(_) => self.queue.is_empty() && !self.faults.babble,
        }
    }

    fn send_next(&mut self, begin_us: u64, ready_us: u64) {
        let Some(mut running) = self.running else { return };
        if let Some(status) = self.faults.stop_with.take() {
            self.stop();
            return self.reply(ready_us, |w| w.head(&running.request, status).end());
        }
        let last = running.stream.scans == 1;
        running.stream.scans = running.stream.scans.saturating_sub(1);
        running.wait = running.stream.interval;
        let request = Request { command: Command::M(running.width, running.stream), ..running.request };
        self.send_scan(&request, Status::SCAN, begin_us, ready_us);
        self.running = if last { None } else { Some(running) };
    }

    fn send_scan(&mut self, request: &Request, status: Status, begin_us: u64, ready_us: u64) {
        let (width, steps) = match request.command {
            Command::M(width, stream) => (width, stream.steps),
            Command::G(width, steps) => (width, steps),
            _ => return,
        };
        // The echo, status and stamp are never hit by the faults of scans.
        const HEAD: usize = 26;
        let stamp_ms = self.timer_ms(begin_us);
        let before = self.queue.len();
        let first = usize::from(steps.first - STEPS.first.min(steps.first));
        let count = usize::from(steps.last) + 1 - usize::from(steps.first);
        let ranges = self.ranges;
        let values = ranges
            .get(first..(first + count).min(BEAMS))
            .unwrap_or(&[])
            .chunks(usize::from(steps.cluster.max(1)))
            .map(|group| u32::from(group.iter().copied().min().unwrap_or(0)));
        self.reply(ready_us.saturating_sub(REPLY_DELAY_US), |w| {
            w.head(request, status).stamp(stamp_ms).data(values, width).end();
        });
        let length = self.queue.len() - before;
        if length > HEAD && self.strikes(self.faults.wrong_sum_one_in) {
            let at = before + HEAD + self.rng.next_u32() as usize % (length - HEAD - 2);
            if let Some(byte) = self.queue.iter_mut().nth(at).filter(|b| **b != b'\n') {
                *byte = if *byte == b'0' { b'1' } else { *byte - 1 };
            }
        }
        if length > HEAD && self.strikes(self.faults.cut_one_in) {
            for _ in 0..self.rng.next_u32() as usize % (length - HEAD) {
                self.queue.pop_back();
            }
        }
    }

    fn reply(&mut self, now_us: u64, write: impl FnOnce(&mut Writer<&mut dyn FnMut(u8)>)) {
        self.start_sending(now_us + REPLY_DELAY_US);
        let (queue, cr_lf) = (&mut self.queue, self.quirks.cr_lf);
        // More waits than any host that listens lets wait: the rest is lost, as in the sensor.
        let mut push = |byte| {
            if cr_lf && byte == b'\n' {
                let _ = queue.push_back(b'\r');
            }
            let _ = queue.push_back(byte);
        };
        write(&mut Writer::new(&mut push));
    }

    fn push(&mut self, byte: u8) {
        let _ = self.queue.push_back(byte);
    }

    fn start_sending(&mut self, at_us: u64) {
        if self.queue.is_empty() {
            self.begin_ns = self.begin_ns.max(at_us * 1000);
        }
    }

    fn is_too_fast(&self) -> bool {
        self.faults.good_to > 0 && self.rate > self.faults.good_to
    }

    fn strikes(&mut self, one_in: u32) -> bool {
        one_in > 0 && self.rng.next_u32().is_multiple_of(one_in)
    }

    fn byte_ns(&self) -> u64 {
        10_000_000_000 / u64::from(self.rate.max(1))
    }

    /// A revolution at this speed: each level is 1 % slower.
    fn period_us(&self) -> u64 {
        let set = REVOLUTION_US * 100 / (100 - u64::from(self.speed));
        set.saturating_add_signed(set as i64 * i64::from(self.faults.slow_ppm) / 1_000_000)
    }

    fn sweep_end_us(&self) -> u64 {
        self.revolution_us + self.period_us() * u64::from(STEPS.last) / STEPS_PER_REVOLUTION
    }

    fn timer_ms(&self, at_us: u64) -> u32 {
        let us = at_us.wrapping_sub(self.timer_zero_us) as i64;
        let drift = i128::from(us) * i128::from(self.faults.drift_ppm) / 1_000_000;
        (us + drift as i64).div_euclid(1000) as u32 & 0xFF_FFFF
    }
}

/// Whether two ends of a line with these bit rates understand each other: within 2 %, as dividers of a clock are.
pub fn rates_agree(one: u32, other: u32) -> bool {
    u64::from(one.abs_diff(other)) * 50 < u64::from(other)
}

/// Whether the sensor has these steps.
fn range_status(steps: &Steps) -> Status {
    if steps.last > STEPS.last {
        Status::new(*b"04")
    } else if steps.last < steps.first || steps.first < STEPS.first {
        Status::new(*b"05")
    } else {
        Status::OK
    }
}
