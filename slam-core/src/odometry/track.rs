//! The recent past of the odometry, for the motion at the instants a scan asks for.
//!
//! In: stamped increments, as often as the encoders are sampled. Out: the motion between two scans and the poses the
//! base had while the scanner swept ([`ScanMotion`]). Between two samples the twist is taken as constant.

use heapless::HistoryBuf;
use nalgebra::Isometry2;

use crate::geometry::pose::{exp, log, normalized, turn};
use crate::odometry::Increment;
use crate::sensor::scan::ScanGeometry;

/// Number of instants, evenly spread from the first to the last beam, at which a scan's motion is given.
pub const SWEEP_KNOTS: usize = 17;

/// How the base moved for one scan. All instants are the beams' own.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ScanMotion {
    /// From the previous scan's middle beam to this scan's.
    pub since_previous: Increment,
    /// Pose of the base at each knot, in the base at the middle beam. Knot 0 is the first beam's instant.
    pub middle_from_knot: [Isometry2<f32>; SWEEP_KNOTS],
    /// Time from the first beam to the last, as a share of the time since the previous scan; zero where it is not known.
    pub sweep_share: f32,
}

impl ScanMotion {
    /// A motion between scans whose sweep is too short, or too little known, to be undone.
    pub fn instantaneous(since_previous: Increment) -> Self {
        Self { since_previous, middle_from_knot: [Isometry2::identity(); SWEEP_KNOTS], sweep_share: 0.0 }
    }

    /// The same scan with another motion since the previous one, which went on evenly while the scanner swept.
    #[must_use]
    pub fn evenly(&self, since_previous: Increment) -> Self {
        let twist = log(&since_previous.before_from_after) * self.sweep_share;
        let mut knot = 0;
        let middle_from_knot = [(); SWEEP_KNOTS].map(|()| {
            knot += 1;
            exp(&(twist * ((knot - 1) as f32 / (SWEEP_KNOTS - 1) as f32 - 0.5)))
        });
        Self { since_previous, middle_from_knot, ..*self }
    }

    /// Whether every number is finite.
    pub fn is_finite(&self) -> bool {
        self.since_previous.is_finite() && self.middle_from_knot.iter().all(crate::geometry::pose::is_finite)
    }
}

#[derive(Clone, Copy, Debug)]
struct Knot {
    stamp_us: u64,
    odom_from_base: Isometry2<f32>,
    /// The increment that led here from the knot before.
    step: Increment,
}

/// Stamps that were not newer than the last one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct StampNotIncreasing {
    /// Newest stamp held, µs.
    pub last_us: u64,
    /// The stamp refused, µs.
    pub actual_us: u64,
}

/// The last `K` odometry samples, 48 bytes each. The oldest is overwritten.
#[derive(Clone, Debug)]
pub struct OdometryTrack<const K: usize> {
    knots: HistoryBuf<Knot, K>,
}

impl<const K: usize> Default for OdometryTrack<K> {
    fn default() -> Self {
        Self { knots: HistoryBuf::new() }
    }
}

impl<const K: usize> OdometryTrack<K> {
    /// Size of the track in RAM.
    pub const BYTES: usize = core::mem::size_of::<Self>();

    /// Appends the motion since the last sample, ended at `stamp_us`. The first sample starts `odom` at its end.
    pub fn push(&mut self, stamp_us: u64, step: Increment) -> Result<(), StampNotIncreasing> {
        let odom_from_base = match self.knots.recent() {
            Some(last) if stamp_us <= last.stamp_us => {
                return Err(StampNotIncreasing { last_us: last.stamp_us, actual_us: stamp_us });
            }
            Some(last) => normalized(&(last.odom_from_base * step.before_from_after)),
            None => step.before_from_after,
        };
        self.knots.write(Knot { stamp_us, odom_from_base, step });
        Ok(())
    }

    /// Stamps of the oldest and newest sample held, µs.
    #[inline(never)]
    pub fn span_us(&self) -> Option<(u64, u64)> {
        Some((self.knots.oldest_ordered().next()?.stamp_us, self.knots.recent()?.stamp_us))
    }

