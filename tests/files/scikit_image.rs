//! Our image errors are those of scikit-image (0.26.0), computed once on the images below: `structural_similarity` with
//! `gaussian_weights=True, sigma=1.5, use_sample_covariance=False, data_range=1, channel_axis=2`, and `peak_signal_noise_ratio`
//! with `data_range=1`, over all values and over those where the recorded image is above zero.

use keysplat::evaluation::image::{ImageF32, psnr, psnr_where_lit, ssim};

#[derive(serde::Deserialize)]
struct Reference {
    width: usize,
    height: usize,
    kind: Kind,
    ssim: f64,
    psnr_db: f64,
    psnr_where_lit_db: f64,
}

#[derive(Clone, Copy, Debug, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
enum Kind {
    Recorded,
    Noisy,
    Smooth,
}

/// Whole numbers, so that the pictures were exactly these in Python too.
fn picture(width: usize, height: usize, kind: Kind) -> ImageF32 {
    let value = |x: i64, y: i64, c: i64| {
        let recorded = (x * (5 + c) + y * (3 + 2 * c) + x * y / (7 + c)) % 256;
        let units = match kind {
            Kind::Recorded => recorded,
            Kind::Noisy => (recorded + (x * 7919 + y * 104_729 + c * 1_299_709) % 41 - 20).clamp(0, 255),
            Kind::Smooth => (x * 2 + y + 40 * c) % 256,
        };
        units as f32 / 255.0
    };
    let pixels = (0..width * height).map(|i| {
        let (x, y) = ((i % width) as i64, (i / width) as i64);
        [value(x, y, 0), value(x, y, 1), value(x, y, 2)]
    });
    ImageF32::new(width, height, pixels.collect()).unwrap()
}

#[test]
fn figures_are_those_of_scikit_image() {
    let references: Vec<Reference> = serde_json::from_str(include_str!("../fixtures/scikit-image/figures.json")).unwrap();
    assert_eq!(references.len(), 5);
    for reference in references {
        let Reference { width, height, kind, .. } = reference;
        let (recorded, other) = (picture(width, height, Kind::Recorded), picture(width, height, kind));
        for (what, ours, theirs) in [
            ("SSIM", ssim(&other, &recorded).unwrap(), reference.ssim),
            ("PSNR", psnr(&other, &recorded).unwrap(), reference.psnr_db),
            ("PSNR where lit", psnr_where_lit(&other, &recorded).unwrap(), reference.psnr_where_lit_db),
        ] {
            assert!((ours - theirs).abs() < 1e-6, "{width}x{height} {kind:?} {what}: {ours} here, {theirs} in scikit-image");
        }
    }
}
