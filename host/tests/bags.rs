//! ROS bags, written here and read back: scans, stamps, geometry, mounting, the choice of topics, and damage.

use std::io::{Read, Write};
use std::path::{Path, PathBuf};

use lineslam::log::records::{BAD_MM, NO_ECHO_MM};
use lineslam::log::{Format, LogError, Odometry, ReadOptions, Records, ros};

mod writers;
use writers::*;

fn options() -> ReadOptions<'static> {
    ReadOptions::default()
}

fn read_bag(bag: &[u8], options: &ReadOptions<'_>) -> Result<Records, LogError> {
    ros::read_ros1(Path::new("drive.bag"), bag, bag.len() as u64, options)
}

/// Of messages in ROS 1's encoding.
fn read_messages(messages: &[Recorded], options: &ReadOptions<'_>) -> Result<Records, LogError> {
    read_bag(&ros1(messages, Chunks::None, 5), options)
}

fn suspected(records: &Records) -> Vec<&str> {
    records.warnings.iter().map(|w| w.suspected).collect()
}

fn warning<'a>(records: &'a Records, suspected: &str) -> &'a str {
    &records.warnings.iter().find(|w| w.suspected == suspected).expect(suspected).message
}

/// The text of the error that a bag's topics give.
fn topics_text(result: Result<Records, LogError>) -> String {
    match result {
        Err(error @ LogError::Topics { .. }) => error.to_string(),
        other => panic!("{other:?}"),
    }
}

/// Everything that the drive must give, however it is stored.
fn check_drive(records: &Records, scans: usize) {
    assert_eq!(records.scans.len(), scans);
    assert_eq!(records.odometry.len(), scans);
    assert_eq!(records.skipped.len(), 0);
    assert_eq!(suspected(records), Vec::<&str>::new());
    for (k, scan) in records.scans.iter().enumerate() {
        // 20 beams of 1 ms after the stamp: the middle is 10 ms later.
        assert_eq!(scan.stamp_us, 1_600_000_000_000_000 + 100_000 * k as i64 + 10_000);
        let expected: Vec<u16> = (0..21).map(|i| (1000 + 100 * i + 10 * k) as u16).collect();
        assert_eq!(scan.ranges_mm, expected);
        assert_eq!(scan.geometry, Some(0));
    }
    for (k, reading) in records.odometry.iter().enumerate() {
        assert_eq!(reading.stamp_us, 1_600_000_000_000_001 + 100_000 * k as i64);
        let Odometry::Pose([x, y, yaw]) = reading.odometry else { panic!("{reading:?}") };
        assert!((x - 0.1 * k as f64).abs() < 1e-12 && y == -0.2 && (yaw - 0.01 * k as f64).abs() < 1e-12);
    }
    let [geometry] = records.geometries[..] else { panic!("{:?}", records.geometries) };
    assert_eq!((geometry.first_bearing_rad, geometry.step_rad), (-1.0, 0.1));
    assert!((geometry.revolution_s - 0.062_831_85).abs() < 1e-6);
    assert_eq!(geometry.limits_m, Some([0.05, 8.0]));
    assert!(geometry.upside_down);
    for (actual, expected) in geometry.base_from_laser.unwrap().iter().zip([0.3, 0.05, 0.5]) {
        assert!((actual - expected).abs() < 1e-6, "{geometry:?}");
    }
}

#[test]
fn ros1_bags_of_all_compressions() {
    for chunks in [Chunks::None, Chunks::Bz2, Chunks::Lz4] {
        let bag = ros1(&drive(Coding::Ros1, 12), chunks, 5);
        let records = read_bag(&bag, &options()).unwrap();
        check_drive(&records, 12);
        assert_eq!([records.scans[0].place, records.odometry[0].place, records.scans[2].place], [2, 3, 7]);
    }
}

