//! One Gaussian in place of several: the moments of their mixture (Kerbl et al. 2024, section 4.1).

use glam::{Quat, Vec3};
use nalgebra::{Matrix2, Matrix3, Rotation3, SymmetricEigen, UnitQuaternion, Vector2, Vector3};

use crate::splat::{Gaussian, GaussianCloud, unit_rotation};

/// Bounds of the logarithm of an extent: its square stays finite, and so do sums of such squares.
pub(super) const MOST_LOG_SCALE: f64 = 30.0;
/// Exponent in Thomsen's formula of an ellipsoid's surface, which is within 1.1 %.
const THOMSEN: f64 = 1.6075;
/// Bounds of a merged opacity: its logit stays finite.
const LEAST_OPACITY: f64 = 1e-6;
const MOST_OPACITY: f64 = 0.999;
/// Most that a merge may enlarge an area.
const MOST_GROWTH: f64 = 2.0;
/// Least variance along an axis, as a share of the largest: what rounding leaves of a flat Gaussian.
const FLATTEST: f64 = 1e-12;

/// What a merge and its error need of a Gaussian.
#[derive(Clone, Copy, Debug)]
pub(super) struct Blob {
    /// World, metres.
    pub mean: Vector3<f64>,
    /// World, metres².
    pub covariance: Matrix3<f64>,
    pub opacity: f64,
    /// A quarter of the ellipsoid's surface: the mean of its shadows' areas over all directions (Cauchy), metres², up to a constant.
    pub area: f64,
}

impl Blob {
    /// Of Gaussian `i`.
    pub fn new(cloud: &GaussianCloud, i: usize) -> Self {
        let scales = cloud.log_scales[i].to_array().map(|v| f64::from(v).clamp(-MOST_LOG_SCALE, MOST_LOG_SCALE).exp());
        let [x, y, z, w] = unit_rotation(cloud.rotations[i]).to_array().map(f64::from);
        let rotation = UnitQuaternion::from_quaternion(nalgebra::Quaternion::new(w, x, y, z)).to_rotation_matrix();
        let axes = rotation.matrix() * Matrix3::from_diagonal(&Vector3::from(scales));
        Self {
            mean: Vector3::from(cloud.means[i].to_array().map(f64::from)),
            covariance: axes * axes.transpose(),
            opacity: 1.0 / (1.0 + (-f64::from(cloud.raw_opacities[i])).exp()),
            area: area(scales),
        }
    }

    /// Opacity times area.
    pub fn mass(&self) -> f64 {
        self.opacity * self.area
    }
}

/// A quarter of an ellipsoid's surface, over π.
fn area(scales: [f64; 3]) -> f64 {
    let [a, b, c] = scales.map(|scale| scale.powf(THOMSEN));
    ((a * b + b * c + c * a) / 3.0).powf(THOMSEN.recip())
}

/// Shares of two masses; halves where there is none.
pub(super) fn shares(a: f64, b: f64) -> (f64, f64) {
    let sum = a + b;
    if sum > 0.0 && sum.is_finite() { (a / sum, b / sum) } else { (0.5, 0.5) }
}

/// The two axes of each of the three planes that Gaussians are seen on.
const PLANES: [(usize, usize); 3] = [(0, 1), (1, 2), (2, 0)];

/// Mean and covariance of two Gaussians' mixture. The opacity keeps the mass; where it would exceed one, the Gaussian grows instead.
pub(super) fn merged(a: &Blob, b: &Blob) -> Blob {
    let (share_a, share_b) = shares(a.mass(), b.mass());
    let mean = a.mean * share_a + b.mean * share_b;
    let apart = a.mean - b.mean;
    let mut covariance = a.covariance * share_a + b.covariance * share_b + apart * apart.transpose() * (share_a * share_b);
    let mut area = area(scales(&covariance.symmetric_eigenvalues()));
    let mut opacity = (a.mass() + b.mass()) * (1.0 - covered_twice(a, b)) / area;
    let growth = (opacity / MOST_OPACITY).clamp(1.0, MOST_GROWTH);
    covariance *= growth;
    area *= growth;
    opacity = (opacity / growth).clamp(LEAST_OPACITY, MOST_OPACITY);
    Blob { mean, covariance, opacity, area }
}

