use std::collections::HashMap;

use nalgebra::{Point3, Rotation3, UnitQuaternion, Vector2, Vector3};

use super::volume::{SIDE, VOXELS, Voxel};
use super::*;
use crate::geometry::{Pinhole, Se3, Sim3};

const PINHOLE: Pinhole = Pinhole { fx: 150.0, fy: 150.0, cx: 79.5, cy: 59.5, width: 160, height: 120 };

/// A camera at a point that looks at another one.
fn looking(from: [f64; 3], at: [f64; 3]) -> Se3 {
    let (from, at) = (Vector3::from(from), Vector3::from(at));
    let forward = (at - from).normalize();
    let down = if forward.y.abs() > 0.9 { Vector3::z() } else { Vector3::y() };
    let right = down.cross(&forward).normalize();
    let rotation = Rotation3::from_basis_unchecked(&[right, forward.cross(&right), forward]);
    Se3::from_parts(from.into(), UnitQuaternion::from_rotation_matrix(&rotation))
}

/// The view of a surface that `depth_along` gives: the distance from a point along a direction, in its multiples.
fn view(pose: Se3, depth_along: &dyn Fn(Vector3<f64>, Vector3<f64>) -> Option<f64>) -> DepthView {
    let pixels =
        (0..PINHOLE.width * PINHOLE.height).map(|i| Vector2::new(f64::from(i % PINHOLE.width), f64::from(i / PINHOLE.width)));
    let depth: Vec<f32> = pixels
        .map(|pixel| depth_along(pose.translation.vector, pose.rotation * PINHOLE.unproject(&pixel, 1.0)).unwrap_or(0.0) as f32)
        .collect();
    let color = vec![[200, 100, 50]; depth.len()];
    DepthView::new(PINHOLE, pose, &depth, color)
}

/// Where a ray meets a ball from outside.
fn ball(centre: Vector3<f64>, radius: f64) -> impl Fn(Vector3<f64>, Vector3<f64>) -> Option<f64> {
    move |origin, direction| {
        let (a, b) = (direction.norm_squared(), direction.dot(&(origin - centre)));
        let square = b * b - a * ((origin - centre).norm_squared() - radius * radius);
        (square >= 0.0).then(|| (-b - square.sqrt()) / a)
    }
}

const RADIUS: f64 = 0.3;

/// A ball seen from all sides.
fn ball_views() -> Vec<DepthView> {
    let axes = [-1.0, 0.0, 1.0];
    let directions = axes.iter().flat_map(|x| axes.iter().flat_map(move |y| axes.map(|z| Vector3::new(*x, *y, z))));
    let eyes = directions.filter(|d| d.norm() > 0.0).map(|d| d.normalize() * 1.2);
    eyes.map(|eye| view(looking(eye.into(), [0.0; 3]), &ball(Vector3::zeros(), RADIUS))).collect()
}

