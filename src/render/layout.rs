//! What host and shaders must agree on: constants (this file is their one source) and the layouts of shared structs.

mod twins;

use nalgebra::Vector3;
use serde::Serialize;

use crate::gpu::{Gpu, workgroups};
use crate::splat::model::*;

pub use twins::*;

/// A tile is 16×8 pixels. On the software adapter 16×16 takes twice as long to blend: small Gaussians leave most of it untouched.
pub const TILE_WIDTH: u32 = 16;
/// Height of a tile, pixels.
pub const TILE_HEIGHT: u32 = 8;
/// The wide form's blending passes divide a tile into sub-tiles of 8×4 pixels.
pub const SUBTILE_WIDTH: u32 = 8;
/// Height of a sub-tile, pixels.
pub const SUBTILE_HEIGHT: u32 = 4;
/// Strips of 4×1 pixels that an invocation of the narrow form's blending passes takes.
pub const STRIPS: u32 = TILE_HEIGHT;
/// Tiles that a workgroup of these passes takes.
pub const GROUP_TILES: u32 = 2;
/// Parts of the list of tiles from which successive workgroups of the blending passes take in turn.
pub const LIST_PARTS: u32 = 16;
/// Keys that one workgroup sorts.
pub const SORT_BLOCK: u32 = 1024;
/// Blocks whose digit counts one workgroup scans.
pub const SORT_CHUNK: u32 = 64;
/// Gaussians of a tile's list that one workgroup takes in the wide form's backward pass: a multiple of what the blending passes load at a time.
pub const BUCKET: u32 = 96;
/// Counters in the counter buffer.
pub const VISIBLE_COUNTER: u32 = 0;
/// Counter of tile intersections.
pub const INTERSECTION_COUNTER: u32 = 1;
/// Number of counters.
pub const COUNTERS: u32 = 2;

/// Brightness of a surveyed cell in steps: 14 bits for 0 to 2.
pub const BRIGHTNESS_STEP: f32 = 2.0 / BRIGHTNESS_MASK as f32;
/// See [`BRIGHTNESS_STEP`].
pub const BRIGHTNESS_MASK: u32 = (1 << 14) - 1;
/// Bit of a surveyed cell: the map lacks what its first pixel shows.
pub const LACKS_CORNER: u32 = 1 << 14;
/// The same of the pixel in its middle.
pub const LACKS_CENTER: u32 = 1 << 15;
/// Verdict of density control on a Gaussian: it stays as it is.
pub const VERDICT_KEEP: u32 = 0;
/// It goes.
pub const VERDICT_REMOVE: u32 = 1;
/// Two smaller ones may take its place.
pub const VERDICT_SPLIT: u32 = 2;
/// Two of its size may take its place.
pub const VERDICT_CLONE: u32 = 3;
/// Bit of a verdict: a view has blended the Gaussian.
pub const SEEN: u32 = 4;
/// Bit of a verdict: it is among the faint ones, of which half go.
pub const FAINT: u32 = 8;
/// Bits of a verdict; the others are those of its score.
pub const VERDICT_BITS: u32 = 15;
/// Bit of a parent in a list of changes: its children are of its own size.
pub const DIVIDED_BY_CLONING: u32 = 1 << 31;

/// Planes of vec4 that precede the higher harmonics: (position, raw opacity), (log scale, sampling interval), rotation (w, x, y, z), (constant colour, -).
pub const GEOMETRY_PLANES: usize = 3;

/// Pixel of a keyframe that shows what is away: of no colour, and no alpha.
pub const HIDDEN: u32 = 1;
/// What stands for the gradient by a hidden pixel's depth.
pub const HIDDEN_GRADIENT: f64 = 1e14;
/// The gradient by a depth is below this, and that of a Gaussian that is blended into a hidden pixel above.
pub const MOST_GRADIENT: f64 = 1e6;
const _: () = assert!(HIDDEN_GRADIENT * ALPHA_MIN * TRANSMITTANCE_MIN > 10.0 * MOST_GRADIENT);

/// How a tile's pixels are spread over invocations. Both forms give the same result up to rounding; each is the faster one on its kind
/// of adapter.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum BlendForm {
    /// Single pixels of 8×4 sub-tiles; a Gaussian passes over the sub-tiles that it does not reach. The backward pass takes a tile's list in buckets. For GPUs.
    #[default]
    Wide,
    /// A block of 4×8 pixels each, four invocations a tile, two tiles a workgroup: every load from memory serves 32 pixels, and a Gaussian's gradient is summed
    /// over four invocations only. For software adapters, where loads and stores are what costs.
    Narrow,
}

impl BlendForm {
    /// Both forms.
    pub const ALL: [Self; 2] = [Self::Wide, Self::Narrow];

    /// The faster form on this adapter. SwiftShader, though software, takes the wide one: the narrow one
    /// takes its compiler 24 GB.
    pub fn of(gpu: &Gpu) -> Self {
        let is_swiftshader = gpu.adapter.name.to_lowercase().contains("swiftshader");
        if gpu.is_software() && !is_swiftshader { Self::Narrow } else { Self::Wide }
    }

