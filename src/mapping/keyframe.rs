//! A keyframe as the mapper receives and keeps it.

use std::borrow::Cow;

use image::{GrayImage, Rgb, RgbImage};
use serde::{Deserialize, Serialize};

use super::gaussian_stats;
use super::image_store::{ImageStore, StoredImage};
use super::plane_sweep::{self, SourceView};
use super::refine_poses::{PoseRefinement, RefinePosesConfig};
use super::{KeyframeId, MappingError};
use crate::geometry::{Pinhole, Se3};
use crate::gpu::{Gpu, GpuError, plain};
use crate::optimise::{Pixels, TargetImage, TrainingView};
use crate::sequence::{DepthImage, RectifiedImage};
use crate::splat::{Exposure, ViewCamera};

/// A keyframe from the tracker.
#[derive(Clone, Debug)]
pub struct Keyframe {
    /// Identity, ascending in the order of tracking.
    pub id: KeyframeId,
    /// Pose at the time of sending.
    pub world_from_camera: Se3,
    /// Rectified colour and depth at the mapping resolution.
    pub image: RectifiedImage,
    /// Origin of the depth in `image`.
    pub depth_source: DepthSource,
    /// Earlier keyframes that see the same landmarks, strongest first.
    pub covisible: Vec<KeyframeId>,
}

impl Keyframe {
    /// At the tracker's pose.
    pub fn camera(&self) -> ViewCamera {
        ViewCamera { pinhole: self.image.pinhole, camera_from_world: self.world_from_camera.inverse() }
    }
}

/// Where a keyframe's depth comes from.
#[derive(Clone, Debug, Default)]
pub enum DepthSource {
    /// Measured by a depth sensor.
    #[default]
    Sensor,
    /// It is that of landmarks: sparse.
    Landmarks {
        /// The right image of a stereo pair.
        right: Option<RightImage>,
    },
}

/// The other image of a stereo pair, at the mapping resolution.
#[derive(Clone, Debug)]
pub struct RightImage {
    /// Brightness, of the size of the left image.
    pub gray: GrayImage,
    /// From the left camera along its x axis.
    pub baseline_metres: f64,
}

/// A keyframe in the mapper.
#[derive(Debug)]
pub(super) struct MappedKeyframe {
    /// Identity, ascending in the order of tracking.
    pub id: KeyframeId,
    /// At the refined pose.
    pub camera: ViewCamera,
    /// The tracker's camera_from_world, which the refinement goes out from.
    pub tracked_from_world: Se3,
    /// camera_from_world at which its Gaussians were inserted, or to which they were last moved.
    anchored_from_world: Se3,
    pub refinement: PoseRefinement,
    /// Exposure of the recorded image against the map.
    pub exposure: Exposure,
    /// Median of the measured depths, metres; 1 if there are none.
    pub depth_metres: f64,
    image: Images,
    /// On the host, where depth is swept for.
    gray: Option<GrayImage>,
    pub covisible: Vec<KeyframeId>,
    /// At its last step; 1 before.
    pub loss: f32,
}

/// A keyframe's image, on the GPU or offloaded.
#[derive(Debug)]
struct Images {
    whole: TargetImage,
    /// Target at half the size, where coarse steps use it.
    half: Option<TargetImage>,
    /// Pixels of both once they are offloaded.
    stored: Option<(StoredImage, Option<StoredImage>)>,
}

/// All of a keyframe but its image, which the recording has.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct KeyframeState {
    /// Identity, ascending in the order of tracking.
    pub id: KeyframeId,
    camera: ViewCamera,
    tracked_from_world: Se3,
    anchored_from_world: Se3,
    refinement: PoseRefinement,
    exposure: Exposure,
    depth_metres: f64,
    covisible: Vec<KeyframeId>,
    loss: f32,
    tile_losses: TileLosses,
    is_resident: bool,
    /// Depth that was swept for, `[H, W]`: it depends on what the other poses were then. Nothing where the recording has it.
    swept: Option<Swept>,
}