fn quiet(_stage: &'static str) {}

fn signed_volume(mesh: &Mesh) -> f64 {
    let of = |t: &[u32; 3]| {
        let [a, b, c] = t.map(|i| mesh.vertices[i as usize].as_dvec3());
        a.dot(b.cross(c)) / 6.0
    };
    mesh.triangles.iter().map(of).sum()
}

/// How often each directed edge occurs.
fn directed_edges(mesh: &Mesh) -> HashMap<(u32, u32), usize> {
    let mut edges = HashMap::new();
    for [a, b, c] in &mesh.triangles {
        [(*a, *b), (*b, *c), (*c, *a)].into_iter().for_each(|edge| *edges.entry(edge).or_default() += 1);
    }
    edges
}

#[track_caller]
fn assert_closed(mesh: &Mesh) {
    let edges = directed_edges(mesh);
    for ((a, b), count) in &edges {
        assert_eq!(edges.get(&(*b, *a)), Some(count), "the edge {a}-{b} has one side");
    }
}

#[test]
fn a_ball_seen_from_all_sides_is_closed_round_and_of_its_size() {
    let mesh = fuse(ball_views(), &MeshConfig { voxel_metres: 0.02, ..MeshConfig::default() }, &quiet).unwrap();
    assert_closed(&mesh);
    let edges = directed_edges(&mesh).len() / 2;
    assert_eq!(mesh.vertices.len() + mesh.triangles.len() - edges, 2, "it has no handle");
    let off: Vec<f64> = mesh.vertices.iter().map(|p| (f64::from(p.length()) - RADIUS).abs()).collect();
    let (mean, most) = (off.iter().sum::<f64>() / off.len() as f64, off.iter().copied().fold(0.0, f64::max));
    assert!(mean < 0.001 && most < 0.008, "a twentieth of a voxel, not {mean}; less than half of one, not {most}");
    let ball = 4.0 / 3.0 * std::f64::consts::PI * RADIUS.powi(3);
    let volume = signed_volume(&mesh);
    assert!((volume / ball - 1.0).abs() < 0.02, "{volume} of {ball}: triangles look outwards");
    assert!(mesh.colors.iter().all(|color| *color == [200, 100, 50]));
}

#[test]
fn planes_and_their_corner_are_exact() {
    // Three walls that meet in the origin, seen from inside.
    let walls = |origin: Vector3<f64>, direction: Vector3<f64>| {
        let t = [0, 1, 2].map(|axis| if direction[axis] < 0.0 { -origin[axis] / direction[axis] } else { f64::INFINITY });
        Some(t.into_iter().fold(f64::INFINITY, f64::min)).filter(|t| t.is_finite())
    };
    let eyes = [[1.0, 0.8, 0.9], [0.7, 1.1, 0.8], [0.9, 0.7, 1.2], [1.1, 1.0, 0.6]];
    let views = eyes.map(|eye| view(looking(eye, [0.1, 0.1, 0.1]), &walls)).into();
    let mesh = fuse(views, &MeshConfig { voxel_metres: 0.02, ..MeshConfig::default() }, &quiet).unwrap();
    let (mut flat, mut exact) = (0, 0);
    for p in &mesh.vertices {
        let mut away = p.to_array();
        away.sort_by(f32::total_cmp);
        if away[1] > 0.1 {
            // Beside what is left out, depth is that of the nearest pixel.
            assert!(away[0].abs() < 0.004, "{p} lies on no wall");
            flat += 1;
            exact += usize::from(away[0].abs() < 2e-4);
        } else {
            assert!(away[0].abs() < 0.02, "{p}: within a voxel where walls meet");
        }
    }
    assert!(flat > 1000 && exact as f64 > 0.97 * flat as f64, "{exact} of {flat}");
}

/// Every pattern of signs that neighbouring cells can have, in blocks that join along all axes.
#[test]
fn random_distances_give_a_closed_surface_without_cracks() {
    let keys: Vec<[i32; 3]> = (0..8).map(|k: i32| [k >> 2 & 1, k >> 1 & 1, k & 1]).collect();
    let mut volume = Volume::new(0.1, &keys);
    let mut rng = fastrand::Rng::with_seed(5);
    for block in &mut volume.blocks {
        for (i, voxel) in block.voxels.iter_mut().enumerate() {
            let local = [i % SIDE, i / SIDE % SIDE, i / SIDE / SIDE];
            let is_border = (0..3).any(|axis| [0, 2 * SIDE - 1].contains(&(block.key[axis] as usize * SIDE + local[axis])));
            let distance = if is_border { 0.05 } else { 0.1 * (rng.f32() - 0.5) };
            *voxel = Voxel { distance, weight: 1.0, color: [0; 3], views: 1 };
        }
    }
    let mesh = marching::extract(&volume, 1);
    assert!(mesh.triangles.len() > VOXELS);
    assert_closed(&mesh);
    assert!(signed_volume(&mesh) > 0.0);
    let cells = tables::CELLS.iter().map(Vec::len);
    assert_eq!((cells.clone().max(), cells.sum::<usize>()), (Some(5), 820), "triangles in the largest cell and in all");
}

#[test]
fn threads_do_not_change_a_bit() {
    let config = MeshConfig { voxel_metres: 0.025, ..MeshConfig::default() };
    let with = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| fuse(ball_views(), &config, &quiet).unwrap())
    };
    let (one, many) = (with(1), with(5));
    assert_eq!(ply::encode(&one), ply::encode(&many));
}

