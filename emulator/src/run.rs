//! A run: the firmware in the board, the world stepped beside it, faults on time, the log and the record taken as they come.

use std::collections::VecDeque;
use std::path::Path;
use std::sync::{Arc, Mutex};

use anyhow::{Context, anyhow};
use lineslam::robot::Robot;
use lineslam::sim::SimConfig;
use lineslam::sim::world::World;
use rand_core::SeedableRng;
use rand_pcg::Pcg64;
use rigless::emulator::{self, AccessKind, Driver, Host, Settled, Start, Stop};
use rigless::image::Image;
use rigless::session::Session;
use rigless::time::VirtualNanos;

use crate::board::{
    CYCLES_PER_INSTRUCTION, DBGMCU_APB1_FZ, EXTI_IMR, FLASH_ACCELERATED, FLASH_ACR, Nucleo, RCC_CR, Shared,
    TIME_DRIVER_EGR, URG_BRR,
};
use crate::board_fault::{Around, BoardFault};
use crate::cycles::{Cause, Program};
use crate::fault::Fault;
use crate::firmware::{Log, LogLine, Symbols};
use crate::paced::Pace;
use crate::record::{Entry, Recorder};
use crate::room::{Building, Edge, Room, TrueScan};
use crate::vcp::{FarEnd, Nobody};

/// The world is looked at this often, microseconds.
const GRID_US: u64 = 1000;
/// The base has stood for so long when the run ends, microseconds.
const REST_US: u64 = 1_500_000;
/// The button is pressed for so long, microseconds.
const PRESS_US: u64 = 200_000;
/// The map must have been printed by then, microseconds.
const PRINT_US: u64 = 30_000_000;
/// Lines of the log that are shown with an error.
const LAST_LINES: usize = 20;
/// A byte that nobody takes is lost after this, microseconds.
const STALE_US: u64 = 2_000;
/// A run that is held after its drive keeps no more than so many entries of the record: those of an hour.
const HELD_ENTRIES: usize = 36_000;
/// When it has more, it goes on with these.
const KEPT_ENTRIES: usize = 1_000;

/// What to run.
pub struct Plan<'a> {
    /// The firmware's ELF.
    pub elf: &'a Path,
    /// The building.
    pub world: &'a World,
    /// The robot that the firmware was built for.
    pub robot: &'a Robot,
    /// Errors of base and scanner.
    pub sim: SimConfig,
    /// Of all noise.
    pub seed: u64,
    /// Length of the run, virtual seconds; without, it ends a while after the path.
    pub seconds: Option<u64>,
    /// What goes wrong.
    pub faults: Vec<Fault>,
    /// Whether each instruction takes as many cycles as the model of the core says, and not as many as all others.
    pub cycles: bool,
}

/// What there is to see while it runs.
#[derive(Clone, Debug)]
pub enum Seen {
    /// A line of the firmware's log.
    Line(LogLine),
    /// The firmware has taken in a scan.
    Progress(Progress),
    /// The path is driven, or the time is up.
    Over,
}

/// How far a run has come.
#[derive(Clone, Copy, Debug)]
pub struct Progress {
    /// Virtual time, microseconds.
    pub now_us: u64,
    /// Share of the path that is driven.
    pub driven: f64,
    /// Distance of the firmware's pose from the truth, metres.
    pub error_m: f64,
    /// Segments of the map.
    pub segments: u32,
    /// What the last scan took on the microcontroller, microseconds.
    pub took_us: u32,
}

/// What a run leaves.
pub struct Outcome {
    /// The firmware's record.
    pub entries: Vec<Entry>,
    /// Its log.
    pub log: Vec<LogLine>,
    /// Scans as the sensor measured and sent them.
    pub scans: Vec<TrueScan>,
    /// What came over the virtual COM port.
    pub vcp: Vec<u8>,
    /// How many bytes of it there were when a frame's last had come, and when that was, virtual microseconds.
    pub frames: Vec<(usize, u64)>,
    /// When the last byte of each scan had come over the sensor's line, virtual microseconds.
    pub replies_us: Vec<u64>,
    /// Resets, by what caused them, with their virtual time in microseconds.
    pub resets: Vec<(u64, String)>,
    /// Times that the LED was switched.
    pub led_changes: u32,
    /// Whether the flash's accelerator was on at the end.
    pub flash_accelerated: bool,
    /// The debug unit's bits for timers and watchdogs that stand while a debugger holds the core.
    pub frozen: u64,
    /// Bytes of the firmware's variables.
    pub static_bytes: u64,
    /// Instructions executed.
    pub instructions: u64,
    /// By the model, or assumed.
    pub cycles_per_instruction: f64,
    /// Virtual time at the end, microseconds.
    pub end_us: u64,
    /// Whether the path was driven to its end.
    pub arrived: bool,
}

