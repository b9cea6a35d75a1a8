//! Image errors: PSNR, SSIM, depth L1.
//!
//! SSIM: Wang et al., *Image quality assessment: from error visibility to structural similarity*, 2004, with their 11×11 Gaussian
//! window (σ 1.5); the figure is that of scikit-image's `structural_similarity(gaussian_weights=True, sigma=1.5,
//! use_sample_covariance=False, data_range=1, channel_axis=2)`, which leaves out the border that the window does not fit in.
//! `tests/scikit_image.rs` holds them together.
//!
//! Left out: LPIPS, which needs a network's weights.

use std::sync::Arc;

use ::image::RgbImage;
use rayon::prelude::*;

/// The window reaches this many pixels to each side: `int(3.5 σ + 0.5)` for σ = 1.5.
const RADIUS: usize = 5;
/// Side of SSIM's window: no smaller image can be compared.
pub const WINDOW: usize = 2 * RADIUS + 1;
const SIGMA_PIXELS: f64 = 1.5;
/// (K₁ L)² and (K₂ L)² of the paper, for a data range L of 1.
const C1: f64 = 0.01 * 0.01;
const C2: f64 = 0.03 * 0.03;

/// A colour image, row-major `[height * width]`, RGB in [0, 1].
#[derive(Clone, Debug, PartialEq)]
pub struct ImageF32 {
    /// Pixels.
    pub width: usize,
    /// Pixels.
    pub height: usize,
    /// Row-major `[height * width]`, RGB in [0, 1].
    pub pixels: Vec<[f32; 3]>,
    /// `[height * width]` the pixels that the camera recorded; `None`: all of them.
    valid: Option<Arc<[bool]>>,
}

/// Images that cannot be compared.
#[derive(Debug, PartialEq, thiserror::Error)]
pub enum ImageError {
    /// The images differ in size.
    #[error("images of {a:?} and {b:?} pixels cannot be compared; resize one")]
    Size {
        /// Width and height of the first, pixels.
        a: (usize, usize),
        /// Width and height of the second, pixels.
        b: (usize, usize),
    },
    /// An image smaller than the window of SSIM.
    #[error("an image of {width}x{height} is smaller than SSIM's window of {WINDOW}x{WINDOW}")]
    TooSmall {
        /// Pixels.
        width: usize,
        /// Pixels.
        height: usize,
    },
}

impl ImageF32 {
    /// `None` unless there are `width * height` pixels.
    pub fn new(width: usize, height: usize, pixels: Vec<[f32; 3]>) -> Option<Self> {
        (width.checked_mul(height) == Some(pixels.len())).then_some(Self { width, height, pixels, valid: None })
    }

    /// 0..255 to [0, 1].
    pub fn from_rgb8(image: &RgbImage) -> Self {
        let (width, height) = image.dimensions();
        let pixels = image.pixels().map(|pixel| pixel.0.map(|value| f32::from(value) / 255.0)).collect();
        Self { width: width as usize, height: height as usize, pixels, valid: None }
    }

    /// Leaves out the pixels that are not `valid` `[height * width]`: they become black, and no comparison with the image counts them.
    pub fn masked(mut self, valid: Option<&Arc<[bool]>>) -> Self {
        let Some(valid) = valid else { return self };
        assert_eq!(valid.len(), self.pixels.len(), "the mask has the size of the image");
        self.pixels.iter_mut().zip(valid.iter()).filter(|(_, valid)| !**valid).for_each(|(pixel, _)| *pixel = [0.0; 3]);
        self.valid = Some(valid.clone());
        self
    }

    fn is_valid(&self, i: usize) -> bool {
        self.valid.as_ref().is_none_or(|valid| valid[i])
    }

    /// Clamps every value to [0, 1], what a screen would show: for rendered images, before any comparison. NaN becomes 0.
    pub fn clamped(mut self) -> Self {
        for value in self.pixels.as_flattened_mut() {
            *value = if value.is_nan() { 0.0 } else { value.clamp(0.0, 1.0) };
        }
        self
    }

