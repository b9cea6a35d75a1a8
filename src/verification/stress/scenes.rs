//! Random scenes: ordinary ones, and ones with a fault.

use fastrand::Rng;
use glam::{Quat, Vec3};
use nalgebra::{Isometry3, Point3, Vector2, Vector6};

use crate::geometry::{Pinhole, Se3, se3};
use crate::splat::{Gaussian, GaussianCloud, ShDegree, ViewCamera};

pub fn between(rng: &mut Rng, low: f32, high: f32) -> f32 {
    low + (high - low) * rng.f32()
}

/// A standard normal number, nearly: the sum of twelve uniform ones.
pub fn gauss(rng: &mut Rng) -> f64 {
    (0..12).map(|_| rng.f64()).sum::<f64>() - 6.0
}

fn direction(rng: &mut Rng) -> Vec3 {
    Vec3::from_array(std::array::from_fn(|_| between(rng, -1.0, 1.0)))
}

/// Fault of a scene. Faults of Gaussians strike every third of them.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Fault {
    None,
    Huge,
    Tiny,
    Needles,
    Discs,
    NearPlane,
    Behind,
    Beside,
    FarAway,
    Opacity,
    AlphaCutOff,
    NoRotation,
    OutOfGamut,
    /// All on one pixel.
    Crowd,
    OnePixelImage,
    OddImage,
    /// Each struck Gaussian has one of these faults.
    Any,
}

