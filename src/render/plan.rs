//! Gaussians as the mapper sees them: their geometry, and a change of their set.

use glam::{Quat, Vec3};

/// One Gaussian without its colour: raw parameters, averaged over its recent steps.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GaussianGeometry {
    /// World, metres.
    pub mean: Vec3,
    /// Logit of the opacity.
    pub raw_opacity: f32,
    /// Natural logarithm of the standard deviations along the Gaussian's own axes, metres.
    pub log_scale: Vec3,
    /// World from Gaussian, not necessarily of unit length.
    pub rotation: Quat,
}

/// A new Gaussian: its parent with another position, opacity and scale.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Child {
    /// Index of the parent before the plan is applied.
    pub parent: u32,
    /// World, metres.
    pub mean: Vec3,
    /// Logit of the opacity.
    pub raw_opacity: f32,
    /// Natural logarithm of the standard deviations, metres.
    pub log_scale: Vec3,
}

/// A change of the set of Gaussians; indices are those before it.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Plan {
    /// Gaussians that stay, ascending.
    pub keep: Vec<u32>,
    /// Gaussians that are appended.
    pub children: Vec<Child>,
}

impl Plan {
    /// A plan that only removes.
    pub fn keeping(keep: Vec<u32>) -> Self {
        Self { keep, children: Vec::new() }
    }

    /// Gaussians after the change.
    pub fn len(&self) -> usize {
        self.keep.len() + self.children.len()
    }

    /// Whether no Gaussian is left.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The parent of each child.
    pub fn parents(&self) -> impl Iterator<Item = u32> + '_ {
        self.children.iter().map(|child| child.parent)
    }
}
