//! What the messages of a bag add up to, as they come.
//!
//! Which odometry is wanted may show at the end only. So the few numbers of each candidate are kept, and the ranges of one
//! topic: as soon as scans of a second one come, the choice is the user's, and from there on messages are counted only.

use std::collections::{BTreeMap, HashMap};
use std::path::Path;

use super::messages::{Encoding, Header, JointState, LaserScan, Message, OdometryMessage, Transforms, bare};
use super::scan::{self, to_us};
use super::topics::{Role, Topic};
use super::transforms::{self, Tree};
use crate::log::records::{OdometryRecord, Records, ScanRecord, Source};
use crate::log::robot::RobotLog;
use crate::log::{Defect, LogError, Odometry, Place, RangeUnit, ReadOptions, Warning};

/// A topic, as the containers name it to the collector.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct TopicId(pub usize);

/// Poses of one frame by one topic.
#[derive(Debug, Default)]
pub struct Track {
    /// The frame whose poses they are.
    pub child: String,
    /// The poses.
    pub records: Vec<OdometryRecord>,
}

/// Wheel joints by one topic.
#[derive(Debug, Default)]
pub struct Joints {
    /// Every joint that was named, in order.
    pub names: std::collections::BTreeSet<String>,
    /// How far the wheels had turned.
    pub records: Vec<OdometryRecord>,
}

/// Damage of a container.
#[derive(Debug, Default)]
pub struct Damage {
    /// Where it was first seen, and what is wrong there.
    pub first: Option<(Place, String)>,
    /// Places that are damaged.
    pub places: usize,
    /// Something about the file as a whole that is no loss.
    pub notes: Vec<String>,
}

/// Takes in the messages of a bag.
pub struct Collector<'a> {
    pub(super) path: &'a Path,
    pub(super) options: &'a ReadOptions<'a>,
    pub(super) records: Records,
    pub(super) topics: Vec<Topic>,
    by_name: HashMap<(String, String), TopicId>,
    /// Messages seen, of whatever topic.
    messages: usize,
    file: Option<String>,
    pub(super) damage: Damage,
    /// The topic whose scans are kept.
    pub(super) scan_topic: Option<TopicId>,
    /// A second topic has scans, and none was asked for.
    pub(super) ambiguous: bool,
    /// The frame of each geometry.
    pub(super) frames: Vec<String>,
    /// Middle beams by the recorder's clock, while no scan has a stamp of its own.
    pub(super) recorded_us: Option<Vec<i64>>,
    pub(super) odometry: BTreeMap<TopicId, Track>,
    pub(super) moving: BTreeMap<(TopicId, String), Track>,
    pub(super) joints: BTreeMap<TopicId, Joints>,
    pub(super) tree: Tree,
    /// What a robot said over its link, if that is in the file and no topic was asked for.
    pub(super) robot: Option<RobotLog>,
}

impl<'a> Collector<'a> {
    pub fn new(path: &'a Path, options: &'a ReadOptions<'a>) -> Self {
        Self {
            path,
            options,
            records: Records::default(),
            topics: Vec::new(),
            by_name: HashMap::new(),
            messages: 0,
            file: None,
            damage: Damage::default(),
            scan_topic: None,
            ambiguous: false,
            frames: Vec::new(),
            recorded_us: Some(Vec::new()),
            odometry: BTreeMap::new(),
            moving: BTreeMap::new(),
            joints: BTreeMap::new(),
            tree: Tree::default(),
            robot: None,
        }
    }

    /// Of several files, the one that is read from here on.
    pub fn begin_file(&mut self, name: &Path) {
        self.file = (name != self.path).then(|| name.display().to_string());
    }

    /// A topic of the bag, new or known.
    pub fn topic(&mut self, name: &str, kind: &str, encoding: Encoding) -> TopicId {
        let kind = kind.replace("/msg/", "/");
        let key = (name.to_string(), kind);
        if let Some(&id) = self.by_name.get(&key) {
            return id;
        }
        let id = TopicId(self.topics.len());
        let role = match (encoding, Role::of(&key.0, &key.1)) {
            (Encoding::Other, _) => Role::Other,
            (_, Role::Link) if self.asks_for_topics() => Role::Other,
            (_, role) => role,
        };
        if role == Role::Link {
            self.robot.get_or_insert_default();
        }
        self.topics.push(Topic { name: key.0.clone(), kind: key.1.clone(), encoding, role, count: 0 });
        self.by_name.insert(key, id);
        id
    }

