//! Gaussians from points that are known already, as 3DGS starts (Kerbl et al. 2023): round ones, as large as the points are apart.

use glam::{Quat, Vec3};

use super::PointsConfig;
use super::knn::spacings;
use crate::sequence::KnownPoint;
use crate::splat::{Gaussian, GaussianCloud, ShDegree, raw_opacity_from_opacity, sh::dc_from_color};

/// A Gaussian for each point; points that `f32` cannot hold are left out. Sizes stay within a factor of the median one, for a stray
/// point far from all others would be a fog, and of two that coincide neither would be seen.
pub(super) fn gaussians(points: &[KnownPoint], config: &PointsConfig, sh_degree: ShDegree) -> GaussianCloud {
    let mut cloud = GaussianCloud::new(sh_degree);
    let of = |p: &KnownPoint| (Vec3::from(p.position.map(|v| v as f32).data.0[0]), p.color);
    let points: Vec<(Vec3, [u8; 3])> = points.iter().map(of).filter(|(position, _)| position.is_finite()).collect();
    let positions: Vec<Vec3> = points.iter().map(|(position, _)| *position).collect();
    let spacings = spacings(&positions);
    let mut sorted = spacings.clone();
    sorted.sort_by(f32::total_cmp);
    let median = sorted.get(sorted.len() / 2).copied().unwrap_or_default().max(f32::MIN_POSITIVE);
    let (least, most) = (median / config.size_range, median * config.size_range);
    for ((mean, color), spacing) in points.into_iter().zip(spacings) {
        cloud.push(Gaussian {
            mean,
            log_scale: Vec3::splat((config.footprint * spacing.clamp(least, most)).ln()),
            rotation: Quat::IDENTITY,
            raw_opacity: raw_opacity_from_opacity(config.opacity),
            sh: vec![dc_from_color(Vec3::from(color.map(|c| f32::from(c) / 255.0)))],
        });
    }
    cloud
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector3;

    fn point(x: f64, y: f64) -> KnownPoint {
        KnownPoint { position: Vector3::new(x, y, 2.0), color: [255, 128, 0] }
    }

    #[test]
    fn points_become_round_gaussians_as_large_as_they_are_apart() {
        let mut points: Vec<KnownPoint> = (0..25).map(|i| point(0.1 * f64::from(i % 5), 0.1 * f64::from(i / 5))).collect();
        points.extend([point(100.0, 0.0), point(0.0, 0.0), KnownPoint { position: Vector3::new(1e60, 0.0, 0.0), color: [0; 3] }]);
        let config = PointsConfig { footprint: 0.5, opacity: 0.3, size_range: 4.0, ..PointsConfig::default() };
        let cloud = gaussians(&points, &config, ShDegree::new(1).unwrap());
        assert_eq!(cloud.len(), 27);
        assert!(cloud.first_non_finite().is_none());
        let size = |i: usize| cloud.log_scales[i].exp();
        assert!((size(12) - Vec3::splat(0.05)).abs().max_element() < 1e-6, "in the middle of the grid");
        assert!((size(25).x - 0.2).abs() < 1e-6, "a stray point is no fog");
        assert!(size(26).x >= 0.0125, "one upon another is still seen");
        let gaussian = cloud.get(3);
        assert!((crate::splat::opacity_from_raw(gaussian.raw_opacity) - 0.3).abs() < 1e-6);
        assert_eq!(gaussian.sh[0], dc_from_color(Vec3::new(1.0, 128.0 / 255.0, 0.0)));
        assert!(gaussians(&[], &config, ShDegree::default()).is_empty());
    }
}