#[test]
fn mcap_files_of_all_compressions_and_encodings() {
    let folder = tempfile::tempdir().unwrap();
    for compression in [None, Some(mcap::Compression::Lz4), Some(mcap::Compression::Zstd)] {
        for coding in [Coding::Cdr, Coding::Ros1] {
            let path = folder.path().join("drive.mcap");
            std::fs::write(&path, mcap_file(&drive(coding, 40), compression, coding)).unwrap();
            check_drive(&ros::read(&path, Format::Mcap, &options()).unwrap(), 40);
        }
    }
}

#[test]
fn sqlite_bags_are_read_in_the_order_of_time() {
    let folder = tempfile::tempdir().unwrap();
    let mut messages = drive(Coding::Cdr, 12);
    messages.reverse();
    let path = folder.path().join("drive 100%#1?.db3");
    db3(&path, &messages, false);
    check_drive(&ros::read(&path, Format::Db3, &options()).unwrap(), 12);
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1, "no file is left beside the bag");
}

#[test]
fn a_folder_is_read_as_its_metadata_lists_it() {
    let folder = tempfile::tempdir().unwrap();
    let messages = drive(Coding::Cdr, 12);
    let metadata = |files: &str, more: &str| {
        let yaml =
            format!("rosbag2_bagfile_information:\n  relative_file_paths:\n{files}  duration: 1\n{more}");
        std::fs::write(folder.path().join("metadata.yaml"), yaml).unwrap();
    };
    let read = || ros::read(folder.path(), Format::Db3, &options());

    metadata("    - drive_1.db3\n    - bag/drive_0.db3\n", "");
    db3(&folder.path().join("drive_1.db3"), &messages[..10], false);
    db3(&folder.path().join("drive_0.db3"), &messages[10..], false);
    check_drive(&read().unwrap(), 12);

    metadata("    - a.mcap\n    - b.mcap\n", "");
    let mcap = |messages| mcap_file(messages, Some(mcap::Compression::Zstd), Coding::Cdr);
    std::fs::write(folder.path().join("a.mcap"), mcap(&messages[..9])).unwrap();
    std::fs::write(folder.path().join("b.mcap"), mcap(&messages[9..])).unwrap();
    check_drive(&read().unwrap(), 12);

    metadata("    - c.db3\n", "  compression_format: zstd\n  compression_mode: MESSAGE\n");
    db3(&folder.path().join("c.db3"), &messages, true);
    check_drive(&read().unwrap(), 12);

    metadata("    - c.db3.zstd\n", "  compression_mode: FILE\n");
    assert!(read().unwrap_err().to_string().contains("zstd -d c.db3.zstd"));
}

#[test]
fn a_bag_whose_recorder_was_killed_or_whose_index_is_damaged_is_read() {
    let good = ros1(&drive(Coding::Ros1, 12), Chunks::Bz2, 5);
    let index_at = u64::from_le_bytes(good[13 + 4 + 8 + 4 + 10..][..8].try_into().unwrap()) as usize;
    assert!(index_at < good.len(), "{index_at}");

    let mut killed = bag_header(0);
    killed.extend_from_slice(&good[killed.len()..index_at]);
    let records = read_bag(&killed, &options()).unwrap();
    assert_eq!((records.scans.len(), suspected(&records)), (12, vec!["damaged"]));
    assert!(warning(&records, "damaged").contains("12 scans could be read"), "{records:?}");

    let mut damaged = good.clone();
    damaged[index_at..].fill(0xaa);
    let records = read_bag(&damaged, &options()).unwrap();
    assert_eq!((records.scans.len(), records.skipped["damaged"]), (12, 1));
    assert!(warning(&records, "damaged").contains(&format!("byte {index_at}")), "{records:?}");
}

