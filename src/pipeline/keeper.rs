//! Keeps a run's checkpoints as it goes, and goes on from one.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Instant;

use crossbeam::channel::Receiver;

use super::checkpoint::{Checkpoint, CheckpointError, Course, Identity, Parts};
use super::heard::Heard;
use super::measurements::Teller;
use super::messages::guarded;
use super::{KeyframeRecord, MapperMessage, PipelineError};
use crate::config::Config;
use crate::export::ExportError;
use crate::gpu::Gpu;
use crate::mapping::{Mapper, MappingConfig, MappingError, RefinedPair, Refinement};
use crate::sequence::Sequence;

/// Where a run's checkpoint lies, and all of it that the mapper itself does not know.
#[derive(Debug)]
pub struct Checkpoints {
    path: PathBuf,
    identity: Identity,
    /// Keyframes, or rounds of the refinement.
    every: usize,
    /// Done since the last checkpoint.
    since: usize,
    /// To go on from, until that is done.
    from: Option<Course>,
    heard: Heard,
    told: Vec<Vec<RefinedPair>>,
    /// Before this process.
    earlier: Parts,
    started: Instant,
    failed: bool,
}

impl Checkpoints {
    /// For a run from its beginning. The first one is written at once, so that there is always something to resume.
    ///
    /// # Errors
    /// If it cannot be written.
    pub fn begin(path: &Path, (sequence, config): (&Sequence, &Config), gpu: &Gpu) -> Result<Self, ExportError> {
        let identity = Identity::of(sequence, config, gpu);
        Checkpoint::write(path, &identity, None)?;
        Ok(Self::new(path, identity, config, (None, Parts::default())))
    }

    /// For a run that goes on.
    ///
    /// # Errors
    /// If the checkpoint is of another run; says what differs.
    pub fn resume(checkpoint: Checkpoint, (sequence, config): (&Sequence, &Config), gpu: &Gpu) -> Result<Self, CheckpointError> {
        let identity = Identity::of(sequence, config, gpu);
        checkpoint.identity.check(&checkpoint.path, &identity)?;
        let mut earlier = checkpoint.course.as_ref().map_or_else(Parts::default, |course| course.parts);
        earlier.resumed += 1;
        Ok(Self::new(&checkpoint.path, identity, config, (checkpoint.course, earlier)))
    }

    fn new(path: &Path, identity: Identity, config: &Config, (from, earlier): (Option<Course>, Parts)) -> Self {
        Self {
            path: path.into(),
            identity,
            every: config.checkpoint_every.unwrap_or(usize::MAX),
            since: 0,
            heard: Heard::default(),
            told: Vec::new(),
            earlier,
            from,
            started: Instant::now(),
            failed: false,
        }
    }

    /// The run before this process, and that this one goes on from it.
    pub(super) fn earlier(&self) -> Parts {
        self.earlier
    }

    /// Whether there is a checkpoint to catch up with.
    pub(super) fn is_behind(&self) -> bool {
        self.from.is_some()
    }

    /// The mapper takes this message.
    pub(super) fn hear(&mut self, message: &MapperMessage) {
        self.heard.hear(message);
    }

    /// The mapper has told the tracker this of the keyframe that it mapped.
    pub(super) fn tell(&mut self, refined: Vec<RefinedPair>) {
        self.told.push(refined);
    }

    /// Another keyframe or round is done: writes a checkpoint if one is due. If that fails the run goes on without.
    pub(super) fn done(&mut self, mapper: &Mapper, refinement: Option<&Refinement>, records: &[KeyframeRecord]) {
        self.since += 1;
        if self.since < self.every {
            return;
        }
        self.since = 0;
        let began = Instant::now();
        let written = guarded("mapping", || {
            let wall_s = self.earlier.wall_s + self.started.elapsed().as_secs_f64();
            let parts = Parts { wall_s, ..self.earlier };
            let course = Course::new(self.heard, mapper.state(refinement)?, (records, &self.told), parts);
            Ok(Checkpoint::write(&self.path, &self.identity, Some(&course))?)
        });
        match written {
            Ok(bytes) => tracing::debug!(bytes, ms = began.elapsed().as_secs_f64() * 1e3, "checkpoint written"),
            Err(error) if !self.failed => {
                self.failed = true;
                tracing::warn!("{error}; the run goes on, and the checkpoint before this one stays");
            }
            Err(_) => {}
        }
    }

    /// Takes the messages up to the checkpoint again, for their images alone; `None` if the run begins. The tracker hears what it heard.
    ///
    /// # Errors
    /// If the messages end before, or are others than they were.
    pub(super) fn catch_up(
        &mut self,
        gpu: &Arc<Gpu>,
        config: &MappingConfig,
        (messages, tracker): (&Receiver<MapperMessage>, &Teller),
    ) -> Result<Option<Resumed>, PipelineError> {
        let Some(course) = self.from.take() else { return Ok(None) };
        let not_repeated = || PipelineError::NotRepeated { checkpoint: self.path.clone() };
        let explained = |error| match error {
            MappingError::State => CheckpointError::Damaged { path: self.path.clone() }.into(),
            MappingError::NotTheSame { .. } => not_repeated(),
            error => error.into(),
        };
        let mut mapper = Mapper::restore(gpu.clone(), config, &course.mapper).map_err(explained)?;
        let mut told = course.told.iter();
        while self.heard.messages < course.heard.messages {
            let Ok(message) = messages.recv() else { return Err(PipelineError::NotCaughtUp { checkpoint: self.path.clone() }) };
            self.heard.hear(&message);
            if let MapperMessage::Keyframe(keyframe) = message {
                mapper.insert_again(&keyframe, &course.mapper).map_err(explained)?;
                tracker.tell(keyframe.id, told.next().ok_or_else(not_repeated)?);
            }
        }
        if self.heard != course.heard || told.len() > 0 {
            return Err(not_repeated());
        }
        tracing::info!(keyframes = course.told.len(), gaussians = mapper.gaussians(), "caught up with the checkpoint");
        let records = course.records();
        self.told = course.told;
        Ok(Some(Resumed { mapper, refinement: course.mapper.into_refinement(), records }))
    }
}

/// What a checkpoint gives back.
pub(super) struct Resumed {
    pub mapper: Mapper,
    /// If it had begun.
    pub refinement: Option<Refinement>,
    pub records: Vec<KeyframeRecord>,
}
