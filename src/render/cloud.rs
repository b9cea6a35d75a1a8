//! The map's Gaussians on the GPU: parameters, Adam's moments, averages of the parameters, and histories, in planes of vec4.

mod change;
mod motion;
mod part;

use bytemuck::{Pod, Zeroable};
use glam::{Quat, Vec3};
use serde::{Deserialize, Serialize};

pub use motion::Motions;
pub use part::{CloudPart, Extent};

use self::change::Kernels;
use super::layout::GEOMETRY_PLANES;
use crate::gpu::{Gpu, GpuBuffer, GpuError, Part, Uniforms};
use crate::splat::{GaussianCloud, ShDegree};

/// Parameters, first and second moments, averages.
const BUFFERS: usize = 4;
/// Growth needs a quarter more memory than it takes: scratch follows the views.
const MARGIN_DIVISOR: u64 = 4;
/// The map grows by an eighth of itself at least.
const LEAST_GROWTH_DIVISOR: usize = 8;

/// What density control remembers of a Gaussian.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
pub struct GaussianHistory {
    /// Scored views that blended it, ever.
    pub views: f32,
    /// The most that it added to a pixel of these, 0 to 1.
    pub best_weight: f32,
    /// The most that it added to one view, pixels.
    pub contribution: f32,
    /// Round of density control in which it came.
    pub came: f32,
}

/// Gaussians on the GPU, `[planes, capacity]` vec4 in each buffer. Plane 0 holds position and raw opacity, 1 the log scale and the
/// sampling interval, 2 the rotation (w, x, y, z), 3 the constant colour, 4… the other harmonics, RGB each.
#[derive(Debug)]
pub struct GpuCloud {
    sh_degree: ShDegree,
    antialiased: bool,
    count: usize,
    /// So many of the first ones never change.
    frozen: usize,
    capacity: usize,
    /// The most that there may be, if that is limited.
    limit: Option<usize>,
    /// The most that the adapter has memory for, once that has been reached.
    room: Option<usize>,
    parameters: GpuBuffer,
    moments_1: GpuBuffer,
    moments_2: GpuBuffer,
    /// Exponential moving average of the parameters.
    averages: GpuBuffer,
    /// `[capacity]` [`GaussianHistory`].
    histories: GpuBuffer,
    /// Rounds of density control so far.
    rounds: u32,
    /// As large as the others: a change gathers one of them into it, the next into that one, and so on, so that it needs no memory.
    spare: Option<GpuBuffer>,
    spare_histories: Option<GpuBuffer>,
    kernels: Kernels,
    uniforms: Uniforms,
}

/// A map with its moments and averages, read back.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct CloudState {
    capacity: usize,
    frozen: usize,
    limit: Option<usize>,
    room: Option<usize>,
    rounds: u32,
    all: CloudPart,
}

impl GpuCloud {
    /// An empty map with room for `capacity` Gaussians; it grows as needed.
    ///
    /// # Errors
    /// [`GpuError`] if a buffer does not fit or the device fails.
    pub fn new(gpu: &Gpu, sh_degree: ShDegree, capacity: usize) -> Result<Self, GpuError> {
        let capacity = capacity.max(256);
        let planes = || allocate(gpu, sh_degree, capacity);
        Ok(Self {
            sh_degree,
            antialiased: false,
            count: 0,
            frozen: 0,
            capacity,
            limit: None,
            room: None,
            parameters: planes()?,
            moments_1: planes()?,
            moments_2: planes()?,
            averages: planes()?,
            histories: allocate_histories(gpu, capacity)?,
            rounds: 0,
            spare: None,
            spare_histories: None,
            kernels: Kernels::new(gpu),
            uniforms: Uniforms::new(gpu)?,
        })
    }

    /// A map as it is, to be rendered. Gaussians that hold a NaN or an infinity are left out.
    ///
    /// # Errors
    /// [`GpuError`] if a buffer does not fit or the device fails.
    pub fn of(gpu: &Gpu, map: &GaussianCloud) -> Result<Self, GpuError> {
        let mut cloud = Self::new(gpu, map.sh_degree, map.len())?;
        cloud.antialiased = map.antialiased;
        cloud.append(gpu, map)?;
        Ok(cloud)
    }

    /// With the filters of Mip-Splatting, or without: see [`GaussianCloud::antialiased`].
    pub fn with_antialiasing(self, antialiased: bool) -> Self {
        Self { antialiased, ..self }
    }

    /// Whether it has the filters of Mip-Splatting.
    pub fn is_antialiased(&self) -> bool {
        self.antialiased
    }

    /// Number of Gaussians.
    pub fn len(&self) -> usize {
        self.count
    }

    /// Whether there are no Gaussians.
    pub fn is_empty(&self) -> bool {
        self.count == 0
    }

    /// Forgets all Gaussians; the buffers stay.
    pub(super) fn clear(&mut self) {
        (self.count, self.frozen) = (0, 0);
    }

