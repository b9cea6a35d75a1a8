//! Gaussians off the GPU with all that training knows of them: how a map larger than the GPU's memory is kept, and how training goes on elsewhere.

use bytemuck::Zeroable;
use glam::{Mat3, Quat, Vec3};
use serde::{Deserialize, Serialize};

use super::change::Gathering;
use super::motion::move_planes;
use super::{BUFFERS, GaussianHistory, GpuCloud, allocate, allocate_histories, cloud_from_planes, planes};
use crate::geometry::Sim3;
use crate::gpu::{Gpu, GpuError, Part, plain};
use crate::render::plan::Plan;
use crate::splat::{GaussianCloud, ShDegree};

/// Places among the buffers.
const PARAMETERS: usize = 0;
const MOMENTS_2: usize = 2;
const AVERAGES: usize = 3;

/// Where a Gaussian lies and how far it reaches.
#[derive(Clone, Copy, Debug)]
pub struct Extent {
    /// Its centre, in world coordinates, metres.
    pub mean: Vec3,
    /// The half axes of its ellipsoid of one standard deviation, in the world's frame, metres.
    pub axes: [Vec3; 3],
}

impl Extent {
    /// Of a Gaussian with these standard deviations, metres, along its own axes.
    pub fn new(mean: Vec3, deviations: Vec3, world_from_own: Quat) -> Self {
        let axes = Mat3::from_quat(world_from_own) * Mat3::from_diagonal(deviations);
        Self { mean, axes: [axes.x_axis, axes.y_axis, axes.z_axis] }
    }

    /// Its standard deviation along a unit vector, metres.
    pub fn deviation(&self, along: Vec3) -> f32 {
        self.axes.iter().map(|axis| axis.dot(along).powi(2)).sum::<f32>().sqrt()
    }
}

/// Gaussians with their moments, averages and histories.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct CloudPart {
    /// `[BUFFERS, planes, N]`: parameters, first and second moments, averages.
    #[serde(with = "plain")]
    values: Vec<[f32; 4]>,
    /// `[N]`
    #[serde(with = "plain")]
    pub(super) histories: Vec<GaussianHistory>,
}

impl CloudPart {
    pub(super) fn with_capacity(planes: usize, count: usize) -> Self {
        Self { values: Vec::with_capacity(BUFFERS * planes * count), histories: Vec::new() }
    }

    /// Number of Gaussians.
    pub fn len(&self) -> usize {
        self.histories.len()
    }

    /// Whether there are no Gaussians.
    pub fn is_empty(&self) -> bool {
        self.histories.is_empty()
    }

    /// Whether it has all values of its Gaussians, of this degree.
    pub(super) fn is_whole(&self, sh_degree: ShDegree) -> bool {
        self.values.len() == BUFFERS * planes(sh_degree) * self.len()
    }

