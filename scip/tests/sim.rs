//! The simulated sensor: every command with every status it has, and the timing of its scans.

use scip::sim::{BEAMS, Mode, SimulatedUrg};
use scip::{Decoder, Event};

struct Bench {
    urg: SimulatedUrg,
    now_us: u64,
}

impl Bench {
    fn new(mode: Mode) -> Self {
        Self { urg: SimulatedUrg::found(0, 1, 500_000, mode), now_us: 0 }
    }

    /// Sends a line at the sensor's bit rate.
    fn send(&mut self, line: &str) {
        let rate = self.urg.baud_rate();
        for byte in line.bytes() {
            self.urg.receive(byte, rate, self.now_us);
        }
    }

    /// All that comes for a while.
    fn hear(&mut self, for_us: u64) -> String {
        let until_us = self.now_us + for_us;
        let mut bytes = Vec::new();
        while self.now_us < until_us {
            self.now_us = self.urg.next_us().clamp(self.now_us + 1, until_us);
            self.urg.advance(self.now_us, &mut |_, ranges| ranges.fill(1000));
            bytes.extend(std::iter::from_fn(|| self.urg.transmit(self.now_us)).map(|s| s.byte));
        }
        String::from_utf8_lossy(&bytes).into_owned()
    }

    fn ask(&mut self, command: &str) -> String {
        self.send(command);
        self.send("\n");
        self.hear(20_000)
    }
}

#[test]
fn power_up_is_scip_1_1_at_19200() {
    let mut bench = Bench { urg: SimulatedUrg::new(0, 1), now_us: 1_000_000 };
    assert_eq!(bench.urg.baud_rate(), 19_200);
    assert_eq!(bench.ask("QT"), "QT\nE\n\n");
    assert_eq!(bench.ask("XY"), "XY\nE\n\n");
    assert_eq!(bench.ask("SCIP2.0"), "SCIP2.0\n0\n\n");
    assert_eq!(bench.ask("SCIP2.0"), "SCIP2.0\n0\n\n");
    assert_eq!(bench.ask("QT"), "QT\n00P\n\n");
}

#[test]
fn every_command_has_its_statuses() {
    let mut bench = Bench::new(Mode::LaserOff);
    for (line, reply) in [
        ("BM", "BM\n00P\n\n"),
        ("BM;again", "BM;again\n02R\n\n"),
        ("QT", "QT\n00P\n\n"),
        ("GD0044072501", "GD0044072501\n10Q\n\n"),
        ("CR00", "CR00\n03S\n\n"),
        ("CR05", "CR05\n00P\n\n"),
        ("CR05", "CR05\n03S\n\n"),
        ("CR11", "CR11\n02R\n\n"),
        ("CR0x", "CR0x\n01Q\n\n"),
        ("CR99", "CR99\n00P\n\n"),
        ("HS1", "HS1\n00P\n\n"),
        ("HS1", "HS1\n02R\n\n"),
        ("HS0", "HS0\n00P\n\n"),
        ("HS2", "HS2\n01Q\n\n"),
        ("SS500000", "SS500000\n03S\n\n"),
        ("SS038400", "SS038400\n04T\n\n"),
        ("SS123456", "SS123456\n02R\n\n"),
        ("SS50000x", "SS50000x\n01Q\n\n"),
        ("SS5000", "SS5000\n0Cc\n\n"),
        ("TM1", "TM1\n04T\n\n"),
        ("TM2", "TM2\n03S\n\n"),
        ("TM3", "TM3\n01Q\n\n"),
        ("MDx044072501000", "MDx044072501000\n01Q\n\n"),
        ("MD0044x72501000", "MD0044x72501000\n02R\n\n"),
        ("MD00440725x1000", "MD00440725x1000\n03S\n\n"),
        ("MD0044072601000", "MD0044072601000\n04T\n\n"),
        ("MD0045004401000", "MD0045004401000\n05U\n\n"),
        ("MD0044072501x00", "MD0044072501x00\n06V\n\n"),
        ("MD00440725010x0", "MD00440725010x0\n07W\n\n"),
        ("MD0044", "MD0044\n0Cc\n\n"),
        ("XY", "XY\n0Ee\n\n"),
        ("BM;0123456789abcdefg", "BM;0123456789abcdefg\n0Gg\n\n"),
        ("BM;a-b", "BM;a-b\n0Hh\n\n"),
    ] {
        assert_eq!(bench.ask(line), reply, "{line}");
    }
    bench.urg.faults.laser_fault = true;
    assert_eq!(bench.ask("BM"), "BM\n01Q\n\n");
    assert_eq!(bench.ask("MD0044072501000"), "MD0044072501000\n50U\n\n");
}

