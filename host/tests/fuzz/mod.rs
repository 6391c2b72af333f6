//! What the fuzz targets do with their bytes. The targets in `host/fuzz` and the replay of their corpus share it.
#![allow(dead_code)] // Each user needs its part.

use std::path::Path;

use lineslam::log::{Format, ReadOptions, ros};

/// The formats, by the names of their targets.
pub const TARGETS: [(&str, Format); 6] = [
    ("rosbag1", Format::Ros1),
    ("mcap", Format::Mcap),
    ("db3", Format::Db3),
    ("carmen", Format::Carmen),
    ("plain", Format::Plain),
    ("mines", Format::Mines),
];

/// Bytes as a file of a format, read strictly and leniently: a log or an error, and never a panic. What is read is no more
/// than the file could hold.
pub fn read(format: Format, data: &[u8]) {
    // A bag does not need to be a file, which is faster.
    if format == Format::Ros1 {
        for options in all_options(format) {
            let _ = ros::read_ros1(Path::new("fuzz.bag"), data, data.len() as u64, &options);
        }
        return;
    }
    let folder = tempfile::tempdir().expect("a folder for the log");
    let path = folder.path().join("log");
    std::fs::write(&path, data).expect("the log is written");
    for options in all_options(format) {
        let _ = lineslam::log::read(&path, &options);
    }
}

/// Options that lead different ways.
fn all_options(format: Format) -> [ReadOptions<'static>; 2] {
    [
        ReadOptions { format, ..ReadOptions::default() },
        ReadOptions {
            format,
            lenient: true,
            wheels: true,
            scan_topic: Some("scan"),
            ..ReadOptions::default()
        },
    ]
}
