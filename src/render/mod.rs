//! The differentiable rasterizer's host side: projection, tile lists, sorting, blending, forward and backward.

mod cloud;
pub mod layout;
mod ordering;
mod plan;
mod rasterizer;
mod rendered;
pub(crate) mod shaders;
mod slabs;
mod sort;
mod workspace;

pub use cloud::{CloudPart, CloudState, Extent, GaussianHistory, GpuCloud, Motions};
pub use layout::{BlendForm, Blending, HIDDEN};
pub use plan::{Division, Plan};
pub use rasterizer::{PreparedView, Rasterizer, ViewCounts};
pub use rendered::Rendered;
pub use shaders::{SHADERS, ShaderSource};
pub use slabs::MapRenderer;
pub use workspace::Capacities;
