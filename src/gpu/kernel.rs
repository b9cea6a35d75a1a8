//! One compute pipeline with its bindings, which are read from the shader itself.

use std::sync::{Arc, Mutex, PoisonError, Weak};

use super::{Gpu, GpuBuffer};

/// Bind groups that a kernel keeps for the next dispatch over the same buffers.
const KEPT: usize = 64;

/// A compiled entry point.
#[derive(Debug)]
pub struct Kernel {
    pipeline: wgpu::ComputePipeline,
    layout: wgpu::BindGroupLayout,
    label: &'static str,
    groups: Mutex<Vec<Group>>,
}

/// A bind group, and what it was made of.
#[derive(Debug)]
struct Group {
    made_of: Vec<(u32, Weak<()>)>,
    group: wgpu::BindGroup,
}

impl Group {
    fn is_of(&self, bindings: &[(u32, &GpuBuffer)]) -> bool {
        let same = |((binding, identity), (other, buffer)): (&(u32, Weak<()>), &(u32, &GpuBuffer))| {
            binding == other && identity.as_ptr() == Arc::as_ptr(buffer.identity())
        };
        self.made_of.len() == bindings.len() && self.made_of.iter().zip(bindings).all(same)
    }

    fn is_alive(&self) -> bool {
        self.made_of.iter().all(|(_, identity)| identity.strong_count() > 0)
    }
}

/// Dispatch size for `count` workgroups: beyond 65,535 they continue in a second dimension (`linear_workgroup` in the shaders).
pub fn workgroups(count: u32) -> [u32; 3] {
    const MAX_PER_DIMENSION: u32 = 65_535;
    [count.min(MAX_PER_DIMENSION), count.div_ceil(MAX_PER_DIMENSION).max(1), 1]
}

/// A number of workgroups along x, y and z, three u32 in a buffer.
#[derive(Clone, Copy)]
pub struct IndirectSize<'a> {
    /// The buffer.
    pub buffer: &'a GpuBuffer,
    /// Bytes from the buffer's start.
    pub offset: u64,
}

impl Kernel {
    /// Compiles `entry_point` of a WGSL `source`.
    pub fn new(gpu: &Gpu, label: &'static str, entry_point: &str, source: &str) -> Self {
        let descriptor = wgpu::ShaderModuleDescriptor { label: Some(label), source: wgpu::ShaderSource::Wgsl(source.into()) };
        // SAFETY: the sources are ours, every loop ends, and every index is bounded by the lengths that size the buffers. Checks cost
        // about a third of a training step on the software adapter.
        let module = unsafe { gpu.device.create_shader_module_trusted(descriptor, wgpu::ShaderRuntimeChecks::unchecked()) };
        let pipeline = gpu.device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
            label: Some(label),
            layout: None,
            module: &module,
            entry_point: Some(entry_point),
            compilation_options: wgpu::PipelineCompilationOptions {
                // Shaders clear what has to start from zero: on Metal and DX12 one invocation would clear all of it.
                zero_initialize_workgroup_memory: false,
                ..Default::default()
            },
            cache: None,
        });
        let layout = pipeline.get_bind_group_layout(0);
        Self { pipeline, layout, label, groups: Mutex::default() }
    }

    /// The bind group over these buffers, made anew only where it is not at hand: making one costs more than a dispatch.
    fn bind(&self, gpu: &Gpu, bindings: &[(u32, &GpuBuffer)]) -> wgpu::BindGroup {
        let mut groups = self.groups.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(found) = groups.iter().find(|group| group.is_of(bindings)) {
            return found.group.clone();
        }
        // Buffers that were replaced by larger ones must not be kept.
        groups.retain(Group::is_alive);
        if groups.len() == KEPT {
            groups.remove(0);
        }
        let entries: Vec<wgpu::BindGroupEntry> = bindings
            .iter()
            .map(|(binding, buffer)| wgpu::BindGroupEntry { binding: *binding, resource: buffer.binding() })
            .collect();
        let descriptor = wgpu::BindGroupDescriptor { label: Some(self.label), layout: &self.layout, entries: &entries };
        let group = gpu.device.create_bind_group(&descriptor);
        let made_of = bindings.iter().map(|(binding, buffer)| (*binding, Arc::downgrade(buffer.identity()))).collect();
        groups.push(Group { made_of, group: group.clone() });
        group
    }

    /// Runs with a size known on the host.
    pub fn dispatch(&self, gpu: &Gpu, pass: &mut wgpu::ComputePass<'_>, bindings: &[(u32, &GpuBuffer)], size: [u32; 3]) {
        pass.set_pipeline(&self.pipeline);
        pass.set_bind_group(0, &self.bind(gpu, bindings), &[]);
        gpu.mark(pass, self.label);
        gpu.traffic.dispatched();
        pass.dispatch_workgroups(size[0], size[1], size[2]);
    }

    /// Runs with a size that the GPU has computed.
    pub fn dispatch_indirect(
        &self,
        gpu: &Gpu,
        pass: &mut wgpu::ComputePass<'_>,
        bindings: &[(u32, &GpuBuffer)],
        size: IndirectSize<'_>,
    ) {
        pass.set_pipeline(&self.pipeline);
        pass.set_bind_group(0, &self.bind(gpu, bindings), &[]);
        gpu.mark(pass, self.label);
        gpu.traffic.dispatched();
        pass.dispatch_workgroups_indirect(size.buffer.raw(), size.offset);
    }
}
