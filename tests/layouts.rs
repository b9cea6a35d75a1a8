//! Real recordings in their layouts; skipped where `KEYSPLAT_DATA` names no folder with them.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use image::RgbImage;
use keysplat::geometry::Se3;
use keysplat::sequence::{Layout, Sensor, Sequence};
use nalgebra::Point3;

/// The recording's folder in `$KEYSPLAT_DATA`; says so where there is none.
fn recorded(name: &str) -> Option<PathBuf> {
    let folder = std::env::var_os("KEYSPLAT_DATA").map(|data| Path::new(&data).join(name));
    if folder.is_none() {
        eprintln!("SKIPPED: set KEYSPLAT_DATA to the folder that holds {name}/");
    }
    folder
}

/// Pixels in which only the nearest point is taken for visible.
const CELL: f64 = 16.0;

/// The median difference in colour (0 to 765) between a photo and the known points that a camera at `world_from_camera` would see.
fn median_difference(sequence: &Sequence, world_from_camera: Se3, photo: &RgbImage) -> u32 {
    let camera_from_world = world_from_camera.inverse();
    let mut nearest = BTreeMap::new();
    for point in &sequence.points {
        let p_in_camera = camera_from_world * Point3::from(point.position);
        let pixel = sequence.camera.pinhole.project(&p_in_camera.coords);
        if let Some(pixel) = pixel.filter(|pixel| sequence.camera.pinhole.contains(pixel, 1.0)) {
            let seen = photo.get_pixel(pixel.x.round() as u32, pixel.y.round() as u32).0;
            let difference: u32 = (0..3).map(|c| u32::from(seen[c].abs_diff(point.color[c]))).sum();
            let cell = nearest.entry(((pixel.x / CELL) as u32, (pixel.y / CELL) as u32)).or_insert((f64::INFINITY, 0));
            if p_in_camera.z < cell.0 {
                *cell = (p_in_camera.z, difference);
            }
        }
    }
    assert!(nearest.len() > 500, "points in only {} cells", nearest.len());
    let mut differences: Vec<u32> = nearest.values().map(|(_, difference)| *difference).collect();
    differences.sort_unstable();
    differences[differences.len() / 2]
}

/// The points of COLMAP's model have the colours of the photos where they are seen: poses, intrinsics and points belong together.
#[test]
fn photos_of_bonsai_show_the_points_of_their_model() {
    let Some(folder) = recorded("bonsai") else { return };
    let sequence = Sequence::open(&folder, None, None).unwrap();
    assert_eq!((sequence.layout, sequence.sensor, sequence.entries.len()), (Layout::Colmap, Sensor::Mono, 292));
    assert_eq!(sequence.points.len(), 81_223);
    let poses = &sequence.groundtruth.as_ref().unwrap().poses;
    assert_eq!(poses.len(), 292);
    for index in (0..292).step_by(60) {
        let photo = sequence.load(index).unwrap().color;
        let difference_seen_from = |pose: usize| median_difference(&sequence, poses[pose].world_from_camera, &photo);
        let (own, other) = (difference_seen_from(index), difference_seen_from((index + 30) % 292));
        assert!(own * 2 < other, "photo {index}: its points differ by {own}, those of another pose by {other}");
    }
}