impl Fault {
    pub const ALL: [(Self, &'static str); 17] = [
        (Self::None, "ordinary"),
        (Self::Huge, "huge Gaussians"),
        (Self::Tiny, "tiny Gaussians"),
        (Self::Needles, "needles"),
        (Self::Discs, "discs"),
        (Self::NearPlane, "at the near plane"),
        (Self::Behind, "behind the camera"),
        (Self::Beside, "beside the frustum"),
        (Self::FarAway, "far away"),
        (Self::Opacity, "opacity near 0 and 1"),
        (Self::AlphaCutOff, "opacity at the cut-off"),
        (Self::NoRotation, "no rotation"),
        (Self::OutOfGamut, "out of gamut"),
        (Self::Crowd, "all on one pixel"),
        (Self::OnePixelImage, "one pixel"),
        (Self::OddImage, "odd sizes"),
        (Self::Any, "all faults"),
    ];

    /// Those that one Gaussian can have.
    const OF_GAUSSIANS: [Self; 12] = [
        Self::Huge,
        Self::Tiny,
        Self::Needles,
        Self::Discs,
        Self::NearPlane,
        Self::Behind,
        Self::Beside,
        Self::FarAway,
        Self::Opacity,
        Self::AlphaCutOff,
        Self::NoRotation,
        Self::OutOfGamut,
    ];

    fn size(self, rng: &mut Rng) -> (u32, u32) {
        match self {
            Self::OnePixelImage => (1, 1),
            Self::OddImage => (rng.u32(1..=50), rng.u32(1..=40)),
            _ => [(32, 24), (48, 32), (36, 26)][rng.usize(..3)],
        }
    }

    fn spoil(self, rng: &mut Rng, camera: &ViewCamera, gaussian: &mut Gaussian) {
        let strength = rng.f32();
        let world_from_camera = camera.camera_from_world.inverse();
        let place = |x: f32, y: f32, z: f32| narrow(&(world_from_camera * Point3::new(x, y, z).cast()));
        match self {
            Self::Huge => gaussian.log_scale += 60.0 * strength,
            Self::Tiny => gaussian.log_scale -= 60.0 * strength,
            Self::Needles => gaussian.log_scale.x += 12.0 * strength,
            Self::Discs => gaussian.log_scale.z -= 14.0 * strength,
            Self::NearPlane => {
                gaussian.mean = place(0.1 * rng.f32() - 0.05, 0.1 * rng.f32() - 0.05, 0.1 * strength);
                gaussian.log_scale -= 3.0 * rng.f32();
            }
            Self::Behind => gaussian.mean = place(rng.f32() - 0.5, rng.f32() - 0.5, -5.0 * strength),
            Self::Beside => gaussian.mean.x += 40.0 * (strength - 0.5),
            Self::FarAway => gaussian.mean *= 10f32.powf(6.0 * strength),
            Self::Opacity => gaussian.raw_opacity = 120.0 * (strength - 0.5),
            Self::AlphaCutOff => gaussian.raw_opacity = -5.537_334 + 1e-3 * (strength - 0.5),
            Self::NoRotation => gaussian.rotation *= if strength < 0.2 { 0.0 } else { 10f32.powf(-6.0 * strength) },
            Self::OutOfGamut => gaussian.sh[0] *= 50.0 * strength,
            Self::Any => Self::OF_GAUSSIANS[rng.usize(..Self::OF_GAUSSIANS.len())].spoil(rng, camera, gaussian),
            Self::None | Self::Crowd | Self::OnePixelImage | Self::OddImage => {}
        }
    }
}

pub fn narrow(p: &Point3<f64>) -> Vec3 {
    Vec3::new(p.x as f32, p.y as f32, p.z as f32)
}

/// A camera with its principal point off the centre, near the origin, looking roughly along z.
pub fn camera(rng: &mut Rng, (width, height): (u32, u32)) -> ViewCamera {
    let focal = f64::from(width.max(8)) * 0.9;
    let tau = Vector6::from_fn(|_, _| f64::from(between(rng, -0.15, 0.15)));
    let (cx, cy) = (f64::from(width) * 0.47, f64::from(height) * 0.54);
    ViewCamera { pinhole: Pinhole { fx: focal, fy: focal * 1.03, cx, cy, width, height }, camera_from_world: se3::exp(&tau) }
}

/// A Gaussian in front of the origin, some of them off the frustum, some faint, some nearly opaque.
pub fn gaussian(rng: &mut Rng, sh_degree: ShDegree) -> Gaussian {
    let z = between(rng, 0.6, 4.0);
    let size = between(rng, -4.5, -1.5);
    Gaussian {
        mean: Vec3::new(between(rng, -0.8, 0.8) * z, between(rng, -0.6, 0.6) * z, z),
        log_scale: Vec3::splat(size) + direction(rng) * 0.8,
        rotation: Quat::from_array(std::array::from_fn(|_| between(rng, -1.0, 1.0))),
        raw_opacity: between(rng, -3.0, 3.5),
        sh: (0..sh_degree.coefficients()).map(|k| direction(rng) * if k == 0 { 1.5 } else { 0.4 }).collect(),
    }
}

/// A map and a view of it.
#[derive(Clone, Debug)]
pub struct Scene {
    pub camera: ViewCamera,
    pub cloud: GaussianCloud,
}

impl Scene {
    pub fn random(rng: &mut Rng, fault: Fault) -> Self {
        let size = fault.size(rng);
        let camera = camera(rng, size);
        let sh_degree = ShDegree::ALL[rng.usize(..4)];
        let mut cloud = GaussianCloud::new(sh_degree);
        let crowd = Vector2::new(f64::from(size.0) * rng.f64(), f64::from(size.1) * rng.f64());
        for i in 0..rng.usize(10..160) {
            let mut gaussian = gaussian(rng, sh_degree);
            if fault == Fault::Crowd {
                let p_in_camera = Point3::from(camera.pinhole.unproject(&crowd, gaussian.mean.z.into()));
                gaussian.mean = narrow(&(camera.camera_from_world.inverse() * p_in_camera));
            }
            if i % 3 == 0 {
                fault.spoil(rng, &camera, &mut gaussian);
            }
            cloud.push(gaussian);
        }
        Self { camera, cloud }
    }

    /// A copy with the world moved (new_from_old) and then made `scale` times as large. Higher harmonics are not turned.
    pub fn moved(&self, new_from_old: &Se3, scale: f64) -> Self {
        let turn = new_from_old.rotation.coords.map(|v| v as f32);
        let turn = Quat::from_xyzw(turn.x, turn.y, turn.z, turn.w);
        let mut cloud = self.cloud.clone();
        for i in 0..cloud.len() {
            let m = cloud.means[i].to_array().map(f64::from);
            cloud.means[i] = narrow(&Point3::from((new_from_old * Point3::from(m)).coords * scale));
            cloud.log_scales[i] += scale.ln() as f32;
            cloud.rotations[i] = turn * cloud.rotations[i];
        }
        Self { camera: moved_camera(&self.camera, new_from_old, scale), cloud }
    }
}

/// The camera that sees a moved and scaled world as `camera` saw it before.
pub fn moved_camera(camera: &ViewCamera, new_from_old: &Se3, scale: f64) -> ViewCamera {
    let moved = camera.camera_from_world * new_from_old.inverse();
    let camera_from_world = Isometry3::from_parts((moved.translation.vector * scale).into(), moved.rotation);
    ViewCamera { camera_from_world, ..*camera }
}
