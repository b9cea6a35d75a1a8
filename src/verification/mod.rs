//! What checks the rest: the f64 oracle of the rasterizer and the optimiser, the stress suite, simulated walks for the tracker. No production
//! module uses them.

pub mod reference;
pub mod stress;
pub mod walk;
