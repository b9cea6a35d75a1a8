//! The first two keyframes of a camera without depth: relative pose and points from matches alone.
//!
//! A homography and a fundamental matrix are both fitted and scored (Mur-Artal, Montiel & Tardós, *ORB-SLAM*, 2015, sec. IV): a plane
//! or little parallax is explained by the first, anything else by the second. Every motion that the better one allows is tried by
//! triangulating all matches; the best is refined by all its inliers, and taken only if it is clearly the best and shows enough parallax.

use nalgebra::{Isometry3, Matrix3, Point3, Rotation3, Translation3, UnitQuaternion, Vector2, Vector3};
use opencv::calib3d;
use opencv::core::{Mat, MatTraitConst, MatTraitConstManual, Point2d, Vector};

use crate::geometry::{Pinhole, Se3};
use crate::tracking::TrackingError;
use crate::tracking::map::triangulation::{View, triangulate};
use crate::tracking::solvers::epipolar;

const RANSAC_PIXELS: f64 = 2.0;
const RANSAC_CONFIDENCE: f64 = 0.999;
const RANSAC_ITERATIONS: i32 = 1000;
/// χ² at 95% for 1 and 2 degrees of freedom; a match scores by how far it is below the second.
const CHI2_LINE: f64 = 3.841;
const CHI2_PIXEL: f64 = 5.991;
/// Share of the score from which on the homography is chosen.
const HOMOGRAPHY_SHARE: f64 = 0.45;
/// Points that a motion must give, and the share of the inliers that they must be.
const MIN_POINTS: usize = 50;
const MIN_POINT_SHARE: f64 = 0.8;
/// The second best motion must give less than this share of the best one's points.
const CLEARLY: f64 = 0.75;
/// Parallax that at least `MIN_POINTS` points must have, as pixels at the image's centre: well above what keypoints are off, or a turn
/// passes for a translation.
const MIN_PARALLAX_PIXELS: f64 = 17.0;
/// Times that the best motion is refined by its inliers, each time those that it then has.
const REFINEMENTS: usize = 2;
/// Reprojection error of a good point, pixels.
const MAX_ERROR_PIXELS: f64 = 2.0;

/// Two views and what they show, the first camera at the origin, the second at distance 1.
#[derive(Clone, Debug)]
pub struct TwoViews {
    pub second_from_first: Se3,
    /// The point of each match, in the first camera's frame; `None` where the match does not fit.
    pub points: Vec<Option<Point3<f64>>>,
}

/// Relative pose and points from matched pixels `(first, second)`, distortion-free; `None` if they do not say enough.
pub fn two_views(matches: &[(Vector2<f64>, Vector2<f64>)], pinhole: &Pinhole) -> Option<TwoViews> {
    if matches.len() < MIN_POINTS {
        return None;
    }
    // A degenerate set makes OpenCV throw: no motion, and no error of the user's.
    let candidates = motions(matches, pinhole).ok()?;
    let mut tried: Vec<(usize, f64, TwoViews)> =
        candidates.motions.iter().map(|motion| try_motion(motion, matches, &candidates.inliers, pinhole)).collect();
    tried.sort_by_key(|(count, ..)| std::cmp::Reverse(*count));
    let second = tried.get(1).map_or(0, |(count, ..)| *count);
    let (_, _, best) = tried.into_iter().next()?;
    let (mut pose, mut inliers) = (best.second_from_first, candidates.inliers);
    for _ in 0..REFINEMENTS {
        let kept = matches.iter().zip(&inliers).filter(|(_, is_inlier)| **is_inlier).map(|(pixels, _)| pixels);
        pose = epipolar::refine(&pose, kept, pinhole);
        inliers = score_fundamental(&epipolar::fundamental(&pose, pinhole), matches).1;
    }
    let (count, parallax_rad, best) = try_motion(&pose, matches, &inliers, pinhole);
    let inliers = inliers.iter().filter(|i| **i).count();
    let enough = count >= MIN_POINTS && count as f64 >= MIN_POINT_SHARE * inliers as f64;
    let clear = (second as f64) < CLEARLY * count as f64;
    (enough && clear && parallax_rad * pinhole.fx >= MIN_PARALLAX_PIXELS).then_some(best)
}

/// Candidate motions of one two-view model.
struct Candidates {
    motions: Vec<Se3>,
    inliers: Vec<bool>,
}

