//! The map: Gaussians as a structure of arrays, spherical harmonics, and immutable snapshots for everyone but the mapper.

mod exposure;
pub mod model;
pub mod sh;

use std::sync::Arc;

use glam::{Quat, Vec3};

pub use exposure::Exposure;
pub use model::ViewCamera;
pub use sh::ShDegree;

/// Gaussians, structure of arrays; all arrays have the same number of Gaussians. Raw parameters are what the optimiser moves;
/// the activated ones are `scale = exp(log_scale)`, `opacity = sigmoid(raw_opacity)`, `rotation / |rotation|`.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct GaussianCloud {
    /// Degree of the spherical harmonics.
    pub sh_degree: ShDegree,
    /// Whether opacities are those of Gaussians without the pixel's dilation and shrink with it: the 2D filter of Mip-Splatting (Yu et al.
    /// 2024).
    pub antialiased: bool,
    /// `[N, 3]` world, metres.
    pub means: Vec<Vec3>,
    /// `[N, 3]` natural logarithm of the standard deviations along the Gaussian's own axes, metres.
    pub log_scales: Vec<Vec3>,
    /// `[N]` world from Gaussian, not necessarily of unit length.
    pub rotations: Vec<Quat>,
    /// `[N]` logit of the opacity.
    pub raw_opacities: Vec<f32>,
    /// `[N, K, 3]` spherical-harmonics coefficients, RGB; K = [`ShDegree::coefficients`].
    pub sh: Vec<Vec3>,
}

/// One Gaussian, for building and looking at clouds.
#[derive(Clone, Debug, PartialEq)]
pub struct Gaussian {
    /// World, metres.
    pub mean: Vec3,
    /// Natural logarithm of the standard deviations along its own axes, metres.
    pub log_scale: Vec3,
    /// World from Gaussian, not necessarily of unit length.
    pub rotation: Quat,
    /// Logit of the opacity.
    pub raw_opacity: f32,
    /// `[K]` spherical-harmonics coefficients, RGB.
    pub sh: Vec<Vec3>,
}

impl GaussianCloud {
    /// An empty map.
    pub fn new(sh_degree: ShDegree) -> Self {
        Self { sh_degree, ..Self::default() }
    }

    /// An empty map of the same kind.
    pub fn emptied(&self) -> Self {
        Self { sh_degree: self.sh_degree, antialiased: self.antialiased, ..Self::default() }
    }

    /// Convolves each Gaussian with an isotropic one of `SMOOTHING` times its sampling interval, metres; opacities shrink as volumes grow: the
    /// 3D filter of Mip-Splatting. An interval of 0 changes nothing.
    pub fn smooth(&mut self, intervals: impl IntoIterator<Item = f32>) {
        for (i, interval) in intervals.into_iter().enumerate().filter(|(_, interval)| *interval > 0.0) {
            let radius = model::SMOOTHING * f64::from(interval);
            let growth = self.log_scales[i].to_array().map(|log_scale| 1.0 + (radius * (-f64::from(log_scale)).exp()).powi(2));
            self.log_scales[i] += Vec3::from(growth.map(|growth| (0.5 * growth.ln()) as f32));
            let kept = growth.iter().product::<f64>().sqrt().recip();
            let raw_opacity = f64::from(self.raw_opacities[i]);
            let opacity = kept / (1.0 + (-raw_opacity).exp());
            self.raw_opacities[i] = (opacity / (1.0 - opacity)).ln().clamp(f64::from(f32::MIN), f64::from(f32::MAX)) as f32;
        }
    }

    /// Number of Gaussians.
    pub fn len(&self) -> usize {
        self.means.len()
    }

    /// Whether there are no Gaussians.
    pub fn is_empty(&self) -> bool {
        self.means.is_empty()
    }

    /// At most `count` of its Gaussians, spread evenly over it.
    pub fn thinned(&self, count: usize) -> Self {
        let count = count.min(self.len());
        self.picked((0..count).map(|i| i * self.len() / count))
    }

    /// Appends a Gaussian; missing coefficients are zero, superfluous ones are dropped.
    pub fn push(&mut self, gaussian: Gaussian) {
        self.means.push(gaussian.mean);
        self.log_scales.push(gaussian.log_scale);
        self.rotations.push(gaussian.rotation);
        self.raw_opacities.push(gaussian.raw_opacity);
        let zeros = std::iter::repeat(Vec3::ZERO);
        self.sh.extend(gaussian.sh.into_iter().chain(zeros).take(self.sh_degree.coefficients()));
    }