    fn check_same_size(&self, other: &Self) -> Result<(), ImageError> {
        let (a, b) = ((self.width, self.height), (other.width, other.height));
        if a == b { Ok(()) } else { Err(ImageError::Size { a, b }) }
    }
}

/// Peak signal-to-noise ratio over the recorded image's valid pixels and all channels, dB, for a peak of 1; infinite for equal images.
///
/// # Errors
/// [`ImageError::Size`] if the images differ in size.
pub fn psnr(rendered: &ImageF32, recorded: &ImageF32) -> Result<f64, ImageError> {
    psnr_where(rendered, recorded, |_| true)
}

/// PSNR over the values where the recorded image is above zero, channel by channel: MonoGS's protocol, which hides the black
/// borders of undistorted images. Infinite where there is none.
///
/// # Errors
/// [`ImageError::Size`] if the images differ in size.
pub fn psnr_where_lit(rendered: &ImageF32, recorded: &ImageF32) -> Result<f64, ImageError> {
    psnr_where(rendered, recorded, |value| value > 0.0)
}

fn psnr_where(rendered: &ImageF32, recorded: &ImageF32, counts: impl Fn(f32) -> bool) -> Result<f64, ImageError> {
    rendered.check_same_size(recorded)?;
    let (mut sum, mut count) = (0.0, 0usize);
    let valid = (0..recorded.pixels.len()).filter(|&i| recorded.is_valid(i));
    for (a, b) in valid.flat_map(|i| rendered.pixels[i].into_iter().zip(recorded.pixels[i])) {
        if counts(b) {
            sum += (f64::from(a) - f64::from(b)).powi(2);
            count += 1;
        }
    }
    Ok(-10.0 * (sum / count.max(1) as f64).log10())
}

/// Structural similarity, the mean over RGB and over the recorded image's valid pixels whose whole window is inside the image.
///
/// # Errors
/// [`ImageError::Size`] if the images differ in size, [`ImageError::TooSmall`] if they are smaller than the window.
pub fn ssim(rendered: &ImageF32, recorded: &ImageF32) -> Result<f64, ImageError> {
    rendered.check_same_size(recorded)?;
    let (width, height) = (recorded.width, recorded.height);
    if width < WINDOW || height < WINDOW {
        return Err(ImageError::TooSmall { width, height });
    }
    let blanked = recorded.valid.as_ref().map(|valid| rendered.clone().masked(Some(valid)));
    let rendered = blanked.as_ref().unwrap_or(rendered);
    let sums: Vec<f64> = (0..3).into_par_iter().map(|channel| ssim_sum(rendered, recorded, channel)).collect();
    let sum: f64 = sums.iter().sum();
    let inner = (RADIUS..height - RADIUS).flat_map(|y| (RADIUS..width - RADIUS).map(move |x| y * width + x));
    let count = inner.filter(|&i| recorded.is_valid(i)).count();
    Ok(sum / (3 * count.max(1)) as f64)
}

/// The sum of one channel's SSIM over the inner pixels that are valid in `b`. A ring of filtered rows keeps the working set in the cache.
fn ssim_sum(a: &ImageF32, b: &ImageF32, channel: usize) -> f64 {
    let weights = window();
    let (width, inner) = (a.width, a.width - 2 * RADIUS);
    // Per row: a, b, a² + b², a b; filtered along the row.
    let mut ring: Vec<[Vec<f64>; 4]> = (0..WINDOW).map(|_| std::array::from_fn(|_| vec![0.0; inner])).collect();
    let mut raw: [Vec<f64>; 4] = std::array::from_fn(|_| vec![0.0; width]);
    let mut filtered: [Vec<f64>; 4] = std::array::from_fn(|_| vec![0.0; inner]);
    let mut sum = 0.0;
    for y in 0..a.height {
        let row = y * width..(y + 1) * width;
        for (x, (pa, pb)) in a.pixels[row.clone()].iter().zip(&b.pixels[row]).enumerate() {
            let (va, vb) = (f64::from(pa[channel]), f64::from(pb[channel]));
            raw[0][x] = va;
            raw[1][x] = vb;
            raw[2][x] = va * va + vb * vb;
            raw[3][x] = va * vb;
        }
        for (raw, out) in raw.iter().zip(&mut ring[y % WINDOW]) {
            filter(&weights, std::array::from_fn(|k| &raw[k..k + inner]), out);
        }
        if y + 1 < WINDOW {
            continue;
        }
        for (quantity, out) in filtered.iter_mut().enumerate() {
            // The oldest row lies right after the newest in the ring.
            filter(&weights, std::array::from_fn(|k| ring[(y + 1 + k) % WINDOW][quantity].as_slice()), out);
        }
        let first = (y - RADIUS) * width + RADIUS;
        sum += ssim_row(&filtered, |x| b.is_valid(first + x));
    }
    sum
}

