//! The emulator as a program of its own, as `lineslam live --emulate` and `lineslam connect --emulate` start it.

mod common;

use std::net::TcpStream;
use std::process::Command;
use std::time::{Duration, Instant};

use common::{elf, root};
use lineslam::emulated::{Board, EmulationError};
use lineslam::link::{Address, Client, Command as Asked, FromRobot};
use link::from_robot::Outcome;

fn emulator() -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_emulator"));
    command.current_dir(root()).arg("--firmware").arg(elf("lineslam"));
    command.args([
        "--attended",
        "--vcp",
        "0",
        "--speed",
        "max",
        "--world",
        "corridor_short",
        "--seconds",
        "12",
    ]);
    command
}

#[test]
fn it_says_where_it_is_and_when_the_drive_is_over_goes_on_and_ends_with_its_owner() {
    let mut board = Board::start(&mut emulator()).unwrap();
    let Address::Tcp(place) = board.address().clone() else { panic!("a socket") };
    board.wait().unwrap();
    // The robot stands, and hears what it is told.
    let mut client = Client::connect(board.address()).unwrap();
    assert_eq!(client.request(Asked::SetMapping(false)).unwrap(), Outcome::Done);
    let mut last_us = 0;
    let begun = Instant::now();
    while last_us < 15_000_000 {
        assert!(begun.elapsed() < Duration::from_secs(60), "{last_us} µs");
        if let Some(FromRobot::Pose(pose)) = client.next(Duration::from_secs(1)).unwrap() {
            last_us = pose.at_us;
        }
    }
    board.check().unwrap();
    let asked = Instant::now();
    drop(board);
    println!("it ended within {:?}", asked.elapsed());
    assert!(asked.elapsed() < Duration::from_secs(2));
    assert!(TcpStream::connect(place).is_err(), "nobody listens there any more");
}

#[test]
fn one_that_cannot_run_says_so() {
    match Board::start(emulator().args(["--set", "wind=3"])) {
        Err(EmulationError::Ended { status }) => assert_eq!(status.code(), Some(1)),
        other => panic!("{other:?}"),
    }
}