/// Runs the plan. `see` is shown the log as it comes, and how far the run is.
pub fn run(plan: &Plan<'_>, see: impl FnMut(Seen) + Send + 'static) -> anyhow::Result<Outcome> {
    run_with(plan, Nobody, see)
}

/// The same with somebody at the other end of the virtual COM port.
pub fn run_with(
    plan: &Plan<'_>,
    vcp: impl FarEnd + 'static,
    see: impl FnMut(Seen) + Send + 'static,
) -> anyhow::Result<Outcome> {
    let elf = std::fs::read(plan.elf).with_context(|| plan.elf.display().to_string())?;
    let symbols = Symbols::read(&elf, plan.elf)?;
    let building = Building::new(plan.world, plan.robot, &plan.sim, plan.seed)?;
    let mut room = Room::new(building, plan.seed);
    for fault in &plan.faults {
        fault.prepare(&mut room, plan.seed);
    }
    let shared: Shared = Arc::new(Mutex::new(room));
    let pace = plan.cycles.then(|| Program::read(&elf, plan.elf).map(Pace::new)).transpose()?;
    let mut board = Nucleo::new(shared.clone(), pace.clone())?;
    for fault in &plan.faults {
        fault.prepare_board(&mut board, &shared, plan.seed);
    }
    let session = Session::new(Box::new(board), 0, VirtualNanos(GRID_US * 1000))?;
    let driver = Director {
        shared,
        log: Log::new(&elf, plan.elf, symbols.rtt)?,
        recorder: Recorder::new(symbols.trace),
        lines: Vec::new(),
        edges: VecDeque::new(),
        grid_us: 0,
        faults: plan.faults.clone(),
        limit_us: plan.seconds.map(|s| s * 1_000_000),
        rested_us: None,
        pressed_us: None,
        map_printed: false,
        is_over: false,
        resets: 0,
        led: false,
        led_changes: 0,
        flash_accelerated: false,
        frozen: 0,
        board_faults: plan.faults.iter().filter_map(Fault::of_board).collect(),
        order: symbols.order,
        rng: Pcg64::seed_from_u64(plan.seed),
        edges_seen: 0,
        vcp: Box::new(vcp),
        see: Box::new(see),
        failure: None,
    };
    let images = [Image::new(plan.elf, elf, None)?];
    let mut finished = emulator::run(session, &Start::new(&images), driver)?;
    if let Some(error) = finished.driver.failure.take() {
        let log = &finished.driver.lines;
        let last = log.iter().skip(log.len().saturating_sub(LAST_LINES)).map(|l| format!("\n{l}"));
        return Err(error.context(format!("the firmware's log ends with:{}", last.collect::<String>())));
    }
    if let Some(error) = finished.session.take_error() {
        return Err(error.into());
    }
    if let Some(pace) = &pace {
        pace.tally.check_known()?;
    }
    let stop = finished.stop.context("the run ended by itself")?;
    let resets =
        finished.session.resets().iter().map(|r| (r.at.0 / 1000, format!("{:?}", r.cause))).collect();
    let director = finished.driver;
    let mut room = director.shared.lock().map_err(|_| anyhow!("the simulation panicked"))?;
    Ok(Outcome {
        entries: director.recorder.entries,
        log: director.lines,
        scans: std::mem::take(&mut room.building.scans),
        vcp: std::mem::take(&mut room.vcp.from_board),
        frames: std::mem::take(&mut room.vcp.frames),
        replies_us: std::mem::take(&mut room.replies_us),
        resets,
        led_changes: director.led_changes,
        flash_accelerated: director.flash_accelerated,
        frozen: director.frozen,
        static_bytes: symbols.static_bytes,
        instructions: pace.as_ref().map_or(stop.instruction_count, |p| p.tally.of(Cause::Instructions)),
        cycles_per_instruction: pace.map_or(CYCLES_PER_INSTRUCTION, |p| p.tally.cycles_per_instruction()),
        end_us: stop.at.0 / 1000,
        arrived: room.building.arrived(),
    })
}

