//! The results of all tasks as one table; every task without a result is named.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use serde::Serialize;

use super::slurm::SlurmState;
use super::task::{TaskResult, failure, result_folder};
use super::{JobError, Plan, Work, cells};
use crate::evaluation::{Metrics, sha256_hex};
use crate::files::write_atomically;
use crate::report::replays::{self, ReplayRow};
use crate::report::sweep::{self, Sweep, SweepRow};
use crate::run_folder::outputs;

/// Figures of the merge itself, beside the table.
const MERGE: &str = "merge.json";

/// A task without a result.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Hole {
    /// Number of the task.
    pub task: usize,
    /// Name of the task.
    pub name: String,
    /// Why it has none.
    pub reason: String,
}

/// What was merged: `merge.json`.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Merge {
    /// Number of tasks.
    pub tasks: usize,
    /// Tasks with a result.
    pub done: usize,
    /// Tasks without one.
    pub holes: Vec<Hole>,
    /// SHA-256 of the merged results without times.
    pub digest: String,
    /// The table in Markdown.
    #[serde(skip)]
    pub table: String,
}

/// Verifies all results and writes the table of `bench sweep` or `bench track`, or the map of all cells, and `merge.json`, into the plan's folder. `engine` has the
/// states that an engine reports.
///
/// # Errors
/// Names all holes unless they are allowed. If nothing is done, or a file cannot be read or written.
pub fn merge(plan: &Plan, engine: &BTreeMap<usize, SlurmState>, allow_holes: bool) -> Result<Merge, JobError> {
    let (mut done, mut holes, mut digests) = (Vec::new(), Vec::new(), String::new());
    for (number, task) in plan.tasks.iter().enumerate() {
        match TaskResult::verified(plan, number) {
            Ok(result) => {
                digests += &result.digest();
                done.push(number);
            }
            Err(reason) => {
                let ended = failure(plan, number).map(|failure| failure.reason);
                let ended = ended.or_else(|| Some(format!("{reason}; Slurm: {}", engine.get(&number)?)));
                holes.push(Hole { task: number, name: task.name.clone(), reason: ended.unwrap_or(reason) });
            }
        }
    }
    if !holes.is_empty() && (!allow_holes || done.is_empty()) {
        let lines: Vec<String> = holes.iter().map(Hole::to_string).collect();
        let (count, tasks, plan) = (holes.len(), plan.tasks.len(), plan.folder().to_owned());
        return Err(JobError::Holes { holes: lines.join("\n"), count, tasks, plan });
    }
    let table = write_tables(plan, &done, &holes)?;
    let merge = Merge { tasks: plan.tasks.len(), done: done.len(), holes, digest: sha256_hex(digests.as_bytes()), table };
    let text = serde_json::to_string_pretty(&merge).expect("it is text and numbers");
    write_atomically(&plan.folder().join(MERGE), text.as_bytes())?;
    Ok(merge)
}

fn write_tables(plan: &Plan, done: &[usize], holes: &[Hole]) -> Result<String, JobError> {
    let (mut runs, mut last, mut replays) = (Vec::new(), None, Vec::new());
    for &number in done {
        let task = plan.task(number)?;
        let folder = result_folder(plan, number);
        match &task.work {
            Work::Run(run) => {
                let metrics: Metrics = read(&folder.join(outputs::METRICS))?;
                runs.push(SweepRow::new(&run.sequence, &run.variant, task.seed, &metrics));
                last = Some(metrics);
            }
            Work::Cell(_) => {}
            Work::Replay(_) => replays.push(read::<ReplayRow>(&folder.join(ReplayRow::FILE))?),
        }
    }
    let mut table = cells::merge(plan, done)?;
    if let Some(metrics) = last {
        let holes = holes.iter().map(Hole::to_string).collect();
        table += &sweep::write(plan.folder(), &Sweep::of(runs, &metrics, holes))?;
    }
    if !replays.is_empty() {
        table += &replays::write(plan.folder(), &replays)?;
    }
    Ok(table)
}

pub(super) fn read<T: serde::de::DeserializeOwned>(path: &Path) -> Result<T, JobError> {
    let text = std::fs::read(path).map_err(|source| JobError::Read { path: path.into(), source })?;
    let damaged = |error: serde_json::Error| {
        let advice = "remove the folder and run its task again";
        JobError::Damaged { path: PathBuf::from(path), reason: error.to_string(), advice }
    };
    serde_json::from_slice(&text).map_err(damaged)
}

impl std::fmt::Display for Hole {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "hole: task {} ({}): {}", self.task, self.name, self.reason)
    }
}
