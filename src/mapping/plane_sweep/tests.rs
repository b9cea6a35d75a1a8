use super::*;
use crate::geometry::{Pinhole, Se3};

const PINHOLE: Pinhole = Pinhole { fx: 90.0, fy: 90.0, cx: 47.5, cy: 35.5, width: 96, height: 72 };

/// A textured wall 2 m away that recedes to the right, with a box 1.2 m away before it: depth along a ray, and brightness there.
fn scene(origin: &Vector3<f64>, ray: &Vector3<f64>) -> (f64, u8) {
    let meets = |normal: Vector3<f64>, distance: f64| (distance - normal.dot(origin)) / normal.dot(ray);
    let to_box = meets(Vector3::z(), 1.2);
    let at_box = origin + ray * to_box;
    let on_box = at_box.x.abs() < 0.25 && at_box.y.abs() < 0.2;
    let distance = if on_box { to_box } else { meets(Vector3::new(-0.3, 0.0, 1.0), 2.0) };
    let p = origin + ray * distance;
    // Noise on a grid of 6 cm, blended.
    let cell = |x: f64, y: f64| {
        let hash = (x as i64 * 73_856_093) ^ (y as i64 * 19_349_663) ^ (i64::from(on_box) * 83_492_791);
        (hash.wrapping_mul(2_654_435_761) >> 16 & 255) as f64
    };
    let (u, v) = (p.x / 0.06, p.y / 0.06);
    let (x, y) = (u.floor(), v.floor());
    let row = |y: f64| cell(x, y) * (1.0 - u + x) + cell(x + 1.0, y) * (u - x);
    (distance, (row(y) * (1.0 - v + y) + row(y + 1.0) * (v - y)) as u8)
}

/// Camera, brightness and true depths of a view.
fn render(world_from_camera: &Se3) -> (ViewCamera, GrayImage, Vec<f32>) {
    let (mut pixels, mut depths) = (Vec::new(), Vec::new());
    for (y, x) in (0..PINHOLE.height).flat_map(|y| (0..PINHOLE.width).map(move |x| (y, x))) {
        let ray = world_from_camera.rotation * PINHOLE.unproject(&Vector2::new(f64::from(x), f64::from(y)), 1.0);
        let (depth, brightness) = scene(&world_from_camera.translation.vector, &ray);
        pixels.push(brightness);
        // The views' rotations are small, and the view that is asked about has none.
        depths.push(depth as f32);
    }
    let camera = ViewCamera { pinhole: PINHOLE, camera_from_world: world_from_camera.inverse() };
    (camera, GrayImage::from_raw(PINHOLE.width, PINHOLE.height, pixels).unwrap(), depths)
}

fn others() -> [(ViewCamera, GrayImage, Vec<f32>); 2] {
    [
        render(&Se3::new(Vector3::new(0.12, 0.01, 0.0), Vector3::new(0.01, -0.03, 0.02))),
        render(&Se3::new(Vector3::new(-0.05, 0.1, 0.04), Vector3::new(0.02, 0.01, -0.01))),
    ]
}

/// Every 97th pixel's depth.
fn landmarks(depths: &[f32]) -> DepthImage {
    let metres = depths.iter().enumerate().map(|(i, d)| if i % 97 == 0 { *d } else { 0.0 }).collect();
    DepthImage { width: PINHOLE.width, height: PINHOLE.height, metres }
}

#[test]
fn a_wall_and_a_box_are_where_they_are() {
    let (camera, gray, depths) = render(&Se3::identity());
    let others = others();
    let sources: Vec<SourceView<'_>> = others.iter().map(|(camera, gray, _)| SourceView { camera: *camera, gray }).collect();
    let view = SourceView { camera, gray: &gray };
    let estimate = estimate(&view, &landmarks(&depths), &sources, &PlaneSweepConfig::default()).unwrap();
    let pairs = || estimate.metres.iter().zip(&depths).filter(|(e, _)| **e > 0.0);
    let mut errors: Vec<f32> = pairs().map(|(e, d)| (e - d).abs() / d).collect();
    errors.sort_by(f32::total_cmp);
    let (coverage, median, p90) =
        (errors.len() as f64 / depths.len() as f64, errors[errors.len() / 2], errors[errors.len() * 9 / 10]);
    assert!(coverage > 0.6 && median < 0.02 && p90 < 0.06, "coverage {coverage}, median {median}, p90 {p90}");
}

#[test]
fn without_parallax_texture_or_agreement_nothing_is_believed() {
    let (camera, gray, depths) = render(&Se3::identity());
    let [other, _] = others();
    let view = SourceView { camera, gray: &gray };
    let config = PlaneSweepConfig::default();
    let still = SourceView { camera, gray: &gray };
    assert!(estimate(&view, &landmarks(&depths), &[still], &config).is_none());
    let source = SourceView { camera: other.0, gray: &other.1 };
    let wrong: Vec<f32> = depths.iter().enumerate().map(|(i, d)| d * if i % 2 == 0 { 0.6 } else { 1.5 }).collect();
    assert!(estimate(&view, &landmarks(&wrong), &[source], &config).is_none());
    assert!(estimate(&view, &landmarks(&vec![0.0; depths.len()]), &[source], &config).is_none());
    let blank = GrayImage::new(PINHOLE.width, PINHOLE.height);
    let blank_source = SourceView { camera: other.0, gray: &blank };
    let found = estimate(&SourceView { camera, gray: &blank }, &landmarks(&depths), &[blank_source], &config);
    assert!(found.is_none_or(|depth| depth.metres.iter().all(|m| *m == 0.0)));
}
