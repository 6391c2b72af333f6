//! What the robot says, in words.

use super::from_robot::{Event, Outcome, State};

/// What has happened.
pub fn of_event(event: &Event) -> String {
    match event {
        Event::Started(cause) => format!("the board has started: {cause:?}"),
        Event::SensorLost => "no scans: the robot goes on by odometry".into(),
        Event::SensorFound => "scans again".into(),
        Event::LoopClosed => "a loop was closed".into(),
        Event::Wheels(Some(fault)) => format!("something is wrong with the wheels: {fault:?}"),
        Event::Wheels(None) => "the wheels are as they should be again".into(),
        Event::MapFull => "the map is full: old lines give way".into(),
        Event::State(now) => format!("the robot is {}", of_state(*now)),
        Event::CountersRestarted => "the wheels' counters began anew".into(),
        Event::ScanRefused => "a scan was refused: another number of beams".into(),
    }
}

/// How far the pose is to be relied on.
pub fn of_state(state: State) -> &'static str {
    match state {
        State::Tracking => "tracking",
        State::Uncertain => "uncertain",
        State::Lost => "lost",
    }
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
