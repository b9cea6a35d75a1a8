//! Stereo rectification: a calibrated pair becomes two row-aligned pinholes without distortion.
//!
//! After Fusiello, Trucco & Verri, *A compact algorithm for rectification of stereo pairs* (2000): both cameras turn about their centres
//! until their x axes lie along the baseline, with the optical axis as near as that allows to the mean of the two. The common pinhole
//! is the widest whose every pixel both cameras recorded, so that nothing needs a mask.

use image::{DynamicImage, GrayImage, ImageBuffer, Luma, Pixel, Rgb, RgbImage};
use nalgebra::{Matrix3, Rotation3, UnitQuaternion, Vector2, Vector3};

use super::checks;
use super::sampling::Sampler;
use crate::geometry::{Camera, Distortion, Pinhole, Se3};

/// Cameras that must turn further than this are not side by side.
const MAX_TURN_RAD: f64 = 0.7;
/// How far outside of the recorded image a source may lie, pixels: rounding, not a lens that cannot be undone.
const MARGIN: f64 = 0.1;

/// A rectified pair, and where it came from.
#[derive(Debug)]
pub struct StereoRectification {
    /// Pinhole of both rectified cameras, at the recorded size.
    pub pinhole: Pinhole,
    pub baseline_metres: f64,
    pub rectified_from_left: UnitQuaternion<f64>,
    pub remap: StereoRemap,
}

/// For each rectified pixel, where it lies in the recorded image.
#[derive(Debug)]
pub struct StereoRemap {
    left: Sampler,
    right: Sampler,
}

impl StereoRemap {
    /// The left image, rectified; of the size of the cameras.
    pub fn left(&self, recorded: DynamicImage) -> RgbImage {
        match recorded {
            // A third of the work, and most stereo cameras are grey.
            DynamicImage::ImageLuma8(grey) => DynamicImage::from(resample::<Luma<u8>, 1>(&self.left, &grey)).into_rgb8(),
            other => resample::<Rgb<u8>, 3>(&self.left, &other.into_rgb8()),
        }
    }

    pub fn right(&self, recorded: &GrayImage) -> GrayImage {
        resample::<Luma<u8>, 1>(&self.right, recorded)
    }
}

fn resample<P: Pixel<Subpixel = u8>, const C: usize>(
    sampler: &Sampler,
    image: &ImageBuffer<P, Vec<u8>>,
) -> ImageBuffer<P, Vec<u8>> {
    ImageBuffer::from_raw(image.width(), image.height(), sampler.means::<C>(image)).expect("a sample for each pixel")
}

/// Rectifies two cameras of the same size; says what is wrong where they are no stereo pair.
pub fn rectify(left: &Camera, right: &Camera, left_from_right: &Se3) -> Result<StereoRectification, String> {
    let size = |camera: &Camera| (camera.pinhole.width, camera.pinhole.height);
    if size(left) != size(right) {
        return Err("the two cameras have images of different sizes".into());
    }
    let rectified_from_left = turn(left_from_right)?;
    let rectified_from_right = rectified_from_left * left_from_right.rotation;
    let pinhole = common_pinhole(&[(left, rectified_from_left), (right, rectified_from_right)])?;
    let remap = StereoRemap {
        left: sampler(&pinhole, left, &rectified_from_left)?,
        right: sampler(&pinhole, right, &rectified_from_right)?,
    };
    Ok(StereoRectification { pinhole, baseline_metres: left_from_right.translation.vector.norm(), rectified_from_left, remap })
}

/// The rotation of the left camera that puts the baseline on its x axis.
fn turn(left_from_right: &Se3) -> Result<UnitQuaternion<f64>, String> {
    let no_pair = || "the second camera is not to the right of the first; swap the two if they are exchanged".to_owned();
    let x = left_from_right.translation.vector.try_normalize(1e-6).ok_or_else(no_pair)?;
    let mean_axis = Vector3::z() + left_from_right.rotation * Vector3::z();
    let y = mean_axis.cross(&x).try_normalize(1e-6).ok_or_else(no_pair)?;
    let axes = Matrix3::from_rows(&[x.transpose(), y.transpose(), x.cross(&y).transpose()]);
    let rectified_from_left = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(axes));
    let turns = [rectified_from_left, rectified_from_left * left_from_right.rotation];
    if turns.iter().any(|turn| turn.angle() > MAX_TURN_RAD) { Err(no_pair()) } else { Ok(rectified_from_left) }
}

