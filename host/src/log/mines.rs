//! The mines format: one scan a line, 707 numbers. Column 0 is the time in µs, 2 and 3 the wheel ticks, 24 to 705 the
//! ranges in millimetres. The last column is padding that some files leave out. Words lie between blanks, tabs, commas or
//! semicolons.

use super::records::{Records, ScanRecord, Source};
use super::{Defect, Odometry, RangeUnit, ReadOptions, StampUnit, number, whole};

const FIRST_RANGE: usize = 24;
const RANGES: usize = 682;
const WORDS: usize = FIRST_RANGE + RANGES;

/// The words of a line.
pub fn words(text: &str) -> impl Iterator<Item = &str> {
    text.split(|c: char| c.is_whitespace() || matches!(c, ',' | ';')).filter(|word| !word.is_empty())
}

/// Whether a line could be of this format: it begins with a number and has as many words as it must; where the format
/// is asked for, the number is enough, so that what is wrong can be said.
pub fn looks_like(text: &str, asked_for: bool) -> bool {
    let begins = words(text).next().is_some_and(|word| word.parse::<f64>().is_ok());
    begins && (asked_for || (WORDS..=WORDS + 1).contains(&words(text).count()))
}

/// Reads line after line.
pub struct Parser {
    us_per_unit: f64,
    mm_per_unit: f64,
}

impl Parser {
    /// As the options say.
    pub fn new(options: &ReadOptions<'_>) -> Self {
        Self {
            us_per_unit: options.stamps.unwrap_or(StampUnit::Us).us(),
            mm_per_unit: options.ranges.unwrap_or(RangeUnit::Mm).mm(),
        }
    }

    /// Reads a line.
    pub fn line(&mut self, line: usize, text: &str, records: &mut Records) -> Result<(), Defect> {
        let words: Vec<&str> = words(text).collect();
        if words.len() < WORDS {
            return Err(Defect::Truncated { expected: WORDS + 1, actual: words.len() });
        }
        if words.len() > WORDS + 1 {
            return Err(Defect::TooLong { expected: WORDS + 1, actual: words.len() });
        }
        let mut ranges = [0i64; RANGES];
        for (range, word) in ranges.iter_mut().zip(&words[FIRST_RANGE..WORDS]) {
            *range = whole("range in mm", word)?;
        }
        let ticks = [whole("left wheel ticks", words[2])?, whole("right wheel ticks", words[3])?];
        let stamp_us = (number("time in µs", words[0])? * self.us_per_unit).round() as i64;
        let ranges_mm = ranges.map(|range| records.range_mm(range as f64, self.mm_per_unit)).to_vec();
        records.odometry(line, stamp_us, Source::Scan, Odometry::Ticks(ticks));
        records.scans.push(ScanRecord { place: line, stamp_us, ranges_mm, geometry: None });
        Ok(())
    }
}
