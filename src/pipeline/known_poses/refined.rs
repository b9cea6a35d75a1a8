//! A finished run that is refined: its poses, its exposures and its map, or the part of them that a region needs.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::Arc;

use rayon::prelude::*;

use crate::config::RefinedConfig;
use crate::evaluation::Exposures;
use crate::evaluation::trajectory::MAX_TIME_DIFFERENCE_S;
use crate::geometry::{Se3, StampedPose, Trajectory};
use crate::mapping::InitialMap;
use crate::partition::{Coverage, Place, Region, RegionView};
use crate::pipeline::PipelineError;
use crate::recording::Recording;
use crate::run_folder::outputs;
use crate::sequence::Sequence;
use crate::splat::{Exposure, GaussianCloud, ViewCamera};

/// A Gaussian is refined with a region whose keyframes see this share of what all see of it.
const LEAST_SUPERVISION: f32 = 0.8;
/// Standard deviations of a Gaussian within which a border is its own.
const BORDER_DEVIATIONS: f32 = 2.0;
/// Keyframes looked at side by side.
const AT_ONCE: usize = 64;

/// A keyframe of the run.
#[derive(Clone, Debug)]
pub(super) struct RefinedKeyframe {
    pub world_from_camera: Se3,
    pub exposure: Exposure,
    /// `[height * width]` of the mapping resolution: pixels that show the region or its halo; `None`: all.
    pub valid: Option<Arc<[bool]>>,
    pub image_only: bool,
}

/// What of a run is refined.
#[derive(Clone, Debug)]
pub(super) struct Refined {
    /// Frame and pose of all that was tracked.
    pub trajectory: Vec<(usize, StampedPose)>,
    /// By frame.
    pub keyframes: BTreeMap<usize, RefinedKeyframe>,
    pub map: InitialMap,
}

impl Refined {
    /// Reads a run. With a region: its keyframes are those that see it, and its map has first, frozen, what these see beyond the halo.
    ///
    /// # Errors
    /// [`PipelineError::RefinedRun`] if a file of it is missing, does not parse or belongs to another recording; [`PipelineError::NotSeen`] if no
    /// keyframe sees the region.
    pub fn read(config: &RefinedConfig, map: Arc<GaussianCloud>, recording: &Recording) -> Result<Self, PipelineError> {
        let sequence = recording.sequence();
        let wrong = |path: PathBuf, reason: String| PipelineError::RefinedRun { path, reason };
        let poses = |name: &str| {
            let path = config.run.join(name);
            let trajectory = Trajectory::read_tum(&path).map_err(|error| wrong(path.clone(), error.to_string()))?;
            let found = frames(sequence, &trajectory);
            if found.is_empty() {
                return Err(wrong(path, format!("has no pose near a frame of {}", sequence.name)));
            }
            Ok(found)
        };
        let exposures_file = config.run.join(outputs::EXPOSURES);
        let exposures = Exposures::read(&exposures_file).map_err(|reason| wrong(exposures_file, reason))?;
        let keyframe = |(frame, pose): (usize, StampedPose), image_only| {
            let exposure = exposures.at(pose.timestamp_s);
            (frame, RefinedKeyframe { world_from_camera: pose.world_from_camera, exposure, valid: None, image_only })
        };
        // Image-only keyframes have exposures and are not in the list.
        let trajectory = poses(outputs::TRAJECTORY)?;
        let exposed = trajectory.iter().filter(|(_, pose)| exposures.has(pose.timestamp_s));
        let mut keyframes: BTreeMap<usize, RefinedKeyframe> = exposed.map(|found| keyframe(*found, true)).collect();
        keyframes.extend(poses(outputs::KEYFRAMES)?.into_iter().map(|found| keyframe(found, false)));
        let whole = Self { trajectory, keyframes, map: InitialMap { cloud: map, frozen: 0 } };
        match config.region {
            Some(region) => whole.within(&region, recording),
            None => Ok(whole),
        }
    }

