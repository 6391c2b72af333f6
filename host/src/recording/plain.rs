//! The plain log of a recording: a whole line at a time.

use std::fs::File;
use std::io::Write;
use std::path::{Path, PathBuf};

use super::RecordError;
use super::course::RobotScan;
use super::ros::{geometry, wheels};
use crate::link::from_robot::Hello;
use crate::log::{Odometry, plain_header, plain_line};

/// A plain log that is being written.
pub(super) struct Plain {
    path: PathBuf,
    file: File,
    has_header: bool,
}

impl Plain {
    pub fn new(path: &Path, file: File) -> Self {
        Self { path: path.to_owned(), file, has_header: false }
    }

    /// Lines that are written at once: nothing of them waits here.
    fn put(&mut self, hello: &Hello, revolution_us: u32, text: &mut String) -> Result<(), RecordError> {
        if !std::mem::replace(&mut self.has_header, true) {
            let stated = geometry(&hello.scanner, revolution_us);
            text.insert_str(0, &plain_header(&hello.robot, &stated, wheels(hello)));
        }
        self.file.write_all(text.as_bytes()).map_err(|source| self.failed(source))
    }

    fn failed(&self, source: std::io::Error) -> RecordError {
        RecordError::Io { path: self.path.clone(), source }
    }

    /// A scan, stamped as its sensor had it: what the robot takes off the stamp its robot file says again.
    pub fn scan(&mut self, hello: &Hello, scan: &RobotScan, epoch_us: u64) -> Result<(), RecordError> {
        let stamp_us = epoch_us.saturating_add(scan.middle_us);
        let stamp_us = stamp_us.saturating_add_signed(hello.scanner.late_us.into());
        let mut text = String::new();
        plain_line(&mut text, stamp_us, None, Some(&scan.ranges_mm));
        self.put(hello, scan.revolution_us, &mut text)
    }

    pub fn ticks(&mut self, hello: &Hello, stamp_us: u64, ticks: [i32; 2]) -> Result<(), RecordError> {
        // The first line says how long a revolution takes, so it is of a scan.
        if !self.has_header {
            return Ok(());
        }
        let mut text = String::new();
        plain_line(&mut text, stamp_us, Some(&Odometry::Ticks(ticks.map(i64::from))), None);
        self.put(hello, 0, &mut text)
    }

    pub fn finish(self) -> Result<(), RecordError> {
        self.file.sync_all().map_err(|source| self.failed(source))
    }
}
