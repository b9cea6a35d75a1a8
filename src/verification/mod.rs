//! Checks of the numerics: the f64 oracle of the rasterizer and the optimiser, and the stress suite. No production module uses them.

pub mod reference;
pub mod stress;
