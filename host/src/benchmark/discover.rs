//! Logs in a folder, with the references and relations that belong to them, by their names.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use super::BenchmarkError;

/// Folders below folders that are searched.
const DEPTH: usize = 6;
/// Endings of files that are taken for logs, and what they hold. Texts may be gzipped.
const ENDINGS: [(&str, Container); 7] = [
    (".log", Container::Text),
    (".clf", Container::Text),
    (".dat", Container::Text),
    (".jsonl", Container::Text),
    (".bag", Container::Bag),
    (".mcap", Container::Bag),
    (".db3", Container::Bag),
];
/// What converters append to a log's name, the better ones first: sorted by time, as it was, converted otherwise, unsorted.
const CONVERSIONS: [&str; 4] = [".sort", ".clf", ".clf2bag", ".orig"];
/// What else people append to a log's name.
const ADDITIONS: [&str; 3] = ["-corrected", ".corrected", "_robotlaser"];
/// Names of the same building, ours last.
const ALIASES: [(&str, &str); 4] = [
    ("freiburg-079", "fr079"),
    ("freiburg-101", "fr101"),
    ("fr-clinic", "hospital"),
    ("freiburg-hospital", "hospital"),
];

/// What kind of file a log is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Container {
    /// A text.
    Text,
    /// A bag of messages.
    Bag,
}

/// A log, and what belongs to it.
#[derive(Clone, Debug)]
pub struct Found {
    /// The file.
    pub path: PathBuf,
    /// What it is called in tables: the end of its path, as much as tells it from the others.
    pub name: String,
    /// The building or drive, by which published figures are found.
    pub log: String,
    /// What kind of file it is.
    pub container: Container,
    /// The trajectory that counts as true.
    pub reference: Option<PathBuf>,
    /// Files of relations that may be its own, the nearest first.
    pub relations: Vec<PathBuf>,
    /// Names of other files with the same log, which are left out.
    pub same: Vec<String>,
}

impl Found {
    /// Its name where only letters, digits, minus and underscore may stand.
    pub fn slug(&self) -> String {
        let stem = self.name.replace('/', "-");
        let stem = ENDINGS.iter().find_map(|(ending, _)| stem.strip_suffix(ending)).unwrap_or(&stem);
        let bag = if self.container == Container::Bag { "_bag" } else { "" };
        let plain = |c: char| if c.is_ascii_alphanumeric() || c == '-' || c == '_' { c } else { '-' };
        stem.chars().map(plain).chain(bag.chars()).collect()
    }
}

/// The logs in a folder and the folders below it, in the order of their names. `only` are names of logs or files; all, where empty.
pub fn find(folder: &Path, only: &[String]) -> Result<Vec<Found>, BenchmarkError> {
    let mut files = Vec::new();
    walk(folder, DEPTH, &mut files)
        .map_err(|source| BenchmarkError::Folder { path: folder.to_owned(), source })?;
    files.sort();
    // The same log in several files of a folder.
    let mut logs: BTreeMap<(PathBuf, String, Container), Vec<(usize, PathBuf)>> = BTreeMap::new();
    for path in &files {
        if let Some((stem, container)) = stem(path) {
            let (stem, rank) = without_conversion(stem);
            let parent = path.parent().unwrap_or(folder).to_owned();
            logs.entry((parent, stem.to_owned(), container)).or_default().push((rank, path.clone()));
        }
    }
    let mut found: Vec<Found> = logs
        .into_iter()
        .map(|((parent, stem, container), mut paths)| {
            paths.sort();
            let mut paths = paths.into_iter().map(|(_, path)| path);
            let path = paths.next().unwrap_or_default();
            let log = log_of(&stem);
            let reference =
                files.iter().find(|f| f.parent() == Some(&*parent) && belongs(f, &log, ".ref.tum"));
            let mut relations: Vec<PathBuf> =
                files.iter().filter(|f| belongs(f, &log, ".relations")).cloned().collect();
            relations.sort_by_key(|f| std::cmp::Reverse(steps_in_common(f, &path)));
            let same = paths.map(|p| file_name(&p).to_owned()).collect();
            Found {
                name: String::new(),
                log,
                container,
                reference: reference.cloned(),
                relations,
                same,
                path,
            }
        })
        .collect();
    name(&mut found);
    if found.is_empty() {
        let endings = ENDINGS.map(|(ending, _)| ending).join(", ");
        return Err(BenchmarkError::NoLogs { path: folder.to_owned(), endings });
    }
    select(found, only)
}

