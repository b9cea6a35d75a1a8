//! Harmonics within the range of a format, with the colours that the map shows where it was seen from.
//!
//! Few directions see a Gaussian, and so its harmonics may be large and cancel there. Cut off one by one, they no longer do.

use nalgebra::{SMatrix, SVector, Vector3};
use rayon::prelude::*;

use crate::geometry::Se3;
use crate::splat::{GaussianCloud, sh};

const MOST: usize = 16;
type Normal = SMatrix<f64, MOST, MOST>;
type Coefficients = SVector<f64, MOST>;

/// Weight of the coefficients themselves, beside the colours in a view: directions that nobody saw stay as they are.
const RIDGE: f64 = 1e-5;
/// A constant harmonic beyond this gives no colour between black and white.
const MOST_CONSTANT: f64 = 3.3;
const SWEEPS: usize = 1000;
const SETTLED: f64 = 1e-6;
/// A camera sees what lies so near its axis, as cosine.
const CONE: f64 = 0.7;

/// The map with no harmonic beyond the constant one larger than `most`: the least change of its colours as cameras at these poses
/// (world from camera) see them.
pub fn fit_harmonics(cloud: &GaussianCloud, cameras: &[Se3], most: f32) -> GaussianCloud {
    let count = cloud.sh_degree.coefficients();
    let mut fitted = cloud.clone();
    fitted.sh.par_chunks_mut(count).zip(&cloud.means).for_each(|(sh, mean)| {
        if sh[1..].iter().all(|coefficient| coefficient.abs().max_element() <= most) {
            return;
        }
        let normal = normal(&Vector3::from(mean.to_array().map(f64::from)), cameras, count);
        for channel in 0..3 {
            let wanted = Coefficients::from_fn(|k, _| if k < count { f64::from(sh[k][channel]) } else { 0.0 });
            let found = bounded(&normal, &wanted, f64::from(most), count);
            sh.iter_mut().enumerate().for_each(|(k, coefficient)| coefficient[channel] = found[k] as f32);
        }
    });
    fitted
}

/// Mean of the products of the basis in the directions of the cameras that see a point.
fn normal(point: &Vector3<f64>, cameras: &[Se3], count: usize) -> Normal {
    let mut sum = Normal::zeros();
    let mut views = 0.0;
    for camera in cameras {
        let Some(direction) = (point - camera.translation.vector).try_normalize(1e-9) else { continue };
        if direction.dot(&(camera.rotation * Vector3::z())) > CONE {
            let basis = Coefficients::from(sh::basis(&direction));
            sum += basis * basis.transpose();
            views += 1.0;
        }
    }
    let ridge = Normal::from_diagonal(&Coefficients::from_fn(|k, _| if k < count { RIDGE } else { 1.0 }));
    sum / f64::max(views, 1.0) + ridge
}

/// Minimises `(x − wanted)ᵀ A (x − wanted)` with |x| ≤ `most`, and another bound for the first component, by coordinates.
fn bounded(normal: &Normal, wanted: &Coefficients, most: f64, count: usize) -> Coefficients {
    let cut = |k: usize, value: f64| if k == 0 { value.clamp(-MOST_CONSTANT, MOST_CONSTANT) } else { value.clamp(-most, most) };
    let mut found = Coefficients::from_fn(|k, _| cut(k, wanted[k]));
    for _ in 0..SWEEPS {
        let mut change = 0f64;
        for k in 0..count {
            let slope = normal.row(k).tr_dot(&(found - wanted));
            let better = cut(k, found[k] - slope / normal[(k, k)]);
            change = change.max((better - found[k]).abs());
            found[k] = better;
        }
        if change < SETTLED {
            break;
        }
    }
    found
}

#[cfg(test)]
mod tests {
    use glam::Vec3;

    use super::super::tests::cloud;
    use super::*;
    use crate::splat::ShDegree;

    fn color(sh: &[Vec3], direction: &Vector3<f64>) -> Vec3 {
        sh.iter().zip(sh::basis(direction)).map(|(c, basis)| *c * basis as f32).sum()
    }

    #[test]
    fn colours_stay_where_cameras_see_them() {
        let mut map = cloud(ShDegree::ALL[2], 30);
        map.sh.iter_mut().for_each(|coefficient| *coefficient *= 6.0);
        let cameras: Vec<Se3> = (0..12).map(|k| Se3::translation(0.1 * f64::from(k), 0.05 * f64::from(k % 3), -12.0)).collect();
        let fitted = fit_harmonics(&map, &cameras, 1.0);
        let (mut fit, mut cut) = (0.0, 0.0);
        for i in 0..map.len() {
            let (before, after) = (map.get(i), fitted.get(i));
            assert!(after.sh[1..].iter().all(|c| c.abs().max_element() <= 1.0));
            let clamped: Vec<Vec3> =
                before.sh.iter().enumerate().map(|(k, c)| if k == 0 { *c } else { c.clamp(-Vec3::ONE, Vec3::ONE) }).collect();
            for camera in &cameras {
                let mean = Vector3::from(before.mean.to_array().map(f64::from));
                let direction = (mean - camera.translation.vector).normalize();
                let wanted = color(&before.sh, &direction);
                fit += color(&after.sh, &direction).distance_squared(wanted);
                cut += color(&clamped, &direction).distance_squared(wanted);
            }
        }
        assert!(fit < 0.2 * cut, "{fit} against {cut}");
        let mut small = map.clone();
        small.sh.iter_mut().for_each(|coefficient| *coefficient /= 30.0);
        assert_eq!(fit_harmonics(&small, &cameras, 1.0), small, "what is within the range stays");
        let unseen = fit_harmonics(&map, &[], 1.0);
        assert!(unseen.sh.iter().zip(&map.sh).enumerate().all(|(k, (a, b))| {
            let expected = if k % 9 == 0 { *b } else { b.clamp(-Vec3::ONE, Vec3::ONE) };
            a.distance(expected) < 1e-5
        }));
    }
}
