//! Adapter choice, device creation, and errors that surface asynchronously.

use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use serde::Serialize;
use wgpu::{Backends, InstanceDescriptor, InstanceFlags};

use super::memory::MemoryCount;
use super::profile::Profiler;
use super::traffic::Traffic;
use super::upload::UploadStaging;

/// Failure of the adapter, the device or an allocation on it.
#[derive(Debug, thiserror::Error)]
pub enum GpuError {
    /// The system has no adapter.
    #[error(
        "no GPU adapter was found; install a Vulkan driver, or Mesa's software one (`apt-get install mesa-vulkan-drivers libvulkan1`), and see what there is with `keysplat adapters`"
    )]
    NoAdapter,
    /// No adapter matches the wanted name.
    #[error("no adapter's name contains `{wanted}`; there are: {found}")]
    NoSuchAdapter {
        /// Part of a name.
        wanted: String,
        /// Names of the adapters there are.
        found: String,
    },
    /// The driver refuses a device.
    #[error("the adapter {adapter} gives no device: {source}")]
    Device {
        /// Name of the adapter.
        adapter: String,
        /// The cause.
        source: wgpu::RequestDeviceError,
    },
    /// A device limit is too low.
    #[error(
        "the device's limit `{limit}` is {offered}, but keysplat needs {needed}; request `Gpu::required_limits` of the adapter"
    )]
    MissingLimit {
        /// Name of the limit.
        limit: &'static str,
        /// Value needed.
        needed: u64,
        /// Value offered.
        offered: u64,
    },
    /// The adapter lacks a feature.
    #[error("the adapter lacks {0}, which keysplat needs")]
    MissingCapability(String),
    /// A buffer exceeds the adapter's binding size.
    #[error(
        "{label}: a buffer of {} MiB is needed, but the adapter binds at most {} MiB; lower the mapping resolution (--map-scale) or the number of Gaussians",
        needed.div_ceil(1 << 20), limit >> 20
    )]
    TooLarge {
        /// Name of the buffer.
        label: String,
        /// Bytes needed.
        needed: u64,
        /// Bytes that the adapter binds at most.
        limit: u64,
    },
    /// An allocation failed on the adapter.
    #[error("the GPU ran out of memory ({0}); lower the mapping resolution (--map-scale) or the number of Gaussians")]
    OutOfMemory(String),
    /// The device was lost, or a command failed.
    #[error("the GPU device failed: {0}")]
    Failed(String),
    /// Submitted work did not end in time.
    #[error(
        "the GPU has not finished its work within {} s and counts as hung; restart the machine or its graphics driver, or choose another adapter with --gpu",
        waited.as_secs()
    )]
    Hung {
        /// Time waited.
        waited: Duration,
    },
}

/// Identity of an adapter in metrics and lists.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct AdapterSummary {
    /// Name of the adapter.
    pub name: String,
    /// Graphics API: `vulkan`, `metal` or `dx12`.
    pub backend: String,
    /// `discrete`, `integrated`, `virtual`, `cpu` or `other`.
    pub kind: String,
    /// Name and version of the driver.
    pub driver: String,
}

impl From<wgpu::AdapterInfo> for AdapterSummary {
    fn from(info: wgpu::AdapterInfo) -> Self {
        let kind = match info.device_type {
            wgpu::DeviceType::DiscreteGpu => "discrete",
            wgpu::DeviceType::IntegratedGpu => "integrated",
            wgpu::DeviceType::VirtualGpu => "virtual",
            wgpu::DeviceType::Cpu => "cpu",
            wgpu::DeviceType::Other => "other",
        };
        Self {
            name: info.name,
            backend: format!("{:?}", info.backend).to_lowercase(),
            kind: kind.into(),
            driver: format!("{} {}", info.driver, info.driver_info).trim().into(),
        }
    }
}

/// A device with its queue, and what is known of it.
#[derive(Debug)]
pub struct Gpu {
    /// The wgpu device.
    pub device: wgpu::Device,
    /// The queue of the device.
    pub queue: wgpu::Queue,
    /// Identity of the adapter.
    pub adapter: AdapterSummary,
    pub(super) failure: Arc<Mutex<Option<Failure>>>,
    pub(super) memory: Arc<MemoryCount>,
    pub(super) traffic: Traffic,
    /// For the next readback.
    pub(super) staging: Mutex<Option<wgpu::Buffer>>,
    pub(super) upload_staging: UploadStaging,
    pub(super) profiler: Option<Profiler>,
}

#[derive(Debug)]
pub(super) enum Failure {
    OutOfMemory(String),
    Failed(String),
    Hung(Duration),
}

/// A batch of steps takes seconds even on a software adapter.
const MAX_WAIT: Duration = Duration::from_secs(600);

fn instance() -> wgpu::Instance {
    let mut descriptor = InstanceDescriptor::new_without_display_handle_from_env();
    // Our own kernels write the indirect arguments, within bounds; wgpu's check would cost a dispatch for each of ours.
    descriptor.flags.remove(InstanceFlags::VALIDATION_INDIRECT_CALL);
    wgpu::Instance::new(descriptor)
}