    /// The part of it that a region needs.
    fn within(self, region: &Region, recording: &Recording) -> Result<Self, PipelineError> {
        let cloud = &*self.map.cloud;
        let places: Vec<Place> = cloud.means.iter().map(|mean| region.place(*mean)).collect();
        let near: Vec<u32> =
            (0..).zip(&places).filter(|(_, place)| **place != Place::Beyond).map(|(gaussian, _)| gaussian).collect();
        let keyframes: Vec<(usize, RefinedKeyframe)> = self.keyframes.into_iter().collect();
        let look = |(frame, keyframe): &(usize, RefinedKeyframe)| {
            let pinhole = recording.map_pinhole_of(*frame);
            let camera = ViewCamera { pinhole, camera_from_world: keyframe.world_from_camera.inverse() };
            // In a large scene, most cameras look elsewhere.
            Coverage::any_in_view(cloud, &camera, &near).then(|| {
                let coverage = Coverage::of(cloud, &camera);
                let part = RegionView::of(&coverage, &places);
                (pinhole, coverage, part)
            })
        };
        let (mut is_context, mut supervision) = (vec![false; cloud.len()], vec![Supervision::default(); cloud.len()]);
        let mut chosen = BTreeMap::new();
        // Sums in the order of the keyframes, a few of which are held at a time.
        for keyframes in keyframes.chunks(AT_ONCE) {
            let seen: Vec<_> = keyframes.par_iter().map(look).collect();
            for ((frame, keyframe), seen) in keyframes.iter().zip(seen) {
                let Some((pinhole, coverage, part)) = seen else { continue };
                for (block, gaussian, share) in &coverage.shares {
                    let here = part.as_ref().is_some_and(|part| part.valid[*block as usize]);
                    supervision[*gaussian as usize].add(*share, here);
                }
                let Some(RegionView { valid, context }) = part else { continue };
                context.into_iter().for_each(|gaussian| is_context[gaussian as usize] = true);
                let valid = coverage.to_pixels(&valid, pinhole.width, pinhole.height);
                chosen.insert(*frame, RefinedKeyframe { valid: Some(valid.into()), ..keyframe.clone() });
            }
        }
        if chosen.is_empty() {
            return Err(PipelineError::NotSeen);
        }
        // What reaches through the border stays as it is on both sides: moved across it, it would be left twice, or not at all.
        let is_shared =
            |i: usize| region.border_crosses(cloud.means[i], BORDER_DEVIATIONS * cloud.log_scales[i].max_element().exp());
        let moves = |i: usize| places[i] != Place::Beyond && supervision[i].is_enough() && !is_shared(i);
        let stays = |i: usize| !moves(i) && (places[i] != Place::Beyond || is_context[i]);
        let mut part = cloud.picked((0..cloud.len()).filter(|i| stays(*i)));
        let frozen = part.len();
        part.append(&cloud.picked((0..cloud.len()).filter(|i| moves(*i))));
        tracing::info!(keyframes = chosen.len(), gaussians = part.len() - frozen, frozen, "region");
        Ok(Self { keyframes: chosen, map: InitialMap { cloud: Arc::new(part), frozen }, ..self })
    }
}

/// What all keyframes see of a Gaussian, and what those of a region see of it: blocks' light.
#[derive(Clone, Copy, Debug, Default)]
struct Supervision {
    all: f32,
    here: f32,
}

impl Supervision {
    fn add(&mut self, share: f32, here: bool) {
        self.all += share;
        self.here += if here { share } else { 0.0 };
    }

    /// Whether the region's keyframes see nearly all of it that is seen: steps that are blind for the rest would spoil that.
    fn is_enough(self) -> bool {
        self.here >= LEAST_SUPERVISION * self.all
    }
}

/// The core of a region in a map, refined or frozen.
pub(super) fn core_of(map: &GaussianCloud, region: &Region) -> GaussianCloud {
    map.picked((0..map.len()).filter(|&i| region.place(map.means[i]) == Place::Core))
}

/// The frame nearest in time to each pose, once.
fn frames(sequence: &Sequence, trajectory: &Trajectory) -> Vec<(usize, StampedPose)> {
    let nearest = |pose: &StampedPose| Some((sequence.nearest(pose.timestamp_s, MAX_TIME_DIFFERENCE_S)?, *pose));
    let found: BTreeMap<usize, StampedPose> = trajectory.poses.iter().filter_map(nearest).collect();
    found.into_iter().collect()
}
