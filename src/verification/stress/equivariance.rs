//! The same world elsewhere, turned, or of another size must give the same map there.
//!
//! Shifts, half turns and sizes are exact symmetries of a training step: positions move in units of their Gaussian's size, and Adam works
//! number by number, so that it knows axes up to their order and sign. By any other turn the gradients turn along, but Adam's steps do
//! not; then only the gradients, and how well the map fits in the end, are compared.
//!
//! What may differ is rounding, which steps amplify: Adam's first steps are as long for tiny gradients as for large ones. How much, a
//! control tells: the world at home from positions as f32 writes them there, with a rounding more on every number.

use fastrand::Rng;
use nalgebra::{UnitQuaternion, Vector3, Vector4};

use super::long::target;
use super::scenes::{self, Fault, Scene};
use super::{Family, Machine, Outcome, Part};
use crate::geometry::Se3;
use crate::gpu::GpuError;
use crate::optimise::{AdamConfig, LossConfig, TargetImage, Trainer, TrainingView};
use crate::splat::{Gaussian, GaussianCloud, ShDegree};
use crate::verification::reference::{Gaussian64, cloud64};

const STEPS: usize = 60;
/// How many times the control's difference, and beyond that how much of what the parameters travelled, a moved run may differ. Controls are
/// 1e-4 off as a rule and 1e-2 at times, where a pair at a cut-off goes the other way early; a wrong exponent of the size would be 1.
const CONTROL_FACTOR: f64 = 5.0;
const TRAVEL_SHARE: f64 = 2e-2;
/// One case in so many.
const EVERY: usize = 10;
/// A gradient's largest difference, of its largest magnitude: pairs at the cut-off of 1/255 come and go with a rounding.
const GRADIENT_LIMIT: f64 = 1e-2;
/// How much better or worse than at home a map may fit that was turned by any angle: each path through 60 steps is one of many, and the
/// loss has fallen to a sixth.
const LOSS_LIMIT: f64 = 1.0;

pub fn families(machine: &Machine) -> Vec<Family<'_>> {
    let family = |name: &str, motion: fn(&mut Rng) -> (Se3, f64), expected: Expected| {
        let case = move |rng: &mut Rng| {
            let (new_from_old, scale) = motion(rng);
            moved_run(machine, rng, &new_from_old, scale, expected)
        };
        Family::new(Part::Equivariance, format!("equivariance: {name}"), EVERY, case)
    };
    vec![
        family("shifted 3 m", |rng| (shift(rng, 3.0), 1.0), Expected::Same),
        family("shifted 100 m", |rng| (shift(rng, 100.0), 1.0), Expected::Same),
        family("shifted 10 km", |rng| (shift(rng, 1e4), 1.0), Expected::Anything),
        family("half turn", |rng| (half_turn(rng), 1.0), Expected::Same),
        family("size from 0.1 to 100", |rng| (Se3::identity(), 0.1 * 1000f64.powf(rng.f64())), Expected::Same),
        family("any turn", |rng| (any_turn(rng), 1.0), Expected::SameGradient),
    ]
}

/// Checks of a moved world.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Expected {
    /// The moved map.
    Same,
    /// The moved gradient, and a map that fits about as well.
    SameGradient,
    /// That far away f32 is too coarse for positions; what remains is only reported.
    Anything,
}

fn direction(rng: &mut Rng) -> Vector3<f64> {
    Vector3::from_fn(|_, _| 2.0 * rng.f64() - 1.0).normalize()
}

fn shift(rng: &mut Rng, metres: f64) -> Se3 {
    Se3::from_parts((direction(rng) * metres).into(), UnitQuaternion::identity())
}

fn half_turn(rng: &mut Rng) -> Se3 {
    let axis = [Vector3::x_axis(), Vector3::y_axis(), Vector3::z_axis()][rng.usize(..3)];
    Se3::from_parts(Vector3::zeros().into(), UnitQuaternion::from_axis_angle(&axis, std::f64::consts::PI))
}

fn any_turn(rng: &mut Rng) -> Se3 {
    Se3::new(Vector3::zeros(), direction(rng) * 3.0 * rng.f64())
}

/// A run's end: the map, the loss over the steps, and the gradient before the first.
struct Run {
    map: GaussianCloud,
    losses: Vec<f64>,
    gradient: Vec<Gaussian64>,
}

