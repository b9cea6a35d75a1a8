//! Where features are too few: the relative pose of two RGB-D frames from all their pixels.
//!
//! Point-to-plane distances under projective association (Chen & Medioni 1992; Newcombe et al., *KinectFusion*, ISMAR 2011) and
//! brightness differences (Steinbrücker et al. 2011; Kerl et al. 2013) are minimised together, coarse to fine, with robust weights.

use nalgebra::{Matrix6, SymmetricEigen, Vector3, Vector6};

use crate::geometry::{Pinhole, Se3, se3};
use crate::tracking::features::dense_frame::DenseFrame;
use crate::tracking::solvers::pose::PosePrior;

/// Halvings of a frame's size, coarsest first, with the iterations on each.
const LEVELS: [(u32, usize); 4] = [(3, 20), (2, 16), (1, 12), (0, 10)];
/// Standard deviations of inverse depth among neighbouring pixels (1/metres; less than a lone keypoint's, which may lie on an edge), and of
/// brightness, grey levels.
const INVERSE_DEPTH_SIGMA: f64 = 0.004;
const GREY_SIGMA: f64 = 20.0;
/// Residuals beyond this many standard deviations pull less and less (Huber), at the finest level; each coarser one takes twice that.
const HUBER: f64 = 1.5;
/// Beyond this times Huber's threshold two points are of different surfaces.
const GATE: f64 = 8.0;
/// Cosine up to which normals agree.
const NORMAL_COSINE: f64 = 0.6;
const CONVERGED: f64 = 1e-6;
/// Share of the points in view that must agree.
const MIN_AGREEMENT: f64 = 0.55;
/// And of all points.
const MIN_OVERLAP: f64 = 0.3;
/// Correlation of the two frames' brightness that says they show one place: flat walls fit each other anywhere.
const MIN_RESEMBLANCE: f64 = 0.6;
/// The least information about any direction of motion, per point: (1/m)² or (1/rad)² over the squared residuals' scale.
const MIN_INFORMATION: f64 = 0.05;
/// Neighbouring pixels err together: so many say as much as one.
const ERRING_TOGETHER: f64 = 300.0;

/// A level of a dense frame with what follows from it.
struct Level {
    pinhole: Pinhole,
    grey: Vec<f64>,
    /// In the camera frame; `None` where depth is unknown.
    points: Vec<Option<Vector3<f64>>>,
    normals: Vec<Option<Vector3<f64>>>,
}

impl Level {
    fn new(frame: &DenseFrame, halvings: u32) -> Self {
        let step = 1usize << halvings;
        // Whole blocks only; what remains at the right and lower border is left out.
        let (full, s) = (frame.pinhole, 1.0 / step as f64);
        let pinhole = Pinhole {
            fx: full.fx * s,
            fy: full.fy * s,
            cx: (full.cx + 0.5) * s - 0.5,
            cy: (full.cy + 0.5) * s - 0.5,
            width: full.width >> halvings,
            height: full.height >> halvings,
        };
        let (width, height) = (pinhole.width as usize, pinhole.height as usize);
        let full = full.width as usize;
        let (mut grey, mut points) = (Vec::with_capacity(width * height), Vec::with_capacity(width * height));
        for i in 0..width * height {
            let (x, y) = (i % width, i / width);
            let block = || (0..step).flat_map(move |v| (0..step).map(move |u| (y * step + v) * full + x * step + u));
            grey.push(block().map(|s| f64::from(frame.grey[s])).sum::<f64>() / (step * step) as f64);
            // The nearest depth of the block: a mean would invent points between surfaces.
            let nearest = block().map(|s| f64::from(frame.depth[s])).filter(|d| *d > 0.0).min_by(f64::total_cmp);
            points.push(nearest.map(|d| pinhole.unproject(&nalgebra::Vector2::new(x as f64, y as f64), d)));
        }
        let normals = (0..points.len()).map(|i| normal(&points, i, width)).collect();
        Self { pinhole, grey, points, normals }
    }