fn select(found: Vec<Found>, only: &[String]) -> Result<Vec<Found>, BenchmarkError> {
    let is = |f: &Found, name: &str| f.log == name || f.name == name || file_name(&f.path) == name;
    if let Some(name) = only.iter().find(|name| !found.iter().any(|f| is(f, name))) {
        let found = found.iter().map(|f| f.name.as_str()).collect::<Vec<_>>().join(", ");
        return Err(BenchmarkError::NoSuchLog { name: name.clone(), found });
    }
    Ok(found.into_iter().filter(|f| only.is_empty() || only.iter().any(|name| is(f, name))).collect())
}

/// All files, and the folders that are bags.
fn walk(folder: &Path, depth: usize, files: &mut Vec<PathBuf>) -> std::io::Result<()> {
    for entry in std::fs::read_dir(folder)? {
        let entry = entry?;
        let path = entry.path();
        if entry.file_name().to_string_lossy().starts_with('.') {
            continue;
        }
        if entry.file_type()?.is_dir() {
            if path.join("metadata.yaml").exists() {
                files.push(path);
            } else if depth > 0 {
                // A folder below that cannot be searched is as good as empty.
                let _ = walk(&path, depth - 1, files);
            }
        } else {
            files.push(path);
        }
    }
    Ok(())
}

fn file_name(path: &Path) -> &str {
    path.file_name().and_then(|n| n.to_str()).unwrap_or_default()
}

/// A log's name without its ending, and what it holds; `None` of what is no log.
fn stem(path: &Path) -> Option<(&str, Container)> {
    let name = file_name(path);
    let gzipped = name.strip_suffix(".gz");
    let plain = gzipped.unwrap_or(name);
    let ended =
        ENDINGS.iter().find_map(|(ending, container)| Some((plain.strip_suffix(ending)?, *container)));
    match ended {
        Some((_, Container::Bag)) if gzipped.is_some() => None,
        None if path.join("metadata.yaml").exists() => Some((name, Container::Bag)),
        ended => ended,
    }
}

/// A name without what converters append, and how good the conversion is, the best first.
fn without_conversion(stem: &str) -> (&str, usize) {
    let mut rank = 1;
    let mut rest = stem;
    while let Some((k, shorter)) =
        CONVERSIONS.iter().enumerate().find_map(|(k, c)| Some((k, rest.strip_suffix(c)?)))
    {
        if rest == stem {
            rank = k;
        }
        rest = shorter;
    }
    (rest, rank)
}

/// The building or drive that a name stands for.
fn log_of(stem: &str) -> String {
    let mut name = stem.to_lowercase();
    while let Some(shorter) = ADDITIONS.iter().find_map(|a| name.strip_suffix(a)) {
        name = shorter.to_owned();
    }
    ALIASES.iter().find(|(theirs, _)| *theirs == name).map_or(name, |(_, ours)| (*ours).to_owned())
}

/// Whether a file is this log's by its name: NAME or NAME-something, and the ending.
fn belongs(path: &Path, log: &str, ending: &str) -> bool {
    let Some(stem) = file_name(path).strip_suffix(ending) else { return false };
    let own = log_of(without_conversion(stem).0);
    own == log || own.strip_prefix(log).is_some_and(|rest| rest.starts_with(['.', '-', '_']))
}

/// Folders that two paths have in common.
fn steps_in_common(a: &Path, b: &Path) -> usize {
    a.components().zip(b.components()).take_while(|(a, b)| a == b).count()
}

