//! Random and degenerate scenes, forward and backward, against the f64 oracle; and what is left of it all far from the origin.
//!
//! An error is the largest absolute difference over the largest magnitude of that quantity in the scene, plus a floor. Pixels in which
//! rounding may decide a cut-off or an order, or where an exponent is itself uncertain, have no right answer in f32: they are left out of
//! the images' errors and get no gradient on either side.

use fastrand::Rng;
use nalgebra::{Point3, Vector3};

use super::scenes::{Fault, Scene, between, narrow};
use super::{Family, Machine, Outcome, Part};
use crate::geometry::Se3;
use crate::gpu::GpuError;
use crate::optimise::ImageGradients;
use crate::render::Rendered;
use crate::splat::GaussianCloud;
use crate::splat::model::Surface;
use crate::verification::reference::project_backward::backward;
use crate::verification::reference::rasterize_forward::{self, Conditioning, pixel_conditioning};
use crate::verification::reference::{Cutoffs, Gaussian64, Image64, ImageGradient64, View64, cloud64};

const BACKGROUND: [f32; 3] = [0.1, 0.2, 0.3];
/// Relative distance from a cut-off within which f32 and f64 may disagree.
const BAND: f64 = 1e-5;
/// A pixel with an exponent whose rounding error may exceed this is left out: colours would be off by as much.
const UNCERTAIN: f64 = 2e-4;
/// Errors above these are failures: well above what rounding does in 160 Gaussians, well below any wrong term.
const IMAGE_LIMIT: f64 = 2e-4;
const GRADIENT_LIMIT: f64 = 1e-3;
/// Magnitudes below these count as these: colours and alpha of 0.01, depths of 1 cm; gradients of 1e-4 per unit of the image's.
const IMAGE_FLOOR: f64 = 1e-2;
const GRADIENT_FLOOR: f64 = 1e-4;
/// How far away the shifted world lies, metres.
const SHIFTS: [f64; 4] = [0.0, 100.0, 1e3, 1e4];

pub fn families(machine: &Machine) -> Vec<Family<'_>> {
    let of_fault = |surface, (fault, name)| {
        let case = move |rng: &mut Rng| {
            let scene = Scene::random(rng, fault);
            check(machine, rng, &scene, surface)
        };
        let surface = if surface == Surface::Planar { ", planar" } else { "" };
        Family::new(Part::Rasterizer, format!("render: {name}{surface}"), 1, case)
    };
    let of_shift = |metres: f64| {
        let case = move |rng: &mut Rng| shifted(machine, rng, metres);
        Family::new(Part::Rasterizer, format!("render: {metres:e} m from the origin"), 4, case)
    };
    let of_faults = |surface| Fault::ALL.into_iter().map(move |fault| of_fault(surface, fault));
    of_faults(Surface::Volume).chain(of_faults(Surface::Planar)).chain(SHIFTS.into_iter().map(of_shift)).collect()
}

fn view64(scene: &Scene) -> View64 {
    View64 {
        camera: scene.camera,
        background: Vector3::from(BACKGROUND).map(f64::from),
        cutoffs: Cutoffs::Sharp,
        antialiased: false,
        surface: Surface::Volume,
    }
}

/// Largest difference over largest magnitude, of `(got, wanted)`.
fn error(pairs: impl Iterator<Item = (f64, f64)>, floor: f64) -> f64 {
    let (difference, magnitude) = pairs.fold((0.0f64, floor), |(difference, magnitude), (got, wanted)| {
        // A NaN must not be swallowed by `max`.
        let off = if (got - wanted).is_nan() { f64::INFINITY } else { (got - wanted).abs() };
        (difference.max(off), magnitude.max(wanted.abs()))
    });
    difference / magnitude
}

