//! Motion of Gaussians by similarities: centres, sizes, orientations and harmonics. Of the map by a shader, of parts that are away on the host.

use std::ops::Range;

use glam::Quat;
use nalgebra::{Matrix3, Point3, Vector3};

use super::{GpuCloud, change};
use crate::geometry::Sim3;
use crate::gpu::{Gpu, GpuBuffer, GpuError};
use crate::render::layout::{GEOMETRY_PLANES, TransformSetup};
use crate::splat::sh::ShRotation;

/// vec4 of a motion in `shaders/transform.wgsl`: displacement, rotation, growth, and the harmonics' matrices with 83 values.
const MOTION_ROWS: usize = 26;
/// Invocations of one of its workgroups.
const INVOCATIONS: u32 = 64;

/// How Gaussians move.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Motions {
    /// Motions in the world, new_from_old.
    pub of: Vec<Sim3>,
    /// Places in map order, ascending and apart, of Gaussians that move alike, and the place of their motion.
    pub runs: Vec<(Range<usize>, usize)>,
}

impl Motions {
    /// Number of Gaussians that move.
    pub fn gaussians(&self) -> usize {
        self.runs.iter().map(|(run, _)| run.len()).sum()
    }
}

impl GpuCloud {
    /// Moves Gaussians and their averages. Moments stay as they are: directions of the world hardly turn by a correction.
    ///
    /// # Errors
    /// [`GpuError`] if a buffer does not fit.
    pub fn transform(&mut self, gpu: &Gpu, motions: &Motions) -> Result<(), GpuError> {
        let (Some((first, _)), Some((last, _))) = (motions.runs.first(), motions.runs.last()) else { return Ok(()) };
        let span = first.start as u32..last.end as u32;
        let runs: Vec<[u32; 4]> =
            motions.runs.iter().map(|(run, motion)| [run.start as u32, run.end as u32, *motion as u32, 0]).collect();
        let rows: Vec<[[f32; 4]; MOTION_ROWS]> = motions.of.iter().map(rows).collect();
        let runs_on_gpu = GpuBuffer::storage(gpu, "runs", (runs.len() * 16) as u64)?;
        runs_on_gpu.write(gpu, 0, &runs);
        let motions_on_gpu = GpuBuffer::storage(gpu, "motions", (rows.len() * MOTION_ROWS * 16) as u64)?;
        motions_on_gpu.write(gpu, 0, &rows);
        let setup = TransformSetup { first: span.start, end: span.end, capacity: self.capacity as u32, pad: 0 };
        self.uniforms.begin();
        let setup = self.uniforms.put(&setup);
        self.uniforms.upload(gpu);
        for values in [&self.parameters, &self.averages] {
            let bindings = [(0, self.uniforms.of(setup)), (1, &runs_on_gpu), (2, &motions_on_gpu), (3, values)];
            change::dispatch(gpu, &self.kernels.transform, &bindings, span.len() as u32, INVOCATIONS);
        }
        Ok(())
    }
}

/// A motion as the shader has it. The displacement is the difference to no motion: f32 would lose a small one far from the origin.
fn rows(new_from_old: &Sim3) -> [[f32; 4]; MOTION_ROWS] {
    let mut rows = [[0.0; 4]; MOTION_ROWS];
    let displacement = new_from_old.rotation.to_rotation_matrix().matrix() * new_from_old.scale - Matrix3::identity();
    for (row, values) in rows.iter_mut().take(3).enumerate() {
        let [x, y, z] = [0, 1, 2].map(|column| displacement[(row, column)] as f32);
        *values = [x, y, z, new_from_old.translation[row] as f32];
    }
    let [x, y, z, w] = new_from_old.rotation.coords.map(|v| v as f32).into();
    rows[3] = [w, x, y, z];
    rows[4] = [new_from_old.scale as f32, new_from_old.scale.ln() as f32, 0.0, 0.0];
    let harmonics = ShRotation::new(&new_from_old.rotation);
    rows[5..].as_flattened_mut().iter_mut().zip(harmonics.elements()).for_each(|(to, element)| *to = element as f32);
    rows
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
