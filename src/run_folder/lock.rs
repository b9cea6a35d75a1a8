//! One process at a time works in a run's folder.
//!
//! The lock is the operating system's, on an empty file that stays: it goes with the process that holds it, however that ends, and a file
//! that is left over locks nobody out. Where a file system knows no locks, nobody is kept out either.

use std::fs::{File, TryLockError};
use std::path::Path;

use super::outputs::OutputError;

/// The file that is locked, in the run's folder.
const NAME: &str = ".lock";

/// Holds a run's folder until it is dropped.
#[derive(Debug)]
#[must_use = "the folder is free again when it is dropped"]
pub struct FolderLock {
    /// Locked as long as it is open.
    _file: File,
}

impl FolderLock {
    /// Takes a folder that exists.
    ///
    /// # Errors
    /// If another process has it, or nothing can be written there.
    pub fn take(folder: &Path) -> Result<Self, OutputError> {
        let path = folder.join(NAME);
        let open = File::options().write(true).create(true).truncate(false).open(&path);
        let file = open.map_err(|source| OutputError::Folder { path: folder.into(), source })?;
        match file.try_lock() {
            Err(TryLockError::WouldBlock) => return Err(OutputError::Busy { path: folder.into() }),
            Err(TryLockError::Error(error)) => {
                tracing::warn!("cannot lock {}: {error}; see that nothing else writes to this folder", path.display());
            }
            Ok(()) => {}
        }
        Ok(Self { _file: file })
    }

    /// Whether a process holds the folder.
    pub fn is_held(folder: &Path) -> bool {
        let file = File::options().write(true).open(folder.join(NAME));
        file.is_ok_and(|file| matches!(file.try_lock_shared(), Err(TryLockError::WouldBlock)))
    }
}
