//! Images seen at fixed positions between their pixels.

use super::DepthImage;

/// Depths further apart than this share (of the nearest) lie on different surfaces and are not averaged.
const SAME_SURFACE: f32 = 0.03;
/// The nearest pixel of a position outside of the image.
const OUTSIDE: u32 = u32::MAX;

/// A position. Pixels are numbered row by row.
#[derive(Clone, Copy, Debug)]
struct Sample {
    /// Pixel to its upper left, and how far beyond that it lies, pixels.
    corner: u32,
    right: f32,
    down: f32,
    /// Nearest pixel, or [`OUTSIDE`].
    nearest: u32,
}

/// Positions in images of one size, in groups of equal length: one group for each pixel of the result.
#[derive(Clone, Debug)]
pub(super) struct Sampler {
    samples: Vec<Sample>,
    group: usize,
    /// From a pixel to the next one in its row and in its column; 0 where there is only one.
    strides: [usize; 2],
}

impl Sampler {
    /// Samples at positions in pixels; beyond the border its values go on.
    pub fn new((width, height): (u32, u32), positions: &[[f32; 2]], group: usize) -> Self {
        // The second last pixel has all that lies up to the last one.
        let corner = |at: f32, size: u32| {
            let at = at.clamp(0.0, size as f32 - 1.0);
            let corner = (at as u32).min(size.saturating_sub(2));
            (corner, at - corner as f32)
        };
        let sample = |&[x, y]: &[f32; 2]| {
            let ((left, right), (top, down)) = (corner(x, width), corner(y, height));
            let (x, y) = (x.round(), y.round());
            let inside = x >= 0.0 && y >= 0.0 && x < width as f32 && y < height as f32;
            let nearest = if inside { y as u32 * width + x as u32 } else { OUTSIDE };
            Sample { corner: top * width + left, right, down, nearest }
        };
        let strides = [usize::from(width > 1), if height > 1 { width as usize } else { 0 }];
        Self { samples: positions.iter().map(sample).collect(), group, strides }
    }

    /// Mean of each group's bilinear samples, `C` interleaved channels a pixel.
    pub fn means<const C: usize>(&self, image: &[u8]) -> Vec<u8> {
        let mut means = Vec::with_capacity(self.samples.len() / self.group * C);
        let [right, down] = self.strides.map(|stride| stride * C);
        for group in self.samples.chunks_exact(self.group) {
            let mut sum = [0.0f32; C];
            for Sample { corner, right: u, down: v, .. } in group {
                let corner = *corner as usize * C;
                let at = |offset: usize| -> [f32; C] {
                    let pixel: &[u8; C] = image[corner + offset..].first_chunk().expect("an image of the expected size");
                    pixel.map(f32::from)
                };
                let [a, b, c, d] = [at(0), at(right), at(down), at(right + down)];
                for i in 0..C {
                    sum[i] += (a[i] * (1.0 - u) + b[i] * u) * (1.0 - v) + (c[i] * (1.0 - u) + d[i] * u) * v;
                }
            }
            means.extend(sum.map(|sum| (sum / self.group as f32 + 0.5) as u8));
        }
        means
    }

    /// Mean of each group's measured depths on the nearest surface, metres; 0 where there is none. Averaging across a depth edge would invent
    /// points in mid-air.
    pub fn nearest_surfaces(&self, depth: &DepthImage) -> Vec<f32> {
        let at = |sample: &Sample| depth.metres.get(sample.nearest as usize).copied().filter(|metres| *metres > 0.0);
        let surface = |group: &[Sample]| {
            let farthest = group.iter().filter_map(at).fold(f32::INFINITY, f32::min) * (1.0 + SAME_SURFACE);
            let (mut sum, mut count) = (0.0, 0.0);
            for metres in group.iter().filter_map(at).filter(|metres| *metres <= farthest) {
                sum += metres;
                count += 1.0;
            }
            if count > 0.0 { sum / count } else { 0.0 }
        };
        self.samples.chunks_exact(self.group).map(surface).collect()
    }

    /// Of each group, whether a mask keeps all its pixels.
    pub fn kept(&self, mask: &[u8]) -> impl Iterator<Item = bool> {
        self.samples
            .chunks_exact(self.group)
            .map(|group| group.iter().all(|sample| mask.get(sample.nearest as usize).is_none_or(|kept| *kept > 0)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Of a plane, samples are exact; beyond the border its last value goes on.
    #[test]
    fn means_are_those_of_bilinear_samples() {
        for (width, height) in [(7u32, 5u32), (1, 4), (6, 1)] {
            let image: Vec<u8> =
                (0..width * height).flat_map(|i| [10 + 20 * (i % width), 200 - 30 * (i / width)]).map(|v| v as u8).collect();
            let positions: Vec<[f32; 2]> =
                (0..400u16).map(|i| [f32::from(i % 20) * 0.5 - 1.5, f32::from(i / 20) * 0.37 - 1.0]).collect();
            let means = Sampler::new((width, height), &positions, 2).means::<2>(&image);
            assert_eq!(means.len(), positions.len());
            for (mean, pair) in means.chunks(2).zip(positions.chunks(2)) {
                let inside =
                    |axis: usize, size: u32| pair.iter().map(|at| at[axis].clamp(0.0, size as f32 - 1.0)).sum::<f32>() / 2.0;
                let expected = [10.0 + 20.0 * inside(0, width), 200.0 - 30.0 * inside(1, height)];
                assert!(mean.iter().zip(expected).all(|(a, b)| (f32::from(*a) - b).abs() < 0.51), "{mean:?} for {expected:?}");
            }
        }
    }

    #[test]
    fn the_nearest_surface_has_the_pixels_inside_alone() {
        let depth = DepthImage { width: 2, height: 1, metres: vec![2.0, 2.02] };
        let of = |positions: &[[f32; 2]]| Sampler::new((2, 1), positions, 3).nearest_surfaces(&depth);
        let far = DepthImage { metres: vec![0.0, 3.0], ..depth.clone() };
        assert_eq!(of(&[[0.0, 0.0], [1.0, 0.2], [1.6, 0.0]]), [2.01]);
        assert_eq!(of(&[[-0.6, 0.0], [f32::NAN, 0.0], [0.0, 0.7]]), [0.0]);
        assert_eq!(Sampler::new((2, 1), &[[0.0, 0.0], [1.0, 0.0]], 2).nearest_surfaces(&far), [3.0]);
    }
}
