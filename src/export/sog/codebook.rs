//! Codebooks: at most 256 numbers that stand for many, each coded as the place of the nearest.
//!
//! Even steps where 256 of them span the numbers: their places compress best at the same error (Gish and Pierce 1968). Else Lloyd's
//! algorithm (1982) on the sorted numbers.

/// A byte's places.
pub(super) const ENTRIES: usize = 256;
const ROUNDS: usize = 40;

/// Numbers in ascending order, [`ENTRIES`] of them.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Codebook(pub Vec<f32>);

impl Codebook {
    /// The codebook of finite numbers, in steps of `step` where these suffice.
    pub fn new(numbers: impl Iterator<Item = f32>, step: f32) -> Self {
        let mut sorted: Vec<f32> = numbers.collect();
        sorted.sort_unstable_by(f32::total_cmp);
        let (least, most) = sorted.first().zip(sorted.last()).map_or((0.0, 0.0), |(a, b)| (*a, *b));
        let mut values = if f64::from(most) - f64::from(least) <= f64::from(step) * (ENTRIES - 1) as f64 {
            // Multiples of the step: short in the file.
            let place = |number: f32| (f64::from(number) / f64::from(step)).round() as i64;
            (place(least)..=place(most)).take(ENTRIES).map(|k| (k as f64 * f64::from(step)) as f32).collect()
        } else {
            lloyd(&sorted)
        };
        // Readers reserve room for a byte's places.
        let last = values.last().copied().unwrap_or_default();
        values.resize(ENTRIES, last);
        Self(values)
    }

    /// The place of the nearest.
    pub fn place(&self, number: f32) -> u8 {
        let above = self.0.partition_point(|value| *value < number).min(ENTRIES - 1);
        let below = above.saturating_sub(1);
        let nearest = if (number - self.0[below]).abs() <= (self.0[above] - number).abs() { below } else { above };
        nearest as u8
    }

    /// The number that stands for another.
    pub fn nearest(&self, number: f32) -> f32 {
        self.0[usize::from(self.place(number))]
    }
}

/// Means of the stretches of sorted numbers that are nearest to each, from stretches of equal counts.
fn lloyd(sorted: &[f32]) -> Vec<f32> {
    // Of each stretch by itself: differences of running sums would cancel.
    let sum = |from: usize, to: usize| sorted[from..to].iter().map(|number| f64::from(*number)).sum::<f64>();
    let mean = |from: usize, to: usize| (sum(from, to) / (to - from) as f64) as f32;
    let mut ends: Vec<usize> = (0..=ENTRIES).map(|k| k * sorted.len() / ENTRIES).collect();
    let mut values = Vec::new();
    for _ in 0..ROUNDS {
        ends.dedup();
        values = ends.windows(2).map(|stretch| mean(stretch[0], stretch[1])).collect::<Vec<f32>>();
        let middle = |pair: &[f32]| sorted.partition_point(|number| *number < 0.5 * pair[0] + 0.5 * pair[1]);
        let inner = values.windows(2).map(middle);
        let next: Vec<usize> = std::iter::once(0).chain(inner).chain([sorted.len()]).collect();
        if next == ends {
            break;
        }
        ends = next;
    }
    values
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn steps_suffice_or_the_commonest_numbers_get_most_places() {
        let mut rng = fastrand::Rng::with_seed(3);
        let near: Vec<f32> = (0..5000).map(|_| rng.f32() * 4.0 - 2.0).collect();
        let steps = Codebook::new(near.iter().copied(), 0.02);
        assert!(steps.0.is_sorted() && steps.0.len() == ENTRIES);
        assert!(near.iter().all(|number| (steps.nearest(*number) - number).abs() < 0.01 + 1e-5));
        let with_far: Vec<f32> = near.iter().copied().chain([-300.0, 500.0]).collect();
        let lloyd = Codebook::new(with_far.iter().copied(), 0.02);
        assert!(lloyd.0.is_sorted() && lloyd.0.len() == ENTRIES);
        assert!(with_far.iter().all(|number| (lloyd.nearest(*number) - number).abs() < 0.05), "places go where the numbers are");
        let brute = |number: f32| lloyd.0.iter().map(|value| (value - number).abs()).fold(f32::INFINITY, f32::min);
        assert!(with_far.iter().all(|number| (lloyd.nearest(*number) - number).abs() == brute(*number)));
        assert_eq!(Codebook::new(std::iter::empty(), 0.1).0, vec![0.0; ENTRIES]);
        assert_eq!(Codebook::new([f32::MIN, f32::MAX].into_iter(), 0.1).place(f32::MAX), 1);
    }
}