    /// Brightness between pixels and its gradient; `None` at the border.
    fn brightness(&self, x: f64, y: f64) -> Option<(f64, f64, f64)> {
        let (width, height) = (self.pinhole.width as usize, self.pinhole.height as usize);
        let (column, row) = (x.floor(), y.floor());
        // NaN is not inside.
        if !(column >= 0.0 && row >= 0.0 && column < (width - 1) as f64 && row < (height - 1) as f64) {
            return None;
        }
        let (u, v) = (x - column, y - row);
        let at = row as usize * width + column as usize;
        let [a, b, c, d] = [self.grey[at], self.grey[at + 1], self.grey[at + width], self.grey[at + width + 1]];
        let value = (1.0 - v) * ((1.0 - u) * a + u * b) + v * ((1.0 - u) * c + u * d);
        Some((value, (1.0 - v) * (b - a) + v * (d - c), (1.0 - u) * (c - a) + u * (d - b)))
    }
}

/// Normal towards the camera from the neighbours on both sides; `None` at the border and over edges.
fn normal(points: &[Option<Vector3<f64>>], i: usize, width: usize) -> Option<Vector3<f64>> {
    let (x, y) = (i % width, i / width);
    if x == 0 || y == 0 || x + 1 == width || i + width >= points.len() {
        return None;
    }
    let here = points[i]?;
    let (right, left, below, above) = (points[i + 1]?, points[i - 1]?, points[i + width]?, points[i - width]?);
    let edge = 0.08 * here.z;
    if [right, left, below, above].iter().any(|p| (p.z - here.z).abs() > edge) {
        return None;
    }
    let n = (right - left).cross(&(below - above)).try_normalize(1e-12)?;
    Some(if n.dot(&here) > 0.0 { -n } else { n })
}

/// A relative pose, and how well it is held.
#[derive(Clone, Copy, Debug)]
pub struct Aligned {
    pub current_from_reference: Se3,
    /// Share of the reference's points that the current frame sees and confirms.
    pub overlap: f64,
    /// Of a left perturbation (metres, radians).
    pub information: Matrix6<f64>,
}

impl Aligned {
    /// What it says of the current pose, given that of the reference.
    pub fn prior(&self, reference_from_world: &Se3) -> PosePrior {
        PosePrior { camera_from_world: self.current_from_reference * reference_from_world, information: self.information }
    }
}

/// Normal equations of one level at one pose.
#[derive(Clone, Debug, Default)]
struct Sums {
    hessian: Matrix6<f64>,
    gradient: Vector6<f64>,
    cost: f64,
    points: usize,
    in_view: usize,
    agree: usize,
}

/// The pose of `current` relative to `reference`, from the best of some initial guesses; `None` where the two do not agree, or the scene
/// does not hold the pose (a single plane without texture).
pub fn align(reference: &DenseFrame, current: &DenseFrame, guesses: &[Se3]) -> Option<Aligned> {
    let mut best: Option<(f64, Aligned)> = None;
    let levels: Vec<LevelPair> = LEVELS
        .iter()
        .map(|(halvings, steps)| LevelPair {
            reference: Level::new(reference, *halvings),
            current: Level::new(current, *halvings),
            steps: *steps,
            huber: HUBER * f64::from(1 << halvings),
        })
        .collect();
    for guess in guesses {
        let mut pose = *guess;
        for level in &levels {
            pose = descend(level, pose);
        }
        let LevelPair { reference, current, huber, .. } = &levels[levels.len() - 1];
        let sums = linearise(reference, current, &pose, *huber);
        let agreement = sums.agree as f64 / sums.in_view.max(1) as f64;
        let overlap = sums.agree as f64 / sums.points.max(1) as f64;
        let information = SymmetricEigen::new(sums.hessian / sums.agree.max(1) as f64).eigenvalues.min();
        let alike = resemblance(reference, current, &pose) >= MIN_RESEMBLANCE;
        let held = alike && agreement >= MIN_AGREEMENT && overlap >= MIN_OVERLAP && information >= MIN_INFORMATION;
        let cost = sums.cost / sums.in_view.max(1) as f64;
        if held && best.as_ref().is_none_or(|(least, _)| cost < *least) {
            best = Some((cost, Aligned { current_from_reference: pose, overlap, information: sums.hessian / ERRING_TOGETHER }));
        }
    }
    best.map(|(_, aligned)| aligned)
}

/// Both frames at one pyramid level, and the level's schedule.
struct LevelPair {
    reference: Level,
    current: Level,
    /// Most Gauss-Newton steps.
    steps: usize,
    /// Threshold of the robust loss, standard deviations.
    huber: f64,
}

