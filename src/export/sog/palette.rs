//! A palette of harmonics: few vectors that stand for those of all Gaussians.
//!
//! Weighted k-means in two levels, groups and then the entries of each (a tree-structured vector quantiser, Gersho and Gray 1992).
//! Entries are then chosen and moved by the colours that cameras see, as a constant harmonic can make up for the rest. No chance is in it,
//! and sums run in a fixed order.

use nalgebra::Cholesky;
use rayon::prelude::*;

use super::super::harmonics::{Coefficients, MOST, Normal, Seen, channel};
use super::Precision;
use super::kmeans::{Centroids, Points, kmeans};
use crate::geometry::Se3;
use crate::splat::{GaussianCloud, opacity_from_raw};

/// Labels have 16 bits.
pub(super) const MOST_ENTRIES: usize = 1 << 16;
/// Weight of harmonics themselves beside the colours in a view to find like ones: more than once entries are chosen.
const RIDGE_TO_FIND: f64 = 1e-3;
/// Entries among which the one of the least change is chosen.
const CANDIDATES: usize = 48;
const ROUNDS: usize = 4;

/// Entries, and which of them stands for each Gaussian.
pub(super) struct Palette {
    /// `[P, 3 (K − 1)]`, coefficient by coefficient in red, green and blue.
    pub entries: Vec<f32>,
    /// `[N]`.
    pub labels: Vec<u16>,
}

impl Palette {
    /// The palette of a map whose harmonics go beyond the constant one.
    pub fn new(cloud: &GaussianCloud, cameras: &[Se3], precision: &Precision) -> Self {
        let dimensions = 3 * (cloud.sh_degree.coefficients() - 1);
        let wanted = ((cloud.len() as f64 / precision.gaussians_per_entry) as usize).next_multiple_of(64).min(MOST_ENTRIES);
        let values = quiet(cloud, cameras, RIDGE_TO_FIND);
        if cloud.len() <= wanted {
            return Self { entries: values, labels: (0..cloud.len()).map(|i| i as u16).collect() };
        }
        let weights: Vec<f32> = (0..cloud.len()).into_par_iter().map(|i| weight(cloud, i, cameras)).collect();
        let points = Points { values: &values, weights: &weights, dimensions };
        let everyone: Vec<usize> = (0..cloud.len()).collect();
        let groups = kmeans(&points, &everyone, wanted.isqrt());
        let mut members = vec![Vec::new(); groups.centroids.len() / dimensions];
        groups.labels.iter().enumerate().for_each(|(i, group)| members[*group].push(i));
        let errors: Vec<f64> = members.iter().map(|group| group.iter().map(|i| f64::from(groups.errors[*i])).sum()).collect();
        let all = errors.iter().sum::<f64>().max(f64::MIN_POSITIVE);
        let exact = quiet(cloud, cameras, precision.ridge);
        let shown = Shown { cloud, cameras, values: &exact, ridge: precision.ridge };
        let share = |(group, error): (&Vec<usize>, &f64)| {
            let entries = (error / all * (wanted - wanted.isqrt()) as f64) as usize;
            let entries = entries.min(group.len()) + 1;
            refined(&points, &shown, group, entries)
        };
        let parts: Vec<(Vec<f32>, Vec<usize>)> = members.par_iter().zip(&errors).map(share).collect();
        let mut palette = Self { entries: Vec::new(), labels: vec![0; cloud.len()] };
        for (group, (entries, labels)) in members.iter().zip(parts) {
            let first = palette.entries.len() / dimensions;
            group.iter().zip(labels).for_each(|(i, label)| palette.labels[*i] = (first + label) as u16);
            palette.entries.extend(entries);
        }
        palette.by_use(dimensions)
    }

