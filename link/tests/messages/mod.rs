//! Messages of all kinds, with small numbers and with the largest.
#![allow(dead_code)] // Each test file uses its part.

use heapless::Vec;
use link::FromRobot;
use link::from_robot::*;
use link::map::{LINES, LOOPS, Line, PLACES};
use link::ranges::{Packed, RANGES};
use link::to_robot::{Command, Request, Streams};
use link::{FRAME, Receiver, Sender};

pub fn full<T: Clone, const N: usize>(item: T) -> Vec<T, N> {
    core::iter::repeat_n(item, N).collect()
}

pub fn text<const N: usize>() -> heapless::String<N> {
    core::iter::repeat_n('x', N).collect()
}

/// The largest of each kind.
pub fn largest() -> [FromRobot; 12] {
    let far = f32::MIN_POSITIVE;
    let line = Line { start_m: [far; 2], end_m: [far; 2], sigma_m: far, hits: u16::MAX, is_wall: true };
    let most = u32::MAX;
    [
        FromRobot::Hello(Hello {
            uptime_us: u64::MAX,
            firmware: text(),
            board: text(),
            robot: text(),
            lines: u16::MAX,
            places: u16::MAX,
            reset: ResetCause::Other,
            kept: KeptMap::Damaged,
            scanner: Scanner {
                beams: u16::MAX,
                first_bearing_rad: far,
                step_rad: far,
                min_mm: u16::MAX,
                max_mm: u16::MAX,
                base_from_laser: [far; 3],
                upside_down: true,
                late_us: i32::MIN,
            },
            wheels: Wheels { radii_m: [far; 2], track_m: far, ticks_per_turn: far },
            streams: Streams(u16::MAX),
        }),
        FromRobot::Pose(Pose {
            number: most,
            cause: Cause::PoseSet([far; 3]),
            at_us: u64::MAX,
            samples: most,
            pose: [far; 3],
            covariance: [far; 6],
            state: State::Lost,
            lines: u16::MAX,
            took_us: most,
        }),
        FromRobot::Status(largest_status()),
        FromRobot::Health(Health {
            uptime_us: u64::MAX,
            scan_us: most,
            longest_scan_us: most,
            mapping_permille: u16::MAX,
            link_permille: u16::MAX,
            stack: [most; 3],
            sent: most,
            poses_replaced: most,
            scans_unsent: most,
            samples_unsent: most,
            events_unsent: most,
            received: most,
            damaged: most,
            unknown: most,
            overruns: most,
        }),
        FromRobot::Event(Happened { at_us: u64::MAX, event: Event::Wheels(Some(WheelFault::BothDead)) }),
        FromRobot::Answer(Answer { id: most, outcome: Outcome::NotConfigured }),
        FromRobot::Ticks(Ticks {
            before: most,
            stamp_us: u64::MAX,
            ticks: [i32::MIN; 2],
            steps: full((most, i32::MIN, i32::MAX)),
        }),
        FromRobot::Ranges(Ranges {
            number: most,
            at_us: u64::MAX,
            revolution_us: most,
            beams: u16::MAX,
            first: u16::MAX,
            ranges: Packed::of(&[u16::MAX; RANGES]),
        }),
        FromRobot::Lines(Lines(full::<_, LINES>((u16::MAX, line)))),
        FromRobot::Block(Block { block: u8::MAX, lines: u16::MAX, check: most }),
        FromRobot::Places(Places { first: u16::MAX, poses: full::<_, PLACES>([far; 3]) }),
        FromRobot::PlacesEnd(PlacesEnd {
            places: u16::MAX,
            check: most,
            loops: full::<_, LOOPS>((u16::MAX, u16::MAX)),
        }),
    ]
}

/// All bytes of its counters that a reader can give them: each of a varint's most.
fn largest_status() -> Status {
    let mut bytes = std::vec![0xFF; 9];
    bytes.push(1);
    bytes.extend(1.5f32.to_le_bytes());
    bytes.extend([1, 1, 1, 7, 1]);
    bytes.extend([0; 8]);
    bytes.push(1);
    for _ in 0..28 {
        bytes.extend([0xFF, 0xFF, 0xFF, 0xFF, 0x0F]);
    }
    bytes.extend([0xFF, 0xFF, 0x03]);
    let (status, rest) = postcard::take_from_bytes(&bytes).expect("a status");
    assert!(rest.is_empty(), "as many fields as are filled here");
    status
}

/// Requests of all kinds.
pub fn requests() -> [Request; 8] {
    let mut id = u32::MAX - 3;
    [
        Command::Hello,
        Command::Subscribe(Streams::ALL),
        Command::Forget,
        Command::SetPose([1.5, -2.0, 3.0]),
        Command::SetMapping(false),
        Command::Relocalise,
        Command::SendMap { blocks: u32::MAX, places: true },
        Command::Restart,
    ]
    .map(|command| {
        id = id.wrapping_add(1);
        Request { id, command }
    })
}

/// The frame of a message.
pub fn framed(sender: &mut Sender, message: &impl serde::Serialize) -> std::vec::Vec<u8> {
    let mut frame = [0; FRAME];
    let len = sender.frame(message, &mut frame).expect("a message that fits");
    frame[..len].to_vec()
}

/// The bodies that are found in some bytes.
pub fn bodies(receiver: &mut Receiver, bytes: &[u8]) -> std::vec::Vec<std::vec::Vec<u8>> {
    bytes.iter().filter_map(|byte| receiver.push(*byte).map(<[u8]>::to_vec)).collect()
}
