//! The differentiable rasterizer's host side: projection, tile lists, sorting, blending, forward and backward.

mod cloud;
pub mod layout;
mod rasterizer;
pub(crate) mod shaders;
mod sort;
mod workspace;

pub(crate) use cloud::cloud_from_planes;
pub use cloud::{Child, CloudState, GaussianGeometry, GpuCloud, Plan};
pub use layout::BlendForm;
pub use rasterizer::{PreparedView, Rasterizer, Rendered, ViewCounts};
pub use shaders::{SHADERS, ShaderSource};
pub use workspace::Capacities;