#[test]
fn small_components_go() {
    let (large, small) = (ball(Vector3::zeros(), RADIUS), ball(Vector3::new(0.5, 0.0, 0.0), 0.08));
    let both = |origin: Vector3<f64>, direction: Vector3<f64>| {
        let hits = [large(origin, direction), small(origin, direction)];
        hits.into_iter().flatten().min_by(f64::total_cmp)
    };
    let views: Vec<DepthView> = (0..8)
        .map(|k| std::f64::consts::TAU * f64::from(k) / 8.0)
        .map(|angle| view(looking([1.5 * angle.cos(), 0.4, 1.5 * angle.sin()], [0.2, 0.0, 0.0]), &both))
        .collect();
    let fused = |share| {
        let config = MeshConfig { voxel_metres: 0.02, min_component_share: share, ..MeshConfig::default() };
        let mesh = fuse(views.clone(), &config, &quiet).unwrap();
        let mut names = components::components(&mesh);
        names.sort_unstable();
        names.dedup();
        (names.len(), mesh.vertices.iter().any(|p| p.x > 0.4))
    };
    assert!(fused(0.0).0 >= 2, "both and their scraps");
    assert_eq!((fused(0.01), fused(1.0)), ((2, true), (1, false)));
}

#[test]
fn depth_that_the_others_see_through_is_left_out() {
    let wall = |_: Vector3<f64>, direction: Vector3<f64>| Some(2.0 / direction.z);
    let eyes = [-0.3, -0.1, 0.1, 0.3];
    let mut views: Vec<DepthView> = eyes.map(|x| view(looking([x, 0.0, 0.0], [x, 0.0, 1.0]), &wall)).into();
    let ghost = |origin: Vector3<f64>, direction: Vector3<f64>| {
        let hit = origin + direction / direction.z;
        Some(if hit.x.abs() < 0.15 && hit.y.abs() < 0.15 { 1.0 } else { 2.0 } / direction.z)
    };
    let false_view = view(looking([0.0, 0.0, 0.0], [0.0, 0.0, 1.0]), &ghost);
    let middle = (60 * PINHOLE.width + 80) as usize;
    assert!((false_view.inverse_depth[middle] - 1.0).abs() < 1e-3);
    views.push(false_view);
    let config = MeshConfig::default();
    consistency::check(&mut views, &config);
    assert_eq!(views[4].inverse_depth[middle], 0.0);
    assert!(views[..4].iter().all(|view| (view.inverse_depth[middle] - 0.5).abs() < 1e-3), "one against three");
    let near = fuse(views, &config, &quiet).unwrap().vertices.iter().filter(|p| p.z < 1.5).count();
    assert_eq!(near, 0);
}

#[test]
fn edges_and_flat_angles_are_left_out() {
    let steep =
        |origin: Vector3<f64>, direction: Vector3<f64>| Some((0.3 - origin.y) / direction.y).filter(|t| (0.0..60.0).contains(t));
    let flat_view = view(looking([0.0; 3], [0.0, 0.0, 1.0]), &steep);
    let row = |y: u32| flat_view.inverse_depth[(y * PINHOLE.width + 80) as usize];
    assert!(row(110) > 0.0 && row(64) == 0.0, "the floor near the horizon is seen too flat");
    let step = |_: Vector3<f64>, direction: Vector3<f64>| Some(if direction.x < 0.0 { 1.0 } else { 2.0 });
    let edge_view = view(looking([0.0; 3], [0.0, 0.0, 1.0]), &step);
    let at = |x: u32| edge_view.inverse_depth[(60 * PINHOLE.width + x) as usize];
    assert_eq!([70, 79, 80, 90].map(|x| at(x) > 0.0), [true, false, false, true]);
}

