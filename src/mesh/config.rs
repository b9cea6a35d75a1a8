//! What decides a mesh beside its views.

use serde::{Deserialize, Serialize};

use super::MeshError;

/// Which depth is fused.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "lowercase")]
pub enum DepthSource {
    /// That of the map.
    Rendered,
    /// That of the recording's sensor.
    Measured,
    /// The sensor's, and the map's where the sensor has none.
    Both,
}

/// Largest side of a voxel, metres.
pub(super) const MOST_VOXEL_METRES: f64 = 10.0;

/// Settings of a mesh.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct MeshConfig {
    /// Side of a voxel, metres.
    pub voxel_metres: f64,
    /// Distances are truncated at so many voxels.
    pub truncation_voxels: f64,
    /// Two views agree where their depths differ by less than this share of the depth.
    pub tolerance: f64,
    /// Neighbouring views that each view is compared with; 0 compares none.
    pub neighbours: usize,
    /// Views that must have seen a voxel.
    pub min_views: u16,
    /// A connected component is kept if its area is at least this share of the largest one's; 1 keeps the largest alone, 0 keeps all.
    pub min_component_share: f64,
    /// Share of the triangles that simplification aims at.
    pub simplify: Option<f64>,
    /// Bound on the memory of views and voxels, bytes.
    pub max_memory_bytes: u64,
}

impl Default for MeshConfig {
    fn default() -> Self {
        Self {
            voxel_metres: 0.01,
            truncation_voxels: 4.0,
            tolerance: 0.02,
            neighbours: 8,
            min_views: 1,
            min_component_share: 0.001,
            simplify: None,
            max_memory_bytes: 4 << 30,
        }
    }
}

impl MeshConfig {
    /// Where distances are truncated, metres.
    pub fn truncation_metres(&self) -> f64 {
        self.truncation_voxels * self.voxel_metres
    }

    /// Checks the ranges.
    ///
    /// # Errors
    /// [`MeshError::Option`] with the option that is out of its range.
    pub fn validate(&self) -> Result<(), MeshError> {
        let within = |option, value: f64, (low, high): (f64, f64), advice| match (low..=high).contains(&value) {
            true => Ok(()),
            false => Err(MeshError::Option { option, value, advice }),
        };
        within("voxel", self.voxel_metres, (1e-4, MOST_VOXEL_METRES), "give a side from 0.0001 to 10 metres")?;
        within("truncation", self.truncation_voxels, (2.0, 32.0), "give 2 to 32 voxels")?;
        within("tolerance", self.tolerance, (1e-4, 1.0), "give a share from 0.0001 to 1")?;
        within("min-component", self.min_component_share, (0.0, 1.0), "give a share from 0 to 1")?;
        within("simplify", self.simplify.unwrap_or(1.0), (1e-4, 1.0), "give a share from 0.0001 to 1")
    }
}
