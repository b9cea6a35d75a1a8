//! Random scenes full of degenerate Gaussians: whatever goes in, images and gradients are finite, and right wherever rounding does not
//! decide a cut-off.

use std::sync::{Arc, Mutex, OnceLock};

use fastrand::Rng;
use keysplat::gpu::Gpu;
use keysplat::optimise::{ImageGradients, Trainer};
use keysplat::render::{BlendForm, GpuCloud};
use keysplat::splat::{Gaussian, GaussianCloud, ShDegree};
use keysplat::verification::reference::project_backward::backward;
use keysplat::verification::reference::rasterize_forward::Conditioning;
use keysplat::verification::reference::{Cutoffs, Gaussian64, View64, cloud64, rasterize_forward};
use nalgebra::Vector3;
use proptest::prelude::*;

const SIZE: (u32, u32) = (36, 26);
/// Relative distance from a cut-off within which f32 and f64 may disagree.
const BAND: f64 = 2e-4;
/// Errors by norm: away from the cut-offs, and where some pairs lie in the band. There a pair may appear or vanish at 1/255.
const CLEAR_TOLERANCE: f64 = 1e-3;
const BAND_TOLERANCE: f64 = 3e-2;
/// An exponent whose rounding error exceeds this (a needle thousands of pixels long) says nothing; only finiteness is asked then.
const HOPELESS: f64 = 3e-3;

struct Machine {
    gpu: Arc<Gpu>,
    /// One of each form of the blending passes; they take turns.
    forms: Vec<Trainer>,
}

/// One device for all cases; `None`, said once, without an adapter.
fn machine() -> Option<&'static Mutex<Machine>> {
    static MACHINE: OnceLock<Result<Mutex<Machine>, String>> = OnceLock::new();
    let machine = MACHINE.get_or_init(|| match Gpu::open(None) {
        Ok(gpu) => {
            let form = |&form| Trainer::with_blending(gpu.clone(), form).unwrap();
            let forms = BlendForm::ALL.iter().map(form).collect();
            Ok(Mutex::new(Machine { gpu, forms }))
        }
        Err(error) => Err(error.to_string()),
    });
    machine.as_ref().inspect_err(|error| crate::common::requirements::skip("adapter", error)).ok()
}

/// What is wrong with a Gaussian, with a strength in [0, 1].
fn spoil(gaussian: &mut Gaussian, fault: u8, strength: f32) {
    let up_to = |high: f32| strength * high;
    match fault {
        0 => gaussian.rotation *= up_to(1e-3),
        1 => gaussian.log_scale += up_to(60.0),
        2 => gaussian.log_scale -= up_to(60.0),
        3 => gaussian.log_scale.x += up_to(12.0),
        4 => gaussian.mean.z = up_to(0.1),
        5 => gaussian.mean.z = -up_to(5.0),
        6 => gaussian.raw_opacity = up_to(60.0),
        7 => gaussian.raw_opacity = -up_to(60.0),
        8 => gaussian.mean *= 1.0 + up_to(1e6),
        9 => gaussian.mean.x += up_to(20.0),
        _ => {}
    }
}

/// `(fault, strength)` of each Gaussian; most have none.
fn faults() -> impl Strategy<Value = Vec<(u8, f32)>> {
    prop::collection::vec((0u8..24, 0.0f32..1.0), 10..60)
}

fn scene(seed: u64, faults: &[(u8, f32)]) -> (View64, GaussianCloud) {
    let mut rng = Rng::with_seed(seed);
    let camera = crate::common::camera(&mut rng, SIZE.0, SIZE.1);
    let degree = ShDegree::ALL[(seed / 2 % 4) as usize];
    let clean = crate::common::scene(&mut rng, faults.len(), degree);
    let mut cloud = GaussianCloud::new(degree);
    for (i, (fault, strength)) in faults.iter().enumerate() {
        let mut gaussian = clean.get(i);
        spoil(&mut gaussian, *fault, *strength);
        cloud.push(gaussian);
    }
    (
        View64 {
            camera,
            background: Vector3::new(0.1, 0.2, 0.3),
            cutoffs: Cutoffs::Sharp,
            antialiased: false,
            surface: Default::default(),
        },
        cloud,
    )
}

fn narrow(v: &Vector3<f64>) -> [f32; 3] {
    [v.x as f32, v.y as f32, v.z as f32]
}

