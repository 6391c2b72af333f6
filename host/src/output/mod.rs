//! Files that a replay leaves behind. Each module turns results into the bytes of one kind of file; [`write_all`] puts
//! them on disk, all or none.

pub mod csv;
pub mod dxf;
pub mod grid;
pub mod mcap;
pub mod report;
pub mod scan;
pub mod svg;
pub mod tracking;
pub mod trajectory_csv;
pub mod tum;

use std::io::Write;
use std::path::{Path, PathBuf};

use nalgebra::Point2;

/// Lower left and upper right corner of the box around points; the origin twice without any.
fn bounds(points: impl Iterator<Item = Point2<f32>>) -> (Point2<f32>, Point2<f32>) {
    let grown = points.fold(None, |grown: Option<(Point2<f32>, Point2<f32>)>, p| {
        Some(grown.map_or((p, p), |(low, high)| (low.inf(&p), high.sup(&p))))
    });
    grown.unwrap_or((Point2::origin(), Point2::origin()))
}

/// The files could not be written; none was.
#[derive(Debug, thiserror::Error)]
#[error("{}", path.display())]
pub struct WriteError {
    /// File or folder.
    pub path: PathBuf,
    /// What the system said.
    pub source: std::io::Error,
}

/// Writes named files into a folder, or where an absolute name says; folders that are missing are made. All contents are on disk under temporary names
/// before the first one gets its own.
pub fn write_all<N: AsRef<Path>>(folder: &Path, files: &[(N, Vec<u8>)]) -> Result<(), WriteError> {
    let failed = |path: &Path| {
        let path = path.to_owned();
        move |source| WriteError { path, source }
    };
    let mut written = Vec::new();
    for (name, bytes) in files {
        let path = folder.join(name);
        if path.is_dir() {
            return Err(WriteError { path, source: std::io::ErrorKind::IsADirectory.into() });
        }
        let parent = path.parent().unwrap_or(folder);
        std::fs::create_dir_all(parent).map_err(failed(parent))?;
        let mut file = tempfile::Builder::new()
            .prefix(".writing-")
            .permissions(file_mode())
            .tempfile_in(parent)
            .map_err(failed(&path))?;
        file.write_all(bytes).and_then(|()| file.as_file().sync_all()).map_err(failed(&path))?;
        written.push((file, path));
    }
    for (file, path) in written {
        file.persist(&path).map_err(|e| WriteError { path, source: e.error })?;
    }
    Ok(())
}

#[cfg(unix)]
fn file_mode() -> std::fs::Permissions {
    // Temporary files are private by default; results are for everybody, within the umask.
    std::os::unix::fs::PermissionsExt::from_mode(0o666)
}

#[cfg(not(unix))]
fn file_mode() -> std::fs::Permissions {
    std::env::temp_dir().metadata().map(|m| m.permissions()).expect("the folder for temporary files exists")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn writes_every_file_and_overwrites_old_ones() {
        let folder = tempfile::tempdir().unwrap();
        let out = folder.path().join("new/out");
        write_all(&out, &[("a", b"1".to_vec()), ("b", b"2".to_vec())]).unwrap();
        write_all(&out, &[("a", b"3".to_vec())]).unwrap();
        assert_eq!(std::fs::read(out.join("a")).unwrap(), b"3");
        assert_eq!(std::fs::read(out.join("b")).unwrap(), b"2");
        assert_eq!(std::fs::read_dir(&out).unwrap().count(), 2, "no temporary file stays");
    }

    #[test]
    fn writes_nothing_when_one_file_cannot_be_written() {
        let folder = tempfile::tempdir().unwrap();
        std::fs::create_dir(folder.path().join("b")).unwrap();
        let error = write_all(folder.path(), &[("a", b"1".to_vec()), ("b", b"2".to_vec())]).unwrap_err();
        assert!(error.path.ends_with("b"));
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1, "only the folder that was there");
    }
}
