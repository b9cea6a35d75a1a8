//! Which Gaussians are on the GPU. Before a keyframe is mapped, those that its window sees come back; where there is no room, those leave that no
//! keyframe near by sees.

use std::collections::BTreeSet;

use rayon::prelude::*;

use super::Mapper;
use crate::mapping::chunks::{ChunkId, Members, OrientedBox, Outlook, parts};
use crate::mapping::{MappingError, schedule};
use crate::render::{CloudPart, Plan};
use crate::splat::GaussianCloud;

/// Where Gaussians leave, a part in so many of the GPU's room becomes free, so that not at every keyframe some have to.
pub(super) const FREE_DIVISOR: usize = 8;

/// Neighbouring Gaussians on the GPU.
pub(super) struct Group {
    pub bounds: OrientedBox,
    /// In map order.
    pub places: Vec<u32>,
}

impl Mapper {
    /// Brings what the newest keyframe and its window see onto the GPU, as far as there is room: what is nearest to the newest one first.
    pub(super) fn page_for_window(&mut self) -> Result<(), MappingError> {
        self.needing = schedule::window(&self.keyframes, &self.config.window);
        if self.chunks.are_here() {
            return Ok(());
        }
        self.page_in()?;
        let newest = self.keyframes.len() - 1;
        if !self.is_short && self.hidden(newest).is_some() {
            self.is_short = true;
            tracing::warn!(
                "keyframe {} sees more Gaussians than the {} that the GPU has room for, and some keyframes are not learnt from; raise \
                 --max-gpu-memory",
                self.keyframes[newest].id,
                self.most_on_gpu()
            );
        }
        Ok(())
    }

    /// What the needing keyframes see comes back, in their order, until there is no more room.
    pub(super) fn page_in(&mut self) -> Result<(), MappingError> {
        let mut seen = BTreeSet::new();
        let mut wanted: Vec<ChunkId> = Vec::new();
        for k in &self.needing {
            wanted.extend(self.chunks.seen_by(&self.keyframes[*k].outlook()).into_iter().filter(|chunk| seen.insert(*chunk)));
        }
        if wanted.is_empty() {
            return Ok(());
        }
        self.make_room(wanted.iter().map(|chunk| self.chunks.gaussians(*chunk)).sum())?;
        let mut room = self.most_on_gpu().saturating_sub(self.cloud.len());
        let fits = |chunk: &&ChunkId| {
            let left = room.checked_sub(self.chunks.gaussians(**chunk));
            room = left.unwrap_or(0);
            left.is_some()
        };
        let coming: Vec<ChunkId> = wanted.iter().take_while(fits).copied().collect();
        let members = |chunk: &ChunkId| self.chunks.get(*chunk, self.config.sh_degree, self.cloud.rounds());
        let members = coming.iter().map(members).collect::<Result<Vec<Members>, _>>()?;
        self.cloud.limit(self.most_gaussians());
        let mut part = CloudPart::joined(members.iter().map(|members| &members.part));
        // Where they were fixed, it was for what was near them then.
        part.release();
        self.cloud.put_back(&self.gpu, &part)?;
        for (chunk, members) in coming.into_iter().zip(members) {
            self.anchors.put_back(&members.keyframes);
            self.chunks.is_back(chunk);
        }
        Ok(())
    }

    /// Where there is no room on the GPU for so many more Gaussians, images leave first, then Gaussians.
    pub(super) fn make_room(&mut self, more: usize) -> Result<(), MappingError> {
        let wanted = self.cloud.len() + more;
        if wanted <= self.most_on_gpu() || self.needing.is_empty() {
            return Ok(());
        }
        self.offload_images()?;
        let most = self.most_on_gpu();
        if wanted <= most {
            return Ok(());
        }
        let room = (most - most / FREE_DIVISOR).saturating_sub(more);
        let leaving = self.unseen(room)?;
        self.page_out(&leaving)
    }