/// Drives the run: everything that happens on virtual time outside the microcontroller.
struct Director {
    shared: Shared,
    log: Log,
    recorder: Recorder,
    lines: Vec<LogLine>,
    edges: VecDeque<Edge>,
    grid_us: u64,
    faults: Vec<Fault>,
    limit_us: Option<u64>,
    rested_us: Option<u64>,
    pressed_us: Option<u64>,
    map_printed: bool,
    is_over: bool,
    resets: usize,
    led: bool,
    led_changes: u32,
    flash_accelerated: bool,
    frozen: u64,
    board_faults: Vec<BoardFault>,
    order: Option<u64>,
    rng: Pcg64,
    edges_seen: usize,
    vcp: Box<dyn FarEnd>,
    see: Box<dyn FnMut(Seen) + Send>,
    failure: Option<anyhow::Error>,
}

impl Driver<Nucleo> for Director {
    fn on_settled(&mut self, session: &mut Session<Nucleo>, _: &mut dyn Host, settled: Settled) {
        let Settled::Access { access, .. } = settled else { return };
        if access.kind != AccessKind::Write {
            return;
        }
        match access.address {
            TIME_DRIVER_EGR => session.board_mut().clear_time_driver_flags(),
            URG_BRR => {
                let rate = session.board_mut().urg_baud_rate(access.value);
                if let Ok(mut room) = self.shared.lock() {
                    room.host_rate = rate;
                }
            }
            RCC_CR => session.board_mut().hold_hse(access.virtual_time),
            DBGMCU_APB1_FZ => self.frozen = access.value,
            address if address == EXTI_IMR.0 => {
                session.board_mut().pvd_armed = access.value & EXTI_IMR.1 != 0;
            }
            FLASH_ACR => self.flash_accelerated = access.value & FLASH_ACCELERATED == FLASH_ACCELERATED,
            _ => {}
        }
    }

    fn on_stop(
        &mut self,
        session: &mut Session<Nucleo>,
        stop: Stop,
        host: &mut dyn Host,
    ) -> Option<VirtualNanos> {
        match self.advance(session, stop, host) {
            Ok(next) => next,
            Err(error) => {
                self.failure = Some(error);
                None
            }
        }
    }
}

impl Director {
    fn advance(
        &mut self,
        session: &mut Session<Nucleo>,
        stop: Stop,
        host: &mut dyn Host,
    ) -> anyhow::Result<Option<VirtualNanos>> {
        let now_ns = stop.at.0;
        while let Some(&edge) = self.edges.front().filter(|e| e.at_ns <= now_ns) {
            self.edges.pop_front();
            session.board_mut().drive_encoder(stop.at, edge.side, edge.levels);
        }
        if now_ns / 1000 >= self.grid_us {
            self.grid_us = now_ns / 1000 / GRID_US * GRID_US + GRID_US;
            if self.on_grid(session, stop, host)? {
                return Ok(None);
            }
        }
        let sensor_us = self.room(|room| room.urg.next_us())?;
        let edge_ns = self.edges.front().map_or(u64::MAX, |e| e.at_ns);
        let sensor_ns = if sensor_us * 1000 > now_ns { sensor_us * 1000 } else { u64::MAX };
        Ok(Some(VirtualNanos((self.grid_us * 1000).min(edge_ns).min(sensor_ns).max(now_ns + 1))))
    }

    fn room<R>(&self, use_it: impl FnOnce(&mut Room) -> R) -> anyhow::Result<R> {
        let mut room = self.shared.lock().map_err(|_| anyhow!("the simulation panicked"))?;
        Ok(use_it(&mut room))
    }

