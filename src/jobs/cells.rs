//! The cells of a large map, refined apart from each other, and the map that they make together.

use std::fmt::Write;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use serde::{Deserialize, Serialize};

use super::input::create_folder;
use super::merge::read;
use super::task::result_folder;
use super::{CellTask, JobError, Plan, Work};
use crate::export::MapFormat;
use crate::files::write_atomically;
use crate::geometry::{Se3, Trajectory};
use crate::partition::Place;
use crate::run_folder::outputs;
use crate::splat::GaussianCloud;

/// Folder of the merged map in a plan: a run's folder, which the commands on finished runs take.
const MERGED: &str = "merged";

/// Figures of a refined cell.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct CellRow {
    /// Keyframes that see it.
    pub keyframes: usize,
    /// Optimisation steps.
    pub steps: usize,
    /// Gaussians in its box afterwards.
    pub gaussians: usize,
    /// Wall-clock time, seconds.
    pub wall_s: f64,
}

impl CellRow {
    /// Its file in a task's folder.
    pub const FILE: &str = "cell.json";
}

/// Writes the run with the refined cells in the place of its own, and one table. A cell without a result keeps the run's Gaussians.
pub(super) fn merge(plan: &Plan, done: &[usize]) -> Result<String, JobError> {
    let cells: Vec<(usize, &CellTask)> = plan.tasks.iter().enumerate().filter_map(of_cell).collect();
    let Some((number, first)) = cells.first() else { return Ok(String::new()) };
    let is_done: Vec<bool> = cells.iter().map(|(number, _)| done.contains(number)).collect();
    let run = plan.folder().join(&first.run);
    // The cells are of the map that was planned.
    plan.verify_inputs(plan.task(*number)?)?;
    let (whole, format) = map_of(&run)?;
    let mut table = String::from("| cell | keyframes | steps | Gaussians before | after | s |\n|---|---|---|---|---|---|\n");
    let owner = |i: usize| cells.iter().position(|(_, cell)| cell.region.place(whole.means[i]) == Place::Core);
    let owners: Vec<Option<usize>> = (0..whole.len()).map(owner).collect();
    let mut merged = whole.picked((0..whole.len()).filter(|i| owners[*i].is_none_or(|cell| !is_done[cell])));
    for (cell, (number, _)) in cells.iter().enumerate() {
        let name = &plan.task(*number)?.name;
        let before = owners.iter().filter(|owner| **owner == Some(cell)).count();
        if !is_done[cell] {
            let _ = writeln!(table, "| {name} | | | {before} | as before | |");
            continue;
        }
        let folder = result_folder(plan, *number);
        let row: CellRow = read(&folder.join(CellRow::FILE))?;
        let (core, _) = map_of(&folder)?;
        // Options of the plan may have given the cells another degree.
        (0..core.len()).for_each(|i| merged.push(core.get(i)));
        let CellRow { keyframes, steps, gaussians, wall_s } = row;
        let _ = writeln!(table, "| {name} | {keyframes} | {steps} | {before} | {gaussians} | {wall_s:.1} |");
    }
    let folder = plan.folder().join(MERGED);
    create_folder(&folder)?;
    // Figures there may be of another map.
    let _ = std::fs::remove_file(folder.join(outputs::METRICS));
    for name in [outputs::CONFIG, outputs::TRAJECTORY, outputs::KEYFRAMES, outputs::EXPOSURES] {
        copy(&run.join(name), &folder.join(name))?;
    }
    let merged = outputs::write_map(&folder, format, &Arc::new(merged), &poses(&run.join(outputs::KEYFRAMES)))?;
    let _ = writeln!(table, "\n{} Gaussians in {}", merged.cloud.len(), folder.display());
    Ok(table)
}

fn of_cell((number, task): (usize, &super::Task)) -> Option<(usize, &CellTask)> {
    match &task.work {
        Work::Cell(cell) => Some((number, cell)),
        _ => None,
    }
}

fn map_of(folder: &Path) -> Result<(GaussianCloud, MapFormat), JobError> {
    let missing = || std::io::Error::from(std::io::ErrorKind::NotFound);
    let none = || JobError::Read { path: folder.join(outputs::map_name(Default::default())), source: missing() };
    let (path, format) = outputs::find_map(folder).ok_or_else(none)?;
    let advice = "put it back as it was, or plan anew";
    let map = format.read(&path).map_err(|error| JobError::Damaged { path: path.clone(), reason: error.to_string(), advice })?;
    Ok((map, format))
}

fn poses(path: &Path) -> Vec<Se3> {
    let trajectory = Trajectory::read_tum(path).unwrap_or_default();
    trajectory.poses.iter().map(|pose| pose.world_from_camera).collect()
}

/// A file that may be missing.
fn copy(from: &Path, to: &Path) -> Result<(), JobError> {
    match std::fs::read(from) {
        Ok(bytes) => Ok(write_atomically(to, &bytes)?),
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => Ok(()),
        Err(source) => Err(JobError::Read { path: PathBuf::from(from), source }),
    }
}