#[test]
fn the_last_chunk_of_a_killed_recorder_is_used() {
    for chunks in [Chunks::None, Chunks::Bz2, Chunks::Lz4] {
        let messages = drive(Coding::Ros1, 40);
        let mut data = connection(0, &messages[0]);
        for (number, message) in [(1, &messages[1]), (2, &messages[2])] {
            data.extend(connection(number, message));
        }
        for message in messages.iter().filter(|m| m.topic != "/tf_static") {
            let number = ["/chatter", "/scan", "/odom"].iter().position(|t| *t == message.topic).unwrap();
            data.extend(message_record(number, message));
        }
        // Sizes are zero until the chunk is full.
        let mut begun = chunk(chunks, &data);
        let header = u32::from_le_bytes(begun[..4].try_into().unwrap()) as usize;
        begun[header..header + 8].fill(0);
        let mut bag = bag_header(0);
        bag.extend(&begun[..begun.len() - 1]);
        let records = read_bag(&bag, &options()).unwrap();
        let whole = if chunks == Chunks::None { 40..=40 } else { 1..=40 };
        assert!(whole.contains(&records.scans.len()), "{chunks:?} {}", records.scans.len());
    }
}

#[test]
fn a_bag_cut_anywhere_gives_what_comes_before() {
    for chunks in [Chunks::None, Chunks::Bz2, Chunks::Lz4] {
        let good = ros1(&drive(Coding::Ros1, 20), chunks, 4);
        let mut before = 0;
        for cut in (0..good.len()).step_by(97) {
            match read_bag(&good[..cut], &options()) {
                Ok(records) => {
                    assert!(records.scans.len() >= before, "{chunks:?} {cut}");
                    assert!(suspected(&records).contains(&"damaged"), "{chunks:?} {cut}");
                    before = records.scans.len();
                }
                Err(error) => assert_eq!(before, 0, "{chunks:?} {cut}: {error}"),
            }
        }
        assert!(before >= 19, "{chunks:?}: {before} scans of 20");
    }
}

#[test]
fn an_mcap_file_cut_anywhere_gives_what_comes_before() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("cut.mcap");
    for compression in [None, Some(mcap::Compression::Lz4), Some(mcap::Compression::Zstd)] {
        let good = mcap_file(&drive(Coding::Cdr, 40), compression, Coding::Cdr);
        let mut before = 0;
        for cut in (0..good.len()).step_by(97) {
            std::fs::write(&path, &good[..cut]).unwrap();
            match ros::read(&path, Format::Mcap, &options()) {
                Ok(records) => {
                    assert!(records.scans.len() >= before, "{compression:?} {cut}");
                    assert!(suspected(&records).contains(&"damaged"), "{compression:?} {cut}");
                    before = records.scans.len();
                }
                Err(error) => assert_eq!(before, 0, "{compression:?} {cut}: {error}"),
            }
        }
        assert_eq!(before, 40, "{compression:?}");
    }
}

#[test]
fn reading_goes_on_behind_a_damaged_chunk() {
    for chunks in [Chunks::None, Chunks::Bz2, Chunks::Lz4] {
        let good = ros1(&drive(Coding::Ros1, 40), chunks, 8);
        let third = |bytes: &[u8]| {
            bytes.windows(8).enumerate().filter(|(_, w)| w == b"\x04\0\0\0op=\x05").nth(2).unwrap().0
        };
        for (at, length) in [(60, 40), (0, 30)] {
            let mut damaged = good.clone();
            let from = third(&good) + at;
            damaged[from..from + length].fill(0xee);
            let records = read_bag(&damaged, &options()).unwrap();
            assert!(records.scans.len() >= 34, "{chunks:?} {at}: {}", records.scans.len());
            assert!(warning(&records, "damaged").contains("scans could be read"));
            assert!(records.skipped["damaged"] >= 1);
        }
    }
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("damaged.mcap");
    for compression in [None, Some(mcap::Compression::Lz4), Some(mcap::Compression::Zstd)] {
        let good = mcap_file(&drive(Coding::Cdr, 60), compression, Coding::Cdr);
        let mut told = 0;
        // Some of these places are in an index, which is of no use here.
        for part in 2..8 {
            let mut bytes = good.clone();
            let at = bytes.len() * part / 10;
            bytes[at..at + 40].fill(0xee);
            std::fs::write(&path, &bytes).unwrap();
            let records =
                ros::read(&path, Format::Mcap, &ReadOptions { lenient: true, ..options() }).unwrap();
            let scans = records.scans.len();
            assert!(scans >= 55, "{compression:?} {part}: {scans}");
            told += usize::from(suspected(&records).contains(&"damaged"));
        }
        assert!(told >= 3, "{compression:?}: {told}");
    }
}

