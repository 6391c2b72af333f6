//! A map as it is saved: lines, places and loops as plain numbers, the same on the robot and on a PC.
//!
//! In: what [`Slam`](crate::Slam) knows. Out: [`StoredLine`]s, [`StoredPlace`]s and [`StoredLoop`]s, and back. What encloses them is up to who
//! writes them; with the feature `serde` they go into any of its formats, and `lineslam` writes them as JSON.

use heapless::Vec;
use nalgebra::{Isometry2, Matrix3, Point2};

use crate::geometry::math::sqrt;
use crate::geometry::pose::{components, is_finite, pose};
use crate::geometry::segment::{Moments, Segment};
use crate::map::MapSegment;
use crate::odometry::bias::OdometryBias;
use crate::places::{Anchor, Loop, PLACE_LINES, PlaceLine};

/// Version of what is stored here. A map of another version is not read.
pub const VERSION: u16 = 1;

/// Numbers beyond these make no sense: coordinates and ways, metres; standard deviations, metres and radians; errors of the odometry.
const FARTHEST_M: f32 = 1e5;
const LEAST_SIGMA: f32 = 1e-6;
const MOST_SIGMA: f32 = 10.0;
const MOST_BIAS: f32 = 0.5;

/// A wall.
#[derive(Clone, Copy, Debug, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize), serde(deny_unknown_fields))]
pub struct StoredLine {
    /// Where it begins, in `map`, metres; its free side is on the left, …
    pub start_m: [f32; 2],
    /// … and where it ends.
    pub end_m: [f32; 2],
    /// So far from its start, metres (beyond its ends where it is what an opening left of a longer line), …
    pub middle_m: f32,
    /// … its distance has this standard deviation, metres, …
    pub sigma_offset_m: f32,
    /// … and its direction this one, radians.
    pub sigma_direction_rad: f32,
    /// Points that it was fitted to.
    pub points: u32,
    /// Keyframes that saw it.
    pub hits: u16,
    /// Way that the robot had driven when it was seen last, metres.
    pub seen_at_m: f32,
}

impl StoredLine {
    /// Of a line of the map.
    pub fn of(entry: &MapSegment) -> Self {
        let segment = entry.segment();
        let Segment { moments, start, end, .. } = segment;
        Self {
            start_m: [start.x, start.y],
            end_m: [end.x, end.y],
            middle_m: -segment.along_of(start),
            sigma_offset_m: sqrt(1.0 / moments.weight),
            sigma_direction_rad: sqrt(1.0 / moments.scatter_along(segment.direction)),
            points: moments.inliers,
            hits: entry.hits,
            seen_at_m: entry.seen_at_m,
        }
    }

    /// As a line of the map that no scan has seen yet. None where a number makes no sense.
    pub fn entry(&self) -> Option<MapSegment> {
        let ([ax, ay], [bx, by]) = (self.start_m, self.end_m);
        let (start, end) = (Point2::new(ax, ay), Point2::new(bx, by));
        let length_m = sqrt((end - start).norm_squared());
        let sigmas = [self.sigma_offset_m, self.sigma_direction_rad];
        let makes_sense = length_m > 0.0
            && [ax, ay, bx, by, self.middle_m, self.seen_at_m].iter().all(|v| v.abs() < FARTHEST_M)
            && sigmas.iter().all(|sigma| (LEAST_SIGMA..MOST_SIGMA).contains(sigma));
        if !makes_sense {
            return None;
        }
        let direction = (end - start) / length_m;
        let along = 1.0 / (self.sigma_direction_rad * self.sigma_direction_rad);
        let moments = Moments {
            inliers: self.points,
            weight: 1.0 / (self.sigma_offset_m * self.sigma_offset_m),
            centroid: start + direction * self.middle_m,
            scatter: [
                along * direction.x * direction.x,
                along * direction.x * direction.y,
                along * direction.y * direction.y,
            ],
        };
        let segment = Segment { moments, direction, start, end };
        segment.is_finite().then(|| MapSegment::new(&segment, self.hits, 0, self.seen_at_m))
    }
}

/// A place. Poses are x, y (m) and θ (rad).
#[derive(Clone, Debug, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize), serde(deny_unknown_fields))]
pub struct StoredPlace {
    /// In `map`.
    pub pose: [f32; 3],
    /// In the frame of the place before, as the robot drove.
    pub from_previous: [f32; 3],
    /// Variances of that: along (m²), across (m²), heading (rad²).
    pub variances: [f32; 3],
    /// Way driven until there, metres.
    pub way_m: f32,
    /// Its lines: x and y of both ends in its frame, millimetres.
    pub lines_mm: Vec<[i16; 4], PLACE_LINES>,
}

impl StoredPlace {
    /// Of a place.
    pub fn of(anchor: &Anchor) -> Self {
        Self {
            pose: numbers(&anchor.pose),
            from_previous: numbers(&anchor.from_previous),
            variances: anchor.variances,
            way_m: anchor.way_m,
            lines_mm: anchor.lines.iter().map(PlaceLine::numbers).collect(),
        }
    }