/// Gauss-Newton with damping on one level.
fn descend(level: &LevelPair, initial: Se3) -> Se3 {
    let mut pose = initial;
    for _ in 0..level.steps {
        let sums = linearise(&level.reference, &level.current, &pose, level.huber);
        let mut damped = sums.hessian;
        (0..6).for_each(|k| damped[(k, k)] += 1e-3 * sums.hessian[(k, k)] + 1e-3);
        let Some(step) = damped.cholesky().map(|c| c.solve(&-sums.gradient)) else { break };
        pose = se3::exp(&step) * pose;
        if step.norm() < CONVERGED {
            break;
        }
    }
    pose.rotation.renormalize();
    pose
}

fn linearise(reference: &Level, current: &Level, pose: &Se3, huber: f64) -> Sums {
    let mut sums = Sums::default();
    let offset = brightness_offset(reference, current, pose);
    let pinhole = &current.pinhole;
    for (i, point) in reference.points.iter().enumerate() {
        let (Some(point), Some(normal)) = (point, reference.normals[i]) else { continue };
        sums.points += 1;
        let p = pose * nalgebra::Point3::from(*point);
        let Some(pixel) = pinhole.project(&p.coords).filter(|pixel| pinhole.contains(pixel, 0.0)) else { continue };
        let at = pixel.y.round() as usize * pinhole.width as usize + pixel.x.round() as usize;
        let (Some(target), Some(facing)) = (current.points[at], current.normals[at]) else { continue };
        sums.in_view += 1;
        // Distance from the plane, in standard deviations of what the sensor measures there.
        let sigma = INVERSE_DEPTH_SIGMA * target.z * target.z;
        let distance = facing.dot(&(p.coords - target)) / sigma.max(1e-4);
        if distance.abs() > GATE * huber || (pose.rotation * normal).dot(&facing) < NORMAL_COSINE {
            sums.cost += GATE * huber * huber;
            continue;
        }
        sums.agree += 1;
        let row = by_pose(&p.coords, &(facing / sigma.max(1e-4)));
        sums.add(&row, distance, huber);
        let Some((value, gx, gy)) = current.brightness(pixel.x, pixel.y) else { continue };
        let error = (value - reference.grey[i] - offset) / GREY_SIGMA;
        let iz = 1.0 / p.z;
        let (fx, fy) = (gx * pinhole.fx * iz, gy * pinhole.fy * iz);
        let gradient = Vector3::new(fx, fy, -(fx * p.x + fy * p.y) * iz) / GREY_SIGMA;
        sums.add(&by_pose(&p.coords, &gradient), error, huber);
    }
    sums
}

impl Sums {
    fn add(&mut self, row: &Vector6<f64>, residual: f64, huber: f64) {
        let weight = if residual.abs() <= huber { 1.0 } else { huber / residual.abs() };
        self.hessian += weight * row * row.transpose();
        self.gradient += weight * residual * row;
        self.cost += weight * residual * residual;
    }
}

/// Derivative of a function of a point in the camera frame, with gradient `g` there, by a left perturbation of the pose.
fn by_pose(p: &Vector3<f64>, g: &Vector3<f64>) -> Vector6<f64> {
    let turn = p.cross(g);
    Vector6::new(g.x, g.y, g.z, turn.x, turn.y, turn.z)
}

/// Correlation of the reference's brightness with what the current frame shows there; 0 where either is blank.
fn resemblance(reference: &Level, current: &Level, pose: &Se3) -> f64 {
    let mut pairs: Vec<(f64, f64)> = Vec::new();
    for (point, grey) in reference.points.iter().zip(&reference.grey) {
        let Some(point) = point else { continue };
        let p = pose * nalgebra::Point3::from(*point);
        let Some(pixel) = current.pinhole.project(&p.coords) else { continue };
        pairs.extend(current.brightness(pixel.x, pixel.y).map(|(value, ..)| (*grey, value)));
    }
    let count = pairs.len().max(1) as f64;
    let (a, b) = pairs.iter().fold((0.0, 0.0), |s, p| (s.0 + p.0 / count, s.1 + p.1 / count));
    let (aa, bb, ab) = pairs.iter().fold((0.0, 0.0, 0.0), |s, p| {
        let (x, y) = (p.0 - a, p.1 - b);
        (s.0 + x * x, s.1 + y * y, s.2 + x * y)
    });
    // A grey level or two is noise.
    if aa < count || bb < count { 0.0 } else { ab / (aa * bb).sqrt() }
}