/// All adapters of this machine, fastest kind first.
fn sorted_adapters(instance: &wgpu::Instance) -> Vec<wgpu::Adapter> {
    let mut adapters = pollster::block_on(instance.enumerate_adapters(Backends::PRIMARY));
    adapters.sort_by_key(|adapter| match adapter.get_info().device_type {
        wgpu::DeviceType::DiscreteGpu => 0,
        wgpu::DeviceType::IntegratedGpu => 1,
        wgpu::DeviceType::VirtualGpu => 2,
        wgpu::DeviceType::Other => 3,
        wgpu::DeviceType::Cpu => 4,
    });
    adapters
}

/// Lists this machine's adapters, the one that would be chosen first.
pub fn adapters() -> Vec<AdapterSummary> {
    sorted_adapters(&instance()).iter().map(|adapter| adapter.get_info().into()).collect()
}

impl Gpu {
    /// Opens the fastest adapter, or the first whose name contains `wanted` (any case).
    ///
    /// # Errors
    /// [`GpuError`] if no such adapter exists or it gives no device.
    pub fn open(wanted: Option<&str>) -> Result<Arc<Self>, GpuError> {
        Self::open_with(wanted, wgpu::Features::empty(), u64::MAX)
    }

    /// Opens a device with timestamps where the adapter has them (see [`Self::take_profile`]).
    ///
    /// # Errors
    /// [`GpuError`] if no such adapter exists or it gives no device.
    pub fn open_profiled(wanted: Option<&str>) -> Result<Arc<Self>, GpuError> {
        Self::open_with(wanted, Profiler::FEATURES, u64::MAX)
    }

    /// Opens as [`Self::open`] with a smaller limit: no buffer may be larger than `bytes`.
    ///
    /// # Errors
    /// [`GpuError`] if no such adapter exists or it gives no device.
    pub fn open_small(wanted: Option<&str>, bytes: u64) -> Result<Arc<Self>, GpuError> {
        Self::open_with(wanted, wgpu::Features::empty(), bytes)
    }

    fn open_with(wanted: Option<&str>, wished: wgpu::Features, most: u64) -> Result<Arc<Self>, GpuError> {
        let mut adapters = sorted_adapters(&instance());
        if adapters.is_empty() {
            return Err(GpuError::NoAdapter);
        }
        let names: Vec<String> = adapters.iter().map(|a| a.get_info().name).collect();
        let index = match wanted {
            None => 0,
            Some(wanted) => names
                .iter()
                .position(|name| name.to_lowercase().contains(&wanted.to_lowercase()))
                .ok_or_else(|| GpuError::NoSuchAdapter { wanted: wanted.into(), found: names.join(", ") })?,
        };
        let adapter = adapters.swap_remove(index);
        let full = Self::required_limits(&adapter);
        let required_limits = wgpu::Limits {
            max_buffer_size: full.max_buffer_size.min(most),
            max_storage_buffer_binding_size: full.max_storage_buffer_binding_size.min(most),
            ..full
        };
        let required_features = wished & adapter.features();
        let descriptor =
            wgpu::DeviceDescriptor { label: Some("keysplat"), required_features, required_limits, ..Default::default() };
        let (device, queue) = pollster::block_on(adapter.request_device(&descriptor))
            .map_err(|source| GpuError::Device { adapter: names[index].clone(), source })?;
        Ok(Self::watched(&adapter, device, queue, required_features.contains(Profiler::FEATURES)))
    }

    /// Limits to request for a device that is passed to [`Self::from_device`]: WebGPU's defaults, and buffers as large as the adapter
    /// allows.
    pub fn required_limits(adapter: &wgpu::Adapter) -> wgpu::Limits {
        let offered = adapter.limits();
        wgpu::Limits {
            max_buffer_size: offered.max_buffer_size,
            max_storage_buffer_binding_size: offered.max_storage_buffer_binding_size,
            ..wgpu::Limits::default()
        }
    }

    /// A GPU on the device of the embedding program, which may go on using it and its queue.
    ///
    /// The device needs no features, and the limits of [`Self::required_limits`]; smaller buffers only limit the map. Its handlers of
    /// uncaptured errors and of loss are replaced: from then on these errors are returned as [`GpuError`]. Indirect dispatches are
    /// faster if the instance was created without `InstanceFlags::VALIDATION_INDIRECT_CALL`.
    ///
    /// # Errors
    /// [`GpuError::MissingLimit`] or [`GpuError::MissingCapability`] for the first thing that the device or its adapter lacks.
    pub fn from_device(adapter: &wgpu::Adapter, device: wgpu::Device, queue: wgpu::Queue) -> Result<Arc<Self>, GpuError> {
        let needed = wgpu::DownlevelFlags::COMPUTE_SHADERS | wgpu::DownlevelFlags::INDIRECT_EXECUTION;
        let missing = needed - adapter.get_downlevel_capabilities().flags;
        if !missing.is_empty() {
            return Err(GpuError::MissingCapability(format!("{missing:?}")));
        }
        check_limits(&device.limits())?;
        Ok(Self::watched(adapter, device, queue, false))
    }

