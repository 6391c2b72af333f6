//! The link on the emulated board: what the virtual COM port says is what the firmware did, and nothing that a PC does costs a scan.

mod common;

use std::collections::BTreeMap;

use common::{hall, hall_with, last_error_m, nothing_lost, robot, says, scans};
use emulator::record::{Entry, Event};
use emulator::report::{first_difference, replayed};
use emulator::run::Outcome;
use emulator::vcp::{FarEnd, Script, messages, poses};
use link::from_robot::{Answer, Cause, Health, Outcome as Done, Pose, ResetCause};
use link::map::{BLOCK, Line, block_check, places_check};
use link::{BIT_RATE, Command, FRAME, FromRobot, Receiver, Request, Sender, Streams};

/// Requests at these seconds, numbered.
fn script(commands: &[(f64, Command)]) -> Script {
    let number = |(k, (at_s, command)): (usize, &(f64, Command))| {
        ((at_s * 1e6) as u64, Request { id: 1000 + k as u32, command: *command })
    };
    Script::new(commands.iter().enumerate().map(number))
}

fn everything() -> Script {
    script(&[(0.5, Command::Subscribe(Streams::ALL))])
}

/// The bits of what an entry of the record and a pose have in common.
fn bits_of(entry: &Entry) -> (String, [u32; 3], u32) {
    let what = match &entry.event {
        Event::Scan { middle_us, .. } => format!("scan {middle_us}"),
        Event::Coasted { until_us } => format!("coasted {until_us}"),
        other => format!("{other:?}"),
    };
    (what, entry.pose.map(f32::to_bits).into(), entry.segments)
}

fn bits_of_pose(pose: &Pose) -> (String, [u32; 3], u32) {
    let what = match pose.cause {
        Cause::Scan => format!("scan {}", pose.at_us),
        Cause::Coasted => format!("coasted {}", pose.at_us),
        other => format!("{other:?}"),
    };
    (what, pose.pose.map(f32::to_bits), pose.lines.into())
}

fn health(outcome: &Outcome) -> Health {
    let last = messages(&outcome.vcp).into_iter().rev().find_map(|message| match message {
        FromRobot::Health(health) => Some(health),
        _ => None,
    });
    last.expect("once a second")
}

fn answers(outcome: &Outcome) -> Vec<Answer> {
    let answer = |message| if let FromRobot::Answer(answer) = message { Some(answer) } else { None };
    messages(&outcome.vcp).into_iter().filter_map(answer).collect()
}

