//! Writes a recording in TUM's or KITTI's layout, first beside its place, then moved there whole.

use std::path::{Path, PathBuf};

use image::codecs::png::{CompressionType, FilterType, PngEncoder};
use image::{ExtendedColorType, ImageEncoder};

use super::SceneError;
use super::config::{SceneConfig, StereoConfig};
use super::degrade::{DEPTH_UNITS_PER_METRE, Recorded};
use crate::geometry::Trajectory;

/// A recording under construction. Dropped before [`Self::finish`], it leaves nothing.
pub struct Writer {
    partial: PathBuf,
    target: PathBuf,
    finished: bool,
}

/// Name of a frame's images without extension: its time in TUM's layout, its number in KITTI's.
fn stem(config: &SceneConfig, frame: usize) -> String {
    if config.stereo.is_some() { format!("{frame:06}") } else { format!("{:.6}", frame as f64 / config.fps) }
}

/// Folders of the images: colour and depth, or left and right.
fn folders(config: &SceneConfig) -> [&'static str; 2] {
    if config.stereo.is_some() { ["image_2", "image_3"] } else { ["rgb", "depth"] }
}

impl Writer {
    pub fn new(config: &SceneConfig, target: &Path) -> Result<Self, SceneError> {
        let occupied = std::fs::read_dir(target).map(|mut entries| entries.next().is_some()).unwrap_or(target.exists());
        if occupied {
            return Err(SceneError::Exists { path: target.into() });
        }
        let name = target.file_name().map(|n| n.to_string_lossy().into_owned());
        let name = name.ok_or_else(|| SceneError::Exists { path: target.into() })?;
        let partial = target.with_file_name(format!(".{name}.partial-{}", std::process::id()));
        let this = Self { partial, target: target.into(), finished: false };
        for folder in folders(config) {
            let path = this.partial.join(folder);
            std::fs::create_dir_all(&path).map_err(|source| SceneError::Write { path, source })?;
        }
        Ok(this)
    }

    /// `recorded` has one entry a camera.
    pub fn frame(&self, config: &SceneConfig, frame: usize, recorded: &[Recorded]) -> Result<(), SceneError> {
        let name = stem(config, frame);
        let (width, height) = (config.camera.width, config.camera.height);
        let save = |folder: &str, bytes: &[u8], color| {
            let path = self.partial.join(folder).join(format!("{name}.png"));
            let mut png = Vec::with_capacity(bytes.len());
            let encoder = PngEncoder::new_with_quality(&mut png, CompressionType::Fast, FilterType::Sub);
            encoder
                .write_image(bytes, width, height, color)
                .map_err(|source| SceneError::Image { path: path.clone(), source })?;
            std::fs::write(&path, png).map_err(|source| SceneError::Write { path, source })
        };
        for (camera, folder) in recorded.iter().zip(folders(config)) {
            save(folder, &camera.rgb, ExtendedColorType::Rgb8)?;
        }
        if let [only] = recorded {
            let depth: Vec<u8> = only.depth.iter().flat_map(|units| units.to_ne_bytes()).collect();
            save("depth", &depth, ExtendedColorType::L16)?;
        }
        Ok(())
    }

    /// Writes the lists, the camera, the poses and the scene, and moves everything to its place.
    pub fn finish(mut self, config: &SceneConfig, poses: &Trajectory) -> Result<(), SceneError> {
        let files = match &config.stereo {
            Some(stereo) => kitti_files(config, stereo, poses),
            None => tum_files(config, poses),
        };
        for (name, text) in files.into_iter().chain([("scene.toml", config.to_toml())]) {
            let path = self.partial.join(name);
            std::fs::write(&path, text).map_err(|source| SceneError::Write { path, source })?;
        }
        std::fs::rename(&self.partial, &self.target).map_err(|source| SceneError::Write { path: self.target.clone(), source })?;
        self.finished = true;
        Ok(())
    }
}

impl Drop for Writer {
    fn drop(&mut self) {
        if !self.finished {
            // Nothing more can be done about a folder that cannot be removed.
            let _ = std::fs::remove_dir_all(&self.partial);
        }
    }
}

fn tum_files(config: &SceneConfig, poses: &Trajectory) -> Vec<(&'static str, String)> {
    let list = |folder: &str| {
        let line = |frame: usize| format!("{0} {folder}/{0}.png\n", stem(config, frame));
        format!("# timestamp file\n{}", (0..config.frames).map(line).collect::<String>())
    };
    let c = &config.camera;
    let camera = format!(
        "# fx fy cx cy width height depth_units_per_metre k1 k2 p1 p2\n{} {} {} {} {} {} {DEPTH_UNITS_PER_METRE} {} {} {} {}\n",
        c.fx, c.fy, c.cx, c.cy, c.width, c.height, c.k1, c.k2, c.p1, c.p2
    );
    vec![
        ("rgb.txt", list("rgb")),
        ("depth.txt", list("depth")),
        ("camera.txt", camera),
        ("groundtruth.txt", format!("# timestamp tx ty tz qx qy qz qw, camera to world\n{}", poses.to_tum())),
    ]
}

fn kitti_files(config: &SceneConfig, stereo: &StereoConfig, poses: &Trajectory) -> Vec<(&'static str, String)> {
    let c = &config.camera;
    let projection = |shift: f64| format!("{} 0 {} {} 0 {} {} 0 0 0 1 0", c.fx, c.cx, -c.fx * shift, c.fy, c.cy);
    vec![
        ("calib.txt", format!("P2: {}\nP3: {}\n", projection(0.0), projection(stereo.baseline))),
        ("times.txt", poses.poses.iter().map(|pose| format!("{:.6}\n", pose.timestamp_s)).collect()),
        ("poses.txt", poses.to_kitti()),
    ]
}
