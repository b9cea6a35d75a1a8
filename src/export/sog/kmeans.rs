//! Weighted k-means (Lloyd 1982), the same on any number of threads.

use rayon::prelude::*;

const ROUNDS: usize = 8;
/// Points that the centroids are found from; all are assigned at the end.
const MOST_TRAINING: usize = 1 << 16;
/// Points whose sums are one: fixed, so that the order of sums is.
const CHUNK: usize = 4096;
/// Centroids compared at once.
const LANES: usize = 8;

/// Points of many dimensions.
pub(super) struct Points<'a> {
    /// `[N, D]`.
    pub values: &'a [f32],
    /// `[N]`, not negative.
    pub weights: &'a [f32],
    pub dimensions: usize,
}

impl Points<'_> {
    pub fn of(&self, i: usize) -> &[f32] {
        &self.values[i * self.dimensions..(i + 1) * self.dimensions]
    }
}

/// Centroids, laid out to be compared with a point in lanes.
pub(super) struct Centroids {
    /// `[⌈k / LANES⌉, D, LANES]`.
    blocks: Vec<f32>,
    /// Half of the squared norms, infinite beyond the last.
    halves: Vec<f32>,
    dimensions: usize,
}

impl Centroids {
    /// From `[k, D]`.
    pub fn new(centroids: &[f32], dimensions: usize) -> Self {
        let count = centroids.len() / dimensions;
        let mut blocks = vec![0.0; count.next_multiple_of(LANES) * dimensions];
        let mut halves = vec![f32::INFINITY; count.next_multiple_of(LANES)];
        for (k, centroid) in centroids.chunks(dimensions).enumerate() {
            halves[k] = 0.5 * centroid.iter().map(|v| v * v).sum::<f32>();
            let at = k / LANES * LANES * dimensions + k % LANES;
            centroid.iter().enumerate().for_each(|(d, value)| blocks[at + d * LANES] = *value);
        }
        Self { blocks, halves, dimensions }
    }

    /// Half of the squared distances less that of the point's norm, block by block.
    fn scores<'a>(&'a self, point: &'a [f32]) -> impl Iterator<Item = [f32; LANES]> + 'a {
        self.blocks.chunks_exact(LANES * self.dimensions).zip(self.halves.chunks_exact(LANES)).map(|(block, halves)| {
            let mut scores = [0f32; LANES];
            scores.copy_from_slice(halves);
            for (value, row) in point.iter().zip(block.chunks_exact(LANES)) {
                scores.iter_mut().zip(row).for_each(|(score, c)| *score -= value * c);
            }
            scores
        })
    }

    /// The nearest, and its squared distance.
    pub fn nearest(&self, point: &[f32]) -> (usize, f32) {
        let mut best = (0, f32::INFINITY);
        for (block, scores) in self.scores(point).enumerate() {
            for (lane, score) in scores.into_iter().enumerate() {
                if score < best.1 {
                    best = (block * LANES + lane, score);
                }
            }
        }
        let norm: f32 = point.iter().map(|v| v * v).sum();
        (best.0, (2.0 * best.1 + norm).max(0.0))
    }

    /// The `count` nearest, in no order.
    pub fn nearest_few(&self, point: &[f32], count: usize) -> Vec<usize> {
        let scores = self.scores(point).flatten().enumerate().filter(|(_, score)| score.is_finite());
        let mut scores: Vec<(usize, f32)> = scores.collect();
        if scores.len() > count {
            scores.select_nth_unstable_by(count - 1, |a, b| a.1.total_cmp(&b.1).then(a.0.cmp(&b.0)));
            scores.truncate(count);
        }
        scores.into_iter().map(|(k, _)| k).collect()
    }
}

/// What k-means found.
pub(super) struct Clusters {
    /// `[k, D]`.
    pub centroids: Vec<f32>,
    /// For each member.
    pub labels: Vec<usize>,
    /// Weighted squared distance of each member.
    pub errors: Vec<f32>,
}

