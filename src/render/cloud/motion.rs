//! Motion of Gaussians by similarities: centres, sizes, orientations and harmonics. On the host, because a keyframe rarely moves far.

use std::ops::Range;

use glam::Quat;
use nalgebra::{Point3, Vector3};

use super::GpuCloud;
use crate::geometry::Sim3;
use crate::gpu::{Gpu, GpuError};
use crate::render::layout::GEOMETRY_PLANES;
use crate::splat::sh::ShRotation;

/// Gaussians side by side that move alike.
#[derive(Clone, Debug, PartialEq)]
pub struct RunMotion {
    /// Their places in map order.
    pub run: Range<usize>,
    /// Motion in the world.
    pub new_from_old: Sim3,
    /// Whether their moments belong to where they were.
    pub clears_moments: bool,
}

impl GpuCloud {
    /// Moves runs of Gaussians, ascending.
    ///
    /// # Errors
    /// [`GpuError`] if a buffer does not fit or the device fails.
    pub fn transform(&mut self, gpu: &Gpu, motions: &[RunMotion]) -> Result<(), GpuError> {
        let (Some(first), Some(last)) = (motions.first(), motions.last()) else { return Ok(()) };
        let span = first.run.start..last.run.end;
        for buffer in [&self.parameters, &self.averages] {
            let place = |plane: usize| plane * self.capacity + span.start;
            let parts: Vec<_> = (0..self.planes()).map(|plane| buffer.part::<[f32; 4]>(place(plane), span.len())).collect();
            let read = gpu.read(None, &parts)?;
            let mut planes: Vec<Vec<[f32; 4]>> = (0..self.planes()).map(|plane| read.part(plane)).collect();
            drop(read);
            for RunMotion { run, new_from_old, .. } in motions {
                let run = run.start - span.start..run.end - span.start;
                move_planes(&mut planes.iter_mut().map(|plane| &mut plane[run.clone()]).collect::<Vec<_>>(), new_from_old);
            }
            planes.iter().enumerate().for_each(|(plane, values)| buffer.write(gpu, place(plane), values));
        }
        let mut encoder = gpu.device.create_command_encoder(&Default::default());
        for RunMotion { run, .. } in motions.iter().filter(|motion| motion.clears_moments) {
            for plane in 0..self.planes() {
                let (from, bytes) = ((plane * self.capacity + run.start) * 16, run.len() * 16);
                for moments in [&self.moments_1, &self.moments_2] {
                    gpu.clear(&mut encoder, moments, from as u64, Some(bytes as u64));
                }
            }
        }
        gpu.submit(encoder);
        Ok(())
    }
}

/// Moves Gaussians, `[planes, N]`.
pub(super) fn move_planes(planes: &mut [&mut [[f32; 4]]], new_from_old: &Sim3) {
    move_geometry(planes, new_from_old);
    rotate_harmonics(planes, new_from_old);
}

/// Centres, log scales and rotations.
fn move_geometry(planes: &mut [&mut [[f32; 4]]], new_from_old: &Sim3) {
    let [x, y, z, w] = new_from_old.rotation.coords.map(|v| v as f32).into();
    let (turn, growth) = (Quat::from_xyzw(x, y, z, w), new_from_old.scale.ln() as f32);
    for i in 0..planes[0].len() {
        let [x, y, z, raw_opacity] = planes[0][i];
        let p = new_from_old.act(&Point3::new(x, y, z).cast());
        planes[0][i] = [p.x as f32, p.y as f32, p.z as f32, raw_opacity];
        planes[1][i][..3].iter_mut().for_each(|log_scale| *log_scale += growth);
        planes[1][i][3] *= new_from_old.scale as f32;
        let [w, x, y, z] = planes[2][i];
        let q = turn * Quat::from_xyzw(x, y, z, w);
        planes[2][i] = [q.w, q.x, q.y, q.z];
    }
}

/// Harmonics above the constant, which is the same in every direction.
fn rotate_harmonics(planes: &mut [&mut [[f32; 4]]], new_from_old: &Sim3) {
    let harmonics = &mut planes[GEOMETRY_PLANES + 1..];
    if harmonics.is_empty() {
        return;
    }
    let rotation = ShRotation::new(&new_from_old.rotation);
    let mut coefficients = vec![Vector3::zeros(); harmonics.len() + 1];
    for i in 0..harmonics[0].len() {
        for (to, plane) in coefficients[1..].iter_mut().zip(&*harmonics) {
            *to = Vector3::new(plane[i][0], plane[i][1], plane[i][2]).cast();
        }
        rotation.rotate(&mut coefficients);
        for (plane, new) in harmonics.iter_mut().zip(&coefficients[1..]) {
            plane[i] = [new.x as f32, new.y as f32, new.z as f32, 0.0];
        }
    }
}
