//! The tracker's solvers for whole maps: bundle adjustment, pose graphs, alignment of point sets and of keyframes that share points.
//!
//! A least-squares answer that costs more than the truth, by the very cost that it minimises, was not found: the truth was there to be
//! had. That holds at any conditioning, where errors themselves may be as large as they like along what nothing was measured of.

use fastrand::Rng;
use nalgebra::{Point3, Vector3, Vector6};

use super::geometry::{PINHOLE, Shape, VOLUME, WORLDS, World, is_finite, pose_error, small_motion, trust, world_point};
use super::scenes::gauss;
use super::{Family, Outcome, Part};
use crate::geometry::sim3::Vector7;
use crate::geometry::{Se3, Sim3, align, se3, sim3};
use crate::tracking::solvers::bundle::{BundleObservation, BundleProblem, CONVERGED};
use crate::tracking::solvers::pose_graph::{Edge, PoseGraph};
use crate::tracking::solvers::sim3_alignment::{Pair, align_pairs};

/// Costs above the truth's by more than this share were not minimised; adjustment stops at steps that gain a ten-thousandth.
const COST_LIMIT: f64 = 1.02;
const STEPS: usize = 10;

pub fn families() -> Vec<Family<'static>> {
    let bundles = WORLDS.into_iter().flat_map(|(name, world)| {
        [(false, ""), (true, ", depth")].map(|(with_depth, more)| {
            let case = move |rng: &mut Rng| Ok(bundle(rng, &world, with_depth, 0.3, 0));
            Family::new(Part::Tracker, format!("bundle: {name}{more}"), 10, case)
        })
    });
    let baselines = [0.03, 0.003].into_iter().map(|metres| {
        let case = move |rng: &mut Rng| Ok(bundle(rng, &VOLUME, false, metres, 0));
        Family::new(Part::Tracker, format!("bundle: baseline {metres}"), 10, case)
    });
    let behind = Family::new(Part::Tracker, "bundle: points begin behind", 10, |rng| Ok(bundle(rng, &VOLUME, false, 0.3, 5)));
    let graphs = GRAPHS.into_iter().map(|(name, graph)| {
        Family::new(Part::Tracker, format!("pose graph: {name}"), 10, move |rng| Ok(pose_graph(rng, &graph)))
    });
    let sets = WORLDS.into_iter().flat_map(|(name, world)| {
        [(false, ""), (true, ", scale free")].map(|(scale_is_free, more)| {
            let case = move |rng: &mut Rng| Ok(point_sets(rng, &world, scale_is_free));
            Family::new(Part::Tracker, format!("align points: {name}{more}"), 1, case)
        })
    });
    let both = WORLDS.into_iter().filter(|(_, world)| world.away == 0.0 && world.scale == 1.0).flat_map(|(name, world)| {
        [(false, ", depth"), (true, ", scale free")].map(|(scale_is_free, more)| {
            let case = move |rng: &mut Rng| Ok(keyframes(rng, &world, scale_is_free, 0.3));
            Family::new(Part::Tracker, format!("align keyframes: {name}{more}"), 2, case)
        })
    });
    let same_place =
        Family::new(Part::Tracker, "align keyframes: same place, scale free", 2, |rng| Ok(keyframes(rng, &VOLUME, true, 1e-3)));
    bundles.chain(baselines).chain([behind]).chain(graphs).chain(sets).chain(both).chain([same_place]).collect()
}

/// Six cameras `metres` apart on an arc before 80 points, the last two held; a twentieth of the measurements is wrong. Some points are
/// believed `behind` the cameras at first.
fn bundle(rng: &mut Rng, world: &World, with_depth: bool, metres: f64, behind: usize) -> Outcome {
    let world_from_home = world.placed(rng);
    let mut truth = BundleProblem { free_poses: 4, ..Default::default() };
    let at_home: Vec<Se3> = (0..6)
        .map(|k| {
            let along = f64::from(k) - 2.5;
            let tau = Vector6::new(metres * along, -0.3 * metres * along, 0.2 * metres * along, 0.02 * along, 0.03 * along, 0.0);
            se3::exp(&tau) * small_motion(rng, 0.02 * metres, 0.02)
        })
        .collect();
    truth.poses = at_home.iter().map(|pose| world.camera(pose, &world_from_home)).collect();
    for point in 0..80 {
        truth.points.push(world_point(&world_from_home, &Se3::identity(), &world.point(rng)));
        for pose in 0..6 {
            let p_in_camera = (truth.poses[pose] * truth.points[point]).coords;
            let Some(mut measurement) = world.measure(rng, &p_in_camera, with_depth) else { continue };
            measurement.pixel.x += if rng.f64() < 0.05 { 30.0 } else { 0.0 };
            truth.observations.push(BundleObservation { pose, point, measurement, class: trust(&measurement) });
        }
    }
    let mut problem = truth.clone();
    for pose in &mut problem.poses[..4] {
        *pose =
            super::geometry::step(pose, &pose_error(&small_motion(rng, 0.02 * metres, 0.01), &Se3::identity(), 1.0), world.scale);
    }
    for (index, point) in problem.points.iter_mut().enumerate() {
        // Along the line of sight mostly, as triangulation errs.
        let p_in_camera = world_from_home.inverse().act(point).coords;
        let side = if index < behind { -1.0 } else { 1.0 };
        *point = world_from_home.act(&Point3::from(p_in_camera * (1.0 + 0.02 * gauss(rng)) * side));
    }
    solve_bundle(&mut problem, &mut truth, world)
}

