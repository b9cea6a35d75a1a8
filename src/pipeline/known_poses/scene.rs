//! What is known of a scene before its first keyframe: points, where the frames see them, and how far away they are.
//!
//! The points come with the recording. Where it has neither points nor depth, they are triangulated from its frames.

use std::borrow::Cow;
use std::collections::{BTreeMap, HashSet};
use std::path::Path;
use std::sync::Arc;

use glam::Vec3;
use nalgebra::{Point3, Vector2, Vector3};
use rayon::prelude::*;

use super::refined::{Refined, core_of};
use crate::export::ExportFilter;
use crate::geometry::Se3;
use crate::mapping::{InitialMap, MappingConfig};
use crate::pipeline::{PipelineError, Progress};
use crate::recording::Recording;
use crate::run_folder::outputs;
use crate::sequence::{Frame, FrameEntry, KnownPoint, Sensor, SensorKind, SequenceError};
use crate::splat::{GaussianCloud, ViewCamera};
use crate::tracking::TrackingConfig;
use crate::tracking::structure::{PosedView, SeenPoint, triangulate_views};

/// Median depth for which the mapper's lengths are chosen, metres: that of a room.
const USUAL_DISTANCE_METRES: f64 = 2.0;
/// Cameras and points that are looked at for the scene's own distance: enough for a median.
const SAMPLED_CAMERAS: usize = 50;
const SAMPLED_POINTS: usize = 2000;
/// Frames that points are triangulated from, at most: a bound on memory and time.
const MOST_VIEWS: usize = 500;
/// Features of a frame, at least: photos are further apart than the frames that tracking matches, and share fewer.
const FEATURES: usize = 4000;
/// Noise of keypoints as a share of `tracking.pixel_sigma`, which allows for poses that are still to be found.
const PIXEL_SIGMA_SHARE: f64 = 0.5;
/// Frames decoded side by side.
const BATCH: usize = 8;
/// Triangulated points that are a scene.
const MIN_POINTS: usize = 50;

/// The scene of a recording with known poses.
#[derive(Debug)]
pub(in crate::pipeline) struct Scene<'a> {
    recording: &'a Recording,
    points: Cow<'a, [KnownPoint]>,
    /// By frame; none where the points came with the recording.
    seen: BTreeMap<usize, Vec<SeenPoint>>,
    /// What the map begins with instead of the points.
    initial_map: Option<InitialMap>,
    /// The run that is refined; its map is the initial one.
    refined: Option<Refined>,
    /// Median depth of the points in the cameras that have them in view, in the world's unit.
    distance: Option<f64>,
}

impl<'a> Scene<'a> {
    /// The scene of a recording. Frames are decoded for it only where there are neither points nor depth nor an initial map, whose centres
    /// are points as good.
    ///
    /// # Errors
    /// [`PipelineError::NoStructure`] if too few points can be triangulated; [`PipelineError::InitialMap`] if that cannot be read.
    pub fn new(recording: &'a Recording, progress: &Progress) -> Result<Self, PipelineError> {
        let sequence = recording.sequence();
        let mut scene = Self {
            recording,
            points: Cow::Borrowed(&sequence.points),
            seen: BTreeMap::new(),
            initial_map: None,
            refined: None,
            distance: None,
        };
        if let Some(refined) = &recording.config().refined {
            let refined = Refined::read(refined, initial_map(&refined.run, recording)?, recording)?;
            (scene.initial_map, scene.refined) = (Some(refined.map.clone()), Some(refined));
        } else if let Some(path) = &recording.config().initial_map {
            scene.initial_map = Some(InitialMap { cloud: initial_map(path, recording)?, frozen: 0 });
        }
        if let Some(map) = scene.initial_map.as_ref().filter(|_| sequence.points.is_empty()) {
            let point = |mean: &Vec3| KnownPoint { position: Vector3::from(mean.to_array().map(f64::from)), color: [0; 3] };
            scene.points = map.cloud.means.iter().map(point).collect();
        } else if sequence.sensor != Sensor::Rgbd && sequence.points.is_empty() {
            scene.seen = triangulate(recording, progress)?;
            let points = scene.seen.values().flatten();
            scene.points = points.map(|point| KnownPoint { position: point.position.coords, color: point.color }).collect();
            tracing::info!(points = scene.points.len(), views = scene.seen.len(), "triangulated");
            if scene.points.len() < MIN_POINTS && !progress.stopped() {
                return Err(PipelineError::NoStructure { name: sequence.name.clone(), points: scene.points.len() });
            }
        }
        scene.distance = scene.median_distance();
        Ok(scene)
    }

