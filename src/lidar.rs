//! The scanner: the `scip` client for ever, whole scans to the map by reference, and word of an absent sensor.

use core::sync::atomic::{AtomicBool, AtomicI32, AtomicU32, Ordering};

use embassy_futures::select::{Either, select};
use embassy_sync::blocking_mutex::raw::CriticalSectionRawMutex;
use embassy_sync::zerocopy_channel::Sender;
use embassy_time::{Duration, Ticker};
use scip::client::EmbassyClock;
use scip::{Client, ClientConfig};

use crate::board::{LidarPins, LineErrors, line_errors};
use crate::robot::{BAUD_RATE, SCAN_DELAY_US};

/// Room for the ranges of a scan.
pub const BEAMS: usize = 682;
/// While there is no sensor, it is reported so often.
const ABSENCE: Duration = Duration::from_millis(500);

/// A scan on its way to the map. There are two: one is filled while the other is used, and the lidar task waits where
/// both are full. Scans lost by that show as missed.
pub struct ScanBuffer {
    /// Millimetres or codes.
    pub ranges_mm: [u16; BEAMS],
    /// When the middle beam was taken, microseconds.
    pub middle_us: u64,
    /// One revolution, as measured, microseconds.
    pub revolution_us: u32,
    /// Number of ranges.
    pub len: usize,
}

impl ScanBuffer {
    /// Nothing seen.
    pub const EMPTY: Self = Self { ranges_mm: [0; BEAMS], middle_us: 0, revolution_us: 0, len: 0 };
}

/// What the lidar task tells the others. Latest wins.
pub struct LidarState {
    /// Whether scans come.
    pub present: AtomicBool,
    /// Reports of an absent sensor.
    pub absences: AtomicU32,
    /// Scans handed out.
    pub scans: AtomicU32,
    /// Scans that the stamps show to be missing while connected.
    pub missed: AtomicU32,
    /// Scans begun and dropped: wrong sums, lost or garbled bytes.
    pub dropped: AtomicU32,
    /// Errors of the port that cost what was being read, framing and overruns, also while the sensor is looked for.
    pub port_errors: AtomicU32,
    /// Noise, framing errors and overruns while connected.
    pub line: [AtomicU32; 3],
    /// Scans whose stamps were not believed.
    pub doubted: AtomicU32,
    /// One revolution, microseconds.
    pub revolution_us: AtomicU32,
    /// How much faster than the sensor's this clock runs, parts per million.
    pub skew_ppm: AtomicI32,
    /// Bit rate, bit/s.
    pub baud_rate: AtomicU32,
    /// Times that the connection was lost.
    pub losses: AtomicU32,
}

/// The state.
pub static STATE: LidarState = LidarState {
    present: AtomicBool::new(false),
    absences: AtomicU32::new(0),
    scans: AtomicU32::new(0),
    missed: AtomicU32::new(0),
    dropped: AtomicU32::new(0),
    port_errors: AtomicU32::new(0),
    line: [const { AtomicU32::new(0) }; 3],
    doubted: AtomicU32::new(0),
    revolution_us: AtomicU32::new(0),
    skew_ppm: AtomicI32::new(0),
    baud_rate: AtomicU32::new(0),
    losses: AtomicU32::new(0),
};

