//! The whole robot as a firmware holds it: wheel ticks and scans go in with their stamps, the pose comes out.
//!
//! [`Slam`] wants the motion of each scan; this keeps the odometry that tells it, moves on by odometry alone when scans
//! stay away, and takes up its map again after a reset. It is what runs on the microcontroller, so that a PC given the
//! same ticks and scans in the same order computes the same bits.

use core::mem::MaybeUninit;

use nalgebra::{Isometry2, Matrix3, Vector3};

use crate::config::{ConfigError, SlamConfig};
use crate::odometry::track::OdometryTrack;
use crate::odometry::{DifferentialDrive, Increment};
use crate::sensor::scan::Scan;
use crate::slam::{Slam, SlamUpdate};

/// Wheel ticks at an instant.
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

/// How long a reset may take, microseconds: the wait of a watchdog and the boot, with room to spare. The wheels may go on turning.
const RESET_US: u64 = 10_000_000;

/// What happened to the odometry since the start.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct MapperCounters {
    /// Samples whose stamp did not increase; they were passed over, their ticks come with the next.
    pub stamps_refused: u32,
    /// Scans for which there was no odometry yet, or that are older than the last; they were passed over.
    pub scans_without_odometry: u32,
    /// Times that the robot took up its map again after a reset.
    pub resumed: u32,
    /// Samples between which the wheels cannot have turned so far; their ticks were left out.
    pub impossible_steps: u32,
    /// Those of them after which both counters stood near zero: they had been restarted.
    pub counters_restarted: u32,
}

/// Ticks and scans in, poses out. Room for `N` map segments and `K` odometry samples, which must span a scan and its
/// way to here: 64 at 200 Hz are 0.32 s.
///
/// RAM: [`Mapper::BYTES`], that of [`Slam`] and 48 bytes for each sample.
pub struct Mapper<const N: usize, const K: usize> {
    slam: Slam<N>,
    drive: DifferentialDrive,
    track: OdometryTrack<K>,
    last_ticks: Option<WheelTicks>,
    /// The instant of the pose.
    pose_us: Option<u64>,
    /// Set while the time of the next sample has nothing to do with that of the last.
    resuming: Option<[f32; 3]>,
    counters: MapperCounters,
}

impl<const N: usize, const K: usize> Mapper<N, K> {
    /// Size in RAM.
    pub const BYTES: usize = core::mem::size_of::<Self>();

    /// An empty map.
    pub fn new(config: SlamConfig, drive: DifferentialDrive) -> Result<Self, ConfigError> {
        Slam::<N>::check(&config)?;
        let mut mapper = Self::blank(config, drive);
        mapper.slam.prepare();
        Ok(mapper)
    }

    /// The same, made where it is to stay: no copy of it passes over the stack.
    pub fn new_in(
        place: &mut MaybeUninit<Self>,
        config: SlamConfig,
        drive: DifferentialDrive,
    ) -> Result<&mut Self, ConfigError> {
        Slam::<N>::check(&config)?;
        let mapper = place.write(Self::blank(config, drive));
        mapper.slam.prepare();
        Ok(mapper)
    }

    #[inline(always)]
    fn blank(mut config: SlamConfig, drive: DifferentialDrive) -> Self {
        config.odometry.track_m.get_or_insert(drive.track_m);
        Self {
            slam: Slam::blank(config),
            drive,
            track: OdometryTrack::default(),
            last_ticks: None,
            pose_us: None,
            resuming: None,
            counters: MapperCounters::default(),
        }
    }

    /// Map, pose and counters.
    pub fn slam(&self) -> &Slam<N> {
        &self.slam
    }

    /// Counters since the start.
    pub fn counters(&self) -> MapperCounters {
        self.counters
    }

    /// The instant of the pose, microseconds; `None` before the first sample.
    pub fn pose_us(&self) -> Option<u64> {
        self.pose_us
    }

    /// Ticks and stamp of the newest sample.
    pub fn last_ticks(&self) -> Option<WheelTicks> {
        self.last_ticks
    }

    /// Takes a sample of the wheels.
    pub fn push(&mut self, ticks: WheelTicks) {
        let step = self.step_to(&ticks);
        if let Some(unseen) = self.resuming.take() {
            // Across the reset: what the wheels counted, and what they may have done unseen.
            self.slam.coast(&step);
            let sigmas = Vector3::from(unseen);
            self.slam.loosen(&Matrix3::from_diagonal(&sigmas.component_mul(&sigmas)));
            self.track = OdometryTrack::default();
            self.pose_us = None;
        }
        if self.track.push(ticks.stamp_us, step).is_err() {
            self.counters.stamps_refused = self.counters.stamps_refused.saturating_add(1);
            return;
        }
        self.last_ticks = Some(ticks);
        self.pose_us.get_or_insert(ticks.stamp_us);
    }

    /// What the wheels did since the last sample.
    fn step_to(&mut self, ticks: &WheelTicks) -> Increment {
        let integration = self.slam.config().odometry.integration;
        let Some(last) = self.last_ticks else { return self.drive.increment(0, 0, integration) };
        let (left, right) = (ticks.left.wrapping_sub(last.left), ticks.right.wrapping_sub(last.right));
        let step = self.drive.increment(left, right, integration);
        // Across a reset time is not known.
        let since_us =
            if self.resuming.is_some() { RESET_US } else { ticks.stamp_us.saturating_sub(last.stamp_us) };
        if self.drive.is_possible(left, right, since_us) {
            return step;
        }
        self.counters.impossible_steps = self.counters.impossible_steps.saturating_add(1);
        if self.drive.is_possible(ticks.left, ticks.right, since_us) {
            self.counters.counters_restarted = self.counters.counters_restarted.saturating_add(1);
        }
        self.drive.increment(0, 0, integration)
    }

    /// Takes a scan whose middle beam was taken at `middle_us`. `None` without odometry for it.
    pub fn scan(&mut self, middle_us: u64, ranges_mm: &[u16]) -> Option<SlamUpdate> {
        let geometry = self.slam.config().sensor.geometry;
        let from_us = self.pose_us.filter(|from| *from <= middle_us);
        let motion = from_us.and_then(|from| self.track.scan_motion(Some(from), middle_us, &geometry));
        let Some(motion) = motion else {
            self.counters.scans_without_odometry = self.counters.scans_without_odometry.saturating_add(1);
            return None;
        };
        self.pose_us = Some(middle_us);
        Some(self.slam.process_scan(&Scan { ranges_mm }, &motion))
    }

    /// Moves on by odometry alone to an instant, or the newest sample before it, where scans stay away. To be called often
    /// enough that the track still holds the instant of the pose; a scan from before the new one is of no use any more. `None` if
    /// there is nothing to move on to.
    pub fn coast(&mut self, until_us: u64) -> Option<Isometry2<f32>> {
        let (from_us, newest_us) = (self.pose_us?, self.track.span_us()?.1);
        let to_us = newest_us.min(until_us);
        if to_us <= from_us {
            return None;
        }
        let motion = self.track.between(from_us, to_us)?;
        self.pose_us = Some(to_us);
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
        // Older than the pose.
        assert!(mapper.scan(1_000, &[1000; 682]).is_none());
        assert!(mapper.scan(30_000, &[1000; 682]).is_some());
        let expected =
            MapperCounters { stamps_refused: 2, scans_without_odometry: 2, ..MapperCounters::default() };
        assert_eq!(mapper.counters(), expected);
        // The ticks of a refused sample are not lost.
        mapper.push(ticks(5));
        assert_eq!(mapper.last_ticks(), Some(ticks(5)));
    }
}
