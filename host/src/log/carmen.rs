//! CARMEN logs: a keyword and its words a line. Read are
//!
//! - `FLASER n r1 … rn x y θ odom_x odom_y odom_θ time host logger_time`, and `RLASER` likewise,
//! - `ROBOTLASER1 type start fov resolution max accuracy mode n r1 … rn m e1 … em lx ly lθ rx ry rθ tv rv forward
//!   side turn_axis time host logger_time`, whose beams and laser pose are taken from the record itself; `ROBOTLASER2` likewise,
//! - `RAWLASER1 type start fov resolution max accuracy mode n r1 … rn m e1 … em time host logger_time`, and 2 to 4 likewise,
//! - `ODOM x y θ tv rv acceleration time host logger_time`,
//! - `PARAM name value host time`: offset and greatest range of the front and the rear laser.
//!
//! Other keywords are other sensors; they are passed over. Where a log has several scanners, or one in several records, one is
//! read: the one asked for, or the first in the order of [`Scanner`] that there is.

use std::collections::BTreeMap;

use super::records::{Records, ScanRecord, Source};
use super::{Defect, Odometry, RangeUnit, ReadOptions, Scanner, StampUnit, Warning, integer, number};
use crate::robot::StatedGeometry;

/// Records of a scanner.
const SCANNERS: [(&str, Scanner); 8] = [
    ("ROBOTLASER1", Scanner::Robotlaser1),
    ("FLASER", Scanner::Flaser),
    ("RAWLASER1", Scanner::Rawlaser1),
    ("ROBOTLASER2", Scanner::Robotlaser2),
    ("RLASER", Scanner::Rlaser),
    ("RAWLASER2", Scanner::Rawlaser2),
    ("RAWLASER3", Scanner::Rawlaser3),
    ("RAWLASER4", Scanner::Rawlaser4),
];
/// Other keywords that a CARMEN log may begin with.
const KEYWORDS: [&str; 10] =
    ["ODOM", "PARAM", "SYNC", "TRUEPOS", "LLASER", "LASER3", "LASER4", "LASER5", "SONAR", "NMEAGGA"];

/// What is nearer is the robot itself, metres; the records do not state it.
const LEAST_RANGE_M: f32 = 0.1;
/// Field of view of the scanners whose records do not state it, the SICK LMS, degrees.
const OF_VIEW_DEG: f32 = 180.0;
/// Mountings that differ by less are the same, metres and radians: poses are written with six digits.
const SAME_MOUNTING: f32 = 0.005;
/// Seconds since 1970 reach this in the year 5138: beyond it stamps are milliseconds, …
const FIRST_MS: f64 = 1e11;
/// … microseconds, …
const FIRST_US: f64 = 1e14;
/// … or nanoseconds.
const FIRST_NS: f64 = 1e17;

/// Whether a line could be of this format.
pub fn looks_like(text: &str) -> bool {
    let first = text.split_whitespace().next().unwrap_or_default();
    scanner_of(first).is_some() || KEYWORDS.contains(&first)
}

fn scanner_of(keyword: &str) -> Option<Scanner> {
    SCANNERS.iter().find(|(name, _)| *name == keyword).map(|(_, scanner)| *scanner)
}

impl Scanner {
    fn keyword(self) -> &'static str {
        SCANNERS.iter().find(|(_, scanner)| *scanner == self).map_or("", |(keyword, _)| keyword)
    }

    fn is_rear(self) -> bool {
        matches!(self, Self::Robotlaser2 | Self::Rlaser | Self::Rawlaser2)
    }
}

/// What a scan's record said, its beams aside.
struct Seen {
    scan: ScanRecord,
    pose: Option<[f64; 3]>,
    beams: Option<StatedBeams>,
}

/// Beams, and the mounting where both poses are there.
#[derive(Clone, Copy)]
struct StatedBeams {
    first_bearing_rad: f32,
    step_rad: f32,
    most_m: f32,
    base_from_laser: Option<[f32; 3]>,
}

