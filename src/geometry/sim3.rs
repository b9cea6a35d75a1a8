//! Sim(3), the similarity transforms, and its exponential map: what a map without a scale of its own can drift by.
//!
//! A tangent vector is `τ = (ρ, θ, λ)`, translation, rotation, logarithm of the scale, and perturbs from the left: `T ← Exp(τ)·T`
//! (Strasdat, Montiel & Davison, *Scale drift-aware large scale monocular SLAM*, RSS 2010; Eade, *Lie groups for 2D and 3D
//! transformations*). The coefficients come from power series that divide by neither angle nor scale, so nothing is special about
//! small ones.

use nalgebra::{Isometry3, Matrix3, Point3, SMatrix, SVector, Translation3, UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};

use super::se3::{Se3, skew};

/// `(ρ, θ, λ)`.
pub type Vector7 = SVector<f64, 7>;
/// A matrix over tangent vectors `(ρ, θ, λ)`.
pub type Matrix7 = SMatrix<f64, 7, 7>;

/// Terms after which the series of `e^z` is exact to f64 for every rotation and all scales from 1/20 to 20.
const SERIES_TERMS: usize = 40;

/// A similarity; its action is `p_in_a = scale * rotation * p_in_b + translation`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Sim3 {
    /// a_from_b, unit length.
    pub rotation: UnitQuaternion<f64>,
    /// In units of a.
    pub translation: Vector3<f64>,
    /// Units of a per unit of b, above 0.
    pub scale: f64,
}

impl Sim3 {
    /// No rotation, no translation, scale 1.
    pub fn identity() -> Self {
        Self::from(Se3::identity())
    }

    /// b_from_a.
    pub fn inverse(&self) -> Self {
        let rotation = self.rotation.inverse();
        Self { rotation, translation: rotation * self.translation / -self.scale, scale: 1.0 / self.scale }
    }

    /// Transforms a point of b's frame to a's.
    pub fn act(&self, p_in_b: &Point3<f64>) -> Point3<f64> {
        Point3::from(self.rotation * p_in_b.coords * self.scale + self.translation)
    }

    /// The rigid motion that projects every point to the same pixel as this does: a's unit becomes that of b.
    pub fn to_rigid(self) -> Se3 {
        Isometry3::from_parts(Translation3::from(self.translation / self.scale), self.rotation)
    }

    /// `Ad`: `T·Exp(τ) = Exp(Ad·τ)·T`.
    pub fn adjoint(&self) -> Matrix7 {
        let rotation = *self.rotation.to_rotation_matrix().matrix();
        let mut adjoint = Matrix7::zeros();
        adjoint.fixed_view_mut::<3, 3>(0, 0).copy_from(&(rotation * self.scale));
        adjoint.fixed_view_mut::<3, 3>(0, 3).copy_from(&(skew(&self.translation) * rotation));
        adjoint.fixed_view_mut::<3, 1>(0, 6).copy_from(&-self.translation);
        adjoint.fixed_view_mut::<3, 3>(3, 3).copy_from(&rotation);
        adjoint[(6, 6)] = 1.0;
        adjoint
    }
}

impl From<Se3> for Sim3 {
    fn from(a_from_b: Se3) -> Self {
        Self { rotation: a_from_b.rotation, translation: a_from_b.translation.vector, scale: 1.0 }
    }
}

impl std::ops::Mul for Sim3 {
    type Output = Self;

    /// `a_from_b * b_from_c`.
    fn mul(self, other: Self) -> Self {
        Self {
            rotation: self.rotation * other.rotation,
            translation: self.rotation * other.translation * self.scale + self.translation,
            scale: self.scale * other.scale,
        }
    }
}

/// `Exp: R⁷ → Sim(3)` of `τ = (ρ, θ, λ)`.
pub fn exp(tau: &Vector7) -> Sim3 {
    let (rho, theta, lambda) = parts(tau);
    Sim3 {
        rotation: UnitQuaternion::from_scaled_axis(theta),
        translation: translation_matrix(&theta, lambda) * rho,
        scale: lambda.exp(),
    }
}

