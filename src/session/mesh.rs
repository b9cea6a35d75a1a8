//! The surface of a finished run: its views are rendered from the map, joined with what the sensor measured, and fused.

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use super::SessionError;
use super::evaluate::{earlier_metrics, nearest_frames, read_trajectory};
use crate::config::Config;
use crate::evaluation::metrics::DepthBiasFigures;
use crate::geometry::{Pinhole, Se3, StampedPose, Trajectory};
use crate::gpu::Gpu;
use crate::mesh::{DepthSource, DepthView, Mesh, MeshConfig, MeshError, fuse};
use crate::recording::{Recording, RecordingError};
use crate::render::{MapRenderer, Rendered};
use crate::run_folder::OutputError;
use crate::run_folder::outputs;
use crate::sequence::{RectifiedImage, Rectifiers, SequenceError};
use crate::splat::ViewCamera;
use crate::splat::model::Surface;

/// The map's depth is taken where it covers so much of a pixel.
const LEAST_ALPHA: f32 = 0.5;
/// Fewer pixels show no surface.
const LEAST_SCALE: f64 = 0.05;

/// What is fused, and how.
#[derive(Clone, Debug, Default)]
pub struct MeshOptions {
    /// Settings of the fusion.
    pub mesh: MeshConfig,
    /// Depth that is fused; by default the sensor's, and the map's where there is none.
    pub depth: Option<DepthSource>,
    /// How the map's depth is blended; by default as the run's configuration has it.
    pub map_depth: Option<MapDepth>,
    /// Every posed frame instead of the keyframes alone.
    pub all_frames: bool,
    /// Only every n-th of them; 0 and 1 take all.
    pub every: usize,
    /// Resolution of the views, as a share of the recorded one; the map's by default.
    pub scale: Option<f64>,
    /// The recording, where the folder does not name it or it has moved.
    pub sequence: Option<PathBuf>,
    /// Part of an adapter's name.
    pub adapter: Option<String>,
}

/// How a map's depth is blended.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum MapDepth {
    /// Expected depth of the Gaussians' centres.
    Centre,
    /// Expected depth of the Gaussians' planes.
    Plane,
    /// Depth of the plane behind which less than half of the light is left.
    Median,
}

impl MapDepth {
    /// That of a run's maps.
    fn of(config: Option<&Config>) -> Self {
        match config.map(|config| config.mapping.surface) {
            Some(Surface::Planar) => Self::Plane,
            Some(Surface::Volume) | None => Self::Centre,
        }
    }

    fn surface(self) -> Surface {
        match self {
            Self::Centre => Surface::Volume,
            Self::Plane | Self::Median => Surface::Planar,
        }
    }
}

/// A run's mesh.
#[derive(Clone, Debug)]
pub struct FusedMesh {
    /// The surface in the world of the run.
    pub mesh: Mesh,
    /// Views that were fused.
    pub views: usize,
    /// Views with depth of the sensor.
    pub measured: usize,
}

/// Fuses the views of a run's folder. `on_view` receives the number of views done and all, `on_stage` what follows.
///
/// # Errors
/// If the folder has no map or no poses, measured depth is asked for and there is none, the adapter fails, or there is no surface.
pub fn mesh_folder(
    folder: &Path,
    options: &MeshOptions,
    on_view: &dyn Fn(usize, usize),
    on_stage: &dyn Fn(&'static str),
) -> Result<FusedMesh, SessionError> {
    options.mesh.validate()?;
    if let Some(value) = options.scale.filter(|scale| !(LEAST_SCALE..=1.0).contains(scale)) {
        return Err(MeshError::Option { option: "scale", value, advice: "give a share from 0.05 to 1" }.into());
    }
    let missing = |name: &str, advice| SessionError::Missing { path: folder.join(name), advice };
    let (map, format) =
        outputs::find_map(folder).ok_or_else(|| missing("map.ply", "give the folder of a run, with a map and its poses"))?;
    let file = if options.all_frames { outputs::TRAJECTORY } else { outputs::KEYFRAMES };
    if !folder.join(file).is_file() {
        return Err(missing(file, "give the folder of a run; without keyframes.txt, --all-frames takes trajectory.txt"));
    }
    let poses = read_trajectory(&folder.join(file))?;
    let cloud = format.read(&map).map_err(OutputError::from)?;
    let config_file = folder.join(outputs::CONFIG);
    let config = if config_file.is_file() { Some(Config::read(&config_file).map_err(RecordingError::from)?) } else { None };
    let recording = open_recording(config.as_ref(), options)?;
    let sensor = recording.as_ref().map(|recording| Measured::new(recording, folder, options)).transpose()?;
    let pinhole = sensor.as_ref().map_or_else(Pinhole::assumed, |sensor| sensor.pinhole);
    let frames = frame_of_pose(recording.as_ref(), &poses);
    let gpu = Gpu::open(options.adapter.as_deref())?;
    let map_depth = options.map_depth.unwrap_or_else(|| MapDepth::of(config.as_ref()));
    let mut renderer = MapRenderer::new(&gpu, &cloud, map_depth.surface(), usize::MAX)?;
    let stamped: Vec<_> = poses.poses.iter().step_by(options.every.max(1)).collect();
    if stamped.is_empty() {
        return Err(missing(file, "it holds no pose; map the recording again"));
    }
    let bytes = stamped.len() as u64 * DepthView::bytes_of(&pinhole);
    if bytes >= options.mesh.max_memory_bytes {
        return Err(MeshError::TooManyViews { views: stamped.len(), needed_mib: bytes >> 20 }.into());
    }
    let (mut views, mut measured) = (Vec::new(), 0);
    let mut sensor = sensor.filter(|_| options.depth != Some(DepthSource::Rendered));
    for (done, pose) in stamped.iter().enumerate() {
        on_view(done, stamped.len());
        let camera = ViewCamera { pinhole, camera_from_world: pose.world_from_camera.inverse() };
        let rendered = renderer.render(&camera)?;
        let frame = frames.get(&pose.timestamp_s.to_bits());
        let image = sensor.as_mut().zip(frame).and_then(|(sensor, frame)| sensor.image(*frame));
        let depth = join(&rendered, image.as_ref(), options.depth, map_depth);
        measured += usize::from(image.is_some_and(|image| image.depth.is_some()));
        views.push(view(pinhole, pose.world_from_camera, &rendered, &depth));
    }
    if options.depth == Some(DepthSource::Measured) && measured == 0 {
        return Err(SessionError::NoMeasuredDepth { folder: folder.into() });
    }
    let count = views.len();
    Ok(FusedMesh { mesh: fuse(views, &options.mesh, on_stage)?, views: count, measured })
}

/// The recording that a folder or the options name. One that the folder names may have gone: the map's depth needs none.
fn open_recording(config: Option<&Config>, options: &MeshOptions) -> Result<Option<Recording>, SessionError> {
    let config = config.cloned();
    if let Some(path) = &options.sequence {
        let mut config = config.unwrap_or_default();
        config.sequence.get_or_insert_default().path.clone_from(path);
        return Ok(Some(Recording::open(config)?));
    }
    let recording =
        config.and_then(|config| Recording::open(config).map_err(|error| tracing::warn!("without the recording: {error}")).ok());
    Ok(recording)
}

/// What the sensor measured, without the lens and without the bias that the run found.
struct Measured<'a> {
    recording: &'a Recording,
    rectifiers: Rectifiers,
    pinhole: Pinhole,
    bias: Option<DepthBiasFigures>,
}