#[test]
fn the_error_names_a_voxel_that_fits() {
    let config = MeshConfig { voxel_metres: 0.002, max_memory_bytes: 24 << 20, ..MeshConfig::default() };
    let error = fuse(ball_views(), &config, &quiet).unwrap_err();
    let MeshError::TooLarge { fits, needed_mib, available_mib, .. } = error else { panic!("{error}") };
    assert!(needed_mib > available_mib && fits > 0.002);
    assert!(error.to_string().contains(&format!("--voxel {fits} fits")), "{error}");
    fuse(ball_views(), &MeshConfig { voxel_metres: fits, ..config.clone() }, &quiet).unwrap();
    let error = fuse(ball_views(), &MeshConfig { max_memory_bytes: 1 << 20, ..config }, &quiet).unwrap_err();
    assert!(error.to_string().contains("--every"), "{error}");
}

#[test]
fn nothing_to_fuse_is_an_error() {
    let nothing = |_: Vector3<f64>, _: Vector3<f64>| None;
    for views in [vec![], vec![view(Se3::identity(), &nothing)]] {
        assert!(matches!(fuse(views, &MeshConfig::default(), &quiet), Err(MeshError::Empty)));
    }
    let odd = DepthView::new(PINHOLE, Se3::identity(), &vec![f32::NAN; 160 * 120], vec![[0; 3]; 160 * 120]);
    assert!(odd.inverse_depth.iter().all(|inverse| *inverse == 0.0));
    for wrong in [0.0, f64::NAN, 11.0] {
        let error = fuse(vec![], &MeshConfig { voxel_metres: wrong, ..MeshConfig::default() }, &quiet).unwrap_err();
        assert!(error.to_string().starts_with("--voxel is"), "{error}");
    }
}

/// A square of two triangles at a depth.
fn square(z: f32, half: f32) -> Mesh {
    let corner = |x: f32, y: f32| Vec3::new(half * x, half * y, z);
    Mesh {
        vertices: vec![corner(-1.0, -1.0), corner(1.0, -1.0), corner(1.0, 1.0), corner(-1.0, 1.0)],
        colors: vec![[0; 3]; 4],
        triangles: vec![[0, 1, 2], [0, 2, 3]],
    }
}

/// A square of many triangles.
fn fine_square(z: f32, cells: u32) -> Mesh {
    let mut mesh = Mesh::default();
    for (x, y) in (0..=cells).flat_map(|y| (0..=cells).map(move |x| (x, y))) {
        let at = |k: u32| 2.0 * k as f32 / cells as f32 - 1.0;
        mesh.vertices.push(Vec3::new(at(x), at(y), z));
        mesh.colors.push([x as u8, y as u8, 0]);
    }
    for (x, y) in (0..cells).flat_map(|y| (0..cells).map(move |x| (x, y))) {
        let a = x + y * (cells + 1);
        mesh.triangles.extend([[a, a + 1, a + cells + 2], [a, a + cells + 2, a + cells + 1]]);
    }
    mesh
}

#[test]
fn errors_are_those_of_surfaces_whose_distance_is_known() {
    let truth = square(2.0, 1.0);
    let errors = compare(&fine_square(2.015, 20), &truth).unwrap();
    let f1: Vec<f64> = errors.shares.iter().map(|share| share.f1).collect();
    assert_eq!(f1, [0.0, 1.0, 1.0]);
    assert!((0.015..0.017).contains(&errors.accuracy_m) && errors.completion_ratio == 1.0, "{errors:?}");
    // Half of the truth is missing; the small component does not count in the shares.
    let mut half = fine_square(2.0, 40);
    half.triangles.retain(|t| t.iter().all(|i| half.vertices[*i as usize].x <= 1e-6));
    let dust = square(2.5, 0.01);
    let first = half.vertices.len() as u32;
    half.vertices.extend(&dust.vertices);
    half.colors.extend(&dust.colors);
    half.triangles.extend(dust.triangles.iter().map(|t| t.map(|i| i + first)));
    let share = compare(&half, &truth).unwrap().shares[0];
    assert!(share.precision == 1.0 && (share.recall - 0.505).abs() < 0.005, "{share:?}");
    assert!(compare(&Mesh::default(), &truth).is_none() && compare(&truth, &Mesh::default()).is_none());
}

