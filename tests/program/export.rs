//! `keysplat export`: a map in all formats, whole and in part.

use std::path::Path;

use glam::Vec3;
use keysplat::export::MapFormat;
use keysplat::splat::{GaussianCloud, ShDegree};

use crate::common::recording::{Finished, finish, keysplat, scratch};

fn export(from: &Path, to: &Path, more: &[&str]) -> Finished {
    let mut command = keysplat(["export".as_ref(), from.as_os_str(), to.as_os_str()]);
    command.args(more);
    finish(command)
}

#[test]
fn a_map_goes_through_every_format_and_back() {
    let folder = scratch().join("run");
    std::fs::create_dir_all(&folder).unwrap();
    let map = crate::common::scene(&mut fastrand::Rng::with_seed(4), 300, ShDegree::new(2).unwrap());
    let ply = folder.join("map.ply");
    MapFormat::default().write(&map, &ply).unwrap();
    for format in MapFormat::all().iter().filter(|format| format.is_written()) {
        let file = scratch().join("copy").with_extension(format.extension());
        let said = export(&folder, &file, &["--format", format.name()]).succeeded();
        assert!(said.stdout.contains("300 Gaussians"), "{}", said.stdout);
        let back = scratch().join("back.ply");
        export(&file, &back, &[]).succeeded();
        let back = MapFormat::default().read(&back).unwrap();
        assert_eq!((back.len(), back.sh_degree), (300, map.sh_degree), "{format:?}");
        // Some formats sort their Gaussians.
        let sorted = |means: &[Vec3]| {
            let mut means = means.to_vec();
            means.sort_by(|a, b| a.x.total_cmp(&b.x));
            means
        };
        let most = (format.tolerance() / 50.0).max(1e-6);
        let (back, means) = (sorted(&back.means), sorted(&map.means));
        assert!(back.iter().all(|a| means.iter().any(|b| a.distance(*b) < most)), "{format:?}");
        assert!(back.iter().zip(&means).all(|(a, b)| (a.x - b.x).abs() < most), "{format:?}");
    }
    let antialiased = GaussianCloud { antialiased: true, ..map.clone() };
    MapFormat::default().write(&antialiased, &ply).unwrap();
    for ending in ["ply", "spz"] {
        let file = scratch().join("antialiased").with_extension(ending);
        export(&folder, &file, &[]).succeeded();
        assert!(MapFormat::of_path(&file).unwrap().read(&file).unwrap().antialiased, "{ending}");
    }
    let part = scratch().join("part");
    export(&ply, &part, &["--format", "spz", "--max-gaussians", "40", "--sh-degree", "0", "--min-opacity", "0.1"]).succeeded();
    let part = MapFormat::by_name("spz").unwrap().read(&part).unwrap();
    assert_eq!((part.len(), part.sh_degree), (40, ShDegree::default()));
}

#[test]
fn what_cannot_be_exported_is_refused() {
    let map = scratch().join("small.ply");
    MapFormat::default().write(&crate::common::scene(&mut fastrand::Rng::with_seed(4), 9, ShDegree::default()), &map).unwrap();
    let out = scratch().join("x.spz");
    export(&map, &scratch().join("x.xyz"), &[]).refused(&["x.xyz", ".ply, .spz, .sog or .glb"]);
    export(&map, &scratch().join("x.splat"), &[]).refused(&["read from splat and not written", "ply, spz, sog"]);
    export(&scratch().join("nothing"), &out, &[]).refused(&["nothing is no map"]);
    export(&map, &out, &["--crop", "50,50,50:60,60,60"]).refused(&["of 9 Gaussians, none passes"]);
    export(&map, &scratch().join("nowhere/x.glb"), &[]).refused(&["nowhere/x.glb"]);
    export(&map, &map, &[]).refused(&["small.ply is the map that is exported"]);
    std::fs::write(&out, b"\x1f\x8b and no more").unwrap();
    export(&out, &scratch().join("y.ply"), &[]).refused(&["x.spz", "this is no SPZ file"]);
    assert!(!scratch().join("y.ply").exists());
}
