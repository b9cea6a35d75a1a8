//! What is done, what waits, what runs and what failed, from the files of a plan and the states of an engine.

use std::collections::BTreeMap;
use std::fmt::Write;

use serde::Serialize;

use super::Plan;
use super::slurm::SlurmState;
use super::task::{TaskResult, attempts, failure};
use crate::evaluation::sha256_hex;
use crate::run_folder::FolderLock;

/// State of a task.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum State {
    /// Its result is there.
    Done,
    /// It has not begun, or was interrupted and can go on.
    Waiting,
    /// A process works on it.
    Running,
    /// It ended without a result, and no process will take it up by itself.
    Failed,
}

/// A task with its state.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct TaskStatus {
    /// Number of the task.
    pub task: usize,
    /// Name of the task.
    pub name: String,
    /// Its state.
    pub state: State,
    /// Why it is in this state, where there is more to say.
    pub reason: String,
}

/// The states of all tasks. `engine` has those that an engine reports.
pub fn status(plan: &Plan, engine: &BTreeMap<usize, SlurmState>) -> Vec<TaskStatus> {
    let tasks = plan.tasks.iter().enumerate();
    let one = |(number, task): (usize, &super::Task)| {
        let (state, reason) = state(plan, number, engine.get(&number));
        TaskStatus { task: number, name: task.name.clone(), state, reason }
    };
    tasks.map(one).collect()
}

/// The tasks whose result is missing or damaged.
pub fn open_tasks(plan: &Plan) -> Vec<usize> {
    (0..plan.tasks.len()).filter(|number| TaskResult::verified(plan, *number).is_err()).collect()
}

fn state(plan: &Plan, number: usize, engine: Option<&SlurmState>) -> (State, String) {
    if TaskResult::find(plan, number).is_some() {
        return (State::Done, String::new());
    }
    if FolderLock::is_held(&plan.task_folder(number)) {
        return (State::Running, engine.map_or_else(String::new, SlurmState::to_string));
    }
    match (failure(plan, number), engine) {
        (_, Some(state)) if state.is_waiting() => (State::Waiting, state.to_string()),
        (_, Some(state)) if state.is_running() => (State::Running, state.to_string()),
        (Some(failure), _) => (State::Failed, format!("{} (status {})", failure.reason, failure.status)),
        (None, Some(state)) => (State::Failed, format!("Slurm ended it: {state}")),
        (None, None) if attempts(plan, number) > 0 => (State::Waiting, "interrupted".into()),
        (None, None) => (State::Waiting, String::new()),
    }
}

/// Digest of all results without times; `None` while one is missing.
pub fn digest(plan: &Plan) -> Option<String> {
    let all: Option<String> = (0..plan.tasks.len()).map(|number| Some(TaskResult::find(plan, number)?.digest())).collect();
    Some(sha256_hex(all?.as_bytes()))
}

/// The states as a table in Markdown, with their counts below.
pub fn to_table(all: &[TaskStatus]) -> String {
    let mut table = String::from("| task | name | state | |\n|---|---|---|---|\n");
    for TaskStatus { task, name, state, reason } in all {
        let reason = reason.replace('\n', " ").replace('|', "\\|");
        let _ = writeln!(table, "| {task} | {name} | {} | {reason} |", state.name());
    }
    let count = |state| all.iter().filter(|task| task.state == state).count();
    let counts =
        [State::Done, State::Waiting, State::Running, State::Failed].map(|state| format!("{} {}", count(state), state.name()));
    table + "\n" + &counts.join(", ") + "\n"
}

impl State {
    fn name(self) -> &'static str {
        match self {
            Self::Done => "done",
            Self::Waiting => "waiting",
            Self::Running => "running",
            Self::Failed => "failed",
        }
    }
}
