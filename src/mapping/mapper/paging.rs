//! Which Gaussians are on the GPU. Before a keyframe is mapped, those that its window sees come back, and the farthest of the others leave. In the final
//! refinement, neighbouring keyframes whose views fit the GPU are refined together for some epochs, then the next ones.

use std::collections::BTreeSet;

use super::Mapper;
use crate::mapping::chunks::{Ball, ChunkId, Members, Outlook, parts};
use crate::mapping::{MappingError, schedule};
use crate::render::{CloudPart, Plan};
use crate::splat::GaussianCloud;

/// Where Gaussians leave, a part in so many of the GPU's room becomes free, so that not at every keyframe some have to.
const FREE_DIVISOR: usize = 8;
/// Epochs of the final refinement over the keyframes of a stay.
const EPOCHS_A_STAY: usize = 3;

/// Neighbouring Gaussians on the GPU.
struct Group {
    ball: Ball,
    /// In map order.
    places: Vec<u32>,
}

impl Mapper {
    /// Keyframes of these that see nothing of what is away.
    pub(super) fn complete(&self, keyframes: impl IntoIterator<Item = usize>) -> Vec<usize> {
        keyframes.into_iter().filter(|k| self.is_complete(*k)).collect()
    }

    pub(super) fn is_complete(&self, k: usize) -> bool {
        self.chunks.are_here() || self.chunks.is_complete(&self.keyframes[k].outlook())
    }

    /// Brings what the newest keyframe and its window see onto the GPU, as far as there is room: what is nearest to the newest one first.
    pub(super) fn page_for_window(&mut self) -> Result<(), MappingError> {
        self.needing = schedule::window(&self.keyframes, &self.config.window);
        if self.chunks.are_here() {
            return Ok(());
        }
        self.page_in()?;
        let newest = self.keyframes.len() - 1;
        if !self.is_short && !self.is_complete(newest) {
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
    fn page_in(&mut self) -> Result<(), MappingError> {
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
        self.cloud.put_back(&self.gpu, &CloudPart::joined(members.iter().map(|members| &members.part)))?;
        for (chunk, members) in coming.into_iter().zip(members) {
            self.anchors.put_back(&members.keyframes);
            self.chunks.is_back(chunk);
        }
        Ok(())
    }

    /// Where there is no room on the GPU for so many more Gaussians, those leave that no needing keyframe sees, the farthest first.
    pub(super) fn make_room(&mut self, more: usize) -> Result<(), MappingError> {
        let most = self.most_on_gpu();
        let wanted = self.cloud.len() + more;
        if wanted <= most || self.needing.is_empty() {
            return Ok(());
        }
        let excess = wanted - (most - most / FREE_DIVISOR);
        let outlooks: Vec<Outlook<'_>> = self.needing.iter().map(|k| self.keyframes[*k].outlook()).collect();
        let groups = self.groups()?.into_iter().filter(|group| !outlooks.iter().any(|outlook| outlook.sees(&group.ball)));
        let mut groups: Vec<(f32, Group)> = groups.map(|group| (outlooks[0].distance(&group.ball), group)).collect();
        groups.sort_by(|a, b| b.0.total_cmp(&a.0));
        let mut freed = 0;
        let leaves = |(_, group): &(f32, Group)| {
            let leaves = freed < excess;
            freed += group.places.len();
            leaves
        };
        let leaving: Vec<Group> = groups.into_iter().take_while(leaves).map(|(_, group)| group).collect();
        self.page_out(&leaving)
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
    fn groups(&self) -> Result<Vec<Group>, MappingError> {
        let first = self.cloud.frozen();
        let extents = self.cloud.extents(&self.gpu, first)?;
        let group = |part: Vec<usize>| Group {
            ball: Ball::around(&part.iter().map(|i| extents[*i]).collect::<Vec<_>>()),
            places: part.into_iter().map(|i| (first + i) as u32).collect(),
        };
        Ok(parts(&extents).into_iter().map(group).collect())
    }

    /// The keyframes of the next stay of the final refinement, [`EPOCHS_A_STAY`] times each, after what they see has come to the GPU; none where no view
    /// fits it.
    pub(super) fn next_stay(&mut self) -> Result<Vec<usize>, MappingError> {
        for _ in 0..self.keyframes.len() {
            let fewest = self.visits.iter().copied().min().unwrap_or(0);
            let due: Vec<usize> = (0..self.keyframes.len()).filter(|k| self.visits[*k] == fewest).collect();
            self.needing = self.fitting(&due)?;
            self.page_in()?;
            let mut stay = self.complete(due.iter().copied());
            // One that sees more than fits is left out of this round of visits.
            let visited = if stay.is_empty() { &due[..1] } else { &stay[..] };
            visited.iter().for_each(|k| self.visits[*k] += EPOCHS_A_STAY as u32);
            tracing::debug!(keyframes = stay.len(), due = due.len(), resident = self.cloud.len(), "stay");
            if !stay.is_empty() {
                let mut epochs = Vec::with_capacity(stay.len() * EPOCHS_A_STAY);
                for _ in 0..EPOCHS_A_STAY {
                    self.rng.shuffle(&mut stay);
                    epochs.extend_from_slice(&stay);
                }
                return Ok(epochs);
            }
        }
        Ok(Vec::new())
    }

    /// The first of these keyframes, as many as have room for what they see on the GPU beside each other.
    fn fitting(&self, keyframes: &[usize]) -> Result<Vec<usize>, MappingError> {
        let room = self.most_on_gpu() - self.most_on_gpu() / FREE_DIVISOR;
        let groups = self.groups()?;
        let (mut here, mut away) = (vec![false; groups.len()], BTreeSet::new());
        let mut gaussians = self.cloud.frozen();
        let mut fitting = Vec::new();
        for k in keyframes {
            let outlook = self.keyframes[*k].outlook();
            for (group, is_counted) in groups.iter().zip(&mut here).filter(|(_, is_counted)| !**is_counted) {
                *is_counted = outlook.sees(&group.ball);
                gaussians += if *is_counted { group.places.len() } else { 0 };
            }
            let new = self.chunks.seen_by(&outlook).into_iter().filter(|chunk| away.insert(*chunk));
            gaussians += new.map(|chunk| self.chunks.gaussians(chunk)).sum::<usize>();
            if gaussians > room && !fitting.is_empty() {
                break;
            }
            fitting.push(*k);
        }
        Ok(fitting)
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
