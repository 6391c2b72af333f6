//! A recording of the emulated board: what a PC makes of it is what the firmware did.

mod common;

use std::path::Path;
use std::sync::{Arc, Mutex};

use common::{hall_with, nothing_lost, robot, scans};
use emulator::record::{Entry, Event};
use emulator::run::Outcome;
use emulator::vcp::FarEnd;
use lineslam::configuration::Configuration;
use lineslam::log::{self, ReadOptions};
use lineslam::recording::{Recorder, Summary};
use lineslam::replay::{self, Replay, Start};
use link::{Command, FRAME, FromRobot, Receiver, Request, Sender};
use slam_core::geometry::pose::components;

/// 2026, microseconds.
const NOW_US: u64 = 1_770_000_000_000_000;

/// A PC that records, and tells the robot something now and then.
struct Pc {
    recorder: Arc<Mutex<Option<Recorder>>>,
    receiver: Receiver<FRAME>,
    sender: Sender,
    id: u32,
    /// The latest first.
    commands: Vec<(u64, Command)>,
}

impl FarEnd for Pc {
    fn exchange(&mut self, now_us: u64, from_board: &[u8], to_board: &mut Vec<u8>) -> anyhow::Result<()> {
        let mut recorder = self.recorder.lock().expect("nobody panics with it");
        let Some(recorder) = recorder.as_mut() else { return Ok(()) };
        let mut commands = Vec::new();
        while let Some((_, command)) = self.commands.pop_if(|(at_us, _)| *at_us <= now_us) {
            commands.push(command);
        }
        for &byte in from_board {
            let message = self.receiver.push(byte).and_then(FromRobot::decode);
            if let Some(message) = message {
                commands.extend(recorder.take(&message, NOW_US + now_us)?);
            }
        }
        for command in commands {
            self.id += 1;
            let mut frame = [0; FRAME];
            let request = Request { id: self.id, command };
            let len = self.sender.frame(&request, &mut frame).map_err(|_| anyhow::anyhow!("{request:?}"))?;
            to_board.extend(&frame[..len]);
        }
        Ok(())
    }
}

/// Drives through the hall and records it.
fn recorded(path: &Path, seconds: u64, faults: &[&str], commands: &[(f64, Command)]) -> (Outcome, Summary) {
    let recorder = Recorder::create(path, None, false).expect("a new file");
    let recorder = Arc::new(Mutex::new(Some(recorder)));
    let mut commands: Vec<_> = commands.iter().map(|(at_s, c)| ((at_s * 1e6) as u64, *c)).collect();
    commands.sort_by_key(|(at_us, _)| std::cmp::Reverse(*at_us));
    let (receiver, sender) = (Receiver::default(), Sender::default());
    let pc = Pc { recorder: recorder.clone(), receiver, sender, id: 7000, commands };
    let (outcome, _) = hall_with(pc, Some(seconds), faults);
    let recorder = recorder.lock().expect("nobody panics with it").take().expect("it is there");
    (outcome, recorder.finish().expect("the file is ended"))
}

/// As `lineslam replay --robot robots/paper.toml` does it.
fn replayed(path: &Path) -> (log::Log, Replay) {
    let log = log::read(path, &ReadOptions::default()).expect("a log");
    let start = Start { follows: true, ..Start::default() };
    let replay = replay::run_from(&start, &log, &robot(), Configuration::Default.config(), || ());
    let replay = replay.expect("a replay");
    (log, replay)
}

fn bits(pose: &nalgebra::Vector3<f32>) -> [u32; 3] {
    [pose.x, pose.y, pose.z].map(f32::to_bits)
}

/// The firmware's record of its own scans and the replay of the recording, to the last bit; how many there are.
fn compared(entries: &[Entry], replay: &Replay) -> usize {
    let board: Vec<_> = scans(entries).map(|entry| bits(&entry.pose)).collect();
    let here: Vec<_> = replay.steps.iter().map(|step| bits(&components(&step.pose))).collect();
    // The last may still be on its way.
    assert!(here.len() + 1 >= board.len(), "{} of {}", here.len(), board.len());
    assert_eq!(here, board[..here.len()]);
    here.len()
}

#[test]
fn a_replay_of_a_recording_is_what_the_board_did_bit_for_bit_through_a_reset() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("hall.mcap");
    // Scans that stay away, and commands, before a reset in the drive.
    let commands = [
        (12.0, Command::SetMapping(false)),
        (14.0, Command::SetMapping(true)),
        (16.0, Command::SetPose([0.5, 0.25, 0.0625])),
        (18.0, Command::Forget),
    ];
    let (outcome, summary) = recorded(&path, 60, &["unplug@24+3", RESET], &commands);
    let last = outcome.entries.iter().position(|entry| entry.event == Event::Resumed).expect("a kept map");
    let (before, after) = (&outcome.entries[last - 1], &outcome.entries[last]);
    println!(
        "{summary:?}\nreset at {:?}, between {} and {} µs",
        outcome.resets, before.read_us, after.read_us
    );
    assert_eq!((summary.runs, outcome.resets.len(), summary.joined), (2, 1, false));
    assert!(summary.missing.is_none(), "{:?}", summary.missing);
    let (log, replay) = replayed(&path);
    assert_eq!(log.warnings, []);
    let scans = compared(&outcome.entries, &replay);
    let agreement = replay.agreement.expect("it was followed");
    println!("{scans} scans, {agreement:?}, {} bytes", std::fs::metadata(&path).expect("the file").len());
    assert_eq!((agreement.different, agreement.unknown), (0, 0));
    assert!(agreement.same + 1 >= outcome.entries.len() && scans > 500);
}

/// Between two scans, when nothing is being taken in or sent: in the middle of one, the kept map would be half done.
const RESET: &str = "reset@40.03";

#[test]
fn with_a_revolution_of_another_length_it_would_be_another() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("hall.mcap");
    let (outcome, summary) = recorded(&path, 15, &[], &[]);
    assert!(nothing_lost(&outcome) && summary.missing.is_none());
    let (mut log, replay) = replayed(&path);
    compared(&outcome.entries, &replay);
    let course = log.course.as_mut().expect("a course");
    for (_, step) in &mut course.steps {
        if let lineslam::recording::course::Step::Done(act) = step
            && let Some(scan) = &mut act.scan
        {
            scan.revolution_us += 1000;
        }
    }
    let start = Start { follows: true, ..Start::default() };
    let other = replay::run_from(&start, &log, &robot(), Configuration::Default.config(), || ());
    let agreement = other.expect("a replay").agreement.expect("it was followed");
    assert!(agreement.different > 50, "{agreement:?}");
}
