//! Synthetic recordings: a furnished, textured room or a building of them, ray-cast along a hand-held camera's path with exact poses, written with
//! depth in TUM's layout or as a stereo pair in KITTI's.
//!
//! `config` says what a scene is; `building`, `room` and `furniture` build it, `light` and `surface` bake how it looks, `path` and
//! `walk` move the camera, `render` casts the rays, `degrade` is the sensor. It leaves out: mirrors and glass, deforming things, rolling
//! shutter, and shadows of the moving object.

mod building;
#[cfg(test)]
mod building_tests;
mod bvh;
mod config;
mod degrade;
mod exact;
mod furniture;
mod light;
mod noise;
mod path;
mod render;
mod room;
mod shapes;
mod surface;
#[cfg(test)]
mod tests;
mod texture;
mod view;
mod walk;
mod write;

use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};

use glam::{DVec2, Vec3};
use rayon::prelude::*;
use sha2::{Digest, Sha256};

use crate::geometry::{Camera, Distortion, Pinhole, Se3, StampedPose, Trajectory};

pub use config::{CameraConfig, DegradationConfig, FurnitureConfig, PathConfig, PathKind, RoomConfig, SceneConfig, StereoConfig};
pub use exact::visible_surface;

use building::Rooms;
use light::Scene;
use path::CameraPath;
use render::{Moment, Rendered, Renderer};
use shapes::Primitive;

/// Part of [`SceneConfig::digest`]; raise it when the same scene would render differently.
const RENDERER_VERSION: u32 = 1;
/// Moments averaged over an exposure. Nine, so that each also takes its own place in a 3 x 3 grid of the pixel.
const BLUR_MOMENTS: usize = 9;
/// Poses of the path that furnishing looks at, for each room.
const PATH_SAMPLES: usize = 160;

/// A scene that cannot be rendered or written.
#[derive(Debug, thiserror::Error)]
pub enum SceneError {
    /// The scene file cannot be read.
    #[error("cannot read {path}: {source}")]
    Read {
        /// The file or folder.
        path: PathBuf,
        /// The cause.
        source: std::io::Error,
    },
    /// Not TOML, an unknown key, or a value of the wrong type.
    #[error("{path}: {source}")]
    Syntax {
        /// The file or folder.
        path: PathBuf,
        /// The cause.
        source: Box<toml::de::Error>,
    },
    /// An error in a scene file.
    #[error("{path}: {source}")]
    In {
        /// The file or folder.
        path: PathBuf,
        /// The cause.
        source: Box<SceneError>,
    },
    /// A value out of its range.
    #[error("`{field}` {what}")]
    Field {
        /// Key in the scene file.
        field: &'static str,
        /// What is wrong.
        what: String,
    },
    /// The rounds, or the rooms of a walk, need more frames.
    #[error(
        "`frames` is {frames}, too few for {rounds} {of} at the allowed pace; give at least {needed}, or raise `path.speed` and `path.turn_rate`"
    )]
    TooFewFrames {
        /// Rounds of the path, or rooms.
        rounds: u32,
        /// What is counted: rounds or rooms.
        of: &'static str,
        /// Frames of the scene.
        frames: usize,
        /// Value needed.
        needed: usize,
    },
    /// The room is full.
    #[error("`{field}`: there is no place for number {index}; ask for fewer pieces, a larger `room`, or another `seed`")]
    NoPlace {
        /// Key in the scene file.
        field: &'static str,
        /// Index in the map.
        index: usize,
    },
    /// The path comes too close to a surface.
    #[error(
        "frame {frame} would be {distance_metres:.2} m from a surface, nearer than {limit} m; enlarge the `room` or lower `path.shake_metres`",
        limit = room::MIN_CLEARANCE
    )]
    TooClose {
        /// Frame of the replay, from 0.
        frame: usize,
        /// Distance from the surface, metres.
        distance_metres: f64,
    },
    /// The output folder exists.
    #[error("{path} is there already; remove it or write elsewhere")]
    Exists {
        /// The file or folder.
        path: PathBuf,
    },
    /// A file cannot be written.
    #[error("cannot write {path}: {source}; check that the folder may be written and has space")]
    Write {
        /// The file or folder.
        path: PathBuf,
        /// The cause.
        source: std::io::Error,
    },
    /// An image cannot be encoded.
    #[error("cannot encode {path}: {source}")]
    Image {
        /// The file or folder.
        path: PathBuf,
        /// The cause.
        source: image::ImageError,
    },
}

