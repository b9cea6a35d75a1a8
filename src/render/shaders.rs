//! Every shader, composed of the constants, the shared parts it names, and its own file.

use super::layout::{self, Blending};
use crate::splat::model::Surface;

/// A composed shader, named as its stage.
pub struct ShaderSource {
    /// Name of the stage.
    pub name: &'static str,
    parts: &'static [&'static str],
    /// Entry points of the module.
    pub entry_points: &'static [&'static str],
}

impl ShaderSource {
    /// Whether a planar surface has a text of its own.
    pub fn depends_on_surface(&self) -> bool {
        self.parts.iter().any(|part| OF_SURFACES.iter().any(|mark| part.contains(mark)))
    }

    /// The whole WGSL text; only the projection and the blending passes depend on the blending.
    pub fn text(&self, blending: impl Into<Blending>) -> String {
        let blending = blending.into();
        let constants = layout::wgsl_constants(blending);
        let parts = std::iter::once(constants.as_str()).chain(self.parts.iter().copied());
        parts.map(|part| of_surface(part, blending.surface)).collect::<Vec<_>>().join("\n")
    }
}

/// Marks of text that differs between surfaces.
const OF_SURFACES: [&str; 4] = ["//# planar", "PROJECTED", "IMAGE_PLANES", "CHECKPOINT"];

/// Without the lines between `//# planar` and `//# end`, unless the surface is planar.
fn of_surface(text: &str, surface: Surface) -> String {
    let mut is_kept = true;
    let mut kept = String::with_capacity(text.len());
    for line in text.split_inclusive('\n') {
        match line.trim() {
            "//# planar" => is_kept = surface == Surface::Planar,
            "//# end" => is_kept = true,
            _ if is_kept => kept.push_str(line),
            _ => {}
        }
    }
    kept
}

const VIEW: &str = include_str!("../../shaders/shared/view.wgsl");
const COUNTERS: &str = include_str!("../../shaders/shared/counters.wgsl");
const PROJECTION: &str = include_str!("../../shaders/shared/projection.wgsl");
const HARMONICS: &str = include_str!("../../shaders/shared/spherical_harmonics.wgsl");
const DEPTH_KEY: &str = include_str!("../../shaders/shared/depth_key.wgsl");
const TILE: &str = include_str!("../../shaders/shared/tile.wgsl");
const TILE_BACKWARD: &str = include_str!("../../shaders/shared/tile_backward.wgsl");
const EXCLUSIVE_SUM: &str = include_str!("../../shaders/shared/exclusive_sum.wgsl");
const TILE_ROWS: &str = include_str!("../../shaders/shared/tile_rows.wgsl");
const TILE_SCORES: &str = include_str!("../../shaders/shared/tile_scores.wgsl");
const TILE_STRIPS: &str = include_str!("../../shaders/shared/tile_strips.wgsl");
const TILE_SUMS: &str = include_str!("../../shaders/shared/tile_sums.wgsl");
const PIXELS_NARROW: &str = include_str!("../../shaders/shared/pixels_narrow.wgsl");
const PIXELS_WIDE: &str = include_str!("../../shaders/shared/pixels_wide.wgsl");
const BLEND: &str = include_str!("../../shaders/shared/blend.wgsl");
const PIXEL_WINDOW: &str = include_str!("../../shaders/shared/pixel_window.wgsl");
const TARGET: &str = include_str!("../../shaders/shared/target.wgsl");
const DENSITY: &str = include_str!("../../shaders/shared/density.wgsl");
const SINK_GRADIENT: &str = include_str!("../../shaders/shared/sink_gradient.wgsl");
const SINK_ADAM: &str = include_str!("../../shaders/shared/sink_adam.wgsl");

macro_rules! shaders {
    ($($constant:ident = $name:literal, $file:literal, [$($part:ident),*], [$($entry:literal),*];)*) => {
        $(pub(crate) const $constant: ShaderSource = ShaderSource {
            name: $name,
            parts: &[$($part,)* include_str!(concat!("../../shaders/", $file, ".wgsl"))],
            entry_points: &[$($entry),*],
        };)*
        /// All shaders of the project.
        pub const SHADERS: &[ShaderSource] = &[$($constant),*];
    };
}

