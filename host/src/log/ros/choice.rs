//! Which topics are meant: by type where there is one of each, else by name.

use super::collect::{Collector, Joints, TopicId};
use super::topics::{Role, Topic, counted, wheel};
use super::transforms::{BASES, last_part};
use crate::log::LogError;

/// Topics that an error lists.
const LISTED: usize = 100;

/// Where the odometry comes from.
pub enum Choice {
    Poses(TopicId),
    Transforms(TopicId, String),
    Wheels(TopicId),
    None,
}

impl Collector<'_> {
    /// An error about the topics, with a list of them.
    fn topics_error(&self, what: impl Into<String>) -> LogError {
        let mut lines: Vec<String> = self
            .topics
            .iter()
            .take(LISTED)
            .map(|t| format!("  {}  {}  {}", t.name, t.kind, counted(t.count, "message")))
            .collect();
        if self.topics.len() > LISTED {
            lines.push(format!("  and {} more", self.topics.len() - LISTED));
        }
        if lines.is_empty() {
            lines.push("  the bag has no topics".into());
        }
        LogError::Topics { path: self.path.to_owned(), what: what.into(), topics: lines.join("\n") }
    }

    /// Whether scans are there, and of one topic.
    pub(super) fn check_scans(&self) -> Result<(), LogError> {
        let scans = || self.topics.iter().filter(|t| t.role == Role::Scan);
        if let Some(name) = self.options.scan_topic {
            return match scans().find(|t| t.is_named(name)) {
                Some(topic) if topic.count > 0 => Ok(()),
                Some(_) => Err(self.topics_error(format!("the topic {name} has no messages"))),
                None => {
                    Err(self.topics_error(format!("--scan-topic: no topic {name} has sensor_msgs/LaserScan")))
                }
            };
        }
        if self.ambiguous {
            let names: Vec<&str> = scans().filter(|t| t.count > 0).map(|t| t.name.as_str()).collect();
            let what = format!(
                "scans of {} topics: choose one with --scan-topic {}",
                names.len(),
                names.join(" or ")
            );
            return Err(self.topics_error(what));
        }
        if self.scan_topic.is_none() {
            return Err(self.topics_error("no scans: no topic has messages of type sensor_msgs/LaserScan"));
        }
        Ok(())
    }

    /// The odometry that is meant.
    pub(super) fn choose_odometry(&self) -> Result<Choice, LogError> {
        if let Some(name) = self.options.odom_topic {
            return self.named_odometry(name);
        }
        if self.options.wheels
            && let Some(id) = self.wheels_topic()?
        {
            return Ok(Choice::Wheels(id));
        }
        let tracks: Vec<TopicId> = self.odometry.keys().copied().collect();
        match tracks[..] {
            [] => {}
            [id] => return Ok(Choice::Poses(id)),
            _ => {
                let names: Vec<&str> = tracks.iter().map(|id| self.name(*id)).collect();
                let what = format!(
                    "odometry of {} topics: choose one with --odom-topic {}",
                    names.len(),
                    names.join(" or ")
                );
                return Err(self.topics_error(what));
            }
        }
        if let Some((id, child)) = self.moving_base(None) {
            return Ok(Choice::Transforms(id, child));
        }
        // Joints that nobody asked for may be anything's; only what is clear is used.
        Ok(self.wheels_topic().ok().flatten().map_or(Choice::None, Choice::Wheels))
    }

    /// The odometry of a topic that the user named.
    fn named_odometry(&self, name: &str) -> Result<Choice, LogError> {
        let named =
            |(_, t): &(usize, &Topic)| t.is_named(name) && !matches!(t.role, Role::Scan | Role::Other);
        let Some((index, topic)) = self.topics.iter().enumerate().find(named) else {
            let what = format!(
                "--odom-topic: no topic {name} has nav_msgs/Odometry, tf2_msgs/TFMessage or sensor_msgs/JointState"
            );
            return Err(self.topics_error(what));
        };
        let id = TopicId(index);
        let choice = match topic.role {
            Role::Odometry => self.odometry.contains_key(&id).then_some(Choice::Poses(id)),
            Role::Transforms => self.moving_base(Some(id)).map(|(id, child)| Choice::Transforms(id, child)),
            _ => match self.joints.get(&id) {
                Some(joints) if is_pair(joints) => Some(Choice::Wheels(id)),
                Some(joints) => return Err(self.topics_error(unclear(name, joints))),
                None => None,
            },
        };
        choice
            .ok_or_else(|| self.topics_error(format!("--odom-topic: the topic {name} has no odometry in it")))
    }

    /// The only topic with a left and a right wheel; an error if wheels are there and not clear.
    fn wheels_topic(&self) -> Result<Option<TopicId>, LogError> {
        let wheeled: Vec<(TopicId, &Joints)> = self
            .joints
            .iter()
            .filter(|(_, joints)| joints.names.iter().any(|name| wheel(name).is_some()))
            .map(|(id, joints)| (*id, joints))
            .collect();
        match wheeled[..] {
            [] => Ok(None),
            [(id, joints)] if is_pair(joints) => Ok(Some(id)),
            [(id, joints)] => Err(self.topics_error(unclear(self.name(id), joints))),
            _ => {
                let names: Vec<&str> = wheeled.iter().map(|(id, _)| self.name(*id)).collect();
                let what = format!(
                    "wheels of {} topics: choose one with --odom-topic {}",
                    names.len(),
                    names.join(" or ")
                );
                Err(self.topics_error(what))
            }
        }
    }

    /// The topic and frame of the robot that moves in a frame `odom`: a usual name, else the one with the most records.
    fn moving_base(&self, topic: Option<TopicId>) -> Option<(TopicId, String)> {
        let rank = |child: &str| {
            BASES.iter().rev().position(|base| *base == last_part(child)).map_or(0, |at| at + 1)
        };
        self.moving
            .iter()
            .filter(|((id, _), track)| match topic {
                Some(topic) => *id == topic,
                None => track.records.len() > 1,
            })
            .max_by_key(|((_, child), track)| (rank(child), track.records.len()))
            .map(|(key, _)| key.clone())
    }

    /// Puts the chosen odometry into the records; what it says of the robot's frame.
    pub(super) fn take_odometry(&mut self, choice: Choice) -> Option<String> {
        let (records, child) = match choice {
            Choice::Poses(id) => self.odometry.remove(&id).map(|t| (t.records, Some(t.child))),
            Choice::Transforms(id, child) => {
                self.moving.remove(&(id, child)).map(|t| (t.records, Some(t.child)))
            }
            Choice::Wheels(id) => self.joints.remove(&id).map(|j| (j.records, None)),
            Choice::None => None,
        }
        .unwrap_or_default();
        if records.is_empty() {
            self.warn(
                "no_odometry",
                "the bag has no odometry (nav_msgs/Odometry, a transform from odom to the robot, or joint states of a left \
                 and a right wheel): the scans alone are used",
            );
        }
        self.records.odometry = records;
        child.filter(|c| !c.is_empty())
    }

    fn name(&self, id: TopicId) -> &str {
        self.topics.get(id.0).map_or("", |t| t.name.as_str())
    }
}

/// Whether a topic has exactly one left and one right wheel.
fn is_pair(joints: &Joints) -> bool {
    let count = |side| joints.names.iter().filter(|name| wheel(name) == Some(side)).count();
    count(0) == 1 && count(1) == 1 && !joints.records.is_empty()
}

fn unclear(topic: &str, joints: &Joints) -> String {
    let names: Vec<&str> = joints.names.iter().take(LISTED).map(String::as_str).collect();
    format!(
        "{topic}: one left and one right wheel must be among the joints, by names like wheel_left_joint and \
         wheel_right_joint; the joints are {}",
        names.join(", ")
    )
}
