//! The one door: odometry and scans go in with their stamps, the pose comes out.
//!
//! [`Slam`] wants the motion of each scan; this keeps the odometry that tells it, leaves out what no robot can have done, moves on
//! by odometry alone when scans stay away, and takes up its map again after a reset. It is what runs on the microcontroller
//! and what replays logs on a PC: given the same samples and scans in the same order both compute the same bits.

use core::mem::MaybeUninit;

use nalgebra::Isometry2;

use crate::config::{ConfigError, SlamConfig};
use crate::geometry::pose::{diagonal, turn};
use crate::map::store::{MapError, StoredMap};
use crate::odometry::delay::{Delay, DelayEstimator, RATE_WITHIN_US};
use crate::odometry::track::{OdometryTrack, ScanMotion};
use crate::odometry::{DifferentialDrive, Increment};
use crate::sensor::scan::{Scan, SensorConfig};
use crate::slam::{Slam, SlamUpdate};
use crate::tracking::correction::Verdict;

/// Wheel ticks at an instant.
///
/// Counters of fewer than 32 bits go in the upper bits, with as many times more ticks for a turn in the [`DifferentialDrive`], so
/// that they wrap where they should.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[repr(C)]
pub struct WheelTicks {
    /// On the clock that stamps scans too, microseconds.
    pub stamp_us: u64,
    /// Left wheel, since any instant; wraps.
    pub left: i32,
    /// Right wheel, since any instant; wraps.
    pub right: i32,
}

/// Standard deviations (m, m, rad) of what a robot may do unseen while its microcontroller is reset: some milliseconds at
/// 1 m/s, and a wheel's slip. Chosen, not measured.
pub const UNSEEN: [f32; 3] = [0.02, 0.02, 0.02];
/// The same where the reset came in the middle of a scan, and what the pose had in common with the walls is lost.
pub const UNSEEN_IN_WORK: [f32; 3] = [0.05, 0.05, 0.05];
/// Where there is no odometry the robot may move this fast, m/s and rad/s. Chosen on one log, of a scanner carried by hand
/// (ccny_demo).
pub const UNKNOWN_SPEED: [f32; 2] = [0.5, 1.0];

/// How long a reset may take, microseconds: the wait of a watchdog and the boot, with room to spare. The wheels may go on turning.
const RESET_US: u64 = 10_000_000;

/// An instant on both clocks, microseconds: that of the odometry, and that which stamps scans, late by what is used of the delay.
#[derive(Clone, Copy)]
struct PoseInstant {
    odometry_us: u64,
    stamp_us: u64,
}

/// What happened to the odometry since the start.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct MapperCounters {
    /// Samples whose stamp did not increase; they were passed over. Ticks come with the next sample, a motion is lost.
    pub stamps_refused: u32,
    /// Scans for which there was no odometry yet, or that are older than the last; they were passed over.
    pub scans_without_odometry: u32,
    /// Times that the robot took up its map again after a reset.
    pub resumed: u32,
    /// Samples between which no robot can have moved so far; they count as none.
    pub impossible_steps: u32,
    /// Those of them after which both counters stood near zero: they had been restarted.
    pub counters_restarted: u32,
}

/// Odometry and scans in, poses out. Room for `N` map segments, `BEAMS` beams, `P` places and `K` odometry samples, which must span a scan
/// and its way to here: 64 at 200 Hz are 0.32 s. Longer gaps between scans are bridged.
///
/// The map's origin is where the robot was at the first scan, or at the first sample if it coasts before.
///
/// RAM: [`Mapper::BYTES`], that of [`Slam`] and 48 bytes for each sample.
pub struct Mapper<const N: usize, const K: usize, const BEAMS: usize = 682, const P: usize = 96> {
    slam: Slam<N, BEAMS, P>,
    drive: Option<DifferentialDrive>,
    track: OdometryTrack<K>,
    last_ticks: Option<WheelTicks>,
    /// The instant of the pose.
    pose_at: Option<PoseInstant>,
    delay: DelayEstimator,
    /// The motion since then up to an instant before which the track may have forgotten it.
    carried: Option<(u64, Increment)>,
    /// Set while the time of the next sample has nothing to do with that of the last.
    resuming: Option<[f32; 3]>,
    counters: MapperCounters,
}

impl<const N: usize, const K: usize, const BEAMS: usize, const P: usize> Mapper<N, K, BEAMS, P> {
    /// Size in RAM.
    pub const BYTES: usize = core::mem::size_of::<Self>();