/// The widest pinhole whose image lies within those of all cameras, each with its rotation to the rectified frame.
fn common_pinhole(cameras: &[(&Camera, UnitQuaternion<f64>)]) -> Result<Pinhole, String> {
    // The rectangle inside all borders, in normalised coordinates of the rectified frame.
    let (mut low, mut high) = (Vector2::repeat(f64::NEG_INFINITY), Vector2::repeat(f64::INFINITY));
    let Pinhole { width, height, .. } = cameras[0].0.pinhole;
    let last = Vector2::new(f64::from(width) - 1.0, f64::from(height) - 1.0);
    for (camera, rectified_from_camera) in cameras {
        let normalised = |x: f64, y: f64| {
            let ideal = camera.undistort_pixel(&Vector2::new(x, y));
            let ray = rectified_from_camera * camera.pinhole.unproject(&ideal, 1.0);
            ray.xy() / ray.z
        };
        for y in (0..height).map(f64::from) {
            low.x = low.x.max(normalised(0.0, y).x);
            high.x = high.x.min(normalised(last.x, y).x);
        }
        for x in (0..width).map(f64::from) {
            low.y = low.y.max(normalised(x, 0.0).y);
            high.y = high.y.min(normalised(x, last.y).y);
        }
    }
    let span = high - low;
    if !(span.x > 0.0 && span.y > 0.0) {
        return Err("the two cameras see nothing in common; check their calibration".into());
    }
    let focal = (last.x / span.x).max(last.y / span.y);
    let centre = (last - (low + high) * focal) / 2.0;
    let pinhole = Pinhole { fx: focal, fy: focal, cx: centre.x, cy: centre.y, width, height };
    checks::camera(Camera { pinhole, distortion: Distortion::default(), depth_units_per_metre: 1.0 }).map(|camera| camera.pinhole)
}

/// Where each pixel of the rectified pinhole lies in the camera's recorded image.
fn sampler(pinhole: &Pinhole, camera: &Camera, rectified_from_camera: &UnitQuaternion<f64>) -> Result<Sampler, String> {
    let camera_from_rectified = rectified_from_camera.inverse();
    let mut sources = Vec::with_capacity(pinhole.width as usize * pinhole.height as usize);
    for y in 0..pinhole.height {
        for x in 0..pinhole.width {
            let ray = camera_from_rectified * pinhole.unproject(&Vector2::new(f64::from(x), f64::from(y)), 1.0);
            let source = camera.pinhole.project(&ray).map(|ideal| camera.distort_pixel(&ideal));
            let source = source.filter(|source| camera.pinhole.contains(source, -MARGIN));
            let source = source.ok_or("the lens distortion cannot be undone; check the distortion coefficients")?;
            sources.push([source.x as f32, source.y as f32]);
        }
    }
    Ok(Sampler::new((camera.pinhole.width, camera.pinhole.height), &sources, 1))
}

#[cfg(test)]
mod tests {
    use nalgebra::{Translation3, Vector6};

    use super::*;
    use crate::geometry::se3;

    const LEFT: Camera = Camera {
        pinhole: Pinhole { fx: 100.0, fy: 99.0, cx: 78.0, cy: 61.0, width: 160, height: 120 },
        distortion: Distortion { k1: -0.25, k2: 0.06, p1: 0.0008, p2: -0.0005, k3: 0.0 },
        depth_units_per_metre: 1.0,
    };
    const RIGHT: Camera = Camera {
        pinhole: Pinhole { fx: 101.0, fy: 102.0, cx: 82.0, cy: 58.0, width: 160, height: 120 },
        distortion: Distortion { k1: -0.28, k2: 0.07, p1: -0.0004, p2: 0.0006, k3: 0.0 },
        depth_units_per_metre: 1.0,
    };

    fn left_from_right() -> Se3 {
        se3::exp(&Vector6::new(0.2, 0.01, -0.02, 0.02, -0.03, 0.015))
    }