/// Offset ahead of the axle and greatest range of a laser, as PARAM records say.
#[derive(Clone, Copy, Default)]
struct Params {
    offset_m: Option<f32>,
    most_m: Option<f32>,
}

/// Reads line after line.
pub struct Parser {
    stamps: Option<StampUnit>,
    mm_per_unit: f64,
    wanted: Option<Scanner>,
    seen: BTreeMap<Scanner, Vec<Seen>>,
    /// Front and rear.
    params: [Params; 2],
    /// A stamp that was not in seconds, and its unit.
    odd_stamp: Option<(f64, &'static str)>,
}

impl Parser {
    /// As the options say.
    pub fn new(options: &ReadOptions<'_>) -> Self {
        Self {
            stamps: options.stamps,
            mm_per_unit: options.ranges.unwrap_or(RangeUnit::M).mm(),
            wanted: options.scanner,
            seen: BTreeMap::new(),
            params: [Params::default(); 2],
            odd_stamp: None,
        }
    }

    /// Reads a line.
    pub fn line(&mut self, line: usize, text: &str, records: &mut Records) -> Result<(), Defect> {
        let words: Vec<&str> = text.split_whitespace().collect();
        let Some(&keyword) = words.first() else { return Ok(()) };
        match scanner_of(keyword) {
            Some(scanner) if self.wanted.is_none_or(|wanted| wanted == scanner) => {
                let seen = match scanner {
                    Scanner::Flaser | Scanner::Rlaser => self.flaser(line, &words, records)?,
                    Scanner::Robotlaser1 | Scanner::Robotlaser2 => self.robot_laser(line, &words, records)?,
                    _ => self.raw_laser(line, &words, records)?,
                };
                self.seen.entry(scanner).or_default().push(seen);
            }
            None if keyword == "ODOM" => {
                expect(&words, 10)?;
                let stamp_us = self.stamp_us(words[7])?;
                records.odometry(line, stamp_us, Source::Own, Odometry::Pose(pose_at(&words, 1)?));
            }
            None if keyword == "PARAM" => self.param(&words),
            _ => {}
        }
        Ok(())
    }

    /// Chooses the scanner. Says what there is where the one asked for is not.
    pub fn finish(mut self, records: &mut Records) -> Result<(), String> {
        if let Some((stamp, unit)) = self.odd_stamp {
            let message = format!(
                "time stamps such as {stamp} can only be {unit} since 1970, not seconds: read as that; --stamps sets the unit"
            );
            records.warnings.push(Warning::new("stamps_not_in_seconds", message));
        }
        let counts: Vec<String> =
            self.seen.iter().map(|(scanner, seen)| format!("{} {}", seen.len(), scanner.keyword())).collect();
        let Some((scanner, seen)) = self.seen.pop_first() else {
            return match self.wanted {
                Some(wanted) => Err(format!("there are no {} records", wanted.keyword())),
                None => Ok(()),
            };
        };
        if !self.seen.is_empty() {
            let message = format!(
                "of {} records the {} ones were read; --scanner chooses",
                counts.join(", "),
                scanner.keyword()
            );
            records.warnings.push(Warning::new("several_scanners", message));
        }
        let params = self.params[usize::from(scanner.is_rear())];
        let beams_of = commonest(&seen);
        let mut mounting: Option<[f32; 3]> = None;
        for Seen { mut scan, pose, beams } in seen {
            // Laser poses are written with few digits: the mounting is that of the first until it really changes.
            let beams = beams.map(|stated| {
                let differs =
                    |a: [f32; 3], b: [f32; 3]| a.iter().zip(b).any(|(a, b)| (a - b).abs() > SAME_MOUNTING);
                if let Some(now) = stated.base_from_laser
                    && mounting.is_none_or(|before| differs(before, now))
                {
                    mounting = Some(now);
                }
                StatedBeams { base_from_laser: mounting, ..stated }
            });
            scan.geometry = geometry(scanner, beams, params, beams_of).map(|stated| records.geometry(stated));
            if let Some(pose) = pose {
                records.odometry(scan.place, scan.stamp_us, Source::Scan, Odometry::Pose(pose));
            }
            records.scans.push(scan);
        }
        // In the order of the file again.
        records.odometry.sort_by_key(|record| record.place);
        Ok(())
    }

