//! The scanner: the `scip` client for ever, whole scans to the map by reference, and word of an absent sensor.

use core::sync::atomic::{AtomicBool, AtomicU32, Ordering};

use embassy_futures::select::{Either, select};
use embassy_sync::blocking_mutex::raw::CriticalSectionRawMutex;
use embassy_sync::zerocopy_channel::Sender;
use embassy_time::{Duration, Ticker};
use scip::client::EmbassyClock;
use scip::{Client, ClientConfig};

use crate::board::LidarPins;
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
    /// Number of ranges.
    pub len: usize,
}

impl ScanBuffer {
    /// Nothing seen.
    pub const EMPTY: Self = Self { ranges_mm: [0; BEAMS], middle_us: 0, len: 0 };
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
    /// Errors of the port: noise, framing, overrun.
    pub port_errors: AtomicU32,
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
    loop {
        let buffer = scans.send().await;
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
        let (counters, decoded) = (client.counters(), client.decoder_counters());
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

fn report_absence() {
    STATE.absences.fetch_add(1, Ordering::Relaxed);
}