#[test]
fn all_that_is_subscribed_to_is_what_the_firmware_did_bit_for_bit() {
    let (outcome, judged) = hall_with(everything(), Some(60), &[]);
    assert!(nothing_lost(&outcome) && judged.report.scans_sent - judged.report.scans_used <= 1);
    let FromRobot::Hello(hello) = &messages(&outcome.vcp)[0] else { panic!("who is there comes first") };
    assert_eq!(
        (hello.robot.as_str(), hello.lines, hello.reset),
        ("paper", slam_core::capacity::SEGMENTS as u16, ResetCause::Power)
    );
    // Every event of the record, in order; the last may still be on its way.
    let said: Vec<_> = poses(&outcome.vcp).map(|pose| bits_of_pose(&pose)).collect();
    let done: Vec<_> = outcome.entries.iter().map(bits_of).collect();
    assert!(said.len() + 1 >= done.len() && said.len() > 600, "{} of {}", said.len(), done.len());
    assert_eq!(said, done[..said.len()]);
    // Every range of every scan, from the first that was taken in after the subscription.
    let (mut whole, mut begun): (Vec<Vec<u16>>, Vec<u16>) = (Vec::new(), Vec::new());
    let (mut samples, mut before) = (Vec::new(), None);
    for message in messages(&outcome.vcp) {
        match message {
            FromRobot::Ranges(part) => {
                assert_eq!(usize::from(part.first), begun.len());
                begun.extend(part.ranges.ranges_mm().expect("as they were packed"));
                if begun.len() == usize::from(part.beams) {
                    whole.push(std::mem::take(&mut begun));
                }
            }
            FromRobot::Ticks(ticks) => {
                // In one row, none missing.
                assert_eq!(*before.get_or_insert(ticks.before), ticks.before);
                samples.extend(ticks.samples());
                before = Some(ticks.before + ticks.steps.len() as u32 + 1);
            }
            _ => {}
        }
    }
    let ranges = |entry: &Entry| match &entry.event {
        Event::Scan { ranges_mm, .. } => Some(ranges_mm.clone()),
        _ => None,
    };
    let taken: Vec<_> = outcome.entries.iter().filter_map(ranges).collect();
    assert!(whole.len() + 1 >= taken.len());
    assert_eq!(whole, taken[..whole.len()]);
    let all: Vec<_> =
        outcome.entries.iter().flat_map(|e| &e.samples).map(|s| (s.stamp_us, [s.left, s.right])).collect();
    let from = all.iter().position(|sample| *sample == samples[0]).expect("a sample of the record");
    let both = samples.len().min(all.len() - from);
    assert!(both > 11_000 && samples[..both] == all[from..from + both], "{both}");
    let health = health(&outcome);
    println!("{health:?}\n{} bytes in 60 s", outcome.vcp.len());
    assert_eq!(
        (health.poses_replaced, health.scans_unsent, health.samples_unsent, health.events_unsent),
        (0, 0, 0, 0)
    );
    // Half of the line is to spare.
    assert!((outcome.vcp.len() as u64) < outcome.end_us * u64::from(BIT_RATE) / 10 / 2_000_000);
}

/// Scans take as long as without, and less than a twentieth more.
#[test]
fn a_subscriber_to_all_costs_the_mapping_nothing() {
    let (alone, judged_alone) =
        hall_with(script(&[(0.5, Command::Subscribe(Streams::default()))]), Some(40), &[]);
    let (listened_to, judged) = hall_with(everything(), Some(40), &[]);
    let [with, without] = [&judged, &judged_alone].map(|judged| judged.report.update_us);
    println!("a scan, median, p99 and most: {with:?} with, {without:?} without; {:?}", health(&listened_to));
    assert!(nothing_lost(&alone) && nothing_lost(&listened_to));
    // The one that is under way when the run ends is not used.
    for report in [&judged.report, &judged_alone.report] {
        assert!(report.scans_sent - report.scans_used <= 1, "{} of {}", report.scans_used, report.scans_sent);
    }
    assert!(f64::from(with[0]) < f64::from(without[0]) * 1.05, "{with:?} {without:?}");
    assert!(health(&listened_to).link_permille < 40);
}

#[test]
fn noise_from_the_pc_at_full_rate_loses_no_scan() {
    let (undisturbed, _) = hall(Some(40), &[]);
    let (outcome, judged) = hall_with(everything(), Some(40), &["vcp-noise@5+30"]);
    assert!(nothing_lost(&outcome));
    assert!(judged.report.scans_sent - judged.report.scans_used <= 1);
    assert_eq!(outcome.resets, []);
    let health = health(&outcome);
    println!("{health:?}");
    assert!(health.damaged + health.overruns > 1000, "{health:?}");
    // It goes the same way: the first scan's instant is all that it depends on.
    assert_eq!(first_difference(&outcome.entries, &robot()).unwrap(), None);
    let [last, alone] = [&outcome, &undisturbed].map(|outcome| scans(&outcome.entries).count());
    assert!(last.abs_diff(alone) <= 1, "{last} {alone}");
    // And understands what is said after it.
    assert_eq!(answers(&outcome).len(), 1);
}

/// A PC that keeps the map, and loses a frame now and then.
#[derive(Default)]
struct Keeper {
    receiver: Receiver<FRAME>,
    sender: Sender,
    requests: u32,
    frames: u32,
    lines: BTreeMap<u16, Line>,
    places: BTreeMap<u16, [f32; 3]>,
    frozen: bool,
    same: std::sync::Arc<std::sync::Mutex<Kept>>,
}