#[test]
fn what_is_no_bag_is_an_error() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("bag");
    for bytes in [&b""[..], b"hello", b"#ROSBAG V1.2\n"] {
        std::fs::write(&path, bytes).unwrap();
        for format in [Format::Ros1, Format::Mcap, Format::Db3] {
            let error = ros::read(&path, format, &options()).unwrap_err();
            assert!(matches!(error, LogError::NotALog { .. }), "{error:?}");
        }
    }
    let mut damaged = bag_header(77);
    damaged.extend([0xff; 5000]);
    assert!(matches!(read_bag(&damaged, &options()).unwrap_err(), LogError::Damaged { .. }));
    rusqlite::Connection::open(folder.path().join("other.db3"))
        .unwrap()
        .execute_batch("CREATE TABLE t(a)")
        .unwrap();
    let error = ros::read(&folder.path().join("other.db3"), Format::Db3, &options()).unwrap_err();
    assert!(error.to_string().contains("no tables"), "{error}");
}

/// A drive without odometry, and more messages.
fn scans_and(more: impl IntoIterator<Item = Recorded>) -> Vec<Recorded> {
    let mut messages = drive(Coding::Ros1, 6);
    messages.retain(|m| m.topic != "/odom");
    messages.extend(more);
    messages
}

fn one_scan(scan: Scan) -> Vec<Recorded> {
    vec![recorded("/scan", SCAN, START, scan.bytes(Coding::Ros1))]
}

#[test]
fn clockwise_beams_keep_their_sign_and_echoes_their_meaning() {
    let ranges = vec![f32::NAN, f32::INFINITY, f32::NEG_INFINITY, -1.0, 0.0, 70.0, 0.0123, 2.0];
    let odd =
        Scan { angles: [0.35, -0.35, -0.1], ranges, time_increment: -1.0, limits: [0.0, 0.0], ..scan(0) };
    let records = read_messages(&one_scan(odd), &options()).unwrap();
    assert_eq!(records.scans[0].ranges_mm, [BAD_MM, NO_ECHO_MM, BAD_MM, BAD_MM, 0, NO_ECHO_MM, 12, 2000]);
    let geometry = records.geometries[0];
    assert_eq!((geometry.step_rad, geometry.revolution_s, geometry.limits_m), (-0.1, 0.0, None));
    assert_eq!(records.scans[0].stamp_us, 1_600_000_000_000_000);
    assert_eq!(suspected(&records), ["no_odometry", "mounting_unknown"]);
    let message = warning(&records, "mounting_unknown");
    assert!(message.contains("'laser'") && message.contains("[mounting]"), "{message}");
}

#[test]
fn a_scan_that_makes_no_sense_is_an_error_or_counted() {
    let mut messages = drive(Coding::Ros1, 4);
    let nonsense = Scan { angles: [0.0, 0.0, 0.0], ..scan(9) };
    messages.insert(4, recorded("/scan", SCAN, START, nonsense.bytes(Coding::Ros1)));
    let error = read_messages(&messages, &options()).unwrap_err();
    assert!(error.to_string().starts_with("drive.bag: message 5: angle_increment is 0"), "{error}");
    let records = read_messages(&messages, &ReadOptions { lenient: true, ..options() }).unwrap();
    assert_eq!((records.scans.len(), records.skipped["malformed"]), (4, 1));
}

#[test]
fn odometry_that_is_no_pose_is_counted() {
    let mut messages = drive(Coding::Ros1, 4);
    let broken = odometry(Coding::Ros1, START, "base_footprint", [f64::NAN, 0.0, 0.0]);
    messages.push(recorded("/odom", ODOMETRY, START, broken));
    messages.push(recorded("/odom", ODOMETRY, START, vec![1, 2, 3]));
    let records = read_messages(&messages, &options()).unwrap();
    assert_eq!((records.odometry.len(), records.skipped["malformed_odometry"]), (4, 2));
}