    /// An empty map. Without a drive there is no use in ticks, only in motions.
    pub fn new(config: SlamConfig, drive: impl Into<Option<DifferentialDrive>>) -> Result<Self, ConfigError> {
        Slam::<N, BEAMS, P>::check(&config)?;
        let mut mapper = Self::blank(config, drive.into());
        mapper.slam.prepare();
        Ok(mapper)
    }

    /// The same, made where it is to stay: no copy of it passes over the stack.
    pub fn new_in(
        place: &mut MaybeUninit<Self>,
        config: SlamConfig,
        drive: impl Into<Option<DifferentialDrive>>,
    ) -> Result<&mut Self, ConfigError> {
        Slam::<N, BEAMS, P>::check(&config)?;
        let mapper = place.write(Self::blank(config, drive.into()));
        mapper.slam.prepare();
        Ok(mapper)
    }

    #[inline(always)]
    fn blank(mut config: SlamConfig, drive: Option<DifferentialDrive>) -> Self {
        config.odometry.track_m = config.odometry.track_m.or(drive.map(|drive| drive.track_m));
        Self {
            slam: Slam::blank(config),
            drive,
            track: OdometryTrack::default(),
            last_ticks: None,
            pose_at: None,
            delay: DelayEstimator::default(),
            carried: None,
            resuming: None,
            counters: MapperCounters::default(),
        }
    }

    /// Takes another scanner, see [`Slam::set_sensor`].
    pub fn set_sensor(&mut self, sensor: SensorConfig) -> Result<(), ConfigError> {
        self.slam.set_sensor(sensor)
    }

    /// How long a revolution of the scanner takes, as measured, microseconds: to be said before each scan where it is known, see
    /// [`Slam::set_revolution_us`]. By it the motion within a scan is taken out.
    pub fn set_revolution_us(&mut self, revolution_us: u32) {
        self.slam.set_revolution_us(revolution_us);
    }

    /// Takes a saved map, see [`Slam::load`].
    pub fn load(&mut self, map: &StoredMap<'_>, at: Option<Isometry2<f32>>) -> Result<(), MapError> {
        self.slam.load(map, at)
    }

    /// Freezes the map, or lets it learn again, see [`Slam::set_mapping`].
    pub fn set_mapping(&mut self, mapping: bool) {
        self.slam.set_mapping(mapping);
    }

    /// The robot stands near a pose in its map, see [`Slam::set_pose`].
    pub fn set_pose(&mut self, pose: Isometry2<f32>) {
        self.slam.set_pose(pose);
    }

    /// The robot may be anywhere in its map, see [`Slam::relocalise`].
    pub fn relocalise(&mut self) {
        self.slam.relocalise();
    }

    /// Map, pose and counters.
    pub fn slam(&self) -> &Slam<N, BEAMS, P> {
        &self.slam
    }

    /// Counters since the start.
    pub fn counters(&self) -> MapperCounters {
        self.counters
    }

    /// The instant of the pose as scans are stamped, microseconds: that of the last scan, or where coasting ended. `None` before
    /// both.
    pub fn pose_us(&self) -> Option<u64> {
        self.pose_at.map(|at| at.stamp_us)
    }

    /// By how much scans are stamped late, beyond what their stamps were corrected by already. `None` where that is not
    /// estimated, see [`OdometryConfig::delay`](crate::config::OdometryConfig::delay).
    pub fn delay(&self) -> Option<Delay> {
        self.slam.config().odometry.delay.as_ref().map(|config| self.delay.delay(config))
    }

    /// Ticks and stamp of the newest sample of ticks, unless a motion came after it.
    pub fn last_ticks(&self) -> Option<WheelTicks> {
        self.last_ticks
    }

    /// Takes a sample of the wheels' counters. The first says only where they begin.
    pub fn push(&mut self, ticks: WheelTicks) {
        let step = self.step_to(&ticks);
        if self.take_step(ticks.stamp_us, step) {
            self.last_ticks = Some(ticks);
        }
    }

    /// Takes a sample of odometry that does not count ticks: the motion since the sample before, in `base` then. What the first
    /// says of the motion before it is not used.
    pub fn push_motion(&mut self, stamp_us: u64, motion: Increment) {
        let since_us = self.track.newest_us().map_or(0, |last_us| stamp_us.saturating_sub(last_us));
        let possible = motion.is_possible(since_us);
        let step = if possible { motion } else { self.impossible_step() };
        if self.take_step(stamp_us, step) {
            self.last_ticks = None;
        }
    }

