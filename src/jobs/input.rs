//! Digests of what tasks read, in the format of `sha256sum`: one line a file, so that the file that changed can be named.

use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};

use rayon::iter::{IntoParallelRefIterator, ParallelIterator};
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use super::JobError;
use crate::evaluation::sha256_hex;
use crate::files::write_durably;

/// Folder of the digests in a plan.
const INPUTS: &str = "inputs";
/// Bytes read at a time.
const CHUNK: usize = 1 << 20;

/// A file, or a folder with all its files, that tasks read.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Input {
    /// Where it is; relative paths begin at the plan's folder.
    pub path: PathBuf,
    /// File with one line for each of its files, in the plan's folder.
    pub digests: PathBuf,
    /// SHA-256 of these lines.
    pub sha256: String,
}

impl Input {
    /// Reads an input whole and writes its digests into the plan's folder.
    ///
    /// # Errors
    /// If a file cannot be read, or the digests cannot be written.
    pub(super) fn measure(plan: &Path, path: PathBuf) -> Result<Self, JobError> {
        let lines = lines(&plan.join(&path))?.concat();
        let sha256 = sha256_hex(lines.as_bytes());
        // Named by its content, so that no other plan's file is replaced.
        let digests = Path::new(INPUTS).join(format!("{}.sha256", &sha256[..16]));
        create_folder(&plan.join(INPUTS))?;
        write_durably(&plan.join(&digests), lines.as_bytes())?;
        Ok(Self { path, digests, sha256 })
    }

    /// Reads the input again and compares it.
    ///
    /// # Errors
    /// Names the first file that differs, is missing or is new.
    pub(super) fn verify(&self, plan: &Path) -> Result<(), JobError> {
        let path = plan.join(&self.path);
        let now = lines(&path)?;
        if sha256_hex(now.concat().as_bytes()) == self.sha256 {
            return Ok(());
        }
        let listed = std::fs::read_to_string(plan.join(&self.digests)).unwrap_or_default();
        let then: Vec<&str> = listed.split_inclusive('\n').collect();
        let folder = if path.is_dir() { path.as_path() } else { path.parent().unwrap_or(Path::new("")) };
        let changed = now.iter().map(String::as_str).find(|line| !then.contains(line));
        let first = changed.or_else(|| then.iter().copied().find(|line| !now.iter().any(|l| l == line)));
        let file = first.and_then(|line| line.trim_end().split_once("  ")).map_or(path.clone(), |(_, name)| folder.join(name));
        let reason = if file.exists() { "is not what it was when the plan was made" } else { "is missing" };
        Err(JobError::Input { path: file, reason: reason.into() })
    }
}

/// `digest  name` of each file, names relative to the folder and sorted.
fn lines(path: &Path) -> Result<Vec<String>, JobError> {
    let unreadable =
        |path: &Path, source: std::io::Error| JobError::Input { path: path.into(), reason: format!("cannot be read ({source})") };
    let metadata = std::fs::metadata(path).map_err(|error| unreadable(path, error))?;
    let folder = if metadata.is_dir() { path } else { path.parent().unwrap_or(Path::new("")) };
    let mut files = Vec::new();
    list(path, &mut files).map_err(|error| unreadable(path, error))?;
    files.sort();
    let line = |file: &PathBuf| {
        let name = file.strip_prefix(folder).unwrap_or(file).display();
        Ok(format!("{}  {name}\n", sha256_of(file).map_err(|error| unreadable(file, error))?))
    };
    files.par_iter().map(line).collect()
}

fn list(path: &Path, files: &mut Vec<PathBuf>) -> std::io::Result<()> {
    if !std::fs::metadata(path)?.is_dir() {
        files.push(path.into());
        return Ok(());
    }
    std::fs::read_dir(path)?.try_for_each(|entry| list(&entry?.path(), files))
}

/// SHA-256 of a file, hexadecimal.
///
/// # Errors
/// If it cannot be read.
pub(super) fn sha256_of(path: &Path) -> std::io::Result<String> {
    let (mut file, mut digest, mut chunk) = (File::open(path)?, Sha256::new(), vec![0; CHUNK]);
    loop {
        let read = file.read(&mut chunk)?;
        if read == 0 {
            return Ok(digest.finalize().iter().map(|byte| format!("{byte:02x}")).collect());
        }
        digest.update(&chunk[..read]);
    }
}

/// Creates a folder and those above it.
///
/// # Errors
/// If that is not permitted, or the disk is full.
pub(super) fn create_folder(path: &Path) -> Result<(), JobError> {
    std::fs::create_dir_all(path).map_err(|source| JobError::Folder { action: "create", path: path.into(), source })
}