impl<'a> Measured<'a> {
    fn new(recording: &'a Recording, folder: &Path, options: &MeshOptions) -> Result<Self, SessionError> {
        let has_depth = options.depth != Some(DepthSource::Rendered);
        let scale = options.scale.unwrap_or(recording.config().map_scale);
        let pinhole = recording.sequence().camera.pinhole.scaled(scale);
        let bias = if has_depth { earlier_metrics(folder)?.and_then(|metrics| metrics.depth_bias) } else { None };
        Ok(Self { recording, rectifiers: Rectifiers::new(scale), pinhole, bias })
    }

    /// A frame's image, unless it cannot be read or has another camera.
    fn image(&mut self, frame: usize) -> Option<RectifiedImage> {
        let sequence = self.recording.sequence();
        let unread = |error: &SequenceError| tracing::warn!("frame {frame} is fused without measured depth: {error}");
        let loaded = sequence.load(frame).inspect_err(unread).ok()?;
        let mut image = self.rectifiers.of(sequence.camera_of(frame)).rectify(&loaded);
        if let (Some(depth), Some(bias)) = (&mut image.depth, self.bias) {
            let half = 0.5 * f64::from(depth.width);
            for (i, z) in depth.metres.iter_mut().enumerate().filter(|(_, z)| **z > 0.0) {
                let (x, y) = ((i as u32 % depth.width) as f64, (i as u32 / depth.width) as f64);
                let across = [(x - self.pinhole.cx) / half, (y - self.pinhole.cy) / half];
                let off = bias.offset_per_m + bias.tilt_x_per_m * across[0] + bias.tilt_y_per_m * across[1];
                let inverse = f64::from(*z).recip() - off;
                *z = if inverse > 0.0 { inverse.recip() as f32 } else { 0.0 };
            }
        }
        Some(image).filter(|image| image.pinhole == self.pinhole)
    }
}

/// Depth of each pixel, metres, 0 where nothing is known.
fn join(rendered: &Rendered, image: Option<&RectifiedImage>, source: Option<DepthSource>, map_depth: MapDepth) -> Vec<f32> {
    let of_map = |i: usize| match map_depth {
        _ if rendered.alpha(i) < LEAST_ALPHA => 0.0,
        MapDepth::Centre | MapDepth::Plane => rendered.expected_depth(i),
        MapDepth::Median => rendered.median_depth(i),
    };
    let of_sensor = |i: usize| image.and_then(|image| image.depth.as_ref()).map_or(0.0, |depth| depth.metres[i]);
    let pixel = |i: usize| match source.unwrap_or(DepthSource::Both) {
        DepthSource::Rendered => of_map(i),
        DepthSource::Measured => of_sensor(i),
        DepthSource::Both => Some(of_sensor(i)).filter(|z| *z > 0.0).unwrap_or_else(|| of_map(i)),
    };
    (0..rendered.transmittance.len()).map(pixel).collect()
}

fn view(pinhole: Pinhole, world_from_camera: Se3, rendered: &Rendered, depth: &[f32]) -> DepthView {
    let byte = |v: f32| (v.clamp(0.0, 1.0) * 255.0).round() as u8;
    let color = rendered.color_depth.iter().map(|p| [byte(p[0]), byte(p[1]), byte(p[2])]).collect();
    DepthView::new(pinhole, world_from_camera, depth, color)
}

/// The frame nearest to each pose of a trajectory, by the bits of the pose's time.
fn frame_of_pose(recording: Option<&Recording>, poses: &Trajectory) -> HashMap<u64, usize> {
    let Some(recording) = recording else { return HashMap::new() };
    let of_pose = |pose: &StampedPose| {
        let alone = Trajectory { poses: vec![*pose] };
        nearest_frames(recording.sequence(), &alone).first().map(|(frame, _)| (pose.timestamp_s.to_bits(), *frame))
    };
    poses.poses.iter().filter_map(of_pose).collect()
}
