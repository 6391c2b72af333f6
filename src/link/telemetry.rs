//! What is known at an instant, as messages.

use core::sync::atomic::Ordering;

use ::link::Streams;
use ::link::from_robot::{
    Cause, Health, Hello, KeptMap, Pose, ResetCause, Scanner, State, Status, WheelFault, Wheels,
};
use embassy_time::Instant;
use slam_core::geometry::pose::components;
use slam_core::odometry::wheel_faults::WheelFault as Fault;
use slam_core::tracking::TrackingState;

use super::RECEIVED;
use super::outbox::Unsent;
use crate::kept::{Found, Mapper, ROOM};
use crate::lidar::STATE;
use crate::{board, encoders, robot, stack};

/// What the work takes.
#[derive(Default)]
pub struct Load {
    /// The last scan, microseconds.
    pub scan_us: u32,
    /// The longest scan, microseconds.
    pub longest_scan_us: u32,
    /// Share of the last period that scans took.
    pub mapping_permille: u16,
    /// Share of it that making messages took.
    pub link_permille: u16,
}

/// Who is there.
#[inline(never)]
pub fn hello(mapper: &Mapper, (reset, kept): (ResetCause, KeptMap), streams: Streams) -> Hello {
    let sensor = &mapper.slam().config().sensor;
    Hello {
        uptime_us: uptime_us(),
        firmware: text(env!("CARGO_PKG_VERSION")),
        board: text(board::NAME),
        robot: text(robot::NAME),
        lines: ROOM[0] as u16,
        places: ROOM[1] as u16,
        reset,
        kept,
        scanner: Scanner {
            beams: sensor.geometry.beams() as u16,
            first_bearing_rad: sensor.geometry.bearing(0),
            step_rad: sensor.geometry.step_rad(),
            min_mm: sensor.codes.min_mm,
            max_mm: sensor.codes.max_mm,
            base_from_laser: components(&sensor.mounting.base_from_laser).into(),
            upside_down: sensor.mounting.upside_down,
            late_us: robot::SCAN_DELAY_US as i32,
        },
        wheels: Wheels {
            radii_m: [robot::DRIVE.left_wheel_radius_m, robot::DRIVE.right_wheel_radius_m],
            track_m: robot::DRIVE.track_m,
            ticks_per_turn: robot::DRIVE.ticks_per_turn,
        },
        streams,
    }
}

/// Cut where it is too long.
fn text<const N: usize>(text: &str) -> heapless::String<N> {
    let mut cut = heapless::String::new();
    for letter in text.chars() {
        if cut.push(letter).is_err() {
            break;
        }
    }
    cut
}

fn uptime_us() -> u64 {
    Instant::now().as_micros()
}

/// The counters.
#[inline(never)]
pub fn status(mapper: &Mapper) -> Status {
    let slam = mapper.slam();
    let (counters, map, odometry) = (slam.counters(), slam.map().counters(), mapper.counters());
    let seen = |counter: &core::sync::atomic::AtomicU32| counter.load(Ordering::Relaxed);
    Status {
        uptime_us: uptime_us(),
        way_m: slam.way_m(),
        sensor: STATE.present.load(Ordering::Relaxed),
        mapping: slam.is_mapping(),
        wheel_fault: slam.wheel_fault().map(fault_of),
        delay: mapper.delay().map(|delay| (delay.delay_s, delay.sigma_s, delay.used)),
        sensor_scans: seen(&STATE.scans),
        sensor_missed: seen(&STATE.missed),
        sensor_dropped: seen(&STATE.dropped),
        port_errors: seen(&STATE.port_errors),
        sensor_losses: seen(&STATE.losses),
        samples_dropped: seen(&encoders::DROPPED),
        stamps_refused: odometry.stamps_refused,
        scans_without_odometry: odometry.scans_without_odometry,
        impossible_steps: odometry.impossible_steps,
        counters_restarted: odometry.counters_restarted,
        scans: counters.scans,
        wrong_beam_count: counters.wrong_beam_count,
        without_segments: counters.without_segments,
        uncorrected: counters.uncorrected,
        coasted: counters.coasted,
        loops_closed: counters.loops_closed,
        crowded_out: counters.crowded_out,
        odometry_left_out: counters.odometry_left_out,
        searched: counters.searched,
        lost: counters.lost,
        relocalised: counters.relocalised,
        gave_up: counters.gave_up,
        lines_added: map.added,
        lines_evicted: map.evicted,
        lines_refused: map.refused,
        lines_fused: map.fused,
        lines_forgotten: map.forgotten,
        lines_opened: map.opened,
        places: slam.places().anchors().len() as u16,
    }
}

