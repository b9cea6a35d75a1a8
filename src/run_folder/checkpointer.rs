//! Writes checkpoints during a run, and holds the state from which a resumed run continues.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use super::checkpoint::{Checkpoint, CheckpointError, Elapsed, Identity, RunState};
use super::history::KeyframeRecord;
use super::message_digest::MessageDigest;
use crate::files::WriteError;
use crate::gpu::Gpu;
use crate::mapping::{FinalRefinement, Mapper, MapperMessage};
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
        Ok(Self::new(path, identity, interval(recording), None))
    }

    /// Continues the run of a checkpoint.
    ///
    /// # Errors
    /// If the checkpoint belongs to another run; names what differs.
    pub fn resume(checkpoint: Checkpoint, recording: &Recording, gpu: &Gpu) -> Result<Self, CheckpointError> {
        let identity = Identity::of(recording, gpu);
        checkpoint.identity.check(&checkpoint.path, &identity)?;
        let mut resumed = Self::new(&checkpoint.path, identity, interval(recording), checkpoint.state);
        resumed.earlier.resumed += 1;
        Ok(resumed)
    }

    fn new(path: &Path, identity: Identity, every: usize, resume_from: Option<RunState>) -> Self {
        Self {
            path: path.into(),
            identity,
            every,
            since: 0,
            digest: MessageDigest::default(),
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

    /// Makes the next finished keyframe or round one with a checkpoint.
    pub(crate) fn hurry(&mut self) {
        self.since = self.every;
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
        if !self.is_due() {
            return Ok(None);
        }
        let elapsed = self.elapsed(self.started.elapsed());
        let state = RunState::new(self.digest, mapper.state(refinement)?, records, elapsed);
        Ok(Some(Checkpoint::write(&self.path, &self.identity, Some(&state))?))
    }

    /// Counts a finished keyframe or round; whether a checkpoint is due.
    fn is_due(&mut self) -> bool {
        self.since = self.since.saturating_add(1);
        let due = self.since >= self.every;
        if due {
            self.since = 0;
        }
        due
    }

    /// Time of all processes, this one included.
    fn elapsed(&self, here: Duration) -> Elapsed {
        Elapsed { wall_s: self.earlier.wall_s + here.as_secs_f64(), ..self.earlier }
    }
}

/// Keyframes or rounds between two checkpoints.
fn interval(recording: &Recording) -> usize {
    recording.config().checkpoint_every.unwrap_or(usize::MAX)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Config;
    use crate::geometry::Se3;
    use crate::mapping::{MapperState, PoseUpdate};
    use crate::synthetic::{self, CameraConfig, SceneConfig};

    fn checkpointer(every: usize, resume_from: Option<RunState>) -> Checkpointer {
        Checkpointer::new(Path::new("out/checkpoint.bin"), Identity::default(), every, resume_from)
    }

    #[test]
    fn a_checkpoint_is_due_after_each_interval() {
        let due = |every| {
            let mut checkpointer = checkpointer(every, None);
            (1..=7).filter(|_| checkpointer.is_due()).count()
        };
        assert_eq!([1, 2, 3, 7, 8, usize::MAX].map(due), [7, 3, 2, 1, 0, 0]);
        let mut third = checkpointer(3, None);
        assert_eq!([(); 6].map(|()| third.is_due()), [false, false, true, false, false, true]);
        third.hurry();
        assert_eq!([(); 3].map(|()| third.is_due()), [true, false, false]);
    }

    #[test]
    fn checkpoints_come_as_often_as_the_configuration_says() {
        let folder = tempfile::tempdir().unwrap();
        let room = folder.path().join("room");
        let camera = CameraConfig { width: 32, height: 24, fx: 26.0, fy: 26.0, cx: 15.5, cy: 11.5, ..CameraConfig::default() };
        let scene = SceneConfig { frames: 2, camera, ..SceneConfig::default() };
        synthetic::generate(&scene, &room, &|_, _| {}).unwrap();
        let every = |checkpoint_every| {
            let config = Config { checkpoint_every, ..Config::for_recording(&room) };
            interval(&Recording::open(config).unwrap())
        };
        assert_eq!([every(Some(1)), every(Some(3)), every(None)], [1, 3, usize::MAX]);
    }

    #[test]
    fn what_the_mapper_receives_is_in_the_digest() {
        let message = MapperMessage::PoseUpdate(vec![PoseUpdate::rigid(1, Se3::translation(0.5, 0.0, 0.0))]);
        let (mut run, mut digest) = (checkpointer(1, None), MessageDigest::default());
        run.received(&message);
        digest.update(&message);
        assert_eq!(run.digest(), digest);
    }

    #[test]
    fn a_resumed_run_continues_from_its_state_once_and_adds_its_time() {
        let earlier = Elapsed { wall_s: 40.0, resumed: 2 };
        let state = RunState::new(MessageDigest::default(), MapperState::default(), &[], earlier);
        let mut resumed = checkpointer(3, Some(state));
        assert!(resumed.is_behind());
        assert_eq!(resumed.take_state().unwrap().elapsed, earlier);
        assert!(!resumed.is_behind() && resumed.take_state().is_none());
        assert_eq!(resumed.earlier(), earlier);
        assert_eq!(resumed.elapsed(Duration::from_millis(1500)), Elapsed { wall_s: 41.5, resumed: 2 });
        assert_eq!(checkpointer(3, None).elapsed(Duration::from_millis(1500)), Elapsed { wall_s: 1.5, resumed: 0 });
        assert!(!checkpointer(3, None).is_behind());
    }
}
