//! Making a [`Slam`], and asking it: nothing here moves pose or map.

use core::mem::MaybeUninit;

use nalgebra::{Isometry2, Matrix3};

use super::Slam;
use crate::config::{ConfigError, SlamConfig};
use crate::estimator::Estimator;
use crate::frontend::Frontend;
use crate::frontend::deskew::ScanPoint;
use crate::geometry::segment::Segment;
use crate::map::{MapSegment, SegmentMap};
use crate::odometry::bias::OdometryBias;
use crate::odometry::health::OdometryHealth;
use crate::odometry::wheel_faults::WheelFault;
use crate::places::Places;
use crate::relocalisation::Relocaliser;
use crate::sensor::scan::SensorConfig;
use crate::tracking::state::StateMonitor;
use crate::tracking::{Tracker, TrackingState};
use crate::update::Counters;

impl<const N: usize, const BEAMS: usize, const P: usize> Slam<N, BEAMS, P> {
    /// Size in RAM.
    pub const BYTES: usize = core::mem::size_of::<Self>();

    /// An empty map, with the robot at its origin.
    pub fn new(config: SlamConfig) -> Result<Self, ConfigError> {
        Self::check(&config)?;
        let mut slam = Self::blank(config);
        slam.prepare();
        Ok(slam)
    }

    /// The same, made where it is to stay: no copy of it passes over the stack.
    pub fn new_in(place: &mut MaybeUninit<Self>, config: SlamConfig) -> Result<&mut Self, ConfigError> {
        Self::check(&config)?;
        let slam = place.write(Self::blank(config));
        slam.prepare();
        Ok(slam)
    }

    /// Takes another scanner, or the same one whose beams lie otherwise from now on, as scanners that do not turn evenly need it
    /// before each scan. Map and pose stay.
    pub fn set_sensor(&mut self, sensor: SensorConfig) -> Result<(), ConfigError> {
        let config = SlamConfig { sensor, ..self.config };
        Self::check(&config)?;
        self.config = config;
        Ok(())
    }

    /// How long a revolution of the scanner takes now, microseconds; zero is not taken. A scanner all of whose beams are taken as
    /// simultaneous stays one.
    pub fn set_revolution_us(&mut self, revolution_us: u32) {
        let known = &mut self.config.sensor.geometry.revolution_us;
        if *known > 0 && revolution_us > 0 {
            *known = revolution_us;
        }
    }

    pub(crate) fn check(config: &SlamConfig) -> Result<(), ConfigError> {
        config.validate()?;
        let beams = config.sensor.geometry.beams();
        if beams > BEAMS {
            return Err(ConfigError::TooManyBeams { beams, capacity: BEAMS });
        }
        Ok(())
    }

    /// Before [`Self::prepare`]. Inlined, so that it is built in its place.
    #[inline(always)]
    pub(crate) fn blank(config: SlamConfig) -> Self {
        Self {
            config,
            map: SegmentMap::new(),
            estimator: Estimator::blank(),
            frontend: Frontend::new(),
            tracker: Tracker::new(),
            places: Places::new(),
            odometry: OdometryHealth::new(config.line_noise, config.odometry.noise),
            state: StateMonitor::default(),
            relocaliser: Relocaliser::new(),
            mapping: true,
            counters: Counters::default(),
        }
    }

    /// What depends on the configuration.
    pub(crate) fn prepare(&mut self) {
        self.estimator.prepare(&self.config);
    }

    /// The settings.
    pub fn config(&self) -> &SlamConfig {
        &self.config
    }

    /// The lines of the map that stand: walls, without what is tentative. Work: for each, that of [`Self::is_wall`].
    pub fn walls(&self) -> impl Iterator<Item = &MapSegment> {
        let lines = self.map.segments().iter().enumerate();
        lines.filter(|(index, _)| self.is_wall(*index)).map(|(_, entry)| entry)
    }

    /// Whether the line of the map with this index stands, or is tentative. Work: that of
    /// [`WallConfig::is_wall`](crate::map::walls::WallConfig::is_wall).
    pub fn is_wall(&self, index: usize) -> bool {
        self.config.walls.is_none_or(|walls| walls.is_wall(index, self.map.segments()))
    }

    /// The map.
    pub fn map(&self) -> &SegmentMap<N> {
        &self.map
    }

    /// Places along the way, and the loops between them.
    pub fn places(&self) -> &Places<P> {
        &self.places
    }

    /// Pose of `base` in `map` at the last scan.
    pub fn pose(&self) -> Isometry2<f32> {
        self.estimator.pose()
    }

    /// Covariance of the pose (x, y, θ), in `map`.
    pub fn covariance(&self) -> Matrix3<f32> {
        self.estimator.covariance(&self.config.line_noise)
    }

    /// Systematic errors of the odometry as learnt so far.
    pub fn odometry_bias(&self) -> OdometryBias {
        self.estimator.odometry_bias()
    }

    /// How far the pose is to be relied on.
    pub fn state(&self) -> TrackingState {
        self.state.state()
    }

    /// What is wrong with the wheels, where that is known.
    pub fn wheel_fault(&self) -> Option<WheelFault> {
        self.odometry.wheel_fault()
    }

    /// Counters since the start.
    pub fn counters(&self) -> Counters {
        self.counters
    }

    /// Points of the last scan that were placed, in `base` at its middle beam.
    pub fn points(&self) -> &[ScanPoint] {
        self.frontend.points()
    }

    /// Segments seen in the last scan, in `base` at its middle beam.
    pub fn observed(&self) -> &[Segment] {
        self.frontend.segments()
    }
}
