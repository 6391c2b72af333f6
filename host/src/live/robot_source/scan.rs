//! Scans put together from their parts, as points in `base`.

use std::collections::VecDeque;

use slam_core::geometry::pose::pose;

use crate::link::from_robot::{Pose, Ranges, Scanner};
use crate::live::source::Scan;

/// Poses that a scan's parts may come after.
const POSES: usize = 8;

/// The scan that is coming in.
pub(super) struct Scans {
    scanner: Scanner,
    poses: VecDeque<(u32, [f32; 3])>,
    number: u32,
    ranges_mm: Vec<Option<u16>>,
}

impl Scans {
    /// Of this scanner.
    pub fn new(scanner: Scanner) -> Self {
        Self { scanner, poses: VecDeque::new(), number: 0, ranges_mm: Vec::new() }
    }

    /// The pose of a scan whose parts may come.
    pub fn remember(&mut self, of: &Pose) {
        self.poses.push_back((of.number, of.pose));
        if self.poses.len() > POSES {
            self.poses.pop_front();
        }
    }

    /// Takes a part; the scan, once it is whole. Each beam is shown from where the robot was in the middle of the sweep.
    pub fn take(&mut self, part: &Ranges) -> Option<Scan> {
        if part.number != self.number || self.ranges_mm.len() != usize::from(part.beams) {
            self.number = part.number;
            self.ranges_mm = vec![None; part.beams.into()];
        }
        let ranges = part.ranges.ranges_mm()?;
        for (place, range) in self.ranges_mm.iter_mut().skip(part.first.into()).zip(&ranges) {
            *place = Some(*range);
        }
        let whole: Vec<u16> = self.ranges_mm.iter().copied().collect::<Option<_>>()?;
        self.ranges_mm.clear();
        let (_, at) = self.poses.iter().find(|(number, _)| *number == part.number)?;
        Some(Scan { at: *at, points_mm: self.points_mm(&whole) })
    }

    fn points_mm(&self, ranges_mm: &[u16]) -> Vec<[i32; 2]> {
        let Scanner { first_bearing_rad, step_rad, min_mm, max_mm, base_from_laser, upside_down, .. } =
            self.scanner;
        let [x, y, heading] = base_from_laser;
        let base_from_laser = pose(x, y, heading);
        let seen = ranges_mm.iter().enumerate().filter(|(_, range)| (min_mm..=max_mm).contains(range));
        let point = |(beam, range): (usize, &u16)| {
            let (sin, cos) = (first_bearing_rad + beam as f32 * step_rad).sin_cos();
            let range_m = f32::from(*range) * 1e-3;
            let y = if upside_down { -range_m * sin } else { range_m * sin };
            let in_base = base_from_laser * nalgebra::Point2::new(range_m * cos, y);
            [in_base.x, in_base.y].map(|v| (v * 1e3).round() as i32)
        };
        seen.map(point).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::link::from_robot::{Cause, State};
    use link::ranges::Packed;

    #[test]
    fn a_scan_is_shown_once_all_parts_are_there() {
        let scanner = Scanner {
            beams: 3,
            first_bearing_rad: 0.0,
            step_rad: std::f32::consts::FRAC_PI_2,
            min_mm: 20,
            max_mm: 5600,
            base_from_laser: [0.1, 0.0, 0.0],
            upside_down: false,
            late_us: 0,
        };
        let pose = Pose {
            number: 7,
            at_us: 1,
            samples: 0,
            pose: [1.0, 2.0, 0.5],
            covariance: [0.0; 6],
            state: State::Tracking,
            lines: 0,
            took_us: 0,
            cause: Cause::Scan,
        };
        let part = |number, first, ranges: &[u16]| Ranges {
            number,
            at_us: 1,
            revolution_us: 100_000,
            beams: 3,
            first,
            ranges: Packed::of(ranges),
        };
        let mut scans = Scans::new(scanner);
        scans.remember(&pose);
        assert_eq!(scans.take(&part(7, 0, &[1000, 2000])), None);
        let scan = scans.take(&part(7, 2, &[0])).unwrap();
        assert_eq!(
            (scan.at, scan.points_mm),
            (pose.pose, vec![[1100, 0], [100, 2000]]),
            "a code is no obstacle"
        );
        // A part that was lost: the next scan has it whole.
        assert_eq!(scans.take(&part(8, 0, &[1000, 2000])), None);
        assert_eq!(scans.take(&part(9, 2, &[1000])), None);
        assert_eq!(scans.take(&part(9, 0, &[1000, 1000])), None, "of a pose that was not told");
        let mut hanging = Scans::new(Scanner { upside_down: true, ..scanner });
        hanging.remember(&pose);
        let scan = hanging.take(&part(7, 0, &[1000, 2000, 1000])).unwrap();
        assert_eq!(scan.points_mm[1], [100, -2000]);
    }
}
