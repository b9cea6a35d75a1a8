//! `keysplat export`: a map in all formats, whole and in part.

use std::io::{Cursor, Write};
use std::path::Path;

use glam::Vec3;
use keysplat::export::MapFormat;
use keysplat::splat::{GaussianCloud, ShDegree};
use serde_json::{Value, json};

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

/// A piece of a streamed map, as the SOG reader takes it: its files in a zip.
fn piece(meta: &Path) -> GaussianCloud {
    let mut zip = zip::ZipWriter::new(Cursor::new(Vec::new()));
    for entry in std::fs::read_dir(meta.parent().unwrap()).unwrap() {
        let path = entry.unwrap().path();
        zip.start_file(path.file_name().unwrap().to_str().unwrap(), zip::write::SimpleFileOptions::default()).unwrap();
        zip.write_all(&std::fs::read(&path).unwrap()).unwrap();
    }
    MapFormat::by_name("sog").unwrap().decode(&zip.finish().unwrap().into_inner()).unwrap()
}

/// The leaves of a streamed map's tree.
fn leaves(node: &Value) -> Vec<&Value> {
    match node["children"].as_array() {
        Some(children) => children.iter().flat_map(leaves).collect(),
        None => vec![node],
    }
}

#[test]
fn levels_of_detail_hold_what_they_name() {
    let map = crate::common::scene(&mut fastrand::Rng::with_seed(4), 9000, ShDegree::new(1).unwrap());
    let ply = scratch().join("lod.ply");
    MapFormat::default().write(&map, &ply).unwrap();
    let out = scratch().join("levels");
    let said = export(&ply, &out, &["--lod"]).succeeded();
    assert!(said.stdout.contains("9000, 2250 Gaussians by level") && said.stdout.contains("lodBaseDistance"), "{}", said.stdout);
    let meta: Value = serde_json::from_slice(&std::fs::read(out.join("lod-meta.json")).unwrap()).unwrap();
    assert_eq!((&meta["version"], &meta["lodLevels"], &meta["count"]), (&json!(1), &json!(2), &json!(11250)));
    assert_eq!(meta["counts"], json!([9000, 2250]));
    let names = meta["filenames"].as_array().unwrap().iter().map(|name| name.as_str().unwrap());
    let pieces: Vec<GaussianCloud> = names.map(|name| piece(&out.join(name))).collect();
    let mut read = vec![0; pieces.len()];
    for leaf in leaves(&meta["tree"]) {
        let corner = |name: &str| Vec3::from([0, 1, 2].map(|k| leaf["bound"][name][k].as_f64().unwrap() as f32));
        for level in ["0", "1"] {
            let number = |name: &str| leaf["lods"][level][name].as_u64().unwrap() as usize;
            let (file, offset, count) = (number("file"), number("offset"), number("count"));
            assert_eq!(offset, read[file], "cells follow each other");
            assert!(count > 0 && count <= 4096);
            read[file] += count;
            let inside = |mean: &Vec3| mean.cmpge(corner("min")).all() && mean.cmple(corner("max")).all();
            assert!(pieces[file].means[offset..offset + count].iter().all(inside));
        }
    }
    assert_eq!(read, pieces.iter().map(GaussianCloud::len).collect::<Vec<_>>());
    // Level 0 is the map.
    let tolerance = MapFormat::by_name("sog").unwrap().tolerance();
    for mean in &pieces[0].means {
        let nearest = map.means.iter().map(|other| mean.distance(*other)).min_by(f32::total_cmp).unwrap();
        assert!(nearest < tolerance / 50.0, "{nearest}");
    }
    assert_eq!((pieces[0].sh_degree, pieces[0].len()), (map.sh_degree, map.len()));
    export(&ply, &out, &["--lod"]).refused(&["levels", "choose a new folder, or empty it"]);
    export(&ply, &scratch().join("levels.sog"), &["--lod"]).refused(&["levels.sog names a file", "leave out the ending"]);
    let few = scratch().join("few/lod-meta.json");
    export(&ply, &few, &["--max-gaussians", "50", "--sh-degree", "0"]).succeeded();
    let meta: Value = serde_json::from_slice(&std::fs::read(&few).unwrap()).unwrap();
    assert_eq!(meta["counts"], json!([50]));
}