/// `out[i] = Σ_k weights[k] * taps[k][i]`, for symmetric weights.
fn filter(weights: &[f64; RADIUS + 1], taps: [&[f64]; WINDOW], out: &mut [f64]) {
    let n = out.len();
    let taps = taps.map(|tap| &tap[..n]);
    for i in 0..n {
        let mut sum = weights[0] * taps[RADIUS][i];
        for k in 1..=RADIUS {
            sum += weights[k] * (taps[RADIUS - k][i] + taps[RADIUS + k][i]);
        }
        out[i] = sum;
    }
}

fn ssim_row([mean_a, mean_b, squares, product]: &[Vec<f64>; 4], counts: impl Fn(usize) -> bool) -> f64 {
    let mut sum = 0.0;
    for i in (0..mean_a.len()).filter(|&i| counts(i)) {
        let (ua, ub) = (mean_a[i], mean_b[i]);
        let means = ua * ua + ub * ub;
        let variances = squares[i] - means;
        let covariance = product[i] - ua * ub;
        sum += (2.0 * ua * ub + C1) * (2.0 * covariance + C2) / ((means + C1) * (variances + C2));
    }
    sum
}

/// The Gaussian's right half with its centre, such that the whole sums to 1.
fn window() -> [f64; RADIUS + 1] {
    let half: [f64; RADIUS + 1] = std::array::from_fn(|k| (-0.5 * (k as f64 / SIGMA_PIXELS).powi(2)).exp());
    let sum = half[0] + 2.0 * half[1..].iter().sum::<f64>();
    half.map(|weight| weight / sum)
}