fn solve_bundle(problem: &mut BundleProblem, truth: &mut BundleProblem, world: &World) -> Outcome {
    let mut outcome = Outcome::default();
    for _ in 0..2 {
        problem.solve(&PINHOLE, STEPS, CONVERGED);
        problem.classify(&PINHOLE);
    }
    let (_, cost) = problem.solve(&PINHOLE, STEPS, CONVERGED);
    truth.observations.clone_from(&problem.observations);
    let least = truth.cost(&PINHOLE);
    let trusted = problem.observations.iter().filter(|o| o.measurement.restricted_to(o.class).is_some()).count();
    if trusted == 0 {
        outcome.count("refused", 1);
        return outcome;
    }
    let finite =
        problem.poses.iter().all(is_finite) && problem.points.iter().flat_map(|p| p.coords.iter()).all(|v| v.is_finite());
    outcome.require(finite, || "a pose or a point is not finite".into());
    outcome.measure("cost, of the truth's", cost / least, COST_LIMIT);
    outcome.measure("left out as wrong", 1.0 - trusted as f64 / problem.observations.len() as f64, 0.35);
    let errors: Vec<_> = problem.poses.iter().zip(&truth.poses).map(|(a, b)| pose_error(a, b, world.scale)).collect();
    let worst = |rows: usize| errors.iter().map(|e| e.rows(rows, 3).norm()).fold(0.0, f64::max);
    outcome.note("translation, of the depth", worst(0) / world.near);
    outcome.note("rotation, rad", worst(3));
    outcome
}

/// A walk round a circle, measured step by step, with closures.
#[derive(Clone, Copy, Debug)]
struct Graph {
    stations: usize,
    scale_is_free: bool,
    size: f64,
    away: f64,
    /// Noise of each step: of translations as a share of the size, and of rotations.
    sigma: f64,
    /// Share of the closures that are false; these are doubted.
    wrong: f64,
    /// Poses that no edge touches.
    loose: usize,
}

const WALK: Graph = Graph { stations: 60, scale_is_free: false, size: 1.0, away: 0.0, sigma: 2e-3, wrong: 0.0, loose: 0 };

const GRAPHS: [(&str, Graph); 10] = [
    ("rigid", WALK),
    ("scale free", Graph { scale_is_free: true, ..WALK }),
    ("10 km away", Graph { away: 1e4, ..WALK }),
    ("scale free, 10 km away", Graph { away: 1e4, scale_is_free: true, ..WALK }),
    ("size 1e-3", Graph { size: 1e-3, ..WALK }),
    ("size 1e3", Graph { size: 1e3, ..WALK }),
    ("scale free, size 1e3", Graph { size: 1e3, scale_is_free: true, ..WALK }),
    ("stiff", Graph { sigma: 1e-6, ..WALK }),
    ("false closures", Graph { wrong: 0.3, ..WALK }),
    ("400 stations, loose poses", Graph { stations: 400, loose: 5, ..WALK }),
];

fn pose_graph(rng: &mut Rng, graph: &Graph) -> Outcome {
    let away = Vector3::new(0.7, -0.1, 0.7) * graph.away;
    let truth: Vec<Sim3> = (0..graph.stations)
        .map(|k| {
            let angle = k as f64 / graph.stations as f64 * std::f64::consts::TAU;
            let turn = Se3::new(Vector3::zeros(), Vector3::y() * angle);
            let world_from_camera =
                Se3::translation(away.x, away.y, away.z) * turn * Se3::translation(0.0, 0.0, -4.0 * graph.size);
            Sim3::from(world_from_camera.inverse())
        })
        .collect();
    let sigmas = Vector7::from_fn(|i, _| graph.sigma * [graph.size, 1.0, f64::from(u8::from(graph.scale_is_free))][i / 3]);
    let weights = Vector7::from_fn(|i, _| if sigmas[i] > 0.0 { 1.0 / sigmas[i] } else { 0.0 });
    let mut edge = |a: usize, b: usize, wrong: bool, huber: Option<f64>| {
        let mut tau = Vector7::from_fn(|i, _| sigmas[i] * gauss(rng));
        if wrong {
            tau += Vector7::from_fn(|i, _| sigmas[i] * 300.0);
        }
        Edge { a, b, a_from_b: sim3::exp(&tau) * truth[a] * truth[b].inverse(), weights, huber }
    };
    let mut problem = PoseGraph { poses: vec![truth[0]], scale_is_free: graph.scale_is_free, ..Default::default() };
    for k in 1..graph.stations {
        problem.edges.push(edge(k, k - 1, false, None));
        let last = problem.poses[k - 1];
        problem.poses.push(problem.edges[k - 1].a_from_b * last);
    }
    for k in 0..graph.stations / 6 {
        let wrong = (k as f64) < graph.wrong * (graph.stations / 6) as f64;
        problem.edges.push(edge(k, graph.stations - 1 - k, wrong, (graph.wrong > 0.0).then_some(3.0)));
    }
    problem.poses.extend((0..graph.loose).map(|_| truth[0]));
    let mut outcome = Outcome::default();
    let (before, after) = problem.optimise(50);
    let all: Vec<Sim3> = truth.iter().chain(&problem.poses[graph.stations..]).copied().collect();
    let least = PoseGraph { poses: all, ..problem.clone() }.cost();
    let centre = |pose: &Sim3| pose.inverse().translation;
    let off = problem.poses.iter().zip(&truth).map(|(p, t)| (centre(p) - centre(t)).norm()).fold(0.0, f64::max);
    outcome.note("cost before, of the truth's", before / least);
    outcome.measure("cost, of the truth's", after / least, 1.0 + 1e-6);
    outcome.note("farthest off, of the size", off / graph.size);
    outcome
}