/// Names each log by the end of its path, as much of it as tells it from the others.
fn name(found: &mut [Found]) {
    let end = |path: &Path, steps: usize| {
        let parts: Vec<_> = path.iter().map(|part| part.to_string_lossy()).collect();
        let end = parts[parts.len().saturating_sub(steps)..].join("/");
        end.strip_suffix(".gz").map_or_else(|| end.clone(), str::to_owned)
    };
    let paths: Vec<PathBuf> = found.iter().map(|f| f.path.clone()).collect();
    for log in found {
        let alone =
            |steps: &usize| paths.iter().filter(|p| end(p, *steps) == end(&log.path, *steps)).count() == 1;
        let steps = (1..=DEPTH).find(alone).unwrap_or(DEPTH + 1);
        log.name = end(&log.path, steps);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn folder(files: &[&str]) -> tempfile::TempDir {
        let folder = tempfile::tempdir().unwrap();
        for file in files {
            let path = folder.path().join(file);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::fs::write(path, "").unwrap();
        }
        folder
    }

    fn names(found: &[Found]) -> Vec<(&str, &str)> {
        found.iter().map(|f| (f.name.as_str(), f.log.as_str())).collect()
    }

    #[test]
    fn logs_are_found_with_what_belongs_to_them() {
        let folder = folder(&[
            "README.md",
            "exp1.dat.gz",
            "exp1.ref.tum",
            "fr079.log.gz",
            "fr079.ref.tum",
            "fr079.relations",
            "kuemmerle/fr079.bag",
            "kuemmerle/fr079.relations",
            "public/freiburg-101-corrected.log.gz",
            ".git/x.log",
        ]);
        let found = find(folder.path(), &[]).unwrap();
        assert_eq!(
            names(&found),
            [
                ("exp1.dat", "exp1"),
                ("fr079.log", "fr079"),
                ("fr079.bag", "fr079"),
                ("freiburg-101-corrected.log", "fr101")
            ]
        );
        assert!(found[0].reference.is_some() && found[1].reference.is_some());
        assert!(found[2].reference.is_none(), "a reference is its neighbour's");
        assert!(found[1].relations[0].ends_with("fr079.relations"));
        assert!(found[2].relations[0].ends_with("kuemmerle/fr079.relations"), "the nearest first");
        assert_eq!(found[2].relations.len(), 2);
        assert_eq!(found.iter().map(Found::slug).collect::<Vec<_>>()[1..3], ["fr079", "fr079_bag"]);
    }

    #[test]
    fn of_several_conversions_of_a_log_the_sorted_one_is_taken() {
        let bags =
            ["aces.clf.orig.bag", "aces.clf.sort.bag", "aces.clf2bag.bag", "fr-clinic_robotlaser.orig.bag"];
        let folder =
            folder(&bags.map(|b| format!("ricoslam/datasets/bag/{b}")).each_ref().map(String::as_str));
        std::fs::create_dir(folder.path().join("ricoslam/datasets/data")).unwrap();
        for relations in ["aces.relations", "fr-clinic.relations"] {
            std::fs::write(folder.path().join("ricoslam/datasets/data").join(relations), "").unwrap();
        }
        let found = find(folder.path(), &[]).unwrap();
        assert_eq!(
            names(&found),
            [("aces.clf.sort.bag", "aces"), ("fr-clinic_robotlaser.orig.bag", "hospital")]
        );
        assert_eq!(found[0].same, ["aces.clf2bag.bag", "aces.clf.orig.bag"]);
        assert!(found.iter().all(|f| f.relations.len() == 1));
    }

    #[test]
    fn names_that_are_alike_are_told_apart_by_their_folders() {
        let folder = folder(&["a/drive.log", "b/drive.log", "b/x/other.dat"]);
        let found = find(folder.path(), &[]).unwrap();
        assert_eq!(
            names(&found),
            [("a/drive.log", "drive"), ("b/drive.log", "drive"), ("other.dat", "other")]
        );
        let only = find(folder.path(), &["other".into()]).unwrap();
        assert_eq!(names(&only), [("other.dat", "other")]);
        let error = find(folder.path(), &["exp9".into()]).unwrap_err().to_string();
        assert!(error.contains("exp9") && error.contains("a/drive.log"), "{error}");
    }

    #[test]
    fn a_folder_without_logs_is_an_error() {
        let folder = folder(&["README.md"]);
        assert!(matches!(find(folder.path(), &[]), Err(BenchmarkError::NoLogs { .. })));
        let absent = folder.path().join("absent");
        assert!(matches!(find(&absent, &[]), Err(BenchmarkError::Folder { .. })));
    }
}
