//! `plan.json`: the tasks, with arguments, inputs and seeds, and the versions of format and program.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use super::input::create_folder;
use super::{Input, JobError};
use crate::evaluation::sha256_hex;
use crate::files::write_durably;
use crate::partition::Region;
use crate::sequence::SensorKind;

/// Version of the format.
const FORMAT: u32 = 1;
const VERSION: &str = env!("CARGO_PKG_VERSION");
/// Name of a plan in its folder.
const PLAN: &str = "plan.json";
const TASKS: &str = "tasks";

/// Independent tasks, and what all of them share.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Plan {
    format: u32,
    version: String,
    /// Relative paths in the arguments of tasks begin here.
    pub working_folder: PathBuf,
    /// What tasks read.
    pub inputs: Vec<Input>,
    /// The tasks; their numbers are their places.
    pub tasks: Vec<Task>,
    /// The plan's own folder, absolute.
    #[serde(skip)]
    folder: PathBuf,
}

/// One task: a process that reads its inputs and makes one result.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Task {
    /// Name for people.
    pub name: String,
    /// Seed of what is random in it.
    pub seed: u64,
    /// Inputs that it reads, as places in [`Plan::inputs`].
    pub inputs: Vec<usize>,
    /// What it does.
    pub work: Work,
}

/// The kinds of tasks, with their arguments.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Work {
    /// A whole run: one row of `bench sweep`.
    Run(RunTask),
    /// A replay by the tracker: one row of `bench track`.
    Replay(ReplayTask),
    /// The refinement of one cell of a large map.
    Cell(CellTask),
}

/// Arguments of a cell's refinement.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CellTask {
    /// Folder of the run; a relative path begins at the plan's folder.
    pub run: PathBuf,
    /// The recording; a relative path begins at the plan's folder.
    pub recording: PathBuf,
    /// The cell.
    pub region: Region,
    /// Options of `keysplat run --refine`.
    pub options: Vec<String>,
}

/// Arguments of a run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RunTask {
    /// Name of the recording.
    pub sequence: String,
    /// Name of the preset or variant.
    pub variant: String,
    /// The recording; a relative path begins at the plan's folder.
    pub recording: PathBuf,
    /// Options of `keysplat run`.
    pub options: Vec<String>,
}

/// Arguments of a replay.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ReplayTask {
    /// Name of the recording, with the sensor if not all of it is used.
    pub name: String,
    /// The recording; a relative path begins at the plan's folder.
    pub recording: PathBuf,
    /// Sensor of which the recording's data is used: all of it by default.
    pub sensor: Option<SensorKind>,
    /// Name of the settings.
    pub variant: String,
    /// The settings, `KEY=VALUE`.
    pub settings: Vec<String>,
    /// First frame, in the order of the recording; seed of the frames that are missing.
    pub start: usize,
    /// Whether frames come in reverse.
    pub backwards: bool,
    /// Stride.
    pub every: usize,
    /// Share of frames that are missing, percent.
    pub missing_percent: u32,
    /// Frames, at most.
    pub most: Option<usize>,
}

/// A plan in the making.
#[derive(Debug)]
pub struct Draft(Plan);

impl Draft {
    /// Begins a plan in `folder`. Relative paths in the arguments of its tasks begin at the current folder.
    ///
    /// # Errors
    /// If the folder cannot be created, or the current one is gone.
    pub fn new(folder: &Path) -> Result<Self, JobError> {
        let here = |source| JobError::Folder { action: "find", path: folder.into(), source };
        let folder = std::path::absolute(folder).map_err(here)?;
        create_folder(&folder)?;
        let working_folder = std::env::current_dir().map_err(here)?;
        Ok(Self(Plan { format: FORMAT, version: VERSION.into(), working_folder, inputs: Vec::new(), tasks: Vec::new(), folder }))
    }