/// A point set, moved, with noise on both sides.
fn point_sets(rng: &mut Rng, world: &World, scale_is_free: bool) -> Outcome {
    let moved = world.placed(rng);
    let truth = if scale_is_free { moved } else { Sim3 { scale: 1.0, ..moved } };
    let sigma = 0.01 * world.near;
    let mut noisy = |p: Vector3<f64>, scale: f64| p + Vector3::from_fn(|_, _| sigma * scale * gauss(rng));
    let mut own = Rng::with_seed(moved.translation.x.to_bits());
    let points: Vec<Vector3<f64>> = (0..40).map(|_| world.point(&mut own)).collect();
    let from: Vec<_> = points.iter().map(|p| noisy(*p, 1.0)).collect();
    let to: Vec<_> = points.iter().map(|p| noisy(truth.act(&Point3::from(*p)).coords, truth.scale)).collect();
    let mut outcome = Outcome::default();
    let Some(found) = align(&from, &to, scale_is_free) else {
        outcome.count("refused", 1);
        return outcome;
    };
    let cost = |s: &Sim3| from.iter().zip(&to).map(|(a, b)| (s.act(&Point3::from(*a)).coords - b).norm_squared()).sum::<f64>();
    // The closed form is exact: nothing may beat it but for rounding of coordinates.
    let rounding = 40.0 * (1e-15 * (truth.translation.norm() + world.far * truth.scale)).powi(2);
    outcome.measure("cost, of the truth's", cost(&found) / (cost(&truth) + rounding), 1.0 + 1e-9);
    outcome.note("scale off", (found.scale / truth.scale - 1.0).abs());
    outcome.note("rotation, rad", found.rotation.angle_to(&truth.rotation));
    outcome.require(found.scale > 0.0, || format!("the scale is {}", found.scale));
    outcome
}

/// Two keyframes within `metres` that know 120 points, a fifth of them paired falsely.
fn keyframes(rng: &mut Rng, world: &World, scale_is_free: bool, metres: f64) -> Outcome {
    let scale = if scale_is_free { 0.7 + 0.7 * rng.f64() } else { 1.0 };
    let b_from_a = Sim3 { scale, ..Sim3::from(small_motion(rng, metres, 0.2)) };
    let mut pairs = Vec::new();
    while pairs.len() < 120 {
        let in_a = world.point(rng);
        let in_b = b_from_a.act(&Point3::from(in_a)).coords;
        let (Some(at_a), Some(at_b)) = (world.measure(rng, &in_a, !scale_is_free), world.measure(rng, &in_b, !scale_is_free))
        else {
            continue;
        };
        // What a keyframe knows of a point errs along its line of sight.
        let (p_in_a, p_in_b) = (Point3::from(in_a * (1.0 + 0.003 * gauss(rng))), Point3::from(in_b * (1.0 + 0.003 * gauss(rng))));
        pairs.push(Pair { p_in_a, p_in_b, in_a: at_a, in_b: at_b });
    }
    for i in (0..pairs.len()).step_by(5) {
        let other = pairs[(i + 7) % 120];
        (pairs[i].p_in_b, pairs[i].in_b) = (other.p_in_b, other.in_b);
    }
    let mut outcome = Outcome::default();
    let Some(found) = align_pairs(&pairs, &PINHOLE, scale_is_free) else {
        outcome.count("refused", 1);
        return outcome;
    };
    let error = sim3::log(&(found * b_from_a));
    let is_well_posed = matches!(world.shape, Shape::Volume | Shape::Plane);
    let limit = if is_well_posed { 0.05 } else { f64::INFINITY };
    outcome.require(error.iter().all(|v| v.is_finite()), || "the motion is not finite".into());
    outcome.measure("rotation, rad", error.rows(3, 3).norm(), limit);
    outcome.measure("translation, of the depth", error.rows(0, 3).norm() / world.near, limit);
    outcome.measure("scale off", error[6].abs(), limit);
    outcome
}