/// What it has, and how its checks came out.
#[derive(Default)]
struct Kept {
    asked: u32,
    lost: u32,
    lines: Vec<Line>,
    blocks_wrong: std::collections::BTreeSet<u8>,
    places_wrong: bool,
}

impl Keeper {
    fn take(&mut self, message: FromRobot) -> Option<Command> {
        let mut same = self.same.lock().unwrap();
        match message {
            FromRobot::Lines(lines) => self.lines.extend(lines.0),
            FromRobot::Places(places) => {
                self.places.extend((places.first..).zip(places.poses));
            }
            FromRobot::Block(block) => {
                self.lines.retain(|slot, _| *slot < block.lines);
                let from = u16::from(block.block) * BLOCK as u16;
                let of_block = self.lines.range(from..from + BLOCK as u16).map(|(_, line)| line);
                same.lines = self.lines.values().copied().collect();
                if block_check(of_block) != block.check {
                    same.blocks_wrong.insert(block.block);
                    same.asked += 1;
                    return Some(Command::SendMap { blocks: 1 << block.block, places: false });
                }
                same.blocks_wrong.remove(&block.block);
            }
            FromRobot::PlacesEnd(end) => {
                self.places.retain(|index, _| *index < end.places);
                same.places_wrong = places_check(self.places.values()) != end.check;
                if same.places_wrong {
                    same.asked += 1;
                    return Some(Command::SendMap { blocks: 0, places: true });
                }
            }
            _ => {}
        }
        None
    }
}

impl FarEnd for Keeper {
    fn exchange(&mut self, now_us: u64, from_board: &[u8], to_board: &mut Vec<u8>) -> anyhow::Result<()> {
        let mut commands = Vec::new();
        if self.requests == 0 && now_us > 1_000_000 {
            commands.push(Command::Subscribe(Streams::ALL));
        }
        // So that the map is the same from then on.
        if now_us > 57_000_000 && !std::mem::replace(&mut self.frozen, true) {
            commands.push(Command::SetMapping(false));
        }
        for &byte in from_board {
            let Some(body) = self.receiver.push(byte).map(<[u8]>::to_vec) else { continue };
            self.frames += 1;
            // The cable is out from 20 s to 25 s, and one frame in fifty never arrives until 55 s.
            if (20_000_000..25_000_000).contains(&now_us)
                || (self.frames.is_multiple_of(50) && now_us < 55_000_000)
            {
                self.same.lock().unwrap().lost += 1;
                continue;
            }
            commands.extend(FromRobot::decode(&body).and_then(|message| self.take(message)));
        }
        for command in commands {
            self.requests += 1;
            let mut frame = [0; FRAME];
            let len =
                self.sender.frame(&Request { id: self.requests, command }, &mut frame).expect("it fits");
            to_board.extend(&frame[..len]);
        }
        Ok(())
    }
}

#[test]
fn a_map_of_which_frames_were_lost_is_the_robot_s_again() {
    let keeper = Keeper::default();
    let same = keeper.same.clone();
    let (outcome, judged) = hall_with(keeper, Some(60), &[]);
    let kept = same.lock().unwrap();
    println!("{} frames lost, asked {} times, {} lines", kept.lost, kept.asked, kept.lines.len());
    assert!(kept.lost > 100 && kept.asked > 10, "{} {}", kept.lost, kept.asked);
    assert!(kept.blocks_wrong.is_empty() && !kept.places_wrong);
    // The lines are those that a PC has that does what the robot did: to the last bit, slot by slot.
    let mapper = replayed(&outcome.entries, &robot()).unwrap();
    let ends = |[a, b]: [[f32; 2]; 2]| [a[0], a[1], b[0], b[1]].map(f32::to_bits);
    let there: Vec<_> =
        kept.lines.iter().map(|line| (ends([line.start_m, line.end_m]), line.hits, line.is_wall)).collect();
    let slam = mapper.slam();
    let here = slam.map().segments().iter().enumerate().map(|(slot, entry)| {
        let ends = ends([entry.segment().start, entry.segment().end].map(|end| [end.x, end.y]));
        (ends, entry.hits, slam.is_wall(slot))
    });
    assert_eq!(there, here.collect::<Vec<_>>());
    assert!(judged.map.len() >= 10 && judged.map.len() == there.iter().filter(|line| line.2).count());
}