fn compare_images(outcome: &mut Outcome, got: &Rendered, wanted: &Image64, trusted: &[bool], limit: f64) {
    let pixels = || (0..trusted.len()).filter(|i| trusted[*i]);
    let color = |i: usize| (0..3).map(move |c| (f64::from(got.color_depth[i][c]), wanted.color[i][c]));
    let depth = |i: usize| (f64::from(got.color_depth[i][3]), wanted.depth[i]);
    let alpha = |i: usize| (f64::from(got.transmittance[i]), wanted.transmittance[i]);
    outcome.measure("colour", error(pixels().flat_map(color), IMAGE_FLOOR), limit);
    outcome.measure("depth", error(pixels().map(depth), IMAGE_FLOOR), limit);
    outcome.measure("alpha", error(pixels().map(alpha), IMAGE_FLOOR), limit);
    if !got.surface.is_empty() {
        let part = |c: usize| pixels().map(move |i| (f64::from(got.surface[i][c]), wanted.surface[i][c]));
        outcome.measure("slopes", error(part(0).chain(part(1)), IMAGE_FLOOR), limit);
        outcome.measure("squared depth", error(part(2), IMAGE_FLOOR), limit);
    }
    let values = got.color_depth.iter().chain(&got.surface).flatten().chain(&got.transmittance);
    let finite = values.into_iter().all(|v| v.is_finite());
    outcome.require(finite, || "the image is not finite".into());
}

fn compare_gradients(outcome: &mut Outcome, got: &GaussianCloud, wanted: &[Gaussian64], limit: f64) {
    let got = cloud64(got);
    let mut class = |name, part: fn(&Gaussian64) -> Vec<f64>| {
        let pairs = got.iter().zip(wanted).flat_map(|(a, b)| part(a).into_iter().zip(part(b)));
        outcome.measure(name, error(pairs, GRADIENT_FLOOR), limit);
    };
    class("gradient: position", |g| g.mean.iter().copied().collect());
    class("gradient: scale", |g| g.log_scale.iter().copied().collect());
    class("gradient: rotation", |g| g.rotation.iter().copied().collect());
    class("gradient: opacity", |g| vec![g.raw_opacity]);
    class("gradient: harmonics", |g| g.sh.iter().flatten().copied().collect());
    let finite = got.iter().flat_map(Gaussian64::flat).all(f64::is_finite);
    outcome.require(finite, || "a gradient is not finite".into());
}

/// A random gradient by the image, zero where a pixel is not trusted.
fn image_gradient(rng: &mut Rng, trusted: &[bool]) -> ImageGradient64 {
    let mut number = |trusted: &bool| if *trusted { f64::from(between(rng, -1.0, 1.0)) } else { 0.0 };
    ImageGradient64 {
        color: trusted.iter().map(|t| Vector3::new(number(t), number(t), number(t))).collect(),
        depth: trusted.iter().map(&mut number).collect(),
        alpha: trusted.iter().map(&mut number).collect(),
        surface: trusted.iter().map(|t| Vector3::new(number(t), number(t), number(t))).collect(),
    }
}

fn check(machine: &Machine, rng: &mut Rng, scene: &Scene, surface: Surface) -> Result<Outcome, GpuError> {
    let (view, wide) = (View64 { surface, ..view64(scene) }, cloud64(&scene.cloud));
    let limits = [IMAGE_LIMIT, GRADIENT_LIMIT];
    let is_trusted = |pixel: &Conditioning| pixel.near_cutoffs == 0 && pixel.exponent_error < UNCERTAIN;
    let trusted: Vec<bool> = pixel_conditioning(&view, &wide, BAND).iter().map(is_trusted).collect();
    compare(machine, rng, scene, &Expected { view: &view, gaussians: &wide, trusted: &trusted }, limits)
}

/// The oracle's input, and the pixels whose values rounding cannot change much.
struct Expected<'a> {
    view: &'a View64,
    gaussians: &'a [Gaussian64],
    trusted: &'a [bool],
}