shaders! {
    PROJECT_FORWARD = "project_forward", "project_forward", [VIEW, PROJECTION, HARMONICS], ["main"];
    SCAN_BLOCKS = "scan_blocks", "scan_blocks", [VIEW, COUNTERS, EXCLUSIVE_SUM], ["main"];
    COMPACT_VISIBLE = "compact_visible", "compact_visible", [VIEW, COUNTERS, DEPTH_KEY], ["main"];
    SORT = "sort", "sort", [VIEW, COUNTERS], ["count_digits", "scan_digits", "scatter"];
    TILE_LISTS_NARROW = "tile_lists_narrow", "tile_lists_narrow", [VIEW, COUNTERS, EXCLUSIVE_SUM, TILE_ROWS], ["main"];
    TILE_LISTS_WIDE = "tile_lists_wide", "tile_lists_wide", [VIEW, COUNTERS, EXCLUSIVE_SUM, TILE_ROWS], ["main"];
    SORT_TILES = "sort_tiles", "sort_tiles", [VIEW, DEPTH_KEY], ["main"];
    TILE_RANGES = "tile_ranges", "tile_ranges", [VIEW, COUNTERS], ["main"];
    ORDER_TILES = "order_tiles", "order_tiles", [VIEW], ["main"];
    RASTERIZE_FORWARD_NARROW = "rasterize_forward_narrow", "rasterize_forward_narrow", [VIEW, TILE, PIXELS_NARROW, BLEND], ["main"];
    RASTERIZE_FORWARD_WIDE = "rasterize_forward_wide", "rasterize_forward_wide", [VIEW, TILE, PIXELS_WIDE, BLEND], ["main"];
    LOSS_FORWARD = "loss_forward", "loss_forward", [PIXEL_WINDOW, TARGET], ["main"];
    LOSS_BACKWARD = "loss_backward", "loss_backward", [PIXEL_WINDOW, TARGET], ["main"];
    SURFACE_LOSS = "surface_loss", "surface_loss", [VIEW], ["main"];
    LOSS_REDUCE = "loss_reduce", "loss_reduce", [COUNTERS], ["main"];
    RASTERIZE_BACKWARD_NARROW = "rasterize_backward_narrow", "rasterize_backward_narrow", [VIEW, TILE, PIXELS_NARROW, TILE_BACKWARD, TILE_STRIPS], ["main"];
    RASTERIZE_BACKWARD_WIDE = "rasterize_backward_wide", "rasterize_backward_wide", [VIEW, TILE, PIXELS_WIDE, TILE_BACKWARD, TILE_SUMS], ["main"];
    RASTERIZE_SCORES_NARROW = "rasterize_scores_narrow", "rasterize_scores_narrow", [VIEW, TILE, PIXELS_NARROW, TILE_BACKWARD, TILE_SCORES, TILE_STRIPS], ["main"];
    RASTERIZE_SCORES_WIDE = "rasterize_scores_wide", "rasterize_scores_wide", [VIEW, TILE, PIXELS_WIDE, TILE_BACKWARD, TILE_SCORES, TILE_SUMS], ["main"];
    GATHER_SCORES = "gather_scores", "gather_scores", [VIEW, COUNTERS], ["main"];
    SUM_SLOTS = "sum_slots", "sum_slots", [VIEW, COUNTERS], ["main"];
    PROJECT_BACKWARD = "project_backward", "project_backward", [VIEW, COUNTERS, PROJECTION, HARMONICS, SINK_GRADIENT], ["main"];
    PROJECT_BACKWARD_ADAM = "project_backward_adam", "project_backward", [VIEW, COUNTERS, PROJECTION, HARMONICS, SINK_ADAM], ["main"];
    RATES = "rates", "rates", [VIEW], ["copy_memory", "multiply_add"];
    SURVEY = "survey", "survey", [VIEW], ["main"];
    DENSITY_VERDICTS = "density_verdicts", "density_verdicts", [VIEW, DENSITY], ["main"];
    DENSITY_HISTORY = "density_history", "density_history", [VIEW, DENSITY], ["main"];
    GATHER = "gather", "gather", [VIEW], ["main"];
    DIVIDE = "divide", "divide", [VIEW], ["main"];
    APPEND = "append", "append", [VIEW], ["main"];
    FIX = "fix", "fix", [VIEW], ["main"];
    TRANSFORM = "transform", "transform", [VIEW], ["main"];
}
