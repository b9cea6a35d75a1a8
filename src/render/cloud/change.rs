//! Changes of the set of Gaussians: new ones, and a plan's removals and divisions.

use glam::Vec3;

use super::{GEOMETRY_PLANES, GpuCloud, allocate, allocate_histories, planes};
use crate::gpu::{Gpu, GpuBuffer, GpuError, Kernel, workgroups};
use crate::render::layout::{AppendSetup, BlendForm, DivideSetup, GatherSetup};
use crate::render::plan::Plan;
use crate::render::shaders::{self, ShaderSource};
use crate::splat::GaussianCloud;

#[derive(Debug)]
pub(super) struct Kernels {
    gather: Kernel,
    divide: Kernel,
    append: Kernel,
}

impl Kernels {
    pub fn new(gpu: &Gpu) -> Self {
        let kernel = |source: &ShaderSource| Kernel::new(gpu, source.name, "main", &source.text(BlendForm::default()));
        Self { gather: kernel(&shaders::GATHER), divide: kernel(&shaders::DIVIDE), append: kernel(&shaders::APPEND) }
    }
}

impl GpuCloud {
    /// Appends Gaussians with zero moments and without a history. Those that hold a NaN or an infinity are left out; their number is
    /// returned.
    ///
    /// # Errors
    /// [`GpuError`] if a buffer does not fit or the device fails.
    pub fn append(&mut self, gpu: &Gpu, cloud: &GaussianCloud) -> Result<usize, GpuError> {
        assert_eq!(cloud.sh_degree, self.sh_degree, "a map has one spherical-harmonics degree");
        let finite: Vec<usize> = (0..cloud.len()).filter(|&i| is_finite(cloud, i)).collect();
        let left_out = cloud.len() - finite.len();
        if finite.is_empty() {
            return Ok(left_out);
        }
        let capacity = self.capacity_for(gpu, self.count + finite.len());
        if capacity > self.capacity {
            self.rebuild(gpu, &Plan::default(), capacity)?;
        }
        let value = |plane: usize| finite.iter().map(move |&i| plane_value(cloud, plane, i));
        let values: Vec<[f32; 4]> = (0..self.planes()).flat_map(value).collect();
        let appended = GpuBuffer::storage(gpu, "appended", (values.len() * 16) as u64)?;
        appended.write(gpu, 0, &values);
        let setup = AppendSetup {
            first: self.count as u32,
            count: finite.len() as u32,
            capacity: self.capacity as u32,
            round: self.rounds as f32,
        };
        self.uniforms.begin();
        let setup = self.uniforms.put(&setup);
        let bindings = [
            (0, self.uniforms.of(setup)),
            (1, &appended),
            (2, &self.parameters),
            (3, &self.moments_1),
            (4, &self.moments_2),
            (5, &self.averages),
            (6, &self.histories),
        ];
        let mut encoder = gpu.device.create_command_encoder(&Default::default());
        let mut pass = encoder.begin_compute_pass(&Default::default());
        self.kernels.append.dispatch(gpu, &mut pass, &bindings, workgroups((finite.len() as u32).div_ceil(256)));
        drop(pass);
        self.uniforms.upload(gpu);
        gpu.submit(encoder);
        self.count += finite.len();
        Ok(left_out)
    }

    /// Applies a plan to the parameters, their averages, the moments and the histories. A child inherits its parent's moments and has no
    /// history.
    ///
    /// # Errors
    /// [`GpuError`] if a buffer does not fit.
    pub fn apply(&mut self, gpu: &Gpu, plan: &Plan) -> Result<(), GpuError> {
        let capacity = self.capacity_for(gpu, plan.len_after(self.count));
        if plan.is_empty() && capacity == self.capacity {
            return Ok(());
        }
        self.rebuild(gpu, plan, capacity)
    }

    /// The Gaussians after a change, with room for `capacity`. Buffers are replaced one at a time: the old and the new ones never stand beside
    /// each other in full.
    fn rebuild(&mut self, gpu: &Gpu, plan: &Plan, capacity: usize) -> Result<(), GpuError> {
        let list = plan.changes();
        let changes = GpuBuffer::storage(gpu, "changes", (list.len() * 4) as u64)?;
        changes.write(gpu, 0, &list);
        let (kept, children) = (plan.kept(self.count) as u32, 2 * plan.divided.len() as u32);
        let removed = plan.removed.len() as u32;
        let (capacity_in, capacity_out) = (self.capacity as u32, capacity as u32);
        let gather_setup = GatherSetup { kept, children, removed, capacity_in, capacity_out, pad: [0; 3] };
        let divide_setup = DivideSetup {
            first: kept,
            children,
            parents: removed,
            capacity: capacity_out,
            round: self.rounds as f32,
            pad: [0; 3],
        };
        let (sh_degree, resized) = (self.sh_degree, capacity != self.capacity);
        let Self { parameters, moments_1, moments_2, averages, histories, spare, spare_histories, kernels, uniforms, .. } = self;
        uniforms.begin();
        let setup = uniforms.put(&gather_setup);
        let of_children = uniforms.put(&divide_setup);
        uniforms.upload(gpu);
        let size = workgroups((kept + children).div_ceil(256));
        let gather = |from: &GpuBuffer, to: &GpuBuffer| {
            let mut encoder = gpu.device.create_command_encoder(&Default::default());
            let mut pass = encoder.begin_compute_pass(&Default::default());
            kernels.gather.dispatch(gpu, &mut pass, &[(0, uniforms.of(setup)), (1, &changes), (2, from), (3, to)], size);
            drop(pass);
            gpu.submit(encoder);
        };
        for buffer in [&mut *parameters, moments_1, moments_2, &mut *averages] {
            // An old one of another size is given back before the new one is made.
            let to = spare.take().filter(|_| !resized).map_or_else(|| allocate(gpu, sh_degree, capacity), Ok)?;
            gather(buffer, &to);
            *spare = Some(std::mem::replace(buffer, to));
        }
        let to = spare_histories.take().filter(|_| !resized).map_or_else(|| allocate_histories(gpu, capacity), Ok)?;
        gather(histories, &to);
        *spare_histories = Some(std::mem::replace(histories, to));
        if children > 0 {
            let bindings = [(0, uniforms.of(of_children)), (1, &changes), (2, &*parameters), (3, &*averages), (4, &*histories)];
            let mut encoder = gpu.device.create_command_encoder(&Default::default());
            let mut pass = encoder.begin_compute_pass(&Default::default());
            kernels.divide.dispatch(gpu, &mut pass, &bindings, workgroups(children.div_ceil(256)));
            drop(pass);
            gpu.submit(encoder);
        }
        if resized {
            (*spare, *spare_histories) = (None, None);
        }
        (self.count, self.capacity) = ((kept + children) as usize, capacity);
        Ok(())
    }
}

fn plane_value(cloud: &GaussianCloud, plane: usize, i: usize) -> [f32; 4] {
    let with = |v: Vec3, w: f32| [v.x, v.y, v.z, w];
    let q = cloud.rotations[i];
    match plane {
        0 => with(cloud.means[i], cloud.raw_opacities[i]),
        1 => with(cloud.log_scales[i], 0.0),
        2 => [q.w, q.x, q.y, q.z],
        _ => with(cloud.sh[i * cloud.sh_degree.coefficients() + plane - GEOMETRY_PLANES], 0.0),
    }
}

fn is_finite(cloud: &GaussianCloud, i: usize) -> bool {
    (0..planes(cloud.sh_degree)).all(|plane| plane_value(cloud, plane, i).iter().all(|v| v.is_finite()))
}
