//! Atomic file writes: the one way in which any output reaches the disk. Elements of PLY files.

pub(crate) mod ply;

use std::io::{ErrorKind, Write};
use std::path::{Path, PathBuf};

/// A file that could not be written.
#[derive(Debug, thiserror::Error)]
#[error("cannot write {path}: {source}; {advice}", advice = advice(source.kind()))]
pub struct WriteError {
    /// The requested file, not the temporary one beside it.
    pub path: PathBuf,
    /// The system's error.
    pub source: std::io::Error,
}

fn advice(kind: ErrorKind) -> &'static str {
    match kind {
        ErrorKind::StorageFull | ErrorKind::QuotaExceeded => "free some space or write to another disk",
        ErrorKind::PermissionDenied | ErrorKind::ReadOnlyFilesystem => "choose a folder that you may write to",
        ErrorKind::NotFound | ErrorKind::NotADirectory => "create the folder first",
        ErrorKind::IsADirectory => "a folder has that name: remove it or choose another name",
        ErrorKind::DirectoryNotEmpty => "choose a new folder, or empty it",
        _ => "check the disk and the path",
    }
}

/// Writes a file so that it is never seen half-written: under another name in the same folder first, then renamed. Replaces what
/// was there. Not flushed to the disk itself: a power cut may still lose it.
///
/// # Errors
/// [`WriteError`] if the folder does not exist, the disk is full, or writing is not permitted.
pub fn write_atomically(path: &Path, bytes: &[u8]) -> Result<(), WriteError> {
    write(path, bytes, |_| Ok(()))
}

/// Writes as [`write_atomically`] and flushes to the disk: after a power cut either the new file or the old one is there.
///
/// # Errors
/// As [`write_atomically`].
pub fn write_durably(path: &Path, bytes: &[u8]) -> Result<(), WriteError> {
    write(path, bytes, std::fs::File::sync_all)?;
    // The rename is the folder's to keep.
    path.parent().into_iter().for_each(sync_folder);
    Ok(())
}

/// Flushes a folder's names to the disk, where the system opens folders as files.
pub fn sync_folder(folder: &Path) {
    let _ = std::fs::File::open(folder).map(|folder| folder.sync_all());
}

/// Removes what writes that were killed left in a folder, as far as that is possible.
pub fn remove_partials(folder: &Path) {
    let is_partial = |name: &str| name.starts_with('.') && name.ends_with(PARTIAL);
    let entries = std::fs::read_dir(folder).into_iter().flatten().filter_map(Result::ok);
    for entry in entries.filter(|entry| entry.file_name().to_str().is_some_and(is_partial)) {
        let _ = std::fs::remove_file(entry.path());
    }
}

const PARTIAL: &str = ".partial";

fn write(path: &Path, bytes: &[u8], flush: impl Fn(&std::fs::File) -> std::io::Result<()>) -> Result<(), WriteError> {
    let write_error = |source| WriteError { path: path.into(), source };
    let Some(name) = path.file_name() else {
        return Err(write_error(ErrorKind::IsADirectory.into()));
    };
    let mut partial_name = std::ffi::OsString::from(".");
    partial_name.push(name);
    partial_name.push(format!(".{}{PARTIAL}", std::process::id()));
    let partial = path.with_file_name(partial_name);
    let written = std::fs::File::create(&partial)
        .and_then(|mut file| file.write_all(bytes).and_then(|()| flush(&file)))
        .and_then(|()| std::fs::rename(&partial, path));
    written.map_err(|source| {
        // Best effort: what failed is more worth telling than what is left over.
        let _ = std::fs::remove_file(&partial);
        write_error(source)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_write_leaves_the_file_and_nothing_else() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("file");
        write_atomically(&path, b"one").unwrap();
        write_atomically(&path, b"two").unwrap();
        assert_eq!(std::fs::read(&path).unwrap(), b"two");
        write_durably(&path, b"three").unwrap();
        assert_eq!(std::fs::read(&path).unwrap(), b"three");
        std::fs::write(folder.path().join(".file.123.partial"), b"th").unwrap();
        remove_partials(folder.path());
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);
    }

    #[test]
    fn failed_writes_say_what_to_do_and_leave_nothing() {
        let folder = tempfile::tempdir().unwrap();
        let missing = write_atomically(&folder.path().join("no/file"), b"").unwrap_err().to_string();
        assert!(missing.contains("no/file") && missing.ends_with("create the folder first"), "{missing}");
        let taken = folder.path().join("taken");
        std::fs::create_dir(&taken).unwrap();
        assert!(write_atomically(&taken, b"").is_err());
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);
    }
}
