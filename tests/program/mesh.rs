//! `keysplat mesh`, `keysplat eval-mesh` and `keysplat generate --surface`: from a run to the errors of its surface.

use std::path::{Path, PathBuf};

use keysplat::export::MapFormat;
use keysplat::mesh::Mesh;
use keysplat::splat::GaussianCloud;

use crate::common::recording::{finish, keysplat, recording, run_command, scratch, skipped_without_adapter};

/// The run's mesh in a file of the scratch folder, with more options.
fn mesh(run: &Path, name: &str, more: &[&str]) -> (crate::common::recording::Finished, PathBuf) {
    let file = scratch().join(name);
    let mut command = keysplat(["mesh".as_ref(), run.as_os_str(), file.as_os_str()]);
    command.args(["--voxel", "0.03"]).args(more);
    (finish(command), file)
}

#[test]
fn a_run_becomes_a_mesh_near_the_true_surface() {
    if skipped_without_adapter() {
        return;
    }
    let (out, truth) = (scratch().join("run"), scratch().join("truth.ply"));
    finish(run_command(recording(), &out, &[])).succeeded();
    let scene = recording().join("scene.toml");
    finish(keysplat(["generate".as_ref(), scene.as_os_str(), "--surface".as_ref(), truth.as_os_str()])).succeeded();
    let errors = |file: &Path| {
        let mut command = keysplat(["eval-mesh".as_ref(), file.as_os_str(), "--truth".as_ref(), truth.as_os_str()]);
        command.arg("--run").arg(&out).args(["--log", "json"]);
        serde_json::from_str::<serde_json::Value>(&finish(command).succeeded().stdout).unwrap()
    };
    let (said, file) = mesh(&out, "measured.ply", &["--depth", "measured", "--all-frames"]);
    let said = said.succeeded().stdout;
    assert!(said.contains("24 views, 24 with measured depth"), "{said}");
    let report = errors(&file);
    let f1 = |report: &serde_json::Value, k: usize| report["shares"][k]["f1"].as_f64().unwrap();
    assert!(f1(&report, 2) > 0.85 && f1(&report, 1) > 0.7, "{report}");
    assert!(
        report["depth"]["depth_l1_m"].as_f64().unwrap() < 0.02 && report["depth"]["seen_share"].as_f64().unwrap() > 0.8,
        "{report}"
    );
    let (said, rendered) = mesh(&out, "rendered.ply", &["--depth", "rendered", "--all-frames"]);
    assert!(said.succeeded().stdout.contains("24 views, 0 with measured depth"));
    let report = errors(&rendered);
    assert!(f1(&report, 2) > 0.4, "from a map of few steps: {report}");

    let (_, again) = mesh(&out, "again.ply", &["--depth", "measured", "--all-frames"]);
    let bytes = |file: &Path| std::fs::read(file).unwrap();
    assert!(bytes(&file) == bytes(&again), "the same mesh to the bit");
    let (whole, simple) =
        (Mesh::read(&file).unwrap(), mesh(&out, "simple.ply", &["--depth", "measured", "--all-frames", "--simplify", "0.3"]).1);
    let simple = Mesh::read(&simple).unwrap();
    assert!(simple.triangles.len() * 2 < whole.triangles.len() && simple.area() > 0.9 * whole.area());
    for name in ["m.glb", "m.obj"] {
        mesh(&out, name, &[]).0.succeeded();
        assert!(bytes(&scratch().join(name)).len() > 10_000);
    }
    // Opacities that shrink with the dilation leave another surface, and the file says that they do.
    let map = MapFormat::default().read(&out.join("map.ply")).unwrap();
    let antialiased = GaussianCloud { antialiased: true, ..map.clone() };
    MapFormat::default().write(&antialiased, &out.join("map.ply")).unwrap();
    let (_, other) = mesh(&out, "antialiased.ply", &["--depth", "rendered", "--all-frames"]);
    assert!(bytes(&other) != bytes(&rendered));
    MapFormat::default().write(&map, &out.join("map.ply")).unwrap();
    refusals(&out);
}

