//! The reduced camera system of bundle adjustment: a symmetric matrix of 6x6 blocks, of which only those of poses that have something in
//! common are there; sparse Cholesky by faer, sequential and hence repeatable.

use faer::prelude::Solve;
use faer::sparse::linalg::solvers::{Llt, SymbolicLlt};
use faer::sparse::{SparseColMatRef, SymbolicSparseColMat};
use faer::{Col, Side};
use nalgebra::Matrix6;

const ABSENT: u32 = u32::MAX;

/// Which blocks of the lower triangle are there, and the symbolic factorisation that follows: made once, used in every step.
#[derive(Debug)]
pub struct ReducedSystem {
    poses: usize,
    /// The place of block (row, column) at `row * poses + column`.
    places: Vec<u32>,
    blocks: usize,
    pattern: SymbolicSparseColMat<usize>,
    symbolic: SymbolicLlt<usize>,
}

impl ReducedSystem {
    /// For `poses` unknown poses and pairs of them that have something in common, in any order and as often as they like. `None` if faer
    /// cannot hold it.
    pub fn new(poses: usize, pairs: impl Iterator<Item = (usize, usize)>) -> Option<Self> {
        let mut places = vec![ABSENT; poses * poses];
        (0..poses).for_each(|k| places[k * poses + k] = 0);
        pairs.for_each(|(a, b)| places[a.max(b) * poses + a.min(b)] = 0);
        let mut blocks = 0;
        let (mut column_starts, mut rows) = (vec![0], Vec::new());
        for column in 0..poses {
            let below: Vec<usize> = (column..poses).filter(|row| places[row * poses + column] != ABSENT).collect();
            for row in &below {
                places[row * poses + column] = blocks;
                blocks += 1;
            }
            for j in 0..6 {
                rows.extend(below.iter().flat_map(|row| first_row(*row, column, j).map(move |i| 6 * row + i)));
                column_starts.push(rows.len());
            }
        }
        let pattern = SymbolicSparseColMat::new_checked(6 * poses, 6 * poses, column_starts, None, rows);
        let symbolic = SymbolicLlt::try_new(pattern.as_ref(), Side::Lower).ok()?;
        Some(Self { poses, places, blocks: blocks as usize, pattern, symbolic })
    }

    /// All blocks, zero.
    pub fn zeros(&self) -> Vec<Matrix6<f64>> {
        vec![Matrix6::zeros(); self.blocks]
    }

    /// Where the block of two poses is, `row >= column`.
    pub fn place(&self, row: usize, column: usize) -> usize {
        self.places[row * self.poses + column] as usize
    }

    /// The solution for a right side of 6 entries a pose; `None` if the matrix is not positive definite.
    pub fn solve(&self, blocks: &[Matrix6<f64>], right: &[f64]) -> Option<Vec<f64>> {
        let mut values = Vec::with_capacity(self.pattern.row_idx().len());
        for column in 0..self.poses {
            let below = (column..self.poses).filter(|row| self.places[row * self.poses + column] != ABSENT);
            let below: Vec<(usize, &Matrix6<f64>)> = below.map(|row| (row, &blocks[self.place(row, column)])).collect();
            for j in 0..6 {
                values.extend(below.iter().flat_map(|(row, block)| first_row(*row, column, j).map(|i| block[(i, j)])));
            }
        }
        let matrix = SparseColMatRef::new(self.pattern.as_ref(), &values);
        let factor = Llt::try_new_with_symbolic(self.symbolic.clone(), matrix, Side::Lower).ok()?;
        let solution = factor.solve(Col::from_fn(right.len(), |i| right[i]));
        let solution: Vec<f64> = solution.iter().copied().collect();
        solution.iter().all(|v| v.is_finite()).then_some(solution)
    }
}

/// Rows of a block's column `j` that lie in the lower triangle.
fn first_row(row: usize, column: usize, j: usize) -> std::ops::Range<usize> {
    if row == column { j..6 } else { 0..6 }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{DMatrix, DVector};

    #[test]
    fn sparse_blocks_solve_as_the_dense_matrix_does() {
        const POSES: usize = 9;
        let mut random = fastrand::Rng::with_seed(6);
        let pairs = [(1, 0), (2, 5), (5, 2), (8, 3), (7, 6), (4, 4), (8, 0)];
        let system = ReducedSystem::new(POSES, pairs.iter().copied()).unwrap();
        let mut blocks = system.zeros();
        assert_eq!(blocks.len(), POSES + 5);
        let mut dense = DMatrix::zeros(6 * POSES, 6 * POSES);
        for (a, b) in (0..POSES).map(|k| (k, k)).chain(pairs) {
            let (row, column) = (a.max(b), a.min(b));
            let half = Matrix6::from_fn(|_, _| random.f64() - 0.5);
            let block = if a == b { half + half.transpose() + Matrix6::identity() * 20.0 } else { half };
            blocks[system.place(row, column)] = block;
            dense.fixed_view_mut::<6, 6>(6 * row, 6 * column).copy_from(&block);
            dense.fixed_view_mut::<6, 6>(6 * column, 6 * row).copy_from(&block.transpose());
        }
        let right: Vec<f64> = (0..6 * POSES).map(|_| random.f64()).collect();
        let expected = dense.lu().solve(&DVector::from_vec(right.clone())).unwrap();
        let found = DVector::from_vec(system.solve(&blocks, &right).unwrap());
        assert!((found - expected).norm() < 1e-12);
        blocks[system.place(4, 4)] = -Matrix6::identity();
        assert!(system.solve(&blocks, &right).is_none());
    }
}