fn motions(matches: &[(Vector2<f64>, Vector2<f64>)], pinhole: &Pinhole) -> Result<Candidates, TrackingError> {
    let first: Vector<Point2d> = matches.iter().map(|(a, _)| Point2d::new(a.x, a.y)).collect();
    let second: Vector<Point2d> = matches.iter().map(|(_, b)| Point2d::new(b.x, b.y)).collect();
    let camera = Matrix3::new(pinhole.fx, 0.0, pinhole.cx, 0.0, pinhole.fy, pinhole.cy, 0.0, 0.0, 1.0);
    let k = to_mat(&camera)?;
    let mut mask = Mat::default();
    let homography = calib3d::find_homography(&first, &second, &mut mask, calib3d::RANSAC, RANSAC_PIXELS)?;
    let homography_score = to_matrix(&homography).map(|h| score_homography(&h, matches));
    let essential = calib3d::find_essential_mat(
        &first,
        &second,
        &k,
        calib3d::RANSAC,
        RANSAC_CONFIDENCE,
        RANSAC_PIXELS,
        RANSAC_ITERATIONS,
        &mut mask,
    )?;
    let fundamental_score = to_matrix(&essential).map(|e| score_fundamental(&epipolar::fundamental_of(&e, pinhole), matches));
    match (homography_score, fundamental_score) {
        (Some((h, inliers)), Some((f, _))) if h > HOMOGRAPHY_SHARE * (h + f) => {
            Ok(Candidates { motions: of_homography(&homography, &k)?, inliers })
        }
        (_, Some((_, inliers))) => Ok(Candidates { motions: of_essential(&essential)?, inliers }),
        (Some((_, inliers)), None) => Ok(Candidates { motions: of_homography(&homography, &k)?, inliers }),
        (None, None) => Ok(Candidates { motions: Vec::new(), inliers: Vec::new() }),
    }
}

fn to_mat(m: &Matrix3<f64>) -> opencv::Result<Mat> {
    let row = |r: usize| [m[(r, 0)], m[(r, 1)], m[(r, 2)]];
    Mat::from_slice_2d(&[row(0), row(1), row(2)])
}

/// A 3×3 matrix of f64; `None` if OpenCV found none, or several.
fn to_matrix(mat: &Mat) -> Option<Matrix3<f64>> {
    let fits = mat.rows() == 3 && mat.cols() == 3;
    let values = fits.then(|| mat.data_typed::<f64>().ok()).flatten()?;
    values.iter().all(|v| v.is_finite()).then(|| Matrix3::from_row_slice(values))
}

/// Score and inliers by the symmetric transfer error.
fn score_homography(h: &Matrix3<f64>, matches: &[(Vector2<f64>, Vector2<f64>)]) -> (f64, Vec<bool>) {
    let Some(back) = h.try_inverse() else { return (0.0, vec![false; matches.len()]) };
    let transfer = |m: &Matrix3<f64>, from: &Vector2<f64>, to: &Vector2<f64>| {
        let p = m * from.push(1.0);
        (p.xy() / p.z - to).norm_squared()
    };
    score(matches, CHI2_PIXEL, |a, b| (transfer(h, a, b), transfer(&back, b, a)))
}

/// Score and inliers by the distances from the epipolar lines.
fn score_fundamental(f: &Matrix3<f64>, matches: &[(Vector2<f64>, Vector2<f64>)]) -> (f64, Vec<bool>) {
    let off = |m: &Matrix3<f64>, from: &Vector2<f64>, to: &Vector2<f64>| {
        let line = m * from.push(1.0);
        line.dot(&to.push(1.0)).powi(2) / line.xy().norm_squared()
    };
    let back = f.transpose();
    score(matches, CHI2_LINE, |a, b| (off(f, a, b), off(&back, b, a)))
}

fn score(
    matches: &[(Vector2<f64>, Vector2<f64>)],
    limit: f64,
    errors: impl Fn(&Vector2<f64>, &Vector2<f64>) -> (f64, f64),
) -> (f64, Vec<bool>) {
    let mut sum = 0.0;
    let inliers = matches
        .iter()
        .map(|(a, b)| {
            let (there, back) = errors(a, b);
            // NaN is no inlier.
            let fits = there <= limit && back <= limit;
            sum += [there, back].iter().filter(|e| **e <= limit).map(|e| CHI2_PIXEL - e).sum::<f64>();
            fits
        })
        .collect();
    (sum, inliers)
}

fn of_essential(essential: &Mat) -> Result<Vec<Se3>, TrackingError> {
    let (mut one, mut other, mut direction) = (Mat::default(), Mat::default(), Mat::default());
    calib3d::decompose_essential_mat(essential, &mut one, &mut other, &mut direction)?;
    let t = direction.data_typed::<f64>()?;
    let &[x, y, z] = t else { return Ok(Vec::new()) };
    let rotations = [to_matrix(&one), to_matrix(&other)];
    let poses = rotations.into_iter().flatten().flat_map(|r| [1.0, -1.0].map(|sign| motion(&r, sign * Vector3::new(x, y, z))));
    Ok(poses.flatten().collect())
}

fn of_homography(homography: &Mat, k: &Mat) -> Result<Vec<Se3>, TrackingError> {
    let (mut rotations, mut translations, mut normals): (Vector<Mat>, Vector<Mat>, Vector<Mat>) = Default::default();
    calib3d::decompose_homography_mat(homography, k, &mut rotations, &mut translations, &mut normals)?;
    let mut poses = Vec::new();
    for (r, t) in rotations.iter().zip(translations.iter()) {
        if let (Some(r), &[x, y, z]) = (to_matrix(&r), t.data_typed::<f64>()?) {
            poses.extend(motion(&r, Vector3::new(x, y, z)));
        }
    }
    Ok(poses)
}