fn run(machine: &Machine, scene: &Scene, target: &TargetImage, loss: &LossConfig) -> Result<Run, GpuError> {
    let on_gpu = machine.upload(&scene.cloud)?;
    let view = TrainingView::new(scene.camera, target);
    // A new one each time: the number of steps so far decides on the windows of SSIM.
    let mut trainer = Trainer::new(machine.gpu.clone())?;
    let gradient = trainer.gradients(&on_gpu, &scene.camera, target, loss)?.cloud;
    let reports = trainer.steps(&on_gpu, &[view; STEPS], loss, &AdamConfig::default())?;
    let losses = reports.iter().map(|r| f64::from(r.loss.total(loss))).collect();
    Ok(Run { map: on_gpu.download(&machine.gpu)?, losses, gradient: cloud64(&gradient) })
}

/// A scene to fit another one's picture with, its harmonics constant: higher ones are not turned.
fn scene(rng: &mut Rng) -> Scene {
    let camera = scenes::camera(rng, (48, 32));
    let mut cloud = GaussianCloud::new(ShDegree::default());
    (0..80).for_each(|_| cloud.push(scenes::gaussian(rng, cloud.sh_degree)));
    Scene { camera, cloud }
}

/// A target of the scene's size of world, rendered at home: pictures are the same everywhere, depths grow with the world.
fn targets(machine: &Machine, rng: &mut Rng, scene: &Scene, scale: f64) -> Result<[TargetImage; 2], GpuError> {
    let other = Scene { camera: scene.camera, ..Scene::random(rng, Fault::None) };
    let on_gpu = machine.upload(&other.cloud)?;
    let mut rendered = machine.with(1, |trainer| trainer.render(&on_gpu, &scene.camera, [0.0; 3]))?;
    let at_home = target(machine, &rendered)?;
    rendered.color_depth.iter_mut().for_each(|v| v[3] *= scale as f32);
    Ok([at_home, target(machine, &rendered)?])
}

fn moved_run(machine: &Machine, rng: &mut Rng, new_from_old: &Se3, scale: f64, expected: Expected) -> Result<Outcome, GpuError> {
    let home = scene(rng);
    let [at_home, elsewhere] = targets(machine, rng, &home, scale)?;
    let loss = LossConfig::default();
    let scaled = scale as f32;
    let scaled_loss = LossConfig {
        depth_weight: loss.depth_weight / scaled,
        precise_depth_metres: loss.precise_depth_metres * scaled,
        ..loss.clone()
    };
    let there = home.moved(new_from_old, scale);
    let before = run(machine, &home, &at_home, &loss)?;
    let after = run(machine, &there, &elsewhere, &scaled_loss)?;
    let mut outcome = Outcome::default();
    let limited = |limit| if expected == Expected::Anything { f64::INFINITY } else { limit };
    compare_gradients(&mut outcome, &before, &after, &new_from_old.rotation, scale, limited(GRADIENT_LIMIT));
    let [last, last_there] = [&before, &after].map(|run| run.losses[STEPS - 1]);
    outcome.note("loss at the end, of the first", last / before.losses[0]);
    if expected == Expected::Same {
        let back = |map: &GaussianCloud| Scene { camera: there.camera, cloud: map.clone() }.moved_back(new_from_old, scale);
        let control = Scene { cloud: rounded_again(rng, &back(&there.cloud)), ..home.clone() };
        let control = run(machine, &control, &at_home, &loss)?;
        let travel = distance(&before.map, &home.cloud);
        let [by_moving, by_rounding] = [back(&after.map), control.map].map(|map| distance(&map, &before.map) / travel);
        outcome.note("control: difference, of the travel", by_rounding);
        outcome.measure("difference, of the travel", by_moving, CONTROL_FACTOR * by_rounding + TRAVEL_SHARE);
    }
    outcome.measure("loss off", (last_there / last - 1.0).abs(), limited(LOSS_LIMIT));
    Ok(outcome)
}

impl Scene {
    /// The map as it was before the world was moved and scaled.
    fn moved_back(&self, new_from_old: &Se3, scale: f64) -> GaussianCloud {
        let shrunk = Self { camera: self.camera, cloud: self.cloud.clone() }.moved(&Se3::identity(), 1.0 / scale);
        shrunk.moved(&new_from_old.inverse(), 1.0).cloud
    }
}