    /// None where a number makes no sense.
    pub(crate) fn anchor(&self) -> Option<Anchor> {
        let [pose, from_previous] = [self.pose, self.from_previous].map(isometry);
        let are_variances = self.variances.iter().all(|v| *v >= 0.0 && v.is_finite());
        let is_whole = is_finite(&pose) && is_finite(&from_previous) && self.way_m.is_finite();
        let lines = self.lines_mm.iter().map(|line| PlaceLine::from_numbers(*line)).collect();
        let anchor = Anchor { pose, from_previous, variances: self.variances, way_m: self.way_m, lines };
        (is_whole && are_variances).then_some(anchor)
    }
}

/// Two places that are one.
#[derive(Clone, Copy, Debug, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize), serde(deny_unknown_fields))]
pub struct StoredLoop {
    /// Index of the older place, …
    pub from: u16,
    /// … and of the younger one.
    pub to: u16,
    /// Pose (x, y, θ) of the younger one in the older one's frame.
    pub measured: [f32; 3],
    /// Covariance of that in the younger one's frame: xx, xy, xθ, yy, yθ, θθ.
    pub covariance: [f32; 6],
}

impl StoredLoop {
    /// Of a loop.
    pub fn of(edge: &Loop) -> Self {
        let c = &edge.covariance;
        Self {
            from: edge.from,
            to: edge.to,
            measured: numbers(&edge.measured),
            covariance: [c.m11, c.m12, c.m13, c.m22, c.m23, c.m33],
        }
    }

    /// None where a number makes no sense among so many places.
    pub(crate) fn edge(&self, places: usize) -> Option<Loop> {
        let [xx, xy, xt, yy, yt, tt] = self.covariance;
        let covariance = Matrix3::new(xx, xy, xt, xy, yy, yt, xt, yt, tt);
        let measured = isometry(self.measured);
        let is_in_order = self.from < self.to && usize::from(self.to) < places;
        let is_whole = is_finite(&measured) && covariance.cholesky().is_some();
        (is_in_order && is_whole).then_some(Loop { from: self.from, to: self.to, measured, covariance })
    }
}

/// All that is known of a building, and of the robot's odometry.
#[derive(Clone, Copy, Debug)]
pub struct StoredMap<'a> {
    /// Its walls.
    pub lines: &'a [StoredLine],
    /// Places, in the order in which the robot came to them.
    pub places: &'a [StoredPlace],
    /// Loops between them.
    pub loops: &'a [StoredLoop],
    /// Way driven until then, metres.
    pub way_m: f32,
    /// Systematic errors of the odometry of the robot that drove there.
    pub odometry_bias: OdometryBias,
}

impl StoredMap<'_> {
    /// Whether all numbers make sense.
    pub(crate) fn check(&self) -> Result<(), MapError> {
        let invalid = |what, index: Option<usize>| match index {
            Some(index) => Err(MapError::Invalid { what, index }),
            None => Ok(()),
        };
        let mut reached_m = 0.0;
        let goes_back = |place: &StoredPlace| {
            let before_m = core::mem::replace(&mut reached_m, place.way_m);
            place.anchor().is_none() || !(before_m..=self.way_m).contains(&place.way_m)
        };
        invalid("lines", self.lines.iter().position(|line| line.entry().is_none()))?;
        invalid("places", self.places.iter().position(goes_back))?;
        invalid("loops", self.loops.iter().position(|edge| edge.edge(self.places.len()).is_none()))?;
        let bias = self.odometry_bias.0;
        let makes_sense = (0.0..FARTHEST_M).contains(&self.way_m) && bias.iter().all(|v| v.abs() < MOST_BIAS);
        if makes_sense { Ok(()) } else { Err(MapError::OutOfRange) }
    }
}

/// Why a map cannot be used.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[non_exhaustive]
pub enum MapError {
    /// There are more of these than there is room for.
    TooMany {
        /// Of what.
        what: &'static str,
        /// How many there are.
        count: usize,
        /// How many there is room for.
        capacity: usize,
    },
    /// One of them has a number that makes no sense.
    Invalid {
        /// Of what.
        what: &'static str,
        /// Which, from zero.
        index: usize,
    },
    /// The way or the odometry's errors make no sense.
    OutOfRange,
    /// The robot may be anywhere, and there are no places to look for it, or the configuration does not look.
    NowhereToLook,
}

impl MapError {
    pub(crate) fn check_room(what: &'static str, count: usize, capacity: usize) -> Result<(), Self> {
        if count > capacity { Err(Self::TooMany { what, count, capacity }) } else { Ok(()) }
    }
}

