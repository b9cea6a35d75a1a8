//! Real spherical harmonics up to degree 3, in the order and signs of the 3DGS file format (Kerbl et al. 2023; Sloan 2013).

use nalgebra::{SMatrix, UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};

/// Coefficient of the constant band, `1 / (2√π)`.
pub const SH_C0: f32 = 0.282_094_8;

/// Degree of a map's view dependence, 0 to 3.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(try_from = "u8", into = "u8")]
pub struct ShDegree(u8);

impl ShDegree {
    /// Degrees 0 to 3.
    pub const ALL: [Self; 4] = [Self(0), Self(1), Self(2), Self(3)];

    /// The degree, if it is 0 to 3.
    pub fn new(degree: u8) -> Option<Self> {
        (degree <= 3).then_some(Self(degree))
    }

    /// The degree as a number, 0 to 3.
    pub fn get(self) -> u8 {
        self.0
    }

    /// Coefficients per colour channel: 1, 4, 9 or 16.
    pub fn coefficients(self) -> usize {
        (usize::from(self.0) + 1).pow(2)
    }
}

impl TryFrom<u8> for ShDegree {
    type Error = String;

    fn try_from(degree: u8) -> Result<Self, String> {
        Self::new(degree).ok_or_else(|| format!("a spherical-harmonics degree is 0, 1, 2 or 3, not {degree}"))
    }
}

impl From<ShDegree> for u8 {
    fn from(degree: ShDegree) -> u8 {
        degree.0
    }
}

/// The constant coefficient of a colour in [0, 1].
pub fn dc_from_color(color: glam::Vec3) -> glam::Vec3 {
    (color - 0.5) / SH_C0
}

/// Most coefficients per colour channel, those of degree 3.
const MAX_COEFFICIENTS: usize = 16;

/// All basis functions up to degree 3 in the unit direction `d`; twin of `shaders/shared/spherical_harmonics.wgsl`.
pub fn basis(d: &Vector3<f64>) -> [f64; MAX_COEFFICIENTS] {
    let [x, y, z] = [d.x, d.y, d.z];
    let [xx, yy, zz] = [x * x, y * y, z * z];
    // √(n / dπ), the norms of the polynomials.
    let norm = |n: f64, d: f64| (n / (d * std::f64::consts::PI)).sqrt();
    let (c1, c2, c3) = (norm(3.0, 4.0), norm(15.0, 4.0), norm(35.0, 32.0));
    [
        norm(1.0, 4.0),
        -c1 * y,
        c1 * z,
        -c1 * x,
        c2 * x * y,
        -c2 * y * z,
        norm(5.0, 16.0) * (2.0 * zz - xx - yy),
        -c2 * x * z,
        0.5 * c2 * (xx - yy),
        -c3 * y * (3.0 * xx - yy),
        norm(105.0, 4.0) * x * y * z,
        -norm(21.0, 32.0) * y * (4.0 * zz - xx - yy),
        norm(7.0, 16.0) * z * (2.0 * zz - 3.0 * xx - 3.0 * yy),
        -norm(21.0, 32.0) * x * (4.0 * zz - xx - yy),
        norm(105.0, 16.0) * z * (xx - yy),
        -c3 * x * (xx - 3.0 * yy),
    ]
}

/// A rotation as it acts on coefficients: the rotated function shows along `R·d` what the original shows along `d`.
///
/// Each degree has a matrix of its own, `M[i][j] = ∫ Y_i(d) Y_j(R⁻¹d) dd`. The integrand has degree 6 at most, so Lebedev's rule over
/// the 26 directions of the cube's faces, edges and corners is exact.
#[derive(Clone, Debug)]
pub struct ShRotation {
    /// Zero between basis functions of different degrees.
    matrix: SMatrix<f64, MAX_COEFFICIENTS, MAX_COEFFICIENTS>,
}