/// Processor, stack, link.
#[inline(never)]
pub fn health(load: &Load, unsent: &Unsent) -> Health {
    Health {
        uptime_us: uptime_us(),
        scan_us: load.scan_us,
        longest_scan_us: load.longest_scan_us,
        mapping_permille: load.mapping_permille,
        link_permille: load.link_permille,
        stack: [stack::most(), stack::most_in_thread(), stack::most_in_interrupts()],
        sent: unsent.frames,
        poses_replaced: unsent.poses,
        scans_unsent: unsent.scans,
        samples_unsent: unsent.samples,
        events_unsent: unsent.events,
        received: RECEIVED.frames.load(Ordering::Relaxed),
        damaged: RECEIVED.damaged.load(Ordering::Relaxed),
        unknown: unsent.unknown,
        overruns: RECEIVED.overruns.load(Ordering::Relaxed),
    }
}

/// The pose after the event of this number, when so many samples have been taken in.
pub fn pose_of([number, samples]: [u32; 2], cause: Cause, at_us: u64, mapper: &Mapper, took_us: u32) -> Pose {
    let slam = mapper.slam();
    let c = slam.covariance();
    Pose {
        number,
        at_us,
        samples,
        pose: components(&slam.pose()).into(),
        covariance: [c.m11, c.m12, c.m13, c.m22, c.m23, c.m33],
        state: state_of(slam.state()),
        lines: slam.map().segments().len() as u16,
        took_us,
        cause,
    }
}

/// How far the pose is to be relied on.
pub fn state_of(state: TrackingState) -> State {
    match state {
        TrackingState::Tracking => State::Tracking,
        TrackingState::Uncertain => State::Uncertain,
        TrackingState::Lost => State::Lost,
    }
}

/// What is wrong with the wheels.
pub fn fault_of(fault: Fault) -> WheelFault {
    match fault {
        Fault::Swapped => WheelFault::Swapped,
        Fault::LeftReversed => WheelFault::LeftReversed,
        Fault::RightReversed => WheelFault::RightReversed,
        Fault::BothReversed => WheelFault::BothReversed,
        Fault::SwappedAndReversed => WheelFault::SwappedAndReversed,
        Fault::LeftDead => WheelFault::LeftDead,
        Fault::RightDead => WheelFault::RightDead,
        Fault::BothDead => WheelFault::BothDead,
    }
}

impl From<board::ResetCause> for ResetCause {
    fn from(cause: board::ResetCause) -> Self {
        match cause {
            board::ResetCause::Power => Self::Power,
            board::ResetCause::Watchdog => Self::Watchdog,
            board::ResetCause::Software => Self::Software,
            board::ResetCause::Pin => Self::Pin,
            board::ResetCause::Other => Self::Other,
        }
    }
}

impl From<Found> for KeptMap {
    fn from(found: Found) -> Self {
        match found {
            Found::Map => Self::Whole,
            Found::Nothing | Found::PowerWasAway => Self::None,
            Found::GivenUp => Self::GivenUp,
            Found::HalfDone => Self::HalfDone,
            Found::Damaged => Self::Damaged,
        }
    }
}