fn check(seed: u64, faults: &[(u8, f32)]) -> Result<(), TestCaseError> {
    let Some(machine) = machine() else { return Ok(()) };
    let mut machine = machine.lock().unwrap();
    let Machine { gpu, forms } = &mut *machine;
    let trainer = &mut forms[seed as usize % 2];
    let (view, cloud) = scene(seed, faults);
    let wide = cloud64(&cloud);
    let mut on_gpu = GpuCloud::new(gpu, cloud.sh_degree, cloud.len()).unwrap();
    on_gpu.append(gpu, &cloud).unwrap();
    let background = narrow(&view.background);
    let judged = rasterize_forward::conditioning(&view, &wide, BAND);
    let tolerance = match judged {
        Conditioning { exponent_error, .. } if exponent_error > HOPELESS => f64::INFINITY,
        Conditioning { near_cutoffs: 0, exponent_error } if exponent_error < CLEAR_TOLERANCE / 10.0 => CLEAR_TOLERANCE,
        _ => BAND_TOLERANCE,
    };

    let rendered = trainer.render(&on_gpu, &view.camera, background).unwrap();
    let expected = rasterize_forward::render(&view, &wide);
    let got: Vec<f64> = rendered.color_depth.iter().flatten().chain(&rendered.transmittance).map(|v| f64::from(*v)).collect();
    prop_assert!(got.iter().all(|v| v.is_finite()), "the image is not finite");
    let wanted = expected.color.iter().zip(&expected.depth).flat_map(|(c, d)| [c.x, c.y, c.z, *d]);
    let wanted: Vec<f64> = wanted.chain(expected.transmittance.iter().copied()).collect();
    let error = crate::common::relative_error(&got, &wanted);
    prop_assert!(error < tolerance, "image: {error:e}, {judged:?}");

    let by_image = crate::common::image_gradient(&mut Rng::with_seed(seed), (SIZE.0 * SIZE.1) as usize);
    let color_depth = by_image
        .color
        .iter()
        .zip(&by_image.depth)
        .map(|(c, d)| {
            let [r, g, b] = narrow(c);
            [r, g, b, *d as f32]
        })
        .collect();
    let alpha = by_image.alpha.iter().map(|a| *a as f32).collect();
    let by = ImageGradients { color_depth, alpha, surface: Vec::new() };
    let got = trainer.gradients_from_image(&on_gpu, &view.camera, background, &by).unwrap();
    let flat: Vec<f64> = cloud64(&got.cloud).iter().flat_map(Gaussian64::flat).collect();
    prop_assert!(flat.iter().all(|v| v.is_finite()), "a gradient is not finite");
    let expected: Vec<f64> = backward(&view, &wide, &by_image).iter().flat_map(Gaussian64::flat).collect();
    let error = crate::common::relative_error(&flat, &expected);
    prop_assert!(error < tolerance, "gradient: {error:e}, {judged:?}");
    Ok(())
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 96, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn degenerate_scenes_stay_finite_and_right(seed in 0u64..1_000_000, faults in faults()) {
        check(seed, &faults)?;
    }

    /// NaN and infinities written straight into the buffers, past the check on insertion, are culled one by one.
    #[test]
    fn poisoned_buffers_do_not_spread(seed in 0u64..1_000_000, victims in prop::collection::vec((0usize..40, 0usize..4, 0usize..3), 1..8)) {
        let Some(machine) = machine() else { return Ok(()) };
        let mut machine = machine.lock().unwrap();
        let Machine { gpu, forms } = &mut *machine;
        let trainer = &mut forms[seed as usize % 2];
        let (view, cloud) = scene(seed, &[(99, 0.0); 40]);
        let mut on_gpu = GpuCloud::new(gpu, cloud.sh_degree, cloud.len()).unwrap();
        on_gpu.append(gpu, &cloud).unwrap();
        for (i, plane, value) in &victims {
            let value = [f32::NAN, f32::INFINITY, f32::NEG_INFINITY][*value];
            on_gpu.parameters().write(gpu, plane * on_gpu.capacity() + i, &[[value; 4]]);
        }
        let rendered = trainer.render(&on_gpu, &view.camera, [0.0; 3]).unwrap();
        prop_assert!(rendered.color_depth.iter().flatten().chain(&rendered.transmittance).all(|v| v.is_finite()));
    }
}
