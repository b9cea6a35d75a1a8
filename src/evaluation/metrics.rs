//! The report of a run: `metrics.json`, and the same figures as a table for people.
//!
//! A figure that does not apply is `null` in the file (and `–` in the table), never left out, so that every file has every field.
//! JSON knows no infinity: a PSNR of equal images is `null` too.

use std::fmt;
use std::path::Path;

use crate::sequence::SensorKind;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use crate::files::{WriteError, write_durably};

/// Everything that is known about a run. Field names carry their units.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Metrics {
    /// Name of the recording.
    pub sequence: String,
    /// Sensor of the run, which may be less than the recording's.
    pub sensor: SensorKind,
    /// Frames arrived by their timestamps (`true`) or as fast as they were consumed.
    pub paced: bool,
    /// Frames replayed.
    pub frames: u64,
    /// Frames whose images could not be read.
    pub frames_read_failed: u64,
    /// Frames with a pose.
    pub frames_tracked: u64,
    /// Real-time replay: frames dropped while the tracker was busy.
    #[serde(default)]
    pub frames_late: u64,
    /// Real-time replay: keyframes that a newer one replaced before the mapper took them.
    #[serde(default)]
    pub keyframes_deferred: u64,
    /// Keyframes created; `None` if unknown.
    pub keyframes: Option<u64>,
    /// Absolute trajectory error, RMSE, metres.
    pub ate_rmse_m: AteFigures,
    /// Relative pose error.
    pub rpe: RpeFigures,
    /// Image quality by protocol.
    pub images: ImageProtocols,
    /// Gaussians in the exported map.
    pub gaussians: Option<u64>,
    /// Size of the exported map, bytes.
    pub map_bytes: Option<u64>,
    /// SHA-256 of the exported map's bytes.
    pub map_hash: Option<String>,
    /// From the first frame's reading to the finished map, without the evaluation; of a resumed run all parts that came to a checkpoint.
    pub wall_s: Option<f64>,
    /// How often it was interrupted and went on from a checkpoint; parts that came to no checkpoint of their own do not count.
    #[serde(default)]
    pub resumed: u64,
    /// Tracking time of a frame, milliseconds.
    pub tracking_ms: Option<Times>,
    /// Systematic error of the depth images that the tracker found.
    #[serde(default)]
    pub depth_bias: Option<DepthBiasFigures>,
    /// Standard deviation of keypoints at the finest pyramid level that the tracker found, pixels.
    #[serde(default)]
    pub pixel_sigma: Option<f64>,
    /// Figures of the optimisation.
    pub mapping: Option<MappingFigures>,
    /// Peak resident memory of the process, bytes.
    pub peak_host_bytes: Option<u64>,
    /// Peak of the buffers allocated on the adapter, bytes.
    pub peak_gpu_bytes: Option<u64>,
    /// The GPU adapter.
    pub adapter: Option<Adapter>,
    /// Model name of the processor.
    pub cpu: Option<String>,
    /// Hardware threads.
    pub threads: u64,
    /// Version of keysplat.
    pub version: String,
    /// SHA-256 of the resolved configuration's text.
    pub config_hash: Option<String>,
}

/// Measured inverse depth minus the true one, 1/metres: offset + tilt_x · x + tilt_y · y, with x to the right and y down from the principal
/// point in half image widths.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DepthBiasFigures {
    /// At the principal point.
    pub offset_per_m: f64,
    /// Along the image's rows.
    pub tilt_x_per_m: f64,
    /// Along its columns.
    pub tilt_y_per_m: f64,
}

/// Absolute trajectory error, each aligned over its own poses.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct AteFigures {
    /// Over all frames with a pose, metres.
    pub all_frames: Option<f64>,
    /// Over keyframes alone, metres.
    pub keyframes: Option<f64>,
}

/// See [`super::trajectory::RelativeErrors`] for how a frame is counted where truth is rarer.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RpeFigures {
    /// Translation, metres a frame.
    pub trans_m_per_frame: Option<f64>,
    /// Rotation, degrees a frame.
    pub rot_deg_per_frame: Option<f64>,
}

/// The three protocols by which rendered images are compared with recorded ones. Those of others have no correction of colours.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ImageProtocols {
    /// Every 8th frame, which the mapper never saw; rendered with the exposure that the keyframes around it have, where these are corrected.
    pub held_out: Option<ImageFigures>,
    /// The same frames rendered in the map's own colours, where exposures are corrected.
    #[serde(default)]
    pub held_out_map_colors: Option<ImageFigures>,
    /// Every posed frame (Photo-SLAM).
    pub all_frames: Option<ImageFigures>,
    /// Every 5th frame that is no keyframe, PSNR where the image is lit (MonoGS).
    pub monogs: Option<ImageFigures>,
}

