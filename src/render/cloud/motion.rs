//! Motion of Gaussians by similarities: centres, sizes, orientations and harmonics. On the host, because a keyframe rarely moves far.

use std::ops::Range;

use glam::Quat;
use nalgebra::{Point3, Vector3};

use super::GpuCloud;
use crate::geometry::Sim3;
use crate::gpu::{Gpu, GpuBuffer, GpuError};
use crate::render::layout::GEOMETRY_PLANES;
use crate::splat::sh::ShRotation;

/// Gaussians side by side that move alike.
#[derive(Clone, Debug, PartialEq)]
pub struct RunMotion {
    /// Their places in map order.
    pub run: Range<usize>,
    /// Motion in the world.
    pub new_from_old: Sim3,
}

impl GpuCloud {
    /// Moves runs of Gaussians, ascending, and clears their moments, which belong to where they were.
    ///
    /// # Errors
    /// [`GpuError`] if a buffer does not fit or the device fails.
    pub fn transform(&mut self, gpu: &Gpu, motions: &[RunMotion]) -> Result<(), GpuError> {
        let (Some(first), Some(last)) = (motions.first(), motions.last()) else { return Ok(()) };
        let span = first.run.start..last.run.end;
        for buffer in [&self.parameters, &self.averages] {
            self.transform_geometry(gpu, buffer, &span, motions)?;
            self.rotate_harmonics(gpu, buffer, &span, motions)?;
        }
        let mut encoder = gpu.device.create_command_encoder(&Default::default());
        for RunMotion { run, .. } in motions {
            for plane in 0..self.planes() {
                let (from, bytes) = ((plane * self.capacity + run.start) * 16, run.len() * 16);
                for moments in [&self.moments_1, &self.moments_2] {
                    encoder.clear_buffer(moments.raw(), from as u64, Some(bytes as u64));
                }
            }
        }
        gpu.queue.submit([encoder.finish()]);
        Ok(())
    }

    /// Centres, log scales and rotations within `span`.
    fn transform_geometry(
        &self,
        gpu: &Gpu,
        buffer: &GpuBuffer,
        span: &Range<usize>,
        motions: &[RunMotion],
    ) -> Result<(), GpuError> {
        let read = |plane: usize| buffer.read::<[f32; 4]>(gpu, plane * self.capacity + span.start, span.len());
        let [mut means, mut log_scales, mut rotations] = [read(0)?, read(1)?, read(2)?];
        for RunMotion { run, new_from_old } in motions {
            let [x, y, z, w] = new_from_old.rotation.coords.map(|v| v as f32).into();
            let (turn, growth) = (Quat::from_xyzw(x, y, z, w), new_from_old.scale.ln() as f32);
            for i in run.start - span.start..run.end - span.start {
                let [x, y, z, raw_opacity] = means[i];
                let p = new_from_old.act(&Point3::new(x, y, z).cast());
                means[i] = [p.x as f32, p.y as f32, p.z as f32, raw_opacity];
                log_scales[i][..3].iter_mut().for_each(|log_scale| *log_scale += growth);
                let [w, x, y, z] = rotations[i];
                let q = turn * Quat::from_xyzw(x, y, z, w);
                rotations[i] = [q.w, q.x, q.y, q.z];
            }
        }
        for (plane, values) in [means, log_scales, rotations].iter().enumerate() {
            buffer.write(gpu, plane * self.capacity + span.start, values);
        }
        Ok(())
    }

    /// Harmonics above the constant within `span`.
    fn rotate_harmonics(
        &self,
        gpu: &Gpu,
        buffer: &GpuBuffer,
        span: &Range<usize>,
        motions: &[RunMotion],
    ) -> Result<(), GpuError> {
        let place = |k: usize| (GEOMETRY_PLANES + k) * self.capacity + span.start;
        let count = self.sh_degree.coefficients();
        let read = |k: usize| buffer.read::<[f32; 4]>(gpu, place(k), span.len());
        let mut planes = (1..count).map(read).collect::<Result<Vec<_>, _>>()?;
        // The constant is the same in every direction and stays.
        let mut harmonics = vec![Vector3::zeros(); count];
        for RunMotion { run, new_from_old } in motions.iter().filter(|_| count > 1) {
            let rotation = ShRotation::new(&new_from_old.rotation);
            for i in run.start - span.start..run.end - span.start {
                for (to, plane) in harmonics[1..].iter_mut().zip(&planes) {
                    *to = Vector3::new(plane[i][0], plane[i][1], plane[i][2]).cast();
                }
                rotation.rotate(&mut harmonics);
                for (plane, new) in planes.iter_mut().zip(&harmonics[1..]) {
                    plane[i] = [new.x as f32, new.y as f32, new.z as f32, 0.0];
                }
            }
        }
        (1..count).zip(&planes).for_each(|(k, values)| buffer.write(gpu, place(k), values));
        Ok(())
    }
}
