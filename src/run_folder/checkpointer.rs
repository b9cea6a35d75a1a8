//! Writes checkpoints during a run, and holds the state from which a resumed run continues.

use std::path::{Path, PathBuf};
use std::time::Instant;

use super::checkpoint::{Checkpoint, CheckpointError, Elapsed, Identity, RunState};
use super::history::KeyframeRecord;
use super::message_digest::MessageDigest;
use crate::files::WriteError;
use crate::gpu::Gpu;
use crate::mapping::{FinalRefinement, Mapper, MapperMessage, RefinedPair};
use crate::recording::Recording;

/// Path and interval of a run's checkpoints, and the part of its state that the mapper does not hold.
#[derive(Debug)]
pub struct Checkpointer {
    path: PathBuf,
    identity: Identity,
    /// Keyframes, or rounds of the final refinement.
    every: usize,
    /// Finished since the last checkpoint.
    since: usize,
    /// State to continue from, until the mapper has taken it.
    resume_from: Option<RunState>,
    digest: MessageDigest,
    feedback: Vec<Vec<RefinedPair>>,
    /// Before this process.
    earlier: Elapsed,
    started: Instant,
}

impl Checkpointer {
    /// Begins a run. The first checkpoint is written at once, so that the run can be resumed from any moment.
    ///
    /// # Errors
    /// If the checkpoint cannot be written.
    pub fn begin(path: &Path, recording: &Recording, gpu: &Gpu) -> Result<Self, WriteError> {
        let identity = Identity::of(recording, gpu);
        Checkpoint::write(path, &identity, None)?;
        Ok(Self::new(path, identity, recording, None))
    }

    /// Continues the run of a checkpoint.
    ///
    /// # Errors
    /// If the checkpoint belongs to another run; names what differs.
    pub fn resume(checkpoint: Checkpoint, recording: &Recording, gpu: &Gpu) -> Result<Self, CheckpointError> {
        let identity = Identity::of(recording, gpu);
        checkpoint.identity.check(&checkpoint.path, &identity)?;
        let mut resumed = Self::new(&checkpoint.path, identity, recording, checkpoint.state);
        resumed.earlier.resumed += 1;
        Ok(resumed)
    }

    fn new(path: &Path, identity: Identity, recording: &Recording, resume_from: Option<RunState>) -> Self {
        Self {
            path: path.into(),
            identity,
            every: recording.config().checkpoint_every.unwrap_or(usize::MAX),
            since: 0,
            digest: MessageDigest::default(),
            feedback: Vec::new(),
            earlier: resume_from.as_ref().map_or_else(Elapsed::default, |state| state.elapsed),
            resume_from,
            started: Instant::now(),
        }
    }

    /// Path of the checkpoint.
    pub(crate) fn path(&self) -> &Path {
        &self.path
    }

    /// Time and resumptions before this process, which counts as one where it resumes.
    pub(crate) fn earlier(&self) -> Elapsed {
        self.earlier
    }

    /// Whether the mapper has yet to reach the checkpoint.
    pub(crate) fn is_behind(&self) -> bool {
        self.resume_from.is_some()
    }

    /// The state to continue from; once.
    pub(crate) fn take_state(&mut self) -> Option<RunState> {
        self.resume_from.take()
    }

    /// Digest of the mapper's input so far.
    pub(crate) fn digest(&self) -> MessageDigest {
        self.digest
    }

    /// Records a message that the mapper has received.
    pub(crate) fn received(&mut self, message: &MapperMessage) {
        self.digest.update(message);
    }

    /// Records the pose feedback of a mapped keyframe.
    pub(crate) fn sent_feedback(&mut self, refined: Vec<RefinedPair>) {
        self.feedback.push(refined);
    }

    /// Counts a finished keyframe or round, and writes a checkpoint if one is due; returns its size in bytes.
    ///
    /// # Errors
    /// If the mapper's state cannot be downloaded or written. The checkpoint before it stays.
    pub(crate) fn finished_one(
        &mut self,
        mapper: &Mapper,
        refinement: Option<&FinalRefinement>,
        records: &[KeyframeRecord],
    ) -> Result<Option<usize>, CheckpointError> {
        self.since += 1;
        if self.since < self.every {
            return Ok(None);
        }
        self.since = 0;
        let wall_s = self.earlier.wall_s + self.started.elapsed().as_secs_f64();
        let elapsed = Elapsed { wall_s, ..self.earlier };
        let state = RunState::new(self.digest, mapper.state(refinement)?, records, &self.feedback, elapsed);
        Ok(Some(Checkpoint::write(&self.path, &self.identity, Some(&state))?))
    }
}
