//! What host and shaders must agree on: constants (this file is their one source) and the layouts of shared structs.

use bytemuck::{Pod, Zeroable};
use nalgebra::Vector3;
use serde::Serialize;

use crate::gpu::{Gpu, workgroups};
use crate::splat::model::*;

/// A tile is 16×8 pixels. On the software adapter 16×16 takes twice as long to blend: small Gaussians leave most of it untouched.
pub const TILE_WIDTH: u32 = 16;
/// Height of a tile, pixels.
pub const TILE_HEIGHT: u32 = 8;
/// Parts of the list of tiles from which successive workgroups of the blending passes take in turn.
pub const LIST_PARTS: u32 = 16;
/// Keys that one workgroup sorts.
pub const SORT_BLOCK: u32 = 1024;
/// Blocks whose digit counts one workgroup scans.
pub const SORT_CHUNK: u32 = 64;
/// Gaussians of a tile's list that one workgroup takes in the wide form's backward pass.
pub const BUCKET: u32 = 128;
/// Counters in the counter buffer.
pub const VISIBLE_COUNTER: u32 = 0;
/// Counter of tile intersections.
pub const INTERSECTION_COUNTER: u32 = 1;
/// Number of counters.
pub const COUNTERS: u32 = 2;

/// Planes of vec4 that precede the higher harmonics: (position, raw opacity), (log scale, -), rotation (w, x, y, z), (constant colour, -).
pub const GEOMETRY_PLANES: usize = 3;

