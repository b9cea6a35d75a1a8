//! Finding a pose without a prediction: descriptors against a known view, PnP with RANSAC (OpenCV's, whose random numbers have a fixed
//! seed), and the keyframes that are worth trying.

use nalgebra::{Isometry3, Point3, Translation3, UnitQuaternion, Vector3};
use opencv::calib3d;
use opencv::core::{Mat, MatTraitConst, MatTraitConstManual, Point2d, Point3d, Vector};

use crate::geometry::{Pinhole, Se3};
use crate::tracking::features::frame_features::{Feature, FrameFeatures};
use crate::tracking::features::matching::{Match, Rules, match_all};
use crate::tracking::map::sparse_map::Map;

const ALL_RULES: Rules = Rules { max_distance: 64, ratio: 0.8, check_rotation: true };
/// Fewer matches than this are chance.
const MIN_MATCHES: usize = 8;
const RANSAC_ITERATIONS: i32 = 200;
/// Reprojection error of a RANSAC inlier, pixels.
const RANSAC_PIXELS: f32 = 4.0;
const RANSAC_CONFIDENCE: f64 = 0.99;

/// A rough pose and the matches that agree with it.
#[derive(Clone, Debug)]
pub struct Rough {
    pub camera_from_world: Se3,
    pub matches: Vec<Match>,
}

/// The pose of `frame` from a view whose features' points in the world are known (`None` where not).
pub fn pose_from_view(
    view: &[Feature],
    points: &[Option<Point3<f64>>],
    frame: &FrameFeatures,
    pinhole: &Pinhole,
) -> Option<Rough> {
    let known: Vec<bool> = points.iter().map(Option::is_some).collect();
    let matches = match_all(view, &known, &frame.features, &ALL_RULES);
    if matches.len() < MIN_MATCHES {
        return None;
    }
    let mut objects: Vector<Point3d> = Vector::new();
    let mut pixels: Vector<Point2d> = Vector::new();
    for m in &matches {
        let p = points[m.query]?;
        let pixel = frame.features[m.feature].pixel;
        objects.push(Point3d::new(p.x, p.y, p.z));
        pixels.push(Point2d::new(pixel.x, pixel.y));
    }
    // A degenerate set makes OpenCV throw: no pose, and no error of the user's.
    let (camera_from_world, inliers) = solve_pnp(&objects, &pixels, pinhole).ok()??;
    let matches: Vec<Match> = inliers.into_iter().filter_map(|i| matches.get(i).copied()).collect();
    (matches.len() >= MIN_MATCHES).then_some(Rough { camera_from_world, matches })
}

fn solve_pnp(
    objects: &Vector<Point3d>,
    pixels: &Vector<Point2d>,
    pinhole: &Pinhole,
) -> opencv::Result<Option<(Se3, Vec<usize>)>> {
    let intrinsics = Mat::from_slice_2d(&[[pinhole.fx, 0.0, pinhole.cx], [0.0, pinhole.fy, pinhole.cy], [0.0, 0.0, 1.0]])?;
    let (mut rotation, mut translation, mut inliers) = (Mat::default(), Mat::default(), Mat::default());
    let found = calib3d::solve_pnp_ransac(
        objects,
        pixels,
        &intrinsics,
        &Mat::default(),
        &mut rotation,
        &mut translation,
        false,
        RANSAC_ITERATIONS,
        RANSAC_PIXELS,
        RANSAC_CONFIDENCE,
        &mut inliers,
        calib3d::SOLVEPNP_EPNP,
    )?;
    if !found || inliers.empty() {
        return Ok(None);
    }
    let (r, t) = (rotation.data_typed::<f64>()?, translation.data_typed::<f64>()?);
    let (&[rx, ry, rz], &[tx, ty, tz]) = (r, t) else { return Ok(None) };
    if ![rx, ry, rz, tx, ty, tz].iter().all(|v| v.is_finite()) {
        return Ok(None);
    }
    let turned = UnitQuaternion::from_scaled_axis(Vector3::new(rx, ry, rz));
    let pose = Isometry3::from_parts(Translation3::new(tx, ty, tz), turned);
    Ok(Some((pose, inliers.data_typed::<i32>()?.iter().map(|i| *i as usize).collect())))
}

/// The `count` keyframes that resemble the frame most, best first.
pub fn similar_keyframes(map: &Map, frame: &FrameFeatures, count: usize) -> Vec<usize> {
    map.database.query(&frame.features).into_iter().take(count).map(|found| found.keyframe).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::se3;
    use crate::tracking::features::descriptor::Descriptor;
    use crate::tracking::features::frame_features::tests::feature;
    use crate::tracking::solvers::residual::tests::PINHOLE;
    use nalgebra::{Vector2, Vector6};

    #[test]
    fn finds_a_far_pose_among_false_matches_and_the_same_each_time() {
        let mut random = fastrand::Rng::with_seed(2);
        let truth = se3::exp(&Vector6::new(0.5, -0.3, 0.2, 0.4, 0.6, -0.5));
        let (mut view, mut seen, mut points) = (Vec::new(), Vec::new(), Vec::new());
        for i in 0..150 {
            let pixel = Vector2::new(640.0 * random.f64(), 480.0 * random.f64());
            let p_in_camera = Point3::from(PINHOLE.unproject(&pixel, 1.0 + 3.0 * random.f64()));
            points.push(Some(truth.inverse() * p_in_camera));
            let descriptor = Descriptor(std::array::from_fn(|_| random.u64(..)));
            view.push(feature(0.0, 0.0, descriptor));
            let wrong = if i % 3 == 0 { Vector2::new(100.0 * random.f64() + 20.0, 50.0) } else { Vector2::zeros() };
            seen.push(feature(pixel.x + wrong.x, pixel.y + wrong.y, descriptor));
        }
        let frame = FrameFeatures::new(seen, &PINHOLE);
        let found = pose_from_view(&view, &points, &frame, &PINHOLE).unwrap();
        assert!(se3::log(&(found.camera_from_world * truth.inverse())).norm() < 1e-3);
        assert!(found.matches.len() >= 95 && found.matches.iter().all(|m| m.query % 3 != 0));
        let again = pose_from_view(&view, &points, &frame, &PINHOLE).unwrap();
        assert_eq!(found.camera_from_world, again.camera_from_world);
        assert!(pose_from_view(&view[..5], &points[..5], &frame, &PINHOLE).is_none());
        // All points in one place.
        let degenerate = vec![points[0]; points.len()];
        if let Some(rough) = pose_from_view(&view, &degenerate, &frame, &PINHOLE) {
            assert!(rough.camera_from_world.translation.vector.iter().all(|v| v.is_finite()));
        }
    }
}
