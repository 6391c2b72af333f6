//! The map: takes in scans and wheel ticks in thread mode, and says what it knows.
//!
//! Everything urgent runs above this in interrupts: a long update delays no byte and no tick.

mod reports;

use core::sync::atomic::{AtomicBool, AtomicU8, Ordering};

use ::link::from_robot::{Cause, Event as News};
use embassy_futures::select::{Either4, select4};
use embassy_sync::blocking_mutex::raw::CriticalSectionRawMutex;
use embassy_sync::zerocopy_channel::Receiver;
use embassy_time::{Duration, Instant, Ticker, Timer};
use slam_core::geometry::pose::components;
use slam_core::odometry::wheel_faults::WheelFault;
use slam_core::tracking::TrackingState;

use crate::board::supply;
use crate::encoders;
use crate::kept::{Found, Keeper, Mapper};
use crate::lidar::ScanBuffer;
use crate::link::{Incoming, Load, Outbox, REQUESTS, Restart, View, pose_of};
use crate::liveness::{self, Task};
use crate::measure::{self, ScanCycles};
use crate::trace::{Event, Tracer, sigma};
use reports::STATUS_EVERY;

/// Without a scan the map moves on by odometry so often …
const COAST_EVERY: Duration = Duration::from_millis(50);
/// … to so long ago: the longest that a scan may be on its way from its middle beam. That is 122 ms at 250 kbit/s and 222 ms at
/// 115 200 bit/s, the least rate that the driver falls back to: 33 ms of sweep, 3 ms of the sensor's work, and its bytes.
const COAST_BEHIND_US: u64 = 230_000;
/// A scan is held for so long at the most while it is sent.
const HOLD: Duration = Duration::from_millis(60);
/// Between the record's last event and a request's so much passes, for whoever reads the record.
const RECORD_READ: Duration = Duration::from_millis(2);

/// The [`TrackingState`], for the LED.
pub static TRACKING: AtomicU8 = AtomicU8::new(TrackingState::Tracking as u8);
/// Set to have the map printed.
pub static PRINT_MAP: AtomicBool = AtomicBool::new(false);
/// Set to have the map forgotten.
pub static FORGET_MAP: AtomicBool = AtomicBool::new(false);

/// Maps for ever.
#[embassy_executor::task]
pub async fn run(
    keeper: Keeper,
    found: Found,
    tracer: Tracer,
    outbox: &'static mut Outbox,
    mut scans: Receiver<'static, CriticalSectionRawMutex, ScanBuffer>,
) {
    let mut mapping = Mapping::new(keeper, tracer, outbox);
    if found.is_map() {
        mapping.resume(found);
    }
    let mut ticker = Ticker::every(COAST_EVERY);
    loop {
        liveness::here(Task::Mapping).await;
        // While a scan is held it is not received again.
        let scan = async {
            match mapping.held {
                None => scans.receive().await,
                Some(_) => core::future::pending().await,
            }
        };
        let request = async {
            Timer::at(mapping.recorded + RECORD_READ).await;
            REQUESTS.receive().await
        };
        let room = mapping.outbox.room(mapping.tracer.samples_taken());
        match select4(scan, ticker.next(), room, request).await {
            Either4::First(scan) if mapping.may_work() => {
                mapping.take_scan(scan);
                mapping.outbox.look_at_map();
            }
            Either4::First(_) => scans.receive_done(),
            Either4::Second(()) => {
                if mapping.may_work() {
                    mapping.coast();
                }
                mapping.outbox.look_at_map();
            }
            Either4::Third(()) => {}
            // One that comes while the supply is low is dropped, and the PC asks again.
            Either4::Fourth(request) => {
                if mapping.may_work() && mapping.obey(request) {
                    Timer::after(RECORD_READ).await;
                }
            }
        }
        if mapping.publish(scans.try_receive().map(|scan| &*scan)) {
            scans.receive_done();
        }
        mapping.report();
        if mapping.forget_map() {
            Timer::after(RECORD_READ).await;
        }
        mapping.print_map();
    }
}