/// `Log: Sim(3) → R⁷`, the inverse of [`exp`] for rotation angles below π.
pub fn log(a_from_b: &Sim3) -> Vector7 {
    let (theta, lambda) = (a_from_b.rotation.scaled_axis(), a_from_b.scale.ln());
    // Invertible for every angle below 2π.
    let inverse = translation_matrix(&theta, lambda).try_inverse().unwrap_or_else(Matrix3::identity);
    let rho = inverse * a_from_b.translation;
    Vector7::from_column_slice(&[rho.x, rho.y, rho.z, theta.x, theta.y, theta.z, lambda])
}

/// The inverse of the left Jacobian: `Log(Exp(δ)·Exp(τ)) = τ + J_l⁻¹(τ)·δ` to first order. By the power series of `J_l`.
pub fn left_jacobian_inverse(tau: &Vector7) -> Matrix7 {
    let ad = little_adjoint(tau);
    let (mut sum, mut term) = (Matrix7::identity(), Matrix7::identity());
    for k in 1..SERIES_TERMS {
        term = term * ad / (k + 1) as f64;
        sum += term;
        if term.amax() < 1e-15 * sum.amax() {
            break;
        }
    }
    sum.try_inverse().unwrap_or_else(Matrix7::identity)
}

fn parts(tau: &Vector7) -> (Vector3<f64>, Vector3<f64>, f64) {
    (tau.fixed_rows::<3>(0).into_owned(), tau.fixed_rows::<3>(3).into_owned(), tau[6])
}

/// `ad`, the derivative of the adjoint.
fn little_adjoint(tau: &Vector7) -> Matrix7 {
    let (rho, theta, lambda) = parts(tau);
    let mut ad = Matrix7::zeros();
    ad.fixed_view_mut::<3, 3>(0, 0).copy_from(&(skew(&theta) + Matrix3::identity() * lambda));
    ad.fixed_view_mut::<3, 3>(0, 3).copy_from(&skew(&rho));
    ad.fixed_view_mut::<3, 1>(0, 6).copy_from(&-rho);
    ad.fixed_view_mut::<3, 3>(3, 3).copy_from(&skew(&theta));
    ad
}

/// `W(θ, λ) = ∫₀¹ e^{uλ} Exp(uθ) du = A·I + B·[θ] + C·[θ]²`.
///
/// With φ = |θ|, z = λ + iφ and the power `z^k = a + iφb`, the coefficients are sums over k of λ^k, b and c = (λ^k − a)/φ², each
/// over (k+1)!; a, b and c follow from those of k−1 without a division.
fn translation_matrix(theta: &Vector3<f64>, lambda: f64) -> Matrix3<f64> {
    let squared_angle = theta.norm_squared();
    let (mut power, mut a, mut b, mut c) = (1.0, 1.0, 0.0, 0.0);
    let (mut sum_a, mut sum_b, mut sum_c) = (1.0, 0.0, 0.0);
    let mut factorial = 1.0;
    for k in 1..SERIES_TERMS {
        c = lambda * c + b;
        (a, b) = (lambda * a - squared_angle * b, a + lambda * b);
        power *= lambda;
        factorial *= (k + 1) as f64;
        sum_a += power / factorial;
        sum_b += b / factorial;
        sum_c += c / factorial;
    }
    let w = skew(theta);
    Matrix3::identity() * sum_a + w * sum_b + w * w * sum_c
}

#[cfg(test)]
mod tests {
    use super::super::se3;
    use super::*;
    use nalgebra::{Matrix4, Vector6};
    use proptest::prelude::*;

    fn tau(t: [f64; 3], axis: [f64; 3], angle: f64, lambda: f64) -> Vector7 {
        let theta = Vector3::from(axis).try_normalize(1e-3).unwrap_or_else(Vector3::x) * angle;
        Vector7::from_column_slice(&[t[0], t[1], t[2], theta.x, theta.y, theta.z, lambda])
    }

    fn matrix(s: &Sim3) -> Matrix4<f64> {
        let mut m = Matrix4::identity();
        m.fixed_view_mut::<3, 3>(0, 0).copy_from(&(s.rotation.to_rotation_matrix().matrix() * s.scale));
        m.fixed_view_mut::<3, 1>(0, 3).copy_from(&s.translation);
        m
    }

