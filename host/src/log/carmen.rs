//! CARMEN logs: a keyword and its words a line. Read are
//!
//! - `FLASER n r1 … rn x y θ odom_x odom_y odom_θ time host logger_time`,
//! - `ROBOTLASER1 type start fov resolution max accuracy remission n r1 … rn m e1 … em lx ly lθ rx ry rθ tv rv forward
//!   side turn_axis time host logger_time`, whose beams and laser pose are taken from the record itself,
//! - `ODOM x y θ tv rv acceleration time host logger_time`.
//!
//! Other keywords are other sensors and parameters; they are passed over.

use super::{Defect, Odometry, Record, integer, number};
use crate::robot::StatedGeometry;

/// Keywords that a CARMEN log may begin with.
const KEYWORDS: [&str; 18] = [
    "FLASER",
    "RLASER",
    "LLASER",
    "LASER3",
    "LASER4",
    "LASER5",
    "ROBOTLASER1",
    "ROBOTLASER2",
    "RAWLASER1",
    "RAWLASER2",
    "ODOM",
    "PARAM",
    "SYNC",
    "TRUEPOS",
    "MARKER",
    "NMEAGGA",
    "POSITION",
    "SONAR",
];

/// Whether a line could be of this format.
pub fn looks_like(text: &str) -> bool {
    text.split_whitespace().next().is_some_and(|word| KEYWORDS.contains(&word))
}

pub fn record(text: &str) -> Result<Option<Record>, Defect> {
    let words: Vec<&str> = text.split_whitespace().collect();
    match words.first().copied() {
        Some("FLASER") => flaser(&words).map(Some),
        Some("ROBOTLASER1") => robot_laser(&words).map(Some),
        Some("ODOM") => odom(&words).map(Some),
        _ => Ok(None),
    }
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

fn flaser(words: &[&str]) -> Result<Record, Defect> {
    let beams: usize = integer("number of ranges", word(words, 1, 2)?)?;
    expect(words, beams.saturating_add(11))?;
    Ok(Record {
        stamp_us: stamp_us(words[beams + 8])?,
        odometry: Some(Odometry::Pose(pose_at(words, beams + 5)?)),
        ranges_mm: Some(ranges_mm(&words[2..beams + 2])?),
        stated: None,
    })
}

fn robot_laser(words: &[&str]) -> Result<Record, Defect> {
    let beams: usize = integer("number of ranges", word(words, 8, 9)?)?;
    let remissions_at = beams.saturating_add(9);
    let remissions: usize =
        integer("number of remissions", word(words, remissions_at, remissions_at.saturating_add(1))?)?;
    let rest = remissions_at.saturating_add(1).saturating_add(remissions);
    expect(words, rest.saturating_add(14))?;
    let step = number("angular resolution", words[4])?;
    if step <= 0.0 || step * beams as f64 > 7.0 {
        return Err(Defect::NotANumber { field: "angular resolution", word: words[4].into() });
    }
    let (laser, robot) = (pose_at(words, rest)?, pose_at(words, rest + 3)?);
    let (s, c) = robot[2].sin_cos();
    let (dx, dy) = (laser[0] - robot[0], laser[1] - robot[1]);
    let yaw = (laser[2] - robot[2]).sin().atan2((laser[2] - robot[2]).cos());
    Ok(Record {
        stamp_us: stamp_us(words[rest + 11])?,
        odometry: Some(Odometry::Pose(robot)),
        ranges_mm: Some(ranges_mm(&words[9..remissions_at])?),
        stated: Some(StatedGeometry {
            first_bearing_rad: number("start angle", words[2])? as f32,
            step_rad: step as f32,
            base_from_laser: [(c * dx + s * dy) as f32, (c * dy - s * dx) as f32, yaw as f32],
        }),
    })
}

fn odom(words: &[&str]) -> Result<Record, Defect> {
    expect(words, 10)?;
    Ok(Record {
        stamp_us: stamp_us(words[7])?,
        odometry: Some(Odometry::Pose(pose_at(words, 1)?)),
        ..Record::default()
    })
}

fn pose_at(words: &[&str], index: usize) -> Result<[f64; 3], Defect> {
    Ok([number("x", words[index])?, number("y", words[index + 1])?, number("θ", words[index + 2])?])
}

fn stamp_us(word: &str) -> Result<u64, Defect> {
    let seconds = number("time stamp", word)?;
    if (0.0..1e12).contains(&seconds) {
        Ok((seconds * 1e6).round() as u64)
    } else {
        Err(Defect::NotANumber { field: "time stamp", word: word.into() })
    }
}

/// Metres to millimetres; what a `u16` cannot hold saturates.
fn ranges_mm(words: &[&str]) -> Result<Vec<u16>, Defect> {
    words.iter().map(|word| number("range", word).map(|m| (m * 1000.0).round() as u16)).collect()
}
