//! COLMAP's model (Schönberger & Frahm, CVPR 2016; `colmap.github.io/format.html`): `cameras`, `images`, `points3D`.
//!
//! Principal points count from the image's corner. Numbers begin at 1. Images have no observations, points no track.

use super::{PosedImage, SurfacePoint, cameras};
use crate::geometry::Pinhole;

/// COLMAP's number of a camera without distortion, and its name.
const PINHOLE: (u32, &str) = (1, "PINHOLE");
/// Mean reprojection error of a point without observations, pixels.
const NO_ERROR: f64 = 0.0;

/// Files below the dataset's folder.
pub(super) type Files = Vec<(String, Vec<u8>)>;

fn path(part: &str, ending: &str) -> String {
    format!("sparse/0/{part}.{ending}")
}

fn parameters(pinhole: &Pinhole) -> [f64; 4] {
    [pinhole.fx, pinhole.fy, pinhole.cx + 0.5, pinhole.cy + 0.5]
}

/// `[qw qx qy qz tx ty tz]` of the world in the camera.
fn pose(image: &PosedImage) -> [f64; 7] {
    let camera_from_world = image.world_from_camera.inverse();
    let (q, t) = (camera_from_world.rotation, camera_from_world.translation.vector);
    [q.w, q.i, q.j, q.k, t.x, t.y, t.z]
}

pub(super) fn binary(images: &[PosedImage], points: &[SurfacePoint]) -> Files {
    let (pinholes, of_image) = cameras(images);
    let floats = |bytes: &mut Vec<u8>, values: &[f64]| values.iter().for_each(|v| bytes.extend(v.to_le_bytes()));
    let begin = |count: usize| (count as u64).to_le_bytes().to_vec();
    let mut of_cameras = begin(pinholes.len());
    for (number, pinhole) in (1u32..).zip(&pinholes) {
        of_cameras.extend([number, PINHOLE.0].into_iter().flat_map(u32::to_le_bytes));
        of_cameras.extend([pinhole.width, pinhole.height].into_iter().flat_map(|side| u64::from(side).to_le_bytes()));
        floats(&mut of_cameras, &parameters(pinhole));
    }
    let mut of_images = begin(images.len());
    for ((number, image), camera) in (1u32..).zip(images).zip(of_image) {
        of_images.extend(number.to_le_bytes());
        floats(&mut of_images, &pose(image));
        of_images.extend((camera as u32 + 1).to_le_bytes());
        of_images.extend(image.name.bytes().chain([0]));
        of_images.extend(0u64.to_le_bytes());
    }
    let mut of_points = begin(points.len());
    for (number, point) in (1u64..).zip(points) {
        of_points.extend(number.to_le_bytes());
        floats(&mut of_points, &point.position.map(f64::from));
        of_points.extend(point.color);
        of_points.extend(NO_ERROR.to_le_bytes());
        of_points.extend(0u64.to_le_bytes());
    }
    vec![(path("cameras", "bin"), of_cameras), (path("points3D", "bin"), of_points), (path("images", "bin"), of_images)]
}

pub(super) fn text(images: &[PosedImage], points: &[SurfacePoint]) -> Files {
    let (pinholes, of_image) = cameras(images);
    let line = |values: &[f64]| values.iter().map(f64::to_string).collect::<Vec<_>>().join(" ");
    let mut of_cameras = String::from("# CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]\n");
    for (number, pinhole) in (1u32..).zip(&pinholes) {
        let Pinhole { width, height, .. } = pinhole;
        of_cameras += &format!("{number} {} {width} {height} {}\n", PINHOLE.1, line(&parameters(pinhole)));
    }
    let mut of_images = String::from("# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, then its observations\n");
    for ((number, image), camera) in (1u32..).zip(images).zip(of_image) {
        of_images += &format!("{number} {} {} {}\n\n", line(&pose(image)), camera + 1, image.name);
    }
    let mut of_points = String::from("# POINT3D_ID X Y Z R G B ERROR TRACK[]\n");
    for (number, SurfacePoint { position: [x, y, z], color: [r, g, b] }) in (1u64..).zip(points) {
        of_points += &format!("{number} {x} {y} {z} {r} {g} {b} {NO_ERROR}\n");
    }
    [("cameras", of_cameras), ("points3D", of_points), ("images", of_images)]
        .map(|(part, text)| (path(part, "txt"), text.into_bytes()))
        .into()
}
