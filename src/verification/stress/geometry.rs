//! Made-up worlds for the tracker's solvers, and what noise lets one know of them.

use fastrand::Rng;
use nalgebra::{DMatrix, DVector, Point3, UnitQuaternion, Vector2, Vector3, Vector6};

use super::scenes::gauss;
use crate::geometry::{Pinhole, Se3, Sim3, se3};
use crate::tracking::solvers::residual::{InlierClass, Measurement};

pub const PINHOLE: Pinhole = Pinhole { fx: 520.0, fy: 515.0, cx: 320.5, cy: 241.0, width: 640, height: 480 };
/// Noise of a pixel's coordinates, and of an inverse depth in a world of size 1.
pub const PIXEL_SIGMA: f64 = 0.5;
pub const INVERSE_DEPTH_SIGMA: f64 = 0.01;

/// How points lie before the camera.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Shape {
    Volume,
    /// A slanted plane.
    Plane,
    Line,
    /// Within 30 pixels.
    Patch,
}

/// A world: what it looks like from near by, and where and how large it is.
#[derive(Clone, Copy, Debug)]
pub struct World {
    pub shape: Shape,
    /// Depths, before scaling.
    pub near: f64,
    pub far: f64,
    pub scale: f64,
    /// How far the origin of its coordinates is away, before scaling.
    pub away: f64,
}

pub const VOLUME: World = World { shape: Shape::Volume, near: 1.0, far: 4.0, scale: 1.0, away: 0.0 };
pub const PLANE: World = World { shape: Shape::Plane, ..VOLUME };

/// Worlds that every solver meets.
pub const WORLDS: [(&str, World); 9] = [
    ("volume", VOLUME),
    ("plane", PLANE),
    ("far points", World { near: 50.0, far: 200.0, ..VOLUME }),
    ("line", World { shape: Shape::Line, ..VOLUME }),
    ("patch", World { shape: Shape::Patch, ..VOLUME }),
    ("10 km away", World { away: 1e4, ..VOLUME }),
    ("plane 10 km away", World { away: 1e4, ..PLANE }),
    ("size 1e-3", World { scale: 1e-3, ..VOLUME }),
    ("size 1e3", World { scale: 1e3, ..VOLUME }),
];

impl World {
    /// A point that a camera at home sees somewhere on its image, in that camera's frame, before scaling.
    pub fn point(&self, rng: &mut Rng) -> Vector3<f64> {
        let (u, v) = (rng.f64(), rng.f64());
        let pixel = match self.shape {
            Shape::Volume | Shape::Plane => Vector2::new(640.0 * u, 480.0 * v),
            Shape::Line => Vector2::new(100.0 + 440.0 * u, 150.0 + 180.0 * u),
            Shape::Patch => Vector2::new(300.0 + 30.0 * u, 200.0 + 30.0 * v),
        };
        let spread = self.far - self.near;
        let depth = match self.shape {
            Shape::Plane => self.near + spread * (0.3 + 0.3 * pixel.x / 640.0 + 0.2 * pixel.y / 480.0),
            Shape::Line => self.near + spread * u,
            Shape::Volume | Shape::Patch => self.near + spread * rng.f64(),
        };
        PINHOLE.unproject(&pixel, depth)
    }

    /// Where the world's coordinates are: world_from_home.
    pub fn placed(&self, rng: &mut Rng) -> Sim3 {
        let turn = Vector3::from_fn(|_, _| 2.0 * rng.f64() - 1.0);
        let away = Vector3::new(0.7, -0.1, 0.7) * self.away * self.scale;
        Sim3 { rotation: UnitQuaternion::from_scaled_axis(turn), translation: away, scale: self.scale }
    }

    /// camera_from_world of a camera whose pose is known at home.
    pub fn camera(&self, camera_from_home: &Se3, world_from_home: &Sim3) -> Se3 {
        let scaled = Sim3 { scale: self.scale, ..Sim3::identity() };
        let camera = scaled * Sim3::from(*camera_from_home) * world_from_home.inverse();
        Se3::from_parts(camera.translation.into(), camera.rotation)
    }