#[derive(Clone, Debug, Serialize, Deserialize)]
struct Swept {
    #[serde(with = "plain")]
    metres: Vec<f32>,
}

/// `[tiles]` of the image and of the one at half the size, empty where there is none.
#[derive(Clone, Debug, Serialize, Deserialize)]
struct TileLosses {
    #[serde(with = "plain")]
    whole: Vec<[f32; 4]>,
    #[serde(with = "plain")]
    half: Vec<[f32; 4]>,
}

impl Images {
    /// Uploads an image; `with_half` also at half the size, if that is still an image worth comparing.
    fn new(gpu: &Gpu, image: &RectifiedImage, with_half: bool) -> Result<Self, GpuError> {
        let target = |image: &RectifiedImage| {
            let depth = image.depth.as_ref().map(|d| d.metres.as_slice());
            TargetImage::masked(gpu, &image.color, depth, image.valid.as_deref())
        };
        let worth = with_half && image.pinhole.width.min(image.pinhole.height) >= MIN_HALVED;
        Ok(Self { whole: target(image)?, half: worth.then(|| target(&halved(image))).transpose()?, stored: None })
    }

    fn tile_losses(&self, gpu: &Gpu) -> Result<TileLosses, GpuError> {
        let half = self.half.as_ref().map_or(Ok(Vec::new()), |half| half.tile_losses(gpu));
        Ok(TileLosses { whole: self.whole.tile_losses(gpu)?, half: half? })
    }

    /// Says whether they are of images of these sizes.
    fn set_tile_losses(&self, gpu: &Gpu, losses: &TileLosses) -> bool {
        let half = self.half.as_ref().map_or(losses.half.is_empty(), |half| half.set_tile_losses(gpu, &losses.half));
        self.whole.set_tile_losses(gpu, &losses.whole) && half
    }
}

impl MappedKeyframe {
    /// Uploads the images, see [`Images::new`], as they were recorded.
    pub fn new(gpu: &Gpu, keyframe: &Keyframe, exposure: Exposure, with_half: bool) -> Result<Self, GpuError> {
        let (image, camera) = (&keyframe.image, keyframe.camera());
        Ok(Self {
            id: keyframe.id,
            camera,
            tracked_from_world: camera.camera_from_world,
            anchored_from_world: camera.camera_from_world,
            refinement: PoseRefinement::default(),
            exposure,
            depth_metres: image.median_depth_metres().unwrap_or(1.0),
            image: Images::new(gpu, image, with_half)?,
            gray: matches!(keyframe.depth_source, DepthSource::Landmarks { .. }).then(|| plane_sweep::gray(&image.color)),
            covisible: keyframe.covisible.clone(),
            loss: 1.0,
        })
    }

    pub fn state(&self, gpu: &Gpu, store: &ImageStore) -> Result<KeyframeState, MappingError> {
        let swept = || match &self.image.stored {
            Some((whole, _)) => Ok::<_, MappingError>(Swept { metres: store.get(whole)?.depth_metres.clone() }),
            None => Ok(Swept { metres: self.image.whole.read_pixels(gpu)?.map_or(Vec::new(), |pixels| pixels.depth_metres) }),
        };
        Ok(KeyframeState {
            id: self.id,
            camera: self.camera,
            tracked_from_world: self.tracked_from_world,
            anchored_from_world: self.anchored_from_world,
            refinement: self.refinement,
            exposure: self.exposure,
            depth_metres: self.depth_metres,
            covisible: self.covisible.clone(),
            loss: self.loss,
            tile_losses: self.image.tile_losses(gpu)?,
            is_resident: self.is_resident(),
            swept: self.gray.is_some().then(swept).transpose()?,
        })
    }

