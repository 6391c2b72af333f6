//! ROS 2 bags in SQLite: tables `topics` and `messages`; of a folder, the files that its `metadata.yaml` lists.
//!
//! Only rows of wanted topics are looked at, in the order of their times. Their numbers are sorted first and each is fetched
//! by its number, so that a file without an index on time is read in little memory too.
//!
//! SQLite follows pages to pages as the file says. Of a file whose pages are each other's children it would do so for ever, so
//! both its steps and what it gives are bounded by the file's size.

use std::path::{Path, PathBuf};

use rusqlite::{Connection, OpenFlags, Row};

use super::collect::{Collector, TopicId};
use super::messages::Encoding;
use crate::log::{LogError, Place, ReadOptions, Records};

/// Rows between two reports of progress.
const REPORT_EVERY: usize = 256;
/// Steps of SQLite that a sound file needs at most, in all and per byte. A row takes some tens of steps, and of bytes more.
const MOST_STEPS: u64 = 100_000;
const MOST_STEPS_PER_BYTE: u64 = 16;
/// Steps between two looks at their number.
const LOOK_EVERY: u64 = 1000;
/// No message is decompressed to more than this.
const MOST_MESSAGE: usize = 64 << 20;

/// What a folder's metadata.yaml says.
#[derive(Debug, Default, PartialEq, Eq)]
struct Metadata {
    files: Vec<String>,
    compression: String,
}

impl Metadata {
    /// The two entries that are wanted; rosbag2 writes one a line.
    fn parse(text: &str) -> Self {
        let mut metadata = Self::default();
        let mut in_files = false;
        for line in text.lines().map(str::trim) {
            let item = line.strip_prefix("- ");
            if let (true, Some(file)) = (in_files, item) {
                metadata.files.push(unquoted(file));
                continue;
            }
            in_files = line == "relative_file_paths:";
            if let Some(mode) = line.strip_prefix("compression_mode:") {
                metadata.compression = unquoted(mode).to_lowercase();
            }
        }
        metadata
    }
}

fn unquoted(word: &str) -> String {
    word.trim().trim_matches(['"', '\'']).into()
}

/// Reads a .db3, or a folder of a ROS 2 bag.
pub fn read(path: &Path, options: &ReadOptions<'_>) -> Result<Records, LogError> {
    let not_a_log = |what: String| LogError::NotALog { path: path.to_owned(), what };
    if !path.is_dir() {
        return read_files(path, &[path.to_owned()], false, options);
    }
    let yaml = path.join("metadata.yaml");
    let metadata = Metadata::parse(&std::fs::read_to_string(&yaml).map_err(LogError::open(&yaml))?);
    if metadata.files.is_empty() {
        return Err(not_a_log("its metadata.yaml lists no files under relative_file_paths".into()));
    }
    if let Some(file) = metadata.files.iter().find(|file| file.ends_with(".zstd")) {
        return Err(not_a_log(format!(
            "{file} is compressed as a whole: run `zstd -d {file}` in the folder and pass the file that this makes"
        )));
    }
    // Old versions of rosbag2 put the folder's name before the file's.
    let file = |name: &String| match path.join(name) {
        file if file.exists() => file,
        file => file.file_name().map_or(file.clone(), |name| path.join(name)),
    };
    let files: Vec<PathBuf> = metadata.files.iter().map(file).collect();
    if metadata.files.iter().all(|name| name.ends_with(".mcap")) {
        return super::read_mcap(path, &files, options);
    }
    read_files(path, &files, metadata.compression == "message", options)
}

fn read_files(
    path: &Path,
    files: &[PathBuf],
    compressed: bool,
    options: &ReadOptions<'_>,
) -> Result<Records, LogError> {
    let mut collector = Collector::new(path, options);
    let mut sizes = Vec::new();
    for file in files {
        let (mut opened, total) = super::open(file)?;
        let mut head = [0; 16];
        let whole = std::io::Read::read_exact(&mut opened, &mut head).is_ok();
        if !whole || head != *b"SQLite format 3\0" {
            let what = "not an SQLite file, in which ROS 2 keeps bags named .db3".into();
            return Err(LogError::NotALog { path: file.clone(), what });
        }
        sizes.push(total);
    }
    let all: u64 = sizes.iter().sum();
    let mut before = 0;
    for (file, size) in files.iter().zip(sizes) {
        collector.begin_file(file);
        let report = |done: u64| (options.progress)(before + done.min(size), all);
        let mut database = Database { collector: &mut collector, compressed };
        match database.walk(file, report) {
            Ok(()) => {}
            Err(Failure::Log(error)) => return Err(error),
            Err(Failure::Sqlite(error)) => {
                let what = format!("SQLite cannot read beyond this: {error}");
                if collector.topics.is_empty() {
                    return Err(LogError::Damaged { path: file.clone(), place: Place::Byte(0), what });
                }
                collector.damaged_here(what);
            }
        }
        before += size;
    }
    collector.finish()
}