    /// The first `count` Gaussians are rendered, but no step moves them from now on; whoever makes a plan must keep to it.
    pub fn freeze(&mut self, count: usize) {
        self.frozen = count;
    }

    /// Number of Gaussians, the first ones, that never change.
    pub fn frozen(&self) -> usize {
        self.frozen
    }

    /// Gaussians that the buffers have space for.
    pub fn capacity(&self) -> usize {
        self.capacity
    }

    /// Degree of the spherical harmonics.
    pub fn sh_degree(&self) -> ShDegree {
        self.sh_degree
    }

    /// Bytes that there is to be room for with each Gaussian: parameters, two moments, averages, history, and spares for changes.
    pub fn bytes_each(&self) -> u64 {
        Self::bytes_for_each(self.sh_degree)
    }

    /// The same for a degree.
    pub fn bytes_for_each(sh_degree: ShDegree) -> u64 {
        ((BUFFERS + 1) * planes(sh_degree) * 16 + 2 * size_of::<GaussianHistory>()) as u64
    }

    /// Bytes that it has at present.
    pub fn bytes(&self) -> u64 {
        let histories = [Some(&self.histories), self.spare_histories.as_ref()].into_iter().flatten();
        self.buffers().into_iter().chain(&self.spare).chain(histories).map(GpuBuffer::size).sum()
    }

    /// Buffers are made for at most `limit` Gaussians from now on; whoever appends must keep to it.
    pub fn limit(&mut self, limit: usize) {
        self.limit = Some(limit);
    }

    /// The most Gaussians that the adapter has room for, as far as that is known: its largest binding, and its memory once reached.
    pub fn most(&self, gpu: &Gpu) -> usize {
        let bound = Self::most_bound(gpu, self.sh_degree);
        self.room.map_or(bound, |room| room.min(bound))
    }

    /// The most Gaussians that the adapter's largest binding holds.
    pub fn most_bound(gpu: &Gpu, sh_degree: ShDegree) -> usize {
        gpu.max_storage_bytes() as usize / (planes(sh_degree) * 16)
    }

    /// Before the map grows to `needed` Gaussians: reduces [`Self::most`] to what there is memory for, with `scratch_bytes` beside each and
    /// a margin. Nothing is changed or lost by it.
    pub fn probe(&mut self, gpu: &Gpu, needed: usize, scratch_bytes: u64) {
        let mut capacity = self.capacity_for(gpu, needed.min(self.most(gpu)));
        let (own, each, bytes) = (self.capacity, self.bytes_each(), self.bytes());
        let has_room = |capacity: usize| {
            let missing = (capacity as u64 * each + (capacity - own) as u64 * scratch_bytes).saturating_sub(bytes);
            gpu.has_room(missing + missing / MARGIN_DIVISOR)
        };
        while capacity > self.capacity && !has_room(capacity) {
            let less = (capacity - self.capacity) / 2;
            capacity = self.capacity + if less > self.capacity / LEAST_GROWTH_DIVISOR { less } else { 0 };
            self.room = Some(capacity);
        }
    }

    /// Number of vec4 planes in each buffer.
    pub fn planes(&self) -> usize {
        planes(self.sh_degree)
    }

    /// Raw parameters, `[planes, capacity]` vec4.
    pub fn parameters(&self) -> &GpuBuffer {
        &self.parameters
    }

    /// First moments of Adam, `[planes, capacity]` vec4.
    pub fn moments_1(&self) -> &GpuBuffer {
        &self.moments_1
    }

    /// Second moments of Adam, `[planes, capacity]` vec4.
    pub fn moments_2(&self) -> &GpuBuffer {
        &self.moments_2
    }

    /// The averages of the parameters over each Gaussian's last steps: the map as it is shown.
    pub fn averages(&self) -> &GpuBuffer {
        &self.averages
    }

    /// What density control remembers of each Gaussian, `[capacity]` [`GaussianHistory`].
    pub fn histories(&self) -> &GpuBuffer {
        &self.histories
    }

    /// Rounds of density control so far, from which a Gaussian's age follows.
    pub fn rounds(&self) -> u32 {
        self.rounds
    }

    /// Another round of density control: all Gaussians are older by one.
    pub fn begin_round(&mut self) {
        self.rounds += 1;
    }

    /// Room for `needed` Gaussians: the present one, or twice as much within the limit and what the adapter can bind; if that is too
    /// little, the allocation says how much is needed.
    fn capacity_for(&self, gpu: &Gpu, needed: usize) -> usize {
        let limit = self.limit.unwrap_or(usize::MAX).max(needed);
        if needed <= self.capacity {
            return self.capacity.min(limit).max(needed);
        }
        needed.next_power_of_two().min(limit).min(self.most(gpu)).max(needed)
    }

    /// All of them, in the order of [`CloudState`].
    fn buffers(&self) -> [&GpuBuffer; BUFFERS] {
        [&self.parameters, &self.moments_1, &self.moments_2, &self.averages]
    }