/// The share of two Gaussians' mass that one hides of the other: blended, they cover less than their sum.
fn covered_twice(a: &Blob, b: &Blob) -> f64 {
    let (mut twice, mut all) = (0.0, 0.0);
    for (u, v) in PLANES {
        let (p, q) = (Footprint::sharp(a, u, v), Footprint::sharp(b, u, v));
        twice += p.overlap(&q);
        all += p.mass() + q.mass();
    }
    if all > 0.0 { (twice / all).min(0.5) } else { 0.0 }
}

/// A Gaussian's shadow on a plane of two axes.
#[derive(Clone, Copy, Debug)]
pub(super) struct Footprint {
    mean: Vector2<f64>,
    covariance: Matrix2<f64>,
    /// Its square root is the area, over 2π.
    determinant: f64,
    amplitude: f64,
}

impl Footprint {
    fn sharp(blob: &Blob, u: usize, v: usize) -> Self {
        let c = &blob.covariance;
        let covariance = Matrix2::new(c[(u, u)], c[(u, v)], c[(v, u)], c[(v, v)]);
        let determinant = covariance.determinant().max(0.0);
        Self { mean: Vector2::new(blob.mean[u], blob.mean[v]), covariance, determinant, amplitude: blob.opacity }
    }

    /// On each of the planes, behind a blur of this standard deviation in metres, which keeps the mass.
    pub fn blurred(blob: &Blob, blur: f64) -> [Self; 3] {
        PLANES.map(|(u, v)| {
            let sharp = Self::sharp(blob, u, v);
            let covariance = sharp.covariance + Matrix2::identity() * (blur * blur);
            let determinant = covariance.determinant().max(f64::MIN_POSITIVE);
            let amplitude = sharp.amplitude * (sharp.determinant / determinant).sqrt();
            Self { covariance, determinant, amplitude, ..sharp }
        })
    }

    fn mass(&self) -> f64 {
        self.amplitude * self.determinant.sqrt()
    }

    /// Integral of the product, over 2π.
    pub fn overlap(&self, other: &Self) -> f64 {
        let sum = self.covariance + other.covariance;
        let determinant = sum.determinant().max(f64::MIN_POSITIVE);
        let [x, y] = (self.mean - other.mean).into();
        let squared = (sum[(1, 1)] * x * x - 2.0 * sum[(0, 1)] * x * y + sum[(0, 0)] * y * y) / determinant;
        let areas = (self.determinant / determinant).sqrt() * other.determinant.sqrt();
        self.amplitude * other.amplitude * areas * (-0.5 * squared.max(0.0)).exp()
    }
}

/// Standard deviations of variances, none of them negative or zero.
fn scales(variances: &Vector3<f64>) -> [f64; 3] {
    let least = (variances.max() * FLATTEST).max((-2.0 * MOST_LOG_SCALE).exp());
    variances.map(|variance| variance.max(least).sqrt()).into()
}

/// The Gaussian of these moments and harmonics.
pub(super) fn gaussian(blob: &Blob, sh: Vec<Vec3>) -> Gaussian {
    let eigen = SymmetricEigen::new(blob.covariance);
    let mut axes = eigen.eigenvectors;
    if axes.determinant() < 0.0 {
        axes.column_mut(0).neg_mut();
    }
    let rotation = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(axes));
    let narrow = |v: f64| v as f32;
    let opacity = blob.opacity.clamp(LEAST_OPACITY, MOST_OPACITY);
    Gaussian {
        mean: Vec3::from(<[f64; 3]>::from(blob.mean).map(narrow)),
        log_scale: Vec3::from(scales(&eigen.eigenvalues).map(|scale| narrow(scale.ln()))),
        rotation: Quat::from_xyzw(narrow(rotation.i), narrow(rotation.j), narrow(rotation.k), narrow(rotation.w)),
        raw_opacity: narrow((opacity / (1.0 - opacity)).ln()),
        sh,
    }
}