impl ShRotation {
    /// The matrices of a rotation, new_from_old.
    pub fn new(rotation: &UnitQuaternion<f64>) -> Self {
        let mut matrix = SMatrix::zeros();
        for (direction, weight) in lebedev_directions() {
            let (new, old) = (basis(&direction), basis(&(rotation.inverse() * direction)));
            for i in 0..MAX_COEFFICIENTS {
                for j in band(i) {
                    matrix[(i, j)] += weight * new[i] * old[j];
                }
            }
        }
        Self { matrix }
    }

    /// Elements of the matrices of degree 1, 2 and 3, each row-major.
    pub fn elements(&self) -> impl Iterator<Item = f64> {
        (1..MAX_COEFFICIENTS).flat_map(move |i| band(i).map(move |j| self.matrix[(i, j)]))
    }

    /// Rotates the coefficients of one Gaussian, `[K, 3]` RGB with K = [`ShDegree::coefficients`].
    pub fn rotate(&self, coefficients: &mut [Vector3<f64>]) {
        let mut old = [Vector3::zeros(); MAX_COEFFICIENTS];
        old[..coefficients.len()].copy_from_slice(coefficients);
        for (i, coefficient) in coefficients.iter_mut().enumerate() {
            *coefficient = band(i).map(|j| old[j] * self.matrix[(i, j)]).sum();
        }
    }
}

/// Basis functions of the same degree as `k`.
fn band(k: usize) -> std::ops::Range<usize> {
    let degree = k.isqrt();
    degree * degree..(degree + 1) * (degree + 1)
}

/// Directions and weights that integrate polynomials over the unit sphere up to degree 7 (Lebedev, 1975).
fn lebedev_directions() -> impl Iterator<Item = (Vector3<f64>, f64)> {
    let steps = || [-1.0, 0.0, 1.0].into_iter();
    let cube = steps().flat_map(move |x| steps().flat_map(move |y| steps().map(move |z| Vector3::new(x, y, z))));
    cube.filter(|v| *v != Vector3::zeros()).map(|v| {
        let share = match v.norm_squared() as u8 {
            1 => 1.0 / 21.0,
            2 => 4.0 / 105.0,
            _ => 9.0 / 280.0,
        };
        (v.normalize(), 4.0 * std::f64::consts::PI * share)
    })
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::verification::reference::spherical_harmonics as reference;

    fn colour(coefficients: &[Vector3<f64>], d: &Vector3<f64>) -> Vector3<f64> {
        (0..).zip(coefficients).map(|(k, c)| c * reference::basis(k, d)).sum()
    }

    proptest! {
        #[test]
        fn the_basis_is_that_of_the_reference(v in prop::array::uniform3(-1.0f64..1.0)) {
            let d = Vector3::from(v).try_normalize(1e-3).unwrap_or_else(Vector3::x);
            (0..).zip(basis(&d)).for_each(|(k, value)| assert!((value - reference::basis(k, &d)).abs() < 1e-14, "{k}"));
        }

        #[test]
        fn a_rotated_function_shows_along_the_rotated_direction_what_it_showed(
            axis in prop::array::uniform3(-3.2f64..3.2), v in prop::array::uniform3(-1.0f64..1.0), seed in any::<u64>()
        ) {
            let rotation = UnitQuaternion::from_scaled_axis(Vector3::from(axis));
            let d = Vector3::from(v).try_normalize(1e-3).unwrap_or_else(Vector3::x);
            let mut random = fastrand::Rng::with_seed(seed);
            for degree in ShDegree::ALL {
                let original: Vec<Vector3<f64>> =
                    (0..degree.coefficients()).map(|_| Vector3::from_fn(|_, _| random.f64() - 0.5)).collect();
                let mut rotated = original.clone();
                ShRotation::new(&rotation).rotate(&mut rotated);
                let difference = colour(&rotated, &(rotation * d)) - colour(&original, &d);
                prop_assert!(difference.norm() < 1e-12, "degree {}: {difference}", degree.get());
            }
        }
    }
}