#[test]
fn of_several_scan_topics_one_must_be_chosen() {
    let rear = (0..2).map(|k| recorded("/rear", SCAN, START, scan(k).bytes(Coding::Ros1)));
    let mut messages = drive(Coding::Ros1, 5);
    messages.extend(rear);
    let text = topics_text(read_messages(&messages, &options()));
    assert_eq!(
        text,
        "drive.bag: scans of 2 topics: choose one with --scan-topic /scan or /rear\n  \
         /chatter  std_msgs/String  1 message\n  \
         /scan  sensor_msgs/LaserScan  5 messages\n  \
         /odom  nav_msgs/Odometry  5 messages\n  \
         /tf_static  tf2_msgs/TFMessage  1 message\n  \
         /rear  sensor_msgs/LaserScan  2 messages"
    );
    for (name, scans) in [("/scan", 5), ("rear", 2)] {
        let records = read_messages(&messages, &ReadOptions { scan_topic: Some(name), ..options() }).unwrap();
        assert_eq!(records.scans.len(), scans, "{name}");
    }
    let text = topics_text(read_messages(&messages, &ReadOptions { scan_topic: Some("/odom"), ..options() }));
    assert!(
        text.starts_with("drive.bag: --scan-topic: no topic /odom has sensor_msgs/LaserScan\n"),
        "{text}"
    );
    let text = topics_text(read_messages(&messages[..1], &options()));
    assert!(text.contains("no scans"), "{text}");
}

#[test]
fn of_several_odometry_topics_one_must_be_chosen() {
    let mut messages = drive(Coding::Ros1, 5);
    messages.push(recorded(
        "/ekf",
        ODOMETRY,
        START,
        odometry(Coding::Ros1, START, "base_link", [1.0, 2.0, 0.0]),
    ));
    let text = topics_text(read_messages(&messages, &options()));
    assert!(text.contains("odometry of 2 topics: choose one with --odom-topic /odom or /ekf\n"), "{text}");
    let records = read_messages(&messages, &ReadOptions { odom_topic: Some("ekf"), ..options() }).unwrap();
    assert_eq!(records.odometry.len(), 1);
    // The mounting is that on the frame of the chosen odometry.
    assert!((records.geometries[0].base_from_laser.unwrap()[0] - 0.2).abs() < 1e-6);
    let text =
        topics_text(read_messages(&messages, &ReadOptions { odom_topic: Some("/chatter"), ..options() }));
    assert!(text.contains("--odom-topic: no topic /chatter has nav_msgs/Odometry"), "{text}");
}

#[test]
fn without_odometry_the_transform_from_odom_is_taken() {
    let moving = |k: u64| {
        let links = [
            ("map", "odom", [5.0, 5.0, 0.0], quaternion(0.0, 1.0)),
            ("/odom", "base_footprint", [k as f64, 0.5, 0.0], quaternion(0.0, 0.1)),
        ];
        recorded("/tf", "tf/tfMessage", START, transforms(Coding::Ros1, START + k * SECOND, &links))
    };
    let records = read_messages(&scans_and((0..3).map(moving)), &options()).unwrap();
    assert_eq!(suspected(&records), Vec::<&str>::new());
    let stamps: Vec<i64> = records.odometry.iter().map(|r| r.stamp_us - 1_600_000_000_000_000).collect();
    assert_eq!(stamps, [0, 1_000_000, 2_000_000]);
    let Odometry::Pose([x, y, yaw]) = records.odometry[2].odometry else { panic!() };
    assert!(x == 2.0 && y == 0.5 && (yaw - 0.1).abs() < 1e-12);
    assert!((records.geometries[0].base_from_laser.unwrap()[0] - 0.3).abs() < 1e-6);
}

