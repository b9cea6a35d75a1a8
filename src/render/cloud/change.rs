//! Changes of the set of Gaussians: new ones, and a plan's removals and divisions.

use glam::Vec3;

use super::{GEOMETRY_PLANES, GpuCloud, allocate, allocate_histories, planes};
use crate::gpu::{Gpu, GpuBuffer, GpuError, Kernel, UniformCell, Uniforms, workgroups};
use crate::render::layout::{AppendSetup, BlendForm, DivideSetup, FixSetup, GatherSetup};
use crate::render::plan::Plan;
use crate::render::shaders::{self, ShaderSource};
use crate::splat::GaussianCloud;

/// Invocations of a workgroup that makes a change.
const INVOCATIONS: u32 = 256;

#[derive(Debug)]
pub(super) struct Kernels {
    gather: Kernel,
    divide: Kernel,
    append: Kernel,
    fix: Kernel,
    pub transform: Kernel,
}

impl Kernels {
    pub fn new(gpu: &Gpu) -> Self {
        let kernel = |source: &ShaderSource| Kernel::new(gpu, source.name, "main", &source.text(BlendForm::default()));
        let sources = [&shaders::GATHER, &shaders::DIVIDE, &shaders::APPEND, &shaders::FIX, &shaders::TRANSFORM];
        let [gather, divide, append, fix, transform] = sources.map(kernel);
        Self { gather, divide, append, fix, transform }
    }
}

/// A change that is ready to be made, one buffer after the other.
pub(super) struct Gathering {
    /// Those that go, and the parents of those that come.
    changes: GpuBuffer,
    kept: u32,
    children: u32,
    setup: UniformCell,
    of_children: UniformCell,
}

impl Gathering {
    /// Of a map with `count` Gaussians in buffers for `capacity_in`, into such for `capacity_out`.
    pub fn new(gpu: &Gpu, plan: &Plan, cloud: &mut GpuCloud, capacity_out: usize) -> Result<Self, GpuError> {
        let list = plan.changes();
        let changes = GpuBuffer::storage(gpu, "changes", (list.len() * 4) as u64)?;
        changes.write(gpu, 0, &list);
        let (kept, children) = (plan.kept(cloud.count) as u32, 2 * plan.divided.len() as u32);
        let removed = plan.removed.len() as u32;
        let (capacity_in, capacity_out) = (cloud.capacity as u32, capacity_out as u32);
        let round = cloud.rounds as f32;
        let uniforms = &mut cloud.uniforms;
        uniforms.begin();
        let setup = uniforms.put(&GatherSetup { kept, children, removed, capacity_in, capacity_out, pad: [0; 3] });
        let of_children =
            uniforms.put(&DivideSetup { first: kept, children, parents: removed, capacity: capacity_out, round, pad: [0; 3] });
        uniforms.upload(gpu);
        Ok(Self { changes, kept, children, setup, of_children })
    }

    /// Gathers one buffer into another.
    pub fn gather(&self, gpu: &Gpu, (kernels, uniforms): (&Kernels, &Uniforms), from: &GpuBuffer, to: &GpuBuffer) {
        let bindings = [(0, uniforms.of(self.setup)), (1, &self.changes), (2, from), (3, to)];
        dispatch(gpu, &kernels.gather, &bindings, self.kept + self.children, INVOCATIONS);
    }
}

pub(super) fn dispatch(gpu: &Gpu, kernel: &Kernel, bindings: &[(u32, &GpuBuffer)], threads: u32, of_workgroup: u32) {
    let mut encoder = gpu.device.create_command_encoder(&Default::default());
    let mut pass = encoder.begin_compute_pass(&Default::default());
    kernel.dispatch(gpu, &mut pass, bindings, workgroups(threads.div_ceil(of_workgroup)));
    drop(pass);
    gpu.submit(encoder);
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
        self.reserve(gpu, self.count + finite.len())?;
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
        self.uniforms.upload(gpu);
        dispatch(gpu, &self.kernels.append, &bindings, finite.len() as u32, INVOCATIONS);
        self.count += finite.len();
        Ok(left_out)
    }

    /// The Gaussians at these places are rendered, but no step moves them, until the next such call. Their children, and where they go, keep that.
    ///
    /// # Errors
    /// [`GpuError`] if a buffer does not fit.
    pub fn fix(&mut self, gpu: &Gpu, places: &[u32]) -> Result<(), GpuError> {
        let mut bits = vec![0u32; self.count.div_ceil(32).max(1)];
        places.iter().for_each(|place| bits[*place as usize / 32] |= 1 << (place % 32));
        let fixed = GpuBuffer::storage(gpu, "fixed", (bits.len() * 4) as u64)?;
        fixed.write(gpu, 0, &bits);
        self.uniforms.begin();
        let setup = self.uniforms.put(&FixSetup { count: self.count as u32, capacity: self.capacity as u32, pad: [0; 2] });
        self.uniforms.upload(gpu);
        let bindings = [(0, self.uniforms.of(setup)), (1, &fixed), (2, &self.moments_2)];
        dispatch(gpu, &self.kernels.fix, &bindings, self.count as u32, INVOCATIONS);
        Ok(())
    }

    /// Makes room for so many Gaussians.
    pub(super) fn reserve(&mut self, gpu: &Gpu, needed: usize) -> Result<(), GpuError> {
        let capacity = self.capacity_for(gpu, needed);
        if capacity > self.capacity { self.rebuild(gpu, &Plan::default(), capacity) } else { Ok(()) }
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
        let gathering = Gathering::new(gpu, plan, self, capacity)?;
        let (sh_degree, resized) = (self.sh_degree, capacity != self.capacity);
        let Self { parameters, moments_1, moments_2, averages, histories, spare, spare_histories, kernels, uniforms, .. } = self;
        let by = (&*kernels, &*uniforms);
        // The histories first: they are one plane, and a failure here or below leaves the averages as they were, which are what a map is read from.
        let to = spare_histories.take().filter(|_| !resized).map_or_else(|| allocate_histories(gpu, capacity), Ok)?;
        gathering.gather(gpu, by, histories, &to);
        *spare_histories = Some(std::mem::replace(histories, to));
        for buffer in [&mut *parameters, moments_1, moments_2, &mut *averages] {
            // An old one of another size is given back before the new one is made.
            let to = spare.take().filter(|_| !resized).map_or_else(|| allocate(gpu, sh_degree, capacity), Ok)?;
            gathering.gather(gpu, by, buffer, &to);
            *spare = Some(std::mem::replace(buffer, to));
        }
        let Gathering { changes, kept, children, of_children, .. } = gathering;
        if children > 0 {
            let bindings = [(0, uniforms.of(of_children)), (1, &changes), (2, &*parameters), (3, &*averages), (4, &*histories)];
            dispatch(gpu, &kernels.divide, &bindings, children, INVOCATIONS);
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