/// Means over images. A figure that no image has is `null`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ImageFigures {
    /// Images compared.
    pub count: u64,
    /// Mean PSNR, dB.
    pub psnr_db: Option<f64>,
    /// Mean SSIM.
    pub ssim: Option<f64>,
    /// Over the images that have sensor depth.
    pub depth_l1_m: Option<f64>,
}

/// Adds images up to [`ImageFigures`], in the order they come.
#[derive(Clone, Copy, Debug, Default)]
pub struct ImageMeans {
    count: u64,
    psnr_db: f64,
    ssim: f64,
    depth_count: u64,
    depth_l1_m: f64,
}

/// Times in milliseconds.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Times {
    /// Median.
    pub median: f64,
    /// 95th percentile.
    pub p95: f64,
    /// Maximum.
    pub max: f64,
}

/// Times in milliseconds, where the largest one says little.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct UsualTimes {
    /// Median.
    pub median: f64,
    /// 95th percentile.
    pub p95: f64,
}

/// Steps and times of the optimisation.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MappingFigures {
    /// Optimisation steps.
    pub iterations: u64,
    /// Steps divided by replayed frames.
    pub iterations_per_frame: f64,
    /// Time of a step, milliseconds.
    pub ms_per_iteration: Option<UsualTimes>,
    /// The size at which the mapper compares images, pixels.
    pub map_width: u32,
    /// Height of these images, pixels.
    pub map_height: u32,
    /// Where the map was larger than the adapter's memory.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub paging: Option<PagingFigures>,
}

/// Gaussians that left the adapter for the disk.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PagingFigures {
    /// Those that left, counted each time.
    pub gaussians_out: u64,
    /// Those that came back.
    pub gaussians_in: u64,
    /// The most that were on the disk at a time.
    pub most_away: u64,
}

/// The GPU, or what stands in for it.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Adapter {
    /// Name that the driver reports.
    pub name: String,
    /// Graphics interface, such as `vulkan`.
    pub backend: String,
    /// `discretegpu`, `integratedgpu`, `virtualgpu`, `cpu` or `other`.
    pub kind: String,
    /// Driver and its version.
    pub driver: String,
}

impl ImageMeans {
    /// Counts one image in; `depth_l1_m` is `None` where the sensor has no depth.
    pub fn add(&mut self, psnr_db: f64, ssim: f64, depth_l1_m: Option<f64>) {
        self.count += 1;
        self.psnr_db += psnr_db;
        self.ssim += ssim;
        if let Some(metres) = depth_l1_m {
            self.depth_count += 1;
            self.depth_l1_m += metres;
        }
    }

    /// `None` if no image was counted.
    pub fn figures(&self) -> Option<ImageFigures> {
        let mean = |sum: f64, count: u64| (count > 0).then(|| sum / count as f64).filter(|mean| mean.is_finite());
        (self.count > 0).then(|| ImageFigures {
            count: self.count,
            psnr_db: mean(self.psnr_db, self.count),
            ssim: mean(self.ssim, self.count),
            depth_l1_m: mean(self.depth_l1_m, self.depth_count),
        })
    }
}

impl Times {
    /// Statistics of times in any order, milliseconds; `None` without times. `p95` is the smallest time that 95 % do not exceed.
    pub fn of(times_ms: &[f64]) -> Option<Self> {
        let mut sorted = times_ms.to_vec();
        sorted.sort_by(f64::total_cmp);
        let n = sorted.len();
        Some(Self {
            max: *sorted.last()?,
            median: (sorted[(n - 1) / 2] + sorted[n / 2]) / 2.0,
            p95: sorted[(n * 95).div_ceil(100) - 1],
        })
    }
}

impl UsualTimes {
    /// As [`Times::of`].
    pub fn of(times_ms: &[f64]) -> Option<Self> {
        Times::of(times_ms).map(|Times { median, p95, .. }| Self { median, p95 })
    }
}

/// SHA-256 as lower-case hexadecimal digits: of the exported map's bytes, of the configuration's text.
pub fn sha256_hex(bytes: &[u8]) -> String {
    Sha256::digest(bytes).iter().map(|byte| format!("{byte:02x}")).collect()
}

/// Writes `metrics.json`.
///
/// # Errors
/// [`WriteError`] if the file cannot be written.
pub fn write_json(metrics: &Metrics, path: &Path) -> Result<(), WriteError> {
    let mut text = serde_json::to_string_pretty(metrics).expect("metrics are numbers and strings, which JSON can hold");
    text.push('\n');
    write_durably(path, text.as_bytes())
}