    /// Name of the stage that blends forward in this form.
    pub fn forward_stage(self) -> &'static str {
        match self {
            Self::Wide => "rasterize_forward_wide",
            Self::Narrow => "rasterize_forward_narrow",
        }
    }

    /// Name of the stage that blends backward in this form.
    pub fn backward_stage(self) -> &'static str {
        match self {
            Self::Wide => "rasterize_backward_wide",
            Self::Narrow => "rasterize_backward_narrow",
        }
    }

    /// Name of the stage that lists tiles in this form.
    pub fn lists_stage(self) -> &'static str {
        match self {
            Self::Wide => "tile_lists_wide",
            Self::Narrow => "tile_lists_narrow",
        }
    }

    /// Intersections of a Gaussian that are summed before its own turn comes. Where lanes are few, one Gaussian's many intersections keep
    /// few others waiting, and a pass of its own costs more.
    pub(crate) fn slot_chunk(self) -> u32 {
        match self {
            // `sum_slots` has 64 invocations for each block of the sort, whose dispatch it shares.
            Self::Wide => SORT_BLOCK / 64,
            Self::Narrow => 1,
        }
    }

    /// Workgroups of a blending pass over so many tiles.
    pub fn workgroups(self, tiles: u32) -> [u32; 3] {
        match self {
            Self::Wide => workgroups(tiles),
            Self::Narrow => workgroups(tiles.div_ceil(GROUP_TILES).next_multiple_of(LIST_PARTS)),
        }
    }
}

/// What the blending passes are compiled for.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Blending {
    /// How a tile's pixels are spread over invocations.
    pub form: BlendForm,
    /// Where along a ray a Gaussian lies.
    pub surface: Surface,
}

impl From<BlendForm> for Blending {
    fn from(form: BlendForm) -> Self {
        Self { form, ..Self::default() }
    }
}

impl Blending {
    /// All forms of all surfaces.
    pub fn all() -> impl Iterator<Item = Self> {
        [Surface::Volume, Surface::Planar].into_iter().flat_map(|surface| BlendForm::ALL.map(|form| Self { form, surface }))
    }

    /// The faster form on this adapter, of a surface.
    pub fn of(gpu: &Gpu, surface: Surface) -> Self {
        Self { form: BlendForm::of(gpu), surface }
    }

    /// Whether the surface is planar.
    pub fn is_planar(self) -> bool {
        self.surface == Surface::Planar
    }

    /// Vectors of a projected Gaussian.
    pub(crate) fn projected(self) -> u32 {
        match self.surface {
            Surface::Volume => 3,
            Surface::Planar => 4,
        }
    }

    /// Vectors of a rendered pixel.
    pub(crate) fn image_planes(self) -> u32 {
        self.projected() - 2
    }

    /// Vectors of four pixels' state in a checkpoint.
    fn checkpoint(self) -> u32 {
        match self.surface {
            Surface::Volume => 5,
            Surface::Planar => 8,
        }
    }

    /// Bytes of the forward pass' checkpoints for so many intersections: what a tile's pixels have blended.
    pub(crate) fn checkpoint_bytes(self, intersections: usize) -> u64 {
        let pixels = u64::from(TILE_WIDTH * TILE_HEIGHT);
        match self.form {
            BlendForm::Wide => (intersections as u64 / u64::from(BUCKET) + 1) * pixels * 4 * u64::from(self.checkpoint()),
            BlendForm::Narrow => 0,
        }
    }
}