enum Failure {
    Log(LogError),
    Sqlite(rusqlite::Error),
}

impl From<rusqlite::Error> for Failure {
    fn from(error: rusqlite::Error) -> Self {
        Self::Sqlite(error)
    }
}

/// Opens a file for reading only. Where no other file beside it holds some of its content it is opened as one that does not
/// change, which needs no lock and leaves no file in its folder.
/// Also gives how many bytes there are.
fn open(path: &Path) -> Result<(Connection, u64), rusqlite::Error> {
    let length = |suffix: &str| {
        let mut name = path.as_os_str().to_owned();
        name.push(suffix);
        std::fs::metadata(name).map_or(0, |m| m.len())
    };
    let (beside, bytes) = (length("-wal") + length("-journal"), length("") + length("-wal"));
    let flags = OpenFlags::SQLITE_OPEN_READ_ONLY | OpenFlags::SQLITE_OPEN_NO_MUTEX;
    let absolute = std::path::absolute(path).unwrap_or_else(|_| path.to_owned());
    let mut connection = match absolute.to_str() {
        Some(text) if beside == 0 => {
            let escaped = text.replace('%', "%25").replace('?', "%3f").replace('#', "%23");
            let uri = format!("file:{escaped}?immutable=1");
            Connection::open_with_flags(uri, flags | OpenFlags::SQLITE_OPEN_URI)?
        }
        _ => Connection::open_with_flags(path, flags)?,
    };
    // Nothing that a schema says is run.
    connection.pragma_update(None, "trusted_schema", false)?;
    connection.pragma_update(None, "temp_store", "FILE")?;
    let mut steps = 0;
    let most = MOST_STEPS + MOST_STEPS_PER_BYTE * bytes;
    let too_many = move || {
        steps += LOOK_EVERY;
        steps > most
    };
    connection.progress_handler(LOOK_EVERY as i32, Some(too_many))?;
    Ok((connection, bytes))
}

struct Database<'c, 'o> {
    collector: &'c mut Collector<'o>,
    /// Whether each message is compressed.
    compressed: bool,
}

impl Database<'_, '_> {
    fn walk(&mut self, file: &Path, report: impl Fn(u64)) -> Result<(), Failure> {
        let (connection, bytes) = open(file)?;
        // A view could compute anything, for any time.
        let tables: i64 = connection.query_row(
            "SELECT count(*) FROM sqlite_master WHERE type = 'table' AND name IN ('topics', 'messages') \
             AND sql LIKE 'CREATE TABLE%'",
            [],
            |row| row.get(0),
        )?;
        if tables != 2 {
            let what = "no ROS 2 bag: it has no tables 'topics' and 'messages'".into();
            return Err(Failure::Log(LogError::NotALog { path: file.to_owned(), what }));
        }
        let topics = self.topics(&connection)?;
        // Of a damaged file the counts may not be known though most rows are.
        let _ = self.count_others(&connection, &topics);
        let wanted: Vec<(i64, TopicId)> =
            topics.into_iter().filter(|(_, id)| self.collector.wants(*id)).collect();
        self.fetch(&connection, &wanted, bytes, report)
    }

    /// The topics and their numbers in the file.
    fn topics(&mut self, connection: &Connection) -> Result<Vec<(i64, TopicId)>, Failure> {
        let mut statement = connection.prepare("SELECT id, name, type, serialization_format FROM topics")?;
        let mut rows = statement.query([])?;
        let mut topics = Vec::new();
        while let Some(row) = rows.next()? {
            let (name, kind, format) = (text(row, 1)?, text(row, 2)?, text(row, 3)?);
            topics.push((row.get(0)?, self.collector.topic(&name, &kind, Encoding::named(&format))));
        }
        Ok(topics)
    }