#[test]
fn wheels_are_taken_when_asked_for_or_when_nothing_else_is_there() {
    let turned = |k: u64| {
        let named =
            [("arm_joint", 9.0), ("wheel_right_joint", 2.0 * k as f64), ("wheel_left_joint", k as f64)];
        recorded("/joint_states", JOINTS, START, joints(Coding::Ros1, START + k * SECOND, &named))
    };
    let angles = |records: &Records| records.odometry.iter().map(|r| r.odometry).collect::<Vec<_>>();
    let expected: Vec<Odometry> =
        (0..3).map(|k| Odometry::Angles([f64::from(k), 2.0 * f64::from(k)])).collect();
    let alone = scans_and((0..3).map(turned));
    assert_eq!(angles(&read_messages(&alone, &options()).unwrap()), expected);

    let mut both = drive(Coding::Ros1, 5);
    both.extend((0..3).map(turned));
    check_drive(&read_messages(&both, &options()).unwrap(), 5);
    for options in [
        ReadOptions { wheels: true, ..options() },
        ReadOptions { odom_topic: Some("/joint_states"), ..options() },
    ] {
        assert_eq!(angles(&read_messages(&both, &options).unwrap()), expected);
    }

    let four = [("wheel_left_front", 1.0), ("wheel_left_back", 1.0), ("wheel_right_front", 1.0)];
    let unclear = scans_and([recorded("/joint_states", JOINTS, START, joints(Coding::Ros1, START, &four))]);
    assert_eq!(suspected(&read_messages(&unclear, &options()).unwrap()), ["no_odometry"]);
    let text = topics_text(read_messages(&unclear, &ReadOptions { wheels: true, ..options() }));
    assert!(text.contains("the joints are wheel_left_back, wheel_left_front, wheel_right_front\n"), "{text}");
}

#[test]
fn stamps_that_are_all_zero_give_way_to_the_recorders() {
    let messages: Vec<Recorded> = (0..3)
        .map(|k| {
            recorded("/scan", SCAN, START + k * SECOND, Scan { stamp_ns: 0, ..scan(k) }.bytes(Coding::Ros1))
        })
        .collect();
    let records = read_messages(&messages, &options()).unwrap();
    let stamps: Vec<i64> = records.scans.iter().map(|s| s.stamp_us - 1_600_000_000_010_000).collect();
    assert_eq!(stamps, [0, 1_000_000, 2_000_000]);
    assert!(suspected(&records).contains(&"recorder_stamps"));
}

#[test]
fn a_tilted_scanner_and_a_sicks_divided_field_are_said() {
    let tilted = [("base_link", "laser", [0.0; 3], quaternion(0.2, 0.0))];
    let sick = Scan {
        angles: [-1.570_796_4, 1.570_796_4, std::f32::consts::PI / 359.0],
        ranges: vec![1.0; 360],
        time_increment: 0.0,
        ..scan(0)
    };
    let mut messages = one_scan(sick);
    messages.push(recorded("/tf", TF, START, transforms(Coding::Ros1, START, &tilted)));
    let records = read_messages(&messages, &options()).unwrap();
    assert_eq!(suspected(&records), ["no_odometry", "tilted_scanner", "angle_increment"]);
    assert!(warning(&records, "tilted_scanner").contains("11.5°"));
    assert!(warning(&records, "angle_increment").contains("0.5° apart"));
    assert!(warning(&records, "angle_increment").contains("robots/sick.toml"));
}

/// A bag that is nowhere as a whole: its begin, a part again and again, and its end.
struct Endless {
    begin: Vec<u8>,
    part: Vec<u8>,
    position: u64,
    total: u64,
}

impl Read for Endless {
    fn read(&mut self, buffer: &mut [u8]) -> std::io::Result<usize> {
        let begin = self.begin.len() as u64;
        let source = match self.position.checked_sub(begin) {
            None => &self.begin[self.position as usize..],
            Some(into) => &self.part[(into % self.part.len() as u64) as usize..],
        };
        let count = source.len().min(buffer.len()).min((self.total - self.position) as usize);
        buffer[..count].copy_from_slice(&source[..count]);
        self.position += count as u64;
        Ok(count)
    }
}

/// The most memory this process has had since it was last asked to forget, MiB.
fn peak_mib() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find(|l| l.starts_with("VmHWM"))?;
    line.split_whitespace().nth(1)?.parse::<u64>().ok().map(|kib| kib / 1024)
}

