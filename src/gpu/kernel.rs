//! One compute pipeline with its bindings, which are read from the shader itself.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, OnceLock, PoisonError, Weak};

use super::{Gpu, GpuBuffer};

/// Bind groups that a kernel keeps for the next dispatch over the same buffers.
const KEPT: usize = 64;

/// An entry point, which is compiled in the background: drivers take tenths of a second for each, and many can be compiled side by side.
#[derive(Debug)]
pub struct Kernel {
    compilation: Arc<Compilation>,
    label: &'static str,
    groups: Mutex<Vec<Group>>,
}

/// What to compile, and the result once somebody has.
#[derive(Debug)]
struct Compilation {
    device: wgpu::Device,
    label: &'static str,
    entry_point: String,
    source: String,
    has_begun: AtomicBool,
    compiled: OnceLock<Compiled>,
}

#[derive(Debug)]
struct Compiled {
    pipeline: wgpu::ComputePipeline,
    layout: wgpu::BindGroupLayout,
}

/// Threads of their own: in the pool of everybody else, the first frames would wait behind all shaders. None where the system gives no threads.
fn compilers() -> Option<&'static rayon::ThreadPool> {
    const MOST: usize = 8;
    static POOL: OnceLock<Option<rayon::ThreadPool>> = OnceLock::new();
    let new = || {
        let threads = rayon::current_num_threads().div_ceil(2).min(MOST);
        let named = rayon::ThreadPoolBuilder::new().num_threads(threads).thread_name(|_| "compiling".into());
        // A panic comes again where the kernel is used first, and is reported from there.
        named.panic_handler(|_| ()).build().ok()
    };
    POOL.get_or_init(new).as_ref()
}

impl Compilation {
    fn result(&self) -> &Compiled {
        self.has_begun.store(true, Ordering::Relaxed);
        self.compiled.get_or_init(|| self.compile())
    }

    fn compile(&self) -> Compiled {
        let label = Some(self.label);
        let descriptor = wgpu::ShaderModuleDescriptor { label, source: wgpu::ShaderSource::Wgsl(self.source.as_str().into()) };
        // SAFETY: the sources are ours, every loop ends, and every index is bounded by the lengths that size the buffers. Checks cost
        // about a third of a training step on the software adapter.
        let module = unsafe { self.device.create_shader_module_trusted(descriptor, wgpu::ShaderRuntimeChecks::unchecked()) };
        let pipeline = self.device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
            label,
            layout: None,
            module: &module,
            entry_point: Some(&self.entry_point),
            compilation_options: wgpu::PipelineCompilationOptions {
                // Shaders clear what has to start from zero: on Metal and DX12 one invocation would clear all of it.
                zero_initialize_workgroup_memory: false,
                ..Default::default()
            },
            cache: None,
        });
        let layout = pipeline.get_bind_group_layout(0);
        Compiled { pipeline, layout }
    }
}

impl Drop for Kernel {
    /// A compilation that has not begun never will, and one that has is waited for: a driver must not be compiling when the program ends.
    fn drop(&mut self) {
        if self.compilation.has_begun.swap(true, Ordering::Relaxed) {
            self.compilation.result();
        }
    }
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
    /// `entry_point` of a WGSL `source`. What does not compile is an error of the device from its first use on (see [`Gpu::check`]).
    pub fn new(gpu: &Gpu, label: &'static str, entry_point: &str, source: &str) -> Self {
        let compilation = Arc::new(Compilation {
            device: gpu.device.clone(),
            label,
            entry_point: entry_point.into(),
            source: source.into(),
            has_begun: AtomicBool::new(false),
            compiled: OnceLock::new(),
        });
        let in_background = Arc::downgrade(&compilation);
        let compile = move || {
            if let Some(compilation) = in_background.upgrade()
                && !compilation.has_begun.swap(true, Ordering::Relaxed)
            {
                compilation.result();
            }
        };
        match compilers() {
            Some(pool) => pool.spawn(compile),
            None => compile(),
        }
        Self { compilation, label, groups: Mutex::default() }
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
        let descriptor =
            wgpu::BindGroupDescriptor { label: Some(self.label), layout: &self.compilation.result().layout, entries: &entries };
        let group = gpu.device.create_bind_group(&descriptor);
        let made_of = bindings.iter().map(|(binding, buffer)| (*binding, Arc::downgrade(buffer.identity()))).collect();
        groups.push(Group { made_of, group: group.clone() });
        group
    }

    /// Runs with a size known on the host.
    pub fn dispatch(&self, gpu: &Gpu, pass: &mut wgpu::ComputePass<'_>, bindings: &[(u32, &GpuBuffer)], size: [u32; 3]) {
        pass.set_pipeline(&self.compilation.result().pipeline);
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
        pass.set_pipeline(&self.compilation.result().pipeline);
        pass.set_bind_group(0, &self.bind(gpu, bindings), &[]);
        gpu.mark(pass, self.label);
        gpu.traffic.dispatched();
        pass.dispatch_workgroups_indirect(size.buffer.raw(), size.offset);
    }
}
