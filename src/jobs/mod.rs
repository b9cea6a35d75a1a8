//! Independent tasks of one plan: made once, run anywhere and in any order, merged into one table.
//!
//! A plan is a folder: `plan.json` with the tasks, `inputs/` with the digests of what they read, and one folder a task in `tasks/`. All that
//! matters is in the program: a task verifies its inputs, resumes, and appears whole or not at all. An engine only starts processes, so each
//! has one file here: processes of this machine, Slurm, Kubernetes. There is no scheduler and no network here.

mod cells;
mod input;
pub mod kubernetes;
pub mod local;
mod merge;
mod plan;
pub mod slurm;
mod status;
mod task;
#[cfg(test)]
mod tests;

use std::path::PathBuf;

pub use cells::CellRow;
pub use input::Input;
pub use merge::{Hole, Merge, merge};
pub use plan::{CellTask, Draft, Plan, ReplayTask, RunTask, Task, Work};
pub use status::{State, TaskStatus, digest, open_tasks, status, to_table};
pub use task::{Ended, Made, TaskResult, WorkError, run_task};

use crate::files::WriteError;
use crate::report::ReportError;
use crate::run_folder::OutputError;

/// Exit status of a task that can go on: it was interrupted, or another process has it (`EX_TEMPFAIL`).
pub const AGAIN: u8 = 75;
/// Exit status of a task that fails each time: its input or the program is not the plan's (`EX_DATAERR`).
pub const NEVER_AGAIN: u8 = 65;
/// Exit status of a task that failed for another cause.
pub const FAILED: u8 = 1;
/// Exit status of a merge with holes that were allowed.
pub const WITH_HOLES: u8 = 3;

/// A plan or a task that cannot go on.
#[derive(Debug, thiserror::Error)]
pub enum JobError {
    /// A file of the plan cannot be read.
    #[error("cannot read {path}: {source}; give the folder of a plan, as bench sweep --plan makes it")]
    Read {
        /// The file.
        path: PathBuf,
        /// The cause.
        source: std::io::Error,
    },
    /// A file of the plan does not parse.
    #[error("{path} is damaged ({reason}); {advice}")]
    Damaged {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        reason: String,
        /// What to do.
        advice: &'static str,
    },
    /// Another version wrote the plan.
    #[error("{path} was written by keysplat {then}, and this is {now}; run it with that version, or plan anew")]
    Version {
        /// The plan.
        path: PathBuf,
        /// Version that planned.
        then: String,
        /// This version.
        now: String,
    },
    /// The folder has a plan already.
    #[error("{folder} holds another plan; choose another folder, or remove it")]
    AnotherPlan {
        /// The folder.
        folder: PathBuf,
    },
    /// The plan has fewer tasks.
    #[error("there is no task {task} in {plan}: its tasks are 0 to {last}")]
    NoTask {
        /// Requested task.
        task: usize,
        /// The plan's folder.
        plan: PathBuf,
        /// Number of the last task.
        last: usize,
    },
    /// An input is not what it was.
    #[error("{path} {reason}; put it back as it was, or plan anew")]
    Input {
        /// The file or folder.
        path: PathBuf,
        /// What changed.
        reason: String,
    },
    /// Another process works on the task.
    #[error("another process works on the task in {folder}; run it again later")]
    Busy {
        /// The task's folder.
        folder: PathBuf,
    },
    /// Several attempts brought the task no further.
    #[error(
        "{tries} attempts ended without a result or a new checkpoint in {folder}; give the task more time or memory, or see its log"
    )]
    NoProgress {
        /// The task's folder.
        folder: PathBuf,
        /// Number of attempts.
        tries: usize,
    },
    /// The task was interrupted.
    #[error("interrupted; run the task in {folder} again, and it goes on from its checkpoint")]
    Interrupted {
        /// The task's folder.
        folder: PathBuf,
    },
    /// The task's work failed.
    #[error("{reason}")]
    Work {
        /// The cause, and what to do.
        reason: String,
        /// Whether it fails each time.
        is_bad_input: bool,
    },
    /// A folder cannot be created, renamed or removed.
    #[error("cannot {action} {path}: {source}; check the disk and the path")]
    Folder {
        /// What was tried.
        action: &'static str,
        /// The folder.
        path: PathBuf,
        /// The cause.
        source: std::io::Error,
    },
    /// Tasks without a result.
    #[error("{holes}\n{count} of {tasks} tasks of {plan} have no result; run them, or merge the others with --allow-holes")]
    Holes {
        /// One line a hole.
        holes: String,
        /// Number of holes.
        count: usize,
        /// Number of tasks.
        tasks: usize,
        /// The plan's folder.
        plan: PathBuf,
    },
    /// An engine's command failed.
    #[error("{command} failed: {reason}")]
    Engine {
        /// The command.
        command: String,
        /// What it printed, or why it did not start.
        reason: String,
    },
    /// The table cannot be made.
    #[error(transparent)]
    Report(#[from] ReportError),
    /// A lock cannot be taken.
    #[error(transparent)]
    Output(#[from] OutputError),
    /// A file cannot be written.
    #[error(transparent)]
    Write(#[from] WriteError),
}

impl JobError {
    /// Exit status of a process that ends with it.
    pub fn exit_status(&self) -> u8 {
        match self {
            Self::Busy { .. } | Self::Interrupted { .. } => AGAIN,
            Self::Read { .. } | Self::Damaged { .. } | Self::Version { .. } | Self::NoTask { .. } | Self::Input { .. } => {
                NEVER_AGAIN
            }
            Self::Work { is_bad_input: true, .. } => NEVER_AGAIN,
            _ => FAILED,
        }
    }
}