    fn watched(adapter: &wgpu::Adapter, device: wgpu::Device, queue: wgpu::Queue, profiled: bool) -> Arc<Self> {
        let failure = Arc::new(Mutex::new(None));
        watch(&device, &failure);
        let profiler = profiled.then(|| Profiler::new(&device));
        Arc::new(Self {
            device,
            queue,
            adapter: adapter.get_info().into(),
            failure,
            memory: Arc::default(),
            traffic: Traffic::default(),
            staging: Mutex::default(),
            upload_staging: UploadStaging::default(),
            profiler,
        })
    }

    /// The largest storage buffer, bytes.
    pub fn max_storage_bytes(&self) -> u64 {
        let limits = self.device.limits();
        limits.max_storage_buffer_binding_size.min(limits.max_buffer_size)
    }

    /// Whether the adapter is a program on the CPU.
    pub fn is_software(&self) -> bool {
        self.adapter.kind == "cpu"
    }

    /// The first failure that the device reported since it was opened, if any.
    ///
    /// # Errors
    /// That failure.
    pub fn check(&self) -> Result<(), GpuError> {
        match &*self.failure.lock().unwrap_or_else(PoisonError::into_inner) {
            None => Ok(()),
            Some(Failure::Hung(waited)) => Err(GpuError::Hung { waited: *waited }),
            Some(Failure::OutOfMemory(what)) => Err(GpuError::OutOfMemory(what.clone())),
            Some(Failure::Failed(what)) => Err(GpuError::Failed(what.clone())),
        }
    }

    /// Waits until everything submitted is done, for ten minutes at most.
    ///
    /// # Errors
    /// [`GpuError`] if the device failed, or hangs.
    pub fn wait(&self) -> Result<(), GpuError> {
        self.wait_at_most(MAX_WAIT)
    }

    /// Waits until everything submitted is done. A GPU that exceeds `limit` has failed: from then on no call waits for it.
    ///
    /// # Errors
    /// [`GpuError`] if the device failed; [`GpuError::Hung`] if it exceeds `limit`.
    pub fn wait_at_most(&self, limit: Duration) -> Result<(), GpuError> {
        self.check()?;
        self.traffic.waited();
        match self.device.poll(wgpu::PollType::Wait { submission_index: None, timeout: Some(limit) }) {
            Ok(_) => {}
            Err(wgpu::PollError::Timeout) => note(&self.failure, Failure::Hung(limit)),
            Err(error) => return Err(GpuError::Failed(error.to_string())),
        }
        self.check()
    }
}

/// Checks what the shaders use of a device's limits against WebGPU's defaults, which they stay within.
fn check_limits(offered: &wgpu::Limits) -> Result<(), GpuError> {
    let needed = wgpu::Limits::default();
    let check = |limit, of: fn(&wgpu::Limits) -> u64| {
        let (needed, offered) = (of(&needed), of(offered));
        if offered >= needed { Ok(()) } else { Err(GpuError::MissingLimit { limit, needed, offered }) }
    };
    check("max_bindings_per_bind_group", |l| l.max_bindings_per_bind_group.into())?;
    check("max_storage_buffers_per_shader_stage", |l| l.max_storage_buffers_per_shader_stage.into())?;
    check("max_uniform_buffers_per_shader_stage", |l| l.max_uniform_buffers_per_shader_stage.into())?;
    check("max_uniform_buffer_binding_size", |l| l.max_uniform_buffer_binding_size)?;
    check("max_compute_workgroup_storage_size", |l| l.max_compute_workgroup_storage_size.into())?;
    check("max_compute_invocations_per_workgroup", |l| l.max_compute_invocations_per_workgroup.into())?;
    check("max_compute_workgroup_size_x", |l| l.max_compute_workgroup_size_x.into())?;
    check("max_compute_workgroups_per_dimension", |l| l.max_compute_workgroups_per_dimension.into())
}

fn watch(device: &wgpu::Device, failure: &Arc<Mutex<Option<Failure>>>) {
    let slot = failure.clone();
    device.on_uncaptured_error(Arc::new(move |error: wgpu::Error| {
        let found = match error {
            wgpu::Error::OutOfMemory { source } => Failure::OutOfMemory(source.to_string()),
            other => Failure::Failed(other.to_string()),
        };
        note(&slot, found);
    }));
    let slot = failure.clone();
    device.set_device_lost_callback(move |_, message| note(&slot, Failure::Failed(format!("device lost: {message}"))));
}

/// Keeps the first failure.
fn note(slot: &Mutex<Option<Failure>>, found: Failure) {
    slot.lock().unwrap_or_else(PoisonError::into_inner).get_or_insert(found);
}
