//! Logs that are text, a record a line: plain or gzipped, with any line ends, with or without a byte order mark. Bytes that are
//! not UTF-8 are let pass where they do not matter, as in comments.

use std::fs::File;
use std::io::{BufRead, BufReader, Read};
use std::path::Path;
use std::sync::atomic::{AtomicU64, Ordering};

use super::{Defect, Format, LogError, Place, ReadOptions, Records, Warning, carmen, mines, plain};

/// Lines of unknown records that may stand before the first known one.
const MOST_UNKNOWN: usize = 200;
/// What can be read, for messages.
const EXPECTED: &str = "expected a ROS bag (.bag, .mcap, .db3), a CARMEN log (FLASER, ROBOTLASER1, RAWLASER1 …), a mines record \
                        (707 numbers a line) or JSON lines (docs/logs.md)";

/// Reads a log line by line, of a format that is known or found out.
pub fn read(path: &Path, format: Format, options: &ReadOptions<'_>) -> Result<(Format, Records), LogError> {
    let file = File::open(path).map_err(LogError::open(path))?;
    let size = file.metadata().map_err(LogError::open(path))?.len();
    let read = AtomicU64::new(0);
    let mut file = BufReader::new(Counted { file, read: &read });
    let head = file.fill_buf().map_err(LogError::open(path))?;
    let gzip = head.starts_with(&[0x1f, 0x8b]);
    if let Some(what) = no_text(head).filter(|_| !gzip) {
        return Err(LogError::NotALog { path: path.to_owned(), what: format!("{what}; {EXPECTED}") });
    }
    let named_gzip = path.extension().is_some_and(|e| e.eq_ignore_ascii_case("gz"));
    if named_gzip && !gzip && !head.is_empty() {
        let what = "the name ends in .gz, but this is not gzip data".into();
        return Err(LogError::NotALog { path: path.to_owned(), what });
    }
    let mut input: Box<dyn BufRead> = if gzip {
        Box::new(BufReader::new(flate2::bufread::MultiGzDecoder::new(file)))
    } else {
        Box::new(file)
    };
    let mut reader = LineReader { path, options, format, parser: None, records: Records::default(), line: 0 };
    reader.run(&mut *input, || (options.progress)(read.load(Ordering::Relaxed), size))?;
    reader.finish()
}

/// Counts what is read of a file.
struct Counted<'a> {
    file: File,
    read: &'a AtomicU64,
}

impl Read for Counted<'_> {
    fn read(&mut self, buffer: &mut [u8]) -> std::io::Result<usize> {
        let n = self.file.read(buffer)?;
        self.read.fetch_add(n as u64, Ordering::Relaxed);
        Ok(n)
    }
}

/// What a file is that is no text, by how it begins.
fn no_text(head: &[u8]) -> Option<&'static str> {
    const KINDS: [(&[u8], &str); 6] = [
        (b"\xff\xfe", "this is UTF-16 text: save it as UTF-8"),
        (b"\xfe\xff", "this is UTF-16 text: save it as UTF-8"),
        (b"\x28\xb5\x2f\xfd", "this is compressed by zstd: unpack it with 'zstd -d' first"),
        (b"BZh", "this is compressed by bzip2: unpack it with 'bunzip2' first"),
        (b"\xfd7zXZ", "this is compressed by xz: unpack it with 'unxz' first"),
        (b"PK\x03\x04", "this is a ZIP archive: unpack it first"),
    ];
    let known = KINDS.iter().find(|(magic, _)| head.starts_with(magic)).map(|(_, what)| *what);
    known.or_else(|| head.iter().take(1024).any(|b| *b == 0).then_some("this is binary, not text"))
}

/// The readers of the formats.
enum Parser {
    Mines(mines::Parser),
    Carmen(Box<carmen::Parser>),
    Plain(plain::Parser),
}

impl Parser {
    fn new(format: Format, options: &ReadOptions<'_>) -> Self {
        match format {
            Format::Mines => Self::Mines(mines::Parser::new(options)),
            Format::Plain => Self::Plain(plain::Parser::new(options)),
            _ => Self::Carmen(Box::new(carmen::Parser::new(options))),
        }
    }

    fn format(&self) -> Format {
        match self {
            Self::Mines(_) => Format::Mines,
            Self::Carmen(_) => Format::Carmen,
            Self::Plain(_) => Format::Plain,
        }
    }

    fn line(&mut self, line: usize, text: &str, records: &mut Records) -> Result<(), Defect> {
        match self {
            Self::Mines(parser) => parser.line(line, text, records),
            Self::Carmen(parser) => parser.line(line, text, records),
            Self::Plain(parser) => parser.line(line, text, records),
        }
    }
}

struct LineReader<'a> {
    path: &'a Path,
    options: &'a ReadOptions<'a>,
    format: Format,
    parser: Option<Parser>,
    records: Records,
    line: usize,
}