    /// Adds a file or a folder that tasks read, once; returns its number.
    ///
    /// # Errors
    /// If it cannot be read.
    pub fn input(&mut self, path: &Path) -> Result<usize, JobError> {
        let path = self.place(path)?;
        if let Some(number) = self.0.inputs.iter().position(|input| input.path == path) {
            return Ok(number);
        }
        self.0.inputs.push(Input::measure(&self.0.folder, path)?);
        Ok(self.0.inputs.len() - 1)
    }

    /// A path as tasks store it: relative where it lies in the plan, so that a plan can move, else absolute.
    ///
    /// # Errors
    /// If the current folder is gone.
    pub fn place(&self, path: &Path) -> Result<PathBuf, JobError> {
        let absolute =
            std::path::absolute(path).map_err(|source| JobError::Folder { action: "find", path: path.into(), source })?;
        Ok(absolute.strip_prefix(&self.0.folder).map(Path::to_owned).unwrap_or(absolute))
    }

    /// Adds a task.
    pub fn task(&mut self, task: Task) {
        self.0.tasks.push(task);
    }

    /// Writes the plan, last of all its files. The same plan may be written again.
    ///
    /// # Errors
    /// If the folder holds another plan, or cannot be written to.
    pub fn finish(self) -> Result<Plan, JobError> {
        let Self(plan) = self;
        if plan.folder.join(PLAN).exists() {
            let same = Plan::read(&plan.folder).is_ok_and(|there| there == plan);
            return if same { Ok(plan) } else { Err(JobError::AnotherPlan { folder: plan.folder }) };
        }
        let text = serde_json::to_string_pretty(&plan).expect("a plan is text and numbers");
        write_durably(&plan.folder.join(PLAN), text.as_bytes())?;
        Ok(plan)
    }
}

impl Plan {
    /// Reads the plan in a folder.
    ///
    /// # Errors
    /// If there is none, it is damaged, or another version wrote it.
    pub fn read(folder: &Path) -> Result<Self, JobError> {
        let path = folder.join(PLAN);
        let cannot_read = |source| JobError::Read { path: path.clone(), source };
        let text = std::fs::read_to_string(&path).map_err(cannot_read)?;
        let damaged = |e: serde_json::Error| JobError::Damaged { path: path.clone(), reason: e.to_string(), advice: "plan anew" };
        // The version first: another one may have other fields.
        let head: serde_json::Value = serde_json::from_str(&text).map_err(damaged)?;
        let then = head["version"].as_str().unwrap_or("of another kind").to_owned();
        if head["format"] != FORMAT || then != VERSION {
            return Err(JobError::Version { path, then, now: VERSION.into() });
        }
        let plan: Self = serde_json::from_value(head).map_err(damaged)?;
        Ok(Self { folder: std::path::absolute(folder).map_err(cannot_read)?, ..plan })
    }

    /// The plan's folder, absolute.
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// A task by its number.
    ///
    /// # Errors
    /// If there is none.
    pub fn task(&self, number: usize) -> Result<&Task, JobError> {
        let none = || JobError::NoTask { task: number, plan: self.folder.clone(), last: self.tasks.len().saturating_sub(1) };
        self.tasks.get(number).ok_or_else(none)
    }

    /// Folder of a task.
    pub fn task_folder(&self, number: usize) -> PathBuf {
        self.folder.join(TASKS).join(format!("{number:04}"))
    }

    /// Digest of all that a task's result depends on: its arguments, seed and inputs, and the version.
    pub(super) fn identity(&self, task: &Task) -> String {
        let inputs: Vec<&str> = task.inputs.iter().filter_map(|i| self.inputs.get(*i)).map(|i| i.sha256.as_str()).collect();
        let all = (&self.format, &self.version, &self.working_folder, task, inputs);
        sha256_hex(serde_json::to_string(&all).expect("a plan is text and numbers").as_bytes())
    }

    /// Verifies what a task reads.
    ///
    /// # Errors
    /// Names the first file that is not what it was.
    pub(super) fn verify_inputs(&self, task: &Task) -> Result<(), JobError> {
        task.inputs.iter().filter_map(|i| self.inputs.get(*i)).try_for_each(|input| input.verify(&self.folder))
    }
}