    /// What the map begins with instead of points.
    pub fn initial_map(&self) -> Option<InitialMap> {
        self.initial_map.clone()
    }

    /// The run that is refined.
    pub(super) fn refined(&self) -> Option<&Refined> {
        self.refined.as_ref()
    }

    /// What of the final map is the run's result: all of it, or a region's core.
    pub fn result_of(&self, map: Arc<GaussianCloud>) -> Arc<GaussianCloud> {
        let region = self.recording.config().refined.as_ref().and_then(|refined| refined.region);
        region.map_or_else(|| map.clone(), |region| Arc::new(core_of(&map, &region)))
    }

    /// The frames that have something for the mapper, ascending.
    pub fn frames(&self) -> Vec<usize> {
        let all = || (0..self.recording.sequence().entries.len()).collect();
        self.refined.as_ref().map_or_else(all, |refined| refined.keyframes.keys().copied().collect())
    }

    /// Median depth of what frames see, in the world's unit.
    pub fn distance(&self) -> f64 {
        self.distance.unwrap_or(USUAL_DISTANCE_METRES)
    }

    /// A mapper's configuration with its lengths in the world's unit: metres where the sensor is metric, else such that the points' median
    /// distance is that of a room.
    pub fn in_units(&self, mapping: &MappingConfig) -> MappingConfig {
        let is_metric = self.recording.sequence().sensor != Sensor::Mono;
        mapping.in_units(if is_metric { 1.0 } else { (self.distance() / USUAL_DISTANCE_METRES) as f32 })
    }

    /// Where a frame sees triangulated points: pixels of the distortion-free pinhole, depth along z.
    pub fn landmarks(&self, frame: usize) -> Vec<(Vector2<f64>, f64)> {
        self.seen.get(&frame).into_iter().flatten().map(|point| (point.pixel, point.depth)).collect()
    }

    fn median_distance(&self) -> Option<f64> {
        let sample = |len: usize, most: usize| (0..len).step_by(len.div_ceil(most).max(1));
        let cameras = cameras(self.recording);
        let mut depths = Vec::new();
        for camera in sample(cameras.len(), SAMPLED_CAMERAS).map(|i| &cameras[i]) {
            let points = sample(self.points.len(), SAMPLED_POINTS).map(|i| &self.points[i]);
            depths.extend(points.filter_map(|point| depth_in_view(camera, point)));
        }
        depths.sort_by(f64::total_cmp);
        depths.get(depths.len() / 2).copied()
    }

    /// The points that begin the map: of those that share a cube of `mapping.points.spacing_pixels` in the nearest view, the first. Denser
    /// ones would only cost time. Points that no frame sees are left out.
    pub fn thinned_points(&self) -> Vec<KnownPoint> {
        let config = self.recording.config();
        let cameras = cameras(self.recording);
        let spacing_pixels = f64::from(config.mapping.points.spacing_pixels) / config.map_scale;
        let cell = |point: &KnownPoint| {
            let pixel_size = |camera: &ViewCamera| Some(depth_in_view(camera, point)? / camera.pinhole.fx);
            let nearest = cameras.iter().filter_map(pixel_size).min_by(f64::total_cmp)?;
            // Sides are powers of two, so that cubes of like distances are the same ones.
            let level = (nearest * spacing_pixels).log2().round();
            Some((level as i64, point.position.map(|v| (v / level.exp2()).floor() as i64)))
        };
        let cells: Vec<Option<(i64, Vector3<i64>)>> = self.points.par_iter().map(cell).collect();
        let mut taken = HashSet::new();
        let first = |cell: Option<(i64, Vector3<i64>)>| cell.is_some_and(|cell| taken.insert(cell));
        let keep: Vec<bool> = cells.into_iter().map(first).collect();
        self.points.iter().zip(keep).filter(|(_, keep)| *keep).map(|(point, _)| *point).collect()
    }
}

