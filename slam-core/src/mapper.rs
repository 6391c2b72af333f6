//! The one door: odometry and scans go in with their stamps, the pose comes out.
//!
//! [`Slam`] wants the motion of each scan; this keeps the odometry that tells it, leaves out what no robot can have done, moves on
//! by odometry alone when scans stay away, and takes up its map again after a reset. It is what runs on the microcontroller
//! and what replays logs on a PC: given the same samples and scans in the same order both compute the same bits.

use core::mem::MaybeUninit;

use nalgebra::{Isometry2, Matrix3, Vector3};

use crate::config::{ConfigError, SlamConfig};
use crate::geometry::pose::turn;
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

    /// Takes a saved map, see [`Slam::load`].
    pub fn load(&mut self, map: &StoredMap<'_>, at: Option<Isometry2<f32>>) -> Result<(), MapError> {
        self.slam.load(map, at)
    }

    /// Freezes the map, or lets it learn again, see [`Slam::set_mapping`].
    pub fn set_mapping(&mut self, mapping: bool) {
        self.slam.set_mapping(mapping);
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
            let sigmas = Vector3::from(unseen);
            self.slam.loosen(&Matrix3::from_diagonal(&sigmas.component_mul(&sigmas)));
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
mod tests {
    use super::*;
    use crate::geometry::pose::components;
    use crate::odometry::Integration;

    const DRIVE: DifferentialDrive = DifferentialDrive {
        left_wheel_radius_m: 0.05,
        right_wheel_radius_m: 0.05,
        track_m: 0.3,
        ticks_per_turn: 2000.0,
    };

    fn mapper() -> Mapper<64, 64> {
        Mapper::new(SlamConfig::default(), DRIVE).unwrap()
    }

    /// Straight on, 200 samples a second, ten ticks each.
    fn ticks(k: u64) -> WheelTicks {
        // Across the wrap of 32 bits.
        let at = (i32::MAX - 500).wrapping_add(10 * k as i32);
        WheelTicks { stamp_us: 5_000 * k, left: at, right: at }
    }

    /// What ten ticks are, metres.
    const STEP_M: f32 = 10.0 / 2000.0 * core::f32::consts::TAU * 0.05;

    #[test]
    fn without_scans_it_goes_on_by_odometry_and_says_how_sure_it_is() {
        let mut mapper = mapper();
        assert_eq!(mapper.coast(u64::MAX), None);
        for k in 0..1000 {
            mapper.push(ticks(k));
            if k % 20 == 19 {
                mapper.coast(u64::MAX).unwrap();
            }
        }
        let x = mapper.slam().pose().translation.x;
        assert!((x - 999.0 * STEP_M).abs() < 1e-3, "{x}");
        assert_eq!(mapper.slam().counters().coasted, 50);
        assert!(mapper.slam().covariance().m11 > 1e-6);
        assert_eq!(mapper.coast(u64::MAX), None);
    }

    #[test]
    fn after_a_reset_the_pose_goes_on_by_the_ticks_with_less_certainty() {
        let mut mapper = mapper();
        for k in 0..100 {
            mapper.push(ticks(k));
        }
        mapper.coast(u64::MAX).unwrap();
        let before = (components(&mapper.slam().pose()), mapper.slam().covariance());
        mapper.resume();
        // The clock has begun anew; ten samples were lost.
        mapper.push(WheelTicks { stamp_us: 7, ..ticks(110) });
        mapper.push(WheelTicks { stamp_us: 5_007, ..ticks(111) });
        mapper.coast(u64::MAX).unwrap();
        let moved = components(&mapper.slam().pose()) - before.0;
        assert!((moved - Vector3::new(12.0 * STEP_M, 0.0, 0.0)).norm() < 1e-4, "{moved}");
        let grown = mapper.slam().covariance() - before.1;
        assert!(grown.m11 > 3.9e-4 && grown.m33 > 3.9e-4, "{grown}");
        assert_eq!(mapper.counters().resumed, 1);
    }

    #[test]
    fn what_the_wheels_turned_while_the_firmware_hung_is_motion() {
        let mut mapper = mapper();
        for k in 0..100 {
            mapper.push(ticks(k));
        }
        mapper.coast(u64::MAX).unwrap();
        let before = mapper.slam().pose().translation.x;
        mapper.resume();
        // 3 s at 0.31 m/s went by.
        mapper.push(WheelTicks { stamp_us: 7, ..ticks(700) });
        mapper.push(WheelTicks { stamp_us: 5_007, ..ticks(701) });
        mapper.coast(u64::MAX).unwrap();
        let moved = mapper.slam().pose().translation.x - before;
        assert!((moved - 602.0 * STEP_M).abs() < 1e-3, "{moved}");
        assert_eq!(mapper.counters().impossible_steps, 0);
    }

    #[test]
    fn a_reset_in_the_middle_of_a_scan_keeps_what_is_whole() {
        let mut mapper = mapper();
        for k in 0..100 {
            mapper.push(ticks(k));
        }
        for scan in 0..3 {
            mapper.scan(200_000 + 100_000 * scan, &[1500; 682]).unwrap();
        }
        let segments = mapper.slam().map().segments().len();
        assert!(segments > 3);
        assert!(mapper.recover());
        mapper.push(WheelTicks { stamp_us: 7, ..ticks(110) });
        assert_eq!(mapper.slam().map().segments().len(), segments);
        assert!(mapper.slam().covariance().m11 > 24e-4);
        // And it goes on.
        mapper.push(WheelTicks { stamp_us: 100_007, ..ticks(111) });
        assert!(mapper.scan(60_000, &[1500; 682]).unwrap().corrected);
    }

    #[test]
    fn counters_that_restart_are_no_motion() {
        let mut mapper = mapper();
        // Ten metres on the counters, then from zero on.
        for k in 0..200 {
            let ticks = if k < 100 { 64_000 + 10 * k as i32 } else { 10 * (k as i32 - 100) };
            mapper.push(WheelTicks { stamp_us: 5_000 * k, left: ticks, right: ticks });
            if k % 20 == 19 {
                mapper.coast(u64::MAX).unwrap();
            }
        }
        assert_eq!((mapper.counters().impossible_steps, mapper.counters().counters_restarted), (1, 1));
        let x = mapper.slam().pose().translation.x;
        assert!((x - 198.0 * STEP_M).abs() < 1e-3, "{x}");
    }

    #[test]
    fn what_cannot_be_used_is_counted() {
        let mut mapper = mapper();
        assert!(mapper.scan(1_000, &[1000; 682]).is_none());
        mapper.push(ticks(4));
        mapper.push(ticks(3));
        mapper.push(ticks(4));
        assert!(mapper.scan(30_000, &[1000; 682]).is_some());
        // Older than the pose.
        assert!(mapper.scan(1_000, &[1000; 682]).is_none());
        let expected =
            MapperCounters { stamps_refused: 2, scans_without_odometry: 2, ..MapperCounters::default() };
        assert_eq!(mapper.counters(), expected);
        // The ticks of a refused sample are not lost.
        mapper.push(ticks(5));
        assert_eq!(mapper.last_ticks(), Some(ticks(5)));
    }

    /// A curve, 10 samples to the scan.
    fn curve(mapper: &mut Mapper<64, 64>, samples: core::ops::Range<u64>) -> Vector3<f32> {
        for k in samples.clone() {
            mapper.push(WheelTicks { stamp_us: 5_000 * k, left: 6 * k as i32, right: 10 * k as i32 });
        }
        let middle_us = 5_000 * (samples.end - 1);
        let motion = mapper.motion(middle_us).unwrap();
        mapper.scan(middle_us, &[0; 682]).unwrap();
        components(&motion.since_previous.before_from_after)
    }

    #[test]
    fn a_gap_between_scans_is_bridged_however_few_samples_the_track_holds() {
        let mut mapper = mapper();
        assert_eq!(curve(&mut mapper, 0..10), Vector3::zeros(), "the map begins at the first scan");
        // The closed form of an arc of 1000 samples, in f64.
        let moved = curve(&mut mapper, 10..1010);
        let (way, turn) = (1000.0 * f64::from(STEP_M) * 0.8, 1000.0 * f64::from(STEP_M) * 0.4 / 0.3);
        let (x, y) = (way / turn * turn.sin(), way / turn * (1.0 - turn.cos()));
        let heading = turn.sin().atan2(turn.cos());
        for (got, want) in moved.iter().zip([x, y, heading]) {
            assert!((f64::from(*got) - want).abs() < 1e-3, "{moved} {x} {y} {heading}");
        }
        // And coasting takes it up too.
        for k in 1010..1500 {
            mapper.push(WheelTicks { stamp_us: 5_000 * k, left: 6 * k as i32, right: 10 * k as i32 });
        }
        let before = mapper.slam().pose();
        mapper.coast(u64::MAX).unwrap();
        let turned = components(&(before.inverse() * mapper.slam().pose())).z;
        let turn = 490.0 * f64::from(STEP_M) * 0.4 / 0.3;
        assert!((f64::from(turned) - turn.sin().atan2(turn.cos())).abs() < 1e-2, "{turned} {turn}");
    }

    #[test]
    fn a_delay_that_cannot_be_is_refused_by_name() {
        let refused = |break_it: fn(&mut crate::odometry::delay::DelayConfig)| {
            let mut config = SlamConfig::default();
            break_it(config.odometry.delay.as_mut().unwrap());
            Mapper::<64, 64>::new(config, DRIVE).err()
        };
        let named = |field| Some(ConfigError::Invalid { field });
        assert_eq!(refused(|d| d.sigma_s = 0.0), named("odometry.delay.sigma_s"));
        assert_eq!(refused(|d| d.max_s = f32::NAN), named("odometry.delay.max_s"));
        assert_eq!(refused(|d| d.max_sigma_s = -1.0), named("odometry.delay.max_sigma_s"));
        assert_eq!(refused(|d| d.significance = f32::INFINITY), named("odometry.delay.significance"));
        assert!(refused(|_| ()).is_none());
    }

    /// A robot that turns to and fro, whose scans are stamped late: the lookup follows, and coasting with it.
    #[test]
    fn scans_are_looked_up_by_the_delay_that_was_found() {
        let late_us = 40_000;
        let rate = |t: f64| 0.8 * (libm::sin(2.0 * t) + 0.5 * libm::sin(3.1 * t));
        // Its integral, in f64.
        let heading =
            |t: f64| 0.8 * (0.5 * (1.0 - libm::cos(2.0 * t)) + 0.5 / 3.1 * (1.0 - libm::cos(3.1 * t)));
        assert!((heading(1.001) - heading(1.0) - 0.001 * rate(1.0005)).abs() < 1e-6);
        let mut mapper = Mapper::<64, 64>::new(SlamConfig::default(), None).unwrap();
        // A square room, seen from its middle and from a scanner in it.
        let mounting = mapper.slam().config().sensor.mounting.base_from_laser;
        let geometry = mapper.slam().config().sensor.geometry;
        let mut said = 0.0;
        for k in 0..12_000u64 {
            let stamp_us = 10_000 * k;
            let turned = heading(stamp_us as f64 * 1e-6) - said;
            said += turned;
            let moved = Increment::from_motion(crate::geometry::pose::pose(0.0, 0.0, turned as f32));
            mapper.push_motion(stamp_us, moved);
            // What was taken 0.15 s ago is delivered.
            if k % 10 == 0 && k > 40 {
                let taken_s = (stamp_us - 150_000) as f64 * 1e-6;
                let ranges: [u16; 682] = core::array::from_fn(|beam| {
                    let at_s = taken_s + (beam as f64 - 340.5) / 1024.0 * 0.1;
                    let map_from_laser =
                        crate::geometry::pose::pose(0.0, 0.0, heading(at_s) as f32) * mounting;
                    let way = map_from_laser.rotation * Isometry2::rotation(geometry.bearing(beam));
                    let (c, s) = (way.rotation.re, way.rotation.im);
                    let from = map_from_laser.translation.vector;
                    let to_wall = |from: f32, along: f32, half: f32| {
                        if along.abs() < 1e-6 { f32::MAX } else { (half * along.signum() - from) / along }
                    };
                    (1000.0 * to_wall(from.x, c, 1.7).min(to_wall(from.y, s, 2.3))) as u16
                });
                let middle_us = stamp_us - 150_000 + late_us;
                mapper.scan(middle_us, &ranges).unwrap();
                assert_eq!(mapper.pose_us(), Some(middle_us));
            }
        }
        let delay = mapper.delay().unwrap();
        assert!((delay.delay_s - 0.04).abs() < 0.008 && delay.used, "{delay:?}");
        // On the scans' clock.
        let pose_us = mapper.pose_us().unwrap();
        assert!(mapper.coast(pose_us - 5_000).is_none() && mapper.coast(pose_us + 20_000).is_some());
        assert_eq!(mapper.pose_us(), Some(pose_us + 20_000));
        assert!(mapper.motion(pose_us).is_none());
    }

    #[test]
    fn motions_and_ticks_say_the_same() {
        let (mut by_ticks, mut by_motions) =
            (mapper(), Mapper::<64, 64>::new(SlamConfig::default(), None).unwrap());
        for scan in 0..5u64 {
            for k in 20 * scan..20 * scan + 20 {
                by_ticks.push(ticks(k));
                let moved = if k == 0 { 0 } else { 10 };
                by_motions.push_motion(5_000 * k, DRIVE.increment(moved, moved, Integration::Arc));
            }
            let middle_us = 100_000 * scan + 50_000;
            let motions = [by_ticks.motion(middle_us), by_motions.motion(middle_us)];
            assert_eq!(motions[0], motions[1]);
            let poses =
                [&mut by_ticks, &mut by_motions].map(|m| m.scan(middle_us, &[1500; 682]).unwrap().pose);
            assert_eq!(poses[0], poses[1]);
        }
        by_motions.push_motion(500_000, Increment::from_motion(crate::geometry::pose::pose(3.0, 0.0, 0.0)));
        assert_eq!(by_motions.counters().impossible_steps, 1);
        // Ticks without wheels are no motion.
        by_motions.push(ticks(110));
        by_motions.push(ticks(120));
        let before = by_motions.slam().pose();
        assert!(by_motions.coast(600_000).is_some());
        assert!((by_motions.slam().pose().translation.vector - before.translation.vector).norm() < 0.2);
    }

    #[test]
    fn counters_of_sixteen_bits_wrap_in_the_upper_half() {
        let drive = DifferentialDrive { ticks_per_turn: DRIVE.ticks_per_turn * 65_536.0, ..DRIVE };
        let (mut wide, mut narrow) = (mapper(), Mapper::<64, 64>::new(SlamConfig::default(), drive).unwrap());
        for k in 0..40u64 {
            wide.push(ticks(k));
            let at = (65_300 + 10 * k) as u16;
            let upper = i32::from(at as i16) << 16;
            narrow.push(WheelTicks { stamp_us: 5_000 * k, left: upper, right: upper });
        }
        assert_eq!(wide.motion(150_000), narrow.motion(150_000));
        assert_eq!(narrow.counters().impossible_steps, 0);
    }

    #[test]
    fn without_odometry_a_scan_may_have_come_from_as_far_as_a_robot_drives() {
        let mut mapper = Mapper::<64, 64>::new(SlamConfig::default(), None).unwrap();
        assert_eq!(mapper.motion(100_000), None);
        for (middle_us, since_s) in [(100_000, 0.0), (300_000, 0.2)] {
            let motion = mapper.unknown_motion(middle_us);
            assert!((motion.since_previous.turn_rad - UNKNOWN_SPEED[1] * since_s).abs() < 1e-6);
            assert!((motion.since_previous.distance_m - UNKNOWN_SPEED[0] * since_s).abs() < 1e-6);
            mapper.scan_with(middle_us, &[1500; 682], &motion);
        }
        assert_eq!(mapper.slam().counters().scans, 2);
    }
}
