//! EWA projection of one Gaussian; twin of `shaders/project_forward.wgsl`.

use nalgebra::{Matrix2, Matrix2x3, Matrix3, Vector2, Vector3, Vector4};

use super::surface::Plane64;
use super::{Cutoffs, Gaussian64, View64, spherical_harmonics};
use crate::splat::model::{self, Surface};

/// A projected Gaussian, with the intermediate values of the backward pass.
#[derive(Clone, Debug)]
pub struct Projected64 {
    /// Projected centre, pixels.
    pub mean: Vector2<f64>,
    /// Along z, metres.
    pub depth: f64,
    /// Inverse 2D covariance, 1/pixels².
    pub conic: Matrix2<f64>,
    /// After the sigmoid and the compensation for the dilation, in (0, 1).
    pub opacity: f64,
    /// The sigmoid alone.
    pub(super) base_opacity: f64,
    /// Σ⁻¹ without the dilation, where the opacity depends on it.
    pub(super) sharp_conic: Option<Matrix2<f64>>,
    /// RGB for the viewing direction, not below zero.
    pub color: Vector3<f64>,
    /// -log(alpha / opacity) up to which a pixel is touched.
    pub cut: f64,
    pub(super) p_in_camera: Vector3<f64>,
    pub(super) jacobian: Matrix2x3<f64>,
    /// Scaled axes in the camera frame, M.
    pub(super) axes: Matrix3<f64>,
    /// 1 where x/z, y/z were inside their bounds.
    pub(super) inside: Vector2<f64>,
    pub(super) direction: Vector3<f64>,
    pub(super) distance: f64,
    pub(super) unclamped_color: Vector3<f64>,
    /// Of a planar surface.
    pub(super) plane: Option<Plane64>,
    /// Change of its depth along x and y of the image, metres a pixel; zero unless the surface is planar.
    pub slope: Vector2<f64>,
}

impl Projected64 {
    /// Its depth at `offset` pixels from the mean, metres.
    pub(super) fn depth_at(&self, offset: &Vector2<f64>) -> f64 {
        self.depth + self.slope.dot(offset)
    }
}

pub(super) fn rotation_matrix(q: &Vector4<f64>) -> Matrix3<f64> {
    let (w, x, y, z) = (q[0], q[1], q[2], q[3]);
    Matrix3::new(
        1.0 - 2.0 * (y * y + z * z),
        2.0 * (x * y - w * z),
        2.0 * (x * z + w * y),
        2.0 * (x * y + w * z),
        1.0 - 2.0 * (x * x + z * z),
        2.0 * (y * z - w * x),
        2.0 * (x * z - w * y),
        2.0 * (y * z + w * x),
        1.0 - 2.0 * (x * x + y * y),
    )
}

/// The rotation of camera_from_world.
pub(super) fn camera_rotation(view: &View64) -> Matrix3<f64> {
    view.camera.camera_from_world.rotation.to_rotation_matrix().into_inner()
}

/// Projects a Gaussian, `None` where it is culled.
pub fn project(view: &View64, g: &Gaussian64) -> Option<Projected64> {
    let camera = &view.camera;
    let p = &camera.pinhole;
    let rotation = camera_rotation(view);
    let p_in_camera = rotation * g.mean + camera.camera_from_world.translation.vector;
    let base_opacity = 1.0 / (1.0 + (-g.raw_opacity).exp());
    let visible_depth = p_in_camera.z > model::NEAR_METRES && p_in_camera.z < model::FAR_METRES;
    if !visible_depth || g.rotation.norm_squared() < model::MIN_QUATERNION_NORM_SQUARED {
        return None;
    }
    let axes = rotation * rotation_matrix(&g.rotation.normalize()) * Matrix3::from_diagonal(&g.log_scale.map(f64::exp));
    let z = p_in_camera.z;
    let bounds = model::tangent_bounds(p);
    let tangent = Vector2::new(p_in_camera.x / z, p_in_camera.y / z);
    let clamped = Vector2::new(tangent.x.clamp(bounds[0], bounds[1]), tangent.y.clamp(bounds[2], bounds[3]));
    let jacobian = Matrix2x3::new(p.fx / z, 0.0, -p.fx * clamped.x / z, 0.0, p.fy / z, -p.fy * clamped.y / z);
    let t = jacobian * axes;
    let sharp = t * t.transpose();
    let covariance = sharp + Matrix2::identity() * if view.antialiased { model::ANTIALIASED_DILATION } else { model::DILATION };
    if !(covariance.determinant() >= model::MIN_DETERMINANT && covariance.determinant() < 1e30) {
        return None;
    }
    let undiluted = sharp.determinant() / covariance.determinant();
    let compensation = if view.antialiased { undiluted.max(model::LEAST_UNDILUTED).sqrt() } else { 1.0 };
    let opacity = base_opacity * compensation;
    if view.cutoffs == Cutoffs::Sharp && opacity < model::ALPHA_MIN {
        return None;
    }
    let is_compensated = view.antialiased && undiluted > model::LEAST_UNDILUTED;
    let offset = g.mean - camera.camera_from_world.inverse().translation.vector;
    let direction = offset.normalize();
    let harmonics = g.sh.iter().enumerate().map(|(k, c)| c * spherical_harmonics::basis(k, &direction));
    let unclamped_color = Vector3::repeat(0.5) + harmonics.sum::<Vector3<f64>>();
    let plane = (view.surface == Surface::Planar).then(|| Plane64::new(&axes, p_in_camera));
    Some(Projected64 {
        slope: plane.as_ref().map_or_else(Vector2::zeros, |plane| plane.slant.component_div(&Vector2::new(p.fx, p.fy)) * z),
        plane,
        mean: Vector2::new(p.fx * tangent.x + p.cx, p.fy * tangent.y + p.cy),
        depth: z,
        conic: covariance.try_inverse()?,
        opacity,
        base_opacity,
        sharp_conic: sharp.try_inverse().filter(|_| is_compensated),
        color: unclamped_color.map(|c| c.max(0.0)),
        cut: (opacity / model::ALPHA_MIN).ln(),
        p_in_camera,
        jacobian,
        axes,
        inside: tangent.zip_map(&clamped, |a, b| if a == b { 1.0 } else { 0.0 }),
        direction,
        distance: offset.norm(),
        unclamped_color,
    })
}
