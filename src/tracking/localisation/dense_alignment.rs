//! Where features are too few: the relative pose of two RGB-D frames from all their pixels.
//!
//! Point-to-plane distances under projective association (Chen & Medioni 1992; Newcombe et al., *KinectFusion*, ISMAR 2011) and
//! brightness differences (Steinbrücker et al. 2011; Kerl et al. 2013) are minimised together, coarse to fine, with robust weights.

use nalgebra::{Matrix6, SymmetricEigen, Vector3, Vector6};

use crate::geometry::{Pinhole, Se3, se3};
use crate::tracking::features::dense_frame::DenseFrame;
use crate::tracking::solvers::pose::PosePrior;
use crate::tracking::solvers::relative_pose::RelativePose;

/// Halvings of a frame's size, coarsest first, with the iterations on each.
const LEVELS: [(u32, usize); 4] = [(3, 20), (2, 16), (1, 12), (0, 10)];
/// Levels by which guesses are compared.
const COARSE: usize = 2;
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
/// Steps below this times the side of a pixel have converged.
const CONVERGED: f64 = 1e-5;
/// Share of the points in view that must agree.
const MIN_AGREEMENT: f64 = 0.55;
/// And of all points.
const MIN_OVERLAP: f64 = 0.3;
/// Correlation of the two frames' brightness that says they show one place: flat walls fit each other anywhere.
const MIN_RESEMBLANCE: f64 = 0.6;
/// The least information about any direction of motion, per point: (1/m)² or (1/rad)² over the squared residuals' scale.
const MIN_INFORMATION: f64 = 0.05;
/// Neighbouring pixels err together: so many say as much as one.
const ERRING_TOGETHER: f64 = 1000.0;

/// A level of a dense frame with what follows from it.
struct Level {
    pinhole: Pinhole,
    grey: Vec<f64>,
    /// `None` where depth is unknown, at the border and over edges.
    surfaces: Vec<Option<Surface>>,
}

/// What a pixel shows, in the camera frame.
#[derive(Clone, Copy, Debug)]
struct Surface {
    point: Vector3<f64>,
    /// Towards the camera.
    normal: Vector3<f64>,
}

impl Surface {
    /// Its point in the frame of the camera at a pose relative to this one.
    fn seen_from(&self, pose: &Se3) -> Vector3<f64> {
        pose.rotation * self.point + pose.translation.vector
    }
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
        let surface = |i: usize| Some(Surface { point: points[i]?, normal: normal(&points, i, width)? });
        Self { pinhole, grey, surfaces: (0..width * height).map(surface).collect() }
    }

    /// Brightness between pixels and its gradient; `None` at the border.
    fn brightness(&self, x: f64, y: f64) -> Option<(f64, f64, f64)> {
        let (width, height) = (self.pinhole.width as usize, self.pinhole.height as usize);
        // NaN is not inside.
        if !(x >= 0.0 && y >= 0.0 && x < (width - 1) as f64 && y < (height - 1) as f64) {
            return None;
        }
        let (column, row) = (x as usize, y as usize);
        let (u, v) = (x - column as f64, y - row as f64);
        let at = row * width + column;
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
        self.relative_pose(0, 0).prior(reference_from_world)
    }

    /// The same as a factor between two poses, which their places name.
    pub fn relative_pose(&self, current: usize, reference: usize) -> RelativePose {
        let Self { current_from_reference, information, .. } = *self;
        RelativePose { current, reference, current_from_reference, information }
    }
}

/// Normal equations of one level at one pose.
#[derive(Clone, Debug, Default)]
struct Sums {
    /// Its lower triangle.
    hessian: Matrix6<f64>,
    gradient: Vector6<f64>,
    cost: f64,
    points: usize,
    in_view: usize,
    agree: usize,
}

/// The pose of `current` relative to `reference`; `None` where the two do not agree, or the scene does not hold the pose (a single plane without
/// texture). Initial guesses are tried in the order of their costs on the coarse levels, until a pose is held.
pub fn align(reference: &DenseFrame, current: &DenseFrame, guesses: &[Se3]) -> Option<Aligned> {
    let level = |(halvings, steps): &(u32, usize)| LevelPair {
        reference: Level::new(reference, *halvings),
        current: Level::new(current, *halvings),
        steps: *steps,
        scale: f64::from(1 << halvings),
    };
    let coarse: Vec<LevelPair> = LEVELS[..COARSE].iter().map(level).collect();
    let rough = |guess: &Se3| {
        let pose = coarse.iter().fold(*guess, |pose, level| level.descend(pose));
        let sums = coarse[COARSE - 1].linearise(&pose);
        let cost = if sums.in_view == 0 { f64::INFINITY } else { sums.cost / sums.in_view as f64 };
        (cost, pose)
    };
    let mut rough: Vec<(f64, Se3)> = guesses.iter().map(rough).collect();
    rough.sort_by(|a, b| a.0.total_cmp(&b.0));
    let fine: Vec<LevelPair> = LEVELS[COARSE..].iter().map(level).collect();
    let refine = |pose: Se3| {
        let pose = fine.iter().fold(pose, |pose, level| level.descend(pose));
        fine[fine.len() - 1].held(pose)
    };
    rough.into_iter().find_map(|(_, pose)| refine(pose))
}