struct Mapping {
    keeper: Keeper,
    tracer: Tracer,
    outbox: &'static mut Outbox,
    load: Load,
    restart: Restart,
    /// Since when the last scan is held.
    held: Option<Instant>,
    /// When the record was last written.
    recorded: Instant,
    /// What was made of messages since the last status.
    link_us: u64,
    /// The pose that was set last, as the record has it.
    set_pose: [u16; 6],
    next_status: Instant,
    scans_at_status: u32,
    last_took_us: u32,
    scan_cycles: ScanCycles,
    busy_us: u64,
    printing: Option<usize>,
    coasting: bool,
    supply_is_low: bool,
    dropped: u32,
    /// As they were said last.
    state: TrackingState,
    fault: Option<WheelFault>,
    restarts: u32,
    full: u32,
}

impl Mapping {
    fn new(keeper: Keeper, tracer: Tracer, outbox: &'static mut Outbox) -> Self {
        Self {
            keeper,
            tracer,
            outbox,
            load: Load::default(),
            restart: Restart::default(),
            held: None,
            recorded: Instant::now(),
            link_us: 0,
            set_pose: [0; 6],
            next_status: Instant::now() + STATUS_EVERY,
            scans_at_status: 0,
            last_took_us: 0,
            scan_cycles: ScanCycles::default(),
            busy_us: 0,
            printing: None,
            coasting: false,
            supply_is_low: false,
            dropped: 0,
            state: TrackingState::Tracking,
            fault: None,
            restarts: 0,
            full: 0,
        }
    }

    fn resume(&mut self, found: Found) {
        let (event, cause) = if found == Found::Map {
            self.keeper.update(|mapper| mapper.resume());
            (Event::Resumed, Cause::Resumed)
        } else {
            // It was put in order when it was taken.
            defmt::warn!("the reset came in the middle of a scan; what was whole of the map is there");
            (Event::Recovered, Cause::Recovered)
        };
        self.record(event, cause, 0, &[], 0);
        let pose = components(&self.keeper.mapper().slam().pose());
        defmt::info!(
            "the map of {=usize} segments is kept; last seen at x {=f32} m, y {=f32} m, heading {=f32} rad",
            self.keeper.mapper().slam().map().segments().len(),
            pose.x,
            pose.y,
            pose.z
        );
    }

    /// Whether the map may be worked on: not while the supply falls, when every instruction may be the last.
    fn may_work(&mut self) -> bool {
        let low = supply::is_low();
        if core::mem::replace(&mut self.supply_is_low, low) != low {
            if low {
                defmt::warn!("the supply is low; the map is left as it is");
            } else {
                defmt::info!("the supply is well again");
            }
        }
        !low
    }

    fn take_scan(&mut self, scan: &ScanBuffer) {
        let (begin, begin_cycles) = (Instant::now(), measure::cycles());
        let Self { keeper, tracer, .. } = self;
        let ranges_mm = scan.ranges_mm.get(..scan.len).unwrap_or(&[]);
        let update = keeper.update(|mapper| {
            take_samples(mapper, tracer);
            mapper.set_revolution_us(scan.revolution_us);
            mapper.scan(scan.middle_us, ranges_mm)
        });
        self.scan_cycles.add(measure::cycles().wrapping_sub(begin_cycles));
        let took_us = begin.elapsed().as_micros() as u32;
        self.last_took_us = took_us;
        self.busy_us += u64::from(took_us);
        self.record(Event::Scan, Cause::Scan, scan.middle_us, ranges_mm, took_us);
        self.outbox.scan(self.tracer.events());
        self.held = Some(begin);
        self.load.scan_us = took_us;
        self.load.longest_scan_us = self.load.longest_scan_us.max(took_us);
        if core::mem::take(&mut self.coasting) {
            self.outbox.event(News::SensorFound);
            let sigmas = self.keeper.mapper().slam().covariance();
            defmt::info!(
                "scans again; sure within {=f32} m, {=f32} m, {=f32} rad (sigma)",
                sigma(sigmas.m11),
                sigma(sigmas.m22),
                sigma(sigmas.m33)
            );
        }
        match update {
            None => {
                defmt::warn!("a scan came without odometry, or late: {}", self.keeper.mapper().counters())
            }
            Some(update) => {
                if let Some(rejected) = update.rejected {
                    defmt::warn!("a scan was not used: {}", rejected);
                    self.outbox.event(News::ScanRefused);
                }
                if update.closure.is_some() {
                    defmt::info!("a loop was closed");
                    self.outbox.event(News::LoopClosed);
                }
            }
        }
        self.report_tracking();
    }

