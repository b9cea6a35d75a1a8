//! `checkpoint.bin` in a run's folder, from which an interrupted run goes on to the bit.
//!
//! Of the tracker nothing is kept: unpaced it repeats to the bit and takes a small part of a run, so that reader and tracker begin at the
//! first frame again, and the mapper takes what it was told up to the checkpoint for its images alone. The configuration lies in the
//! same file: a run and its settings cannot come apart.
//!
//! The file is a line that says what it is, the SHA-256 of the rest, and by postcard the [`Identity`] and a [`Course`], if there is one.

use std::fmt::Display;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use super::KeyframeRecord;
use super::heard::Heard;
use super::outputs;
use crate::config::Config;
use crate::export::{ExportError, write_durably};
use crate::gpu::Gpu;
use crate::mapping::{KeyframeReport, MapperState, RefinedPair};
use crate::sequence::Sequence;

/// The first line; only the version that wrote a file knows how to read the rest.
const HEAD: &str = concat!("keysplat ", env!("CARGO_PKG_VERSION"), " checkpoint\n");
const DIGEST_BYTES: usize = 32;

#[derive(Debug, thiserror::Error)]
pub enum CheckpointError {
    #[error("cannot read {path}: {source}")]
    Read { path: PathBuf, source: std::io::Error },
    #[error("{path} is damaged or cut off, and nothing can be resumed from it; make the run anew with keysplat run")]
    Damaged { path: PathBuf },
    #[error("{path} is of another run: {what} was {then} and is {now}; {advice}")]
    Differs { path: PathBuf, what: String, then: String, now: String, advice: &'static str },
}

/// What a run must share with its checkpoint to go on to the bit.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Identity {
    /// The whole configuration, TOML.
    config: String,
    adapter: String,
    frames: usize,
    /// SHA-256 of camera, sensor and times.
    recording: String,
}

/// What a run has come to.
#[derive(Debug, Serialize, Deserialize)]
pub(super) struct Course {
    pub heard: Heard,
    pub mapper: MapperState,
    records: Vec<(KeyframeReport, [f64; 2], usize, Option<u64>)>,
    /// What the tracker was told after each keyframe.
    pub told: Vec<Vec<RefinedPair>>,
    pub parts: Parts,
}

/// What a run was made in, up to a checkpoint.
#[derive(Clone, Copy, Debug, Default, Serialize, Deserialize)]
pub(super) struct Parts {
    /// Time of all of them.
    pub wall_s: f64,
    /// How often it went on from a checkpoint.
    pub resumed: u64,
}

/// A checkpoint that was read; which run it is of has not been looked at.
#[derive(Debug)]
pub struct Checkpoint {
    pub(super) path: PathBuf,
    pub(super) identity: Identity,
    /// `None` at the run's beginning.
    pub(super) course: Option<Course>,
}

impl Checkpoint {
    /// Reads a file whole and checks it.
    pub fn read(path: &Path) -> Result<Self, CheckpointError> {
        let bytes = std::fs::read(path).map_err(|source| CheckpointError::Read { path: path.into(), source })?;
        let damaged = || CheckpointError::Damaged { path: path.into() };
        check_version(path, &bytes)?;
        let rest = bytes.strip_prefix(HEAD.as_bytes()).and_then(|rest| rest.split_at_checked(DIGEST_BYTES));
        let (_, rest) = rest.filter(|(digest, rest)| Sha256::digest(rest).as_slice() == *digest).ok_or_else(damaged)?;
        let (identity, course) = postcard::from_bytes(rest).map_err(|_| damaged())?;
        Ok(Self { path: path.into(), identity, course })
    }

    /// The configuration of its run.
    pub fn config(&self) -> Result<Config, CheckpointError> {
        self.identity.config().ok_or_else(|| CheckpointError::Damaged { path: self.path.clone() })
    }

    /// Writes one; returns its bytes.
    pub(super) fn write(path: &Path, identity: &Identity, course: Option<&Course>) -> Result<usize, ExportError> {
        let rest = postcard::to_stdvec(&(identity, course)).expect("a checkpoint is plain data");
        let bytes = [HEAD.as_bytes(), Sha256::digest(&rest).as_slice(), &rest].concat();
        write_durably(path, &bytes)?;
        Ok(bytes.len())
    }
}

impl Course {
    pub fn new(
        heard: Heard,
        mapper: MapperState,
        (records, told): (&[KeyframeRecord], &[Vec<RefinedPair>]),
        parts: Parts,
    ) -> Self {
        let records = records.iter().map(|r| (r.report, [r.done_s, r.busy_s], r.waiting, r.host_bytes)).collect();
        Self { heard, mapper, records, told: told.to_vec(), parts }
    }

    pub fn records(&self) -> Vec<KeyframeRecord> {
        let records = self.records.iter().copied();
        records
            .map(|(report, [done_s, busy_s], waiting, host_bytes)| KeyframeRecord { report, done_s, busy_s, waiting, host_bytes })
            .collect()
    }
}

impl Identity {
    pub fn of(sequence: &Sequence, config: &Config, gpu: &Gpu) -> Self {
        let times: Vec<f64> = sequence.entries.iter().map(|entry| entry.timestamp_s).collect();
        let recording = format!("{:?} {:?} {times:?}", sequence.camera, sequence.sensor);
        Self {
            config: config.to_toml(),
            adapter: outputs::adapter(gpu).to_string(),
            frames: times.len(),
            recording: crate::evaluation::sha256_hex(recording.as_bytes()),
        }
    }

    fn config(&self) -> Option<Config> {
        toml::from_str(&self.config).ok()
    }

    /// Says what differs in the run that is to go on from here.
    pub fn check(&self, path: &Path, now: &Self) -> Result<(), CheckpointError> {
        let settings = |identity: &Self| toml::from_str(&identity.config()?.identity()).ok();
        let tables = settings(self).zip(settings(now)).ok_or_else(|| CheckpointError::Damaged { path: path.into() })?;
        if let Some((setting, then, now)) = difference(&tables.0, &tables.1) {
            return check(path, (&setting, "give it the value that it had, or make the run anew"), (&then, &now));
        }
        check(path, ("the adapter", "resume where that one is, or make the run anew"), (&self.adapter, &now.adapter))?;
        let advice = "put the recording back as it was, or make the run anew";
        check(path, ("the number of frames", advice), (&self.frames, &now.frames))?;
        check(path, ("the recording's camera or times (SHA-256)", advice), (&self.recording, &now.recording))
    }
}

/// Says if another version wrote these bytes; not whether they are a checkpoint at all.
fn check_version(path: &Path, bytes: &[u8]) -> Result<(), CheckpointError> {
    let line = bytes.split(|byte| *byte == b'\n').next().and_then(|line| std::str::from_utf8(line).ok());
    let then = line.and_then(|line| line.strip_prefix("keysplat ")?.strip_suffix(" checkpoint"));
    let advice = "resume with that version, or make the run anew";
    let now = env!("CARGO_PKG_VERSION");
    check(path, ("the version of keysplat", advice), (&then.unwrap_or(now), &now))
}

fn check<T: Display + PartialEq>(
    path: &Path,
    (what, advice): (&str, &'static str),
    (then, now): (&T, &T),
) -> Result<(), CheckpointError> {
    if then == now {
        return Ok(());
    }
    let [then, now] = [then, now].map(ToString::to_string);
    Err(CheckpointError::Differs { path: path.into(), what: what.into(), then, now, advice })
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
