//! What came of a scan, and what has been counted since the start.

use nalgebra::{Isometry2, Matrix3};

use crate::ekf::keyframe_update::RegistrationReport;
use crate::frontend::deskew::DeskewReport;
use crate::frontend::extraction::ExtractionReport;
use crate::map::MapCounters;
use crate::odometry::wheel_faults::WheelFault;
use crate::places::Closure;
use crate::relocalisation::{Relocalisation, SearchState};
use crate::sensor::scan::{Scan, ScanGeometry};
use crate::tracking::correction::{Observability, Prior};
use crate::tracking::tracker::Tracked;
use crate::tracking::{Hypothesis, TrackingState};

/// What happened since the start.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct Counters {
    /// Scans processed, good or bad.
    pub scans: u32,
    /// Scans with another number of ranges than the geometry has beams.
    pub wrong_beam_count: u32,
    /// Motions with a number that was not finite; the robot was taken to stand still, unsure by a metre and a radian.
    pub bad_motion: u32,
    /// Scans in which no segment was found.
    pub without_segments: u32,
    /// Scans that left the pose to the odometry: no pair, or a system that could not be solved.
    pub uncorrected: u32,
    /// Moves by odometry alone, without a scan.
    pub coasted: u32,
    /// Times that places were corrected by loops.
    pub loops_closed: u32,
    /// Segments that one scan had too many.
    pub crowded_out: u32,
    /// Scans that overruled the odometry: an increment was wild, as of wheels that slip or spin.
    pub odometry_left_out: u32,
    /// Scans for which poses were searched.
    pub searched: u32,
    /// Scans at which the robot was lost.
    pub lost: u32,
    /// Times that a displaced robot found itself in its map, …
    pub relocalised: u32,
    /// … and that it went on from where it was thought to be.
    pub gave_up: u32,
}

impl Counters {
    /// Counts a motion, if it could not be used.
    pub(crate) fn count_motion(&mut self, is_usable: bool) {
        self.bad_motion = self.bad_motion.saturating_add(u32::from(!is_usable));
    }

    /// Counts a scan.
    pub(crate) fn count(&mut self, update: &SlamUpdate) {
        let add = |counter: &mut u32, amount: u32| *counter = counter.saturating_add(amount);
        add(&mut self.scans, 1);
        add(&mut self.wrong_beam_count, u32::from(update.rejected.is_some()));
        add(&mut self.without_segments, u32::from(update.extraction.segments == 0));
        add(&mut self.uncorrected, u32::from(!update.corrected));
        add(&mut self.loops_closed, u32::from(update.closure.is_some()));
        add(&mut self.crowded_out, update.extraction.crowded_out);
        add(&mut self.odometry_left_out, u32::from(update.odometry_left_out));
        add(&mut self.searched, u32::from(update.searched));
        add(&mut self.lost, u32::from(update.state == TrackingState::Lost));
        let search = update.relocalisation.map(|r| r.state);
        add(&mut self.relocalised, u32::from(search == Some(SearchState::Found)));
        add(&mut self.gave_up, u32::from(search == Some(SearchState::GivenUp)));
    }
}

/// Why a scan was not used.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[non_exhaustive]
pub enum ScanRejection {
    /// Another number of ranges than the geometry has beams.
    WrongBeamCount {
        /// Beams of the geometry.
        expected: usize,
        /// Ranges given.
        actual: usize,
    },
}

impl ScanRejection {
    /// Why a scan of this geometry is not to be used, if it is not.
    pub(crate) fn of(scan: &Scan<'_>, geometry: &ScanGeometry) -> Option<Self> {
        let (expected, actual) = (geometry.beams(), scan.ranges_mm.len());
        (expected != actual).then_some(Self::WrongBeamCount { expected, actual })
    }
}

/// What the core is at.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Stage {
    /// Where the odometry leads.
    Prediction,
    /// Ranges to points.
    Deskew,
    /// Points to segments.
    Extraction,
    /// Segments to pairs.
    Association,
    /// Pairs to pose.
    Correction,
    /// Pairs to map.
    Registration,
}

