//! RGB-D frames with few landmarks: the alignment of all pixels is a prior of the pose, and without landmarks the pose. Not across a gap, where a
//! false minimum looks like a pose.

use std::sync::Arc;

use super::Tracker;
use crate::geometry::Se3;
use crate::tracking::features::dense_frame::DenseFrame;
use crate::tracking::front_end::ExtractedFrame;
use crate::tracking::localisation::dense_alignment::align;
use crate::tracking::localisation::localise::{Context, LastFrame, Localised};

/// Frames without a pose after which pixels no longer say where the camera is.
const MAX_FRAMES_BRIDGED: usize = 2;
/// Overlap from which on the newest keyframe is the better reference than the last frame.
const KEYFRAME_OVERLAP: f64 = 0.5;

impl Tracker {
    /// The frame's pose from all its pixels and the landmarks that agree: against the last frame, then against the newest keyframe, which drifts
    /// less, and once more where that is the last frame: the best of three guesses may be a false minimum.
    pub(super) fn localise_densely(&mut self, frame: &ExtractedFrame, last: &LastFrame, guess: Option<Se3>) -> Option<Localised> {
        if self.lostness.frames_lost > MAX_FRAMES_BRIDGED {
            return None;
        }
        let (dense, before) = (frame.dense.as_ref()?, self.dense.last.as_ref()?);
        let mut guesses = vec![self.expected_motion(), Se3::identity()];
        guesses.extend(guess.map(|pose| pose * last.camera_from_world.inverse()));
        let mut prior = align(before, dense, &guesses)?.prior(&last.camera_from_world);
        if let Some((keyframe, view)) = &self.dense.keyframe {
            let pose = self.map.keyframes[*keyframe].camera_from_world;
            let guess = prior.camera_from_world * pose.inverse();
            if let Some(found) = align(view, dense, &[guess]).filter(|found| found.overlap >= KEYFRAME_OVERLAP) {
                prior = found.prior(&pose);
            }
        }
        let mut context = Context { map: &mut self.map, rig: &self.rig };
        Some(context.with_prior(&frame.features, prior, self.motion.reference))
    }

    /// Keeps a tracked frame's pixels for the next.
    pub(super) fn keep_dense(&mut self, dense: Option<Arc<DenseFrame>>, is_keyframe: bool) {
        if is_keyframe {
            self.dense.keyframe = dense.clone().map(|view| (self.map.keyframes.len() - 1, view));
        }
        self.dense.last = dense;
    }
}
