//! Gradient through the projection to the raw parameters; twin of `shaders/project_backward.wgsl`, in matrices.

use nalgebra::{Matrix2, Matrix2x3, Matrix3, Vector2, Vector3, Vector4};

use super::project_forward::{Projected64, camera_rotation, rotation_matrix};
use super::rasterize_backward;
use super::rasterize_forward::sorted;
use super::{Gaussian64, ImageGradient64, ProjectedGradient, View64, spherical_harmonics};

/// The whole backward pass, from the image's gradient to that of each Gaussian's raw parameters: zero where it was not drawn.
pub fn backward(view: &View64, cloud: &[Gaussian64], by_image: &ImageGradient64) -> Vec<Gaussian64> {
    let sorted = sorted(view, cloud);
    let by_projected = rasterize_backward::backward(view, &sorted, by_image);
    let mut gradient: Vec<Gaussian64> = cloud.iter().map(|g| Gaussian64::from_flat(&vec![0.0; g.flat().len()])).collect();
    for ((i, projected), by) in sorted.iter().zip(&by_projected) {
        gradient[*i] = project_backward(view, &cloud[*i], projected, by);
    }
    gradient
}

fn project_backward(view: &View64, g: &Gaussian64, f: &Projected64, by: &ProjectedGradient) -> Gaussian64 {
    let rotation = camera_rotation(view);
    // Σ⁻¹ = P: dΣ = -P⁻¹dP P⁻¹, hence ∂L/∂Σ = -P G P with G symmetric.
    let by_conic = Matrix2::new(by.conic.x, by.conic.y / 2.0, by.conic.y / 2.0, by.conic.z);
    let mut by_covariance = -(f.conic * by_conic * f.conic);
    // log √(det Σ₀ / det Σ), where Σ is Σ₀ with the dilation.
    if let Some(sharp_conic) = f.sharp_conic {
        by_covariance += 0.5 * by.opacity * f.opacity * (sharp_conic - f.conic);
    }
    let by_t: Matrix2x3<f64> = 2.0 * by_covariance * (f.jacobian * f.axes);
    let by_jacobian = by_t * f.axes.transpose();
    let by_axes: Matrix3<f64> = f.jacobian.transpose() * by_t;

    let mut by_point = by_point(view, f, by, &by_jacobian);
    let mut by_axes = by_axes;
    if let Some(plane) = &f.plane {
        let by_slope = by.slope.component_div(&Vector2::new(view.camera.pinhole.fx, view.camera.pinhole.fy));
        let by_plane = plane.backward(by_slope * f.depth);
        by_point += by_plane.mean + Vector3::new(0.0, 0.0, by_slope.dot(&plane.slant));
        by_axes += by_plane.axes;
    }
    let free = by.color.zip_map(&f.unclamped_color, |b, c| if c > 0.0 { b } else { 0.0 });
    let by_direction: Vector3<f64> =
        g.sh.iter().enumerate().map(|(k, c)| spherical_harmonics::basis_gradient(k, &f.direction) * c.dot(&free)).sum();
    let by_mean_of_color = (by_direction - f.direction * f.direction.dot(&by_direction)) / f.distance;

    let q = g.rotation.normalize();
    let scale = g.log_scale.map(f64::exp);
    let by_axes_in_world = rotation.transpose() * by_axes;
    let by_rotation = by_axes_in_world * Matrix3::from_diagonal(&scale);
    let by_unit = quaternion_gradient(&q, &by_rotation);
    let world_axes = rotation_matrix(&q) * Matrix3::from_diagonal(&scale);
    Gaussian64 {
        mean: rotation.transpose() * by_point + by_mean_of_color,
        log_scale: Vector3::from_fn(|k, _| by_axes_in_world.column(k).dot(&world_axes.column(k))),
        rotation: (by_unit - q * q.dot(&by_unit)) / g.rotation.norm(),
        raw_opacity: by.opacity * f.opacity * (1.0 - f.base_opacity),
        sh: (0..g.sh.len()).map(|k| free * spherical_harmonics::basis(k, &f.direction)).collect(),
    }
}

/// Through the image mean, the depth, and J's dependence on the mean (its own z, and x/z, y/z where these were not clamped).
fn by_point(view: &View64, f: &Projected64, by: &ProjectedGradient, by_jacobian: &Matrix2x3<f64>) -> Vector3<f64> {
    let p = &view.camera.pinhole;
    let (x, y, z) = (f.p_in_camera.x, f.p_in_camera.y, f.p_in_camera.z);
    let projection = Matrix2x3::new(p.fx / z, 0.0, -p.fx * x / (z * z), 0.0, p.fy / z, -p.fy * y / (z * z));
    let mut by_point = projection.transpose() * by.mean;
    by_point.z += by.depth;
    let tangent = Vector2::new(-f.jacobian[(0, 2)] * z / p.fx, -f.jacobian[(1, 2)] * z / p.fy);
    for (row, focal) in [(0, p.fx), (1, p.fy)] {
        by_point.z -= by_jacobian[(row, row)] * focal / (z * z);
        let by_slope = -focal * by_jacobian[(row, 2)];
        by_point[row] += by_slope * f.inside[row] / (z * z);
        by_point.z -= by_slope * tangent[row] * (1.0 + f.inside[row]) / (z * z);
    }
    by_point
}

/// By the unit quaternion (w, x, y, z), from the gradient by the rotation matrix.
fn quaternion_gradient(q: &Vector4<f64>, by_rotation: &Matrix3<f64>) -> Vector4<f64> {
    let (w, x, y, z) = (q[0], q[1], q[2], q[3]);
    let derivatives = [
        Matrix3::new(0.0, -z, y, z, 0.0, -x, -y, x, 0.0),
        Matrix3::new(0.0, y, z, y, -2.0 * x, -w, z, w, -2.0 * x),
        Matrix3::new(-2.0 * y, x, w, x, 0.0, z, -w, z, -2.0 * y),
        Matrix3::new(-2.0 * z, -w, x, w, -2.0 * z, y, x, y, 0.0),
    ];
    Vector4::from_fn(|i, _| 2.0 * derivatives[i].dot(by_rotation))
}
