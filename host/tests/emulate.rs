//! `--emulate` of `lineslam connect` and `lineslam live`, with a script in cargo's place, which says what the emulator says. The emulator
//! itself is tested beside it (`emulator/tests/attended.rs`).
#![cfg(unix)]

mod socket_robot;

use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::time::{Duration, Instant};

use tempfile::TempDir;

fn lineslam(cargo: &Path, arguments: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_lineslam"));
    command.env("CARGO", cargo).current_dir(std::env::temp_dir()).args(arguments);
    command
}

fn text(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

/// A cargo that does this.
fn cargo(folder: &TempDir, script: &str) -> PathBuf {
    let path = folder.path().join("cargo");
    std::fs::write(&path, format!("#!/bin/sh\n{script}\n")).unwrap();
    std::fs::set_permissions(&path, PermissionsExt::from_mode(0o755)).unwrap();
    path
}

/// An emulator whose board is a socket. It notes what it was told, and that it has ended.
fn emulator(folder: &TempDir, address: &str, says_later: &str) -> PathBuf {
    let there = folder.path().display();
    let script = format!(
        "echo \"$@\" > {there}/told\necho '==> emulator'\necho 'the virtual COM port is {address}'\n{says_later}\ncat > {there}/input\ntouch {there}/ended"
    );
    cargo(folder, &script)
}

fn has_ended(folder: &TempDir) -> bool {
    let begun = Instant::now();
    while !folder.path().join("ended").exists() {
        if begun.elapsed() > Duration::from_secs(20) {
            return false;
        }
        std::thread::sleep(Duration::from_millis(20));
    }
    true
}

#[test]
fn what_cannot_be_emulated_is_said_and_why() {
    let folder = tempfile::tempdir().unwrap();
    let failing = cargo(&folder, "echo 'error: no such target' >&2; exit 101");
    let nowhere = Path::new("/nowhere/cargo");
    for (cargo, command, code, says) in [
        (
            nowhere,
            &["live", "--no-open", "--listen", "127.0.0.1:0", "--emulate", "moon"][..],
            2,
            "none of the worlds corridor, ",
        ),
        (nowhere, &["connect", "--emulate", "moon"], 2, "moon is no world file"),
        (nowhere, &["connect", "--emulate", "hall"], 1, "/nowhere/cargo cannot be run"),
        (nowhere, &["connect", "--emulate", "hall", "freeze"], 1, "lineslam live --emulate hall"),
        (
            nowhere,
            &["live", "--no-open", "--listen", "127.0.0.1:0", "--emulate", "hall", "--speed", "0"],
            1,
            "cannot be paused",
        ),
        (&failing, &["connect", "map", "--emulate", "hall"], 1, "no such target"),
        (
            &failing,
            &["live", "--no-open", "--listen", "127.0.0.1:0", "--emulate", "hall"],
            1,
            "has ended (exit status: 101)",
        ),
    ] {
        let output = lineslam(cargo, command).output().unwrap();
        assert!(text(&output).contains(says), "{command:?}: {}", text(&output));
        assert_eq!(output.status.code(), Some(code), "{command:?}");
    }
}

#[test]
fn the_board_is_started_watched_until_its_drive_is_over_and_ended() {
    let folder = tempfile::tempdir().unwrap();
    let (address, robot) = socket_robot::robot(0);
    let cargo = emulator(&folder, &address, "sleep 1; echo 'the drive is over'");
    let output = lineslam(&cargo, &["connect", "--emulate", "hall", "--seed", "7"]).output().unwrap();
    assert!(output.status.success(), "{}", text(&output));
    let printed = String::from_utf8_lossy(&output.stdout);
    assert!(printed.starts_with("robot 'paper'"), "{printed}");
    assert!(text(&output).contains("==> emulator"), "{}", text(&output));
    assert!(has_ended(&folder));
    let told = std::fs::read_to_string(folder.path().join("told")).unwrap();
    assert!(told.starts_with("xtask emulate --attended --vcp 0 --world /"), "{told}");
    assert!(told.trim().ends_with("worlds/hall.toml --seed 7 --speed 1"), "{told}");
    robot.join().unwrap();
}

#[test]
fn the_map_is_printed_when_the_drive_is_over() {
    let folder = tempfile::tempdir().unwrap();
    let (address, robot) = socket_robot::robot(0);
    let cargo = emulator(&folder, &address, "sleep 0.3; echo 'the drive is over'");
    let output = lineslam(&cargo, &["connect", "map", "--emulate", "hall"]).output().unwrap();
    assert!(output.status.success(), "{}", text(&output));
    assert_eq!(String::from_utf8_lossy(&output.stdout).lines().count(), 41);
    assert!(has_ended(&folder));
    robot.join().unwrap();
}

/// Not even a kill leaves one behind.
#[test]
fn the_board_ends_however_its_owner_ends() {
    for signal in ["-INT", "-TERM", "-KILL"] {
        for command in [&["connect"][..], &["live", "--no-open", "--listen", "127.0.0.1:0"]] {
            let folder = tempfile::tempdir().unwrap();
            let (address, robot) = socket_robot::robot(0);
            let cargo = emulator(&folder, &address, "");
            let mut child = lineslam(&cargo, command)
                .args(["--emulate", "hall"])
                .stdout(Stdio::piped())
                .stderr(Stdio::null())
                .spawn()
                .unwrap();
            // What it prints first it prints once it has met the robot.
            let mut line = String::new();
            let said = child.stdout.take().unwrap();
            std::io::BufRead::read_line(&mut std::io::BufReader::new(said), &mut line).unwrap();
            let id = child.id().to_string();
            assert!(Command::new("kill").args([signal, &id]).status().unwrap().success());
            child.wait().unwrap();
            assert!(has_ended(&folder), "{signal} {command:?}");
            robot.join().unwrap();
        }
    }
}
