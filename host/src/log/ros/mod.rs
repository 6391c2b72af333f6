//! ROS bags: scans, odometry and where the scanner sits, from ROS 1 bags and from ROS 2 bags in MCAP and SQLite.
//!
//! ```text
//!  bag1 │ mcap │ db3 ──► (topic, time, bytes) ──► [collect] ──► choice of topics, mounting ──► [Records]
//!   a container each        [messages]                            [topics], [transforms], [finish]
//! ```
//!
//! A container is walked once, from its begin to its end, and nothing of it is kept but the numbers that are wanted. An
//! index at the end is not needed, so that bags whose recorder was killed and bags that were cut are read as far as they
//! go. A size that a file states is not believed before that many bytes have been seen.

mod bag1;
mod choice;
mod collect;
mod db3;
mod finish;
mod input;
mod mcap;
mod messages;
mod scan;
mod topics;
mod transforms;

use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};

use collect::Collector;
use input::Watched;

use super::{Format, LogError, ReadOptions, Records};

/// Reads a bag.
pub fn read(path: &Path, format: Format, options: &ReadOptions<'_>) -> Result<Records, LogError> {
    match format {
        Format::Ros1 => {
            let (file, total) = open(path)?;
            read_ros1(path, file, total, options)
        }
        Format::Mcap => read_mcap(path, &[path.to_owned()], options),
        Format::Db3 => db3::read(path, options),
        other => {
            let what = format!("{} is not a format of ROS bags", other.name());
            Err(LogError::NotALog { path: path.to_owned(), what })
        }
    }
}

/// Reads a ROS 1 bag of `total` bytes from anything that gives its bytes in order; `path` is for messages. Memory grows with
/// the scans and the odometry, not with the bag.
pub fn read_ros1(
    path: &Path,
    reader: impl Read,
    total: u64,
    options: &ReadOptions<'_>,
) -> Result<Records, LogError> {
    let mut collector = Collector::new(path, options);
    bag1::walk(Watched::new(reader, 0, total, options.progress), total, &mut collector)?;
    collector.finish()
}

/// Reads MCAP files that follow on each other; `path` is for messages.
fn read_mcap(path: &Path, files: &[PathBuf], options: &ReadOptions<'_>) -> Result<Records, LogError> {
    let mut collector = Collector::new(path, options);
    let opened = files.iter().map(|file| open(file)).collect::<Result<Vec<_>, _>>()?;
    let all = opened.iter().map(|(_, total)| total).sum();
    let mut before = 0;
    for ((file, total), name) in opened.into_iter().zip(files) {
        collector.begin_file(name);
        let watched = Watched::new(file, before, all, options.progress);
        mcap::walk(watched, total, &mut collector)?;
        before += total;
    }
    collector.finish()
}

/// A file and its length.
fn open(path: &Path) -> Result<(File, u64), LogError> {
    let file = File::open(path).map_err(LogError::open(path))?;
    let total = file.metadata().map_err(LogError::open(path))?.len();
    Ok((file, total))
}