    /// Something was done to the map: the record has it, and a PC is told.
    fn record(&mut self, event: Event, cause: Cause, at_us: u64, ranges_mm: &[u16], took_us: u32) {
        self.tracer.event(event, at_us, ranges_mm, self.keeper.mapper(), took_us);
        self.tell(cause, at_us, took_us);
    }

    /// Tells a PC of the event that the record has got.
    fn tell(&mut self, cause: Cause, at_us: u64, took_us: u32) {
        self.recorded = Instant::now();
        let (number, samples) = (self.tracer.events(), self.tracer.samples_taken());
        self.outbox.pose(pose_of([number, samples], cause, at_us, self.keeper.mapper(), took_us));
    }

    /// Does what a PC asks for. Whether it did something to the map.
    fn obey(&mut self, incoming: Incoming) -> bool {
        let Self { keeper, outbox, restart, tracer, .. } = self;
        let Some(cause) = outbox.obey(incoming, tracer.samples_taken(), keeper, restart) else {
            return false;
        };
        self.was_changed(cause);
        true
    }

    /// The map, or how it is used, was changed by what somebody asked for.
    fn was_changed(&mut self, cause: Cause) {
        let now_us = Instant::now().as_micros();
        let event = match cause {
            Cause::PoseSet(to) => {
                let [x, y, heading] = to.map(|v| [v.to_bits() as u16, (v.to_bits() >> 16) as u16]);
                self.set_pose = [x[0], x[1], y[0], y[1], heading[0], heading[1]];
                self.tracer.event(Event::PoseSet, now_us, &self.set_pose, self.keeper.mapper(), 0);
                self.tell(cause, now_us, 0);
                return self.report_tracking();
            }
            Cause::Forgotten => Event::Forgotten,
            Cause::Frozen => Event::Frozen,
            Cause::Unfrozen => Event::Unfrozen,
            _ => Event::Relocalising,
        };
        self.record(event, cause, now_us, &[], 0);
        self.report_tracking();
    }

    /// Sends what there is room for. Whether the scan that is held is needed no longer.
    fn publish(&mut self, scan: Option<&ScanBuffer>) -> bool {
        let begin = Instant::now();
        if self.held.is_some_and(|since| begin - since > HOLD) {
            self.outbox.cut_scan();
        }
        let Self { keeper, tracer, outbox, load, .. } = self;
        let scan = scan.filter(|_| self.held.is_some());
        outbox.fill(&View { mapper: keeper.mapper(), tracer, scan, load });
        self.restart.when_due(outbox);
        self.link_us += begin.elapsed().as_micros();
        self.held.is_some() && !self.outbox.is_sending() && self.held.take().is_some()
    }

    fn coast(&mut self) {
        let until_us = Instant::now().as_micros().saturating_sub(COAST_BEHIND_US);
        let late = self.keeper.mapper().pose_us().is_none_or(|at| at < until_us);
        // Samples wait in their queue as long as scans come in time.
        if !late {
            return;
        }
        let Self { keeper, tracer, .. } = self;
        let moved = keeper.update(|mapper| {
            take_samples(mapper, tracer);
            mapper.coast(until_us)
        });
        self.record(Event::Coasted, Cause::Coasted, until_us, &[], 0);
        if moved.is_some() && !core::mem::replace(&mut self.coasting, true) {
            self.outbox.event(News::SensorLost);
            defmt::warn!("no scans; going on by odometry alone");
        }
    }

    /// Begins a new map where the button asks for it, once whoever reads the record has had its last event. Whether it did.
    fn forget_map(&mut self) -> bool {
        let is_read = Instant::now() >= self.recorded + RECORD_READ;
        if !FORGET_MAP.load(Ordering::Relaxed) || !is_read || !self.may_work() {
            return false;
        }
        FORGET_MAP.store(false, Ordering::Relaxed);
        self.printing = None;
        match self.keeper.forget() {
            Ok(()) => {
                defmt::warn!("the map is forgotten, as the button asks; a new one begins");
                self.was_changed(Cause::Forgotten);
                true
            }
            Err(error) => {
                defmt::error!("the configuration cannot be used: {}", error);
                false
            }
        }
    }
}

/// Takes in the samples of the wheels that have come.
fn take_samples(mapper: &mut Mapper, tracer: &mut Tracer) {
    while let Ok(ticks) = encoders::SAMPLES.try_receive() {
        tracer.sample(ticks);
        mapper.push(ticks);
    }
}
