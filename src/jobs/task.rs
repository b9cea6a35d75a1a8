//! One task: verified, locked, resumed, and committed by one rename.
//!
//! `tasks/NNNN/working` is the work in progress, `tasks/NNNN/result` a result. A result appears whole: the one is renamed to the other.

use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

use serde::{Deserialize, Serialize};

use super::input::{create_folder, sha256_of};
use super::{JobError, Plan, Task};
use crate::evaluation::sha256_hex;
use crate::files::{WriteError, sync_folder, write_durably};
use crate::run_folder::{FolderLock, OutputError, outputs};

const WORKING: &str = "working";
const RESULT: &str = "result";
/// In a result's folder.
const RESULT_FILE: &str = "result.json";
/// Attempts so far, in a task's folder.
const ATTEMPTS: &str = "attempts.json";
/// The last failure, in a task's folder.
const FAILURE: &str = "failed.json";
/// Attempts in a row that may bring a task no further: a killed process is worth another try, a task that always kills it is not.
const MOST_TRIES: usize = 3;
/// Looks at a lock, and the time between two: `jobs status` holds it for a moment.
const LOCK_TRIES: usize = 5;
const LOCK_WAIT: Duration = Duration::from_millis(50);

/// What a task's work has left in its folder.
#[derive(Clone, Debug, Default)]
pub struct Made {
    /// Figures without times: the same after each repetition.
    pub figures: serde_json::Value,
    /// Files that are the same after each repetition.
    pub files: Vec<String>,
    /// Files that hold times.
    pub timed_files: Vec<String>,
}

/// Why a task's work ended without a result.
#[derive(Debug)]
pub enum WorkError {
    /// A signal ended it, after a checkpoint.
    Interrupted,
    /// Its input cannot be used: it fails each time.
    BadInput(String),
    /// It failed.
    Failed(String),
}

/// How a task ended well.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Ended {
    /// It made its result.
    Made,
    /// The result was there.
    WasThere,
}

/// A task's result: `result.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TaskResult {
    /// Digest of what it depends on.
    task: String,
    /// Figures without times.
    pub figures: serde_json::Value,
    /// Name and SHA-256 of the files that repeat.
    files: Vec<FileDigest>,
    /// Those of the files that hold times.
    timed_files: Vec<FileDigest>,
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct FileDigest {
    name: String,
    sha256: String,
}

/// A failure that was recorded.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Failure {
    pub reason: String,
    pub status: u8,
}

/// Attempts without progress.
#[derive(Debug, Default, PartialEq, Serialize, Deserialize)]
struct Attempts {
    /// Digest of what the task depends on.
    task: String,
    count: usize,
    /// Time and size of the checkpoint that the last attempt began with.
    checkpoint: Option<(SystemTime, u64)>,
}

impl TaskResult {
    /// Digest of all that repeats, wherever the plan lies.
    pub fn digest(&self) -> String {
        let repeats = (&self.figures, &self.files);
        sha256_hex(serde_json::to_string(&repeats).expect("a result is text and numbers").as_bytes())
    }

    /// Reads the result of a task of this plan, without a look at its files; `None` where there is none.
    pub(super) fn find(plan: &Plan, number: usize) -> Option<Self> {
        let text = std::fs::read(result_folder(plan, number).join(RESULT_FILE)).ok()?;
        let result: Self = serde_json::from_slice(&text).ok()?;
        (result.task == plan.identity(plan.tasks.get(number)?)).then_some(result)
    }

    /// The same with all its files verified.
    ///
    /// # Errors
    /// A reason for people.
    pub(super) fn verified(plan: &Plan, number: usize) -> Result<Self, String> {
        let folder = result_folder(plan, number);
        if !folder.exists() {
            return Err("it has no result".into());
        }
        let result = Self::find(plan, number).ok_or("its result is damaged or of another plan")?;
        let mut files = result.files.iter().chain(&result.timed_files);
        let damaged = files.find(|file| sha256_of(&folder.join(&file.name)).ok().as_ref() != Some(&file.sha256));
        damaged.map_or(Ok(()), |file| Err(format!("{} is damaged", folder.join(&file.name).display())))?;
        Ok(result)
    }
}

/// Folder of a task's result.
pub(super) fn result_folder(plan: &Plan, number: usize) -> PathBuf {
    plan.task_folder(number).join(RESULT)
}

/// The failure that the last attempt recorded.
pub(super) fn failure(plan: &Plan, number: usize) -> Option<Failure> {
    serde_json::from_slice(&std::fs::read(plan.task_folder(number).join(FAILURE)).ok()?).ok()
}

/// Attempts since the last progress.
pub(super) fn attempts(plan: &Plan, number: usize) -> usize {
    Attempts::read(&plan.task_folder(number)).count
}