    fn asks_for_topics(&self) -> bool {
        self.options.scan_topic.is_some() || self.options.odom_topic.is_some()
    }

    /// Whether the bytes of a topic's messages are looked at.
    pub fn wants(&self, id: TopicId) -> bool {
        self.topics.get(id.0).is_some_and(|topic| match topic.role {
            Role::Other => false,
            Role::Link => true,
            // The messages beside what the robot said are made of it.
            _ if self.robot.is_some() => false,
            Role::Scan => !self.ambiguous && self.options.scan_topic.is_none_or(|name| topic.is_named(name)),
            Role::Odometry | Role::Transforms | Role::Joints => true,
        })
    }

    /// Counts messages whose bytes are not looked at.
    pub fn pass_over(&mut self, id: TopicId, messages: usize) {
        self.messages += messages;
        if let Some(topic) = self.topics.get_mut(id.0) {
            topic.count += messages;
            if topic.role == Role::Scan && messages > 0 && self.options.scan_topic.is_none() {
                self.scans_of(id);
            }
        }
    }

    /// Takes in a message; `recorded_ns` is the recorder's clock.
    pub fn message(&mut self, id: TopicId, recorded_ns: i64, bytes: &[u8]) -> Result<(), LogError> {
        let wanted = self.wants(id);
        self.pass_over(id, 1);
        let Some(topic) = self.topics.get(id.0).filter(|_| wanted) else { return Ok(()) };
        let (role, encoding) = (topic.role, topic.encoding);
        match role {
            Role::Link => {
                if let Some(robot) = &mut self.robot {
                    robot.take(self.messages, recorded_ns, bytes, &mut self.records);
                }
            }
            Role::Scan if self.ambiguous => {}
            Role::Scan => {
                self.scan_topic = Some(id);
                if let Err(what) = self.scan(recorded_ns, encoding, bytes) {
                    return self.malformed(what);
                }
            }
            // What is wrong with odometry is counted: the scans can be used without.
            Role::Odometry if self.odometry(id, recorded_ns, encoding, bytes).is_none() => {
                self.records.skip("malformed_odometry");
            }
            Role::Transforms if self.transforms(id, recorded_ns, encoding, bytes).is_none() => {
                self.records.skip("malformed_odometry");
            }
            Role::Joints if self.joints(id, recorded_ns, encoding, bytes).is_none() => {
                self.records.skip("malformed_odometry");
            }
            _ => {}
        }
        Ok(())
    }

    /// A byte from which on the container is damaged.
    pub fn damaged(&mut self, byte: u64, what: impl Into<String>) {
        self.damaged_at(Place::Byte(byte), what.into());
    }

    /// Damage after the messages so far, where there are no bytes to tell it by.
    pub fn damaged_here(&mut self, what: impl Into<String>) {
        self.damaged_at(Place::Message(self.messages), what.into());
    }

    fn damaged_at(&mut self, place: Place, what: String) {
        self.damage.places += 1;
        self.records.skip("damaged");
        let what = match &self.file {
            Some(file) => format!("{what} ({file})"),
            None => what,
        };
        self.damage.first.get_or_insert((place, what));
    }

    /// Something about the container that costs nothing but should be known.
    pub fn note(&mut self, what: impl Into<String>) {
        self.damage.notes.push(what.into());
    }

    /// A file that the system cannot read on: an error, unless what comes before is to do.
    pub fn unreadable(&mut self, byte: u64, source: std::io::Error) -> Result<(), LogError> {
        if !self.options.lenient {
            return Err(LogError::Read { path: self.path.to_owned(), place: Place::Byte(byte), source });
        }
        self.damaged(byte, format!("the file cannot be read beyond this: {source}"));
        Ok(())
    }

    /// Takes note that a topic has scans.
    fn scans_of(&mut self, id: TopicId) {
        match self.scan_topic {
            Some(chosen) if chosen != id && !self.ambiguous => {
                self.ambiguous = true;
                self.records.scans = Vec::new();
                self.recorded_us = None;
            }
            _ => self.scan_topic = Some(id),
        }
    }

    /// A scan that cannot be used is counted, where the bag is known to be damaged or reading is lenient.
    fn malformed(&mut self, what: String) -> Result<(), LogError> {
        if !self.options.lenient && self.damage.places == 0 {
            let place = Place::Message(self.messages);
            return Err(LogError::Record {
                path: self.path.to_owned(),
                place,
                defect: Defect::Malformed(what),
            });
        }
        self.records.skip("malformed");
        Ok(())
    }