impl core::fmt::Display for MapError {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        match self {
            Self::TooMany { what, count, capacity } => {
                write!(f, "the map has {count} {what}, there is room for {capacity}")
            }
            Self::Invalid { what, index } => write!(f, "{what}[{index}] has a number that makes no sense"),
            Self::OutOfRange => write!(f, "way_m or odometry_bias makes no sense"),
            Self::NowhereToLook => {
                write!(f, "the map has no places to look for the robot: say where it stands")
            }
        }
    }
}

impl core::error::Error for MapError {}

/// Headings are stored in steps of this, radians: many times what a heading is off by once it was sine and cosine, so that what is stored
/// comes back as it was, however often.
const HEADING_STEP_RAD: f32 = 1e-5;

fn numbers(pose: &Isometry2<f32>) -> [f32; 3] {
    let [x, y, heading]: [f32; 3] = components(pose).into();
    let steps = heading / HEADING_STEP_RAD;
    // The conversion cuts towards zero.
    [x, y, HEADING_STEP_RAD * (steps + 0.5_f32.copysign(steps)) as i32 as f32]
}

fn isometry([x, y, heading]: [f32; 3]) -> Isometry2<f32> {
    pose(x, y, heading)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::map::fixtures::line;
    use proptest::prelude::*;

    #[test]
    fn a_line_comes_back_as_it_was() {
        let entry = line((1.0, -2.0), (3.0, 1.5), 7).seen_at(3.5);
        let back = StoredLine::of(&entry).entry().unwrap();
        let off = |a: Point2<f32>, b: Point2<f32>| (a - b).norm();
        assert!(off(back.segment().start, entry.segment().start) < 1e-5);
        assert!(off(back.segment().moments.centroid, entry.segment().moments.centroid) < 1e-5);
        assert!((back.direction() - entry.direction()).norm() < 1e-6);
        assert_eq!((back.hits, back.seen_at_m, back.last_seen), (7, 3.5, 0));
        let along = |entry: &MapSegment| entry.segment().moments.scatter_along(entry.direction());
        assert!((along(&back) / along(&entry) - 1.0).abs() < 1e-4);
        assert!((back.segment().moments.weight / entry.segment().moments.weight - 1.0).abs() < 1e-5);
    }

    #[test]
    fn so_does_what_an_opening_left_of_a_line() {
        let whole = line((0.0, 1.0), (5.0, 1.0), 7);
        let entry = whole.with_segment(&Segment { start: Point2::new(4.8, 1.0), ..whole.segment() });
        let back = StoredLine::of(&entry).entry().unwrap();
        assert!((back.segment().moments.centroid - entry.segment().moments.centroid).norm() < 1e-5);
        assert!((back.length_m() - 0.2).abs() < 1e-5);
    }

    proptest! {
        #[test]
        fn a_pose_comes_back_as_it_was_stored(x in -100f32..100.0, y in -100f32..100.0, heading in -3.2f32..3.2) {
            let stored = numbers(&isometry([x, y, heading]));
            prop_assert_eq!(numbers(&isometry(stored)), stored);
            let off = isometry(stored).inv_mul(&isometry([x, y, heading]));
            prop_assert!(off.translation.vector.norm() < 1e-6 && off.rotation.angle().abs() < HEADING_STEP_RAD);
        }
    }

    #[test]
    fn what_makes_no_sense_is_refused() {
        let good = StoredLine::of(&line((1.0, -2.0), (3.0, 1.5), 7));
        for bad in [
            StoredLine { end_m: good.start_m, ..good },
            StoredLine { start_m: [f32::NAN, 0.0], ..good },
            StoredLine { sigma_offset_m: 0.0, ..good },
            StoredLine { sigma_direction_rad: f32::NAN, ..good },
            StoredLine { middle_m: f32::INFINITY, ..good },
            StoredLine { seen_at_m: f32::NAN, ..good },
        ] {
            assert_eq!(bad.entry(), None, "{bad:?}");
        }
        let edge =
            StoredLoop { from: 1, to: 4, measured: [0.0; 3], covariance: [1.0, 0.0, 0.0, 1.0, 0.0, 1.0] };
        assert!(edge.edge(5).is_some() && edge.edge(4).is_none());
        assert!(StoredLoop { from: 4, to: 1, ..edge }.edge(5).is_none());
        assert!(StoredLoop { covariance: [1.0, 2.0, 0.0, 1.0, 0.0, 1.0], ..edge }.edge(5).is_none());
        let place = StoredPlace {
            pose: [1.0, 2.0, 3.0],
            from_previous: [0.0; 3],
            variances: [1e-4; 3],
            way_m: 4.0,
            lines_mm: Vec::from_slice(&[[1, 2, 3, 4]]).unwrap(),
        };
        assert_eq!(StoredPlace::of(&place.anchor().unwrap()).lines_mm, place.lines_mm);
        assert!(StoredPlace { variances: [-1.0; 3], ..place.clone() }.anchor().is_none());
        assert!(StoredPlace { pose: [f32::NAN; 3], ..place }.anchor().is_none());
    }
}
