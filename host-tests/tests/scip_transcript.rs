//! A real session with a URG-04LX: decoded, with all sums right, and written again to the same bytes.
//!
//! The recording belongs to others and is not part of this project; see `recorded_logs.rs`.

use std::path::Path;

use host_tests::recorded;
use scip::{Command, Counters, Decoder, Event, Request, Status, Width, Writer};

/// Records of `u32 seconds, u32 microseconds, u32 length`, big-endian, and so many bytes.
fn payload(path: &Path) -> Vec<u8> {
    let recording = std::fs::read(path).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
    let mut rest = &recording[..];
    let mut bytes = Vec::new();
    while let Some((head, tail)) = rest.split_first_chunk::<12>() {
        let length = u32::from_be_bytes([head[8], head[9], head[10], head[11]]) as usize;
        bytes.extend_from_slice(&tail[..length]);
        rest = &tail[length..];
    }
    assert!(rest.is_empty(), "{}: cut record", path.display());
    bytes
}

#[test]
fn what_the_sensor_said_is_decoded_and_written_again() {
    let Some(folder) = recorded("scip", "what_the_sensor_said_is_decoded_and_written_again") else { return };
    let heard = payload(&folder.join("urg_04lx.logr"));
    let mut decoder = Decoder::new();
    let mut ranges_mm = [0; 682];
    let mut written = Vec::new();
    let mut open: Option<Request> = None;
    let (mut scans, mut statuses) = (0, Vec::new());
    let mut rest = &heard[..];
    while !rest.is_empty() {
        let (used, event) = decoder.feed(rest, &mut ranges_mm);
        rest = &rest[used..];
        let mut writer = Writer::new(|b| written.push(b));
        match event {
            None => {}
            Some(Event::Field { request, field }) => {
                if open.replace(request) != Some(request) {
                    writer.head(&request, Status::OK);
                }
                writer.field(field.key, field.value);
            }
            Some(Event::Reply { request, status }) => {
                if open.take().is_none() {
                    writer.head(&request, status);
                }
                writer.end();
                statuses.push((request.command, status.as_str().to_owned()));
            }
            Some(Event::Scan(head)) => {
                scans += 1;
                assert_eq!((head.values, head.stamp_ms), (682, 6_968_830));
                let values = ranges_mm.iter().map(|&r| r.into());
                writer.head(&head.request, Status::OK).stamp(head.stamp_ms).data(values, Width::Three).end();
                assert!(ranges_mm.iter().all(|r| *r < 5600));
                assert!(ranges_mm.iter().filter(|r| **r >= 20).count() > 500);
            }
            Some(other) => panic!("{other:?}"),
        }
    }
    assert_eq!(written, heard);
    assert_eq!(scans, 1);
    let of = |command, status: &str| (command, status.to_owned());
    let info = [of(Command::Vv, "00"), of(Command::Pp, "00"), of(Command::Ii, "00")];
    assert_eq!(statuses[..1], info[..1]);
    assert_eq!(statuses[1..4], info);
    assert_eq!(statuses[4..6], [of(Command::Bm, "02"), of(Command::Cr(0), "03")]);
    assert_eq!(statuses[6..], info);
    assert_eq!(*decoder.counters(), Counters { scans: 1, replies: 9, ..Counters::default() });
}

#[test]
fn what_the_host_said_is_parsed_and_written_again() {
    let Some(folder) = recorded("scip", "what_the_host_said_is_parsed_and_written_again") else { return };
    let said = payload(&folder.join("urg_04lx.logw"));
    let mut written = Vec::new();
    for line in said.split_inclusive(|&b| b == b'\n') {
        let request = Request::parse(&line[..line.len() - 1]).unwrap_or_else(|e| panic!("{line:?}: {e:?}"));
        written.extend_from_slice(&request.line());
    }
    assert_eq!(written, said);
}
