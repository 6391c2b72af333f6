//! A simulated robot for the filter's tests.

use nalgebra::{Isometry2, Matrix3, Vector2, Vector3};

use crate::ekf::filter::EkfSlam;
use crate::ekf::measurement::Measurement;
use crate::ekf::state::UpdateScope;
use crate::ekf::update::UpdateGate;
use crate::geometry::line_noise::{LineNoise, with_variances};
use crate::geometry::line_observation::{LineObservation, ObservationNoise};
use crate::geometry::pose::rotate_covariance;
use crate::geometry::pose::{components, perpendicular, pose};
use crate::geometry::segment::Segment;
use crate::map::SegmentMap;
use crate::odometry::bias::OdometryBias;
use crate::odometry::{Increment, OdometryNoise};
use nalgebra::Point2;
use rand_core::{Rng, SeedableRng};

const NOISE: OdometryNoise = OdometryNoise {
    sigma_along_m_per_sqrt_m: 0.02,
    sigma_across_m_per_sqrt_m: 0.01,
    sigma_heading_rad_per_sqrt_m: 0.03,
    sigma_heading_rad_per_sqrt_rad: 0.0,
    sigma_position_floor_m: 0.001,
    sigma_heading_floor_rad: 0.001,
};
pub const SEEN: [f32; 2] = [1e-4, 4e-4];
pub const SURE: [f32; 2] = [1e-5, 4e-5];
pub const INFLATION: f32 = 2.0;
pub const PLAIN: UpdateGate =
    UpdateGate { max_nis: f32::INFINITY, kernel_nis: f32::INFINITY, min_information_ratio: 0.0 };

/// An observed segment, in `map`, with these variances, by a robot at a position.
pub fn measurement(
    slot: usize,
    mapped: &Segment,
    seen: &Segment,
    position: Vector2<f32>,
    [var_offset, var_direction]: [f32; 2],
) -> Measurement {
    let seen = with_variances(seen, var_offset, var_direction);
    let exact = LineNoise { sigma_offset_m: 0.0, sigma_direction_rad: 0.0 };
    let noise = ObservationNoise::new(&seen, mapped, &exact);
    let observation = LineObservation::new(&seen, mapped, position.into(), noise);
    Measurement::of_line(slot, &observation, &Vector3::zeros()).unwrap()
}

pub struct Gauss(rand_pcg::Pcg32);

impl Gauss {
    pub fn draw(&mut self) -> f32 {
        (0..12).map(|_| self.0.next_u32() as f32 / u32::MAX as f32).sum::<f32>() - 6.0
    }
}

/// A robot in a corridor of many short walls, of which it sees those near it, through an odometry with unknown errors.
pub struct World {
    pub walls: std::vec::Vec<Segment>,
    pub truth: Isometry2<f32>,
    pub believed: Isometry2<f32>,
    pub filter: EkfSlam,
    pub map: SegmentMap<64>,
    /// Index in the map of each wall known.
    pub known: std::vec::Vec<Option<usize>>,
    pub gauss: Gauss,
    pub scan: u32,
}

impl World {
    pub fn new(seed: u64) -> Self {
        let wall = |from: (f32, f32), to: (f32, f32)| {
            let (from, to) = (Point2::new(from.0, from.1), Point2::new(to.0, to.1));
            Segment::from_ends(from, to, 20, 1e-4, Point2::new(from.x, 0.0))
        };
        let walls: std::vec::Vec<Segment> = (0..20)
            .flat_map(|k| {
                let x = k as f32;
                [wall((x, 1.0), (x + 0.7, 1.0)), wall((x, -1.0), (x + 0.5, -1.3)), wall((x, -1.0), (x, -1.4))]
            })
            .collect();
        let mut gauss = Gauss(rand_pcg::Pcg32::seed_from_u64(seed));
        let filter = EkfSlam::new(Vector3::new(0.02, 0.0, 0.01));
        let known = std::vec![None; walls.len()];
        let here = pose(0.5, 0.0, 0.0);
        gauss.draw();
        let (map, scan) = (SegmentMap::new(), 0);
        Self { walls, truth: here, believed: here, filter, map, known, gauss, scan }
    }

    pub fn step(&mut self, forward: f32, bias: Vector3<f32>) {
        self.scan += 1;
        let said = Increment::from_motion(pose(forward, 0.0, 0.0));
        let really = OdometryBias(bias).corrected(&said);
        let l = NOISE.covariance(&said).cholesky().unwrap().l();
        let noise = l * Vector3::from_fn(|_, _| self.gauss.draw());
        self.truth *= really.before_from_after * pose(noise.x, noise.y, noise.z);
        let increment = self.filter.bias().corrected(&said);
        let mut by_pose = Matrix3::identity();
        let lever = perpendicular(self.believed.rotation * increment.before_from_after.translation.vector);
        (by_pose.m13, by_pose.m23) = (lever.x, lever.y);
        let turn = self.believed.rotation.to_rotation_matrix().to_homogeneous();
        let grown = rotate_covariance(&self.believed, &NOISE.covariance(&increment));
        self.filter.predict(&by_pose, &(turn * OdometryBias::derivative(&said)), &grown, &mut self.map);
        self.believed *= increment.before_from_after;
        self.look();
    }

    pub fn look(&mut self) {
        let at = self.truth.translation.vector;
        let near: std::vec::Vec<usize> =
            (0..self.walls.len()).filter(|&i| (self.walls[i].midpoint().coords - at).norm() < 2.5).collect();
        let mut new = std::vec::Vec::new();
        for i in near {
            let in_base = self.walls[i].transformed(&self.truth.inverse());
            let noisy =
                in_base.shifted(self.gauss.draw() * SEEN[0].sqrt(), self.gauss.draw() * SEEN[1].sqrt());
            let seen = with_variances(&noisy.transformed(&self.believed), SEEN[0], SEEN[1]);
            let Some(index) = self.known[i] else {
                new.push((i, with_variances(&noisy, SEEN[0], SEEN[1])));
                continue;
            };
            let slot = self.filter.activate(index, INFLATION, &mut self.map).unwrap();
            let entry = self.map.get_mut(index).unwrap();
            entry.last_seen = self.scan;
            let position = self.believed.translation.vector;
            let measurement = measurement(slot, &entry.segment(), &seen, position, SEEN);
            self.filter.update(&measurement, &PLAIN, UpdateScope::All);
        }
        self.believed = self.filter.commit(&self.believed, &mut self.map);
        for (i, in_base) in new {
            let index = self.map.insert(in_base.transformed(&self.believed), self.scan, 0.0).unwrap();
            self.filter.augment(index, self.believed.translation.vector, &mut self.map);
            self.known[i] = Some(index);
        }
    }

    pub fn nees(&self) -> f32 {
        let mut off = components(&self.believed) - components(&self.truth);
        off.z = crate::geometry::math::wrap_angle(off.z);
        off.dot(&(self.filter.pose_covariance().try_inverse().unwrap() * off))
    }
}
