//! The mapper: owns the Gaussians, their moments and the keyframe window.

mod control;
mod corrections;
mod exposures;
mod interlude;
mod paging;
mod refine;
mod start;
mod state;
mod stays;
mod steps;
mod views;
mod within_limits;

use std::borrow::Cow;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use cpu_time::ThreadTime;
use fastrand::Rng;
use serde::{Deserialize, Serialize};

pub use interlude::Interlude;
pub use paging::PagedOut;
pub use refine::{FinalRefinement, RefineReport};
pub use state::MapperState;
use stays::Turns;
use steps::Taken;

use super::anchors::Anchors;
use super::chunks::{Chunks, PagingFigures};
use super::host_time::HostTimes;
use super::image_store::ImageStore;
use super::insertion::Candidates;
use super::keyframe::{DepthSource, MappedKeyframe};
use super::plane_sweep::{self, SourceView};
use super::schedule::{self, Step};
use super::{InsertionConfig, Keyframe, KeyframeId, MappingConfig, MappingError, initialise_from_points};
use crate::geometry::Se3;
use crate::gpu::Gpu;
use crate::optimise::{DensityPasses, Survey, SurveyRules, Trainer};
use crate::render::{Blending, GpuCloud, Rendered};
use crate::sequence::RectifiedImage;
use crate::splat::{Exposure, GaussianCloud, ViewCamera};

/// Gaussians that there is room for at first; the map's buffers grow with it.
const FIRST_CAPACITY: usize = 4096;
/// Steps of the final refinement submitted at once: the GPU never waits for the host between them, and a stop is heeded between batches.
const BATCH: usize = 10;
/// The same of the steps that follow a keyframe. By default those after density control are one submission, and one wait.
const KEYFRAME_BATCH: usize = 16;
/// Fewer where others wait for the machine.
const YIELDING_BATCH: usize = 3;

/// Result of mapping a keyframe.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct KeyframeReport {
    /// The keyframe.
    pub id: KeyframeId,
    /// Gaussians inserted.
    pub inserted: usize,
    /// Gaussians removed.
    pub pruned: usize,
    /// Gaussians that came by dividing others.
    pub grown: usize,
    /// Gaussians in the map afterwards.
    pub gaussians: usize,
    /// Optimisation steps taken.
    pub iterations: usize,
    /// Mean PSNR of the steps' views before each step.
    pub psnr_db: f32,
    /// Against the map's.
    #[serde(default)]
    pub exposure: Exposure,
}

/// Inserts, optimises and prunes Gaussians.
#[derive(Debug)]
pub struct Mapper {
    /// Resolved configuration, immutable.
    config: Arc<MappingConfig>,
    gpu: Arc<Gpu>,
    trainer: Trainer,
    cloud: GpuCloud,
    anchors: Anchors,
    chunks: Chunks,
    /// Keyframes whose views need what they see on the GPU at present, the most important first.
    needing: Vec<usize>,
    /// Keyframes that steps can learn from while a part of the map is away, ascending.
    learnable: Vec<usize>,
    turns: Turns,
    density: DensityPasses,
    keyframes: Vec<MappedKeyframe>,
    /// Images beyond those on the GPU.
    images: ImageStore,
    rng: Rng,
    step_times: Vec<Duration>,
    host_times: HostTimes,
    /// Keyframes left of the running epoch of the final refinement.
    epoch: Vec<usize>,
    /// Steps at the last density control.
    controlled_at: usize,
    /// New Gaussians of all keyframes, those included that found no room.
    inserted: usize,
    /// Whether a map of others began this one.
    has_initial_map: bool,
    /// Gaussians that the buffers of the last step had room for.
    stepped_capacity: usize,
    /// Whether the adapter has no room for more Gaussians, which is reported once.
    is_full: bool,
    /// Whether a keyframe has seen more than the GPU has room for, which is reported once.
    is_short: bool,
}