    /// What a distorted camera at `camera_from_world` records of a smooth pattern on a wall two metres before the left camera.
    fn record(camera: &Camera, left_from_camera: &Se3) -> GrayImage {
        GrayImage::from_fn(camera.pinhole.width, camera.pinhole.height, |x, y| {
            let ideal = camera.undistort_pixel(&Vector2::new(f64::from(x), f64::from(y)));
            let ray = left_from_camera.rotation * camera.pinhole.unproject(&ideal, 1.0);
            let origin = left_from_camera.translation.vector;
            Luma([pattern(&(origin + ray * ((2.0 - origin.z) / ray.z))).round() as u8])
        })
    }

    fn pattern(p: &Vector3<f64>) -> f64 {
        128.0 + 50.0 * (4.0 * p.x).sin() + 50.0 * (5.0 * p.y + p.x).sin()
    }

    /// Points in space meet, in both rectified images, the row and the disparity that the baseline gives them.
    #[test]
    fn rectified_images_show_the_world_in_rows() {
        let pair = rectify(&LEFT, &RIGHT, &left_from_right()).unwrap();
        let recorded = DynamicImage::from(record(&LEFT, &Se3::identity()));
        let color = DynamicImage::from(recorded.to_rgb8());
        assert_eq!(pair.remap.left(recorded.clone()), pair.remap.left(color));
        let (left, right) = (pair.remap.left(recorded), pair.remap.right(&record(&RIGHT, &left_from_right())));
        let left_from_rectified = pair.rectified_from_left.inverse();
        for (x, y, pixel) in left.enumerate_pixels() {
            let ray = left_from_rectified * pair.pinhole.unproject(&Vector2::new(f64::from(x), f64::from(y)), 1.0);
            let distance = 2.0 / ray.z;
            let expected = pattern(&(ray * distance));
            assert!((f64::from(pixel.0[1]) - expected).abs() < 3.0, "left at {x},{y}: {} for {expected:.1}", pixel.0[1]);
            // `distance` is the depth along the rectified axis, as `ray` has z = 1 there.
            let in_right = f64::from(x) - pair.pinhole.fx * pair.baseline_metres / distance;
            if in_right >= 0.0 {
                let value = Sampler::new(right.dimensions(), &[[in_right as f32, y as f32]], 1).means::<1>(&right)[0];
                assert!((f64::from(value) - expected).abs() < 3.0, "right of {x},{y}: {value} for {expected:.1}");
            }
        }
        assert!((pair.baseline_metres - left_from_right().translation.vector.norm()).abs() < 1e-12);
    }

    #[test]
    fn an_ideal_pair_stays_as_it_is() {
        let camera = Camera { distortion: Distortion::default(), ..LEFT };
        let square = Camera { pinhole: Pinhole { fy: 100.0, ..camera.pinhole }, ..camera };
        let pair =
            rectify(&square, &square, &Se3::from_parts(Translation3::new(0.1, 0.0, 0.0), UnitQuaternion::identity())).unwrap();
        assert!(
            (pair.pinhole.fx - 100.0).abs() < 1e-9
                && (pair.pinhole.cx - 78.0).abs() < 1e-9
                && (pair.pinhole.cy - 61.0).abs() < 1e-9
        );
        let image = record(&camera, &Se3::identity());
        assert_eq!(pair.remap.right(&image), image);
    }

    #[test]
    fn cameras_that_are_no_pair_are_refused() {
        let refused = |right: &Camera, left_from_right: &Se3| rectify(&LEFT, right, left_from_right).unwrap_err();
        assert!(refused(&RIGHT, &left_from_right().inverse()).contains("not to the right"));
        assert!(refused(&RIGHT, &Se3::identity()).contains("not to the right"));
        assert!(refused(&RIGHT, &Se3::translation(0.0, 0.0, 1.0)).contains("not to the right"));
        let small = Camera { pinhole: RIGHT.pinhole.scaled(0.5), ..RIGHT };
        assert!(refused(&small, &left_from_right()).contains("different sizes"));
        let folding = Camera { distortion: Distortion { k1: -3.0, ..Distortion::default() }, ..RIGHT };
        assert!(refused(&folding, &left_from_right()).contains("check"));
    }
}