    /// Stamp of the newest sample, µs.
    pub(crate) fn newest_us(&self) -> Option<u64> {
        self.knots.recent().map(|knot| knot.stamp_us)
    }

    /// Where one of the next samples overwrites what tells the motion since an instant: a later one, up to which that motion is to be
    /// taken out before. `None` as long as it is held.
    pub(crate) fn until_before_forgetting(&self, from_us: u64) -> Option<u64> {
        let knot = self.knots.oldest_ordered().nth(K / 16 + 1)?;
        (self.knots.len() == K && knot.stamp_us > from_us).then_some(knot.stamp_us)
    }

    /// Pose of the base in `odom` at an instant. Before the first and after the last sample: that sample's pose.
    ///
    /// `None` without samples. Work: at most `K` steps.
    pub fn pose_at(&self, stamp_us: u64) -> Option<Isometry2<f32>> {
        self.poses_at([stamp_us]).map(|[pose]| pose)
    }

    /// The same at several instants, the earliest first. Work: at most `K` + `M` steps.
    fn poses_at<const M: usize>(&self, stamps_us: [u64; M]) -> Option<[Isometry2<f32>; M]> {
        let mut poses = [Isometry2::identity(); M];
        self.fill(&stamps_us, &mut poses)?;
        Some(poses)
    }

    /// Compiled once for all numbers of instants: 0.4 kB of flash less.
    #[inline(never)]
    fn fill(&self, stamps_us: &[u64], poses: &mut [Isometry2<f32>]) -> Option<()> {
        let mut knots = self.knots.oldest_ordered();
        let mut before = knots.next()?;
        let mut after = knots.next();
        for (&stamp_us, pose) in stamps_us.iter().zip(poses) {
            while let Some(knot) = after.filter(|knot| knot.stamp_us <= stamp_us) {
                (before, after) = (knot, knots.next());
            }
            *pose = match after {
                Some(after) if stamp_us > before.stamp_us => interpolate(before, after, stamp_us),
                _ => before.odom_from_base,
            };
        }
        Some(())
    }

    /// The turn from one instant to a later one, radians. `None` where that is not held wholly.
    pub(crate) fn turn_between(&self, from_us: u64, to_us: u64) -> Option<f32> {
        let (oldest_us, newest_us) = self.span_us()?;
        let [before, after] =
            self.poses_at([from_us, to_us]).filter(|_| oldest_us <= from_us && to_us <= newest_us)?;
        Some(turn(&before, &after))
    }

    /// The motion from one instant to a later one, with the way travelled on it. `None` without samples.
    #[inline(never)]
    pub fn between(&self, from_us: u64, to_us: u64) -> Option<Increment> {
        let [before, after] = self.poses_at([from_us, to_us])?;
        let before_from_after = before.inverse() * after;
        let (mut distance_m, mut turn_rad) = (0.0, 0.0);
        let mut previous: Option<&Knot> = None;
        for knot in self.knots.oldest_ordered() {
            if let Some(p) = previous.filter(|p| p.stamp_us < to_us && knot.stamp_us > from_us) {
                let overlap = knot.stamp_us.min(to_us).saturating_sub(p.stamp_us.max(from_us));
                let share = overlap as f32 / (knot.stamp_us - p.stamp_us) as f32;
                distance_m += share * knot.step.distance_m;
                turn_rad += share * knot.step.turn_rad;
            }
            previous = Some(knot);
        }
        Some(Increment { before_from_after, distance_m, turn_rad })
    }

    /// The motion for a scan whose middle beam was taken at `middle_us`, the scan before at `previous_us`.
    ///
    /// Without a previous scan the increment is the identity. `None` without samples. Work: at most
    /// 3·`K` + [`SWEEP_KNOTS`] steps.
    pub fn scan_motion(
        &self,
        previous_us: Option<u64>,
        middle_us: u64,
        geometry: &ScanGeometry,
    ) -> Option<ScanMotion> {
        let since_previous = match previous_us {
            Some(previous) => self.between(previous, middle_us)?,
            None => Increment::identity(),
        };
        let half_sweep_us = geometry.sweep_us() / 2;
        let first_us = middle_us.saturating_sub(half_sweep_us);
        let mut k = 0;
        let knots = self.poses_at([(); SWEEP_KNOTS].map(|()| {
            k += 1;
            first_us + 2 * half_sweep_us * (k - 1) / (SWEEP_KNOTS as u64 - 1)
        }))?;
        let middle_from_odom = self.pose_at(middle_us)?.inverse();
        let interval_us = previous_us.map_or(0, |previous| middle_us.saturating_sub(previous));
        let sweep_share = if interval_us > 0 { geometry.sweep_us() as f32 / interval_us as f32 } else { 0.0 };
        let middle_from_knot = knots.map(|knot| middle_from_odom * knot);
        Some(ScanMotion { since_previous, middle_from_knot, sweep_share })
    }
}