    /// What the wheels did since the last sample.
    fn step_to(&mut self, ticks: &WheelTicks) -> Increment {
        let integration = self.slam.config().odometry.integration;
        let (Some(drive), Some(last)) = (&self.drive, self.last_ticks) else { return Increment::identity() };
        let (left, right) = (ticks.left.wrapping_sub(last.left), ticks.right.wrapping_sub(last.right));
        // Across a reset time is not known.
        let since_us =
            if self.resuming.is_some() { RESET_US } else { ticks.stamp_us.saturating_sub(last.stamp_us) };
        if drive.is_possible(left, right, since_us) {
            return drive.increment(left, right, integration);
        }
        if drive.is_possible(ticks.left, ticks.right, since_us) {
            self.counters.counters_restarted = self.counters.counters_restarted.saturating_add(1);
        }
        self.impossible_step()
    }

    /// Counts it; it is taken as none.
    fn impossible_step(&mut self) -> Increment {
        self.counters.impossible_steps = self.counters.impossible_steps.saturating_add(1);
        Increment::identity()
    }

    /// Appends a step that is believed. False where its stamp does not increase.
    fn take_step(&mut self, stamp_us: u64, step: Increment) -> bool {
        if let Some(unseen) = self.resuming.take() {
            // Across the reset: what the wheels counted, and what they may have done unseen.
            self.slam.coast(&step);
            self.slam.loosen(&diagonal(unseen));
            self.track = OdometryTrack::default();
            (self.pose_at, self.carried) = (Some(PoseInstant { odometry_us: stamp_us, stamp_us }), None);
            self.delay.interrupt();
        }
        self.carry();
        let taken = self.track.push(stamp_us, step).is_ok();
        self.counters.stamps_refused = self.counters.stamps_refused.saturating_add(u32::from(!taken));
        taken
    }

    /// Before the track forgets where the motion since the pose begins, its older part is taken out.
    fn carry(&mut self) {
        let Some(from_us) = self.motion_from_us() else { return };
        let Some(until_us) = self.track.until_before_forgetting(from_us) else { return };
        if let Some(motion) = self.track.between(from_us, until_us) {
            self.carried = Some((until_us, self.with_carried(motion)));
        }
    }

    /// Where in the track the motion since the pose goes on.
    fn motion_from_us(&self) -> Option<u64> {
        self.carried.map(|(until_us, _)| until_us).or(self.pose_at.map(|at| at.odometry_us))
    }

    #[inline(never)]
    fn with_carried(&self, motion: Increment) -> Increment {
        self.carried.map_or(motion, |(_, carried)| carried.then(&motion))
    }

    /// What of the delay is used, microseconds.
    fn delay_us(&self) -> i64 {
        i64::from((self.delay.used_s() * 1e6) as i32)
    }

    /// When, on the odometry's clock, a scan's middle beam was taken: as far as there are samples, and not before the pose.
    fn odometry_us(&self, middle_us: u64) -> u64 {
        let at_us = middle_us.saturating_add_signed(-self.delay_us());
        let newest_us = self.track.newest_us().map_or(middle_us, |newest_us| newest_us.max(middle_us));
        at_us.min(newest_us).max(self.pose_at.map_or(0, |at| at.odometry_us))
    }

    /// Up to when samples of the odometry are of use for a scan whose middle beam was taken at `middle_us`, microseconds.
    pub fn wanted_until_us(&self, middle_us: u64) -> u64 {
        let config = self.slam.config();
        let sweep_us = config.sensor.geometry.sweep_us() / 2;
        let beyond_us = config.odometry.delay.map_or(sweep_us, |_| sweep_us.max(RATE_WITHIN_US));
        middle_us.saturating_add_signed(-self.delay_us()).saturating_add(beyond_us)
    }

    /// How the base moved, by odometry, to a scan whose middle beam was taken at `middle_us`. `None` without odometry, and for a
    /// scan from before the pose. Work: at most 3·`K` steps and [`SWEEP_KNOTS`](crate::odometry::track::SWEEP_KNOTS).
    pub fn motion(&self, middle_us: u64) -> Option<ScanMotion> {
        if self.pose_at.is_some_and(|at| at.stamp_us > middle_us) {
            return None;
        }
        let geometry = &self.slam.config().sensor.geometry;
        let at_us = self.odometry_us(middle_us);
        let mut motion = self.track.scan_motion(self.motion_from_us(), at_us, geometry)?;
        motion.since_previous = self.with_carried(motion.since_previous);
        Some(motion)
    }