/// Its Gaussians are flat, it repeats to the bit, and the planes of its Gaussians are nearer to the truth than their centres.
#[test]
fn a_planar_map_is_flat_and_its_planes_are_fused() {
    if skipped_without_adapter() {
        return;
    }
    let planar = ["--set", "mapping.surface=planar"];
    let runs = ["planar", "planar-again"].map(|name| scratch().join(name));
    runs.iter().for_each(|out| drop(finish(run_command(recording(), out, &planar)).succeeded()));
    let [map, again] = runs.each_ref().map(|out| MapFormat::default().read(&out.join("map.ply")).unwrap());
    assert_eq!(map, again);
    let is_flat = |i: &usize| {
        let mut axes = map.log_scales[*i].to_array();
        axes.sort_by(f32::total_cmp);
        axes[0] - axes[1] < 0.35f32.ln()
    };
    let flat = (0..map.len()).filter(is_flat).count();
    assert!(map.first_non_finite().is_none() && flat * 10 > map.len() * 9, "{flat} of {}", map.len());
    let files = ["", "centre", "plane", "median"].map(|depth| {
        let more = if depth.is_empty() { vec![] } else { vec!["--map-depth", depth] };
        let name = format!("planar-{depth}.ply");
        let (said, file) = mesh(&runs[0], &name, &[&["--depth", "rendered", "--all-frames"], &more[..]].concat());
        said.succeeded();
        std::fs::read(file).unwrap()
    });
    assert!(files[0] == files[2] && files[0] != files[1] && files[2] != files[3], "planes are the default");
    let refused = finish(run_command(recording(), &scratch().join("x"), &["--set", "mapping.planar.thickness=0"]));
    refused.refused(&["mapping.planar", "thickness must lie between 0 and 1"]);
}

/// What is wrong ends in an error that says what to do, and in no file.
fn refusals(out: &Path) {
    let refused = |name: &str, more: &[&str], parts: &[&str]| {
        let (said, file) = mesh(out, name, more);
        said.refused(parts);
        assert!(!file.exists(), "{}", file.display());
    };
    refused("x.stl", &[], &["x.stl", ".ply, .glb or .obj"]);
    refused("x.ply", &["--tolerance", "0"], &["--tolerance is 0", "0.0001 to 1"]);
    refused("x.ply", &["--scale", "0"], &["--scale is 0", "0.05 to 1"]);
    refused("x.ply", &["--max-memory", "2M"], &["--max-memory", "--voxel", "fits"]);
    refused("x.ply", &["--max-memory", "1M", "--all-frames"], &["--every"]);
    refused("x.ply", &["--adapter", "nobody's"], &["nobody's"]);
    refused("nowhere/x.ply", &[], &["nowhere/x.ply", "create the folder first"]);
    #[cfg(target_os = "linux")]
    if let Some(disk) = super::bad_input::SmallDisk::mount("64k") {
        let file = disk.0.path().join("x.ply");
        finish(keysplat(["mesh".as_ref(), out.as_os_str(), file.as_os_str()])).refused(&["x.ply", "free some space"]);
        assert_eq!(std::fs::read_dir(disk.0.path()).unwrap().count(), 0);
    }
    let config = std::fs::read_to_string(out.join("config.toml")).unwrap();
    std::fs::write(out.join("config.toml"), config.replace(recording().to_str().unwrap(), "/nowhere/else")).unwrap();
    refused("x.ply", &["--depth", "measured"], &["no measured depth", "--sequence"]);
    mesh(out, "without-recording.ply", &["--min-component", "0"]).0.succeeded();
    std::fs::remove_file(out.join("keyframes.txt")).unwrap();
    refused("x.ply", &[], &["keyframes.txt", "--all-frames"]);
    std::fs::remove_file(out.join("map.ply")).unwrap();
    refused("x.ply", &[], &["map.ply", "give the folder of a run"]);
    let no_mesh =
        finish(keysplat(["eval-mesh".as_ref(), out.join("config.toml").as_os_str(), "--truth".as_ref(), out.as_os_str()]));
    no_mesh.refused(&["config.toml", "PLY"]);
}
