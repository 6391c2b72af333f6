//! `lineslam scan` on a pseudo terminal with the simulated sensor behind it, in real time.
#![cfg(unix)]

use std::io::{ErrorKind, Read, Write};
use std::process::Command;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use scip::sim::SimulatedUrg;
use serialport::{SerialPort as _, TTYPort};

fn lineslam() -> Command {
    Command::new(env!("CARGO_BIN_EXE_lineslam"))
}

/// One end of a pseudo terminal, and the name by which another program opens the other.
fn terminal() -> (TTYPort, String) {
    let (here, there) = TTYPort::pair().expect("a pseudo terminal");
    let device = there.name().expect("a pseudo terminal has a name");
    (here, device)
}

/// A square room of 4 m, the sensor in its middle; every tenth beam sees nothing.
fn measure(_: u64, ranges_mm: &mut [u16]) {
    for (beam, range_mm) in ranges_mm.iter_mut().enumerate() {
        let bearing = (beam as f64 - 340.0) * std::f64::consts::TAU / 1024.0;
        let reach = 2000.0 / bearing.cos().abs().max(bearing.sin().abs());
        *range_mm = if beam % 10 == 0 { 0 } else { reach as u16 };
    }
}

/// Plays the sensor on one end of a pseudo terminal until told to stop. As on USB, the bit rate does not matter.
fn play(mut line: impl Read + Write, stop: &AtomicBool) {
    let start = Instant::now();
    let mut sensor = SimulatedUrg::new(0, 1);
    let mut buffer = [0; 64];
    while !stop.load(Ordering::Relaxed) {
        let now_us = start.elapsed().as_micros() as u64;
        match line.read(&mut buffer) {
            Ok(n) => {
                for &byte in &buffer[..n] {
                    let rate = sensor.baud_rate();
                    sensor.receive(byte, rate, now_us);
                }
            }
            Err(e) if matches!(e.kind(), ErrorKind::TimedOut | ErrorKind::WouldBlock) => {}
            // Nobody has opened the other end, or has closed it.
            Err(_) => std::thread::sleep(Duration::from_millis(2)),
        }
        sensor.advance(now_us, &mut measure);
        let sent: Vec<u8> = std::iter::from_fn(|| sensor.transmit(now_us)).map(|s| s.byte).collect();
        // What nobody listens to is lost, as on a line.
        let _ = line.write_all(&sent);
    }
}

#[test]
fn prints_who_the_sensor_is_and_draws_a_scan() {
    let (mut here, device) = terminal();
    here.set_timeout(Duration::from_millis(2)).unwrap();
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("scan.svg");
    let stop = AtomicBool::new(false);
    let output = std::thread::scope(|scope| {
        scope.spawn(|| play(here, &stop));
        let output = lineslam().args(["scan", "--port", &device, "--out"]).arg(&out).output().unwrap();
        stop.store(true, Ordering::Relaxed);
        output
    });
    let (stdout, stderr) = (String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    assert!(output.status.success(), "{stderr}");
    for expected in [
        "URG-04LX(Hokuyo Automatic Co.,Ltd.)",
        "3.1.04(02/Aug./2007)",
        "H0000000",
        "682 beams from -119.5° to 119.9°, 20 to 5600 mm, 600 rpm",
        "613 ranges, 69 beams with nothing in range, 0 not measured",
    ] {
        assert!(stdout.contains(expected), "{expected} in\n{stdout}");
    }
    let drawing = std::fs::read_to_string(&out).unwrap();
    assert!(drawing.contains("SOKUIKI Sensor URG-04LX H0000000"));
    assert!(drawing.matches("h0").count() == 613);
}

#[test]
fn a_port_that_is_not_there_is_named_and_nothing_is_written() {
    let folder = tempfile::tempdir().unwrap();
    let output =
        lineslam().current_dir(folder.path()).args(["scan", "--port", "/dev/no-such-port"]).output().unwrap();
    assert!(!output.status.success());
    let stderr = String::from_utf8_lossy(&output.stderr);
    assert!(stderr.starts_with("error: /dev/no-such-port: "), "{stderr}");
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
}

#[test]
fn a_port_without_a_sensor_is_left_with_an_error() {
    let (_here, device) = terminal();
    let folder = tempfile::tempdir().unwrap();
    let output = lineslam()
        .current_dir(folder.path())
        .args(["scan", "--attempts", "1", "--port", &device])
        .output()
        .unwrap();
    assert!(!output.status.success());
    let stderr = String::from_utf8_lossy(&output.stderr);
    assert_eq!(stderr, format!("error: {device}: no sensor answers at any bit rate\n"));
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
}