/// Runs a task unless its result is there. `work` receives the folder to work in, with what an interrupted attempt left there.
///
/// # Errors
/// If another process has the task, an input has changed, or the work fails; failures are recorded in the task's folder.
pub fn run_task(
    plan: &Plan,
    number: usize,
    work: &mut dyn FnMut(&Task, &Path) -> Result<Made, WorkError>,
) -> Result<Ended, JobError> {
    let (task, folder) = (plan.task(number)?, plan.task_folder(number));
    create_folder(&folder)?;
    let _lock = lock(&folder)?;
    if TaskResult::verified(plan, number).is_ok() {
        return Ok(Ended::WasThere);
    }
    let made = attempt(plan, task, &folder, work).and_then(|made| commit(plan, task, &folder, made));
    match &made {
        Ok(()) => [ATTEMPTS, FAILURE].iter().for_each(|name| remove_file(&folder.join(name))),
        Err(error) if error.exit_status() == super::AGAIN => {}
        Err(error) => {
            let failure = Failure { reason: error.to_string(), status: error.exit_status() };
            let text = serde_json::to_string_pretty(&failure).expect("a failure is text");
            // A full disk may be the failure itself; the process's own status and log say it then.
            if let Err(unwritten) = write_durably(&folder.join(FAILURE), text.as_bytes()) {
                tracing::warn!("{unwritten}");
            }
            // The next attempt goes on from the checkpoint, unless that has led nowhere.
            let anew = matches!(error, JobError::NoProgress { .. });
            let attempts = if anew { Attempts::default() } else { Attempts { count: 0, ..Attempts::read(&folder) } };
            let _ = attempts.write(&folder);
        }
    }
    made.map(|()| Ended::Made)
}

fn attempt(
    plan: &Plan,
    task: &Task,
    folder: &Path,
    work: &mut dyn FnMut(&Task, &Path) -> Result<Made, WorkError>,
) -> Result<Made, JobError> {
    plan.verify_inputs(task)?;
    let working = folder.join(WORKING);
    let before = Attempts::read(folder);
    let identity = plan.identity(task);
    if before.task != identity {
        // Of another plan, or of an attempt that failed.
        remove_folder(&working)?;
    }
    let checkpoint = std::fs::metadata(working.join(outputs::CHECKPOINT)).ok();
    let checkpoint = checkpoint.and_then(|file| Some((file.modified().ok()?, file.len())));
    let is_stuck = before.task == identity && before.checkpoint == checkpoint;
    let count = if is_stuck { before.count } else { 0 };
    if count >= MOST_TRIES {
        return Err(JobError::NoProgress { folder: folder.into(), tries: count });
    }
    Attempts { task: identity, count: count + 1, checkpoint }.write(folder)?;
    remove_file(&folder.join(FAILURE));
    create_folder(&working)?;
    work(task, &working).map_err(|error| match error {
        WorkError::Interrupted => JobError::Interrupted { folder: folder.into() },
        WorkError::BadInput(reason) => JobError::Work { reason, is_bad_input: true },
        WorkError::Failed(reason) => JobError::Work { reason, is_bad_input: false },
    })
}

/// Makes the work the result, in one rename.
fn commit(plan: &Plan, task: &Task, folder: &Path, made: Made) -> Result<(), JobError> {
    let (working, result) = (folder.join(WORKING), folder.join(RESULT));
    let digests = |names: Vec<String>| {
        let digest = |name: String| {
            let path = working.join(&name);
            let sha256 = sha256_of(&path).map_err(|source| JobError::Folder { action: "read back", path, source })?;
            Ok(FileDigest { name, sha256 })
        };
        names.into_iter().map(digest).collect::<Result<Vec<_>, JobError>>()
    };
    let (files, timed_files) = (digests(made.files)?, digests(made.timed_files)?);
    let record = TaskResult { task: plan.identity(task), figures: made.figures, files, timed_files };
    let text = serde_json::to_string_pretty(&record).expect("a result is text and numbers");
    write_durably(&working.join(RESULT_FILE), text.as_bytes())?;
    // What is there does not match: it was verified before the work.
    remove_folder(&result)?;
    std::fs::rename(&working, &result).map_err(|source| JobError::Folder { action: "rename", path: working, source })?;
    sync_folder(folder);
    Ok(())
}

impl Attempts {
    fn read(folder: &Path) -> Self {
        let text = std::fs::read(folder.join(ATTEMPTS)).unwrap_or_default();
        serde_json::from_slice(&text).unwrap_or_default()
    }

    fn write(&self, folder: &Path) -> Result<(), WriteError> {
        let text = serde_json::to_string(self).expect("attempts are numbers");
        write_durably(&folder.join(ATTEMPTS), text.as_bytes())
    }
}

fn lock(folder: &Path) -> Result<FolderLock, JobError> {
    for _ in 1..LOCK_TRIES {
        match FolderLock::take(folder) {
            Err(OutputError::Busy { .. }) => std::thread::sleep(LOCK_WAIT),
            taken => return Ok(taken?),
        }
    }
    FolderLock::take(folder).map_err(|error| match error {
        OutputError::Busy { path } => JobError::Busy { folder: path },
        error => error.into(),
    })
}

/// Best effort: what remains is replaced or ignored.
fn remove_file(path: &Path) {
    let _ = std::fs::remove_file(path);
}

fn remove_folder(path: &Path) -> Result<(), JobError> {
    match std::fs::remove_dir_all(path) {
        Err(source) if source.kind() != std::io::ErrorKind::NotFound => {
            Err(JobError::Folder { action: "remove", path: path.into(), source })
        }
        _ => Ok(()),
    }
}