impl Mapper {
    /// An empty map on `gpu`.
    ///
    /// # Errors
    /// [`MappingError`] if a buffer does not fit or the device fails.
    pub fn new(gpu: Arc<Gpu>, config: &MappingConfig) -> Result<Self, MappingError> {
        let blending = Blending::of(&gpu, config.surface);
        let mut config = config.clone();
        if blending.is_planar() {
            config.insertion.thickness = config.insertion.thickness.min(config.planar.thickness);
        }
        Ok(Self {
            trainer: Trainer::with_blending(gpu.clone(), blending)?.with_planar(config.planar),
            cloud: GpuCloud::new(&gpu, config.sh_degree, FIRST_CAPACITY)?.with_antialiasing(config.antialiased),
            anchors: Anchors::default(),
            chunks: Chunks::begin(None),
            needing: Vec::new(),
            learnable: Vec::new(),
            turns: Turns::default(),
            density: DensityPasses::new(&gpu)?,
            keyframes: Vec::new(),
            images: ImageStore::new(config.limits.max_host_bytes),
            rng: Rng::with_seed(config.seed),
            step_times: Vec::new(),
            host_times: HostTimes::default(),
            epoch: Vec::new(),
            controlled_at: 0,
            inserted: 0,
            has_initial_map: false,
            stepped_capacity: 0,
            is_full: false,
            is_short: false,
            config: Arc::new(config),
            gpu,
        })
    }

    /// Gaussians that leave the GPU go to this file and not to an unnamed temporary one. Those that a checkpoint names stay until the next, see
    /// [`Self::checkpoint_is_written`]. The file of an earlier run is removed.
    pub fn with_chunks(self, file: Option<PathBuf>) -> Self {
        Self { chunks: Chunks::begin(file), ..self }
    }

    /// Takes in a keyframe: inserts what the map lacks, optimises over the window, prunes. `interlude` comes between the steps. A keyframe
    /// without depth is passed over until there is a map.
    ///
    /// # Errors
    /// [`MappingError`] if a buffer does not fit or the device fails.
    pub fn insert(&mut self, keyframe: &Keyframe, interlude: &dyn Interlude) -> Result<KeyframeReport, MappingError> {
        if keyframe.image.depth.is_none() && self.has_not_begun() {
            return Ok(KeyframeReport { id: keyframe.id, ..KeyframeReport::default() });
        }
        let keyframe = self.timed("depth", |mapper| mapper.sweep(keyframe)).map_or(Cow::Borrowed(keyframe), Cow::Owned);
        // Before its insertion: a bound on memory leaves to it what the image has left.
        let mut mapped = self.timed("image", |mapper| mapper.upload(&keyframe))?;
        if let Some(exposure) = keyframe.exposure {
            mapped.exposure = exposure;
            self.keyframes.push(mapped);
            self.limit_gpu_images()?;
            return Ok(KeyframeReport { id: keyframe.id, gaussians: self.gaussians(), exposure, ..KeyframeReport::default() });
        }
        self.keyframes.push(mapped);
        if keyframe.image_only {
            return self.follow_image(&keyframe, interlude);
        }
        self.timed("paging", Self::page_for_window)?;
        let config = self.config.clone();
        let (candidates, survey) = std::thread::scope(|scope| {
            let candidates = scope.spawn(|| Candidates::new(&keyframe.image, &config.insertion));
            let survey = self.timed("survey", |mapper| mapper.survey(keyframe.image.depth.is_some()));
            (candidates.join().expect("the candidates are found"), survey)
        });
        let survey = survey?;
        let exposure = self.expose(&keyframe, survey.as_ref());
        self.limit_gpu_images()?;
        let insert =
            |mapper: &mut Self, candidates| mapper.insert_gaussians(&keyframe, &candidates, (survey.as_ref(), &exposure));
        let inserted = candidates.map_or(Ok(0), |candidates| self.timed("insertion", |mapper| insert(mapper, candidates)))?;
        let first = self.full_keyframes() == 1;
        let iterations = if first { self.config.first_iterations } else { self.config.iterations_per_keyframe };
        if iterations == 0 {
            return Ok(KeyframeReport {
                id: keyframe.id,
                inserted,
                gaussians: self.gaussians(),
                exposure,
                ..KeyframeReport::default()
            });
        }
        let report = self.optimise(iterations, interlude)?;
        Ok(KeyframeReport { id: keyframe.id, inserted, gaussians: self.gaussians(), exposure, ..report })
    }

