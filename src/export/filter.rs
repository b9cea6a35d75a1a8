//! What of a map is exported.

use glam::Vec3;

use crate::splat::{GaussianCloud, ShDegree, opacity_from_raw};

/// Limits of an exported map; each is applied where it is given.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ExportFilter {
    /// Centres lie between these corners, metres.
    pub crop: Option<(Vec3, Vec3)>,
    /// Least opacity.
    pub min_opacity: Option<f32>,
    /// Most Gaussians: those of the largest product of opacity and area are kept.
    pub max_gaussians: Option<usize>,
    /// Highest degree of the harmonics.
    pub sh_degree: Option<ShDegree>,
}

impl ExportFilter {
    /// The part of a map that passes, in its order.
    pub fn apply(&self, cloud: &GaussianCloud) -> GaussianCloud {
        let inside =
            |i: usize| self.crop.is_none_or(|(low, high)| cloud.means[i].cmpge(low).all() && cloud.means[i].cmple(high).all());
        let opaque = |i: usize| self.min_opacity.is_none_or(|least| opacity_from_raw(cloud.raw_opacities[i]) >= least);
        let mut kept: Vec<usize> = (0..cloud.len()).filter(|&i| inside(i) && opaque(i)).collect();
        if let Some(most) = self.max_gaussians.filter(|most| *most < kept.len()) {
            // Equal ones in their order, so that the same map gives the same part.
            kept.sort_by(|&a, &b| weight(cloud, b).total_cmp(&weight(cloud, a)).then(a.cmp(&b)));
            kept.truncate(most);
            kept.sort_unstable();
        }
        let degree = self.sh_degree.map_or(cloud.sh_degree, |degree| degree.min(cloud.sh_degree));
        let mut part = GaussianCloud { sh_degree: degree, ..cloud.emptied() };
        kept.into_iter().for_each(|i| part.push(cloud.get(i)));
        part
    }
}

/// Opacity times the area of the Gaussian's largest cross-section, up to a constant.
fn weight(cloud: &GaussianCloud, i: usize) -> f32 {
    let mut scales = cloud.log_scales[i].to_array();
    scales.sort_unstable_by(f32::total_cmp);
    opacity_from_raw(cloud.raw_opacities[i]) * (scales[1] + scales[2]).exp()
}

#[cfg(test)]
mod tests {
    use super::super::tests::cloud;
    use super::*;

    #[test]
    fn each_limit_holds_and_the_order_stays() {
        let cloud = cloud(ShDegree::ALL[2], 200);
        assert_eq!(ExportFilter::default().apply(&cloud), cloud);
        let (low, high) = (Vec3::new(-2.0, -4.0, -4.0), Vec3::new(2.0, 4.0, 1.0));
        let filter = ExportFilter {
            crop: Some((low, high)),
            min_opacity: Some(0.3),
            max_gaussians: Some(20),
            sh_degree: ShDegree::new(1),
        };
        let part = filter.apply(&cloud);
        assert_eq!((part.len(), part.sh_degree), (20, ShDegree::ALL[1]));
        let place = |mean: &Vec3| cloud.means.iter().position(|m| m == mean).unwrap();
        let places: Vec<usize> = part.means.iter().map(place).collect();
        assert!(places.is_sorted());
        for (i, mean) in part.means.iter().enumerate() {
            assert!(mean.cmpge(low).all() && mean.cmple(high).all() && opacity_from_raw(part.raw_opacities[i]) >= 0.3);
            assert_eq!(part.get(i).sh, cloud.get(place(mean)).sh[..4]);
        }
        let all = ExportFilter { max_gaussians: None, ..filter }.apply(&cloud);
        let least = (0..part.len()).map(|i| weight(&part, i)).fold(f32::INFINITY, f32::min);
        let left_out = (0..all.len()).filter(|&i| !part.means.contains(&all.means[i]));
        assert!(left_out.map(|i| weight(&all, i)).all(|weight| weight <= least));
    }
}
