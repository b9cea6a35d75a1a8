//! The map's Gaussians on the GPU: parameters, Adam's moments and averages of the parameters, in planes of vec4.

mod motion;

use glam::{Quat, Vec3};
use serde::{Deserialize, Serialize};

pub use motion::RunMotion;

use super::layout::{BlendForm, GEOMETRY_PLANES, GatherSetup};
use super::plan::{GaussianGeometry, Plan};
use super::shaders;
use crate::gpu::{Gpu, GpuBuffer, GpuError, Kernel, Part, ReadBack, plain, workgroups};
use crate::splat::{GaussianCloud, ShDegree};

/// Parameters, first and second moments, averages.
const BUFFERS: usize = 4;
/// Growth needs a quarter more memory than it takes: scratch follows the views.
const MARGIN_DIVISOR: u64 = 4;
/// The map grows by an eighth of itself at least.
const LEAST_GROWTH_DIVISOR: usize = 8;

/// Gaussians on the GPU, `[planes, capacity]` vec4 in each buffer. Plane 0 holds position and raw opacity, 1 the log scale,
/// 2 the rotation (w, x, y, z), 3 the constant colour, 4… the other harmonics, RGB each.
#[derive(Debug)]
pub struct GpuCloud {
    sh_degree: ShDegree,
    count: usize,
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
    /// As large as the others: a change gathers one of them into it, the next into that one, and so on, so that it needs no memory.
    spare: Option<GpuBuffer>,
    gather: Kernel,
}

