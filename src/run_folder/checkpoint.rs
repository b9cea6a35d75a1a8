//! `checkpoint.bin`: the state from which an interrupted run resumes with byte-identical results.
//!
//! Tracker state is not stored: deterministic replay repeats it, at a small part of a run's cost. A resumed run starts reader and tracker at the
//! first frame; until the checkpoint is reached, the mapper only uploads keyframe images. The configuration is stored in the same file.
//!
//! Layout: one text line with the version, the SHA-256 of the rest, and in postcard the [`Identity`] and an optional [`RunState`].

use std::fmt::Display;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use super::history::KeyframeRecord;
use super::message_digest::MessageDigest;
use super::outputs;
use crate::config::Config;
use crate::files::{WriteError, write_durably};
use crate::gpu::Gpu;
use crate::mapping::{KeyframeReport, MapperState, MappingError};
use crate::recording::Recording;

/// The first line; only the version that wrote a file knows how to read the rest.
const HEAD: &str = concat!("keysplat ", env!("CARGO_PKG_VERSION"), " checkpoint\n");
const DIGEST_BYTES: usize = 32;

/// A checkpoint that cannot be read, written or resumed.
#[derive(Debug, thiserror::Error)]
pub enum CheckpointError {
    /// It cannot be written.
    #[error(transparent)]
    Write(#[from] WriteError),
    /// The mapper's state cannot be downloaded.
    #[error(transparent)]
    Mapping(#[from] MappingError),
    /// It cannot be read.
    #[error("cannot read {path}: {source}")]
    Read {
        /// The file or folder.
        path: PathBuf,
        /// The cause.
        source: std::io::Error,
    },
    /// It is cut off or its digest differs.
    #[error("{path} is damaged or cut off, and nothing can be resumed from it; make the run anew with keysplat run")]
    Damaged {
        /// The file or folder.
        path: PathBuf,
    },
    /// It belongs to another run.
    #[error("{path} is of another run: {what} was {then} and is {now}; {advice}")]
    Differs {
        /// The file or folder.
        path: PathBuf,
        /// The part that differs.
        what: String,
        /// Value in the checkpoint.
        then: String,
        /// Value of this run.
        now: String,
        /// What to do.
        advice: &'static str,
    },
}

/// Properties that a resumed run must share with its checkpoint.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct Identity {
    /// The whole configuration, TOML.
    config: String,
    adapter: String,
    frames: usize,
    /// SHA-256 of camera, sensor and times.
    recording: String,
}

/// State of a run between two keyframes, or two rounds of the final refinement.
#[derive(Debug, Serialize, Deserialize)]
pub(crate) struct RunState {
    /// Digest of the mapper's input so far.
    pub digest: MessageDigest,
    /// State of the mapper.
    pub mapper: MapperState,
    records: Vec<(KeyframeReport, [f64; 2], usize, Option<u64>)>,
    /// Time and interruptions so far.
    pub elapsed: Elapsed,
}

/// Wall-clock time and interruptions of a run, up to a checkpoint.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct Elapsed {
    /// Wall-clock time of all processes, seconds.
    pub wall_s: f64,
    /// Number of resumptions.
    pub resumed: u64,
}

/// A checkpoint as read, not yet compared with the run that resumes it.
#[derive(Debug)]
pub struct Checkpoint {
    pub(crate) path: PathBuf,
    pub(crate) identity: Identity,
    /// `None` at the run's beginning.
    pub(crate) state: Option<RunState>,
}

impl Checkpoint {
    /// Reads a checkpoint and verifies its digest.
    ///
    /// # Errors
    /// If it cannot be read, is damaged, or another version wrote it.
    pub fn read(path: &Path) -> Result<Self, CheckpointError> {
        let bytes = std::fs::read(path).map_err(|source| CheckpointError::Read { path: path.into(), source })?;
        let damaged = || CheckpointError::Damaged { path: path.into() };
        check_version(path, &bytes)?;
        let rest = bytes.strip_prefix(HEAD.as_bytes()).and_then(|rest| rest.split_at_checked(DIGEST_BYTES));
        let (_, rest) = rest.filter(|(digest, rest)| Sha256::digest(rest).as_slice() == *digest).ok_or_else(damaged)?;
        let (identity, state) = postcard::from_bytes(rest).map_err(|_| damaged())?;
        Ok(Self { path: path.into(), identity, state })
    }

    /// The configuration of its run.
    ///
    /// # Errors
    /// If the file is damaged.
    pub fn config(&self) -> Result<Config, CheckpointError> {
        self.identity.config().ok_or_else(|| CheckpointError::Damaged { path: self.path.clone() })
    }