    /// Counts the messages of topics that are not wanted.
    fn count_others(&mut self, connection: &Connection, topics: &[(i64, TopicId)]) -> Result<(), Failure> {
        let mut statement =
            connection.prepare("SELECT topic_id, count(*) FROM messages GROUP BY topic_id")?;
        let mut rows = statement.query([])?;
        while let Some(row) = rows.next()? {
            let (number, count): (i64, i64) = (row.get(0)?, row.get(1)?);
            if let Some((_, id)) = topics.iter().find(|(of, _)| *of == number)
                && !self.collector.wants(*id)
            {
                self.collector.pass_over(*id, usize::try_from(count).unwrap_or(0));
            }
        }
        Ok(())
    }

    /// Takes in the rows of wanted topics, of a file of so many bytes.
    fn fetch(
        &mut self,
        connection: &Connection,
        wanted: &[(i64, TopicId)],
        bytes: u64,
        report: impl Fn(u64),
    ) -> Result<(), Failure> {
        let order = format!(
            "SELECT rowid, topic_id, timestamp FROM messages WHERE topic_id IN ({}) ORDER BY timestamp, rowid",
            list(wanted)
        );
        let mut order = connection.prepare(&order)?;
        let mut data = connection.prepare("SELECT data FROM messages WHERE rowid = ?")?;
        let mut rows = order.query([])?;
        let (mut done, mut given) = (0, 0);
        while let Some(row) = rows.next()? {
            let (number, topic, recorded_ns): (i64, i64, i64) = (row.get(0)?, row.get(1)?, row.get(2)?);
            let Some((_, id)) = wanted.iter().find(|(of, _)| *of == topic) else { continue };
            let mut fetched = data.query([number])?;
            match fetched.next() {
                Ok(Some(fetched)) => match fetched.get_ref(0)?.as_bytes() {
                    Ok(message) => {
                        given += message.len() as u64;
                        if given > bytes {
                            self.collector.damaged_here("the messages are more than the file can hold");
                            return Ok(());
                        }
                        self.message(*id, recorded_ns, message)?;
                    }
                    Err(error) => self.collector.damaged_here(format!("a message is no bytes: {error}")),
                },
                Ok(None) => {}
                Err(error) => self.collector.damaged_here(format!("SQLite cannot read a message: {error}")),
            }
            done += 1;
            if usize::is_multiple_of(done, REPORT_EVERY) {
                report(given);
            }
        }
        report(bytes);
        Ok(())
    }

    fn message(&mut self, id: TopicId, recorded_ns: i64, bytes: &[u8]) -> Result<(), Failure> {
        if !self.compressed {
            return self.collector.message(id, recorded_ns, bytes).map_err(Failure::Log);
        }
        let mut whole = Vec::new();
        let decompressed = zstd::stream::read::Decoder::with_buffer(bytes).and_then(|decoder| {
            let mut decoder = std::io::Read::take(decoder, MOST_MESSAGE as u64);
            std::io::Read::read_to_end(&mut decoder, &mut whole)
        });
        if decompressed.is_err() {
            self.collector.pass_over(id, 1);
            self.collector.damaged_here("a message cannot be decompressed");
            return Ok(());
        }
        self.collector.message(id, recorded_ns, &whole).map_err(Failure::Log)
    }
}

/// A text, whatever its bytes.
fn text(row: &Row<'_>, column: usize) -> Result<String, rusqlite::Error> {
    Ok(String::from_utf8_lossy(row.get_ref(column)?.as_bytes()?).into_owned())
}

/// The numbers of topics, for a query.
fn list(topics: &[(i64, TopicId)]) -> String {
    topics.iter().map(|(number, _)| number.to_string()).collect::<Vec<_>>().join(",")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn metadata_lists_files_and_compression() {
        let yaml = "rosbag2_bagfile_information:\n  version: 5\n  relative_file_paths:\n    - drive_0.db3\n    - \"drive_1.db3\"\n  \
                    duration:\n    nanoseconds: 7\n  topics_with_message_count:\n    - topic_metadata:\n        name: /scan\n  \
                    compression_format: \"zstd\"\n  compression_mode: \"MESSAGE\"\n";
        let expected = Metadata {
            files: vec!["drive_0.db3".into(), "drive_1.db3".into()],
            compression: "message".into(),
        };
        assert_eq!(Metadata::parse(yaml), expected);
    }
}
