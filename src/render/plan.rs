//! A change of the set of Gaussians.

use super::layout::DIVIDED_BY_CLONING;

/// Two Gaussians in place of one, see `shaders/divide.wgsl`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Division {
    /// Two smaller ones.
    Split,
    /// Two of its size.
    Clone,
}

/// A change of the set of Gaussians; indices are those before it.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Plan {
    /// Gaussians that go, those that are divided included, ascending.
    pub removed: Vec<u32>,
    /// Gaussians that are divided; their children come behind all others, in this order, two each.
    pub divided: Vec<(u32, Division)>,
}

impl Plan {
    /// A plan that only removes.
    pub fn removing(removed: Vec<u32>) -> Self {
        Self { removed, divided: Vec::new() }
    }

    /// Of `before` Gaussians, those that stay.
    pub fn kept(&self, before: usize) -> usize {
        before - self.removed.len()
    }

    /// Gaussians after the change of `before`.
    pub fn len_after(&self, before: usize) -> usize {
        self.kept(before) + 2 * self.divided.len()
    }

    /// Whether nothing changes.
    pub fn is_empty(&self) -> bool {
        self.removed.is_empty() && self.divided.is_empty()
    }

    /// The shaders' list: those that go, then the parents.
    pub(super) fn changes(&self) -> Vec<u32> {
        let parent = |(parent, division): &(u32, Division)| match division {
            Division::Split => *parent,
            Division::Clone => parent | DIVIDED_BY_CLONING,
        };
        self.removed.iter().copied().chain(self.divided.iter().map(parent)).collect()
    }
}