    fn scan(&mut self, recorded_ns: i64, encoding: Encoding, bytes: &[u8]) -> Result<(), String> {
        let message = LaserScan::<Header>::decode(encoding, bytes)?;
        if message.ranges.is_empty() {
            // As some drivers send while the scanner starts.
            self.records.skip("empty");
            return Ok(());
        }
        let stated = scan::stated(&message)?;
        let mm_per_unit = self.options.ranges.unwrap_or(RangeUnit::M).mm();
        let ranges_mm =
            message.ranges.iter().map(|r| self.records.range_mm(f64::from(*r), mm_per_unit)).collect();
        let frame = message.header.frame;
        if self.frames.last() != Some(&frame) && !self.records.geometries.is_empty() {
            // Alike or not, it may be mounted elsewhere.
            self.records.geometries.push(stated.geometry);
        }
        let geometry = self.records.geometry(stated.geometry);
        self.frames.resize(self.records.geometries.len(), frame);
        if message.header.stamp_ns != 0 {
            self.recorded_us = None;
        } else if let Some(recorded) = &mut self.recorded_us {
            recorded.push(to_us(recorded_ns.saturating_add(stated.to_middle_ns)));
        }
        self.records.scans.push(ScanRecord {
            place: self.messages,
            stamp_us: to_us(message.header.stamp_ns.saturating_add(stated.to_middle_ns)),
            ranges_mm,
            geometry: Some(geometry),
        });
        Ok(())
    }

    /// A reading of the odometry at this place of the bag.
    fn reading(&self, header: &Header, recorded_ns: i64, odometry: Odometry) -> OdometryRecord {
        OdometryRecord {
            place: self.messages,
            stamp_us: to_us(if header.stamp_ns == 0 { recorded_ns } else { header.stamp_ns }),
            source: Source::Own,
            odometry,
        }
    }

    fn odometry(&mut self, id: TopicId, recorded_ns: i64, encoding: Encoding, bytes: &[u8]) -> Option<()> {
        let message = OdometryMessage::<Header>::decode(encoding, bytes).ok()?;
        let pose = transforms::planar(&transforms::isometry(&message.pose)?);
        let reading = self.reading(&message.header, recorded_ns, Odometry::Pose(pose));
        let track = self.odometry.entry(id).or_default();
        if track.child.is_empty() {
            track.child = bare(&message.child_frame_id).into();
        }
        track.records.push(reading);
        Some(())
    }

    fn transforms(&mut self, id: TopicId, recorded_ns: i64, encoding: Encoding, bytes: &[u8]) -> Option<()> {
        let message = Transforms::<Header>::decode(encoding, bytes).ok()?;
        let mut good = Some(());
        for stamped in message.transforms {
            let (parent, child) = (stamped.header.frame.as_str(), bare(&stamped.child_frame_id));
            let Some(parent_from_child) = transforms::isometry(&stamped.transform) else {
                good = None;
                continue;
            };
            self.tree.add(parent, child, parent_from_child);
            if transforms::last_part(parent) == "odom" {
                let pose = Odometry::Pose(transforms::planar(&parent_from_child));
                let reading = self.reading(&stamped.header, recorded_ns, pose);
                let track = self.moving.entry((id, child.to_string())).or_default();
                track.child = child.into();
                track.records.push(reading);
            }
        }
        good
    }

    fn joints(&mut self, id: TopicId, recorded_ns: i64, encoding: Encoding, bytes: &[u8]) -> Option<()> {
        let message = JointState::<Header>::decode(encoding, bytes).ok()?;
        let mut turned = [None; 2];
        for (index, name) in message.name.iter().enumerate() {
            if let Some(side) = super::topics::wheel(name) {
                turned[side] = message.position.get(index).copied().filter(|p| p.is_finite());
            }
        }
        let reading = match turned {
            [Some(left), Some(right)] => {
                Some(self.reading(&message.header, recorded_ns, Odometry::Angles([left, right])))
            }
            _ => None,
        };
        let joints = self.joints.entry(id).or_default();
        for name in message.name {
            if !joints.names.contains(&name) {
                joints.names.insert(name);
            }
        }
        joints.records.extend(reading);
        Some(())
    }

    /// Warns.
    pub(super) fn warn(&mut self, suspected: &'static str, message: impl Into<String>) {
        self.records.warnings.push(Warning::new(suspected, message));
    }
}