/// The map with every number one rounding off, up or down.
fn rounded_again(rng: &mut Rng, cloud: &GaussianCloud) -> GaussianCloud {
    let mut nudge = |v: f32| v * (1.0 + if rng.bool() { f32::EPSILON } else { -f32::EPSILON });
    let mut all = GaussianCloud::new(cloud.sh_degree);
    for i in 0..cloud.len() {
        let g = cloud.get(i);
        let [mut mean, mut log_scale] = [g.mean, g.log_scale].map(|v| v.to_array());
        mean.iter_mut().chain(&mut log_scale).for_each(|v| *v = nudge(*v));
        all.push(Gaussian { mean: mean.into(), log_scale: log_scale.into(), raw_opacity: nudge(g.raw_opacity), ..g });
    }
    all
}

/// How far two maps of the same Gaussians are apart: positions in units of the Gaussians' sizes, everything else as the optimiser counts.
fn distance(a: &GaussianCloud, b: &GaussianCloud) -> f64 {
    let of = |(a, b): (&Gaussian64, &Gaussian64)| {
        let size = (b.log_scale.sum() / 3.0).exp();
        let mean = (a.mean - b.mean).norm_squared() / (size * size);
        let rotation = (a.rotation - b.rotation).norm_squared().min((a.rotation + b.rotation).norm_squared());
        let others = (a.log_scale - b.log_scale).norm_squared() + (a.sh[0] - b.sh[0]).norm_squared();
        mean + rotation + others + (a.raw_opacity - b.raw_opacity).powi(2)
    };
    cloud64(a).iter().zip(&cloud64(b)).map(of).sum::<f64>().sqrt()
}

/// The gradient there, brought home: by positions it turns with the world and shrinks with its size, by quaternions it is multiplied by
/// the turn, as they are.
fn compare_gradients(outcome: &mut Outcome, home: &Run, there: &Run, turn: &UnitQuaternion<f64>, scale: f64, limit: f64) {
    let unturned = |q: &Vector4<f64>| {
        let q = turn.quaternion().conjugate() * nalgebra::Quaternion::new(q[0], q[1], q[2], q[3]);
        Vector4::new(q.w, q.i, q.j, q.k)
    };
    let back =
        |g: &Gaussian64| Gaussian64 { mean: turn.inverse() * g.mean * scale, rotation: unturned(&g.rotation), ..g.clone() };
    let there: Vec<Gaussian64> = there.gradient.iter().map(back).collect();
    let mut class = |name, part: fn(&Gaussian64) -> Vec<f64>| {
        let pairs = home.gradient.iter().zip(&there).flat_map(|(a, b)| part(a).into_iter().zip(part(b)));
        let (off, most) = pairs.fold((0.0f64, 1e-12f64), |(off, most), (a, b)| (off.max((a - b).abs()), most.max(a.abs())));
        outcome.measure(name, off / most, limit);
    };
    class("gradient: position", |g| g.mean.iter().copied().collect());
    class("gradient: scale", |g| g.log_scale.iter().copied().collect());
    class("gradient: rotation", |g| g.rotation.iter().copied().collect());
    class("gradient: opacity", |g| vec![g.raw_opacity]);
    class("gradient: colour", |g| g.sh[0].iter().copied().collect());
}

#[cfg(test)]
mod tests {
    use nalgebra::Point3;

    use super::*;

    #[test]
    fn a_scene_moved_and_moved_back_is_the_same() {
        let mut rng = Rng::with_seed(3);
        let home = scene(&mut rng);
        let motion = Se3::new(Vector3::new(1.0, -2.0, 0.5), Vector3::new(0.3, 1.0, -0.2));
        let there = home.moved(&motion, 7.0);
        assert!(distance(&there.moved_back(&motion, 7.0), &home.cloud) < 1e-2);
        // A point is seen at the same pixel, seven times as far away.
        let seen = |scene: &Scene| scene.camera.camera_from_world * Point3::from(scene.cloud.means[5].to_array().map(f64::from));
        assert!((seen(&there).coords - seen(&home).coords * 7.0).norm() < 1e-4);
    }
}
