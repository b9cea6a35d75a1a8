//! Gaussians moved by a similarity look from the moved camera as they did from the camera before.

use fastrand::Rng;
use keysplat::geometry::{Se3, Sim3, sim3};
use keysplat::render::{GpuCloud, Motions, Rasterizer};
use keysplat::splat::{GaussianCloud, ShDegree, ViewCamera};
use keysplat::verification::reference::{cloud64, spherical_harmonics};
use nalgebra::{SVector, Vector3};

/// Side by side and apart, by two motions.
const MOVED: [(std::ops::Range<usize>, usize); 4] = [(40..120, 0), (120..121, 1), (130..200, 0), (263..291, 1)];

fn new_from_old() -> Sim3 {
    sim3::exp(&SVector::from([0.7, -0.4, 1.1, 0.9, -1.3, 0.6, 0.35]))
}

fn other_motion() -> Sim3 {
    sim3::exp(&SVector::from([-0.1, 0.05, 0.02, -0.4, 0.1, 0.2, 0.0]))
}

fn colour(sh: &[Vector3<f64>], d: &Vector3<f64>) -> Vector3<f64> {
    (0..).zip(sh).map(|(k, c)| c * spherical_harmonics::basis(k, d)).sum()
}

#[test]
fn parameters_and_averages_move_and_moments_stay() {
    let Some(gpu) = crate::common::requirements::adapter() else { return };
    for degree in ShDegree::ALL {
        let rng = &mut Rng::with_seed(4);
        let cloud = crate::common::scene(rng, 300, degree);
        let mut map = GpuCloud::new(&gpu, degree, 300).unwrap();
        map.append(&gpu, &cloud).unwrap();
        let elements = map.planes() * map.capacity();
        [map.moments_1(), map.moments_2()].iter().for_each(|moments| moments.write(&gpu, 0, &vec![[1.0f32; 4]; elements]));
        let motions = Motions { of: vec![new_from_old(), other_motion()], runs: MOVED.into() };
        map.transform(&gpu, &motions).unwrap();
        let moved = map.download(&gpu).unwrap();
        let values = |buffer: &keysplat::gpu::GpuBuffer| buffer.read::<[f32; 4]>(&gpu, 0, elements).unwrap();
        assert_eq!(values(map.parameters()), values(map.averages()));
        for moments in [values(map.moments_1()), values(map.moments_2())] {
            assert!(moments.iter().all(|v| *v == [1.0; 4]));
        }
        for (i, (before, after)) in cloud64(&cloud).iter().zip(cloud64(&moved)).enumerate() {
            let Some((_, motion)) = motions.runs.iter().find(|(run, _)| run.contains(&i)) else {
                assert_eq!(*before, after);
                continue;
            };
            let similarity = &motions.of[*motion];
            assert!((similarity.act(&before.mean.into()).coords - after.mean).norm() < 1e-5);
            assert!((before.log_scale.add_scalar(similarity.scale.ln()) - after.log_scale).norm() < 1e-5);
            let d = Vector3::new(rng.f64() - 0.5, rng.f64() - 0.5, rng.f64() - 0.5).normalize();
            let difference = colour(&after.sh, &(similarity.rotation * d)) - colour(&before.sh, &d);
            assert!(difference.norm() < 1e-5, "degree {}: {difference}", degree.get());
        }
    }
}

#[test]
fn the_moved_map_looks_the_same_from_the_moved_camera() {
    let Some(gpu) = crate::common::requirements::adapter() else { return };
    let rng = &mut Rng::with_seed(5);
    let degree = ShDegree::new(3).unwrap();
    let cloud: GaussianCloud = crate::common::scene(rng, 300, degree);
    let mut map = GpuCloud::new(&gpu, degree, 300).unwrap();
    map.append(&gpu, &cloud).unwrap();
    let view = crate::common::camera(rng, 64, 48);
    let mut rasterizer = Rasterizer::new(gpu.clone()).unwrap();
    let before = rasterizer.render(&map, &view, [0.0; 3]).unwrap();
    let new_from_old = new_from_old();
    map.transform(&gpu, &Motions { of: vec![new_from_old], runs: vec![(0..cloud.len(), 0)] }).unwrap();
    // A camera keeps its unit: world_from_camera of the moved one is rigid.
    let camera_from_new = (Sim3::from(view.camera_from_world) * new_from_old.inverse()).to_rigid();
    let moved = ViewCamera { camera_from_world: camera_from_new, ..view };
    let after = rasterizer.render(&map, &moved, [0.0; 3]).unwrap();
    for (a, b) in before.color_depth.iter().zip(&after.color_depth) {
        let depth = (a[3] * new_from_old.scale as f32 - b[3]).abs();
        assert!((0..3).all(|k| (a[k] - b[k]).abs() < 2e-3) && depth < 5e-3, "{a:?} and {b:?}");
    }
    let unmoved: Se3 = view.camera_from_world;
    assert!((unmoved.inverse() * moved.camera_from_world).translation.vector.norm() > 0.1);
}

/// A correction of millimetres a kilometre from the origin: what f32 can tell apart of it is there.
#[test]
fn small_motions_far_away_are_not_lost() {
    let Some(gpu) = crate::common::requirements::adapter() else { return };
    let rng = &mut Rng::with_seed(6);
    let mut cloud = crate::common::scene(rng, 50, ShDegree::new(0).unwrap());
    cloud.means.iter_mut().for_each(|mean| mean.x += 1000.0);
    let mut map = GpuCloud::new(&gpu, cloud.sh_degree, 50).unwrap();
    map.append(&gpu, &cloud).unwrap();
    let about = Se3::translation(1000.0, 0.0, 0.0);
    let motion = about * Se3::new(Vector3::new(0.0, 0.004, 0.002), Vector3::new(1e-4, 0.0, 0.0)) * about.inverse();
    map.transform(&gpu, &Motions { of: vec![motion.into()], runs: vec![(0..50, 0)] }).unwrap();
    for (before, after) in cloud64(&cloud).iter().zip(cloud64(&map.download(&gpu).unwrap())) {
        let error = (motion * nalgebra::Point3::from(before.mean)).coords - after.mean;
        assert!(error.norm() < 1e-5, "{error}");
    }
}