    /// Groups on the GPU that neither a needing keyframe sees, nor one near the first of these. Those near by count in the order of what they have in
    /// common with the needing ones, as long as there is room.
    fn unseen(&self, room: usize) -> Result<Vec<Group>, MappingError> {
        let needing: Vec<Outlook<'_>> = self.needing.iter().map(|k| self.keyframes[*k].outlook()).collect();
        let is_needed = |group: &Group| needing.iter().any(|outlook| outlook.sees(&group.bounds));
        let (seen, mut unseen): (Vec<Group>, Vec<Group>) = self.groups()?.into_par_iter().partition(is_needed);
        let gaussians = |groups: &[Group], is_counted: &(dyn Fn(&Group) -> bool + Sync)| {
            groups.par_iter().filter(|group| is_counted(group)).map(|group| group.places.len()).sum::<usize>()
        };
        let near = self.keyframes_near(self.needing[0]).into_iter().map(|k| self.keyframes[k].outlook());
        let mut near: Vec<(usize, Outlook<'_>)> =
            near.map(|outlook| (gaussians(&seen, &|group| outlook.sees(&group.bounds)), outlook)).collect();
        near.sort_by_key(|(in_common, _)| std::cmp::Reverse(*in_common));
        let mut kept = self.cloud.frozen() + gaussians(&seen, &|_| true);
        for (_, outlook) in near {
            kept += gaussians(&unseen, &|group| outlook.sees(&group.bounds));
            if kept > room {
                break;
            }
            unseen.retain(|group| !outlook.sees(&group.bounds));
        }
        Ok(unseen)
    }

    /// Images that no needing keyframe has leave the GPU first: a step that uses one uploads it, but Gaussians are learnt only where there is room.
    fn offload_images(&mut self) -> Result<(), MappingError> {
        let leaving =
            self.keyframes.iter_mut().enumerate().filter(|(k, keyframe)| keyframe.is_resident() && !self.needing.contains(k));
        for (_, keyframe) in leaving {
            keyframe.offload(&self.gpu, &mut self.images)?;
        }
        Ok(())
    }

    /// Gaussians leave the GPU for the disk.
    fn page_out(&mut self, groups: &[Group]) -> Result<(), MappingError> {
        let mut places: Vec<(u32, usize)> =
            groups.iter().enumerate().flat_map(|(g, group)| group.places.iter().map(move |place| (*place, g))).collect();
        if places.is_empty() {
            return Ok(());
        }
        places.sort_unstable();
        let mut members = vec![Vec::new(); groups.len()];
        places.iter().enumerate().for_each(|(i, (_, group))| members[*group].push(i));
        let places: Vec<u32> = places.into_iter().map(|(place, _)| place).collect();
        let all = Members { part: self.cloud.copy_out(&self.gpu, &places)?, keyframes: self.anchors.at(&places) };
        members.iter().for_each(|which| self.chunks.put(&all.picked(which), self.cloud.rounds()));
        self.change(&Plan::removing(places))
    }

    /// All Gaussians on the GPU that may leave it.
    pub(super) fn groups(&self) -> Result<Vec<Group>, MappingError> {
        let first = self.cloud.frozen();
        let extents = self.cloud.extents(&self.gpu, first)?;
        let group = |part: Vec<usize>| Group {
            bounds: OrientedBox::around(&part.iter().map(|i| extents[*i]).collect::<Vec<_>>()),
            places: part.into_iter().map(|i| (first + i) as u32).collect(),
        };
        Ok(parts(&extents).into_iter().map(group).collect())
    }

    /// Adds what was on the disk to a map that was downloaded at the same time.
    ///
    /// # Errors
    /// If it cannot be read back.
    pub fn add_paged_out(&self, map: &mut GaussianCloud, paged_out: &PagedOut) -> Result<(), MappingError> {
        self.chunks.complete(map, &paged_out.0)
    }

    /// Downloads the averaged parameters of the Gaussians on the GPU, and says which ones are on the disk. Those stay there until the next such download.
    ///
    /// # Errors
    /// [`MappingError`] if a buffer does not fit or the device fails.
    pub fn download_resident(&self) -> Result<(GaussianCloud, PagedOut), MappingError> {
        Ok((self.cloud.download(&self.gpu)?, PagedOut(self.chunks.snapshot())))
    }
}

/// Gaussians that were on the disk at a download.
#[derive(Clone, Debug, Default)]
pub struct PagedOut(BTreeSet<ChunkId>);

impl PagedOut {
    /// Whether all Gaussians were on the GPU.
    pub fn is_nothing(&self) -> bool {
        self.0.is_empty()
    }
}