    /// Appends the planes of a buffer.
    pub(super) fn read_planes<'a>(&mut self, gpu: &Gpu, parts: impl Iterator<Item = Part<'a>>) -> Result<(), GpuError> {
        let parts: Vec<Part<'_>> = parts.collect();
        let read = gpu.read(None, &parts)?;
        (0..parts.len()).for_each(|plane| self.values.extend(read.part::<[f32; 4]>(plane)));
        Ok(())
    }

    /// Some of its Gaussians.
    pub fn picked(&self, which: &[usize]) -> Self {
        let planes = self.values.chunks_exact(self.len().max(1));
        let values = planes.flat_map(|plane| which.iter().map(|i| plane[*i])).collect();
        Self { values, histories: which.iter().map(|i| self.histories[*i]).collect() }
    }

    /// Several parts as one, in order.
    pub fn joined<'a>(parts: impl Iterator<Item = &'a Self> + Clone) -> Self {
        let planes = parts.clone().find(|part| !part.is_empty()).map_or(0, |part| part.values.len() / part.len());
        let of_plane = |plane: usize| parts.clone().flat_map(move |part| &part.values[plane * part.len()..][..part.len()]);
        let values = (0..planes).flat_map(of_plane).copied().collect();
        Self { values, histories: parts.flat_map(|part| part.histories.iter().copied()).collect() }
    }

    /// The same in bytes, in the byte order of the machine.
    pub fn to_bytes(&self) -> Vec<u8> {
        [bytemuck::cast_slice::<_, u8>(&self.values), bytemuck::cast_slice(&self.histories)].concat()
    }

    /// `count` Gaussians of this degree from [`Self::to_bytes`]; `None` if there are more bytes or fewer.
    pub fn from_bytes(bytes: &[u8], sh_degree: ShDegree, count: usize) -> Option<Self> {
        let mut values = vec![[0.0f32; 4]; BUFFERS * planes(sh_degree) * count];
        let mut histories = vec![GaussianHistory::zeroed(); count];
        let (of_values, of_histories) = bytes.split_at_checked(std::mem::size_of_val(&*values))?;
        if of_histories.len() != std::mem::size_of_val(&*histories) {
            return None;
        }
        bytemuck::cast_slice_mut(&mut values).copy_from_slice(of_values);
        bytemuck::cast_slice_mut(&mut histories).copy_from_slice(of_histories);
        Some(Self { values, histories })
    }

    /// Where they lie and how far they reach, as training has them.
    pub fn extents(&self) -> Vec<Extent> {
        let count = self.len();
        extents([0, 1, 2].map(|plane| &self.values[plane * count..][..count]))
    }

    /// The Gaussians as they are shown, see [`GpuCloud::download`].
    pub fn shown(&self, sh_degree: ShDegree, antialiased: bool) -> GaussianCloud {
        let (planes, count) = (planes(sh_degree), self.len());
        let plane = |plane: usize| self.values[(AVERAGES * planes + plane) * count..][..count].to_vec();
        let averages: Vec<Vec<[f32; 4]>> = (0..planes).map(plane).collect();
        shown(sh_degree, antialiased, &averages)
    }

    /// Moves some Gaussians as [`GpuCloud::transform`] does.
    pub fn transform(&mut self, which: &[usize], new_from_old: &Sim3) {
        let count = self.len();
        if which.is_empty() {
            return;
        }
        let of_buffer = self.values.len() / BUFFERS;
        for (buffer, values) in self.values.chunks_exact_mut(of_buffer).enumerate() {
            if buffer != PARAMETERS && buffer != AVERAGES {
                continue;
            }
            let mut planes: Vec<&mut [[f32; 4]]> = values.chunks_exact_mut(count).collect();
            let mut moved: Vec<Vec<[f32; 4]>> = planes.iter().map(|plane| which.iter().map(|i| plane[*i]).collect()).collect();
            move_planes(&mut moved.iter_mut().map(Vec::as_mut_slice).collect::<Vec<_>>(), new_from_old);
            for (plane, moved) in planes.iter_mut().zip(moved) {
                which.iter().zip(moved).for_each(|(i, value)| plane[*i] = value);
            }
        }
    }

    /// Steps may move its Gaussians, whichever were fixed (see [`GpuCloud::fix`]) when they were copied out.
    pub fn release(&mut self) {
        let count = self.len();
        let planes = self.values.len() / (BUFFERS * count).max(1);
        self.values[(MOMENTS_2 * planes + 1) * count..][..count].iter_mut().for_each(|value| value[3] = 0.0);
    }

    /// Its Gaussians are younger by so many rounds of density control: those in which they were away.
    pub fn rejuvenate(&mut self, rounds: u32) {
        self.histories.iter_mut().for_each(|history| history.came += rounds as f32);
    }
}