    /// The keyframe of a state, with the image that it had; `None` if the state is of an image of another size.
    pub fn restore(
        gpu: &Gpu,
        store: &mut ImageStore,
        state: &KeyframeState,
        keyframe: &Keyframe,
        with_half: bool,
    ) -> Result<Option<Self>, MappingError> {
        let mut image = Cow::Borrowed(&keyframe.image);
        if let Some(Swept { metres }) = &state.swept {
            let Pinhole { width, height, .. } = image.pinhole;
            if metres.len() as u64 != u64::from(width) * u64::from(height) {
                return Ok(None);
            }
            image.to_mut().depth = Some(DepthImage { width, height, metres: metres.clone() });
        }
        let image = &*image;
        let images = Images::new(gpu, image, with_half)?;
        if !images.set_tile_losses(gpu, &state.tile_losses) {
            return Ok(None);
        }
        let mut restored = Self {
            id: state.id,
            camera: state.camera,
            tracked_from_world: state.tracked_from_world,
            anchored_from_world: state.anchored_from_world,
            refinement: state.refinement,
            exposure: state.exposure,
            depth_metres: state.depth_metres,
            gray: state.swept.as_ref().map(|_| plane_sweep::gray(&image.color)),
            image: images,
            covisible: state.covisible.clone(),
            loss: state.loss,
        };
        if !state.is_resident {
            restored.offload(gpu, store)?;
        }
        Ok(Some(restored))
    }

    /// The tracker moved it. Returns the motion of its Gaussians, new_from_old, once what has added up is more than a refinement.
    pub fn update_pose(&mut self, world_from_camera: &Se3) -> Option<Se3> {
        let camera_from_world = world_from_camera.inverse();
        self.track(camera_from_world);
        let motion = gaussian_stats::motion(&self.anchored_from_world.inverse(), world_from_camera)?;
        self.anchored_from_world = camera_from_world;
        Some(motion)
    }

    /// At the tracker's pose; its refinement goes along.
    fn track(&mut self, tracked_from_world: Se3) {
        self.tracked_from_world = tracked_from_world;
        self.camera.camera_from_world = self.refinement.refined_from_tracked * tracked_from_world;
    }

    /// Follows the images by one step, see [`PoseRefinement::step`].
    pub fn refine(&mut self, gradient: &[f32; 6], lr_scale: f32, config: &RefinePosesConfig) {
        self.refinement.step(gradient, lr_scale, config);
        self.track(self.tracked_from_world);
    }

    /// Whether its image is on the GPU.
    pub fn is_resident(&self) -> bool {
        self.image.whole.is_resident()
    }

    /// Moves its image from the GPU to the store.
    ///
    /// # Errors
    /// If the device fails.
    pub fn offload(&mut self, gpu: &Gpu, store: &mut ImageStore) -> Result<(), GpuError> {
        let Images { whole, half, stored } = &mut self.image;
        let Some(pixels) = whole.read_pixels(gpu)? else { return Ok(()) };
        let halved = half.as_ref().map_or(Ok(None), |half| half.read_pixels(gpu))?;
        *stored = Some((store.put(pixels), halved.map(|pixels| store.put(pixels))));
        whole.offload();
        half.iter_mut().for_each(TargetImage::offload);
        Ok(())
    }