    /// The filled part of each plane of a buffer of the map's shape, `[N]` vec4.
    fn parts<'a>(&self, buffer: &'a GpuBuffer) -> impl Iterator<Item = Part<'a>> + use<'a> {
        let (planes, capacity, count) = (self.planes(), self.capacity, self.count);
        (0..planes).map(move |plane| buffer.part::<[f32; 4]>(plane * capacity, count))
    }

    /// Reads a buffer of the map's shape: the map itself, or gradients by it.
    pub(crate) fn read_planes(&self, gpu: &Gpu, buffer: &GpuBuffer) -> Result<GaussianCloud, GpuError> {
        Ok(cloud_from_planes(self.sh_degree, &self.planes_of(gpu, buffer)?))
    }

    /// The filled part of each plane of a buffer of the map's shape, `[planes][N]`.
    fn planes_of(&self, gpu: &Gpu, buffer: &GpuBuffer) -> Result<Vec<Vec<[f32; 4]>>, GpuError> {
        let read = gpu.read(None, &self.parts(buffer).collect::<Vec<_>>())?;
        Ok((0..self.planes()).map(|plane| read.part(plane)).collect())
    }

    /// The least distance of two samples at each Gaussian so far, `[N]` metres; 0 before the first step that moved it.
    ///
    /// # Errors
    /// [`GpuError`] if the device fails.
    pub fn sampling_intervals(&self, gpu: &Gpu) -> Result<Vec<f32>, GpuError> {
        let scales: Vec<[f32; 4]> = self.averages.read(gpu, self.capacity, self.count)?;
        Ok(scales.iter().map(|scale| scale[3]).collect())
    }

    /// Reads the whole map as it is shown, with its smoothing applied.
    ///
    /// # Errors
    /// [`GpuError`] if a buffer does not fit or the device fails.
    pub fn download(&self, gpu: &Gpu) -> Result<GaussianCloud, GpuError> {
        Ok(part::shown(self.sh_degree, self.antialiased, &self.planes_of(gpu, &self.averages)?))
    }

    /// All that training needs to go on as if it had never stopped.
    ///
    /// # Errors
    /// [`GpuError`] if a buffer does not fit or the device fails.
    pub fn state(&self, gpu: &Gpu) -> Result<CloudState, GpuError> {
        let mut all = CloudPart::with_capacity(self.planes(), self.count);
        for buffer in self.buffers() {
            all.read_planes(gpu, self.parts(buffer))?;
        }
        all.histories = self.histories.read(gpu, 0, self.count)?;
        let Self { capacity, frozen, limit, room, rounds, .. } = *self;
        Ok(CloudState { capacity, frozen, limit, room, rounds, all })
    }

    /// The map of a state, to the bit; `None` if that is no map of this degree.
    ///
    /// # Errors
    /// [`GpuError`] if a buffer does not fit or the device fails.
    pub fn restore(gpu: &Gpu, sh_degree: ShDegree, state: &CloudState) -> Result<Option<Self>, GpuError> {
        let count = state.all.len();
        if !state.all.is_whole(sh_degree) || state.capacity < count.max(state.frozen) {
            return Ok(None);
        }
        let mut cloud = Self::new(gpu, sh_degree, state.capacity)?;
        (cloud.count, cloud.frozen, cloud.limit, cloud.room, cloud.rounds) =
            (count, state.frozen, state.limit, state.room, state.rounds);
        cloud.write(gpu, 0, &state.all);
        Ok(Some(cloud))
    }
}

/// Number of vec4 planes for a degree.
pub fn planes(sh_degree: ShDegree) -> usize {
    GEOMETRY_PLANES + sh_degree.coefficients()
}

/// A cloud from its planes, each `[N]`.
fn cloud_from_planes(sh_degree: ShDegree, read: &[Vec<[f32; 4]>]) -> GaussianCloud {
    let xyz = |v: &[f32; 4]| Vec3::new(v[0], v[1], v[2]);
    let count = read[0].len();
    let coefficients = &read[GEOMETRY_PLANES..];
    GaussianCloud {
        sh_degree,
        antialiased: false,
        means: read[0].iter().map(xyz).collect(),
        raw_opacities: read[0].iter().map(|v| v[3]).collect(),
        log_scales: read[1].iter().map(xyz).collect(),
        rotations: read[2].iter().map(|v| Quat::from_xyzw(v[1], v[2], v[3], v[0])).collect(),
        sh: (0..count).flat_map(|i| coefficients.iter().map(move |plane| xyz(&plane[i]))).collect(),
    }
}

fn allocate(gpu: &Gpu, sh_degree: ShDegree, capacity: usize) -> Result<GpuBuffer, GpuError> {
    GpuBuffer::storage(gpu, "Gaussians", (planes(sh_degree) * capacity * 16) as u64)
}

fn allocate_histories(gpu: &Gpu, capacity: usize) -> Result<GpuBuffer, GpuError> {
    GpuBuffer::storage(gpu, "histories", (capacity * size_of::<GaussianHistory>()) as u64)
}
