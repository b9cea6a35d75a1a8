//! A finished run as cells that are refined apart from each other.

use std::path::{Path, PathBuf};

use glam::Vec3;

use super::SessionError;
use super::evaluate::{nearest_frames, read_trajectory};
use crate::config::Config;
use crate::geometry::Se3;
use crate::partition::{Place, Region, cameras_that_see, cells};
use crate::recording::{Recording, RecordingError};
use crate::run_folder::outputs;
use crate::splat::ViewCamera;

/// How a run is divided.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SplitOptions {
    /// Largest extent of the cameras in a cell, metres.
    pub size: f32,
    /// Width of a cell's surroundings that are refined with it, metres.
    pub halo: f32,
    /// Most Gaussians of a cell.
    pub max_gaussians: usize,
}

/// A cell of a run.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Cell {
    /// Its box and its halo.
    pub region: Region,
    /// Gaussians in the box.
    pub gaussians: usize,
    /// Keyframes that see it.
    pub keyframes: usize,
}

/// A run and its cells.
#[derive(Clone, Debug)]
pub struct Split {
    /// The run's folder, absolute.
    pub run: PathBuf,
    /// The run's recording.
    pub recording: PathBuf,
    /// Files of the run that a refinement reads.
    pub files: Vec<PathBuf>,
    /// The cells that keyframes see. Gaussians in no cell stay as they are.
    pub cells: Vec<Cell>,
}

/// Divides the map of a finished run.
///
/// # Errors
/// If a file of the run is missing or does not parse, its recording cannot be opened, or no keyframe sees its map.
pub fn split_run(run: &Path, options: &SplitOptions) -> Result<Split, SessionError> {
    let config = Config::refining(run).map_err(RecordingError::from)?;
    let run = config.refined.as_ref().map_or_else(|| run.to_owned(), |refined| refined.run.clone());
    let recording = Recording::open(config)?;
    let missing = |name: &str| SessionError::Missing { path: run.join(name), advice: "give the folder of a finished run" };
    let (map_file, format) = outputs::find_map(&run).filter(|_| run.is_dir()).ok_or_else(|| missing("map.ply"))?;
    let map = format.read(&map_file).map_err(outputs::OutputError::from)?;
    let sequence = recording.sequence();
    let keyframes = nearest_frames(sequence, &read_trajectory(&run.join(outputs::KEYFRAMES))?);
    let camera = |(frame, world_from_camera): &(usize, Se3)| ViewCamera {
        pinhole: recording.map_pinhole_of(*frame),
        camera_from_world: world_from_camera.inverse(),
    };
    let cameras: Vec<ViewCamera> = keyframes.iter().map(camera).collect();
    let position =
        |camera: &ViewCamera| Vec3::from(camera.camera_from_world.inverse().translation.vector.map(|v| v as f32).data.0[0]);
    let positions: Vec<Vec3> = cameras.iter().map(position).collect();
    let regions = cells(&map.means, &positions, (options.size, options.max_gaussians), options.halo);
    let seen = cameras_that_see(&map, &regions, &cameras);
    let cell = |(region, keyframes): (Region, usize)| {
        let gaussians = map.means.iter().filter(|mean| region.place(**mean) == Place::Core).count();
        Cell { region, gaussians, keyframes }
    };
    let cells: Vec<Cell> = regions.into_iter().zip(seen).filter(|(_, seen)| *seen > 0).map(cell).collect();
    if cells.is_empty() {
        return Err(SessionError::NothingSeen { run });
    }
    let own = [outputs::CONFIG, outputs::TRAJECTORY, outputs::KEYFRAMES, outputs::EXPOSURES].map(|name| run.join(name));
    let files = own.into_iter().chain([map_file]).filter(|file| file.is_file()).collect();
    let recording = recording.config().sequence.clone().unwrap_or_default().path;
    Ok(Split { run, recording, files, cells })
}