    /// Writes a checkpoint durably; returns its size in bytes.
    pub(crate) fn write(path: &Path, identity: &Identity, state: Option<&RunState>) -> Result<usize, WriteError> {
        let rest = postcard::to_stdvec(&(identity, state)).expect("a checkpoint is plain data");
        let bytes = [HEAD.as_bytes(), Sha256::digest(&rest).as_slice(), &rest].concat();
        write_durably(path, &bytes)?;
        Ok(bytes.len())
    }
}

impl RunState {
    /// Packs keyframe records beside the rest.
    pub fn new(digest: MessageDigest, mapper: MapperState, records: &[KeyframeRecord], elapsed: Elapsed) -> Self {
        let records = records.iter().map(|r| (r.report, [r.done_s, r.busy_s], r.waiting, r.host_bytes)).collect();
        Self { digest, mapper, records, elapsed }
    }

    /// Records of the keyframes so far.
    pub fn records(&self) -> Vec<KeyframeRecord> {
        let records = self.records.iter().copied();
        records
            .map(|(report, [done_s, busy_s], waiting, host_bytes)| KeyframeRecord { report, done_s, busy_s, waiting, host_bytes })
            .collect()
    }
}

impl Identity {
    /// Identity of a recording on an adapter.
    pub fn of(recording: &Recording, gpu: &Gpu) -> Self {
        let (sequence, config) = (recording.sequence(), recording.config());
        let times: Vec<f64> = sequence.entries.iter().map(|entry| entry.timestamp_s).collect();
        let own_cameras: Vec<_> = sequence.entries.iter().map(|entry| entry.camera).collect();
        let frames = format!("{:?} {own_cameras:?} {:?} {times:?}", sequence.camera, sequence.sensor);
        Self {
            config: config.to_toml(),
            adapter: outputs::adapter(gpu).to_string(),
            frames: times.len(),
            recording: crate::evaluation::sha256_hex(frames.as_bytes()),
        }
    }

    fn config(&self) -> Option<Config> {
        toml::from_str(&self.config).ok()
    }

    /// Compares with the identity of the resuming run.
    ///
    /// # Errors
    /// The first property that differs, with both values.
    pub fn check(&self, path: &Path, now: &Self) -> Result<(), CheckpointError> {
        let settings = |identity: &Self| toml::from_str(&identity.config()?.identity()).ok();
        let tables = settings(self).zip(settings(now)).ok_or_else(|| CheckpointError::Damaged { path: path.into() })?;
        if let Some((setting, then, now)) = difference(&tables.0, &tables.1) {
            return check(
                path,
                Property { name: &setting, advice: "give it the value that it had, or make the run anew" },
                &then,
                &now,
            );
        }
        let adapter = Property { name: "the adapter", advice: "resume where that one is, or make the run anew" };
        check(path, adapter, &self.adapter, &now.adapter)?;
        let advice = "put the recording back as it was, or make the run anew";
        check(path, Property { name: "the number of frames", advice }, &self.frames, &now.frames)?;
        let frames = Property { name: "the recording's camera or times (SHA-256)", advice };
        check(path, frames, &self.recording, &now.recording)
    }
}

/// Says if another version wrote these bytes; not whether they are a checkpoint at all.
fn check_version(path: &Path, bytes: &[u8]) -> Result<(), CheckpointError> {
    let line = bytes.split(|byte| *byte == b'\n').next().and_then(|line| std::str::from_utf8(line).ok());
    let then = line.and_then(|line| line.strip_prefix("keysplat ")?.strip_suffix(" checkpoint"));
    let advice = "resume with that version, or make the run anew";
    let now = env!("CARGO_PKG_VERSION");
    check(path, Property { name: "the version of keysplat", advice }, &then.unwrap_or(now), &now)
}

/// A property to compare, and what to do where it differs.
struct Property<'a> {
    name: &'a str,
    advice: &'static str,
}

fn check<T: Display + PartialEq>(path: &Path, property: Property<'_>, then: &T, now: &T) -> Result<(), CheckpointError> {
    if then == now {
        return Ok(());
    }
    let [then, now] = [then, now].map(ToString::to_string);
    let Property { name, advice } = property;
    Err(CheckpointError::Differs { path: path.into(), what: name.into(), then, now, advice })
}