fn interpolate(before: &Knot, after: &Knot, stamp_us: u64) -> Isometry2<f32> {
    let whole_us = (after.stamp_us - before.stamp_us) as f32;
    let share = (stamp_us - before.stamp_us) as f32 / whole_us;
    before.odom_from_base * exp(&(log(&after.step.before_from_after) * share))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::pose::{components, pose};
    use core::f32::consts::PI;

    fn arc_track() -> OdometryTrack<8> {
        // A circle of radius 1 m to the left, 0.5 rad in each 100 ms.
        let mut track = OdometryTrack::default();
        let step = Increment::from_motion(exp(&nalgebra::Vector3::new(0.5, 0.0, 0.5)));
        track.push(1_000_000, Increment::identity()).unwrap();
        for k in 1..=6u64 {
            track.push(1_000_000 + 100_000 * k, step).unwrap();
        }
        track
    }

    #[test]
    fn between_samples_the_base_follows_the_arc() {
        let track = arc_track();
        let at = components(&track.pose_at(1_150_000).unwrap());
        assert!((at.x - 0.75f32.sin()).abs() < 1e-5, "{at}");
        assert!((at.y - (1.0 - 0.75f32.cos())).abs() < 1e-5, "{at}");
        assert!((at.z - 0.75).abs() < 1e-5, "{at}");
    }

    #[test]
    fn way_is_shared_out_over_parts_of_samples() {
        let way = arc_track().between(1_050_000, 1_325_000).unwrap();
        assert!((way.distance_m - 1.375).abs() < 1e-5);
        assert!((way.turn_rad - 1.375).abs() < 1e-5);
    }

    #[test]
    fn instants_outside_are_held_at_the_ends_and_old_stamps_refused() {
        let mut track = arc_track();
        assert_eq!(track.pose_at(0), track.pose_at(1_000_000));
        assert_eq!(track.pose_at(u64::MAX), track.pose_at(1_600_000));
        let refused = track.push(1_600_000, Increment::identity());
        assert_eq!(refused, Err(StampNotIncreasing { last_us: 1_600_000, actual_us: 1_600_000 }));
        assert_eq!(OdometryTrack::<4>::default().pose_at(3), None);
    }

    #[test]
    fn the_oldest_sample_is_overwritten() {
        let mut track = arc_track();
        for k in 0..20u64 {
            track.push(2_000_000 + k, Increment::from_motion(pose(0.1, 0.0, PI / 8.0))).unwrap();
        }
        assert_eq!(track.span_us(), Some((2_000_012, 2_000_019)));
    }

    #[test]
    fn sweep_knots_run_from_the_first_beam_to_the_last() {
        let geometry = ScanGeometry { revolution_us: 100_000, ..ScanGeometry::URG_04LX };
        let track = arc_track();
        let motion = track.scan_motion(Some(1_200_000), 1_300_000, &geometry).unwrap();
        // 5 rad/s for half of the sweep.
        let half_rad = 5.0 * 0.5 * geometry.sweep_us() as f32 * 1e-6;
        let first = components(&motion.middle_from_knot[0]);
        let last = components(&motion.middle_from_knot[SWEEP_KNOTS - 1]);
        assert!((first.z + half_rad).abs() < 1e-3, "{first} {half_rad}");
        assert!((last.z - half_rad).abs() < 1e-3, "{last}");
        assert!((motion.since_previous.turn_rad - 0.5).abs() < 1e-5);
    }
}
