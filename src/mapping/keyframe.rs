//! A keyframe as the mapper receives and keeps it.

mod images;

use std::borrow::Cow;

use image::GrayImage;
use nalgebra::Vector3;
use serde::{Deserialize, Serialize};

use super::chunks::{Outlook, Sight};
use super::image_store::ImageStore;
use super::plane_sweep::{self, SourceView};
use super::{KeyframeId, MappingError, PoseUpdate};
use crate::geometry::{Pinhole, Se3, Sim3};
use crate::gpu::{Gpu, GpuError, plain};
use crate::optimise::{Pixels, TargetImage, TrainingView};
use crate::sequence::{DepthImage, RectifiedImage};
use crate::splat::{Exposure, ViewCamera};
use images::{Images, halved_pinhole};

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
    /// Its exposure, if it is of a finished run: the keyframe is then only taken in, and nothing is measured or inserted.
    pub exposure: Option<Exposure>,
    /// Whether only its image counts: it inserts no Gaussians, and no steps of its own follow it.
    pub image_only: bool,
}

impl Keyframe {
    /// A keyframe at a pose (world_from_camera), whose depth, if any, is measured, and whose exposure is not known yet.
    pub fn new(id: KeyframeId, world_from_camera: Se3, image: RectifiedImage) -> Self {
        let (depth_source, covisible) = (DepthSource::Sensor, Vec::new());
        Self { id, world_from_camera, image, depth_source, covisible, exposure: None, image_only: false }
    }

    /// At the tracker's pose.
    pub fn camera(&self) -> ViewCamera {
        ViewCamera { pinhole: self.image.pinhole, camera_from_world: self.world_from_camera.inverse() }
    }

    /// Takes in a correction before the mapper has the keyframe. Depth of landmarks is scaled; measured depth stays.
    pub fn update_pose(&mut self, update: &PoseUpdate) {
        self.world_from_camera = update.world_from_camera;
        if let (DepthSource::Landmarks { .. }, Some(depth)) = (&self.depth_source, &mut self.image.depth) {
            depth.metres.iter_mut().for_each(|metres| *metres *= update.scale as f32);
        }
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
    /// At the tracker's pose.
    pub camera: ViewCamera,
    /// Exposure of the recorded image against the map.
    pub exposure: Exposure,
    /// Steps that learnt from it.
    pub steps: u32,
    /// Whether it inserted nothing, and the window leaves it out.
    pub image_only: bool,
    image: Images,
    /// On the host, where depth is swept for.
    gray: Option<GrayImage>,
    /// How far it sees.
    sight: Sight,
    pub covisible: Vec<KeyframeId>,
}

/// All of a keyframe but its image, which the recording has.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct KeyframeState {
    /// Identity, ascending in the order of tracking.
    pub id: KeyframeId,
    camera: ViewCamera,
    exposure: Exposure,
    steps: u32,
    image_only: bool,
    covisible: Vec<KeyframeId>,
    is_resident: bool,
    /// Depth that was swept for, `[H, W]`: it depends on what the other poses were then. Nothing where the recording has it.
    swept: Option<Swept>,
}

#[derive(Clone, Debug, Serialize, Deserialize)]
struct Swept {
    #[serde(with = "plain")]
    metres: Vec<f32>,
}

impl MappedKeyframe {
    /// Uploads the images, see [`Images::new`], as they were recorded. Its exposure is still to be measured.
    pub fn new(gpu: &Gpu, keyframe: &Keyframe, with_half: bool) -> Result<Self, GpuError> {
        let (image, camera) = (&keyframe.image, keyframe.camera());
        Ok(Self {
            id: keyframe.id,
            camera,
            exposure: Exposure::default(),
            steps: 0,
            image_only: keyframe.image_only,
            image: Images::new(gpu, image, with_half)?,
            gray: matches!(keyframe.depth_source, DepthSource::Landmarks { .. }).then(|| plane_sweep::gray(&image.color)),
            sight: Sight::of(image),
            covisible: keyframe.covisible.clone(),
        })
    }

    pub fn state(&self, gpu: &Gpu, store: &ImageStore) -> Result<KeyframeState, MappingError> {
        let swept = || Ok::<_, MappingError>(Swept { metres: self.image.depth_metres(gpu, store)? });
        Ok(KeyframeState {
            id: self.id,
            camera: self.camera,
            exposure: self.exposure,
            steps: self.steps,
            image_only: self.image_only,
            covisible: self.covisible.clone(),
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
        let mut restored = Self {
            id: state.id,
            camera: state.camera,
            exposure: state.exposure,
            steps: state.steps,
            image_only: state.image_only,
            gray: state.swept.as_ref().map(|_| plane_sweep::gray(&image.color)),
            image: images,
            sight: Sight::of(image),
            covisible: state.covisible.clone(),
        };
        if !state.is_resident {
            restored.offload(gpu, store)?;
        }
        Ok(Some(restored))
    }

    /// Takes in a correction of the tracker. Returns how that moves the world around it, new_from_old, if it does. Its estimated depth is scaled
    /// along; measured depth stays.
    pub fn update_pose(&mut self, gpu: &Gpu, store: &mut ImageStore, update: &PoseUpdate) -> Result<Option<Sim3>, MappingError> {
        let old_camera_from_world = self.camera.camera_from_world;
        self.camera.camera_from_world = update.world_from_camera.inverse();
        if update.scale != 1.0 && self.depth_is_estimated() {
            self.image.scale_depth(gpu, store, update.scale)?;
            self.sight.scale(update.scale as f32);
        }
        let stays = update.scale == 1.0 && self.camera.camera_from_world == old_camera_from_world;
        let world_from_new_camera = Sim3 { scale: update.scale, ..update.world_from_camera.into() };
        Ok((!stays).then(|| world_from_new_camera * Sim3::from(old_camera_from_world)))
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
        self.image.offload(gpu, store)
    }

    /// Pixels of the offloaded image, of the smaller one if `coarse` and there is one; `None` if they are on the GPU.
    ///
    /// # Errors
    /// If the store cannot be read.
    pub fn streamed<'a>(&'a self, coarse: bool, store: &ImageStore) -> std::io::Result<Option<Cow<'a, Pixels>>> {
        self.image.streamed(coarse, store)
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

    /// What it sees from where it is.
    pub fn outlook(&self) -> Outlook<'_> {
        self.sight.from(&self.camera)
    }

    /// Of the camera in the world, metres.
    pub fn position(&self) -> Vector3<f64> {
        self.camera.camera_from_world.inverse().translation.vector
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

    /// Its image at full size.
    pub fn target(&self) -> &TargetImage {
        &self.image.whole
    }

    /// Training view; the smaller image if `coarse` and there is one. An offloaded image is still to be streamed.
    pub fn view(&self, coarse: bool) -> TrainingView<'_> {
        let view = match self.image.half.as_ref().filter(|_| coarse) {
            None => TrainingView::new(self.camera, &self.image.whole),
            Some(target) => {
                let pinhole = halved_pinhole(&self.camera.pinhole);
                TrainingView::new(ViewCamera { pinhole, ..self.camera }, target)
            }
        };
        TrainingView { exposure: self.exposure, ..view }
    }
}