/// Mean absolute depth error in metres over the pixels where the sensor measured something (> 0); `None` where it measured
/// nothing. A rendered depth of 0 (nothing there) counts with its full error. Both `[height * width]`, metres.
pub fn depth_l1(rendered_metres: &[f32], sensor_metres: &[f32]) -> Option<f64> {
    assert_eq!(rendered_metres.len(), sensor_metres.len(), "depth images of one size");
    let (mut sum, mut count) = (0.0, 0usize);
    for (&rendered, &sensor) in rendered_metres.iter().zip(sensor_metres) {
        if sensor > 0.0 {
            sum += (f64::from(rendered) - f64::from(sensor)).abs();
            count += 1;
        }
    }
    (count > 0).then(|| sum / count as f64)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn gray(width: usize, height: usize, value: f32) -> ImageF32 {
        ImageF32::new(width, height, vec![[value; 3]; width * height]).unwrap()
    }

    #[test]
    fn psnr_of_a_known_difference() {
        // A difference of 0.1 everywhere is 20 dB.
        assert!((psnr(&gray(4, 3, 0.6), &gray(4, 3, 0.5)).unwrap() - 20.0).abs() < 1e-5);
        assert_eq!(psnr(&gray(4, 3, 0.5), &gray(4, 3, 0.5)).unwrap(), f64::INFINITY);
    }

    #[test]
    fn the_mask_leaves_black_values_out() {
        let mut recorded = gray(2, 1, 0.5);
        recorded.pixels[0] = [0.0, 0.0, 0.5];
        let rendered = gray(2, 1, 0.6);
        // Four values differ by 0.1, two are black.
        assert!((psnr_where_lit(&rendered, &recorded).unwrap() - 20.0).abs() < 1e-5);
        assert!(psnr(&rendered, &recorded).unwrap() < 10.0);
    }

    /// Whatever is rendered where nothing was recorded, the figures are those of the rest.
    #[test]
    fn invalid_pixels_do_not_count() {
        let noise = |seed: u64| {
            let mut rng = fastrand::Rng::with_seed(seed);
            ImageF32::new(24, 14, (0..24 * 14).map(|_| [rng.f32(), rng.f32(), rng.f32()]).collect()).unwrap()
        };
        let valid: Arc<[bool]> = (0..24 * 14).map(|i| i % 24 < 18).collect();
        let (rendered, recorded) = (noise(1), noise(2).masked(Some(&valid)));
        let mut other = rendered.clone();
        (0..24 * 14).filter(|&i| !valid[i]).for_each(|i| other.pixels[i] = [1.0; 3]);
        assert_ne!(rendered, other);
        for figure in [psnr, psnr_where_lit, ssim] {
            assert_eq!(figure(&rendered, &recorded), figure(&other, &recorded));
        }
        let cut = |image: &ImageF32| {
            let pixels = (0..24 * 14).filter(|&i| valid[i]).map(|i| image.pixels[i]).collect();
            ImageF32::new(18, 14, pixels).unwrap()
        };
        let expected = psnr(&cut(&rendered), &cut(&recorded)).unwrap();
        assert!((psnr(&rendered, &recorded).unwrap() - expected).abs() < 1e-9);
        // Windows that reach over the border see it black in both images.
        let blanked = rendered.clone().masked(Some(&valid));
        let windows = |valid: &dyn Fn(usize) -> bool| {
            let mut only = recorded.clone();
            only.valid = Some((0..24 * 14).map(valid).collect());
            ssim_sum(&blanked, &only, 0)
        };
        let sum: f64 = (0..18).map(|x| windows(&|i| i % 24 == x)).sum();
        let all: f64 = (0..3).map(|channel| ssim_sum(&blanked, &recorded, channel)).sum();
        assert!((ssim_sum(&blanked, &recorded, 0) - sum).abs() < 1e-9);
        assert!((ssim(&rendered, &recorded).unwrap() - all / (3 * 4 * 13) as f64).abs() < 1e-9);
        assert!((ssim(&recorded, &recorded).unwrap() - 1.0).abs() < 1e-9);
    }

    #[test]
    fn ssim_is_the_mean_over_the_windows_of_valid_pixels() {
        let (width, height) = (15, 14);
        let mut rng = fastrand::Rng::with_seed(8);
        let mut noise = || {
            let pixels = (0..width * height).map(|_| [rng.f32(), rng.f32(), rng.f32()]).collect();
            ImageF32::new(width, height, pixels).unwrap()
        };
        let (rendered, recorded) = (noise(), noise());
        // One row and one pixel were not recorded.
        let valid: Arc<[bool]> = (0..width * height).map(|i| i / width != 6 && i != 7 * width + 8).collect();
        let [a, b] = [&rendered, &recorded].map(|image| image.clone().masked(Some(&valid)));
        let window = |image: &ImageF32, x: usize, y: usize| {
            let at = |i: usize| image.pixels[(y - RADIUS + i / WINDOW) * width + x - RADIUS + i % WINDOW];
            ImageF32::new(WINDOW, WINDOW, (0..WINDOW * WINDOW).map(at).collect()).unwrap()
        };
        let centres = (RADIUS..height - RADIUS).flat_map(|y| (RADIUS..width - RADIUS).map(move |x| (x, y)));
        let windows: Vec<f64> = centres
            .filter(|&(x, y)| valid[y * width + x])
            .map(|(x, y)| ssim(&window(&a, x, y), &window(&b, x, y)).unwrap())
            .collect();
        assert_eq!(windows.len(), 3 * 5 - 1);
        let expected = windows.iter().sum::<f64>() / windows.len() as f64;
        assert!((ssim(&rendered, &b).unwrap() - expected).abs() < 1e-12);
    }

    #[test]
    fn sizes_are_checked() {
        let error = psnr(&gray(4, 3, 0.0), &gray(3, 4, 0.0)).unwrap_err();
        assert_eq!(error, ImageError::Size { a: (4, 3), b: (3, 4) });
        assert_eq!(ssim(&gray(20, 10, 0.0), &gray(20, 10, 0.0)), Err(ImageError::TooSmall { width: 20, height: 10 }));
        assert_eq!(ImageF32::new(2, 2, vec![[0.0; 3]; 3]), None);
    }

    #[test]
    fn ssim_of_flat_images_is_the_luminance_term() {
        let expected = (2.0 * 0.2 * 0.8 + 1e-4) / (0.2 * 0.2 + 0.8 * 0.8 + 1e-4);
        assert!((ssim(&gray(16, 12, 0.2), &gray(16, 12, 0.8)).unwrap() - expected).abs() < 1e-6);
        assert!((ssim(&gray(11, 11, 0.3), &gray(11, 11, 0.3)).unwrap() - 1.0).abs() < 1e-12);
    }

    #[test]
    fn ssim_of_stripes_and_their_mean_is_the_contrast_term() {
        let stripes: Vec<[f32; 3]> = (0..16 * 12).map(|i| [if i % 2 == 0 { 0.55 } else { 0.45 }; 3]).collect();
        let stripes = ImageF32::new(16, 12, stripes).unwrap();
        let expected = 9e-4 / (0.05 * 0.05 + 9e-4);
        assert!((ssim(&stripes, &gray(16, 12, 0.5)).unwrap() - expected).abs() < 1e-5);
    }

    #[test]
    fn depth_counts_where_the_sensor_measured() {
        assert_eq!(depth_l1(&[1.5, 9.0, 0.0], &[1.0, 0.0, 2.0]), Some(1.25));
        assert_eq!(depth_l1(&[1.0], &[0.0]), None);
    }

    #[test]
    fn clamping_removes_what_no_screen_shows() {
        let image = ImageF32::new(1, 1, vec![[-0.5, 1.5, f32::NAN]]).unwrap();
        assert_eq!(image.clamped().pixels, [[0.0, 1.0, 0.0]]);
    }

    #[test]
    fn ssim_is_that_of_its_definition() {
        let mut rng = fastrand::Rng::with_seed(5);
        let (width, height) = (15, 14);
        let mut noise = || {
            let pixels = (0..width * height).map(|_| [rng.f32(), rng.f32(), rng.f32()]).collect();
            ImageF32::new(width, height, pixels).unwrap()
        };
        let (a, b) = (noise(), noise());
        let weight = |d: usize| (-0.5 * ((d as f64 - 5.0) / 1.5).powi(2)).exp();
        let norm: f64 = (0..11).map(weight).sum::<f64>().powi(2);
        let mut sum = 0.0;
        for (channel, y, x) in (0..3).flat_map(|c| (0..height - 10).flat_map(move |y| (0..width - 10).map(move |x| (c, y, x)))) {
            // Means of a, b, a², b² and a b over the window.
            let mut m = [0.0; 5];
            for (v, u) in (0..11).flat_map(|v| (0..11).map(move |u| (v, u))) {
                let at = |image: &ImageF32| f64::from(image.pixels[(y + v) * width + x + u][channel]);
                let (p, q) = (at(&a), at(&b));
                let values = [p, q, p * p, q * q, p * q];
                m.iter_mut().zip(values).for_each(|(m, value)| *m += weight(u) * weight(v) / norm * value);
            }
            let covariances = [m[2] - m[0] * m[0], m[3] - m[1] * m[1], m[4] - m[0] * m[1]];
            sum += (2.0 * m[0] * m[1] + 1e-4) * (2.0 * covariances[2] + 9e-4)
                / ((m[0] * m[0] + m[1] * m[1] + 1e-4) * (covariances[0] + covariances[1] + 9e-4));
        }
        let expected = sum / (3 * (width - 10) * (height - 10)) as f64;
        assert!((ssim(&a, &b).unwrap() - expected).abs() < 1e-9);
    }
}