impl SceneConfig {
    /// Reads and checks a scene file.
    ///
    /// # Errors
    /// [`SceneError`] if the file cannot be read or parsed, or a value is out of range.
    pub fn read(path: &Path) -> Result<Self, SceneError> {
        let text = std::fs::read_to_string(path).map_err(|source| SceneError::Read { path: path.into(), source })?;
        Self::parse(&text, path)
    }

    /// Parses and checks a scene; `path` is named in errors.
    ///
    /// # Errors
    /// As [`Self::read`], except for reading.
    pub fn parse(text: &str, path: &Path) -> Result<Self, SceneError> {
        let config: Self =
            toml::from_str(text).map_err(|source| SceneError::Syntax { path: path.into(), source: Box::new(source) })?;
        config.validate().map_err(|source| SceneError::In { path: path.into(), source: Box::new(source) })?;
        Ok(config)
    }

    /// The scene as a file, every field spelt out.
    pub fn to_toml(&self) -> String {
        toml::to_string(self).expect("a scene of numbers and names can be written")
    }

    /// Names what would be rendered: equal for scenes that give the same bytes. 64 hexadecimal digits.
    pub fn digest(&self) -> String {
        let mut hasher = Sha256::new();
        hasher.update(RENDERER_VERSION.to_le_bytes());
        hasher.update(self.to_toml());
        hasher.finalize().iter().map(|byte| format!("{byte:02x}")).collect()
    }

    fn camera(&self) -> Camera {
        let c = &self.camera;
        Camera {
            pinhole: Pinhole { fx: c.fx, fy: c.fy, cx: c.cx, cy: c.cy, width: c.width, height: c.height },
            distortion: Distortion { k1: c.k1, k2: c.k2, p1: c.p1, p2: c.p2, k3: 0.0 },
            depth_units_per_metre: degrade::DEPTH_UNITS_PER_METRE,
        }
    }
}

/// A furnished room or building and the way through it, checked, before anything is lit or rendered.
struct Plan {
    path: CameraPath,
    solids: Vec<Primitive>,
    rooms: Rooms,
    mover: Option<room::Mover>,
    /// Times and poses along the path.
    sampled: Vec<(f64, Se3)>,
}

impl Plan {
    fn new(config: &SceneConfig) -> Result<Self, SceneError> {
        config.validate()?;
        check_lens(&config.camera())?;
        let path = CameraPath::new(config)?;
        let every = config.frames.div_ceil(PATH_SAMPLES * config.room.rooms.iter().product::<usize>());
        let timed = |frame: usize| (frame as f64 / config.fps, path.world_from_camera(frame as f64 / config.fps));
        let sampled: Vec<(f64, Se3)> = (0..config.frames).step_by(every).map(timed).collect();
        let poses: Vec<Se3> = sampled.iter().map(|(_, pose)| *pose).collect();
        let (solids, rooms) = room::furnish(config, &poses)?;
        check_clearance(config, &path, &solids, &rooms)?;
        let mover = config.degradation.moving_object.then(|| room::Mover::new(config, &sampled, &solids)).transpose()?;
        Ok(Self { path, solids, rooms, mover, sampled })
    }
}

/// A scene that is ready to be rendered frame by frame.
struct Recording<'a> {
    config: &'a SceneConfig,
    path: CameraPath,
    renderer: Renderer,
    /// `left_from_camera` of each camera.
    cameras: Vec<Se3>,
}

impl<'a> Recording<'a> {
    fn new(config: &'a SceneConfig) -> Result<Self, SceneError> {
        let Plan { path, solids, rooms, mover, sampled } = Plan::new(config)?;
        let renderer = Renderer::new(&config.camera(), Scene::new(solids, rooms), mover, config.room.gloss);
        let moment = |(time_s, pose): &(f64, Se3)| Moment { world_from_camera: *pose, time_s: *time_s, subpixel: DVec2::ZERO };
        renderer.warm_up(&sampled.iter().step_by(8).map(moment).collect::<Vec<_>>());
        Ok(Self { config, path, renderer, cameras: cameras(config) })
    }

    fn time_s(&self, frame: usize) -> f64 {
        frame as f64 / self.config.fps
    }

