//! Two hundred steps of Adam on random and degenerate scenes: nothing may become NaN, explode, stand still while it is seen, or grow worse.

use fastrand::Rng;
use glam::Vec3;
use image::{Rgb, RgbImage};

use super::scenes::{Fault, Scene, between};
use super::{Family, Machine, Outcome, Part};
use crate::gpu::GpuError;
use crate::optimise::{AdamConfig, LossConfig, TargetImage, TrainingView};
use crate::splat::{Gaussian, GaussianCloud};

const STEPS: usize = 200;
/// Gaussians that are seen must move within the last steps.
const LAST_STEPS: usize = 20;
/// One scene in so many is trained.
const EVERY: usize = 25;
/// The most that a step of Adam can move, in rates: (1-β₁)/√(1-β₂) after a long pause.
const LONGEST_STEP: f32 = 3.2;
/// Gradients that have fallen to less than this share of themselves need not move anything.
const FORGOTTEN: f32 = 0.01;
/// Gradients above this move nothing, see `sink_adam.wgsl`.
const OVERFLOW: f32 = 1e15;

pub fn families(machine: &Machine) -> Vec<Family<'_>> {
    let of_fault = |(fault, name)| {
        let case = move |rng: &mut Rng| {
            let scene = Scene::random(rng, fault);
            train(machine, rng, &scene, fault)
        };
        Family::new(Part::Rasterizer, format!("train: {name}"), EVERY, case)
    };
    Fault::ALL.into_iter().map(of_fault).collect()
}

/// Noise, or a smooth picture; and a depth that has nothing to do with the scene.
fn target(machine: &Machine, rng: &mut Rng, (width, height): (u32, u32)) -> Result<TargetImage, GpuError> {
    let noisy = rng.bool();
    let [a, b] = [rng.u32(1..9), rng.u32(1..9)];
    let image = RgbImage::from_fn(width, height, |x, y| {
        if noisy { Rgb([rng.u8(..), rng.u8(..), rng.u8(..)]) } else { Rgb([(x * a) as u8, (y * b) as u8, ((x + y) * a) as u8]) }
    });
    let depth = |_| if rng.f32() < 0.2 { 0.0 } else { between(rng, 0.05, 60.0) };
    let depth: Vec<f32> = (0..width * height).map(depth).collect();
    TargetImage::new(&machine.gpu, &image, Some(&depth))
}

fn train(machine: &Machine, rng: &mut Rng, scene: &Scene, fault: Fault) -> Result<Outcome, GpuError> {
    let size = (scene.camera.pinhole.width, scene.camera.pinhole.height);
    let target = target(machine, rng, size)?;
    let (loss, adam) = (LossConfig::default(), AdamConfig::default());
    let on_gpu = machine.upload(&scene.cloud)?;
    let view = TrainingView::new(scene.camera, &target);
    machine.with(rng.usize(..2), |trainer| {
        let mut outcome = Outcome::default();
        let mut losses = Vec::new();
        let mut before_last = on_gpu.download(&machine.gpu)?;
        let at_first_by = trainer.gradients(&on_gpu, &scene.camera, &target, &loss)?.cloud;
        let mut before_last_by = at_first_by.clone();
        for done in (0..STEPS).step_by(LAST_STEPS) {
            let is_last = done + LAST_STEPS >= STEPS;
            if is_last {
                before_last = on_gpu.download(&machine.gpu)?;
                before_last_by = trainer.gradients(&on_gpu, &scene.camera, &target, &loss)?.cloud;
            }
            let reports = trainer.steps(&on_gpu, &[view; LAST_STEPS], &loss, &adam)?;
            losses.extend(reports.iter().map(|r| r.loss.total(&loss)));
        }
        outcome.require(losses.iter().all(|loss| loss.is_finite()), || "a loss is not finite".into());
        // Where little or nothing is seen there is nothing to gain; noise cannot be fitted by single pixels' Gaussians.
        let limit = if fault == Fault::None { 1.0 } else { 1.05 };
        outcome.measure("loss after, of before", f64::from(losses[STEPS - 1] / losses[0].max(1e-6)), limit);
        let gradients = trainer.gradients(&on_gpu, &scene.camera, &target, &loss)?.cloud;
        let after = on_gpu.download(&machine.gpu)?;
        outcome.count("Gaussians", after.len());
        outcome.count("never seen", (0..after.len()).filter(|i| !is_seen(&at_first_by, *i)).count());
        outcome.count("unseen at the end", (0..after.len()).filter(|i| !is_seen(&gradients, *i)).count());
        check_parameters(&mut outcome, &scene.cloud, &after, &adam);
        // The first of the last steps goes out from these gradients; a Gaussian that others uncover later need not have moved yet.
        let pulled = |i: &usize| is_pulled(&before_last_by, &at_first_by, *i);
        let stuck = (0..after.len()).filter(pulled).filter(|&i| after.get(i) == before_last.get(i));
        let stuck: Vec<usize> = stuck.collect();
        outcome.require(stuck.is_empty(), || format!("{} Gaussians have gradients but stand still: {stuck:?}", stuck.len()));
        Ok(outcome)
    })
}

/// Whether a Gaussian has a gradient at all, but none that overflowed.
fn is_seen(gradients: &GaussianCloud, i: usize) -> bool {
    components(gradients, i).any(|v| v.abs() > 1e-20 && v.abs() < OVERFLOW)
}

/// Whether a Gaussian has a gradient that Adam follows: one far below what it was is lost in the memory of that, as it should be.
fn is_pulled(now: &GaussianCloud, at_first: &GaussianCloud, i: usize) -> bool {
    let grows_or_stays = components(now, i).zip(components(at_first, i)).any(|(now, then)| now.abs() > FORGOTTEN * then.abs());
    grows_or_stays && is_seen(now, i)
}

/// Gradients by mean, log scale, opacity and constant colour.
fn components(gradients: &GaussianCloud, i: usize) -> impl Iterator<Item = f32> {
    let g = gradients.get(i);
    let geometry = g.mean.to_array().into_iter().chain(g.log_scale.to_array()).chain([g.raw_opacity]);
    geometry.chain(g.sh[0].to_array())
}

/// How many times longer than its second axis a Gaussian is, logarithm.
fn elongation(log_scale: Vec3) -> f32 {
    let mut s = log_scale.to_array();
    s.sort_by(f32::total_cmp);
    s[2] - s[1]
}

fn check_parameters(outcome: &mut Outcome, before: &GaussianCloud, after: &GaussianCloud, adam: &AdamConfig) {
    let lost = after.first_non_finite();
    outcome.require(lost.is_none(), || format!("Gaussian {} is not finite: {:?}", lost.unwrap(), after.get(lost.unwrap())));
    let reach = LONGEST_STEP * STEPS as f32;
    let (mut growth, mut opacity, mut needles) = (0.0f32, 0.0f32, 0);
    for i in 0..after.len() {
        let (old, new): (Gaussian, Gaussian) = (before.get(i), after.get(i));
        growth = growth.max((new.log_scale - old.log_scale).max_element());
        opacity = opacity.max((new.raw_opacity - old.raw_opacity).abs());
        needles += usize::from(new != old && elongation(new.log_scale) > adam.max_elongation.ln() + 1e-3);
    }
    outcome.measure("growth of a log scale", growth.into(), (reach * adam.lr_log_scale).into());
    outcome.measure("change of a raw opacity", opacity.into(), (reach * adam.lr_opacity).into());
    outcome.require(needles == 0, || format!("{needles} Gaussians that moved are needles"));
}