    /// A noisy measurement of a point in the camera frame.
    pub fn measure(&self, rng: &mut Rng, p_in_camera: &Vector3<f64>, with_depth: bool) -> Option<Measurement> {
        let pixel = PINHOLE.project(&(p_in_camera / self.scale))? + noise(rng);
        let (depth, sigma) = (p_in_camera.z, INVERSE_DEPTH_SIGMA / self.scale);
        let inverse_depth = with_depth.then(|| 1.0 / depth + gauss(rng) * sigma);
        Some(Measurement { pixel, inverse_depth, pixel_weight: 1.0 / PIXEL_SIGMA, depth_weight: 1.0 / sigma })
    }
}

pub fn noise(rng: &mut Rng) -> Vector2<f64> {
    Vector2::new(gauss(rng), gauss(rng)) * PIXEL_SIGMA
}

pub fn trust(measurement: &Measurement) -> InlierClass {
    if measurement.inverse_depth.is_some() { InlierClass::Full } else { InlierClass::PixelOnly }
}

/// A pose near the identity: up to `metres` and `rad` along and about each axis.
pub fn small_motion(rng: &mut Rng, metres: f64, rad: f64) -> Se3 {
    let mut within = |most: f64| most * (2.0 * rng.f64() - 1.0);
    se3::exp(&Vector6::new(within(metres), within(metres), within(metres), within(rad), within(rad), within(rad)))
}

/// Information matrix of whitened residuals at 0: JᵀJ, J by central differences.
pub fn information(residuals: impl Fn(&DVector<f64>) -> DVector<f64>, unknowns: usize) -> DMatrix<f64> {
    const STEP: f64 = 1e-6;
    let columns: Vec<DVector<f64>> = (0..unknowns)
        .map(|k| {
            let mut step = DVector::zeros(unknowns);
            step[k] = STEP;
            (residuals(&step) - residuals(&-step)) / (2.0 * STEP)
        })
        .collect();
    let jacobian = DMatrix::from_columns(&columns);
    jacobian.transpose() * jacobian
}

/// An error in standard deviations: 1 is what the noise alone makes of it.
pub fn sigmas(error: &DVector<f64>, information: &DMatrix<f64>) -> f64 {
    ((error.transpose() * information * error)[0] / error.len() as f64).sqrt()
}

/// Logarithm to base 10 of the condition number of the normal equations.
pub fn condition(information: &DMatrix<f64>) -> f64 {
    let values = information.symmetric_eigenvalues();
    (values.max() / values.min().max(1e-300)).log10()
}

/// The left-handed error `found · truth⁻¹`, its translation in units of the world's size.
pub fn pose_error(found: &Se3, truth: &Se3, scale: f64) -> DVector<f64> {
    let mut error = se3::log(&(found * truth.inverse()));
    error.fixed_rows_mut::<3>(0).scale_mut(1.0 / scale);
    DVector::from_column_slice(error.as_slice())
}

/// A pose moved by a left step whose translation is in units of the world's size.
pub fn step(pose: &Se3, step: &DVector<f64>, scale: f64) -> Se3 {
    let mut tau = Vector6::from_column_slice(step.as_slice());
    tau.fixed_rows_mut::<3>(0).scale_mut(scale);
    se3::exp(&tau) * pose
}

pub fn is_finite(pose: &Se3) -> bool {
    pose.translation.vector.iter().chain(pose.rotation.coords.iter()).all(|v| v.is_finite())
}

pub fn world_point(world_from_home: &Sim3, camera_from_home: &Se3, p_in_camera: &Vector3<f64>) -> Point3<f64> {
    world_from_home.act(&camera_from_home.inverse_transform_point(&Point3::from(*p_in_camera)))
}
