//! The mines format: one scan a line, 707 numbers. Column 0 is the time in µs, 2 and 3 the wheel ticks, 24 to 705 the
//! ranges in millimetres. The last column is padding that some files leave out.

use super::{Defect, Odometry, Record, integer};

const FIRST_RANGE: usize = 24;
const RANGES: usize = 682;
const WORDS: usize = FIRST_RANGE + RANGES;

/// Whether a line could be of this format: it begins with a whole number.
pub fn looks_like(text: &str) -> bool {
    text.split_whitespace().next().is_some_and(|word| word.parse::<i64>().is_ok())
}

pub fn record(text: &str) -> Result<Option<Record>, Defect> {
    let words: Vec<&str> = text.split_whitespace().collect();
    if words.len() < WORDS {
        return Err(Defect::Truncated { expected: WORDS + 1, actual: words.len() });
    }
    if words.len() > WORDS + 1 {
        return Err(Defect::TooLong { expected: WORDS + 1, actual: words.len() });
    }
    let mut ranges_mm = Vec::with_capacity(RANGES);
    for word in &words[FIRST_RANGE..WORDS] {
        ranges_mm.push(integer::<u32>("range in mm", word)?.min(u32::from(u16::MAX)) as u16);
    }
    let ticks = [integer("left wheel ticks", words[2])?, integer("right wheel ticks", words[3])?];
    Ok(Some(Record {
        stamp_us: integer("time in µs", words[0])?,
        odometry: Some(Odometry::Ticks(ticks)),
        ranges_mm: Some(ranges_mm),
        stated: None,
    }))
}