    fn flaser(&mut self, line: usize, words: &[&str], records: &mut Records) -> Result<Seen, Defect> {
        let beams: usize = integer("number of ranges", word(words, 1, 2)?)?;
        expect(words, beams.saturating_add(11))?;
        let pose = Some(pose_at(words, beams + 5)?);
        let scan = self.scan(line, &words[2..beams + 2], words[beams + 8], records)?;
        Ok(Seen { scan, pose, beams: None })
    }

    fn robot_laser(&mut self, line: usize, words: &[&str], records: &mut Records) -> Result<Seen, Defect> {
        let (ranges, rest) = laser_ranges(words, 14)?;
        let (laser, robot) = (pose_at(words, rest)?, pose_at(words, rest + 3)?);
        let (s, c) = robot[2].sin_cos();
        let (dx, dy) = (laser[0] - robot[0], laser[1] - robot[1]);
        let yaw = (laser[2] - robot[2]).sin().atan2((laser[2] - robot[2]).cos());
        let base_from_laser = Some([(c * dx + s * dy) as f32, (c * dy - s * dx) as f32, yaw as f32]);
        let beams = Some(StatedBeams { base_from_laser, ..stated_beams(words, ranges.len())? });
        let scan = self.scan(line, ranges, words[rest + 11], records)?;
        Ok(Seen { scan, pose: Some(robot), beams })
    }

    fn raw_laser(&mut self, line: usize, words: &[&str], records: &mut Records) -> Result<Seen, Defect> {
        let (ranges, rest) = laser_ranges(words, 3)?;
        let beams = Some(stated_beams(words, ranges.len())?);
        let scan = self.scan(line, ranges, words[rest], records)?;
        Ok(Seen { scan, pose: None, beams })
    }

    fn scan(
        &mut self,
        place: usize,
        ranges: &[&str],
        stamp: &str,
        records: &mut Records,
    ) -> Result<ScanRecord, Defect> {
        let stamp_us = self.stamp_us(stamp)?;
        let mut values = Vec::with_capacity(ranges.len());
        for word in ranges {
            // Infinite and not a number are readings too.
            let value = word.parse::<f64>();
            values.push(value.map_err(|_| Defect::NotANumber { field: "range", word: short(word) })?);
        }
        let ranges_mm = values.into_iter().map(|v| records.range_mm(v, self.mm_per_unit)).collect();
        Ok(ScanRecord { place, stamp_us, ranges_mm, geometry: None })
    }

    fn param(&mut self, words: &[&str]) {
        let [_, name, value, ..] = words else { return };
        let Some(value) = value.parse::<f32>().ok().filter(|v| v.is_finite()) else { return };
        for (side, params) in ["front", "rear"].iter().zip(&mut self.params) {
            if !name.contains(side) || !name.contains("laser") {
                continue;
            }
            if name.ends_with("_offset") {
                params.offset_m = Some(value);
            } else if (name.ends_with("_max") || name.ends_with("_max_range")) && value > LEAST_RANGE_M {
                params.most_m = Some(value);
            }
        }
    }

