//! Fuses one view into one block: the projective distance to the view's surface, as a running mean.
//!
//! The distance along the ray times the cosine at which it meets the surface is that to the tangent plane (Bylow et al., *Real-time camera tracking
//! and 3D reconstruction using signed distance functions*, 2013). A view weighs by that cosine and by 1/z², the precision of depth
//! sensors (Nguyen et al., *Modeling Kinect sensor noise*, 2012). Behind the surface the weight falls to zero at the truncation
//! (Oleynikova et al., *Voxblox*, 2017), so that the two sides of a thin thing disturb each other less.

use nalgebra::Vector3;

use super::volume::{Block, SIDE, Voxel};
use super::{DepthView, MeshConfig};

/// Nearer voxels are not projected, metres.
const NEAR_METRES: f32 = 0.05;

/// A view with what does not change from block to block.
pub(super) struct Projection<'a> {
    view: &'a DepthView,
    truncation: f32,
    voxel: f64,
    /// Steps of one voxel along the world's axes, in the camera's frame.
    steps: [[f32; 3]; 3],
}

impl<'a> Projection<'a> {
    pub fn new(view: &'a DepthView, config: &MeshConfig) -> Self {
        let inverse = view.world_from_camera.rotation.inverse();
        let step = |axis: Vector3<f64>| <[f32; 3]>::from((inverse * axis * config.voxel_metres).map(|v| v as f32));
        Self {
            view,
            truncation: config.truncation_metres() as f32,
            voxel: config.voxel_metres,
            steps: [step(Vector3::x()), step(Vector3::y()), step(Vector3::z())],
        }
    }

    /// The block's first voxel in the camera's frame, unless the view sees nothing of the block.
    fn origin(&self, block: &Block) -> Option<[f32; 3]> {
        let side = self.voxel * SIDE as f64;
        let corner = Vector3::from(block.key.map(|k| f64::from(k) * side));
        let (pose, pinhole) = (&self.view.world_from_camera, &self.view.pinhole);
        let origin = pose.inverse_transform_vector(&(corner - pose.translation.vector));
        let half = pose.inverse_transform_vector(&Vector3::repeat(0.5 * (side - self.voxel)));
        let (middle, radius) = (origin + half, half.norm());
        if middle.z + radius < f64::from(NEAR_METRES) {
            return None;
        }
        // Outside of one of the four planes through the camera and the image's borders.
        let misses = |along: f64, focal: f64, low: f64, high: f64| {
            let (left, right) = (low / focal, high / focal);
            let beyond = |slope: f64, sign: f64| sign * (along - slope * middle.z) / slope.hypot(1.0) > radius;
            beyond(left, -1.0) || beyond(right, 1.0)
        };
        let outside = misses(middle.x, pinhole.fx, -0.5 - pinhole.cx, f64::from(pinhole.width) - 0.5 - pinhole.cx)
            || misses(middle.y, pinhole.fy, -0.5 - pinhole.cy, f64::from(pinhole.height) - 0.5 - pinhole.cy);
        (!outside).then(|| <[f32; 3]>::from(origin.map(|v| v as f32)))
    }

    /// Adds what the view knows of each voxel.
    pub fn integrate(&self, block: &mut Block) {
        let Some(origin) = self.origin(block) else { return };
        let [ax, ay, az] = self.steps;
        let mut voxels = block.voxels.iter_mut();
        for z in 0..SIDE {
            for y in 0..SIDE {
                let row = |k: usize| origin[k] + z as f32 * az[k] + y as f32 * ay[k];
                let row = [row(0), row(1), row(2)];
                for (x, voxel) in voxels.by_ref().take(SIDE).enumerate() {
                    let x = x as f32;
                    self.add([row[0] + x * ax[0], row[1] + x * ax[1], row[2] + x * ax[2]], voxel);
                }
            }
        }
    }

    fn add(&self, p: [f32; 3], voxel: &mut Voxel) {
        if p[2] < NEAR_METRES {
            return;
        }
        let pinhole = &self.view.pinhole;
        let n = [p[0] / p[2], p[1] / p[2]];
        let (u, v) = (n[0] * pinhole.fx as f32 + pinhole.cx as f32, n[1] * pinhole.fy as f32 + pinhole.cy as f32);
        let inside = u > -0.5 && v > -0.5 && u < pinhole.width as f32 - 0.5 && v < pinhole.height as f32 - 0.5;
        if !inside {
            return;
        }
        let inverse = self.view.sample(u, v);
        if inverse == 0.0 {
            return;
        }
        let nearest = v.round() as usize * pinhole.width as usize + u.round() as usize;
        let facing = self.view.facing[nearest];
        let ray = (1.0 + n[0] * n[0] + n[1] * n[1]).sqrt();
        let along = (inverse.recip() - p[2]) * ray;
        let distance = along * facing;
        // Behind the surface the ray's own length counts: a flat ray would else reach what lies far behind a rim.
        if facing == 0.0 || along < -self.truncation || distance > self.truncation {
            return;
        }
        let behind = (1.0 + along.min(0.0) / self.truncation).max(0.0);
        let weight = facing * inverse * inverse * behind;
        if weight <= 0.0 {
            return;
        }
        let sum = voxel.weight + weight;
        let share = weight / sum;
        voxel.distance += share * (distance - voxel.distance);
        voxel.weight = sum;
        voxel.views = voxel.views.saturating_add(1);
        for (mean, color) in voxel.color.iter_mut().zip(self.view.color[nearest]) {
            let old = f32::from(*mean);
            *mean = (old + share * (256.0 * f32::from(color) - old)).round().clamp(0.0, 65535.0) as u16;
        }
    }
}