    /// Pixels of the offloaded image, of the smaller one if `coarse` and there is one; `None` if they are on the GPU.
    ///
    /// # Errors
    /// If the store cannot be read.
    pub fn streamed<'a>(&'a self, coarse: bool, store: &ImageStore) -> std::io::Result<Option<Cow<'a, Pixels>>> {
        let image = self.image.stored.as_ref().map(|(whole, half)| half.as_ref().filter(|_| coarse).unwrap_or(whole));
        image.map(|image| store.get(image)).transpose()
    }

    /// Pixels of the whole image as they were recorded.
    ///
    /// # Errors
    /// If the device fails or the store cannot be read.
    pub fn pixels(&self, gpu: &Gpu, store: &ImageStore) -> Result<Pixels, MappingError> {
        match self.streamed(false, store)? {
            Some(pixels) => Ok(pixels.into_owned()),
            None => Ok(self.image.whole.read_pixels(gpu)?.expect("an image is on the GPU or in the store")),
        }
    }

    /// Whether its depth, if any, was estimated and not measured.
    pub fn depth_is_estimated(&self) -> bool {
        self.gray.is_some()
    }

    /// View of the plane sweep.
    pub fn source(&self) -> Option<SourceView<'_>> {
        self.gray.as_ref().map(|gray| SourceView { camera: self.camera, gray })
    }

    /// Bytes of its image on the GPU.
    pub fn image_bytes(&self) -> u64 {
        let pixels = u64::from(self.camera.pinhole.width * self.camera.pinhole.height);
        match (self.is_resident(), &self.image.half) {
            (false, _) => 0,
            (true, None) => pixels * 8,
            (true, Some(_)) => pixels * 10,
        }
    }

    /// Training view; the smaller image if `coarse` and there is one. An offloaded image is still to be streamed.
    pub fn view(&self, coarse: bool) -> TrainingView<'_> {
        match self.image.half.as_ref().filter(|_| coarse) {
            None => TrainingView { exposure: self.exposure, ..TrainingView::new(self.camera, &self.image.whole) },
            Some(target) => {
                let camera = ViewCamera { pinhole: halved_pinhole(&self.camera.pinhole), ..self.camera };
                TrainingView { exposure: self.exposure, ..TrainingView::new(camera, target) }
            }
        }
    }
}

/// Shorter sides below this many pixels are not halved.
const MIN_HALVED: u32 = 64;

/// Pinhole of the half-size image; an odd last row or column is left out.
fn halved_pinhole(p: &Pinhole) -> Pinhole {
    let half = |c: f64| (c + 0.5) * 0.5 - 0.5;
    Pinhole { fx: 0.5 * p.fx, fy: 0.5 * p.fy, cx: half(p.cx), cy: half(p.cy), width: p.width / 2, height: p.height / 2 }
}

/// Means of 2×2 pixels; of the depths only those that are measured and on the nearest surface.
fn halved(image: &RectifiedImage) -> RectifiedImage {
    let pinhole = halved_pinhole(&image.pinhole);
    let block = |x: u32, y: u32| [(0, 0), (1, 0), (0, 1), (1, 1)].map(|(dx, dy)| (2 * x + dx, 2 * y + dy));
    let color = RgbImage::from_fn(pinhole.width, pinhole.height, |x, y| {
        let sum = block(x, y)
            .map(|(x, y)| image.color.get_pixel(x, y).0.map(u32::from))
            .into_iter()
            .fold([2; 3], |sum, c| [sum[0] + c[0], sum[1] + c[1], sum[2] + c[2]]);
        Rgb(sum.map(|s| (s / 4) as u8))
    });
    let depth = image.depth.as_ref().map(|depth| {
        let mean = |i: u32| {
            let measured = block(i % pinhole.width, i / pinhole.width).map(|(x, y)| depth.at(x, y).unwrap_or(f32::INFINITY));
            let nearest = measured.into_iter().fold(f32::INFINITY, f32::min);
            let near = || measured.iter().filter(|m| m.is_finite() && **m < SAME_SURFACE * nearest);
            let count = near().count();
            if count > 0 { near().sum::<f32>() / count as f32 } else { 0.0 }
        };
        let metres = (0..pinhole.width * pinhole.height).map(mean).collect();
        DepthImage { width: pinhole.width, height: pinhole.height, metres }
    });
    let valid = image.valid.as_ref().map(|valid| {
        let width = image.pinhole.width;
        let all = |i: u32| block(i % pinhole.width, i / pinhole.width).iter().all(|(x, y)| valid[(y * width + x) as usize]);
        (0..pinhole.width * pinhole.height).map(all).collect()
    });
    RectifiedImage { pinhole, color, depth, valid }
}

/// Depths within this factor of each other are on one surface.
const SAME_SURFACE: f32 = 1.1;
