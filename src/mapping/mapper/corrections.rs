//! Corrections of the tracker: keyframes that move take their Gaussians along, and those of submaps that never joined are removed.

use std::collections::{BTreeMap, BTreeSet};

use super::Mapper;
use crate::mapping::{KeyframeId, MappingError, PoseUpdate};
use crate::render::Plan;

impl Mapper {
    /// Moves earlier keyframes to better poses, one update each. The Gaussians inserted from a keyframe follow it, wherever they are; returns how
    /// many did. Unknown ids are those that were never sent to the mapper.
    ///
    /// # Errors
    /// [`MappingError`] if a buffer does not fit or the device fails.
    pub fn update_poses(&mut self, updates: &[PoseUpdate]) -> Result<usize, MappingError> {
        let mut motions = BTreeMap::new();
        let updates: BTreeMap<KeyframeId, &PoseUpdate> = updates.iter().map(|update| (update.keyframe, update)).collect();
        for keyframe in &mut self.keyframes {
            if let Some(update) = updates.get(&keyframe.id) {
                let motion = keyframe.update_pose(&self.gpu, &mut self.images, update)?;
                motions.extend(motion.map(|motion| (keyframe.id, motion)));
            }
        }
        let moved = self.anchors.moved(&motions);
        self.cloud.transform(&self.gpu, &moved)?;
        Ok(self.chunks.transform(&motions) + moved.gaussians())
    }

    /// Removes keyframes and the Gaussians inserted from them; returns how many Gaussians. Unknown ids are those that were never sent.
    ///
    /// # Errors
    /// [`MappingError`] if a buffer does not fit or the device fails.
    pub fn remove_keyframes(&mut self, keyframes: &[KeyframeId]) -> Result<usize, MappingError> {
        let keyframes: BTreeSet<KeyframeId> = keyframes.iter().copied().collect();
        let removed = self.anchors.of(&keyframes);
        let gaussians = removed.len() + self.chunks.remove(&keyframes, self.config.sh_degree)?;
        if !removed.is_empty() {
            self.change(&Plan::removing(removed))?;
        }
        self.keyframes.retain(|keyframe| !keyframes.contains(&keyframe.id));
        // Their entries are places among the keyframes.
        self.epoch.clear();
        self.learnable.clear();
        Ok(gaussians)
    }
}