/// Median difference in brightness: the exposure may have changed.
fn brightness_offset(reference: &Level, current: &Level, pose: &Se3) -> f64 {
    let mut differences: Vec<f64> = Vec::new();
    for (i, point) in reference.points.iter().enumerate().step_by(3) {
        let Some(point) = point else { continue };
        let p = pose * nalgebra::Point3::from(*point);
        let Some(pixel) = current.pinhole.project(&p.coords) else { continue };
        let Some((value, ..)) = current.brightness(pixel.x, pixel.y) else { continue };
        differences.push(value - reference.grey[i]);
    }
    differences.sort_by(f64::total_cmp);
    differences.get(differences.len() / 2).copied().unwrap_or_default()
}

#[cfg(test)]
pub mod tests {
    use super::*;
    use crate::geometry::{Camera, Distortion};
    use crate::sequence::DepthImage;
    use crate::tracking::TrackingConfig;
    use crate::tracking::features::dense_frame::{DenseSampler, SCALE};
    use crate::tracking::solvers::residual::tests::PINHOLE;
    use nalgebra::{Point3, Vector2};

    const CAMERA: Camera = Camera {
        pinhole: PINHOLE,
        distortion: Distortion { k1: 0.0, k2: 0.0, p1: 0.0, p2: 0.0, k3: 0.0 },
        depth_units_per_metre: 5000.0,
    };

    /// A room's corner: three planes, grey with soft stripes. The nearest hit along each pixel's line of sight.
    pub fn corner(camera_from_world: &Se3) -> DenseFrame {
        let world_from_camera = camera_from_world.inverse();
        let eye = world_from_camera * Point3::origin();
        let mut metres = vec![0.0f32; 640 * 480];
        let mut grey = vec![0u8; 640 * 480];
        for (i, (metres, grey)) in metres.iter_mut().zip(&mut grey).enumerate() {
            let ray = PINHOLE.unproject(&Vector2::new((i % 640) as f64, (i / 640) as f64), 1.0);
            let direction = world_from_camera.rotation * ray;
            let planes = [(Vector3::x(), 1.2), (Vector3::y(), 0.9), (Vector3::z(), 3.0)];
            let hit = planes.iter().filter_map(|(n, d)| {
                let along = n.dot(&direction);
                let t = (d - n.dot(&eye.coords)) / along;
                (t > 0.0).then_some(t)
            });
            let t = hit.min_by(f64::total_cmp).unwrap_or(0.0);
            let p = eye + direction * t;
            *metres = t as f32;
            *grey = (120.0 + 25.0 * (3.0 * p.x + 2.0 * p.z).sin() + 20.0 * (2.5 * p.y - p.x).cos()) as u8;
        }
        let depth = DepthImage { width: 640, height: 480, metres };
        DenseSampler::new(&CAMERA).sample(&grey, &depth, &TrackingConfig::default())
    }

    #[test]
    fn a_corner_without_features_holds_the_pose() {
        let truth = se3::exp(&Vector6::new(0.12, -0.06, 0.1, 0.04, -0.07, 0.05));
        let (reference, current) = (corner(&Se3::identity()), corner(&truth));
        let found = align(&reference, &current, &[Se3::identity()]).unwrap();
        let error = se3::log(&(found.current_from_reference * truth.inverse()));
        assert!(error.norm() < 5e-3, "{error}");
        assert!(found.overlap > 0.5);
    }

    #[test]
    fn what_does_not_fit_or_does_not_hold_is_refused() {
        let reference = corner(&Se3::identity());
        let elsewhere = corner(&se3::exp(&Vector6::new(0.0, 0.0, 0.0, 0.0, 2.4, 0.0)));
        assert!(align(&reference, &elsewhere, &[Se3::identity()]).is_none());
        // Sizes that halve to nothing whole.
        let odd = Pinhole { width: 45, height: 31, ..PINHOLE.scaled(0.07) };
        let small = DenseFrame { depth: vec![2.0; 45 * 31], grey: vec![100.0; 45 * 31], pinhole: odd };
        assert!(align(&small, &small, &[Se3::identity()]).is_none());
        // A blank wall says nothing about sliding along it.
        let wall = DenseFrame { depth: vec![2.0; 160 * 120], grey: vec![100.0; 160 * 120], pinhole: PINHOLE.scaled(SCALE) };
        assert!(align(&wall, &wall, &[Se3::identity()]).is_none());
        let blind = DenseFrame { depth: vec![0.0; 160 * 120], ..wall.clone() };
        assert!(align(&blind, &wall, &[Se3::identity()]).is_none());
    }
}