/// A map with its moments and averages, read back.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct CloudState {
    capacity: usize,
    limit: Option<usize>,
    room: Option<usize>,
    /// `[BUFFERS, planes, N]`: parameters, first and second moments, averages.
    #[serde(with = "plain")]
    values: Vec<[f32; 4]>,
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
            count: 0,
            capacity,
            limit: None,
            room: None,
            parameters: planes()?,
            moments_1: planes()?,
            moments_2: planes()?,
            averages: planes()?,
            spare: None,
            gather: Kernel::new(gpu, "gather", "main", &shaders::GATHER.text(BlendForm::default())),
        })
    }

    /// Number of Gaussians.
    pub fn len(&self) -> usize {
        self.count
    }

    /// Whether there are no Gaussians.
    pub fn is_empty(&self) -> bool {
        self.count == 0
    }

    /// Gaussians that the buffers have space for.
    pub fn capacity(&self) -> usize {
        self.capacity
    }

    /// Degree of the spherical harmonics.
    pub fn sh_degree(&self) -> ShDegree {
        self.sh_degree
    }

    /// Bytes that there is to be room for with each Gaussian: parameters, two moments, averages, and a spare for changes.
    pub fn bytes_each(&self) -> u64 {
        ((BUFFERS + 1) * self.planes() * 16) as u64
    }

    /// Bytes that it has at present.
    pub fn bytes(&self) -> u64 {
        self.buffers().into_iter().chain(&self.spare).map(|buffer| buffer.size()).sum()
    }

    /// Buffers are made for at most `limit` Gaussians from now on; whoever appends must keep to it.
    pub fn limit(&mut self, limit: usize) {
        self.limit = Some(limit);
    }

    /// The most Gaussians that the adapter has room for, as far as that is known: its largest binding, and its memory once reached.
    pub fn most(&self, gpu: &Gpu) -> usize {
        let bound = gpu.max_storage_bytes() as usize / (self.planes() * 16);
        self.room.map_or(bound, |room| room.min(bound))
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

    /// Appends Gaussians with zero moments. Those that hold a NaN or an infinity are left out; their number is returned.
    ///
    /// # Errors
    /// [`GpuError`] if a buffer does not fit or the device fails.
    pub fn append(&mut self, gpu: &Gpu, cloud: &GaussianCloud) -> Result<usize, GpuError> {
        assert_eq!(cloud.sh_degree, self.sh_degree, "a map has one spherical-harmonics degree");
        let finite: Vec<usize> = (0..cloud.len()).filter(|&i| is_finite(cloud, i)).collect();
        let capacity = self.capacity_for(gpu, self.count + finite.len());
        if capacity > self.capacity {
            let all: Vec<u32> = (0..self.count as u32).collect();
            self.rebuild(gpu, &all, capacity)?;
        }
        let zeros = vec![[0.0f32; 4]; finite.len()];
        for plane in 0..self.planes() {
            let values: Vec<[f32; 4]> = finite.iter().map(|&i| plane_value(cloud, plane, i)).collect();
            let first = plane * self.capacity + self.count;
            self.parameters.write(gpu, first, &values);
            self.averages.write(gpu, first, &values);
            self.moments_1.write(gpu, first, &zeros);
            self.moments_2.write(gpu, first, &zeros);
        }
        self.count += finite.len();
        Ok(cloud.len() - finite.len())
    }

    /// Applies a plan to the parameters, their averages and the moments. A child inherits its parent's moments.
    ///
    /// # Errors
    /// [`GpuError`] if a buffer does not fit.
    pub fn apply(&mut self, gpu: &Gpu, plan: &Plan) -> Result<(), GpuError> {
        let sources: Vec<u32> = plan.keep.iter().copied().chain(plan.parents()).collect();
        let capacity = self.capacity_for(gpu, sources.len());
        if plan.keep.len() == self.count && plan.children.is_empty() && capacity == self.capacity {
            return Ok(());
        }
        self.rebuild(gpu, &sources, capacity)?;
        let first = plan.keep.len();
        let positions: Vec<[f32; 4]> = plan.children.iter().map(|c| c.mean.extend(c.raw_opacity).into()).collect();
        let scales: Vec<[f32; 4]> = plan.children.iter().map(|c| c.log_scale.extend(0.0).into()).collect();
        for (plane, values) in [positions, scales].iter().enumerate() {
            self.parameters.write(gpu, plane * self.capacity + first, values);
            self.averages.write(gpu, plane * self.capacity + first, values);
        }
        Ok(())
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

    /// The Gaussians at `chosen`, in this order, with room for `capacity`. Buffers are replaced one at a time: the old and the new ones never
    /// stand beside each other in full.
    fn rebuild(&mut self, gpu: &Gpu, chosen: &[u32], capacity: usize) -> Result<(), GpuError> {
        let list = GpuBuffer::storage(gpu, "chosen", (chosen.len() * 4) as u64)?;
        list.write(gpu, 0, chosen);
        let setup = GatherSetup {
            count: chosen.len() as u32,
            planes: self.planes() as u32,
            capacity_in: self.capacity as u32,
            capacity_out: capacity as u32,
        };
        let setup = GpuBuffer::uniform(gpu, "gather setup", &setup)?;
        let size = workgroups((chosen.len() as u32).div_ceil(256));
        let (sh_degree, resized) = (self.sh_degree, capacity != self.capacity);
        let Self { parameters, moments_1, moments_2, averages, spare, gather, .. } = self;
        for buffer in [parameters, moments_1, moments_2, averages] {
            // An old one of another size is given back before the new one is made.
            let to = match spare.take().filter(|_| !resized) {
                Some(spare) => spare,
                None => allocate(gpu, sh_degree, capacity)?,
            };
            let mut encoder = gpu.device.create_command_encoder(&Default::default());
            let mut pass = encoder.begin_compute_pass(&Default::default());
            gather.dispatch(gpu, &mut pass, &[(0, &setup), (1, &list), (2, buffer), (3, &to)], size);
            drop(pass);
            gpu.submit(encoder);
            *spare = Some(std::mem::replace(buffer, to));
        }
        if resized {
            *spare = None;
        }
        (self.count, self.capacity) = (chosen.len(), capacity);
        Ok(())
    }

    /// All of them, in the order of [`CloudState`].
    fn buffers(&self) -> [&GpuBuffer; BUFFERS] {
        [&self.parameters, &self.moments_1, &self.moments_2, &self.averages]
    }

    /// Downloads the averaged geometry of all Gaussians, `[N]` in map order. Blocks until the GPU is idle.
    ///
    /// # Errors
    /// [`GpuError`] if the device fails.
    pub fn read_geometry(&self, gpu: &Gpu) -> Result<Vec<GaussianGeometry>, GpuError> {
        Ok(self.geometry(&gpu.read(None, &self.geometry_parts())?, 0))
    }

    /// The same, to be read back with others.
    pub(crate) fn geometry_parts(&self) -> [Part<'_>; GEOMETRY_PLANES] {
        [0, 1, 2].map(|plane| self.averages.part::<[f32; 4]>(plane * self.capacity, self.count))
    }

    /// The averaged geometry of all Gaussians, `[N]` in map order; its parts are `first` and the following ones.
    pub(crate) fn geometry(&self, read: &ReadBack<'_>, first: usize) -> Vec<GaussianGeometry> {
        let [positions, scales, rotations] = [0, 1, 2].map(|plane| read.part::<[f32; 4]>(first + plane));
        let geometry = |i: usize| {
            let ([x, y, z, raw_opacity], [a, b, c, _], [qw, qx, qy, qz]) = (positions[i], scales[i], rotations[i]);
            let (mean, log_scale, rotation) = (Vec3::new(x, y, z), Vec3::new(a, b, c), Quat::from_xyzw(qx, qy, qz, qw));
            GaussianGeometry { mean, raw_opacity, log_scale, rotation }
        };
        (0..self.count).map(geometry).collect()
    }

    /// The filled part of each plane of a buffer of the map's shape, `[N]` vec4.
    fn parts<'a>(&self, buffer: &'a GpuBuffer) -> impl Iterator<Item = Part<'a>> + use<'a> {
        let (planes, capacity, count) = (self.planes(), self.capacity, self.count);
        (0..planes).map(move |plane| buffer.part::<[f32; 4]>(plane * capacity, count))
    }

    /// Reads a buffer of the map's shape: the map itself, or gradients by it.
    pub(crate) fn read_planes(&self, gpu: &Gpu, buffer: &GpuBuffer) -> Result<GaussianCloud, GpuError> {
        let read = gpu.read(None, &self.parts(buffer).collect::<Vec<_>>())?;
        let planes: Vec<Vec<[f32; 4]>> = (0..self.planes()).map(|plane| read.part(plane)).collect();
        Ok(cloud_from_planes(self.sh_degree, &planes))
    }

    /// Reads the whole map as it is shown.
    ///
    /// # Errors
    /// [`GpuError`] if a buffer does not fit or the device fails.
    pub fn download(&self, gpu: &Gpu) -> Result<GaussianCloud, GpuError> {
        self.read_planes(gpu, &self.averages)
    }

    /// All that training needs to go on as if it had never stopped.
    ///
    /// # Errors
    /// [`GpuError`] if a buffer does not fit or the device fails.
    pub fn state(&self, gpu: &Gpu) -> Result<CloudState, GpuError> {
        let mut values = Vec::with_capacity(BUFFERS * self.planes() * self.count);
        for buffer in self.buffers() {
            let read = gpu.read(None, &self.parts(buffer).collect::<Vec<_>>())?;
            (0..self.planes()).for_each(|plane| values.extend(read.part::<[f32; 4]>(plane)));
        }
        Ok(CloudState { capacity: self.capacity, limit: self.limit, room: self.room, values })
    }

    /// The map of a state, to the bit; `None` if that is no map of this degree.
    ///
    /// # Errors
    /// [`GpuError`] if a buffer does not fit or the device fails.
    pub fn restore(gpu: &Gpu, sh_degree: ShDegree, state: &CloudState) -> Result<Option<Self>, GpuError> {
        let planes = planes(sh_degree);
        let count = state.values.len() / (BUFFERS * planes);
        if state.values.len() != BUFFERS * planes * count || state.capacity < count {
            return Ok(None);
        }
        let mut cloud = Self::new(gpu, sh_degree, state.capacity)?;
        (cloud.count, cloud.limit, cloud.room) = (count, state.limit, state.room);
        let buffers = cloud.buffers();
        for (i, plane) in state.values.chunks_exact(count.max(1)).enumerate() {
            buffers[i / planes].write(gpu, (i % planes) * cloud.capacity, plane);
        }
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
        means: read[0].iter().map(xyz).collect(),
        raw_opacities: read[0].iter().map(|v| v[3]).collect(),
        log_scales: read[1].iter().map(xyz).collect(),
        rotations: read[2].iter().map(|v| Quat::from_xyzw(v[1], v[2], v[3], v[0])).collect(),
        sh: (0..count).flat_map(|i| coefficients.iter().map(move |plane| xyz(&plane[i]))).collect(),
    }
}

fn plane_value(cloud: &GaussianCloud, plane: usize, i: usize) -> [f32; 4] {
    let with = |v: Vec3, w: f32| [v.x, v.y, v.z, w];
    let q = cloud.rotations[i];
    match plane {
        0 => with(cloud.means[i], cloud.raw_opacities[i]),
        1 => with(cloud.log_scales[i], 0.0),
        2 => [q.w, q.x, q.y, q.z],
        _ => with(cloud.sh[i * cloud.sh_degree.coefficients() + plane - GEOMETRY_PLANES], 0.0),
    }
}

fn is_finite(cloud: &GaussianCloud, i: usize) -> bool {
    (0..planes(cloud.sh_degree)).all(|plane| plane_value(cloud, plane, i).iter().all(|v| v.is_finite()))
}

fn allocate(gpu: &Gpu, sh_degree: ShDegree, capacity: usize) -> Result<GpuBuffer, GpuError> {
    GpuBuffer::storage(gpu, "Gaussians", (planes(sh_degree) * capacity * 16) as u64)
}