    /// Once a millisecond. True at the end of the run.
    fn on_grid(
        &mut self,
        session: &mut Session<Nucleo>,
        stop: Stop,
        host: &mut dyn Host,
    ) -> anyhow::Result<bool> {
        let now_us = stop.at.0 / 1000;
        let before = self.lines.len();
        if !self.board_faults.iter().any(|fault| fault.hides_log(now_us)) {
            self.log.drain(host, &mut self.lines)?;
        }
        for line in self.lines.iter().skip(before) {
            (self.see)(Seen::Line(line.clone()));
        }
        if session.resets().len() != self.resets {
            self.resets = session.resets().len();
            self.recorder.restarted();
            // The lines stand as they stood.
            let levels = self.room(|room| room.building.encoder_levels())?;
            for (side, levels) in levels.into_iter().enumerate() {
                session.board_mut().drive_encoder(stop.at, side, levels);
            }
        }
        if self.recorder.look(host, now_us)? {
            self.tell(now_us)?;
        }
        let mut edges = Vec::new();
        let levels = self.room(|room| room.building.encoder_levels())?;
        self.room(|room| {
            room.building.advance(now_us, &mut edges);
            while room.urg.next_us() + STALE_US < now_us && room.from_sensor(now_us).is_some() {}
        })?;
        for fault in &self.board_faults {
            fault.disturb(&mut edges, levels, &mut self.edges_seen);
            let around = &mut Around { stop, shared: &self.shared, order: self.order, rng: &mut self.rng };
            fault.at(now_us, GRID_US, session, host, around)?;
        }
        self.edges.extend(edges);
        {
            let mut room = self.shared.lock().map_err(|_| anyhow!("the simulation panicked"))?;
            room.vcp.exchange(self.vcp.as_mut(), now_us)?;
        }
        for fault in &self.faults {
            fault.at(now_us, GRID_US, session, &self.shared, stop, host)?;
        }
        let led = session.board_mut().led();
        self.led_changes += u32::from(std::mem::replace(&mut self.led, led) != led);
        self.is_over(session, stop, now_us)
    }

    /// Lets the base rest, presses the button, and waits for the map.
    fn is_over(&mut self, session: &mut Session<Nucleo>, stop: Stop, now_us: u64) -> anyhow::Result<bool> {
        let arrived = self.room(|room| room.building.arrived())?;
        if self.rested_us.is_none() && arrived {
            self.rested_us = Some(now_us + REST_US);
        }
        let due = self.limit_us.or(self.rested_us).unwrap_or(u64::MAX);
        match self.pressed_us {
            None if now_us >= due && !self.vcp.lets_end() => {
                self.over();
                self.forget()?;
                Ok(false)
            }
            None if now_us >= due => {
                self.over();
                self.pressed_us = Some(now_us);
                session.board_mut().press(stop.at, true);
                Ok(false)
            }
            None => Ok(false),
            Some(pressed_us) => {
                if now_us == pressed_us + PRESS_US {
                    session.board_mut().press(stop.at, false);
                }
                if now_us > pressed_us + PRINT_US {
                    return Err(anyhow!("the map was not printed when the button was pressed"));
                }
                self.map_printed |= self.lines.iter().rev().take(20).any(|l| l.text == "end of map");
                Ok(self.map_printed && now_us > pressed_us + PRESS_US)
            }
        }
    }

    /// Says so, once.
    fn over(&mut self) {
        if !std::mem::replace(&mut self.is_over, true) {
            (self.see)(Seen::Over);
        }
    }

    /// A robot may stand for days: what is long ago is let go.
    fn forget(&mut self) -> anyhow::Result<()> {
        if self.recorder.entries.len() > HELD_ENTRIES {
            keep_last(&mut self.recorder.entries, KEPT_ENTRIES);
            keep_last(&mut self.lines, KEPT_ENTRIES);
            self.room(|room| {
                room.vcp.forget();
                keep_last(&mut room.replies_us, KEPT_ENTRIES);
                room.building.forget(KEPT_ENTRIES);
            })?;
        }
        Ok(())
    }

    fn tell(&mut self, now_us: u64) -> anyhow::Result<()> {
        let Some(entry) = self.recorder.entries.last() else { return Ok(()) };
        let crate::record::Event::Scan { ranges_mm, took_us, .. } = &entry.event else { return Ok(()) };
        let (pose, segments, took_us) = (entry.map_from_base(), entry.segments, *took_us);
        let driven = self.room(|room| room.building.driven())?;
        let error_m = self.room(|room| {
            let scans = &room.building.scans;
            let truth = scans.iter().rev().take(5).find(|s| s.ranges_mm == *ranges_mm);
            truth.zip(scans.first()).map(|(truth, first)| {
                let estimate = first.world_from_base * nalgebra::convert::<_, nalgebra::Isometry2<f64>>(pose);
                (estimate.translation.vector - truth.world_from_base.translation.vector).norm()
            })
        })?;
        let error_m = error_m.unwrap_or(f64::NAN);
        (self.see)(Seen::Progress(Progress { now_us, driven, error_m, segments, took_us }));
        Ok(())
    }
}

fn keep_last<T>(all: &mut Vec<T>, count: usize) {
    all.drain(..all.len().saturating_sub(count));
}
