//! Harmonics as cameras see them: what a format rounds or bounds is fitted to the colours that the map shows where it was seen from.
//!
//! Few directions see a Gaussian, and so its harmonics may be large and cancel there. Cut off one by one, they no longer do.

use nalgebra::{SMatrix, SVector, Vector3};
use rayon::prelude::*;

use crate::geometry::Se3;
use crate::splat::{GaussianCloud, sh};

pub(super) const MOST: usize = 16;
pub(super) type Normal = SMatrix<f64, MOST, MOST>;
pub(super) type Coefficients = SVector<f64, MOST>;

/// Weight of the coefficients themselves, beside the colours in a view: directions that nobody saw stay as they are.
const RIDGE: f64 = 1e-5;
/// A constant harmonic beyond this gives no colour between black and white.
const MOST_CONSTANT: f64 = 3.3;
const SWEEPS: usize = 300;
/// Rounds of the targets of colours that are drawn black.
const ROUNDS: usize = 8;
const SETTLED: f64 = 1e-6;
/// A camera sees what lies so near its axis, as cosine.
const CONE: f64 = 0.7;
/// Cameras that are asked, at most, spread evenly.
const MOST_CAMERAS: usize = 200;
/// Harmonics give a colour less this.
const GREY: f64 = 0.5;

/// Share of an image that a Gaussian without cameras counts as, per square metre.
const UNSEEN: f64 = 1e-3;

/// The basis functions in the directions of the cameras that see a point, and how near these are.
pub(super) struct Seen {
    bases: Vec<Coefficients>,
    squared_distances: Vec<f64>,
}

impl Seen {
    /// From the point and the cameras' poses, world from camera.
    pub fn new(mean: glam::Vec3, cameras: &[Se3]) -> Self {
        let point = Vector3::from(mean.to_array().map(f64::from));
        let seen = |camera: &Se3| {
            let away = point - camera.translation.vector;
            let direction = away.try_normalize(1e-9)?;
            let is_seen = direction.dot(&(camera.rotation * Vector3::z())) > CONE;
            is_seen.then(|| (Coefficients::from(sh::basis(&direction)), away.norm_squared()))
        };
        let step = cameras.len().div_ceil(MOST_CAMERAS).max(1);
        let (bases, squared_distances) = cameras.iter().step_by(step).filter_map(seen).unzip();
        Self { bases, squared_distances }
    }

    /// How much of the cameras' images an area there fills, square metres, up to a constant.
    pub fn share(&self, area: f64) -> f64 {
        if self.is_empty() { area * UNSEEN } else { self.squared_distances.iter().map(|squared| area / (squared + area)).sum() }
    }

    /// Whether no camera sees it.
    pub fn is_empty(&self) -> bool {
        self.bases.is_empty()
    }

    /// Mean of the products of the basis functions; that over all directions where no camera sees it.
    pub fn normal(&self) -> Normal {
        if self.is_empty() {
            return Normal::identity() / (4.0 * std::f64::consts::PI);
        }
        self.bases.iter().fold(Normal::zeros(), |sum, basis| sum + basis * basis.transpose()) / self.bases.len() as f64
    }

    /// Colours of coefficients, from each camera; below 0 they are drawn as 0.
    fn colors<'a>(&'a self, coefficients: &'a Coefficients) -> impl Iterator<Item = f64> + 'a {
        self.bases.iter().map(|basis| basis.dot(coefficients) + GREY)
    }

    /// What `found` should show to be drawn as `wanted` is: where that is black, anything black.
    fn targets(&self, wanted: &Coefficients, found: &Coefficients) -> Vec<f64> {
        let target = |(wanted, found): (f64, f64)| if wanted <= 0.0 { found.min(0.0) } else { wanted };
        self.colors(wanted).zip(self.colors(found)).map(target).collect()
    }