/// Both frames at one pyramid level, and the level's schedule.
struct LevelPair {
    reference: Level,
    current: Level,
    /// Most Gauss-Newton steps.
    steps: usize,
    /// Side of a pixel, those of the finest level.
    scale: f64,
}

impl LevelPair {
    /// Gauss-Newton with damping.
    fn descend(&self, initial: Se3) -> Se3 {
        let mut pose = initial;
        for _ in 0..self.steps {
            let sums = self.linearise(&pose);
            let mut damped = sums.hessian;
            (0..6).for_each(|k| damped[(k, k)] += 1e-3 * sums.hessian[(k, k)] + 1e-3);
            let Some(step) = damped.cholesky().map(|c| c.solve(&-sums.gradient)) else { break };
            pose = se3::exp(&step) * pose;
            if step.norm() < CONVERGED * self.scale {
                break;
            }
        }
        pose.rotation.renormalize();
        pose
    }

    /// The pose, if the frames agree there and hold it.
    fn held(&self, pose: Se3) -> Option<Aligned> {
        let sums = self.linearise(&pose);
        let mut information = sums.hessian;
        information.fill_upper_triangle_with_lower_triangle();
        let agreement = sums.agree as f64 / sums.in_view.max(1) as f64;
        let overlap = sums.agree as f64 / sums.points.max(1) as f64;
        let least = SymmetricEigen::new(information / sums.agree.max(1) as f64).eigenvalues.min();
        let alike = || resemblance(&self.reference, &self.current, &pose) >= MIN_RESEMBLANCE;
        let held = agreement >= MIN_AGREEMENT && overlap >= MIN_OVERLAP && least >= MIN_INFORMATION && alike();
        held.then(|| Aligned { current_from_reference: pose, overlap, information: information / ERRING_TOGETHER })
    }

    fn linearise(&self, pose: &Se3) -> Sums {
        let Self { reference, current, .. } = self;
        let huber = HUBER * self.scale;
        let mut sums = Sums::default();
        let offset = brightness_offset(reference, current, pose);
        let (pinhole, rotation) = (&current.pinhole, pose.rotation.to_rotation_matrix());
        for (i, surface) in reference.surfaces.iter().enumerate() {
            let Some(Surface { point, normal }) = surface else { continue };
            sums.points += 1;
            let p = rotation * point + pose.translation.vector;
            let Some(pixel) = pinhole.project(&p).filter(|pixel| pinhole.contains(pixel, 0.0)) else { continue };
            let at = (pixel.y + 0.5) as usize * pinhole.width as usize + (pixel.x + 0.5) as usize;
            let Some(Surface { point: target, normal: facing }) = &current.surfaces[at] else { continue };
            sums.in_view += 1;
            // Distance from the plane, in standard deviations of what the sensor measures there.
            let weight = 1.0 / (INVERSE_DEPTH_SIGMA * target.z * target.z).max(1e-4);
            let distance = facing.dot(&(p - target)) * weight;
            if distance.abs() > GATE * huber || (rotation * normal).dot(facing) < NORMAL_COSINE {
                sums.cost += GATE * huber * huber;
                continue;
            }
            sums.agree += 1;
            sums.add(&by_pose(&p, &(facing * weight)), distance, huber);
            let Some((value, gx, gy)) = current.brightness(pixel.x, pixel.y) else { continue };
            let error = (value - reference.grey[i] - offset) / GREY_SIGMA;
            let iz = 1.0 / p.z;
            let (fx, fy) = (gx * pinhole.fx * iz, gy * pinhole.fy * iz);
            let gradient = Vector3::new(fx, fy, -(fx * p.x + fy * p.y) * iz) / GREY_SIGMA;
            sums.add(&by_pose(&p, &gradient), error, huber);
        }
        sums
    }
}

impl Sums {
    fn add(&mut self, row: &Vector6<f64>, residual: f64, huber: f64) {
        let weight = if residual.abs() <= huber { 1.0 } else { huber / residual.abs() };
        for column in 0..6 {
            let weighted = weight * row[column];
            for k in column..6 {
                self.hessian[(k, column)] += weighted * row[k];
            }
            self.gradient[column] += weighted * residual;
        }
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
    for (surface, grey) in reference.surfaces.iter().zip(&reference.grey) {
        let Some(surface) = surface else { continue };
        let Some(pixel) = current.pinhole.project(&surface.seen_from(pose)) else { continue };
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
    for (i, surface) in reference.surfaces.iter().enumerate().step_by(3) {
        let Some(surface) = surface else { continue };
        let Some(pixel) = current.pinhole.project(&surface.seen_from(pose)) else { continue };
        let Some((value, ..)) = current.brightness(pixel.x, pixel.y) else { continue };
        differences.push(value - reference.grey[i]);
    }
    let middle = differences.len() / 2;
    if differences.is_empty() { 0.0 } else { *differences.select_nth_unstable_by(middle, f64::total_cmp).1 }
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
        // Guesses that lead nowhere do not stand in the way of one that does.
        let astray =
            [se3::exp(&Vector6::new(0.0, 0.0, 0.0, 0.0, 1.2, 0.0)), se3::exp(&Vector6::new(0.0, 0.0, 0.0, 0.9, 0.0, 0.4))];
        assert!(align(&reference, &current, &astray).is_none());
        let among = align(&reference, &current, &[astray[0], Se3::identity(), astray[1]]).unwrap();
        assert!(se3::log(&(among.current_from_reference * truth.inverse())).norm() < 5e-3);
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