    /// What follows an image-only keyframe: in real time, steps over all keyframes go on.
    fn follow_image(&mut self, keyframe: &Keyframe, interlude: &dyn Interlude) -> Result<KeyframeReport, MappingError> {
        let survey = if self.is_measured() { self.timed("survey", |mapper| mapper.survey(false))? } else { None };
        let exposure = self.expose(keyframe, survey.as_ref());
        self.limit_gpu_images()?;
        let taken = if self.config.yields_to_keyframes { self.consolidate_until(interlude)? } else { Taken::default() };
        let (iterations, psnr_db) = (taken.steps, taken.psnr_db());
        let report = KeyframeReport { id: keyframe.id, gaussians: self.gaussians(), exposure, ..KeyframeReport::default() };
        Ok(KeyframeReport { iterations, psnr_db, ..report })
    }

    /// Number of keyframes that are not image-only.
    pub fn full_keyframes(&self) -> usize {
        self.keyframes.iter().filter(|keyframe| !keyframe.image_only).count()
    }

    /// Downloads the averaged parameters of all Gaussians. Blocks until the GPU is idle.
    ///
    /// # Errors
    /// [`MappingError`] if a buffer does not fit, the device fails, or Gaussians cannot be read back from the disk.
    pub fn download(&self) -> Result<GaussianCloud, MappingError> {
        let mut map = self.cloud.download(&self.gpu)?;
        self.chunks.complete(&mut map, &self.chunks.away())?;
        Ok(map)
    }

    /// Renders what is on the GPU over black.
    ///
    /// # Errors
    /// [`MappingError`] if a buffer does not fit or the device fails.
    pub fn render(&mut self, camera: &ViewCamera) -> Result<Rendered, MappingError> {
        Ok(self.trainer.render(&self.cloud, camera, [0.0; 3])?)
    }

    /// The Gaussians on the GPU, to be rendered by others.
    pub fn map(&self) -> &GpuCloud {
        &self.cloud
    }

    /// The device that it works on.
    pub fn gpu(&self) -> &Arc<Gpu> {
        &self.gpu
    }

    /// Duration of each step so far: its share of its batch.
    pub fn step_times(&self) -> &[Duration] {
        &self.step_times
    }

    /// CPU time of the calling threads so far, by part of the work.
    pub fn host_times(&self) -> &HostTimes {
        &self.host_times
    }

    fn timed<T>(&mut self, part: &'static str, work: impl FnOnce(&mut Self) -> T) -> T {
        let started = ThreadTime::now();
        let done = work(self);
        self.host_times.add(part, started);
        done
    }

    /// Whether any step has moved the map: before, its colours are those of single pixels.
    fn is_trained(&self) -> bool {
        !self.step_times.is_empty()
    }

    /// Whether it has passed over all keyframes so far.
    pub fn has_not_begun(&self) -> bool {
        self.keyframes.is_empty() && self.cloud.is_empty()
    }

    /// Number of Gaussians in the map, those on the disk included.
    pub fn gaussians(&self) -> usize {
        self.cloud.len() + self.chunks.gaussians_away()
    }

    /// Whether Gaussians have left the GPU at any time.
    pub fn has_paged_out(&self) -> bool {
        self.paging() != PagingFigures::default()
    }

    /// What left the GPU for the disk, and what came back.
    pub fn paging(&self) -> PagingFigures {
        self.chunks.figures()
    }

    /// A checkpoint of this state has been written.
    pub fn checkpoint_is_written(&mut self) {
        self.chunks.checkpoint_is_written();
    }

    /// The map seen from the newest keyframe, if it is compared with it: by its depth or to find its exposure.
    fn survey(&mut self, has_depth: bool) -> Result<Option<Survey>, MappingError> {
        let Some(keyframe) = self.keyframes.last() else { return Ok(None) };
        let is_compared = has_depth || (self.config.exposure.enabled && self.is_trained());
        if !is_compared || self.cloud.is_empty() {
            return Ok(None);
        }
        let InsertionConfig { stride, min_alpha, depth_disagreement, .. } = self.config.insertion;
        let rules = SurveyRules { target: keyframe.target(), cell: stride, min_alpha, depth_disagreement };
        Ok(Some(self.trainer.survey(&self.cloud, &keyframe.camera, has_depth.then_some(&rules))?))
    }

