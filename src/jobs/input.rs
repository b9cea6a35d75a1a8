//! Digests of what tasks read, in the format of `sha256sum`: one line a file, so that the file that changed can be named.

use std::fs::{File, Metadata};
use std::io::Read;
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

use rayon::iter::{IntoParallelRefIterator, ParallelIterator};
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use super::JobError;
use crate::evaluation::sha256_hex;
use crate::files::{write_atomically, write_durably};

/// Folder of the digests in a plan.
const INPUTS: &str = "inputs";
/// Ending of the file beside the digests that holds the files' states when they were last right.
const SEEN: &str = "seen";
/// File systems tell times in steps up to this long.
const TIME_STEP: Duration = Duration::from_millis(if cfg!(test) { 20 } else { 2000 });
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
        let states = states(&plan.join(&path))?;
        let lines = lines(&plan.join(&path))?.concat();
        let sha256 = sha256_hex(lines.as_bytes());
        // Named by its content, so that no other plan's file is replaced.
        let digests = Path::new(INPUTS).join(format!("{}.sha256", &sha256[..16]));
        create_folder(&plan.join(INPUTS))?;
        write_durably(&plan.join(&digests), lines.as_bytes())?;
        write_atomically(&plan.join(&digests).with_extension(SEEN), states.as_bytes())?;
        Ok(Self { path, digests, sha256 })
    }

    /// Compares the input with its digests. Reads it only where a file has changed since the plan or a task read it whole: a thousand tasks do not
    /// read a recording a thousand times.
    ///
    /// # Errors
    /// Names the first file that differs, is missing or is new.
    pub(super) fn verify(&self, plan: &Path) -> Result<(), JobError> {
        let (path, seen) = (plan.join(&self.path), plan.join(&self.digests).with_extension(SEEN));
        let states = states(&path)?;
        if std::fs::read_to_string(&seen).is_ok_and(|before| before == states) {
            return Ok(());
        }
        let now = lines(&path)?;
        if sha256_hex(now.concat().as_bytes()) == self.sha256 {
            // Without it the next task reads them again.
            let _ = write_atomically(&seen, states.as_bytes());
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
    of_files(path, sha256_of)
}

/// Size and time of the last change of each file: another digest has another state. A file that changed a moment ago may change again at the same
/// time; its state never comes again.
fn states(path: &Path) -> Result<String, JobError> {
    let now = SystemTime::now();
    let state = |file: &Path| {
        let metadata = std::fs::metadata(file)?;
        let changed = changed(&metadata);
        let is_settled = now.duration_since(changed).is_ok_and(|age| age > TIME_STEP);
        let since_epoch = |time: SystemTime| time.duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default().as_nanos();
        Ok(format!("{} {}", metadata.len(), since_epoch(if is_settled { changed } else { now })))
    };
    of_files(path, state).map(|lines| lines.concat())
}

/// When a file's content or metadata changed last. On Unix it follows the clock alone; programs cannot set it.
fn changed(metadata: &Metadata) -> SystemTime {
    #[cfg(unix)]
    {
        use std::os::unix::fs::MetadataExt;
        let since_epoch = Duration::new(metadata.ctime().try_into().unwrap_or(0), metadata.ctime_nsec().try_into().unwrap_or(0));
        SystemTime::UNIX_EPOCH + since_epoch
    }
    #[cfg(not(unix))]
    metadata.modified().unwrap_or_else(|_| SystemTime::now())
}

/// `what  name` of each file, names relative to the folder and sorted.
fn of_files(path: &Path, what: impl Fn(&Path) -> std::io::Result<String> + Sync) -> Result<Vec<String>, JobError> {
    let unreadable =
        |path: &Path, source: std::io::Error| JobError::Input { path: path.into(), reason: format!("cannot be read ({source})") };
    let metadata = std::fs::metadata(path).map_err(|error| unreadable(path, error))?;
    let folder = if metadata.is_dir() { path } else { path.parent().unwrap_or(Path::new("")) };
    let mut files = Vec::new();
    list(path, &mut files).map_err(|error| unreadable(path, error))?;
    files.sort();
    let line = |file: &PathBuf| {
        let name = file.strip_prefix(folder).unwrap_or(file).display();
        Ok(format!("{}  {name}\n", what(file).map_err(|error| unreadable(file, error))?))
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