    /// The same where nothing is known but how far the robot may have moved, by [`UNKNOWN_SPEED`].
    pub fn unknown_motion(&self, middle_us: u64) -> ScanMotion {
        let since_us = self.pose_at.map_or(0, |at| middle_us.saturating_sub(at.stamp_us));
        let [distance_m, turn_rad] = UNKNOWN_SPEED.map(|speed| speed * since_us as f32 * 1e-6);
        ScanMotion::instantaneous(Increment { distance_m, turn_rad, ..Increment::identity() })
    }

    /// Takes a scan whose middle beam was taken at `middle_us`, with its [`Self::motion`]. `None` where there is none: the scan
    /// is passed over.
    pub fn scan(&mut self, middle_us: u64, ranges_mm: &[u16]) -> Option<SlamUpdate> {
        let Some(motion) = self.motion(middle_us) else {
            self.counters.scans_without_odometry = self.counters.scans_without_odometry.saturating_add(1);
            return None;
        };
        Some(self.scan_with(middle_us, ranges_mm, &motion))
    }

    /// Takes a scan with a motion that was asked for before, or is [unknown](Self::unknown_motion).
    pub fn scan_with(&mut self, middle_us: u64, ranges_mm: &[u16], motion: &ScanMotion) -> SlamUpdate {
        let at_us = self.odometry_us(middle_us);
        (self.pose_at, self.carried) = (Some(PoseInstant { odometry_us: at_us, stamp_us: middle_us }), None);
        let update = self.slam.process_scan(&Scan { ranges_mm }, motion);
        self.learn_delay(at_us, &update);
        update
    }

    /// Compares the turn by the scanner with that of the odometry.
    fn learn_delay(&mut self, at_us: u64, update: &SlamUpdate) {
        let config = self.slam.config();
        let Some(delay) = config.odometry.delay else { return };
        let left_out = update.odometry_left_out || update.odometry_useless || update.relocalisation.is_some();
        let fixed = update.observability.verdict == Verdict::Full
            && update.support >= config.state.good_score
            && !left_out;
        match self.turn_rate(at_us).filter(|_| fixed) {
            Some(rate) => self.delay.update(turn(&update.predicted, &update.pose), rate, &delay),
            None => self.delay.interrupt(),
        }
    }

    /// The odometry's turn rate around an instant, rad/s.
    fn turn_rate(&self, at_us: u64) -> Option<f32> {
        let (from_us, to_us) = (at_us.saturating_sub(RATE_WITHIN_US), at_us.saturating_add(RATE_WITHIN_US));
        Some(self.track.turn_between(from_us, to_us)? * (0.5e6 / RATE_WITHIN_US as f32))
    }

    /// Moves on by odometry alone to an instant, or the newest sample before it, where scans stay away; a scan from before the
    /// new instant is of no use any more. `None` if there is nothing to move on to.
    pub fn coast(&mut self, until_us: u64) -> Option<Isometry2<f32>> {
        let (oldest_us, newest_us) = self.track.span_us()?;
        let from_us = self.motion_from_us().unwrap_or(oldest_us);
        let to_us = newest_us.min(until_us.saturating_add_signed(-self.delay_us()));
        if to_us <= from_us {
            return None;
        }
        let motion = self.with_carried(self.track.between(from_us, to_us)?);
        let stamp_us = to_us.saturating_add_signed(self.delay_us());
        (self.pose_at, self.carried) = (Some(PoseInstant { odometry_us: to_us, stamp_us }), None);
        Some(self.slam.coast(&motion))
    }

    /// The same after a reset that came in the middle of any of the other calls. False where nothing can be kept.
    pub fn recover(&mut self) -> bool {
        let kept = self.slam.recover();
        self.resume();
        self.resuming = Some(UNSEEN_IN_WORK);
        kept
    }

    /// Takes up the map again after a reset: the clock has begun anew, the wheels' ticks go on from where they were last
    /// known, and the robot may have moved unseen, by [`UNSEEN`].
    pub fn resume(&mut self) {
        self.resuming = Some(UNSEEN);
        self.counters.resumed = self.counters.resumed.saturating_add(1);
    }
}

#[cfg(test)]
mod tests;