    /// The constant harmonic with which `found` is drawn most like `wanted`.
    pub fn constant(&self, wanted: &Coefficients, found: &Coefficients) -> f64 {
        let mut found = *found;
        found[0] = wanted[0];
        let mut best = (self.error(wanted, &found), found[0]);
        // First as if nothing were drawn black.
        let mut targets: Vec<f64> = self.colors(wanted).collect();
        for _ in 0..ROUNDS {
            // Views that stay black have no say.
            let (mut missing, mut views) = (0.0, 0u32);
            for (target, color) in targets.into_iter().zip(self.colors(&found)).filter(|(target, color)| target != color) {
                missing += target - color;
                views += 1;
            }
            found[0] += missing / (f64::from(views.max(1)) * f64::from(sh::SH_C0));
            let error = self.error(wanted, &found);
            if error < best.0 {
                best = (error, found[0]);
            }
            targets = self.targets(wanted, &found);
        }
        best.1
    }

    /// Sum of the squared differences of what is drawn.
    fn error(&self, wanted: &Coefficients, found: &Coefficients) -> f64 {
        self.colors(wanted).zip(self.colors(found)).map(|(a, b)| (a.max(0.0) - b.max(0.0)).powi(2)).sum()
    }

    /// The coefficients within the bounds that are drawn most like `wanted`, and are near it where nobody looks.
    fn bounded(&self, wanted: &Coefficients, most: f64, count: usize) -> Coefficients {
        let ridge = Normal::from_diagonal(&Coefficients::from_fn(|k, _| if k < count { RIDGE } else { 1.0 }));
        let normal = if self.is_empty() { Normal::zeros() } else { self.normal() } + ridge;
        let mut found = bounded(&normal, &(normal * wanted), &wanted.map(|_| 0.0), Bounds { wanted, most, count });
        for _ in 0..ROUNDS {
            let targets = self.targets(wanted, &found);
            let seen = self.bases.iter().zip(targets).fold(Coefficients::zeros(), |sum, (basis, t)| sum + basis * (t - GREY));
            let right = seen / self.bases.len().max(1) as f64 + ridge * wanted;
            let before = found;
            found = bounded(&normal, &right, &found, Bounds { wanted, most, count });
            if (found - before).amax() < SETTLED {
                break;
            }
        }
        found
    }
}

/// What coefficients are wanted, how large they may be, and how many there are.
#[derive(Clone, Copy)]
struct Bounds<'a> {
    wanted: &'a Coefficients,
    most: f64,
    count: usize,
}