#[test]
fn icp_finds_a_small_motion_of_a_ball_in_a_corner() {
    let mut truth = fine_square(0.0, 30);
    let side = fine_square(0.0, 30);
    for turn in [|p: Vec3| Vec3::new(p.x, -1.0, p.y), |p: Vec3| Vec3::new(-1.0, p.x, p.y)] {
        let first = truth.vertices.len() as u32;
        truth.vertices.extend(side.vertices.iter().map(|p| turn(*p)));
        truth.colors.extend(&side.colors);
        truth.triangles.extend(side.triangles.iter().map(|t| t.map(|i| i + first)));
    }
    let moved = Sim3 {
        rotation: UnitQuaternion::from_euler_angles(0.004, -0.006, 0.005),
        translation: Vector3::new(0.01, -0.008, 0.006),
        scale: 1.0,
    };
    let back = refine_alignment(&truth.clone().moved(&moved), &truth) * moved;
    let off = [0.0, 1.0, -1.0].map(|v| (back.act(&Point3::new(v, -v, v)).coords - Vector3::new(v, -v, v)).norm());
    assert!(off.iter().all(|off| *off < 1.5e-3), "{off:?}");
}

#[test]
fn depth_is_compared_where_both_are_seen() {
    let cameras = [Se3::identity(), Se3::from_parts(Vector3::new(0.1, 0.0, 0.0).into(), UnitQuaternion::identity())];
    let truth = fine_square(2.0, 10);
    let errors = compare_depth(&square(2.03, 0.4), &truth, &PINHOLE, &cameras).unwrap();
    assert!((errors.depth_l1_m - 0.03).abs() < 1e-5 && errors.views == 2, "{errors:?}");
    let seen = (0.8f64 / 2.03 * 150.0).powi(2) / (160.0 * 120.0);
    assert!((errors.seen_share - seen).abs() < 0.02, "{errors:?}, not {seen}");
    assert!(compare_depth(&square(-1.0, 1.0), &truth, &PINHOLE, &cameras).is_none());
}

#[test]
fn simplification_leaves_a_flat_surface_flat_and_of_its_size() {
    let mesh = fine_square(1.0, 40);
    let simple = simplify(&mesh, 0.25);
    assert!(simple.triangles.len() <= mesh.triangles.len() / 4 + 1 && !simple.triangles.is_empty());
    assert!((simple.area() - mesh.area()).abs() < 1e-3 && simple.vertices.iter().all(|p| p.z == 1.0));
    assert_eq!(simple.vertices.len(), simple.colors.len());
    assert_eq!(simplify(&mesh, 1.0).area(), mesh.area());
}

#[test]
fn files_hold_the_mesh() {
    let mesh = fine_square(1.5, 3);
    let folder = tempfile::tempdir().unwrap();
    let read = |name: &str| {
        let path = folder.path().join(name);
        let length = MeshFormat::of_path(&path).unwrap().write(&mesh, &path).unwrap();
        let bytes = std::fs::read(&path).unwrap();
        assert_eq!(bytes.len(), length);
        bytes
    };
    read("a.ply");
    assert_eq!(Mesh::read(&folder.path().join("a.ply")).unwrap(), mesh);
    let obj = String::from_utf8(read("a.OBJ")).unwrap();
    assert_eq!(obj.lines().filter(|line| line.starts_with("v ")).count(), 16);
    assert!(obj.starts_with("v -1 -1 1.5 0.0000 0.0000 0.0000\n") && obj.ends_with("f 11 16 15\n"), "{obj}");
    let glb = read("a.glb");
    let word = |at: usize| u32::from_le_bytes(glb[at..at + 4].try_into().unwrap()) as usize;
    assert_eq!((&glb[..4], word(8), word(12) % 4), (b"glTF".as_slice(), glb.len(), 0));
    let document: serde_json::Value = serde_json::from_slice(&glb[20..20 + word(12)]).unwrap();
    assert_eq!(document["accessors"][0]["min"], serde_json::json!([-1.0, -1.0, -1.5]), "y up, z backward");
    assert_eq!(document["accessors"][2]["count"], 54);
    assert_eq!(word(20 + word(12)), 16 * 12 + 16 * 8 + 54 * 4);
    for (name, what) in [("a.stl", ".ply, .glb or .obj"), ("nowhere/a.ply", "create the folder")] {
        let path = folder.path().join(name);
        let error = MeshFormat::of_path(&path).and_then(|format| format.write(&mesh, &path)).unwrap_err().to_string();
        assert!(error.contains(what), "{error}");
    }
}

