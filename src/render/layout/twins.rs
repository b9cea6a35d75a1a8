//! Host twins of the structs that shaders share with the host.

use bytemuck::{Pod, Zeroable};

use super::COUNTERS;

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
        /// 1 where the map is antialiased, else 0.
        antialiased: f32,
        /// Gaussians whose hash is below this are left out.
        dropped_below: u32,
        /// Added to their places before these are hashed.
        dropout_seed: u32,
        /// Factor of the opacities.
        opacity_gain: f32,
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
    /// A survey of a render (`shaders/survey.wgsl`).
    SurveySetup {
        /// Image width, pixels.
        width: u32,
        /// Image height, pixels.
        height: u32,
        /// Side of a cell, pixels.
        cell: u32,
        /// Cells in a row.
        columns: u32,
        /// Cells in all.
        cells: u32,
        /// Pixels from one sample to the next.
        sample_stride: u32,
        /// Sampled pixels.
        samples: u32,
        /// Alpha below which a pixel lacks map.
        min_alpha: f32,
        /// Share of its depth by which a pixel is nearer than the map and lacks it.
        depth_disagreement: f32,
        /// Unused.
        pad: [u32; 3],
    }
    /// A change of the set of Gaussians (`shaders/gather.wgsl`).
    GatherSetup {
        /// Gaussians that stay.
        kept: u32,
        /// Gaussians that come behind them, two from each parent.
        children: u32,
        /// Gaussians that go.
        removed: u32,
        /// Gaussians that the source has space for.
        capacity_in: u32,
        /// Gaussians that the destination has space for.
        capacity_out: u32,
        /// Unused.
        pad: [u32; 3],
    }
    /// Gathered copies become their parents' children (`shaders/divide.wgsl`).
    DivideSetup {
        /// The first of them.
        first: u32,
        /// How many there are.
        children: u32,
        /// Place of the first parent in the list of changes.
        parents: u32,
        /// Gaussians that a plane has space for.
        capacity: u32,
        /// Round of density control in which they come.
        round: f32,
        /// Unused.
        pad: [u32; 3],
    }
    /// New Gaussians (`shaders/append.wgsl`).
    AppendSetup {
        /// Place of the first of them.
        first: u32,
        /// How many there are.
        count: u32,
        /// Gaussians that a plane has space for.
        capacity: u32,
        /// Round of density control in which they come.
        round: f32,
    }
    /// Gaussians that no step moves (`shaders/fix.wgsl`).
    FixSetup {
        /// Gaussians in the map.
        count: u32,
        /// Gaussians that a plane has space for.
        capacity: u32,
        /// Fills a vec4.
        pad: [u32; 2],
    }
    /// Gaussians that move (`shaders/transform.wgsl`).
    TransformSetup {
        /// First of them.
        first: u32,
        /// One past the last.
        end: u32,
        /// Gaussians that a plane has space for.
        capacity: u32,
        /// Fills a vec4.
        pad: u32,
    }
    /// Rules of density control (`shaders/shared/density.wgsl`).
    #[derive(PartialEq)]
    DensitySetup {
        /// Gaussians in the map.
        count: u32,
        /// Gaussians that a plane has space for.
        capacity: u32,
        /// Rounds of density control so far, this one included.
        round: f32,
        /// Least logit of the opacity.
        min_raw_opacity: f32,
        /// Natural logarithm of the largest standard deviation in metres.
        max_log_scale: f32,
        /// Rounds that a Gaussian has been there before several views split or prune it.
        min_age: f32,
        /// Views that must have blended a Gaussian before it can be called useless.
        min_views: f32,
        /// Least of the largest weights, 0 to 1.
        min_weight: f32,
        /// Least of the largest contributions to a view, pixels.
        min_contribution: f32,
        /// Logit of the opacity below which a Gaussian is faint.
        faint_raw_opacity: f32,
        /// Error pixels a view above which a Gaussian is too coarse,
        error_pixels: f32,
        /// with more absolute gradient a view than this, for a pixel of motion,
        pixel_gradient: f32,
        /// and a longest axis beyond so many pixels: their natural logarithm.
        split_log_pixels: f32,
        /// Gradient a view from which 3DGS divides a Gaussian, normalised device coordinates.
        gradient: f32,
        /// Natural logarithm of the longest axis in pixels beyond which it splits rather than clones.
        split_or_clone_log_pixels: f32,
        /// Unused.
        pad: u32,
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
    /// Loss of a planar surface (`shaders/surface_loss.wgsl`).
    SurfaceSetup {
        /// Weight of the normals' term over the number of pixels.
        normal_weight: f32,
        /// Weight of the spread's term over the number of pixels.
        spread_weight: f32,
        /// Alpha below which a pixel has no surface.
        min_alpha: f32,
        /// Share of the depth from which two pixels lie on different surfaces.
        edge: f32,
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
        /// Logarithm of the ratio of its shortest axis to its second to which the shortest shrinks.
        log_thickness: f32,
        /// The colour's learning rate is divided by √(1 + this · steps of the Gaussian).
        color_settling: f32,
        /// The same of all other learning rates.
        geometry_settling: f32,
        /// Least share of the newest parameters in their average.
        least_share: f32,
        /// Gaussians before this place never move.
        frozen: u32,
        /// Weight of the squares of the higher harmonics in the loss summed over the pixels, halved.
        harmonics_prior: f32,
        /// Unused.
        pad: [u32; 3],
    }
}
