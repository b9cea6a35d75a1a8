//! `transforms.json`, as nerfstudio has it, and the points that its splats begin from.
//!
//! Cameras are OpenGL's: x right, y up, z backward. Principal points count from the image's corner. The world stays that of the run.

use serde::Serialize;

use super::colmap::Files;
use super::{DEPTH, IMAGES, MASKS, PosedImage, SurfacePoint, depth_name, mask_name};

/// Poses' unit per unit of depth: nerfstudio's own.
const DEPTH_UNIT: f64 = 1e-3;
const POINTS: &str = "points.ply";

#[derive(Serialize)]
struct Transforms {
    camera_model: &'static str,
    ply_file_path: &'static str,
    #[serde(skip_serializing_if = "Option::is_none")]
    depth_unit_scale_factor: Option<f64>,
    frames: Vec<Frame>,
}

#[derive(Serialize)]
struct Frame {
    file_path: String,
    #[serde(skip_serializing_if = "Option::is_none")]
    mask_path: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    depth_file_path: Option<String>,
    fl_x: f64,
    fl_y: f64,
    cx: f64,
    cy: f64,
    w: u32,
    h: u32,
    /// Rows of `world_from_camera`, of OpenGL's camera.
    transform_matrix: [[f64; 4]; 4],
}

pub(super) fn files(images: &[PosedImage], points: &[SurfacePoint]) -> Files {
    let file = Transforms {
        camera_model: "PINHOLE",
        ply_file_path: POINTS,
        depth_unit_scale_factor: images.iter().any(|image| image.has_depth).then_some(DEPTH_UNIT),
        frames: images.iter().map(frame).collect(),
    };
    let json = serde_json::to_vec_pretty(&file).expect("numbers and text");
    vec![(POINTS.into(), ply(points)), ("transforms.json".into(), json)]
}

fn frame(image: &PosedImage) -> Frame {
    let PosedImage { name, pinhole, world_from_camera, .. } = image;
    let mut matrix = world_from_camera.to_matrix();
    matrix.columns_mut(1, 2).neg_mut();
    Frame {
        file_path: format!("{IMAGES}/{name}"),
        mask_path: image.has_mask.then(|| format!("{MASKS}/{}", mask_name(name))),
        depth_file_path: image.has_depth.then(|| format!("{DEPTH}/{}", depth_name(name))),
        fl_x: pinhole.fx,
        fl_y: pinhole.fy,
        cx: pinhole.cx + 0.5,
        cy: pinhole.cy + 0.5,
        w: pinhole.width,
        h: pinhole.height,
        transform_matrix: std::array::from_fn(|row| std::array::from_fn(|column| matrix[(row, column)])),
    }
}

/// Points as a binary PLY.
fn ply(points: &[SurfacePoint]) -> Vec<u8> {
    let properties = ["float x", "float y", "float z", "uchar red", "uchar green", "uchar blue"];
    let properties: String = properties.iter().map(|property| format!("property {property}\n")).collect();
    let header = format!("ply\nformat binary_little_endian 1.0\nelement vertex {}\n{properties}end_header\n", points.len());
    let mut bytes = header.into_bytes();
    for point in points {
        bytes.extend(point.position.into_iter().flat_map(f32::to_le_bytes));
        bytes.extend(point.color);
    }
    bytes
}
