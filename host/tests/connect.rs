//! `lineslam connect`, beside a robot that is a socket.

mod socket_robot;

use std::net::TcpStream;
use std::process::{Command as Process, Output};

use link::Command;
use socket_robot::robot;

fn connect(address: &str, arguments: &[&str]) -> Output {
    let mut process = Process::new(env!("CARGO_BIN_EXE_lineslam"));
    process.args(["connect", "--port", address]).args(arguments).output().unwrap()
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

#[test]
fn each_subcommand_is_its_command() {
    let quarter = std::f32::consts::FRAC_PI_2;
    for (arguments, command) in [
        (&["forget", "--yes"][..], Command::Forget),
        (&["set-pose", "1.5", "-2", "90"], Command::SetPose([1.5, -2.0, quarter])),
        (&["freeze"], Command::SetMapping(false)),
        (&["unfreeze"], Command::SetMapping(true)),
        (&["find"], Command::Relocalise),
        (&["restart"], Command::Restart),
    ] {
        let (address, robot) = robot(0);
        let output = connect(&address, arguments);
        assert!(output.status.success(), "{}", text(&output.stderr));
        let requests = robot.join().unwrap();
        assert_eq!(requests.iter().map(|request| request.command).collect::<Vec<_>>(), [command]);
    }
}

#[test]
fn a_request_without_an_answer_is_sent_again_with_the_same_number() {
    let (address, robot) = robot(2);
    let output = connect(&address, &["freeze"]);
    assert!(output.status.success(), "{}", text(&output.stderr));
    let requests = robot.join().unwrap();
    assert_eq!(requests.len(), 3);
    assert!(requests.iter().all(|request| *request == requests[0]));
}

#[test]
fn a_robot_that_says_nothing_or_no_is_an_error() {
    let (address, deaf) = robot(usize::MAX);
    let output = connect(&address, &["unfreeze"]);
    assert_eq!(output.status.code(), Some(1));
    assert!(text(&output.stderr).contains("no answer from the robot within 4 s"), "{}", text(&output.stderr));
    deaf.join().unwrap();
    let (address, robot) = robot(0);
    let output = connect(&address, &["set-pose", "1e9", "0", "0"]);
    assert_eq!(output.status.code(), Some(1));
    assert!(text(&output.stderr).contains("a number makes no sense"), "{}", text(&output.stderr));
    robot.join().unwrap();
    for (port, says) in
        [("tcp://127.0.0.1:1", "refused"), ("/dev/nothing", "/dev/nothing"), ("tcp://x", "expected")]
    {
        let output = connect(port, &["freeze"]);
        assert!(!output.status.success());
        assert!(text(&output.stderr).contains(says), "{}", text(&output.stderr));
    }
}

#[test]
fn the_map_is_not_forgotten_unless_it_is_meant() {
    let (address, robot) = robot(0);
    let output = connect(&address, &["forget"]);
    assert_eq!(output.status.code(), Some(1));
    assert!(text(&output.stderr).contains("--yes"), "{}", text(&output.stderr));
    // It was not even connected to.
    drop(TcpStream::connect(address.strip_prefix("tcp://").unwrap()).unwrap());
    assert_eq!(robot.join().unwrap(), []);
}

#[test]
fn the_map_comes_whole_though_a_message_was_lost() {
    let (address, robot) = robot(0);
    let output = connect(&address, &["map"]);
    assert!(output.status.success(), "{}", text(&output.stderr));
    let printed = text(&output.stdout);
    let lines: Vec<&str> = printed.lines().collect();
    assert_eq!(lines.len(), 41);
    assert_eq!((lines[0], lines[9]), ("x0,y0,x1,y1,scans,wall", "8,0,8,2.5,9,true"));
    let requests = robot.join().unwrap();
    let asked =
        requests.iter().filter(|r| r.command == Command::SendMap { blocks: 1, places: false }).count();
    assert_eq!(asked, 1);
}

#[test]
fn the_trajectory_is_printed_as_tum() {
    let (address, robot) = robot(0);
    let output = connect(&address, &["--tum", "--seconds", "1"]);
    assert!(output.status.success(), "{}", text(&output.stderr));
    let printed = text(&output.stdout);
    assert!(
        printed.starts_with("1.100000 0.500000 -0.250000 0 0 0 0.000000000 1.000000000\n1.200000 "),
        "{printed}"
    );
    assert!(printed.lines().count() > 10 && printed.lines().all(|line| line.split(' ').count() == 8));
    robot.join().unwrap();
}

#[test]
fn who_is_there_and_how_it_does_is_printed() {
    let (address, robot) = robot(0);
    let output = connect(&address, &["--seconds", "2"]);
    let printed = text(&output.stdout);
    assert!(printed.contains("robot 'paper': lineslam 0.1.0 on a socket, up for 1.0 s"), "{printed}");
    assert!(
        printed.contains("x 0.500 y -0.250 m, 0.0°, sure within 0.014 m; tracking; 40 lines"),
        "{printed}"
    );
    robot.join().unwrap();
}
