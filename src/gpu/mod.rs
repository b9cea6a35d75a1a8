//! The compute device: adapters, buffers, kernels, readback. No algorithm lives here.

mod buffer;
mod device;
mod kernel;
mod memory;
pub mod plain;
mod profile;
mod readback;
mod traffic;
mod uniforms;
mod upload;

pub use buffer::GpuBuffer;
pub use device::{AdapterSummary, Gpu, GpuError, adapters};
pub use kernel::{IndirectSize, Kernel, workgroups};
pub use readback::{Part, ReadBack};
pub use traffic::TrafficCount;
pub use uniforms::{UniformCell, Uniforms};