    /// The most used entries first: the high bytes of labels are few then.
    fn by_use(self, dimensions: usize) -> Self {
        let mut uses = vec![0usize; self.entries.len() / dimensions];
        self.labels.iter().for_each(|label| uses[usize::from(*label)] += 1);
        let mut order: Vec<usize> = (0..uses.len()).collect();
        order.sort_by_key(|entry| std::cmp::Reverse(uses[*entry]));
        let mut places = vec![0; uses.len()];
        order.iter().enumerate().for_each(|(place, entry)| places[*entry] = place as u16);
        Self {
            entries: order
                .iter()
                .flat_map(|entry| &self.entries[entry * dimensions..(entry + 1) * dimensions])
                .copied()
                .collect(),
            labels: self.labels.iter().map(|label| places[usize::from(*label)]).collect(),
        }
    }
}

/// What the entries are chosen by.
struct Shown<'a> {
    cloud: &'a GaussianCloud,
    cameras: &'a [Se3],
    /// `[N, 3 (K − 1)]`, the harmonics that entries stand for.
    values: &'a [f32],
    /// See [`Precision`].
    ridge: f64,
}

/// The root of what a Gaussian's squared error is worth: its opacity, and the root of the share of the images that it fills.
fn weight(cloud: &GaussianCloud, i: usize, cameras: &[Se3]) -> f32 {
    let scale = cloud.log_scales[i];
    let area = f64::from(scale.element_sum() - scale.min_element()).clamp(-60.0, 60.0).exp();
    opacity_from_raw(cloud.raw_opacities[i]) * Seen::new(cloud.means[i], cameras).share(area).sqrt() as f32
}

/// The least harmonics that show nearly the same to the cameras, `[N, 3 (K − 1)]`.
fn quiet(cloud: &GaussianCloud, cameras: &[Se3], ridge: f64) -> Vec<f32> {
    let count = cloud.sh_degree.coefficients();
    let ridge = Normal::from_diagonal(&Coefficients::from_fn(|k, _| if (1..count).contains(&k) { ridge } else { 1e-9 }));
    let rest = |(mean, sh): (&glam::Vec3, &[glam::Vec3])| -> Vec<f32> {
        let seen = Seen::new(*mean, cameras);
        if seen.is_empty() {
            return sh[1..].iter().flat_map(|c| c.to_array()).collect();
        }
        let normal = within(seen.normal(), count);
        let solver = Cholesky::new(normal + ridge);
        let found: [Coefficients; 3] = std::array::from_fn(|c| {
            let wanted = channel(sh, c);
            solver.as_ref().map_or(wanted, |solver| solver.solve(&(normal * wanted)))
        });
        (1..count).flat_map(|k| [0, 1, 2].map(|c| found[c][k] as f32)).collect()
    };
    cloud.means.par_iter().zip(cloud.sh.par_chunks(count)).flat_map_iter(rest).collect()
}

/// The part of the first coefficients, and ones beyond.
fn within(normal: Normal, count: usize) -> Normal {
    Normal::from_fn(|i, k| match i.max(k) < count {
        true => normal[(i, k)],
        false => f64::from(u8::from(i == k)),
    })
}

/// How much a change of harmonics shows once the constant one makes up for what it can.
fn visible(seen: &Seen, count: usize, ridge: f64) -> Normal {
    let normal = seen.normal();
    let first = normal.column(0) / normal[(0, 0)].max(1e-9);
    let left = normal - first * normal.row(0);
    Normal::from_fn(|i, k| {
        let inside = (1..count).contains(&i) && (1..count).contains(&k);
        let ridge = f64::from(u8::from(i == k)) * if (1..count).contains(&i) { ridge } else { 1.0 };
        if inside { left[(i, k)] + ridge } else { ridge }
    })
}

