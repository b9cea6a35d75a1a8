//! A survey says of a render what its pixels say.

use fastrand::Rng;
use image::{Rgb, RgbImage};
use keysplat::optimise::{SurveyRules, TargetImage, Trainer};
use keysplat::render::BlendForm;
use keysplat::splat::ShDegree;

use crate::common::requirements::adapter;
use crate::oracle::upload;

/// Odd sizes: cells at the border are cut off.
const SIZE: (u32, u32) = (203, 101);

#[test]
fn cells_and_samples_are_those_of_the_render() {
    let Some(gpu) = adapter() else { return };
    let mut rng = Rng::with_seed(12);
    let camera = crate::common::camera(&mut rng, SIZE.0, SIZE.1);
    let cloud = upload(&gpu, &crate::common::scene(&mut rng, 150, ShDegree::default()));
    let pixels = (SIZE.0 * SIZE.1) as usize;
    let depth: Vec<f32> = (0..pixels).map(|_| if rng.u8(..4) == 0 { 0.0 } else { 4.0 * rng.f32() }).collect();
    let image = RgbImage::from_pixel(SIZE.0, SIZE.1, Rgb([90; 3]));
    let target = TargetImage::new(&gpu, &image, Some(&depth)).unwrap();
    for (form, cell) in BlendForm::ALL.into_iter().flat_map(|form| [1, 2, 4].map(|cell| (form, cell))) {
        let mut trainer = Trainer::with_blending(gpu.clone(), form).unwrap();
        let rendered = trainer.render(&cloud, &camera, [0.0; 3]).unwrap();
        let rules = SurveyRules { target: &target, cell, min_alpha: 0.5, depth_disagreement: 0.1 };
        let survey = trainer.survey(&cloud, &camera, Some(&rules)).unwrap();
        assert_eq!(survey.columns, SIZE.0.div_ceil(cell));
        let cells = (survey.columns * SIZE.1.div_ceil(cell)) as usize;
        let lacks = |(x, y): (u32, u32)| {
            let pixel = (y * SIZE.0 + x) as usize;
            let is_behind = depth[pixel] > 0.0 && rendered.expected_depth(pixel) - depth[pixel] > 0.1 * depth[pixel];
            rendered.alpha(pixel) < 0.5 || is_behind
        };
        let (mut corners, mut brightest) = (0, 0.0f32);
        for i in 0..cells as u32 {
            let found = survey.cell(i as usize);
            let (x, y) = (i % survey.columns * cell, i / survey.columns * cell);
            let inside = (x..(x + cell).min(SIZE.0)).flat_map(|x| (y..(y + cell).min(SIZE.1)).map(move |y| (x, y)));
            let values: Vec<f32> =
                inside.map(|(x, y)| rendered.color_depth[(y * SIZE.0 + x) as usize][..3].iter().sum::<f32>() / 3.0).collect();
            let mean = values.iter().sum::<f32>() / values.len() as f32;
            assert!((found.brightness - mean).abs() < 1e-4, "{form:?}, cell {i}: {} {mean}", found.brightness);
            let center = ((x + cell / 2).min(SIZE.0 - 1), (y + cell / 2).min(SIZE.1 - 1));
            assert_eq!((found.lacks_corner, found.lacks_center), (lacks((x, y)), lacks(center)), "{form:?}, cell {i}");
            corners += usize::from(found.lacks_corner);
            brightest = brightest.max(mean);
        }
        assert!((cells / 10..cells * 9 / 10).contains(&corners) && brightest > 0.3);
        assert!(survey.samples.len() > pixels / 4);
        for sample in &survey.samples {
            let expected = rendered.color_depth[sample.pixel];
            assert!((0..3).all(|k| (sample.color[k] - expected[k].min(1.0)).abs() < 1e-4), "{sample:?} {expected:?}");
            assert!((sample.alpha - rendered.alpha(sample.pixel)).abs() < 1e-4);
        }
        let without = trainer.survey(&cloud, &camera, None).unwrap();
        assert!(without.samples == survey.samples);
    }
}