    /// Appends all Gaussians of another map.
    ///
    /// # Panics
    /// If it has another degree.
    pub fn append(&mut self, other: &Self) {
        assert_eq!(self.sh_degree, other.sh_degree, "a map has one spherical-harmonics degree");
        self.means.extend_from_slice(&other.means);
        self.log_scales.extend_from_slice(&other.log_scales);
        self.rotations.extend_from_slice(&other.rotations);
        self.raw_opacities.extend_from_slice(&other.raw_opacities);
        self.sh.extend_from_slice(&other.sh);
    }

    /// Some of its Gaussians, in the given order.
    pub fn picked(&self, which: impl Iterator<Item = usize> + Clone) -> Self {
        let k = self.sh_degree.coefficients();
        Self {
            means: which.clone().map(|i| self.means[i]).collect(),
            log_scales: which.clone().map(|i| self.log_scales[i]).collect(),
            rotations: which.clone().map(|i| self.rotations[i]).collect(),
            raw_opacities: which.clone().map(|i| self.raw_opacities[i]).collect(),
            sh: which.flat_map(|i| self.sh[i * k..(i + 1) * k].iter().copied()).collect(),
            ..self.emptied()
        }
    }

    /// A copy of Gaussian `i`.
    pub fn get(&self, i: usize) -> Gaussian {
        let k = self.sh_degree.coefficients();
        Gaussian {
            mean: self.means[i],
            log_scale: self.log_scales[i],
            rotation: self.rotations[i],
            raw_opacity: self.raw_opacities[i],
            sh: self.sh[i * k..(i + 1) * k].to_vec(),
        }
    }

    /// The index of the first Gaussian that holds a NaN or an infinity, if any.
    pub fn first_non_finite(&self) -> Option<usize> {
        (0..self.len()).find(|&i| !self.is_finite(i))
    }

    /// Its Gaussians without those that hold a NaN or an infinity.
    pub fn finite(&self) -> Self {
        self.picked((0..self.len()).filter(|&i| self.is_finite(i)))
    }

    fn is_finite(&self, i: usize) -> bool {
        let k = self.sh_degree.coefficients();
        self.means[i].is_finite()
            && self.log_scales[i].is_finite()
            && self.rotations[i].is_finite()
            && self.raw_opacities[i].is_finite()
            && self.sh[i * k..(i + 1) * k].iter().all(|c| c.is_finite())
    }
}

/// The map at one moment, as everyone but the mapper sees it.
#[derive(Clone, Debug)]
pub struct MapSnapshot {
    /// The Gaussians.
    pub cloud: Arc<GaussianCloud>,
    /// Keyframes mapped so far.
    pub keyframes: usize,
    /// Mean PSNR of the views that the last keyframe's steps rendered.
    pub psnr_db: f32,
}

/// A rotation of unit length. What has it already, to f32's precision, stays as it is, so that doing this again changes nothing; a quaternion
/// without length turns nothing.
pub fn unit_rotation(rotation: Quat) -> Quat {
    let q = rotation.to_array().map(f64::from);
    let norm = q.iter().map(|v| v * v).sum::<f64>().sqrt();
    if norm == 0.0 {
        Quat::IDENTITY
    } else if (norm - 1.0).abs() <= 2.0 * f64::from(f32::EPSILON) {
        rotation
    } else {
        Quat::from_array(q.map(|v| (v / norm) as f32))
    }
}

/// `logit`, the inverse of the sigmoid.
pub fn raw_opacity_from_opacity(opacity: f32) -> f32 {
    (opacity / (1.0 - opacity)).ln()
}

/// Raw opacity of an opacity in 255ths. Those of the bytes 0 and 255 stay finite.
pub fn raw_opacity_of_byte(byte: u8) -> f32 {
    const LEAST: f32 = 1.0 / 1024.0;
    raw_opacity_from_opacity((f32::from(byte) / 255.0).clamp(LEAST, 1.0 - LEAST))
}

/// The sigmoid: opacity of a raw opacity.
pub fn opacity_from_raw(raw_opacity: f32) -> f32 {
    1.0 / (1.0 + (-raw_opacity).exp())
}
