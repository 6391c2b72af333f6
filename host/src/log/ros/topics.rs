//! The topics of a bag, and what each is good for.

use super::messages::{Encoding, bare};
use crate::recording::{LINK_TOPIC, LINK_TYPE};

/// What a topic is good for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Role {
    /// sensor_msgs/LaserScan.
    Scan,
    /// nav_msgs/Odometry.
    Odometry,
    /// tf2_msgs/TFMessage.
    Transforms,
    /// sensor_msgs/JointState.
    Joints,
    /// What a robot said over its link.
    Link,
    /// Nothing here.
    Other,
}

impl Role {
    /// By the name and the type, without ROS 2's `msg/`.
    pub fn of(name: &str, kind: &str) -> Self {
        match kind {
            LINK_TYPE if name == LINK_TOPIC => Self::Link,
            "sensor_msgs/LaserScan" => Self::Scan,
            "nav_msgs/Odometry" => Self::Odometry,
            "tf2_msgs/TFMessage" | "tf/tfMessage" => Self::Transforms,
            "sensor_msgs/JointState" => Self::Joints,
            _ => Self::Other,
        }
    }
}

/// A topic of a bag.
#[derive(Clone, Debug)]
pub struct Topic {
    pub name: String,
    /// Its type, without ROS 2's `msg/`.
    pub kind: String,
    pub encoding: Encoding,
    pub role: Role,
    /// Messages seen.
    pub count: usize,
}

impl Topic {
    /// Whether a name, with its leading slash or without, is this topic's.
    pub fn is_named(&self, name: &str) -> bool {
        bare(&self.name) == bare(name)
    }
}

/// The side of a wheel's joint, 0 left and 1 right, where its name tells.
pub fn wheel(joint: &str) -> Option<usize> {
    let name = joint.to_lowercase();
    if !name.contains("wheel") {
        return None;
    }
    let side = |word: &str, letter: &str| {
        name.contains(word) || name.split(|c: char| !c.is_alphanumeric()).any(|part| part == letter)
    };
    match (side("left", "l"), side("right", "r")) {
        (true, false) => Some(0),
        (false, true) => Some(1),
        _ => None,
    }
}

/// A number of things in words.
pub fn counted(count: usize, thing: &str) -> String {
    format!("{count} {thing}{}", if count == 1 { "" } else { "s" })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sides_are_told_by_words_and_letters() {
        for left in
            ["wheel_left_joint", "left_wheel", "l_wheel_joint", "wheel_l", "Wheel-L", "front/LeftWheel"]
        {
            assert_eq!(wheel(left), Some(0), "{left}");
        }
        for right in ["wheel_right_joint", "r_wheel", "wheel_r"] {
            assert_eq!(wheel(right), Some(1), "{right}");
        }
        for neither in ["wheel_joint", "left_arm", "wheel_left_right", "caster_wheel_link"] {
            assert_eq!(wheel(neither), None, "{neither}");
        }
    }
}