/// The map of a file or of a run's folder: of more Gaussians than the mapper may have, those that cover most.
fn initial_map(path: &Path, recording: &Recording) -> Result<Arc<GaussianCloud>, PipelineError> {
    let (path, format) = outputs::find_map(path).ok_or_else(|| PipelineError::NoInitialMap { path: path.into() })?;
    let map = format.read(&path)?;
    if map.is_empty() {
        return Err(PipelineError::EmptyInitialMap { path });
    }
    let antialiased = recording.config().mapping.antialiased;
    if map.antialiased != antialiased {
        let path = path.display();
        tracing::warn!(
            "mapping.antialiased is {antialiased}, unlike in {path}: its opacities are wrong until steps correct them"
        );
    }
    let max_gaussians = recording.config().mapping.limits.max_gaussians;
    let map = ExportFilter { max_gaussians, ..ExportFilter::default() }.apply(&map);
    tracing::info!(gaussians = map.len(), "the map begins with that of {}", path.display());
    Ok(Arc::new(map))
}

/// The frames with a pose, at full size.
fn cameras(recording: &Recording) -> Vec<ViewCamera> {
    let sequence = recording.sequence();
    let camera = |(index, entry): (usize, &FrameEntry)| {
        let camera_from_world = recording.known_pose(entry.timestamp_s)?.inverse();
        Some(ViewCamera { pinhole: sequence.camera_of(index).pinhole, camera_from_world })
    };
    sequence.entries.iter().enumerate().filter_map(camera).collect()
}

/// Depth of a point that a camera has in view.
fn depth_in_view(ViewCamera { pinhole, camera_from_world }: &ViewCamera, point: &KnownPoint) -> Option<f64> {
    let p_in_camera = (camera_from_world * Point3::from(point.position)).coords;
    let seen = pinhole.project(&p_in_camera).is_some_and(|pixel| pinhole.contains(&pixel, 0.0));
    seen.then_some(p_in_camera.z)
}

/// Points that the frames which are not held out see, by frame. Frames that cannot be read are passed over here: the reader counts them.
fn triangulate(recording: &Recording, progress: &Progress) -> Result<BTreeMap<usize, Vec<SeenPoint>>, PipelineError> {
    let (sequence, config) = (recording.sequence(), recording.config());
    let posed = |(index, entry): (usize, &FrameEntry)| Some((index, recording.known_pose(entry.timestamp_s)?));
    let mut frames: Vec<(usize, Se3)> = sequence.entries.iter().enumerate().filter_map(posed).collect();
    frames.retain(|(index, _)| !config.replay.is_held_out(*index));
    let frames: Vec<(usize, Se3)> = frames.iter().step_by(frames.len().div_ceil(MOST_VIEWS).max(1)).copied().collect();
    let tracking = TrackingConfig {
        features: Some(config.tracking.features_kept(SensorKind::Mono).max(FEATURES)),
        pixel_sigma: PIXEL_SIGMA_SHARE * config.tracking.pixel_sigma,
        ..config.tracking.clone()
    };
    tracing::info!("no points: triangulating them from {} frames", frames.len());
    let (mut indices, mut views) = (Vec::new(), Vec::new());
    for batch in frames.chunks(BATCH).take_while(|_| !progress.stopped()) {
        let loaded = sequence.load_all(&batch.iter().map(|(index, _)| *index).collect::<Vec<usize>>());
        let view = |((index, world_from_camera), frame): (&(usize, Se3), Result<Frame, SequenceError>)| {
            let frame = frame.ok()?;
            Some((*index, PosedView::new(&frame, sequence.camera_of(*index), world_from_camera, &tracking)))
        };
        for (index, view) in batch.par_iter().zip(loaded).filter_map(view).collect::<Vec<_>>() {
            indices.push(index);
            views.push(view?);
        }
    }
    Ok(indices.into_iter().zip(triangulate_views(&views, &tracking)).collect())
}