impl LineReader<'_> {
    fn run(&mut self, input: &mut dyn BufRead, progress: impl Fn()) -> Result<(), LogError> {
        let mut bytes = Vec::new();
        let mut unknown: Option<(usize, String)> = None;
        loop {
            bytes.clear();
            self.line += 1;
            if self.line.is_multiple_of(64) {
                progress();
            }
            match input.read_until(b'\n', &mut bytes) {
                Ok(0) => break,
                Ok(_) => {}
                // Compressed data that was cut off, as when the robot lost power, is good up to there.
                Err(_) if self.options.lenient && self.parser.is_some() => {
                    self.cut_off("the compressed data ends early");
                    break;
                }
                Err(source) => {
                    let place = Place::Line(self.line);
                    return Err(LogError::Read { path: self.path.to_owned(), place, source });
                }
            }
            let text = String::from_utf8_lossy(&bytes);
            let text = text.trim_start_matches('\u{feff}').trim();
            if text.is_empty() || text.starts_with('#') {
                continue;
            }
            let parser = match &mut self.parser {
                Some(parser) => parser,
                None => match detect(self.format, text) {
                    Some(format) => self.parser.insert(Parser::new(format, self.options)),
                    None => {
                        // Some program's own records may stand first.
                        let (line, first) = unknown.get_or_insert_with(|| (self.line, text.to_owned()));
                        if !is_keyword(text) || self.line - *line >= MOST_UNKNOWN {
                            let what = unlike(*line, first);
                            return Err(LogError::NotALog { path: self.path.to_owned(), what });
                        }
                        continue;
                    }
                },
            };
            if let Err(defect) = parser.line(self.line, text, &mut self.records) {
                // The last line of a recorder that was stopped hard.
                if !bytes.ends_with(b"\n") {
                    self.cut_off(&defect.to_string());
                } else {
                    self.refuse(defect)?;
                }
            }
        }
        match unknown.filter(|_| self.parser.is_none()) {
            Some((line, first)) => {
                Err(LogError::NotALog { path: self.path.to_owned(), what: unlike(line, &first) })
            }
            None => Ok(()),
        }
    }

    fn finish(self) -> Result<(Format, Records), LogError> {
        let Self { path, parser, mut records, line, .. } = self;
        let format = parser.as_ref().map_or(Format::Carmen, Parser::format);
        if let Some(Parser::Carmen(parser)) = parser {
            parser.finish(&mut records).map_err(|what| LogError::NotALog { path: path.to_owned(), what })?;
        }
        if records.scans.is_empty() && records.skipped.is_empty() {
            let read = format!("line {}", line.saturating_sub(1));
            return Err(LogError::NoScan { path: path.to_owned(), read });
        }
        Ok((format, records))
    }

    fn cut_off(&mut self, why: &str) {
        self.records.skip("cut_off");
        let message =
            format!("the log was cut off in line {}: {why}. What stands before it was used", self.line);
        self.records.warnings.push(Warning::new("cut_off", message));
    }

    fn refuse(&mut self, defect: Defect) -> Result<(), LogError> {
        if !self.options.lenient {
            let place = Place::Line(self.line);
            return Err(LogError::Record { path: self.path.to_owned(), place, defect });
        }
        self.records.skip(defect.reason());
        Ok(())
    }
}

/// The format whose record a line is, among those that it may be.
fn detect(wanted: Format, text: &str) -> Option<Format> {
    let fits = |format| wanted == Format::Auto || wanted == format;
    match () {
        () if fits(Format::Plain) && plain::looks_like(text) => Some(Format::Plain),
        () if fits(Format::Mines) && mines::looks_like(text, wanted == Format::Mines) => Some(Format::Mines),
        () if fits(Format::Carmen) && carmen::looks_like(text) => Some(Format::Carmen),
        () => None,
    }
}

/// Whether a line begins like a record of CARMEN's kind.
fn is_keyword(text: &str) -> bool {
    let word = text.split_whitespace().next().unwrap_or_default();
    word.starts_with(|c: char| c.is_ascii_uppercase())
        && word.chars().all(|c| c.is_ascii_uppercase() || c.is_ascii_digit() || c == '_')
}

/// That a line is of no format that can be read, and what it looks like.
fn unlike(line: usize, text: &str) -> String {
    let words: Vec<&str> = mines::words(text).collect();
    let start: String = text.chars().take(40).collect();
    let looks = if words.iter().all(|w| w.parse::<f64>().is_ok()) {
        format!("a line of {} numbers, as another program writes them", words.len())
    } else {
        format!("a line of {} words", words.len())
    };
    format!("line {line}: neither format that can be read begins with '{start}' ({looks}); {EXPECTED}")
}
