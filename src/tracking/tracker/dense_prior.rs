//! RGB-D frames with few landmarks: the alignment of all pixels is a prior of the pose, and without landmarks the pose. Not across a gap, where a
//! false minimum looks like a pose. A frame that becomes a keyframe is aligned to older keyframes too: relative poses for bundle adjustment.

use std::sync::Arc;

use super::Tracker;
use crate::geometry::Se3;
use crate::tracking::features::dense_frame::DenseFrame;
use crate::tracking::front_end::ExtractedFrame;
use crate::tracking::localisation::dense_alignment::align;
use crate::tracking::localisation::localise::{Context, LastFrame, Localised};
use crate::tracking::map::tally::distinct;
use crate::tracking::solvers::relative_pose::RelativePose;

/// Frames without a pose after which pixels no longer say where the camera is.
const MAX_FRAMES_BRIDGED: usize = 2;
/// Overlap from which on the newest keyframe is the better reference than the last frame.
const KEYFRAME_OVERLAP: f64 = 0.5;
/// Keyframes that a keyframe is aligned to: before it, and of those that share most with it.
const RELATIVE_TO: usize = 3;

impl Tracker {
    /// The frame's pose from all its pixels and the landmarks that agree: against the newest keyframe, which drifts less than the last frame does,
    /// or against the last frame where too little of that keyframe is in view.
    pub(super) fn localise_densely(&mut self, frame: &ExtractedFrame, last: &LastFrame, guess: Option<Se3>) -> Option<Localised> {
        if self.lostness.frames_lost > MAX_FRAMES_BRIDGED {
            return None;
        }
        let (dense, before) = (frame.dense.as_ref()?, self.dense.last.as_ref()?);
        let mut guesses = vec![self.expected_motion() * last.camera_from_world, last.camera_from_world];
        guesses.extend(guess);
        let from = |reference: &Se3| guesses.iter().map(|pose| pose * reference.inverse()).collect::<Vec<Se3>>();
        let to_keyframe = self.dense.keyframe.as_ref().and_then(|(keyframe, view)| {
            let found = align(view, dense, &from(&self.map.keyframes[*keyframe].camera_from_world))?;
            (found.overlap >= KEYFRAME_OVERLAP).then(|| found.relative_pose(self.map.keyframes.len(), *keyframe))
        });
        let prior = match &to_keyframe {
            Some(relative) => relative.prior(&self.map.keyframes[relative.reference].camera_from_world),
            None => align(before, dense, &from(&last.camera_from_world))?.prior(&last.camera_from_world),
        };
        let mut context = Context { map: &mut self.map, rig: &self.rig };
        let found = context.with_prior(&frame.features, prior, self.motion.reference);
        Some(Localised { relative_pose: to_keyframe, ..found })
    }

    /// Poses of the frame that becomes a keyframe relative to older ones, by all pixels: those before it and those that share most landmarks with it.
    pub(super) fn relative_poses(
        &self,
        dense: &DenseFrame,
        camera_from_world: &Se3,
        landmarks: &[Option<usize>],
    ) -> Vec<RelativePose> {
        let (map, root) = (&self.map, self.map.keyframes[self.motion.reference].root);
        let covisible = map.covisibility(landmarks.iter().flatten().copied()).into_iter().map(|(k, _)| k).take(RELATIVE_TO);
        let before = map.living.iter().rev().copied().filter(|k| map.keyframes[*k].root == root).take(RELATIVE_TO);
        let references = distinct(before.chain(covisible)).into_iter();
        let relative = |reference: usize| {
            let keyframe = &map.keyframes[reference];
            let guess = camera_from_world * keyframe.camera_from_world.inverse();
            let found = align(keyframe.dense.as_ref()?, dense, &[guess]).filter(|found| found.overlap >= KEYFRAME_OVERLAP)?;
            Some(found.relative_pose(map.keyframes.len(), reference))
        };
        references.filter_map(relative).collect()
    }

    /// Keeps a tracked frame's pixels for the next.
    pub(super) fn keep_dense(&mut self, dense: Option<Arc<DenseFrame>>, is_keyframe: bool) {
        if is_keyframe {
            self.dense.keyframe = dense.clone().map(|view| (self.map.keyframes.len() - 1, view));
        }
        self.dense.last = dense;
    }
}