/// The motion with its translation scaled to length 1; `None` without a translation.
fn motion(rotation: &Matrix3<f64>, translation: Vector3<f64>) -> Option<Se3> {
    let direction = translation.try_normalize(1e-6)?;
    let rotation = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix(rotation));
    Some(Isometry3::from_parts(Translation3::from(direction), rotation))
}

/// Triangulates all inliers: how many points are good, the parallax that `MIN_POINTS` of them exceed, and the points.
fn try_motion(
    motion: &Se3,
    matches: &[(Vector2<f64>, Vector2<f64>)],
    inliers: &[bool],
    pinhole: &Pinhole,
) -> (usize, f64, TwoViews) {
    let identity = Se3::identity();
    let (first, second) = (View { camera_from_world: &identity, pinhole }, View { camera_from_world: motion, pinhole });
    let (mut points, mut parallaxes) = (vec![None; matches.len()], Vec::new());
    for (i, (a, b)) in matches.iter().enumerate().filter(|(i, _)| inliers[*i]) {
        let Some(met) = triangulate(&first, a, &second, b) else { continue };
        let fits = |pose: &Se3, pixel: &Vector2<f64>| {
            pinhole.project(&(pose * met.point).coords).is_some_and(|p| (p - pixel).norm() <= MAX_ERROR_PIXELS)
        };
        if fits(&identity, a) && fits(motion, b) {
            points[i] = Some(met.point);
            parallaxes.push(met.parallax_cosine.clamp(-1.0, 1.0).acos());
        }
    }
    parallaxes.sort_by(|a, b| b.total_cmp(a));
    let parallax = parallaxes.get(MIN_POINTS.min(parallaxes.len()).saturating_sub(1)).copied().unwrap_or_default();
    (parallaxes.len(), parallax, TwoViews { second_from_first: *motion, points })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::se3;
    use crate::tracking::solvers::residual::tests::PINHOLE;
    use nalgebra::Vector6;

    /// Matches of random points, on a plane or in a volume, half a pixel off; every eighth is wrong.
    fn matches(truth: &Se3, planar: bool) -> Vec<(Vector2<f64>, Vector2<f64>)> {
        let mut random = fastrand::Rng::with_seed(4);
        let mut found = Vec::new();
        while found.len() < 300 {
            let pixel = Vector2::new(640.0 * random.f64(), 480.0 * random.f64());
            let depth = if planar { 3.0 + 0.002 * pixel.x + 0.001 * pixel.y } else { 2.0 + 3.0 * random.f64() };
            let p = Point3::from(PINHOLE.unproject(&pixel, depth));
            let Some(seen) = PINHOLE.project(&(truth * p).coords) else { continue };
            let wrong = if found.len() % 8 == 0 { Vector2::new(40.0 * random.f64(), -35.0) } else { Vector2::zeros() };
            found.push((pixel, seen + wrong + Vector2::new(random.f64() - 0.5, random.f64() - 0.5)));
        }
        found
    }

    #[test]
    fn motion_is_found_in_planes_and_volumes() {
        let truth = se3::exp(&Vector6::new(0.5, -0.1, 0.1, 0.02, -0.1, 0.03));
        let direction = truth.translation.vector.normalize();
        let right =
            |motion: &Se3| motion.rotation.angle_to(&truth.rotation) < 0.01 && motion.translation.vector.dot(&direction) > 0.99;
        let found = two_views(&matches(&truth, false), &PINHOLE).unwrap();
        assert!(right(&found.second_from_first) && found.points.iter().flatten().count() > 200);
        // Two motions explain a plane equally well: the right one is among the candidates, and no wrong one is taken.
        let plane = matches(&truth, true);
        assert!(motions(&plane, &PINHOLE).unwrap().motions.iter().any(right));
        assert!(two_views(&plane, &PINHOLE).is_none_or(|found| right(&found.second_from_first)));
    }

    #[test]
    fn a_mere_turn_and_chance_give_nothing() {
        let turn = se3::exp(&Vector6::new(0.0, 0.0, 0.0, 0.03, -0.08, 0.02));
        assert!(two_views(&matches(&turn, false), &PINHOLE).is_none());
        let mut random = fastrand::Rng::with_seed(4);
        let mut pixel = || Vector2::new(640.0 * random.f64(), 480.0 * random.f64());
        let chance: Vec<_> = (0..200).map(|_| (pixel(), pixel())).collect();
        assert!(two_views(&chance, &PINHOLE).is_none());
        assert!(two_views(&chance[..5], &PINHOLE).is_none());
        assert!(two_views(&[(Vector2::zeros(), Vector2::zeros()); 80], &PINHOLE).is_none());
    }
}
