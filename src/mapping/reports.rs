//! What the map's thread says in the log: what has changed, the status once a second, and the map where it is asked for.

use core::sync::atomic::Ordering;

use ::link::from_robot::Event as News;
use embassy_time::{Duration, Instant};
use slam_core::Segment;
use slam_core::geometry::pose::components;
use slam_core::tracking::TrackingState;

use super::{Mapping, PRINT_MAP, TRACKING};
use crate::board::{CORE_HZ, supply};
use crate::lidar::{self, STATE};
use crate::link::{fault_of, state_of};
use crate::resets::Count;
use crate::trace::sigma;
use crate::{encoders, measure, rtt, stack};

/// The status is logged so often.
pub(super) const STATUS_EVERY: Duration = Duration::from_secs(1);
/// Segments of the map that are printed at once.
const PRINT_AT_ONCE: usize = 8;

impl Mapping {
    /// What has changed of the state, and of what is known of the wheels.
    pub(super) fn report_tracking(&mut self) {
        let mapper = self.keeper.mapper();
        let (state, fault) = (mapper.slam().state(), mapper.slam().wheel_fault());
        let restarts = mapper.counters().counters_restarted;
        if core::mem::replace(&mut self.state, state) != state {
            TRACKING.store(state as u8, Ordering::Relaxed);
            self.outbox.event(News::State(state_of(state)));
            match state {
                TrackingState::Tracking => defmt::info!("tracking again"),
                TrackingState::Uncertain => defmt::warn!("the pose is uncertain"),
                TrackingState::Lost => {
                    defmt::warn!("the robot is lost and looks for itself: nothing enters the map")
                }
            }
        }
        if core::mem::replace(&mut self.fault, fault) != fault {
            self.outbox.event(News::Wheels(fault.map(fault_of)));
            match fault {
                Some(fault) => defmt::warn!("{=str}", fault.message()),
                None => defmt::info!("the wheels are as they should be again"),
            }
        }
        if core::mem::replace(&mut self.restarts, restarts) != restarts {
            defmt::warn!("the counters restarted");
            self.outbox.event(News::CountersRestarted);
        }
    }

    /// The status line, once a second, and what was dropped.
    pub(super) fn report(&mut self) {
        let dropped = encoders::DROPPED.load(Ordering::Relaxed);
        if core::mem::replace(&mut self.dropped, dropped) != dropped {
            defmt::warn!("encoders: {=u32} samples dropped so far", dropped);
        }
        let now = Instant::now();
        if now < self.next_status {
            return;
        }
        let period_us = (STATUS_EVERY + (now - self.next_status)).as_micros();
        self.next_status = now + STATUS_EVERY;
        let mapper = self.keeper.mapper();
        let slam = mapper.slam();
        let (delay_s, delay_sigma_s, delay_used) =
            mapper.delay().map_or((0.0, 0.0, false), |delay| (delay.delay_s, delay.sigma_s, delay.used));
        let (pose, covariance) = (components(&slam.pose()), slam.covariance());
        let scans = STATE.scans.load(Ordering::Relaxed);
        let new = scans.wrapping_sub(core::mem::replace(&mut self.scans_at_status, scans));
        let permille = core::mem::take(&mut self.busy_us) * 1000 / period_us.max(1);
        self.load.mapping_permille = permille as u16;
        self.load.link_permille = (core::mem::take(&mut self.link_us) * 1000 / period_us.max(1)) as u16;
        let counters = slam.map().counters();
        let full = counters.evicted.saturating_add(counters.refused);
        if core::mem::replace(&mut self.full, full) < full {
            self.outbox.event(News::MapFull);
        }
        self.outbox.second();
        defmt::info!(
            "x {=f32} y {=f32} heading {=f32}, sigma {=f32} {=f32} {=f32}, {=usize} segments, {=u32} scans in {=u64} ms, \
             update {=u32} us, cpu {=u64} permille, delay {=f32} s, sigma {=f32} s, used {=bool}",
            pose.x,
            pose.y,
            pose.z,
            sigma(covariance.m11),
            sigma(covariance.m22),
            sigma(covariance.m33),
            slam.map().segments().len(),
            new,
            period_us / 1000,
            self.last_took_us,
            permille,
            delay_s,
            delay_sigma_s,
            delay_used
        );
        defmt::info!(
            "lidar: missed {=u32}, dropped {=u32}, port errors {=u32}, losses {=u32}; {}; {}",
            STATE.missed.load(Ordering::Relaxed),
            STATE.dropped.load(Ordering::Relaxed),
            STATE.port_errors.load(Ordering::Relaxed),
            STATE.losses.load(Ordering::Relaxed),
            slam.counters(),
            mapper.counters()
        );
        let [median, most] = self.scan_cycles.take();
        let urgent_permille =
            u64::from(measure::take_urgent()) * 1_000_000_000 / u64::from(CORE_HZ) / period_us.max(1);
        defmt::info!(
            "health: scan {=u32} cycles at the median, {=u32} at most; urgent executor {=u64} permille; supply dips {=u32}; \
             log frames lost {=u32}; since power-up: watchdog {=u32}, failures {=u32}, clock lost {=u32}",
            median,
            most,
            urgent_permille,
            supply::dips(),
            rtt::lost(),
            Count::Watchdog.read(),
            Count::Failure.read(),
            Count::ClockLost.read()
        );
        lidar::report();
        defmt::info!(
            "stack: {=u32} bytes at most, {=u32} in thread mode, {=u32} in the urgent executor",
            stack::most(),
            stack::most_in_thread(),
            stack::most_in_interrupts()
        );
    }

    /// A few segments of the map that was asked for, so that the log keeps up.
    pub(super) fn print_map(&mut self) {
        if PRINT_MAP.swap(false, Ordering::Relaxed) {
            defmt::info!("walls of the map");
            self.printing = Some(0);
        }
        let Some(from) = self.printing else { return };
        let slam = self.keeper.mapper().slam();
        let map = slam.map().segments();
        let next_few = map.iter().enumerate().skip(from).take(PRINT_AT_ONCE);
        for (_, entry) in next_few.filter(|(index, _)| slam.is_wall(*index)) {
            let Segment { start: a, end: b, moments, .. } = entry.segment();
            defmt::info!(
                "segment {=f32} {=f32} {=f32} {=f32} points {=u32} scans {=u16}",
                a.x,
                a.y,
                b.x,
                b.y,
                moments.inliers,
                entry.hits
            );
        }
        let next = from + PRINT_AT_ONCE;
        self.printing = if next < map.len() {
            Some(next)
        } else {
            defmt::info!("end of map");
            None
        };
    }
}