/// Renders the scene and pulls a random gradient back, on the GPU and by the oracle, whose view and map may be another's.
fn compare(
    machine: &Machine,
    rng: &mut Rng,
    scene: &Scene,
    expected: &Expected<'_>,
    [image_limit, gradient_limit]: [f64; 2],
) -> Result<Outcome, GpuError> {
    let Expected { view, gaussians: wide, trusted } = *expected;
    let mut outcome = Outcome::default();
    outcome.count("pixels", trusted.len());
    outcome.count("left out", trusted.iter().filter(|t| !**t).count());
    let on_gpu = machine.upload(&scene.cloud)?;
    let by_image = image_gradient(rng, trusted);
    let colors = by_image.color.iter().zip(&by_image.depth);
    let color_depth = colors.map(|(c, d)| [c.x as f32, c.y as f32, c.z as f32, *d as f32]).collect();
    let alpha = by_image.alpha.iter().map(|a| *a as f32).collect();
    let surface = by_image.surface.iter().map(|s| [s.x as f32, s.y as f32, s.z as f32, 0.0]).collect();
    let by = ImageGradients { color_depth, alpha, surface };
    let (rendered, gradients) = machine.with_surface(rng.usize(..2), view.surface, |trainer| {
        let rendered = trainer.render(&on_gpu, &scene.camera, BACKGROUND)?;
        Ok::<_, GpuError>((rendered, trainer.gradients_from_image(&on_gpu, &scene.camera, BACKGROUND, &by)?))
    })?;
    compare_images(&mut outcome, &rendered, &rasterize_forward::render(view, wide), trusted, image_limit);
    let expected = backward(view, wide, &by_image);
    compare_gradients(&mut outcome, &gradients.cloud, &expected, gradient_limit);
    Ok(outcome)
}

/// An ordinary scene, moved `metres` away with its camera, against the oracle of the scene at home: what f32 leaves of it.
fn shifted(machine: &Machine, rng: &mut Rng, metres: f64) -> Result<Outcome, GpuError> {
    let scene = Scene::random(rng, Fault::None);
    let away = Se3::translation(0.7 * metres, -0.1 * metres, 0.7 * metres);
    let there = scene.moved(&away, 1.0);
    // Cut-offs are taken as they come: what they do to the image is part of the loss.
    let pixels = (scene.camera.pinhole.width * scene.camera.pinhole.height) as usize;
    let (view, wide) = (view64(&scene), cloud64(&scene.cloud));
    let limits = [f64::INFINITY, f64::INFINITY];
    let mut outcome =
        compare(machine, rng, &there, &Expected { view: &view, gaussians: &wide, trusted: &vec![true; pixels] }, limits)?;
    let on_gpu = machine.upload(&there.cloud)?;
    let rendered = machine.with(0, |trainer| trainer.render(&on_gpu, &there.camera, BACKGROUND))?;
    outcome.note("colours against home, RMS", rms(&rendered, &rasterize_forward::render(&view, &wide)));
    // What the positions alone lose by being written in f32 there: the same, rendered by the oracle.
    let back = away.inverse();
    let mut rounded = scene.cloud.clone();
    rounded.means = there.cloud.means.iter().map(|m| narrow(&(back * Point3::from(m.to_array().map(f64::from))))).collect();
    let rounded = rasterize_forward::render(&view, &cloud64(&rounded));
    outcome.note("of rounded positions alone, RMS", rms(&rendered_of(&rounded), &rasterize_forward::render(&view, &wide)));
    Ok(outcome)
}

fn rendered_of(image: &Image64) -> Rendered {
    let color_depth = image.color.iter().zip(&image.depth).map(|(c, d)| [c.x as f32, c.y as f32, c.z as f32, *d as f32]);
    let transmittance = image.transmittance.iter().map(|t| *t as f32).collect();
    Rendered { width: 0, height: 0, color_depth: color_depth.collect(), transmittance, surface: Vec::new() }
}

fn rms(got: &Rendered, wanted: &Image64) -> f64 {
    let squares =
        got.color_depth.iter().zip(&wanted.color).flat_map(|(g, w)| (0..3).map(move |c| (f64::from(g[c]) - w[c]).powi(2)));
    (squares.sum::<f64>() / (3 * wanted.color.len()) as f64).sqrt()
}