/// A figure with its decimals and unit, or a dash.
fn cell(value: Option<f64>, decimals: usize, unit: &str) -> String {
    value.map_or_else(|| "–".into(), |value| format!("{value:.decimals$} {unit}").trim_end().to_owned())
}

fn mebibytes(bytes: Option<u64>) -> String {
    cell(bytes.map(|bytes| bytes as f64 / f64::from(1 << 20)), 1, "MiB")
}

impl fmt::Display for ImageFigures {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let depth = cell(self.depth_l1_m.map(|m| 100.0 * m), 2, "cm");
        let (psnr, ssim) = (cell(self.psnr_db, 2, "dB"), cell(self.ssim, 4, ""));
        write!(f, "PSNR {psnr}   SSIM {ssim}   depth L1 {depth}   ({} images)", self.count)
    }
}

/// One figure a line, name left; no line is left out.
impl fmt::Display for Metrics {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut row = |name: &str, value: String| writeln!(f, "{name:<22}{value}");
        let centimetres = |metres: Option<f64>| cell(metres.map(|m| 100.0 * m), 2, "cm");
        let sensor = format!("{:?}", self.sensor).to_lowercase();
        let lost_percent = 100.0 * self.frames.saturating_sub(self.frames_tracked) as f64 / self.frames.max(1) as f64;
        row("sequence", format!("{} ({sensor}, {})", self.sequence, if self.paced { "real time" } else { "deterministic" }))?;
        let keyframes = self.keyframes.map_or_else(|| "–".into(), |n| n.to_string());
        let late = if self.paced { format!(", {} late", self.frames_late) } else { String::new() };
        row("frames", format!("{}, {keyframes} keyframes, {} unreadable{late}", self.frames, self.frames_read_failed))?;
        row("ATE RMSE", format!("{}   lost frames {lost_percent:.1} %", centimetres(self.ate_rmse_m.all_frames)))?;
        row("ATE RMSE, keyframes", centimetres(self.ate_rmse_m.keyframes))?;
        let degrees = cell(self.rpe.rot_deg_per_frame, 3, "°");
        row("RPE per frame", format!("{}   {degrees}", cell(self.rpe.trans_m_per_frame.map(|m| 1000.0 * m), 2, "mm")))?;
        for (name, figures) in [
            ("held-out images", self.images.held_out),
            ("  in own colours", self.images.held_out_map_colors),
            ("all images", self.images.all_frames),
            ("images as MonoGS", self.images.monogs),
        ] {
            row(name, figures.map_or_else(|| "–".into(), |figures| figures.to_string()))?;
        }
        let gaussians = self.gaussians.map_or_else(|| "–".into(), |n| n.to_string());
        row("Gaussians", format!("{gaussians}   map on disk {}", mebibytes(self.map_bytes)))?;
        row("map hash", self.map_hash.clone().unwrap_or_else(|| "–".into()))?;
        let resumed = if self.resumed > 0 { format!("   resumed {}×", self.resumed) } else { String::new() };
        row("whole run", cell(self.wall_s, 1, "s") + &resumed)?;
        let tracking = self.tracking_ms.map(|t| format!("median {:.1} ms   p95 {:.1} ms   max {:.1} ms", t.median, t.p95, t.max));
        row("tracking per frame", tracking.unwrap_or_else(|| "–".into()))?;
        row("mapping", self.mapping.map_or_else(|| "–".into(), |mapping| mapping.to_string()))?;
        row("peak memory", format!("host {}   GPU {}", mebibytes(self.peak_host_bytes), mebibytes(self.peak_gpu_bytes)))?;
        row("adapter", self.adapter.as_ref().map_or_else(|| "–".into(), Adapter::to_string))?;
        row("CPU", format!("{}   {} threads", self.cpu.as_deref().unwrap_or("–"), self.threads))?;
        row("keysplat", format!("{}   configuration {}", self.version, self.config_hash.as_deref().unwrap_or("–")))
    }
}

impl fmt::Display for MappingFigures {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { iterations, iterations_per_frame, map_width, map_height, .. } = self;
        write!(f, "{iterations} iterations at {map_width}x{map_height}, {iterations_per_frame:.2} per frame")?;
        let Some(UsualTimes { median, p95 }) = self.ms_per_iteration else { return Ok(()) };
        write!(f, "   median {median:.1} ms   p95 {p95:.1} ms")
    }
}

impl fmt::Display for Adapter {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} ({}, {}, {})", self.name, self.kind, self.backend, self.driver)
    }
}

#[cfg(test)]
mod tests;
