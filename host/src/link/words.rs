//! What the robot says, in words.

use slam_core::odometry::wheel_faults::WheelFault;
use slam_core::tracking::TrackingState;

use super::from_robot::{self, Event, Outcome, State};

/// What has happened.
pub fn of_event(event: &Event) -> String {
    match event {
        Event::Started(cause) => format!("the board has started: {cause:?}"),
        Event::SensorLost => "no scans: the robot goes on by odometry".into(),
        Event::SensorFound => "scans again".into(),
        Event::LoopClosed => "a loop was closed".into(),
        Event::Wheels(Some(fault)) => fault_of(*fault).message().into(),
        Event::Wheels(None) => "the wheels are as they should be again".into(),
        Event::MapFull => "the map is full: old lines give way".into(),
        Event::State(now) => format!("the robot is {}", of_state(*now)),
        Event::CountersRestarted => "the wheels' counters began anew".into(),
        Event::ScanRefused => "a scan was refused: another number of beams".into(),
    }
}

/// A fault of the wheels, as the core knows it.
pub fn fault_of(fault: from_robot::WheelFault) -> WheelFault {
    use from_robot::WheelFault as Said;
    match fault {
        Said::Swapped => WheelFault::Swapped,
        Said::LeftReversed => WheelFault::LeftReversed,
        Said::RightReversed => WheelFault::RightReversed,
        Said::BothReversed => WheelFault::BothReversed,
        Said::SwappedAndReversed => WheelFault::SwappedAndReversed,
        Said::LeftDead => WheelFault::LeftDead,
        Said::RightDead => WheelFault::RightDead,
        Said::BothDead => WheelFault::BothDead,
    }
}

/// How far the pose is to be relied on, as the core knows it.
pub fn state_of(state: State) -> TrackingState {
    match state {
        State::Tracking => TrackingState::Tracking,
        State::Uncertain => TrackingState::Uncertain,
        State::Lost => TrackingState::Lost,
    }
}

/// How far the pose is to be relied on.
pub fn of_state(state: State) -> &'static str {
    state_of(state).name()
}

/// Why a request was not carried out; none where it was.
pub fn of_refusal(outcome: Outcome) -> Option<&'static str> {
    match outcome {
        Outcome::Done => None,
        Outcome::Unknown => Some("the robot's firmware does not know this"),
        Outcome::OutOfRange => Some("the robot refuses: a number makes no sense"),
        Outcome::NotConfigured => Some("the robot is not configured to do this"),
    }
}