/// From here on the peak counts, which is what the process has now.
fn peak_from_here_mib() -> Option<u64> {
    std::fs::write("/proc/self/clear_refs", "5").ok()?;
    peak_mib()
}

#[test]
fn two_gibibytes_are_read_in_64_mebibytes() {
    let total: u64 = 2 << 30;
    let messages = drive(Coding::Ros1, 3);
    let image = recorded("/image", "sensor_msgs/Image", START, vec![0x55; 8 << 20]);
    let mut begin = bag_header(0);
    let mut data = connection(0, &messages[1]);
    data.extend(connection(1, &image));
    begin.extend(chunk(Chunks::None, &data));
    // A camera's pictures in chunks of 32 MiB, and a scan in each.
    let mut data = Vec::new();
    for _ in 0..4 {
        data.extend(message_record(1, &image));
    }
    data.extend(message_record(0, &messages[1]));
    let part = chunk(Chunks::None, &data);
    drop((image, data));
    let scans = (total - begin.len() as u64) / part.len() as u64;
    let before = peak_from_here_mib();
    let (calls, last) = (std::sync::atomic::AtomicU64::new(0), std::sync::atomic::AtomicU64::new(0));
    let progress = |done: u64, all: u64| {
        assert_eq!(all, total);
        calls.fetch_add(1, std::sync::atomic::Ordering::Relaxed);
        last.store(done, std::sync::atomic::Ordering::Relaxed);
    };
    let bag = Endless { begin, part, position: 0, total };
    let options = ReadOptions { progress: &progress, ..options() };
    let records = ros::read_ros1(Path::new("endless.bag"), bag, total, &options).unwrap();
    assert_eq!(records.scans.len() as u64, scans);
    assert_eq!(last.into_inner(), total);
    match (before, peak_mib()) {
        // Other tests run at the same time; what they need is small.
        (Some(before), Some(after)) => {
            println!("{before} MiB before, at most {after} MiB");
            assert!(after - before < 64, "{before} MiB before, at most {after} MiB");
        }
        _ => println!("SKIPPED: the system does not tell the most memory"),
    }
}

/// A recorded bag, or `None`, said so.
fn public(name: &str) -> Option<PathBuf> {
    let beside = || Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared/data");
    let path = std::env::var_os("LINESLAM_DATA").map_or_else(beside, PathBuf::from).join(name);
    if path.exists() {
        return Some(path);
    }
    let _ = writeln!(std::io::stdout(), "\nSKIPPED bags: {} is not there", path.display());
    None
}

#[test]
fn bags_of_others_are_read_whole() {
    for (name, scans, odometry) in [("aces", 7374, 7375), ("fr079", 4934, 8951), ("mit-csail", 1988, 1988)] {
        let Some(path) = public(&format!("kuemmerle/{name}.bag")) else { continue };
        let records = ros::read(&path, Format::Ros1, &options()).unwrap();
        assert_eq!((records.scans.len(), records.odometry.len()), (scans, odometry), "{name}");
        assert_eq!(records.skipped.len(), 0, "{name}");
        let ahead = records.geometries[0].base_from_laser.unwrap();
        assert_eq!(ahead, [if name == "fr079" { 0.04 } else { 0.0 }, 0.0, 0.0], "{name}");
        let is_doubted = suspected(&records).contains(&"angle_increment");
        assert_eq!(is_doubted, name != "mit-csail", "{name}");
    }
}

#[test]
fn a_bag_with_a_damaged_index_gives_its_scans() {
    let Some(path) = public("public/ccny_demo.bag") else { return };
    let records = ros::read(&path, Format::Ros1, &options()).unwrap();
    println!("{} scans, {:?}, {:?}", records.scans.len(), records.skipped, records.warnings);
    assert!(records.scans.len() >= 278, "{}", records.scans.len());
    assert!(warning(&records, "damaged").contains("byte 798265"), "{:?}", records.warnings);
}