/// The entries of a group, and the label of each member among them.
fn refined(points: &Points<'_>, shown: &Shown<'_>, members: &[usize], entries: usize) -> (Vec<f32>, Vec<usize>) {
    let found = kmeans(points, members, entries);
    let (mut centroids, mut labels) = (found.centroids, found.labels);
    let count = shown.cloud.sh_degree.coefficients();
    if members.len() <= entries {
        return (centroids, labels);
    }
    for _ in 0..ROUNDS {
        let index = Centroids::new(&centroids, points.dimensions);
        let mut sums = vec![(Normal::zeros(), [Coefficients::zeros(); 3]); centroids.len() / points.dimensions];
        for (member, label) in members.iter().zip(&mut labels) {
            let point = &shown.values[member * points.dimensions..(member + 1) * points.dimensions];
            let metric = visible(&Seen::new(shown.cloud.means[*member], shown.cameras), count, shown.ridge);
            let change = |entry: usize| {
                let at = &centroids[entry * points.dimensions..(entry + 1) * points.dimensions];
                (0..3).map(|c| quadratic(&metric, &(rest(at, c) - rest(point, c)), count)).sum::<f64>()
            };
            let mut few = index.nearest_few(points.of(*member), CANDIDATES);
            few.push(*label);
            *label =
                few.into_iter().map(|k| (change(k), k)).min_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1))).expect("some").1;
            let weight = f64::from(points.weights[*member]).powi(2);
            let (normal, right) = &mut sums[*label];
            *normal += metric * weight;
            (0..3).for_each(|c| right[c] += metric * rest(point, c) * weight);
        }
        for (entry, (normal, right)) in centroids.chunks_mut(points.dimensions).zip(&sums) {
            let Some(solver) = Cholesky::new(*normal).filter(|_| normal[(0, 0)] > 0.0) else { continue };
            let solved: [Coefficients; 3] = std::array::from_fn(|c| solver.solve(&right[c]));
            entry.iter_mut().enumerate().for_each(|(at, value)| *value = solved[at % 3][at / 3 + 1] as f32);
        }
    }
    (centroids, labels)
}

/// A channel of the coefficients beyond the constant one, at their places.
fn rest(values: &[f32], channel: usize) -> Coefficients {
    Coefficients::from_fn(|k, _| if k == 0 { 0.0 } else { values.get(3 * (k - 1) + channel).copied().map_or(0.0, f64::from) })
}

fn quadratic(metric: &Normal, change: &Coefficients, count: usize) -> f64 {
    debug_assert!(count <= MOST);
    let mut sum = 0.0;
    for k in 1..count {
        let column = metric.column(k);
        sum += change[k] * (1..count).map(|i| column[i] * change[i]).sum::<f64>();
    }
    sum
}

#[cfg(test)]
mod tests {
    use super::super::super::tests::cloud;
    use super::super::COMPACT;
    use super::*;
    use crate::splat::ShDegree;

    #[test]
    fn few_entries_show_what_all_showed() {
        let mut map = cloud(ShDegree::ALL[1], 4000);
        let cameras: Vec<Se3> = (0..6).map(|k| Se3::translation(0.3 * f64::from(k), 0.0, -12.0)).collect();
        // Of three kinds, with a little noise.
        let kinds = [[0.5, -0.2, 0.1], [-0.4, 0.3, 0.2], [0.0, 0.1, -0.6]];
        for i in 0..map.len() {
            (1..4).for_each(|k| map.sh[4 * i + k] = map.sh[4 * i + k] * 0.01 + glam::Vec3::splat(kinds[i % 3][k - 1]));
        }
        let palette = Palette::new(&map, &cameras, &COMPACT);
        let entries = palette.entries.len() / 9;
        assert!((3..=832).contains(&entries), "{entries}");
        for i in 0..map.len() {
            let entry = &palette.entries[9 * usize::from(palette.labels[i])..][..9];
            let seen = Seen::new(map.means[i], &cameras);
            let mut worst = 0f64;
            for c in 0..3 {
                let wanted = channel(&map.sh[4 * i..4 * i + 4], c);
                let mut found = rest(entry, c);
                found[0] = seen.constant(&wanted, &found);
                worst = worst.max(quadratic(&visible(&seen, 4, COMPACT.ridge), &(found - wanted), 4));
            }
            assert!(worst < 2e-4, "{i}: {worst}");
        }
        let again = Palette::new(&map, &cameras, &COMPACT);
        assert!(again.entries == palette.entries && again.labels == palette.labels);
    }
}