#[test]
fn each_command_is_done_once_answered_and_logged() {
    let set = Command::SetPose([0.25, -0.125, 0.0625]);
    let commands = script(&[
        (2.0, Command::Hello),
        (2.5, Command::Subscribe(Streams::DEFAULT)),
        (20.0, Command::SetMapping(false)),
        (24.0, Command::SetMapping(true)),
        (26.0, Command::Relocalise),
        (40.0, Command::Forget),
        (42.0, set),
        (44.0, Command::SetPose([f32::NAN, 0.0, 0.0])),
        (46.0, Command::Restart),
    ]);
    // The same request again, as of a PC that has heard no answer.
    let (outcome, judged) = hall_with(Twice(commands, None), Some(60), &[]);
    let given: Vec<_> = answers(&outcome).into_iter().map(|answer| (answer.id, answer.outcome)).collect();
    let of = |k: u32| if k == 7 { Done::OutOfRange } else { Done::Done };
    let expected: Vec<_> = (0..9u32).flat_map(|k| [(1000 + k, of(k)); 2]).take(17).collect();
    assert_eq!(given, expected);
    let done: Vec<_> = outcome
        .entries
        .iter()
        .filter(|e| !matches!(e.event, Event::Scan { .. } | Event::Coasted { .. }))
        .collect();
    let events: Vec<_> = done.iter().map(|entry| entry.event.clone()).collect();
    let Command::SetPose(to) = set else { unreachable!() };
    let once = [
        Event::Frozen,
        Event::Unfrozen,
        Event::Relocalising,
        Event::Forgotten,
        Event::PoseSet(to),
        Event::Resumed,
    ];
    assert_eq!(events, once);
    assert_eq!(done[3].segments, 0);
    // Over sine and cosine, and back.
    assert!((done[4].pose - nalgebra::Vector3::from(to)).norm() < 1e-6, "{:?}", done[4].pose);
    assert_eq!(outcome.resets.len(), 1);
    assert!(says(&outcome, "INFO", "reset by Software") && says(&outcome, "INFO", "link: Forget: Done"));
    // A frozen map stays as it is.
    let frozen = |entry: &&Entry| (20_500_000..24_000_000).contains(&entry.read_us);
    let segments: std::collections::BTreeSet<_> =
        outcome.entries.iter().filter(frozen).map(|e| e.segments).collect();
    assert_eq!(segments.len(), 1, "{segments:?}");
    // A PC that does the same computes the same.
    assert_eq!(first_difference(&outcome.entries, &robot()).unwrap(), None);
    println!("{}", last_error_m(&judged));
    let hellos =
        messages(&outcome.vcp).into_iter().filter(|message| matches!(message, FromRobot::Hello(_))).count();
    assert_eq!(hellos, 3, "at the start, when asked once, and after the restart");
}

/// Sends everything but the restart twice, 50 ms apart.
struct Twice(Script, Option<(u64, Vec<u8>)>);

impl FarEnd for Twice {
    fn exchange(&mut self, now_us: u64, from_board: &[u8], to_board: &mut Vec<u8>) -> anyhow::Result<()> {
        self.0.exchange(now_us, from_board, to_board)?;
        // A robot that has restarted would do that again.
        if !to_board.is_empty() && now_us < 45_000_000 {
            self.1 = Some((now_us + 50_000, to_board.clone()));
        } else if let Some((_, again)) = self.1.take_if(|(at_us, _)| *at_us <= now_us) {
            to_board.extend(again);
        }
        Ok(())
    }
}
