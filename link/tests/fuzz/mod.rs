//! What the fuzz target does with its bytes. The target in `link/fuzz` and the replay of its corpus share it.

use link::{FRAME, FromRobot, Receiver, Request, Sender};

/// Bytes as they may come over the line, to both ends, and bytes as bodies; how many messages were found. Whatever was understood must
/// be the same once it has gone over the line again.
pub fn receiver(data: &[u8]) -> usize {
    let mut found = 0;
    let (mut robot, mut pc) = (Receiver::<64>::default(), Receiver::<FRAME>::default());
    for &byte in data {
        let at_the_robot = robot.push(byte).map(<[u8]>::to_vec);
        let at_the_pc = pc.push(byte).map(<[u8]>::to_vec);
        // What is short enough for the robot is the same for both.
        assert!(at_the_robot.is_none() || at_the_robot == at_the_pc);
        found += usize::from(at_the_pc.is_some_and(|body| decode(&body)));
    }
    decode(data);
    found
}

fn decode(body: &[u8]) -> bool {
    if let Ok(request) = Request::decode(body) {
        again(&request, |body| Request::decode(body).ok());
    }
    let Some(message) = FromRobot::decode(body) else { return false };
    if let FromRobot::Ranges(ranges) = &message {
        let _ = ranges.ranges.ranges_mm();
    }
    if let FromRobot::Ticks(ticks) = &message {
        assert_eq!(ticks.samples().count(), ticks.steps.len() + 1);
    }
    again(&message, FromRobot::decode);
    true
}

/// As text, since a number that is none is unlike itself.
fn again<T: serde::Serialize + core::fmt::Debug>(message: &T, decode: impl Fn(&[u8]) -> Option<T>) {
    let mut frame = [0; FRAME];
    let len = Sender::default().frame(message, &mut frame).expect("it came out of a frame");
    let mut receiver = Receiver::<FRAME>::default();
    let body = frame[..len].iter().find_map(|byte| receiver.push(*byte).map(<[u8]>::to_vec));
    let back = body.and_then(|body| decode(&body));
    assert_eq!(format!("{:?}", Some(message)), format!("{:?}", back.as_ref()));
}
