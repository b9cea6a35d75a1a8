//! Many thousand steps on one small scene that can be fitted: the loss must not rise once it has fallen, and nothing may wander off.

use fastrand::Rng;
use glam::Vec3;
use image::{Rgb, RgbImage};

use super::scenes::{self, between};
use super::{Family, Machine, Outcome, Part};
use crate::geometry::se3;
use crate::gpu::GpuError;
use crate::optimise::{AdamConfig, LossConfig, TargetImage, TrainingView};
use crate::render::Rendered;
use crate::splat::{GaussianCloud, ShDegree, ViewCamera};

const SIZE: (u32, u32) = (64, 48);
const VIEWS: usize = 4;
const GAUSSIANS: usize = 200;
/// When the loss is looked at, as shares of all steps: at 1000, 5000 and 20,000 of 20,000.
const MILESTONES: [f64; 3] = [0.05, 0.25, 1.0];
/// Steps whose losses are averaged, and that are submitted together.
const BATCH: usize = 40;
/// Adam at a steady rate jitters about the optimum by this share of the loss.
const RISE_LIMIT: f64 = 1.1;
/// Bounds of what 20,000 steps may make of raw parameters: e^±16 metres, an opacity that f32 can still tell from 0 and 1, colours.
const LOG_SCALE_LIMIT: f64 = 16.0;
const RAW_OPACITY_LIMIT: f64 = 40.0;
const HARMONICS_LIMIT: f64 = 100.0;
/// Positions stay within this distance, metres; the scene lies within 4.
const DISTANCE_LIMIT: f64 = 100.0;

pub fn families(machine: &Machine, steps: usize) -> Vec<Family<'_>> {
    vec![Family::new(Part::Long, format!("long: {steps} steps"), usize::MAX, move |rng| long(machine, rng, steps))]
}

/// A picture and a depth image of what was rendered.
pub(super) fn target(machine: &Machine, rendered: &Rendered) -> Result<TargetImage, GpuError> {
    let byte = |v: f32| (v.clamp(0.0, 1.0) * 255.0).round() as u8;
    let pixel = |x: u32, y: u32| rendered.color_depth[(y * rendered.width + x) as usize];
    let image = RgbImage::from_fn(rendered.width, rendered.height, |x, y| {
        let [r, g, b, _] = pixel(x, y);
        Rgb([byte(r), byte(g), byte(b)])
    });
    let depth = |i: usize| if rendered.alpha(i) > 0.5 { rendered.expected_depth(i) } else { 0.0 };
    let depth: Vec<f32> = (0..rendered.transmittance.len()).map(depth).collect();
    TargetImage::new(&machine.gpu, &image, Some(&depth))
}

fn long(machine: &Machine, rng: &mut Rng, steps: usize) -> Result<Outcome, GpuError> {
    let mut truth = GaussianCloud::new(ShDegree::ALL[1]);
    (0..GAUSSIANS).for_each(|_| truth.push(scenes::gaussian(rng, truth.sh_degree)));
    let camera = scenes::camera(rng, SIZE);
    let aside = |k: usize| se3::exp(&nalgebra::Vector6::new(0.2 * k as f64, 0.0, 0.0, 0.0, -0.08 * k as f64, 0.0));
    let cameras = (0..VIEWS).map(|k| ViewCamera { camera_from_world: aside(k) * camera.camera_from_world, ..camera });
    let cameras: Vec<ViewCamera> = cameras.collect();
    let on_gpu = machine.upload(&truth)?;
    let targets = machine.with(1, |trainer| {
        let render = |camera| target(machine, &trainer.render(&on_gpu, camera, [0.0; 3])?);
        cameras.iter().map(render).collect::<Result<Vec<_>, GpuError>>()
    })?;
    let mut start = truth.clone();
    for i in 0..start.len() {
        let mut jitter = |most: f32| Vec3::from_array(std::array::from_fn(|_| between(rng, -most, most)));
        start.means[i] += jitter(0.05);
        start.log_scales[i] += jitter(0.5);
        start.sh[i * 4] += jitter(0.5);
    }
    let on_gpu = machine.upload(&start)?;
    let view = |k: usize| TrainingView::new(cameras[k % VIEWS], &targets[k % VIEWS]);
    let batch: Vec<TrainingView<'_>> = (0..BATCH).map(view).collect();
    let (loss, adam) = (LossConfig::default(), AdamConfig::default());
    let mut losses = Vec::new();
    machine.with(1, |trainer| {
        for _ in 0..steps.div_ceil(BATCH) {
            let reports = trainer.steps(&on_gpu, &batch, &loss, &adam)?;
            losses.push(reports.iter().map(|r| f64::from(r.loss.total(&loss))).sum::<f64>() / BATCH as f64);
        }
        Ok::<_, GpuError>(())
    })?;
    Ok(judge(&losses, &on_gpu.download(&machine.gpu)?))
}

/// Checks the batches' mean losses and the final map.
fn judge(losses: &[f64], after: &GaussianCloud) -> Outcome {
    let mut outcome = Outcome::default();
    let [early, middle, late] =
        MILESTONES.map(|share| losses[((losses.len() as f64 * share).ceil() as usize).clamp(1, losses.len()) - 1]);
    outcome.note("loss at first", losses[0]);
    outcome.note("loss at 5%", early);
    outcome.note("loss at 25%", middle);
    outcome.note("loss at the end", late);
    outcome.measure("loss at 25%, of that at 5%", middle / early, RISE_LIMIT);
    outcome.measure("loss at the end, of that at 25%", late / middle, RISE_LIMIT);
    let worst = losses.iter().skip(losses.len() / 4).copied().fold(0.0, f64::max);
    outcome.measure("worst loss after 25%, of that at 5%", worst / early, 1.5);
    outcome.require(losses.iter().all(|loss| loss.is_finite()), || "a loss is not finite".into());
    outcome.require(after.first_non_finite().is_none(), || "a Gaussian is not finite".into());
    let most = |values: &mut dyn Iterator<Item = f32>| f64::from(values.map(f32::abs).fold(0.0, f32::max));
    outcome.measure("largest |log scale|", most(&mut after.log_scales.iter().flat_map(|v| v.to_array())), LOG_SCALE_LIMIT);
    outcome.measure("largest |raw opacity|", most(&mut after.raw_opacities.iter().copied()), RAW_OPACITY_LIMIT);
    outcome.measure("largest |harmonic|", most(&mut after.sh.iter().flat_map(|v| v.to_array())), HARMONICS_LIMIT);
    outcome.measure("farthest Gaussian, metres", most(&mut after.means.iter().map(|v| v.length())), DISTANCE_LIMIT);
    outcome
}