    fn render(&self, frame: usize, camera: usize) -> Rendered {
        let middle_s = self.time_s(frame);
        let pose = |time_s: f64| self.path.world_from_camera(time_s) * self.cameras[camera];
        let moment = |time_s: f64, subpixel: DVec2| Moment { world_from_camera: pose(time_s), time_s, subpixel };
        let exposure_s = self.config.degradation.motion_blur / self.config.fps;
        if exposure_s == 0.0 {
            return self.renderer.render(&moment(middle_s, DVec2::ZERO), true);
        }
        let mut sharp = self.renderer.render(&moment(middle_s, DVec2::ZERO), false);
        for k in (0..BLUR_MOMENTS).filter(|k| *k != BLUR_MOMENTS / 2) {
            let share = (k as f64 + 0.5) / BLUR_MOMENTS as f64 - 0.5;
            // Places of the 3 x 3 grid in an order that does not follow time.
            let place = (k * 2 + 5) % BLUR_MOMENTS;
            let subpixel = DVec2::new((place % 3) as f64 - 1.0, (place / 3) as f64 - 1.0) / 3.0;
            let other = self.renderer.render(&moment(middle_s + share * exposure_s, subpixel), false);
            sharp.color.iter_mut().zip(other.color).for_each(|(sum, c)| *sum += c);
        }
        sharp.color.iter_mut().for_each(|c: &mut Vec3| *c /= BLUR_MOMENTS as f32);
        sharp
    }

    fn trajectory(&self) -> Trajectory {
        let pose = |frame: usize| {
            let timestamp_s = self.time_s(frame);
            StampedPose { timestamp_s, world_from_camera: self.path.world_from_camera(timestamp_s) }
        };
        Trajectory { poses: (0..self.config.frames).map(pose).collect() }
    }
}

/// Renders `config` into the new folder `out`, in parallel; `progress` is called after each frame. The same scene gives the same
/// bytes, however many threads there are. A run that fails or is killed leaves no folder `out`.
///
/// # Errors
/// [`SceneError`] if the scene has no place for its furniture, the path comes too close to a surface, `out` exists, or writing fails.
pub fn generate(config: &SceneConfig, out: &Path, progress: &(dyn Fn(usize, usize) + Sync)) -> Result<(), SceneError> {
    config.validate()?;
    let writer = write::Writer::new(config, out)?;
    let recording = Recording::new(config)?;
    let sensor = degrade::Sensor::new(config);
    let done = AtomicUsize::new(0);
    (0..config.frames).into_par_iter().with_max_len(1).try_for_each(|frame| {
        let record = |camera: usize| sensor.record(&recording.render(frame, camera), frame, camera);
        writer.frame(config, frame, &(0..recording.cameras.len()).map(record).collect::<Vec<_>>())?;
        progress(done.fetch_add(1, Ordering::Relaxed) + 1, config.frames);
        Ok(())
    })?;
    writer.finish(config, &recording.trajectory())
}

/// `left_from_camera` of each camera. The right one's calibration does not know that it is turned.
fn cameras(config: &SceneConfig) -> Vec<Se3> {
    let right = config.stereo.as_ref().map(|stereo| {
        let mut rng = fastrand::Rng::with_seed(config.seed ^ 0x57E2_E0CA_3E2A);
        let turned = [(); 3].map(|()| (2.0 * rng.f64() - 1.0) * stereo.misalignment.to_radians());
        Se3::new(nalgebra::Vector3::new(stereo.baseline, 0.0, 0.0), turned.into())
    });
    std::iter::once(Se3::identity()).chain(right).collect()
}

/// A lens that folds the image over itself cannot be rendered: every recorded pixel needs the one ray that it shows.
fn check_lens(camera: &Camera) -> Result<(), SceneError> {
    let p = camera.pinhole;
    let (right, bottom) = (f64::from(p.width) - 1.0, f64::from(p.height) - 1.0);
    let along = |n: f64| (0..=16).map(move |k| n * f64::from(k) / 16.0);
    for (x, y) in along(right).flat_map(|x| [(x, 0.0), (x, bottom)]).chain(along(bottom).flat_map(|y| [(0.0, y), (right, y)])) {
        let recorded = nalgebra::Vector2::new(x, y);
        let back = camera.distort_pixel(&camera.undistort_pixel(&recorded));
        // Undistortion that runs away ends in NaN, which is no agreement either.
        let agrees = (back - recorded).norm() < 1e-3;
        if !agrees {
            let what = "are too strong: at the image's border the lens shows no single ray; use smaller coefficients".into();
            return Err(SceneError::Field { field: "camera.k1, k2, p1, p2", what });
        }
    }
    Ok(())
}

fn check_clearance(config: &SceneConfig, path: &CameraPath, solids: &[Primitive], rooms: &Rooms) -> Result<(), SceneError> {
    let cameras = cameras(config);
    for (frame, camera) in (0..config.frames).flat_map(|frame| cameras.iter().map(move |camera| (frame, camera))) {
        let p = room::position(&(path.world_from_camera(frame as f64 / config.fps) * camera));
        let distance_metres = rooms.solids_near(p).map(|k| solids[k].distance(p)).fold(f64::INFINITY, f64::min);
        if distance_metres < room::MIN_CLEARANCE {
            return Err(SceneError::TooClose { frame, distance_metres });
        }
    }
    Ok(())
}