    /// Seconds to microseconds; where a stamp cannot be seconds, what it must be instead.
    fn stamp_us(&mut self, word: &str) -> Result<i64, Defect> {
        let stamp = number("time stamp", word)?;
        let unit = self.stamps.unwrap_or_else(|| {
            let (unit, name) = match stamp.abs() {
                s if s < FIRST_MS => return StampUnit::S,
                s if s < FIRST_US => (StampUnit::Ms, "milliseconds"),
                s if s < FIRST_NS => (StampUnit::Us, "microseconds"),
                _ => (StampUnit::Ns, "nanoseconds"),
            };
            self.odd_stamp.get_or_insert((stamp, name));
            unit
        });
        let us = (stamp * unit.us()).round();
        // Until the year 33658.
        if us.abs() < 1e18 {
            Ok(us as i64)
        } else {
            Err(Defect::NotANumber { field: "time stamp", word: short(word) })
        }
    }
}

/// How the beams of a scan lie, where record or parameters say anything of it.
fn geometry(
    scanner: Scanner,
    beams: Option<StatedBeams>,
    params: Params,
    commonest: usize,
) -> Option<StatedGeometry> {
    let mounted = |offset_m: f32| [offset_m, 0.0, if scanner.is_rear() { std::f32::consts::PI } else { 0.0 }];
    let offset = params.offset_m.map(mounted).or(scanner.is_rear().then(|| mounted(0.0)));
    if beams.is_none() && offset.is_none() && params.most_m.is_none() {
        return None;
    }
    let of_view_rad = OF_VIEW_DEG.to_radians();
    let stated = beams.unwrap_or(StatedBeams {
        first_bearing_rad: -0.5 * of_view_rad,
        // 180 and 360 beams leave out the last edge, 181 and 361 have it.
        step_rad: of_view_rad / (commonest - commonest % 2).max(1) as f32,
        most_m: f32::INFINITY,
        base_from_laser: None,
    });
    let most_m = params.most_m.unwrap_or(f32::INFINITY).min(stated.most_m);
    Some(StatedGeometry {
        first_bearing_rad: stated.first_bearing_rad,
        step_rad: stated.step_rad,
        revolution_s: 0.0,
        limits_m: most_m.is_finite().then_some([LEAST_RANGE_M, most_m]),
        base_from_laser: stated.base_from_laser.or(offset),
        upside_down: false,
    })
}

/// The number of ranges that most scans have.
fn commonest(seen: &[Seen]) -> usize {
    super::assemble::commonest(seen.iter().map(|s| s.scan.ranges_mm.len()))
}

/// The ranges of a ROBOTLASER or RAWLASER record, and where what follows the remissions begins: `tail` words must be there.
fn laser_ranges<'a, 'b>(words: &'b [&'a str], tail: usize) -> Result<(&'b [&'a str], usize), Defect> {
    let beams: usize = integer("number of ranges", word(words, 8, 9)?)?;
    let remissions_at = beams.saturating_add(9);
    let remissions: usize =
        integer("number of remissions", word(words, remissions_at, remissions_at.saturating_add(1))?)?;
    let rest = remissions_at.saturating_add(1).saturating_add(remissions);
    expect(words, rest.saturating_add(tail))?;
    Ok((&words[9..remissions_at], rest))
}

fn stated_beams(words: &[&str], beams: usize) -> Result<StatedBeams, Defect> {
    let step = number("angular resolution", words[4])?;
    if step <= 0.0 || step * beams as f64 > 7.0 {
        return Err(Defect::NotANumber { field: "angular resolution", word: short(words[4]) });
    }
    let most_m = number("greatest range", words[5])? as f32;
    Ok(StatedBeams {
        first_bearing_rad: number("start angle", words[2])? as f32,
        step_rad: step as f32,
        most_m: if most_m > LEAST_RANGE_M { most_m } else { f32::INFINITY },
        base_from_laser: None,
    })
}

/// Checks the number of words of a record whose length is known.
fn expect(words: &[&str], expected: usize) -> Result<(), Defect> {
    match words.len() {
        actual if actual < expected => Err(Defect::Truncated { expected, actual }),
        actual if actual > expected => Err(Defect::TooLong { expected, actual }),
        _ => Ok(()),
    }
}

/// The word at `index`; the record must have `expected` of them.
fn word<'a>(words: &[&'a str], index: usize, expected: usize) -> Result<&'a str, Defect> {
    words.get(index).copied().ok_or(Defect::Truncated { expected, actual: words.len() })
}

fn pose_at(words: &[&str], index: usize) -> Result<[f64; 3], Defect> {
    Ok([number("x", words[index])?, number("y", words[index + 1])?, number("θ", words[index + 2])?])
}

fn short(word: &str) -> String {
    word.chars().take(20).collect()
}