#[test]
fn foreign_files_are_read() {
    let mut file = b"ply\ncomment x\nformat binary_little_endian 1.0\nelement vertex 4\nproperty double x\nproperty double y\nproperty double z\n\
        property float quality\nelement face 1\nproperty uchar flags\nproperty list int int vertex_index\nelement edge 0\nend_header\n"
        .to_vec();
    for p in [[0.0f64, 0.0, 1.0], [1.0, 0.0, 1.0], [1.0, 1.0, 1.0], [0.0, 1.0, 1.0]] {
        p.iter().for_each(|v| file.extend(v.to_le_bytes()));
        file.extend(0.5f32.to_le_bytes());
    }
    file.push(7);
    [4i32, 0, 1, 2, 3].iter().for_each(|v| file.extend(v.to_le_bytes()));
    let mesh = Mesh::decode(&file, "x.ply".as_ref()).unwrap();
    assert_eq!((mesh.triangles, mesh.vertices.len()), (vec![[0, 1, 2], [0, 2, 3]], 4));
}

#[test]
fn damaged_files_say_what_is_wrong() {
    let whole = ply::encode(&fine_square(1.0, 2));
    let decode = |bytes: &[u8]| Mesh::decode(bytes, "x.ply".as_ref());
    assert!(decode(&whole).is_ok());
    for length in 0..whole.len() {
        assert!(decode(&whole[..length]).is_err(), "{length} bytes");
    }
    let mut rng = fastrand::Rng::with_seed(1);
    for _ in 0..3000 {
        let mut bytes = whole.clone();
        for _ in 0..rng.usize(1..5) {
            let at = rng.usize(..bytes.len());
            bytes[at] = rng.u8(..);
        }
        if let Ok(mesh) = decode(&bytes) {
            assert!(mesh.triangles.iter().flatten().all(|i| (*i as usize) < mesh.vertices.len()));
        }
    }
    let end = whole.windows(11).position(|window| window == b"end_header\n").unwrap() + 11;
    let text = String::from_utf8(whole[..end].to_vec()).unwrap();
    let with =
        |from: &str, to: &str| decode(&[text.replacen(from, to, 1).as_bytes(), &whole[end..]].concat()).unwrap_err().to_string();
    assert!(with("binary_little_endian", "ascii").contains("`format ascii 1.0` is not supported"));
    assert!(with("element vertex 9", "element vertex 999999999999").contains("cut off"));
    assert!(with("property float x", "property float q").contains("lack x, y or z"));
    assert!(with("vertex_indices", "else").contains("vertex_indices"));
    assert!(with("element face 8", "element face x").contains("x.ply is no mesh"));
    let edges = text.replacen("end_header", "element edge 0\nproperty int vertex1\nend_header", 1);
    assert!(decode(&[edges.as_bytes(), &whole[end..]].concat()).is_ok());
    let changed = |at: usize, to: &[u8]| decode(&[&whole[..at], to, &whole[at + to.len()..]].concat()).unwrap_err().to_string();
    assert!(changed(end, &1e20f32.to_le_bytes()).contains("vertex 0 is not finite, or farther"));
    assert!(changed(whole.len() - 1, &[255]).contains("face 7 names a vertex"));
}
