//! A measurement as the filter takes it: the innovation of a line's offset and direction, its noise R, and its Jacobian H by the
//! states.

use nalgebra::Vector3;

use crate::ekf::state::{POSE, STATES, line_states};
use crate::geometry::line_observation::LineObservation;
use crate::geometry::pose::cross;
use crate::geometry::segment::Segment;

/// Difference between two lines, in offset (m) and direction (rad), linear in the error state δ: r(δ) = r(0) + H·δ.
#[derive(Clone, Debug)]
pub(crate) struct Measurement {
    /// r(0), observed minus expected.
    pub residual: [f32; 2],
    /// Diagonal of R.
    pub noise: [f32; 2],
    /// H.
    pub jacobian: Jacobian,
}

/// Rows of H for an offset and a direction; zero but for the pose and up to two lines.
#[derive(Clone, Debug)]
pub(crate) struct Jacobian {
    by_pose: [[f32; 3]; 2],
    /// By offset and direction of the line in a slot.
    by_lines: heapless::Vec<(usize, [[f32; 2]; 2]), 2>,
}

impl Jacobian {
    /// Zero but for the pose.
    pub fn by_pose(by_pose: [[f32; 3]; 2]) -> Self {
        Self { by_pose, by_lines: heapless::Vec::new() }
    }

    /// By the pose, if that is not zero.
    pub fn pose_part(&self) -> Option<&[[f32; 3]; 2]> {
        Some(&self.by_pose).filter(|by_pose| **by_pose != [[0.0; 3]; 2])
    }

    /// By the lines, with the slot of each.
    pub fn line_parts(&self) -> &[(usize, [[f32; 2]; 2])] {
        &self.by_lines
    }

    /// The columns that may differ from zero: state, and its element in both rows.
    pub fn columns(&self) -> impl Iterator<Item = (usize, [f32; 2])> + Clone {
        let [o, d] = self.by_pose;
        let pose = (0..3).zip(o.into_iter().zip(d)).map(|(i, (o, d))| (POSE + i, [o, d]));
        let of_line = |&(slot, [o, d]): &(usize, [[f32; 2]; 2])| {
            line_states(slot).into_iter().zip(o.into_iter().zip(d)).map(|(state, (o, d))| (state, [o, d]))
        };
        pose.chain(self.by_lines.iter().flat_map(of_line))
    }

    /// H·x.
    pub fn times(&self, x: &[f32; STATES]) -> [f32; 2] {
        let mut sums = [0.0; 2];
        let mut add = |first: usize, rows: [&[f32]; 2]| {
            for (sum, row) in sums.iter_mut().zip(rows) {
                let part = x.get(first..first + row.len()).unwrap_or_default();
                row.iter().zip(part).for_each(|(by, x)| *sum += by * x);
            }
        };
        add(POSE, self.by_pose.each_ref().map(|by| by.as_slice()));
        for (slot, by_line) in &self.by_lines {
            let [first, _] = line_states(*slot);
            add(first, by_line.each_ref().map(|by| by.as_slice()));
        }
        sums
    }
}

impl Measurement {
    /// An observation of the line in a slot. `since_prior` leads from the prior's (x, y, θ), where the error state is zero, to the pose
    /// through which it was observed. `None` for lines without extent.
    pub fn of_line(slot: usize, seen: &LineObservation, since_prior: &Vector3<f32>) -> Option<Self> {
        let [offset, direction] = seen.by_pose.map(|by| Vector3::from(by).dot(since_prior));
        // The residual at the prior: that at the pose, less what the way from there has changed.
        let residual = [seen.residual[0] - offset, seen.residual[1] - direction];
        let noise = seen.noise.variances();
        let by_lines = heapless::Vec::from_slice(&[(slot, seen.by_line)]).unwrap_or_default();
        let jacobian = Jacobian { by_pose: seen.by_pose, by_lines };
        noise.iter().all(|variance| variance.is_finite()).then_some(Self { residual, noise, jacobian })
    }

    /// Two lines of the map that are one wall, each with its slot: a constraint between them.
    pub fn of_twins(kept: (&Segment, usize), gone: (&Segment, usize), noise: [f32; 2]) -> Self {
        let ((a, slot_a), (b, slot_b)) = (kept, gone);
        let apart = b.moments.centroid - a.moments.centroid;
        let along = a.along_of(b.moments.centroid);
        let by_lines = [(slot_a, [[-1.0, -along], [0.0, -1.0]]), (slot_b, [[1.0, 0.0], [0.0, 1.0]])];
        let by_lines = heapless::Vec::from_slice(&by_lines).unwrap_or_default();
        let residual = [a.normal().dot(&apart), cross(a.direction, b.direction)];
        Self { residual, noise, jacobian: Jacobian { by_pose: [[0.0; 3]; 2], by_lines } }
    }
}