/// At most `k` centroids of some of the points. They start spread evenly over the members' weights, so that members that lie in an order of
/// space make for a good start.
pub(super) fn kmeans(points: &Points<'_>, members: &[usize], k: usize) -> Clusters {
    let dimensions = points.dimensions;
    if members.len() <= k {
        let centroids = members.iter().flat_map(|i| points.of(*i)).copied().collect();
        return Clusters { centroids, labels: (0..members.len()).collect(), errors: vec![0.0; members.len()] };
    }
    let training: Vec<usize> = members.iter().step_by(members.len().div_ceil(MOST_TRAINING)).copied().collect();
    let k = k.clamp(1, training.len());
    let mut centroids: Vec<f32> = start(points, &training, k).into_iter().flat_map(|i| points.of(i).to_vec()).collect();
    for _ in 0..ROUNDS {
        let assigned = assign(points, &training, &centroids);
        let sums: Vec<Vec<f64>> = training
            .par_chunks(CHUNK)
            .zip(assigned.par_chunks(CHUNK))
            .map(|(members, assigned)| sum(points, members, assigned, k))
            .collect();
        let total = sums.into_iter().reduce(|mut a, b| {
            a.iter_mut().zip(b).for_each(|(a, b)| *a += b);
            a
        });
        let total = total.expect("there are members");
        let mut worst: Vec<usize> = (0..training.len()).collect();
        let empty = total.chunks(dimensions + 1).filter(|sum| sum[dimensions] <= 0.0).count();
        if empty > 0 {
            worst.sort_by(|a, b| assigned[*b].1.total_cmp(&assigned[*a].1).then(a.cmp(b)));
        }
        let mut worst = worst.into_iter();
        for (centroid, sum) in centroids.chunks_mut(dimensions).zip(total.chunks(dimensions + 1)) {
            if sum[dimensions] > 0.0 {
                centroid.iter_mut().zip(sum).for_each(|(c, value)| *c = (value / sum[dimensions]) as f32);
            } else if let Some(far) = worst.next() {
                centroid.copy_from_slice(points.of(training[far]));
            }
        }
    }
    let (labels, errors) = assign(points, members, &centroids).into_iter().unzip();
    Clusters { centroids, labels, errors }
}

/// Members at even steps of the sum of weights.
fn start(points: &Points<'_>, members: &[usize], k: usize) -> Vec<usize> {
    let total: f64 = members.iter().map(|i| f64::from(points.weights[*i])).sum();
    let mut chosen = Vec::with_capacity(k);
    let mut sum = 0.0;
    for (place, i) in members.iter().enumerate() {
        sum += f64::from(points.weights[*i]);
        let due = sum > (chosen.len() as f64 + 0.5) / k as f64 * total || members.len() - place <= k - chosen.len();
        if due && chosen.len() < k {
            chosen.push(*i);
        }
    }
    chosen
}

/// The nearest centroid of each member, and the weighted squared distance.
fn assign(points: &Points<'_>, members: &[usize], centroids: &[f32]) -> Vec<(usize, f32)> {
    let index = Centroids::new(centroids, points.dimensions);
    let nearest = |i: &usize| {
        let (label, distance) = index.nearest(points.of(*i));
        (label, distance * points.weights[*i])
    };
    members.par_iter().with_min_len(CHUNK / 8).map(nearest).collect()
}

/// `[k, D + 1]`: weighted sums of the members, and their weights.
fn sum(points: &Points<'_>, members: &[usize], assigned: &[(usize, f32)], k: usize) -> Vec<f64> {
    let row = points.dimensions + 1;
    let mut sums = vec![0f64; k * row];
    for (i, (label, _)) in members.iter().zip(assigned) {
        let weight = f64::from(points.weights[*i]);
        let sum = &mut sums[label * row..(label + 1) * row];
        sum.iter_mut().zip(points.of(*i)).for_each(|(sum, value)| *sum += weight * f64::from(*value));
        sum[row - 1] += weight;
    }
    sums
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn clusters_are_found_and_labels_are_the_nearest() {
        let mut rng = fastrand::Rng::with_seed(3);
        let (n, dimensions) = (3000, 5);
        let values: Vec<f32> = (0..n).flat_map(|i| vec![(i % 7) as f32; dimensions]).map(|v| v + 0.1 * rng.f32()).collect();
        let weights: Vec<f32> = (0..n).map(|_| rng.f32()).collect();
        let points = Points { values: &values, weights: &weights, dimensions };
        let members: Vec<usize> = (0..n).collect();
        let found = kmeans(&points, &members, 11);
        let distance = |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(a, b)| (a - b) * (a - b)).sum::<f32>();
        let index = Centroids::new(&found.centroids, dimensions);
        for i in 0..n {
            let brute = found.centroids.chunks(dimensions).map(|c| distance(c, points.of(i))).fold(f32::INFINITY, f32::min);
            let own = distance(&found.centroids[found.labels[i] * dimensions..][..dimensions], points.of(i));
            assert!(own <= brute + 1e-4 && own < 0.1, "{i}: {own} against {brute}");
            assert!(index.nearest_few(points.of(i), 3).contains(&found.labels[i]));
        }
        let few = kmeans(&points, &members[..4], 11);
        assert_eq!((few.centroids, few.labels), (values[..20].to_vec(), vec![0, 1, 2, 3]));
        let equal = kmeans(&Points { values: &[1.0; 40], weights: &[0.0; 8], dimensions }, &members[..8], 3);
        assert_eq!(equal.centroids, vec![1.0; 15]);
    }
}
