//! Uniforms of a whole submission in one buffer: written on the host while commands are encoded, uploaded at once.

use bytemuck::Pod;

use super::{Gpu, GpuBuffer, GpuError};

/// Bytes between two uniforms: the least alignment of their bindings that every adapter has.
const CELL_BYTES: usize = 256;
/// Uniforms that a submission may have.
const CELLS: usize = 96;

/// A uniform of the present submission.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct UniformCell(usize);

/// The buffer, and what it will hold. A submission that puts the same uniforms in the same order binds the same cells again.
#[derive(Debug)]
pub struct Uniforms {
    buffer: GpuBuffer,
    cells: Vec<GpuBuffer>,
    bytes: Vec<u8>,
}

impl Uniforms {
    /// Room for the uniforms of one submission.
    ///
    /// # Errors
    /// [`GpuError`] if the buffer does not fit.
    pub fn new(gpu: &Gpu) -> Result<Self, GpuError> {
        let buffer = GpuBuffer::computed_uniform(gpu, "uniforms", (CELL_BYTES * CELLS) as u64)?;
        let cells = (0..CELLS).map(|cell| buffer.window((cell * CELL_BYTES) as u64, CELL_BYTES as u64)).collect();
        Ok(Self { buffer, cells, bytes: Vec::with_capacity(CELL_BYTES * CELLS) })
    }

    /// Forgets what a submission that failed has left.
    pub fn begin(&mut self) {
        self.bytes.clear();
    }

    /// Adds a uniform.
    pub fn put<T: Pod>(&mut self, value: &T) -> UniformCell {
        let cell = self.bytes.len() / CELL_BYTES;
        assert!(std::mem::size_of::<T>() <= CELL_BYTES && cell < CELLS, "a submission's uniforms fit");
        self.bytes.extend_from_slice(bytemuck::bytes_of(value));
        self.bytes.resize((cell + 1) * CELL_BYTES, 0);
        UniformCell(cell)
    }

    /// The buffer to bind a uniform by.
    pub fn of(&self, UniformCell(cell): UniformCell) -> &GpuBuffer {
        &self.cells[cell]
    }

    /// Uploads all, to take effect before the next submission.
    pub fn upload(&self, gpu: &Gpu) {
        self.buffer.write(gpu, 0, &self.bytes);
    }
}