impl Stage {
    /// All of them, in the order of the pipeline.
    pub const ALL: [Self; 6] = [
        Self::Prediction,
        Self::Deskew,
        Self::Extraction,
        Self::Association,
        Self::Correction,
        Self::Registration,
    ];
    /// How many there are.
    pub const COUNT: usize = Self::ALL.len();
}

/// Outcome of one scan.
#[derive(Clone, Copy, Debug)]
pub struct SlamUpdate {
    /// Pose of `base` in `map` at the scan's middle beam.
    pub pose: Isometry2<f32>,
    /// Covariance of (x, y, θ), in `map`, the error of the map around the robot included.
    pub covariance: Matrix3<f32>,
    /// Where the odometry alone put the base, from the last pose.
    pub predicted: Isometry2<f32>,
    /// What became of the beams.
    pub deskew: DeskewReport,
    /// What was seen.
    pub extraction: ExtractionReport,
    /// What it did to the map.
    pub registration: RegistrationReport,
    /// Whether the pairs corrected the pose; otherwise it is the prediction.
    pub corrected: bool,
    /// Rounds of association and correction.
    pub iterations: u8,
    /// Share of the points on observed segments that the map explains, 0 to 1; see
    /// [`tight_score`](crate::tracking::hypothesis::tight_score).
    pub support: f32,
    /// Root mean square distance of the observed segments from their map lines after the correction, weighted by
    /// inliers, metres. Zero without pairs.
    pub residual_m: f32,
    /// Share of the walls that should be seen from here and are seen through instead, 0 to 1.
    pub contradicted_share: f32,
    /// How far the pose is to be relied on.
    pub state: TrackingState,
    /// Whether the scan overruled the prediction: the odometry's increment was wild.
    pub odometry_left_out: bool,
    /// Whether the prediction explained too little, and the pose was searched for.
    pub searched: bool,
    /// Whether the odometry has been of no use for a while, so that the scanner is followed alone.
    pub odometry_useless: bool,
    /// What is wrong with the wheels, where that is known.
    pub wheel_fault: Option<WheelFault>,
    /// Directions of the pose that the pairs fix.
    pub observability: Observability,
    /// Way driven until now, metres.
    pub way_m: f32,
    /// Set while the robot looks for itself in its map, and when it is found.
    pub relocalisation: Option<Relocalisation>,
    /// Set when places were corrected by loops, and the map and the pose with them.
    pub closure: Option<Closure>,
    /// Set when the scan was not used. The motion still was.
    pub rejected: Option<ScanRejection>,
    /// Counters of the core, this scan included.
    pub counters: Counters,
    /// Counters of the map, this scan included.
    pub map_counters: MapCounters,
}

impl SlamUpdate {
    /// A scan of which nothing is known but the prediction.
    pub(crate) fn predicted(prior: &Prior, state: TrackingState) -> Self {
        Self {
            pose: prior.pose,
            covariance: prior.covariance,
            predicted: prior.pose,
            deskew: DeskewReport::default(),
            extraction: ExtractionReport::default(),
            registration: RegistrationReport::default(),
            corrected: false,
            iterations: 0,
            support: 0.0,
            residual_m: 0.0,
            contradicted_share: 0.0,
            state,
            odometry_left_out: false,
            searched: false,
            odometry_useless: false,
            wheel_fault: None,
            observability: Observability::BLIND,
            way_m: 0.0,
            relocalisation: None,
            closure: None,
            rejected: None,
            counters: Counters::default(),
            map_counters: MapCounters::default(),
        }
    }

    /// Takes what tracking found; the pose goes to the estimator.
    pub(crate) fn take(&mut self, tracked: &Tracked) {
        self.take_pose(&tracked.hypothesis);
        self.iterations = tracked.iterations;
        self.odometry_left_out = tracked.left_out.is_some();
        self.searched = tracked.searched;
    }
    /// Takes what speaks for a pose.
    pub(crate) fn take_pose(&mut self, hypothesis: &Hypothesis) {
        self.corrected = hypothesis.corrected;
        self.support = hypothesis.score;
        self.observability = hypothesis.observability;
    }
}
