//! A finished run's folder, or a map alone, as a board for viewers.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::{Arc, Mutex};

use serde::de::DeserializeOwned;

use super::board::{Board, Frames, History as Figures, put};
use super::delivery::Delivery;
use super::error::ViewError;
use super::packing::PackedMap;
use super::path::camera_path;
use super::pictures::RecordedImages;
use super::protocol::{CameraView, Command, Hello, KeyframeView, Outgoing, PROTOCOL, Phase, Statistics, ToViewer};
use super::server::Desk;
use crate::config::{Config, ConfigError};
use crate::evaluation::{Comparison, Metrics};
use crate::export::MapFormat;
use crate::geometry::Trajectory;
use crate::gpu::{Gpu, GpuError};
use crate::mapping::KeyframeReport;
use crate::recording::Recording;
use crate::render::{MapRenderer, Rendered};
use crate::run_folder::{History, outputs};
use crate::sequence::{RectifiedImage, SensorKind};
use crate::splat::model::Surface;
use crate::splat::{GaussianCloud, ViewCamera};

/// Poses of a path; longer ones are thinned.
const MOST_POSES: usize = 20_000;
/// The only one of files.
const REVISION: u64 = 1;

/// Files of a run, or a map alone, opened for viewing.
pub struct Finished {
    board: Arc<Board>,
    desk: Arc<FolderDesk>,
}

/// Answers viewers from files.
struct FolderDesk {
    cloud: Arc<GaussianCloud>,
    recording: Option<Recording>,
    images: Option<RecordedImages>,
    keyframes: Vec<KeyframeView>,
    adapter: Option<String>,
    renderer: Mutex<Option<MapRenderer<Arc<GaussianCloud>>>>,
}

impl Finished {
    /// Reads a run's folder, or a map.
    ///
    /// # Errors
    /// [`ViewError`] if there is nothing to show, or a file of the run is damaged.
    pub fn open(path: &Path) -> Result<Self, ViewError> {
        let nothing = || ViewError::Nothing { path: path.into() };
        if path.is_file() {
            let format = MapFormat::of_path(path).ok_or_else(nothing)?;
            let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
            return Ok(Self::new(Files { name, cloud: format.read(path)?, ..Files::default() }));
        }
        let (map, format) = outputs::find_map(path).ok_or_else(nothing)?;
        let mut files = Files { cloud: format.read(&map)?, ..Files::default() };
        files.read(path)?;
        if files.name.is_empty() {
            files.name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        }
        Ok(Self::new(files))
    }

    fn new(files: Files) -> Self {
        let images = files.recording.as_ref().filter(|r| RecordedImages::are_there(r)).map(RecordedImages::new);
        let board = Board::new(files.hello(images.is_some()));
        let keyframes = files.keyframe_views();
        put(&board.map, PackedMap::new(&files.cloud, REVISION, None));
        let loops = files.history.as_ref().map_or_else(Vec::new, |history| history.loops.clone());
        put(&board.frames, Frames { keyframes: keyframes.clone(), loops, current: None });
        put(&board.path, camera_path(&files.trajectory, files.comparison.as_ref(), MOST_POSES));
        board.statistics.store(Arc::new(files.statistics()));
        let adapter = files.recording.as_ref().and_then(|r| r.config().adapter.clone());
        let Files { cloud, recording, .. } = files;
        let desk = FolderDesk { cloud: Arc::new(cloud), recording, images, keyframes, adapter, renderer: Mutex::new(None) };
        Self { board: Arc::new(board), desk: Arc::new(desk) }
    }

    /// What a server shows.
    pub fn board(&self) -> Arc<Board> {
        self.board.clone()
    }

    /// What answers viewers.
    pub fn desk(&self) -> Arc<dyn Desk> {
        self.desk.clone()
    }

    /// All messages that a viewer gets, with the images of some keyframes: for a page that has no server.
    pub fn messages(&self, images: usize) -> Vec<Outgoing> {
        let hello = Hello { exact: false, images: false, ..self.board.hello.clone() };
        let mut messages = vec![Outgoing::text(&ToViewer::Hello(&hello))];
        let mut delivery = Delivery::default();
        while let Some(message) = delivery.next(&self.board) {
            messages.push(message);
            delivery.taken(REVISION);
        }
        messages.extend(self.keyframe_images(images));
        messages
    }

    /// The messages of the image of some keyframes, spread evenly; none where the recording is not there.
    fn keyframe_images(&self, most: usize) -> Vec<Outgoing> {
        let keyframes = &self.desk.keyframes;
        let count = most.min(keyframes.len());
        let chosen = (0..count).map(|k| keyframes[k * keyframes.len() / count].id);
        chosen.filter_map(|id| self.desk.keyframe(id).ok()).collect()
    }
}

/// What was read.
#[derive(Default)]
struct Files {
    name: String,
    cloud: GaussianCloud,
    recording: Option<Recording>,
    metrics: Option<Metrics>,
    history: Option<History>,
    comparison: Option<Comparison>,
    trajectory: Trajectory,
    keyframes: Trajectory,
}