    /// The keyframe with more depth than that of its landmarks, if that is what it has and more can be found.
    fn sweep(&self, keyframe: &Keyframe) -> Option<Keyframe> {
        let DepthSource::Landmarks { right } = &keyframe.depth_source else { return None };
        let (image, config) = (&keyframe.image, &self.config.plane_sweep);
        let landmarks = image.depth.as_ref().filter(|_| config.enabled)?;
        let camera = keyframe.camera();
        let beside = right.as_ref().map(|right| {
            let right_from_left = Se3::translation(-right.baseline_metres, 0.0, 0.0);
            let camera = ViewCamera { camera_from_world: right_from_left * camera.camera_from_world, ..camera };
            SourceView { camera, gray: &right.gray }
        });
        let earlier =
            |id: &KeyframeId| self.keyframes.binary_search_by_key(id, |k| k.id).ok().and_then(|k| self.keyframes[k].source());
        let others: Vec<SourceView<'_>> = beside.into_iter().chain(keyframe.covisible.iter().filter_map(earlier)).collect();
        let gray = plane_sweep::gray(&image.color);
        let mut depth = plane_sweep::estimate(&SourceView { camera, gray: &gray }, landmarks, &others, config)?;
        depth
            .metres
            .iter_mut()
            .zip(&landmarks.metres)
            .filter(|(_, metres)| **metres > 0.0)
            .for_each(|(to, metres)| *to = *metres);
        (0..depth.metres.len()).filter(|&i| !image.is_valid(i)).for_each(|i| depth.metres[i] = 0.0);
        let image = RectifiedImage { depth: Some(depth), ..image.clone() };
        Some(Keyframe { image, ..keyframe.clone() })
    }

    /// Steps over the window, of which some score the Gaussians, whose density is then controlled; then steps over all keyframes. Reports what it did.
    fn optimise(&mut self, iterations: usize, interlude: &dyn Interlude) -> Result<KeyframeReport, MappingError> {
        if self.cloud.is_empty() {
            return Ok(KeyframeReport::default());
        }
        self.timed("paging", Self::fix_context)?;
        let window = self.learnable(schedule::window(&self.keyframes, &self.config.window));
        if window.is_empty() {
            return Ok(KeyframeReport::default());
        }
        let config = self.config.clone();
        let (density, adam) = (&config.density, config.adam.online());
        // Where an adapter takes hundreds of steps before the next keyframe, a few more for density control delay nothing.
        let is_fast = config.yields_to_keyframes && self.step_times.len() - self.controlled_at >= config.refine.density_every;
        let controlled = is_fast || self.full_keyframes().is_multiple_of(density.every);
        let mut scoring = if controlled { self.scoring_steps(&window, density) } else { Vec::new() };
        scoring.truncate(iterations);
        let unscored = iterations - scoring.len();
        let mut before: Vec<Step> = window.iter().cycle().take(unscored).map(|k| Step::new(*k)).collect();
        let mut after = before.split_off((density.after_share * unscored as f32).round() as usize);
        // Together where they are one batch: the host waits once.
        if !controlled {
            after.splice(..0, before.drain(..));
        } else if before.len() + scoring.len() <= self.batch() {
            scoring.splice(..0, before.drain(..));
        }
        let mut taken = self.take(&before, &adam, interlude)?;
        self.cloud.begin_round();
        let (mut pruned, mut grown) = (0, 0);
        if controlled {
            self.trainer.begin_scores(&self.cloud)?;
            let scored = self.take_scored(&scoring, &adam, density)?;
            taken += scored.0;
            (pruned, grown) = self.timed("density", |mapper| mapper.control_density(scored.1, density))?;
            self.controlled_at = self.step_times.len();
        }
        let rest = self.with_consolidation(after);
        taken += self.take(&rest, &adam, interlude)?;
        if config.yields_to_keyframes {
            taken += self.consolidate_until(interlude)?;
        }
        let (iterations, psnr_db) = (taken.steps, taken.psnr_db());
        Ok(KeyframeReport { pruned, grown, iterations, psnr_db, ..KeyframeReport::default() })
    }
}