/// Hands out scans for ever; connects and connects again.
#[embassy_executor::task]
pub async fn run(pins: LidarPins, mut scans: Sender<'static, CriticalSectionRawMutex, ScanBuffer>) {
    let Some(port) = pins.open() else {
        defmt::error!("the lidar's port cannot be opened");
        return;
    };
    let mut config = ClientConfig::default();
    config.baud_rate = BAUD_RATE.unwrap_or(config.baud_rate);
    let mut client = Client::new(port, EmbassyClock, config);
    let mut chosen_rate = client.chosen_baud_rate();
    let (mut jumps, mut errors) = (0, line_errors());
    loop {
        let buffer = scans.send().await;
        let was_present = STATE.present.load(Ordering::Relaxed);
        let outcome = {
            let mut call = core::pin::pin!(client.next_scan(&mut buffer.ranges_mm));
            let mut ticker = Ticker::every(ABSENCE);
            loop {
                crate::liveness::here(crate::liveness::Task::Lidar).await;
                match select(call.as_mut(), ticker.next()).await {
                    Either::First(outcome) => break outcome,
                    Either::Second(()) if STATE.present.load(Ordering::Relaxed) => {}
                    Either::Second(()) => report_absence(),
                }
            }
        };
        match outcome {
            Ok(scan) => {
                if !STATE.present.swap(true, Ordering::Relaxed)
                    && let Some(info) = client.info()
                {
                    defmt::info!(
                        "lidar: {=str}, serial {=str}, firmware {=str}, {=usize} beams, {=u32} bit/s",
                        info.product.as_str(),
                        info.serial.as_str(),
                        info.firmware.as_str(),
                        info.beams(),
                        client.baud_rate()
                    );
                }
                buffer.len = scan.ranges;
                buffer.revolution_us = scan.revolution_us();
                STATE.revolution_us.store(scan.revolution_us(), Ordering::Relaxed);
                let stamped_us = scan.beam_us(0).midpoint(scan.beam_us(scan.ranges.saturating_sub(1)));
                buffer.middle_us = stamped_us.saturating_add_signed(-SCAN_DELAY_US);
                scans.send_done();
            }
            Err(error) => {
                STATE.present.store(false, Ordering::Relaxed);
                report_absence();
                defmt::warn!("lidar: {}", error);
            }
        }
        let before = core::mem::replace(&mut chosen_rate, client.chosen_baud_rate());
        if chosen_rate != before {
            defmt::warn!("lidar: {=u32} bit/s fails; from now on {=u32}", before, chosen_rate);
        }
        let clock = client.sensor_clock();
        // A new connection begins with none.
        if clock.jumps() > core::mem::replace(&mut jumps, clock.jumps()) {
            defmt::warn!("lidar: the sensor's clock was set; stamps are right again");
        }
        STATE.skew_ppm.store(clock.skew_ppm() as i32, Ordering::Relaxed);
        STATE.baud_rate.store(client.baud_rate(), Ordering::Relaxed);
        count_line_errors(&mut errors, was_present);
        let (counters, decoded) = (client.counters(), client.decoder_counters());
        STATE.doubted.store(counters.doubted, Ordering::Relaxed);
        STATE.scans.store(counters.scans, Ordering::Relaxed);
        if STATE.missed.swap(counters.missed, Ordering::Relaxed) != counters.missed {
            defmt::warn!("lidar: {=u32} scans missed so far", counters.missed);
        }
        STATE.losses.store(counters.losses, Ordering::Relaxed);
        if STATE.port_errors.swap(counters.port_errors, Ordering::Relaxed) != counters.port_errors {
            defmt::warn!("lidar: {=u32} errors of the port so far", counters.port_errors);
        }
        if STATE.dropped.swap(decoded.scans_dropped, Ordering::Relaxed) != decoded.scans_dropped {
            defmt::warn!("lidar: a scan was dropped; {}", decoded);
        }
    }
}

/// Adds the errors since the last time, where the sensor was there: while it is looked for, at rates that it does not speak, there are
/// nothing but errors.
fn count_line_errors(before: &mut LineErrors, connected: bool) {
    let now = line_errors();
    let then = core::mem::replace(before, now);
    let new = [
        now.noise.wrapping_sub(then.noise),
        now.framing.wrapping_sub(then.framing),
        now.overruns.wrapping_sub(then.overruns),
    ];
    for (counter, new) in STATE.line.iter().zip(new).filter(|_| connected) {
        counter.fetch_add(new, Ordering::Relaxed);
    }
}

/// The line's share of the status.
pub fn report() {
    let [noise, framing, overruns] = [0, 1, 2]
        .map(|kind: usize| STATE.line.get(kind).map_or(0, |counter| counter.load(Ordering::Relaxed)));
    defmt::info!(
        "line: {=u32} bit/s, noise {=u32}, framing {=u32}, overruns {=u32}, stamps doubted {=u32}; revolution {=u32} us, \
         clock {=i32} ppm fast",
        STATE.baud_rate.load(Ordering::Relaxed),
        noise,
        framing,
        overruns,
        STATE.doubted.load(Ordering::Relaxed),
        STATE.revolution_us.load(Ordering::Relaxed),
        STATE.skew_ppm.load(Ordering::Relaxed)
    );
}

fn report_absence() {
    STATE.absences.fetch_add(1, Ordering::Relaxed);
}
