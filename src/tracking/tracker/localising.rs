//! A frame's pose, if it can be trusted: by the motion model, else by descriptors, else by relocalisation.

use super::Tracker;
use crate::tracking::features::frame_features::FrameFeatures;
use crate::tracking::localisation::localise::{Context, LastFrame, Localised};

/// For this many frames after the camera was found again, poses are held to the stricter count.
pub(super) const FRESHLY_FOUND_FRAMES: usize = 5;
/// Without a velocity, a pose by descriptors replaces that of the motion model from so many times its inliers on: a few far points agree with many
/// poses.
const CLEARLY_MORE: f64 = 1.5;
/// A true pose agrees with well over half of its matches, one by chance with few.
const MIN_INLIER_SHARE: f64 = 0.35;

impl Tracker {
    /// The frame's pose, if it can be trusted.
    pub(super) fn localise(&mut self, features: &FrameFeatures, last: &LastFrame) -> Option<Localised> {
        let strict = self.lostness.is_lost || self.lostness.frames_since_found < FRESHLY_FOUND_FRAMES;
        let needed = if strict { self.rig.config.min_relocalisation_inliers } else { self.rig.config.min_inliers };
        let reference = self.motion.reference;
        let predicted = self.expected_motion() * last.camera_from_world;
        let mut context = Context { map: &mut self.map, rig: &self.rig };
        let mut found = None;
        if !self.lostness.is_lost {
            let view = context.view_of_last(last);
            let mut start = context.with_motion_model(features, &view, &predicted);
            if self.motion.velocity.is_none() {
                let inliers = |found: &Option<Localised>| found.as_ref().map_or(0.0, |f| f.inliers as f64);
                let other = context.against_view(features, &view);
                start = if inliers(&other) > CLEARLY_MORE * inliers(&start) { other } else { start };
            }
            if let Some(start) = start {
                found = Some(context.in_local_map(features, &start, reference)).filter(|f| f.inliers >= needed);
            }
            if found.is_none()
                && let Some(start) = context
                    .against_view(features, &view)
                    .or_else(|| context.against_view(features, &context.view_of_keyframe(reference)))
            {
                found = Some(context.in_local_map(features, &start, reference)).filter(|f| f.inliers >= needed);
            }
        }
        if found.is_none() {
            let needed = self.rig.config.min_relocalisation_inliers;
            found = context.relocalise(features, reference).filter(|f| f.inliers >= needed);
        }
        let trusted = |f: &Localised| {
            let finite = f.camera_from_world.to_homogeneous().iter().all(|v| v.is_finite());
            finite && f.inliers as f64 >= MIN_INLIER_SHARE * f.matches as f64
        };
        found.filter(trusted)
    }
}