/// How a tile's pixels are spread over invocations. Both forms give the same result up to rounding; each is the faster one on its kind
/// of adapter.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum BlendForm {
    /// A strip of 4×1 pixels each, 32 invocations a tile; the backward pass keeps a Gaussian per invocation. For GPUs.
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

    /// Strips of 4×1 pixels per invocation.
    fn strips(self) -> u32 {
        match self {
            Self::Wide => 1,
            Self::Narrow => 8,
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

    /// Bytes of the forward pass' checkpoints for so many intersections: colour, depth and transmittance of a tile's pixels each.
    pub(crate) fn checkpoint_bytes(self, intersections: usize) -> u64 {
        match self {
            Self::Wide => (intersections as u64 / u64::from(BUCKET) + 1) * u64::from(TILE_WIDTH * TILE_HEIGHT) * 20,
            Self::Narrow => 0,
        }
    }

    /// Tiles that a workgroup of a blending pass takes.
    fn group_tiles(self) -> u32 {
        match self {
            Self::Wide => 1,
            Self::Narrow => 2,
        }
    }

    /// Workgroups of a blending pass over so many tiles.
    pub fn workgroups(self, tiles: u32) -> [u32; 3] {
        match self {
            Self::Wide => workgroups(tiles),
            Self::Narrow => workgroups(tiles.div_ceil(self.group_tiles()).next_multiple_of(LIST_PARTS)),
        }
    }
}

/// The constants above as WGSL, put before every shader.
pub fn wgsl_constants(form: BlendForm) -> String {
    let floats = [
        ("ALPHA_MIN", ALPHA_MIN),
        ("ALPHA_MAX", ALPHA_MAX),
        ("TRANSMITTANCE_MIN", TRANSMITTANCE_MIN),
        ("NEAR_METRES", NEAR_METRES),
        ("FAR_METRES", FAR_METRES),
        ("DILATION", DILATION),
        ("MIN_DETERMINANT", MIN_DETERMINANT),
        ("MIN_QUATERNION_NORM_SQUARED", MIN_QUATERNION_NORM_SQUARED),
    ];
    let integers = [
        ("TILE_WIDTH", TILE_WIDTH),
        ("TILE_HEIGHT", TILE_HEIGHT),
        ("STRIPS", form.strips()),
        ("GROUP_TILES", form.group_tiles()),
        ("LIST_PARTS", LIST_PARTS),
        ("SORT_BLOCK", SORT_BLOCK),
        ("DEPTH_KEY_STEP", DEPTH_KEY_STEP),
        ("SORT_CHUNK", SORT_CHUNK),
        ("BUCKET", BUCKET),
        ("SLOT_CHUNK", form.slot_chunk()),
        ("VISIBLE_COUNTER", VISIBLE_COUNTER),
        ("INTERSECTION_COUNTER", INTERSECTION_COUNTER),
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
        }
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

/// Declares host twins of WGSL structs, and lists their layouts so that `tests/shaders.rs` can compare them with the shaders.
macro_rules! host_twins {
    ($($(#[$doc:meta])* $name:ident { $($(#[$field_doc:meta])* $field:ident: $type:ty,)* })*) => {
        $($(#[$doc])*
        #[repr(C)]
        #[derive(Clone, Copy, Debug, Pod, Zeroable)]
        pub struct $name { $($(#[$field_doc])* pub $field: $type,)* })*

        /// Layouts of all structs that host and shaders share: name, size, and the fields' offsets, all in bytes.
        pub fn struct_layouts() -> Vec<(&'static str, usize, Vec<(&'static str, usize)>)> {
            vec![
                $((stringify!($name), size_of::<$name>(), vec![$((stringify!($field), std::mem::offset_of!($name, $field))),*]),)*
            ]
        }
    };
}

host_twins! {
    /// One camera view of the map (`shaders/shared/view.wgsl`).
    View {
        /// First row of camera_from_world, rotation and translation.
        camera_row_0: [f32; 4],
        /// Second row.
        camera_row_1: [f32; 4],
        /// Third row.
        camera_row_2: [f32; 4],
        /// Camera centre, metres; the last lane is unused.
        center_in_world: [f32; 4],
        /// fx, fy, cx, cy, pixels.
        intrinsics: [f32; 4],
        /// Bounds of x/z and y/z within which the projection is linearised: least x, most x, least y, most y.
        tangent_bounds: [f32; 4],
        /// RGB behind the map; the last lane is unused.
        background: [f32; 4],
        /// Image width, pixels.
        width: u32,
        /// Image height, pixels.
        height: u32,
        /// Tiles in a row.
        tiles_x: u32,
        /// Rows of tiles.
        tiles_y: u32,
        /// Gaussians in the map.
        gaussian_count: u32,
        /// Gaussians that the planes have space for.
        capacity: u32,
        /// Degree of the spherical harmonics, 0 to 3.
        sh_degree: u32,
        /// Tile intersections that the buffers have space for.
        intersection_capacity: u32,
    }
    /// Counts made on the GPU, and the indirect dispatches that follow from them (`shaders/shared/counters.wgsl`).
    #[derive(Default)]
    Counter {
        /// Elements, at most the capacity.
        count: u32,
        /// Elements that there would be with enough capacity.
        needed: u32,
        /// Workgroups for one lane an element.
        per_element: [u32; 3],
        /// Workgroups for one sorting block a workgroup.
        per_block: [u32; 3],
        /// Workgroups for one bucket of a tile's list a workgroup.
        per_bucket: [u32; 3],
    }
    /// Which of the two prefix sums (`shaders/scan_blocks.wgsl`).
    ScanSetup {
        /// Counter that receives the total.
        counter: u32,
        /// Unused.
        pad: [u32; 3],
    }
    /// What a step leaves behind (`shaders/loss_reduce.wgsl`).
    StepLog {
        /// Sums over the pixels: |colour error|, SSIM, |depth error|, squared colour error.
        loss: [f32; 4],
        /// Work of the view.
        counters: [Counter; COUNTERS as usize],
        /// Unused.
        pad: [u32; 2],
    }
    /// One digit of a radix sort (`shaders/sort.wgsl`).
    SortSetup {
        /// Lowest bit of the digit.
        shift: u32,
        /// Counter that holds the number of keys.
        counter: u32,
        /// Unused.
        pad: [u32; 2],
    }
    /// Mode of `shaders/shared/tile_rows.wgsl`.
    TileListsSetup {
        /// 0 counts tile intersections, 1 writes them.
        emit: u32,
        /// Unused.
        pad: [u32; 3],
    }
    /// Compaction of the map's planes (`shaders/gather.wgsl`).
    GatherSetup {
        /// Gaussians that stay.
        count: u32,
        /// Planes of four floats.
        planes: u32,
        /// Gaussians that the source has space for.
        capacity_in: u32,
        /// Gaussians that the destination has space for.
        capacity_out: u32,
    }
    /// Weights of the image loss (`shaders/loss_*.wgsl`).
    LossSetup {
        /// Image width, pixels.
        width: u32,
        /// Image height, pixels.
        height: u32,
        /// λ of SSIM against L1.
        ssim_weight: f32,
        /// Weight of the depth term, 1/metres.
        depth_weight: f32,
        /// Depth beyond which its weight falls with the square, metres.
        precise_depth: f32,
        /// Confidence of the depth image, 0 to 1.
        depth_confidence: f32,
        /// First pixel with a window of SSIM along x, 0 or 1.
        phase_x: u32,
        /// The same along y.
        phase_y: u32,
        /// Pixels of the image for each of its windows.
        pixels_per_window: f32,
        /// Factor from the recorded red to the map's.
        red_gain: f32,
        /// Factor from the recorded green to the map's.
        green_gain: f32,
        /// Factor from the recorded blue to the map's.
        blue_gain: f32,
    }
    /// High-error mask (`shaders/shared/tile_scores.wgsl`).
    ScoreSetup {
        /// Factor of the mean absolute error above which a pixel is a high-error one.
        error_ratio: f32,
        /// Error below which no pixel is a high-error one.
        noise: f32,
        /// λ of SSIM against L1.
        ssim_weight: f32,
        /// Pixels of the image.
        pixels: f32,
    }
    /// Learning rates by plane and lane, and decay rates (`shaders/shared/sink_adam.wgsl`).
    AdamSetup {
        /// Learning rates of the first five planes.
        rates: [[f32; 4]; 5],
        /// Decay of the first moment.
        beta_1: f32,
        /// Decay of the second moment.
        beta_2: f32,
        /// Offset of the denominator.
        epsilon: f32,
        /// Natural logarithm of `beta_1`.
        log_beta_1: f32,
        /// Natural logarithm of `beta_2`.
        log_beta_2: f32,
        /// Whether the higher harmonics take part in this step.
        step_harmonics: u32,
        /// Logarithm of the largest ratio of a Gaussian's longest axis to its second.
        log_elongation: f32,
        /// The colour's learning rate is divided by √(1 + this · steps of the Gaussian).
        color_settling: f32,
        /// Least share of the newest parameters in their average.
        least_share: f32,
        /// Unused.
        pad: [f32; 3],
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