#[test]
fn clock_adjustment_knows_only_its_own_commands() {
    let mut bench = Bench::new(Mode::Streaming);
    bench.urg.set_timer_ms(0, 6_968_830);
    assert!(bench.ask("TM0").ends_with("TM0\n00P\n\n"));
    assert!(!bench.urg.is_streaming() && !bench.urg.laser_is_on());
    assert_eq!(bench.ask("TM0"), "TM0\n02R\n\n");
    assert_eq!(bench.ask("QT"), "QT\n0Ee\n\n");
    // 60 ms after it was set.
    assert_eq!(bench.ask("TM1"), "TM1\n00P\nJUHjA\n\n");
    assert_eq!(bench.ask("TM2"), "TM2\n00P\n\n");
    assert_eq!(bench.ask("QT"), "QT\n00P\n\n");
}

#[test]
fn the_bit_rate_changes_after_the_reply_and_rs_takes_all_back() {
    let mut bench = Bench::new(Mode::Idle);
    assert_eq!(bench.ask("SS115200"), "SS115200\n00P\n\n");
    assert_eq!(bench.urg.baud_rate(), 115_200);
    // What is said at another rate is not understood.
    for byte in *b"QT\n" {
        bench.urg.receive(byte, 500_000, bench.now_us);
    }
    assert!(!bench.hear(20_000).contains("QT\n00P"));
    bench.send("\n");
    bench.hear(20_000);
    assert_eq!(bench.ask("RS"), "RS\n00P\n\n");
    assert_eq!(bench.urg.baud_rate(), 19_200);
    assert!(!bench.urg.laser_is_on());
    let info = {
        bench.send("II\n");
        bench.hear(200_000)
    };
    assert!(info.contains("LASR:OFF;7\n") && info.contains("SBPS:19200[bps]"), "{info}");
    assert!(info.contains("TIME:0000"), "{info}");
}

#[test]
fn a_stream_counts_down_and_ends_and_leaves_scans_out() {
    let mut bench = Bench::new(Mode::LaserOff);
    bench.send("MS0044072501103\n");
    let text = bench.hear(900_000);
    let heads: Vec<_> = text.lines().filter(|l| l.starts_with("MS")).collect();
    assert_eq!(heads, ["MS0044072501103", "MS0044072501102", "MS0044072501101", "MS0044072501100"]);
    assert!(!bench.urg.is_streaming());
    // One left out between two: 200 ms from stamp to stamp.
    let mut decoder = Decoder::new();
    let mut ranges = [0; BEAMS];
    let (mut rest, mut stamps) = (text.as_bytes(), Vec::new());
    while !rest.is_empty() {
        let (used, event) = decoder.feed(rest, &mut ranges);
        if let Some(Event::Scan(head)) = event {
            stamps.push(head.stamp_ms);
            assert!(ranges.iter().all(|r| *r == 1000));
        }
        rest = &rest[used..];
    }
    assert_eq!(stamps.windows(2).map(|p| p[1] - p[0]).collect::<Vec<_>>(), [200, 200]);
}

#[test]
fn gd_gives_one_scan_and_vv_ends_a_stream() {
    let mut bench = Bench::new(Mode::Idle);
    bench.send("GD0100019910;once\n");
    let text = bench.hear(200_000);
    assert!(text.starts_with("GD0100019910;once\n00P\n"), "{text}");
    // 1000 is 0?X, ten times, and the sum.
    assert!(text.contains(&"0?X".repeat(10)), "{text}");
    assert_eq!(text.matches("GD").count(), 1);
    let mut bench = Bench::new(Mode::Streaming);
    bench.hear(150_000);
    bench.send("VV\n");
    bench.hear(200_000);
    assert!(!bench.urg.is_streaming());
}

#[test]
fn a_slow_line_leaves_scans_out_instead_of_falling_behind() {
    let mut bench = Bench { urg: SimulatedUrg::found(0, 1, 115_200, Mode::Streaming), now_us: 0 };
    let text = bench.hear(10_000_000);
    // 185.5 ms each on the line, ready every 100 ms.
    let scans = text.matches("MD").count();
    assert!((48..=51).contains(&scans), "{scans}");
}