/// The constants above as WGSL, put before every shader.
pub fn wgsl_constants(blending: Blending) -> String {
    let form = blending.form;
    let floats = [
        ("MOST_SLANT", MOST_SLANT),
        ("ALPHA_MIN", ALPHA_MIN),
        ("ALPHA_MAX", ALPHA_MAX),
        ("TRANSMITTANCE_MIN", TRANSMITTANCE_MIN),
        ("NEAR_METRES", NEAR_METRES),
        ("FAR_METRES", FAR_METRES),
        ("DILATION", DILATION),
        ("ANTIALIASED_DILATION", ANTIALIASED_DILATION),
        ("SMOOTHING", SMOOTHING),
        ("LEAST_UNDILUTED", LEAST_UNDILUTED),
        ("MIN_DETERMINANT", MIN_DETERMINANT),
        ("BRIGHTNESS_STEP", f64::from(BRIGHTNESS_STEP)),
        ("HIDDEN_GRADIENT", HIDDEN_GRADIENT),
        ("MOST_GRADIENT", MOST_GRADIENT),
        ("MIN_QUATERNION_NORM_SQUARED", MIN_QUATERNION_NORM_SQUARED),
    ];
    let integers = [
        ("TILE_WIDTH", TILE_WIDTH),
        ("TILE_HEIGHT", TILE_HEIGHT),
        ("SUBTILE_WIDTH", SUBTILE_WIDTH),
        ("SUBTILE_HEIGHT", SUBTILE_HEIGHT),
        ("STRIPS", STRIPS),
        ("PROJECTED", blending.projected()),
        ("IMAGE_PLANES", blending.image_planes()),
        ("CHECKPOINT", blending.checkpoint()),
        ("GROUP_TILES", GROUP_TILES),
        ("LIST_PARTS", LIST_PARTS),
        ("SORT_BLOCK", SORT_BLOCK),
        ("DEPTH_KEY_STEP", DEPTH_KEY_STEP),
        ("SORT_CHUNK", SORT_CHUNK),
        ("BUCKET", BUCKET),
        ("HIDDEN", HIDDEN),
        ("SLOT_CHUNK", form.slot_chunk()),
        ("VISIBLE_COUNTER", VISIBLE_COUNTER),
        ("INTERSECTION_COUNTER", INTERSECTION_COUNTER),
        ("BRIGHTNESS_MASK", BRIGHTNESS_MASK),
        ("LACKS_CORNER", LACKS_CORNER),
        ("LACKS_CENTER", LACKS_CENTER),
        ("VERDICT_KEEP", VERDICT_KEEP),
        ("VERDICT_REMOVE", VERDICT_REMOVE),
        ("VERDICT_SPLIT", VERDICT_SPLIT),
        ("VERDICT_CLONE", VERDICT_CLONE),
        ("SEEN", SEEN),
        ("FAINT", FAINT),
        ("VERDICT_BITS", VERDICT_BITS),
        ("DIVIDED_BY_CLONING", DIVIDED_BY_CLONING),
    ];
    let floats = floats.iter().map(|(name, value)| format!("const {name}: f32 = {value:e};\n"));
    let integers = integers.iter().map(|(name, value)| format!("const {name}: u32 = {value}u;\n"));
    floats.chain(integers).collect()
}

impl View {
    /// The view's constants; what depends on the map is filled in when it is rendered.
    pub fn new(camera: &ViewCamera, background: [f32; 3]) -> Self {
        let p = &camera.pinhole;
        let rotation = camera.camera_from_world.rotation.to_rotation_matrix();
        let translation = camera.camera_from_world.translation.vector;
        let center: Vector3<f64> = -(rotation.inverse() * translation);
        let row = |r: usize| [rotation[(r, 0)] as f32, rotation[(r, 1)] as f32, rotation[(r, 2)] as f32, translation[r] as f32];
        Self {
            camera_row_0: row(0),
            camera_row_1: row(1),
            camera_row_2: row(2),
            center_in_world: [center.x as f32, center.y as f32, center.z as f32, 0.0],
            intrinsics: [p.fx as f32, p.fy as f32, p.cx as f32, p.cy as f32],
            tangent_bounds: tangent_bounds(p).map(|v| v as f32),
            background: [background[0], background[1], background[2], 0.0],
            width: p.width,
            height: p.height,
            tiles_x: p.width.div_ceil(TILE_WIDTH),
            tiles_y: p.height.div_ceil(TILE_HEIGHT),
            gaussian_count: 0,
            capacity: 0,
            sh_degree: 0,
            intersection_capacity: 0,
            antialiased: 0.0,
            dropped_below: 0,
            dropout_seed: 0,
            opacity_gain: 1.0,
        }
    }

    /// The same with a dropout.
    pub fn with_dropout(self, Dropout { share, seed }: Dropout) -> Self {
        let dropped_below = (f64::from(share) * f64::from(u32::MAX)) as u32;
        Self { dropped_below, dropout_seed: seed, opacity_gain: 1.0 / (1.0 - share), ..self }
    }

    /// Tiles of the image.
    pub fn tiles(&self) -> u32 {
        self.tiles_x * self.tiles_y
    }

    /// Pixels of the image.
    pub fn pixels(&self) -> u32 {
        self.width * self.height
    }
}

impl Counter {
    const SIZE: u64 = std::mem::size_of::<Self>() as u64;

    /// Byte offset of a counter's indirect arguments with one invocation an element.
    pub const fn per_element_offset(counter: u32) -> u64 {
        counter as u64 * Self::SIZE + 8
    }

    /// Byte offset of a counter's indirect arguments with one workgroup per sort block.
    pub const fn per_block_offset(counter: u32) -> u64 {
        counter as u64 * Self::SIZE + 20
    }

    /// Byte offset of a counter's indirect arguments with one workgroup per bucket of a tile's list.
    pub const fn per_bucket_offset(counter: u32) -> u64 {
        counter as u64 * Self::SIZE + 32
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn indirect_offsets_point_into_the_struct() {
        assert_eq!(std::mem::offset_of!(Counter, per_element) as u64, Counter::per_element_offset(0));
        let size = std::mem::size_of::<Counter>() as u64;
        assert_eq!(std::mem::offset_of!(Counter, per_block) as u64 + size, Counter::per_block_offset(1));
        assert_eq!(std::mem::offset_of!(Counter, per_bucket) as u64 + size, Counter::per_bucket_offset(1));
    }
}