/// The first setting that differs, and its two values.
fn difference(then: &toml::Table, now: &toml::Table) -> Option<(String, String, String)> {
    then.keys().chain(now.keys()).find_map(|key| match (then.get(key), now.get(key)) {
        (Some(toml::Value::Table(then)), Some(toml::Value::Table(now))) => {
            difference(then, now).map(|(inner, then, now)| (format!("{key}.{inner}"), then, now))
        }
        (then, now) if then == now => None,
        (then, now) => {
            let [then, now] = [then, now].map(|value| value.map_or_else(|| "absent".into(), ToString::to_string));
            Some((key.clone(), then, now))
        }
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn identity() -> Identity {
        Identity { config: Config::default().to_toml(), adapter: "llvmpipe".into(), frames: 24, recording: "00ff".into() }
    }

    #[test]
    fn a_run_that_differs_is_named() {
        let path = Path::new("out/checkpoint.bin");
        let then = identity();
        then.check(path, &identity()).unwrap();
        let says = |now: Identity, parts: [&str; 3]| {
            let message = then.check(path, &now).unwrap_err().to_string();
            assert!(
                message.starts_with("out/checkpoint.bin is of another run") && parts.iter().all(|p| message.contains(p)),
                "{message}"
            );
        };
        let config = Config::default().with_settings(&["mapping.window.recent=9"]).unwrap().to_toml();
        says(Identity { config, ..identity() }, ["mapping.window.recent was ", " and is 9", "the value that it had"]);
        let config = Config { adapter: Some("vega".into()), ..Config::default() }.to_toml();
        says(Identity { config, ..identity() }, ["adapter was absent", "vega", "anew"]);
        says(Identity { adapter: "vega".into(), ..identity() }, ["llvmpipe", "vega", "resume where"]);
        says(Identity { frames: 23, ..identity() }, ["number of frames", "was 24", "is 23"]);
        says(Identity { recording: "01ff".into(), ..identity() }, ["camera or times", "00ff", "01ff"]);
        // Where the recording lies, and how often a checkpoint is written, decides nothing.
        let elsewhere = Config { checkpoint_every: Some(3), ..Config::default() };
        then.check(path, &Identity { config: elsewhere.to_toml(), ..identity() }).unwrap();
    }

    #[test]
    fn a_checkpoint_gives_back_the_configuration_of_its_run() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("checkpoint.bin");
        let config = Config::default().with_settings(&["mapping.window.recent=9"]).unwrap();
        let written = Checkpoint::write(&path, &Identity { config: config.to_toml(), ..identity() }, None).unwrap();
        assert_eq!(std::fs::metadata(&path).unwrap().len(), written as u64);
        let read = Checkpoint::read(&path).unwrap();
        assert_eq!(read.config().unwrap(), config);
        assert!(read.state.is_none());
    }

    #[test]
    fn a_checkpoint_gives_back_the_records_of_its_run() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("checkpoint.bin");
        let record = |id| KeyframeRecord {
            report: KeyframeReport { id, inserted: 7, ..KeyframeReport::default() },
            done_s: 2.5,
            busy_s: 0.5,
            waiting: 3,
            host_bytes: Some(1 << 30),
        };
        let records = [record(4), record(6)];
        let elapsed = Elapsed { wall_s: 40.0, resumed: 2 };
        let state = RunState::new(MessageDigest::default(), MapperState::default(), &records, elapsed);
        Checkpoint::write(&path, &identity(), Some(&state)).unwrap();
        let read = Checkpoint::read(&path).unwrap().state.unwrap();
        assert_eq!((read.records(), read.elapsed), (records.to_vec(), elapsed));
    }

    #[test]
    fn damaged_files_are_refused_whatever_they_hold() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("checkpoint.bin");
        Checkpoint::write(&path, &identity(), None).unwrap();
        let good = std::fs::read(&path).unwrap();
        assert_eq!(Checkpoint::read(&path).unwrap().config().unwrap(), Config::default());
        let refused = |bytes: &[u8]| {
            std::fs::write(&path, bytes).unwrap();
            let message = Checkpoint::read(&path).unwrap_err().to_string();
            assert!(message.contains("checkpoint.bin is damaged or cut off") && message.contains("keysplat run"), "{message}");
        };
        (0..good.len()).step_by(13).for_each(|len| refused(&good[..len]));
        for at in (HEAD.len()..good.len()).step_by(13).chain([0, HEAD.len() - 1]) {
            let mut bytes = good.clone();
            bytes[at] ^= 4;
            refused(&bytes);
        }
        // A sound checksum over as many Gaussians as no file could hold.
        let rest =
            [&postcard::to_stdvec(&identity()).unwrap()[..], &[1, 3], &[0; DIGEST_BYTES], &[8, 0], &[0xff; 9], &[1]].concat();
        refused(&[HEAD.as_bytes(), Sha256::digest(&rest).as_slice(), &rest].concat());
        std::fs::write(&path, [&b"keysplat 0.0.7 checkpoint\n"[..], &good[HEAD.len()..]].concat()).unwrap();
        let message = Checkpoint::read(&path).unwrap_err().to_string();
        assert!(message.contains("the version of keysplat was 0.0.7 and is ") && message.contains("anew"), "{message}");
    }
}
