//! The cells of a streamed map: a k-d tree whose leaves hold a bounded number of Gaussians. Viewers choose a level for each leaf.

use glam::Vec3;

/// Gaussians in a leaf, at most.
pub(super) const MOST_IN_CELL: usize = 4096;

/// A tree over leaves that are numbered from left to right.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Tree {
    /// A leaf's number.
    Leaf(usize),
    Branch(Box<[Tree; 2]>),
}

/// Halves the points at the median of the axis along which they spread most, until no part has more than `most`. Returns the tree and the points of each
/// leaf, in the order of space.
pub(super) fn divide(means: &[Vec3], most: usize) -> (Tree, Vec<Vec<usize>>) {
    let mut leaves = Vec::new();
    let tree = part(means, (0..means.len()).collect(), most, &mut leaves);
    (tree, leaves)
}

fn part(means: &[Vec3], mut inside: Vec<usize>, most: usize, leaves: &mut Vec<Vec<usize>>) -> Tree {
    if inside.len() <= most {
        inside.sort_unstable();
        leaves.push(inside);
        return Tree::Leaf(leaves.len() - 1);
    }
    let axis = widest(means, &inside);
    let middle = inside.len() / 2;
    inside.select_nth_unstable_by(middle, |a, b| means[*a][axis].total_cmp(&means[*b][axis]).then(a.cmp(b)));
    let above = inside.split_off(middle);
    Tree::Branch(Box::new([part(means, inside, most, leaves), part(means, above, most, leaves)]))
}

/// The axis of the largest variance; of equal ones, the first.
fn widest(means: &[Vec3], inside: &[usize]) -> usize {
    let points = || inside.iter().map(|i| means[*i].as_dvec3());
    let centre = points().sum::<glam::DVec3>() / inside.len().max(1) as f64;
    let spread = points().map(|point| (point - centre) * (point - centre)).sum::<glam::DVec3>();
    (0..3).max_by(|&a, &b| spread[a].total_cmp(&spread[b]).then(b.cmp(&a))).unwrap_or(0)
}