impl Files {
    fn read(&mut self, folder: &Path) -> Result<(), ViewError> {
        let trajectory = |name: &str| {
            let path = folder.join(name);
            if path.is_file() { Trajectory::read_tum(&path) } else { Ok(Trajectory::default()) }
        };
        self.trajectory = trajectory(outputs::TRAJECTORY)?;
        self.keyframes = trajectory(outputs::KEYFRAMES)?;
        self.metrics = json(folder, outputs::METRICS);
        self.history = json(folder, outputs::HISTORY);
        self.comparison = json(folder, outputs::COMPARISON);
        self.name = self.metrics.as_ref().map_or_else(String::new, |metrics| metrics.sequence.clone());
        let config = folder.join(outputs::CONFIG);
        let recording = Config::read(&config).map_err(|error: ConfigError| error.to_string());
        let recording = recording.and_then(|config| Recording::open(config).map_err(|error| error.to_string()));
        self.recording = recording.inspect_err(|why| tracing::warn!("recorded images are not shown: {why}")).ok();
        Ok(())
    }

    fn hello(&self, images: bool) -> Hello {
        let sensor = self.metrics.as_ref().map(|metrics| metrics.sensor);
        let metric = sensor.is_some_and(|sensor| sensor != SensorKind::Mono);
        Hello {
            protocol: PROTOCOL,
            name: self.name.clone(),
            sensor: sensor.map(|sensor| sensor.to_string()),
            live: false,
            control: false,
            exact: true,
            images,
            units: if metric { "metres" } else { "arbitrary" },
            camera: self.recording.as_ref().map(|recording| CameraView::from(recording.map_pinhole())),
            frames: self.metrics.as_ref().map(|metrics| metrics.frames as usize),
        }
    }

    fn keyframe_views(&self) -> Vec<KeyframeView> {
        let entries = self.recording.as_ref().map(|recording| &recording.sequence().entries);
        let frame_at = |t: f64| {
            let entries = entries?;
            let after = entries.partition_point(|entry| entry.timestamp_s < t);
            let near = [after.checked_sub(1), Some(after)].into_iter().flatten().filter(|i| *i < entries.len());
            near.min_by(|a, b| (entries[*a].timestamp_s - t).abs().total_cmp(&(entries[*b].timestamp_s - t).abs()))
        };
        let view = |(place, pose): (usize, &crate::geometry::StampedPose)| KeyframeView {
            id: place,
            frame: frame_at(pose.timestamp_s).unwrap_or(place),
            t: pose.timestamp_s,
            pose: (&pose.world_from_camera).into(),
        };
        self.keyframes.poses.iter().enumerate().map(view).collect()
    }

    /// How the run went, keyframe by keyframe.
    fn statistics(&self) -> Figures {
        let mut figures = Figures::default();
        let Some(history) = &self.history else { return figures };
        let mut steps = 0;
        let frame_of: BTreeMap<usize, usize> = self.keyframe_views().iter().map(|view| (view.id, view.frame)).collect();
        for (k, record) in history.keyframes.iter().enumerate() {
            let KeyframeReport { iterations, gaussians, psnr_db, .. } = record.report;
            steps += iterations;
            let frame = frame_of.get(&k).copied().unwrap_or(k);
            let tracked =
                history.frames.binary_search_by_key(&frame, |tracked| tracked.frame).map(|place| &history.frames[place]);
            figures.push(Statistics {
                s: record.done_s,
                frames: frame + 1,
                keyframes: k + 1,
                gaussians,
                steps,
                psnr_db: (iterations > 0).then_some(psnr_db),
                frame_ms: tracked.ok().map(|tracked| tracked.times.total_ms()),
                step_ms: (iterations > 0).then(|| 1e3 * record.busy_s / iterations as f64),
                host_bytes: record.host_bytes,
                ..Statistics::default()
            });
        }
        if let Some((metrics, last)) = self.metrics.as_ref().zip(figures.newest().copied()) {
            let steps = metrics.mapping.as_ref().map_or(last.steps, |mapping| mapping.iterations as usize);
            let (s, frames) = (metrics.wall_s.unwrap_or(last.s).max(last.s), metrics.frames as usize);
            figures.push(Statistics { s, phase: Phase::Done, frames, gaussians: self.cloud.len(), steps, ..last });
        }
        figures
    }
}

/// A file of the run; `None` where it is missing or of another version, for the map can be shown without it.
fn json<T: DeserializeOwned>(folder: &Path, name: &str) -> Option<T> {
    let bytes = std::fs::read(folder.join(name)).ok()?;
    serde_json::from_slice(&bytes).inspect_err(|error| tracing::warn!("{name} is not used: {error}")).ok()
}

impl FolderDesk {
    fn open_renderer(&self) -> Result<MapRenderer<Arc<GaussianCloud>>, GpuError> {
        let gpu = Gpu::open(self.adapter.as_deref())?;
        MapRenderer::new(&gpu, self.cloud.clone(), Surface::Volume, usize::MAX)
    }
}

impl Desk for FolderDesk {
    fn recorded(&self, id: usize) -> Result<(usize, RectifiedImage), String> {
        let missing = "the recording of this run is not there";
        let (recording, images) = self.recording.as_ref().zip(self.images.as_ref()).ok_or(missing)?;
        let keyframe = self.keyframes.iter().find(|view| view.id == id).ok_or("there is no such keyframe")?;
        Ok((keyframe.frame, images.load(recording, keyframe.frame)?))
    }

    fn draw(&self, camera: &ViewCamera) -> Result<Rendered, String> {
        let mut renderer = self.renderer.lock().map_err(|_| "the rasterizer failed")?;
        if renderer.is_none() {
            *renderer = Some(self.open_renderer().map_err(|error| error.to_string())?);
        }
        let renderer = renderer.as_mut().expect("it was just opened");
        renderer.render(camera).map_err(|error| error.to_string())
    }

    fn control(&self, _: Command) {}
}
