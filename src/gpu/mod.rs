//! The compute device: adapters, buffers, kernels, readback. No algorithm lives here.

mod buffer;
mod device;
mod kernel;
pub mod plain;
mod profile;

pub use buffer::GpuBuffer;
pub use device::{AdapterSummary, Gpu, GpuError, adapters};
pub use kernel::{IndirectSize, Kernel, workgroups};
