//! Errors of a mesh against a true surface: in the truth's world at once, or led there by the run that the mesh is of.

use std::path::{Path, PathBuf};

use serde::Serialize;

use super::SessionError;
use super::evaluate::{EvaluateOptions, read_trajectory, resolve};
use crate::evaluation::{Alignment, evaluate_trajectory};
use crate::geometry::{Pinhole, Se3, Sim3, Trajectory};
use crate::mesh::{DepthErrors, Mesh, MeshError, MeshErrors, compare, compare_depth, refine_alignment};
use crate::recording::Recording;
use crate::run_folder::outputs;

/// Depth is compared from so many poses, spread evenly.
const DEPTH_VIEWS: usize = 100;

/// How a mesh is led to the truth.
#[derive(Clone, Debug, Default)]
pub struct MeshTruthOptions {
    /// Folder of the run that the mesh is of; without it the mesh is in the truth's world.
    pub run: Option<PathBuf>,
    /// The recording, where the folder does not name it or it has moved.
    pub sequence: Option<PathBuf>,
    /// Whether the alignment is refined by ICP, as NICE-SLAM does.
    pub refine: bool,
}

/// All errors of a mesh.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct MeshReport {
    /// Distances.
    #[serde(flatten)]
    pub errors: MeshErrors,
    /// Depth from poses of the run.
    pub depth: Option<DepthErrors>,
    /// By how much ICP moved the mesh, metres at the world's origin.
    pub refined_by_m: Option<f64>,
}

/// Compares a mesh with a true surface.
///
/// # Errors
/// If the run's trajectory cannot be aligned with its recording's truth, or one of the surfaces has no area.
pub fn evaluate_mesh(mesh: Mesh, truth: &Mesh, options: &MeshTruthOptions) -> Result<MeshReport, SessionError> {
    let run = options.run.as_deref().map(|folder| Run::open(folder, options)).transpose()?;
    let mut truth_from_mesh = run.as_ref().map_or_else(Sim3::identity, |run| run.truth_from_run);
    let mut refined_by_m = None;
    if options.refine {
        let step = refine_alignment(&mesh.clone().moved(&truth_from_mesh), truth);
        refined_by_m = Some(step.translation.norm());
        truth_from_mesh = step * truth_from_mesh;
    }
    let mesh = mesh.moved(&truth_from_mesh);
    let errors = compare(&mesh, truth).ok_or(MeshError::NoArea)?;
    let depth = run.and_then(|run| compare_depth(&mesh, truth, &run.pinhole, &run.cameras(&truth_from_mesh)));
    Ok(MeshReport { errors, depth, refined_by_m })
}

/// Where the cameras of a run were.
struct Run {
    pinhole: Pinhole,
    trajectory: Trajectory,
    truth_from_run: Sim3,
}

impl Run {
    fn open(folder: &Path, options: &MeshTruthOptions) -> Result<Self, SessionError> {
        let config = resolve(folder, &EvaluateOptions { sequence: options.sequence.clone(), ..EvaluateOptions::default() })?;
        let recording = Recording::open(config)?;
        let sequence = recording.sequence();
        let trajectory = read_trajectory(&folder.join(outputs::TRAJECTORY))?;
        let no_truth = |reason: String| SessionError::NoAlignment { folder: folder.into(), reason };
        let truth = sequence.groundtruth.as_ref().ok_or_else(|| no_truth("its recording has no ground truth".into()))?;
        let errors = evaluate_trajectory(truth, &trajectory, Alignment::of(sequence.sensor.kind()));
        let truth_from_run = errors.map_err(|error| no_truth(error.to_string()))?.alignment;
        Ok(Self { pinhole: recording.map_pinhole(), trajectory, truth_from_run })
    }

    /// Some of the poses, in the truth's world.
    fn cameras(&self, truth_from_mesh: &Sim3) -> Vec<Se3> {
        let poses = &self.trajectory.poses;
        let every = poses.len().div_ceil(DEPTH_VIEWS).max(1);
        let moved = |pose: &Se3| {
            let centre = truth_from_mesh.act(&pose.translation.vector.into());
            Se3::from_parts(centre.coords.into(), truth_from_mesh.rotation * pose.rotation)
        };
        poses.iter().step_by(every).map(|pose| moved(&pose.world_from_camera)).collect()
    }
}