impl GpuCloud {
    /// A copy of the Gaussians at these places, ascending. Needs no memory beyond [`GpuCloud::bytes_each`].
    ///
    /// # Errors
    /// [`GpuError`] if a buffer does not fit or the device fails.
    pub fn copy_out(&mut self, gpu: &Gpu, places: &[u32]) -> Result<CloudPart, GpuError> {
        let mut wanted = places.iter().copied().peekable();
        let others = (0..self.len() as u32).filter(|place| wanted.next_if_eq(place).is_none()).collect();
        let gathering = Gathering::new(gpu, &Plan::removing(others), self, self.capacity)?;
        let mut part = CloudPart::with_capacity(self.planes(), places.len());
        let spare = self.spare.take().map_or_else(|| allocate(gpu, self.sh_degree, self.capacity), Ok)?;
        for buffer in self.buffers() {
            gathering.gather(gpu, (&self.kernels, &self.uniforms), buffer, &spare);
            let plane = |plane: usize| spare.part::<[f32; 4]>(plane * self.capacity, places.len());
            part.read_planes(gpu, (0..self.planes()).map(plane))?;
        }
        self.spare = Some(spare);
        let spare = self.spare_histories.take().map_or_else(|| allocate_histories(gpu, self.capacity), Ok)?;
        gathering.gather(gpu, (&self.kernels, &self.uniforms), &self.histories, &spare);
        part.histories = spare.read(gpu, 0, places.len())?;
        self.spare_histories = Some(spare);
        Ok(part)
    }

    /// Where the Gaussians from the place `first` on lie and how far they reach, as training has them.
    ///
    /// # Errors
    /// [`GpuError`] if the device fails.
    pub fn extents(&self, gpu: &Gpu, first: usize) -> Result<Vec<Extent>, GpuError> {
        let plane = |plane: usize| self.parameters.part::<[f32; 4]>(plane * self.capacity + first, self.count - first);
        let read = gpu.read(None, &[plane(0), plane(1), plane(2)])?;
        let planes: [Vec<[f32; 4]>; 3] = [0, 1, 2].map(|i| read.part(i));
        Ok(extents(planes.each_ref().map(Vec::as_slice)))
    }

    /// Appends Gaussians that were here before, as they were.
    ///
    /// # Errors
    /// [`GpuError`] if a buffer does not fit or the device fails.
    pub fn put_back(&mut self, gpu: &Gpu, part: &CloudPart) -> Result<(), GpuError> {
        assert!(part.is_whole(self.sh_degree), "a map has one spherical-harmonics degree");
        self.reserve(gpu, self.count + part.len())?;
        self.write(gpu, self.count, part);
        self.count += part.len();
        Ok(())
    }

    /// Writes all values of a part from the place `first` on.
    pub(super) fn write(&self, gpu: &Gpu, first: usize, part: &CloudPart) {
        self.histories.write(gpu, first, &part.histories);
        let buffers = self.buffers();
        for (i, plane) in part.values.chunks_exact(part.len().max(1)).enumerate() {
            buffers[i / self.planes()].write(gpu, (i % self.planes()) * self.capacity + first, plane);
        }
    }
}

/// Of parameters by plane.
fn extents([positions, scales, rotations]: [&[[f32; 4]]; 3]) -> Vec<Extent> {
    let extent = |((position, scale), rotation): ((&[f32; 4], &[f32; 4]), &[f32; 4])| {
        let [w, x, y, z] = *rotation;
        let scale = Vec3::from_slice(scale).exp();
        Extent::new(Vec3::from_slice(position), scale, Quat::from_xyzw(x, y, z, w).normalize())
    };
    positions.iter().zip(scales).zip(rotations).map(extent).collect()
}

/// A map as it is shown, of the planes of its averages, `[planes][N]`.
pub(super) fn shown(sh_degree: ShDegree, antialiased: bool, averages: &[Vec<[f32; 4]>]) -> GaussianCloud {
    let mut cloud = cloud_from_planes(sh_degree, averages);
    if antialiased {
        cloud.antialiased = true;
        cloud.smooth(averages[1].iter().map(|scale| scale[3]));
    }
    cloud
}