    proptest! {
        #[test]
        fn exp_and_log_are_inverse(
            t in prop::array::uniform3(-10.0f64..10.0), axis in prop::array::uniform3(-1.0f64..1.0), angle in 0.0f64..3.1,
            lambda in -2.5f64..2.5
        ) {
            let tau = tau(t, axis, angle, lambda);
            prop_assert!((log(&exp(&tau)) - tau).norm() < 1e-8 * (1.0 + tau.norm()));
        }

        #[test]
        fn tiny_angles_and_scales_keep_full_precision(
            t in prop::array::uniform3(-10.0f64..10.0), r in prop::array::uniform3(-1e-6f64..1e-6), lambda in -1e-6f64..1e-6
        ) {
            let tau = Vector7::from_column_slice(&[t[0], t[1], t[2], r[0], r[1], r[2], lambda]);
            prop_assert!((log(&exp(&tau)) - tau).norm() < 1e-12);
        }

        #[test]
        fn without_scale_it_is_se3(t in prop::array::uniform3(-10.0f64..10.0), axis in prop::array::uniform3(-1.0f64..1.0), angle in 0.0f64..3.1) {
            let tau = tau(t, axis, angle, 0.0);
            let rigid = se3::exp(&Vector6::from_column_slice(&tau.as_slice()[..6]));
            prop_assert!((matrix(&exp(&tau)) - rigid.to_homogeneous()).norm() < 1e-10);
        }

        #[test]
        fn composition_inverse_and_adjoint_are_those_of_the_matrices(
            t in prop::array::uniform3(-3.0f64..3.0), axis in prop::array::uniform3(-1.0f64..1.0), angle in 0.0f64..3.0,
            lambda in -1.0f64..1.0, d in prop::array::uniform3(-0.5f64..0.5)
        ) {
            let (a, step) = (exp(&tau(t, axis, angle, lambda)), tau(d, [d[2], d[0], d[1]], 0.4, d[0]));
            let b = exp(&step);
            prop_assert!((matrix(&(a * b)) - matrix(&a) * matrix(&b)).norm() < 1e-10);
            prop_assert!((matrix(&(a * a.inverse())) - Matrix4::identity()).norm() < 1e-10);
            prop_assert!((matrix(&(exp(&(a.adjoint() * step)) * a)) - matrix(&(a * b))).norm() < 1e-9);
            let p = Point3::from(d);
            prop_assert!((a.act(&p).to_homogeneous() - matrix(&a) * p.to_homogeneous()).norm() < 1e-10);
            // The same direction of sight.
            prop_assert!(((a.to_rigid() * p).coords * a.scale - a.act(&p).coords).norm() < 1e-10);
        }

        #[test]
        fn the_left_jacobian_is_the_numerical_derivative(
            t in prop::array::uniform3(-3.0f64..3.0), axis in prop::array::uniform3(-1.0f64..1.0), angle in 0.0f64..2.5,
            lambda in -1.0f64..1.0
        ) {
            let tau = tau(t, axis, angle, lambda);
            let analytic = left_jacobian_inverse(&tau);
            for k in 0..7 {
                let mut step = Vector7::zeros();
                step[k] = 1e-6;
                let numeric = (log(&(exp(&step) * exp(&tau))) - log(&(exp(&-step) * exp(&tau)))) / 2e-6;
                prop_assert!((numeric - analytic.column(k)).norm() < 1e-6 * (1.0 + analytic.norm()));
            }
        }
    }

    #[test]
    fn exp_is_the_matrix_exponential() {
        let tau = tau([0.3, -0.2, 0.5], [0.4, 0.1, -0.7], 0.9, 0.6);
        let (rho, theta, lambda) = parts(&tau);
        let mut generator = Matrix4::zeros();
        generator.fixed_view_mut::<3, 3>(0, 0).copy_from(&(skew(&theta) + Matrix3::identity() * lambda));
        generator.fixed_view_mut::<3, 1>(0, 3).copy_from(&rho);
        let (mut series, mut term) = (Matrix4::identity(), Matrix4::identity());
        for k in 1..40 {
            term = term * generator / f64::from(k);
            series += term;
        }
        assert!((matrix(&exp(&tau)) - series).norm() < 1e-13);
    }
}