/// Minimises `xᵀAx/2 − bᵀx` within the bounds, by coordinates; from `start`, or from what is wanted where that is 0.
fn bounded(normal: &Normal, right: &Coefficients, start: &Coefficients, bounds: Bounds<'_>) -> Coefficients {
    let Bounds { wanted, most, count } = bounds;
    let cut = |k: usize, value: f64| if k == 0 { value.clamp(-MOST_CONSTANT, MOST_CONSTANT) } else { value.clamp(-most, most) };
    let from = if start.amax() == 0.0 { wanted } else { start };
    let mut found = Coefficients::from_fn(|k, _| cut(k, from[k]));
    for _ in 0..SWEEPS {
        let mut change = 0f64;
        for k in 0..count {
            let slope = normal.row(k).tr_dot(&found) - right[k];
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

/// A channel of coefficients.
pub(super) fn channel(sh: &[glam::Vec3], channel: usize) -> Coefficients {
    Coefficients::from_fn(|k, _| sh.get(k).map_or(0.0, |coefficient| f64::from(coefficient[channel])))
}

/// The map with no harmonic beyond the constant one larger than `most`: the least change of its colours as cameras at these poses
/// (world from camera) see them.
pub(super) fn fit_harmonics(cloud: &GaussianCloud, cameras: &[Se3], most: f32) -> GaussianCloud {
    let count = cloud.sh_degree.coefficients();
    let mut fitted = cloud.clone();
    fitted.sh.par_chunks_mut(count).zip(&cloud.means).for_each(|(sh, mean)| {
        if sh[1..].iter().all(|coefficient| coefficient.abs().max_element() <= most) {
            return;
        }
        let seen = Seen::new(*mean, cameras);
        for c in 0..3 {
            let found = seen.bounded(&channel(sh, c), f64::from(most), count);
            sh.iter_mut().enumerate().for_each(|(k, coefficient)| coefficient[c] = found[k] as f32);
        }
    });
    fitted
}

#[cfg(test)]
mod tests {
    use glam::Vec3;

    use super::super::tests::cloud;
    use super::*;
    use crate::splat::ShDegree;

    /// What is drawn: nothing is darker than black.
    fn color(sh: &[Vec3], direction: &Vector3<f64>) -> Vec3 {
        let sum: Vec3 = sh.iter().zip(sh::basis(direction)).map(|(c, basis)| *c * basis as f32).sum();
        (sum + 0.5).max(Vec3::ZERO)
    }

    fn cameras() -> Vec<Se3> {
        (0..12).map(|k| Se3::translation(0.1 * f64::from(k), 0.05 * f64::from(k % 3), -12.0)).collect()
    }

    fn loud_map() -> GaussianCloud {
        let mut map = cloud(ShDegree::ALL[2], 30);
        map.sh.iter_mut().for_each(|coefficient| *coefficient *= 6.0);
        map
    }

    /// Squared error of what the cameras see.
    fn error(map: &GaussianCloud, i: usize, sh: &[Vec3]) -> f32 {
        let mean = Vector3::from(map.means[i].to_array().map(f64::from));
        let difference = |camera: &Se3| {
            let direction = (mean - camera.translation.vector).normalize();
            color(sh, &direction).distance_squared(color(&map.get(i).sh, &direction))
        };
        cameras().iter().map(difference).sum()
    }

    #[test]
    fn colours_stay_where_cameras_see_them() {
        let map = loud_map();
        let fitted = fit_harmonics(&map, &cameras(), 1.0);
        let (mut fit, mut cut) = (0.0, 0.0);
        for i in 0..map.len() {
            let (before, after) = (map.get(i), fitted.get(i));
            assert!(after.sh[1..].iter().all(|c| c.abs().max_element() <= 1.0));
            let clamped: Vec<Vec3> =
                before.sh.iter().enumerate().map(|(k, c)| if k == 0 { *c } else { c.clamp(-Vec3::ONE, Vec3::ONE) }).collect();
            fit += error(&map, i, &after.sh);
            cut += error(&map, i, &clamped);
        }
        assert!(fit < 0.2 * cut, "{fit} against {cut}");
        let mut small = map.clone();
        small.sh.iter_mut().for_each(|coefficient| *coefficient /= 30.0);
        assert_eq!(fit_harmonics(&small, &cameras(), 1.0), small, "what is within the range stays");
        let unseen = fit_harmonics(&map, &[], 1.0);
        assert!(unseen.sh.iter().zip(&map.sh).enumerate().all(|(k, (a, b))| {
            let expected = if k % 9 == 0 { *b } else { b.clamp(-Vec3::ONE, Vec3::ONE) };
            a.distance(expected) < 1e-5
        }));
    }

    #[test]
    fn black_stays_black_and_costs_nothing() {
        let map = loud_map();
        for i in 0..map.len() {
            let seen = Seen::new(map.means[i], &cameras());
            let (mut cut, mut moved) = (map.get(i).sh, map.get(i).sh);
            cut[1..].iter_mut().for_each(|coefficient| *coefficient *= 0.5);
            moved[1..].iter_mut().for_each(|coefficient| *coefficient *= 0.5);
            (0..3).for_each(|c| moved[0][c] = seen.constant(&channel(&map.get(i).sh, c), &channel(&cut, c)) as f32);
            assert!(error(&map, i, &moved) <= error(&map, i, &cut) + 1e-5, "{i}");
        }
        let unseen = Seen::new(map.means[0], &[]);
        assert_eq!(unseen.constant(&channel(&map.get(0).sh, 0), &Coefficients::zeros()), f64::from(map.get(0).sh[0].x));
    }
}
