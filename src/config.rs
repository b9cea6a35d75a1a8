//! The configuration of a run: the modules' own configs, composed and validated once.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use crate::export::MapFormat;
use crate::mapping::{ExposureConfig, MappingConfig, RefineConfig};
use crate::partition::Region;
use crate::sequence::{Layout, SensorKind};
use crate::tracking::TrackingConfig;

/// Configuration of a run: every setting of all modules. `config.toml` in the run folder is the resolved one, and can be used again.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Config {
    /// The recording; on the command line, usually.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub sequence: Option<SequenceConfig>,
    /// Part of an adapter's name; the fastest adapter where absent.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub adapter: Option<String>,
    /// Mapping resolution as a share of the recorded one.
    pub map_scale: f64,
    /// File format of the map.
    pub map_format: MapFormat,
    /// A map, or the folder of a run, that the map begins with; in the world of the known poses.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub initial_map: Option<PathBuf>,
    /// A finished run to go on from: poses, exposures and the initial map are its own.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub refined: Option<RefinedConfig>,
    /// Keyframes mapped, and rounds of the refinement, between two checkpoints; none are kept where absent.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub checkpoint_every: Option<usize>,
    /// Frame selection, sensor and replay mode.
    pub replay: ReplayConfig,
    /// Tracker settings.
    pub tracking: TrackingConfig,
    /// Mapper settings.
    pub mapping: MappingConfig,
}

/// Where a recording lies and how to read it.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SequenceConfig {
    /// A folder, or a video.
    pub path: PathBuf,
    /// Recognised where absent.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub layout: Option<Layout>,
    /// Replay what a sensor of this kind would have given.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub sensor: Option<SensorKind>,
    /// A camera preset instead of what the recording says; for a video, or the path of a `camera.toml`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub camera: Option<String>,
}

/// What of a finished run is refined.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RefinedConfig {
    /// Its folder.
    pub run: PathBuf,
    /// The part of its map that is refined, and all that the result holds; the whole map where absent.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub region: Option<Region>,
}

/// Which frames are replayed, and how fast.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ReplayConfig {
    /// Every n-th frame.
    pub every: usize,
    /// First frame and the one past the last, before `every`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub frames: Option<(usize, usize)>,
    /// Frames arrive by their timestamps; what comes too late is counted. Otherwise nothing is dropped and a run repeats to the bit.
    pub real_time: bool,
    /// Nothing is tracked: poses are those that the recording knows (COLMAP, transforms.json, ground truth).
    pub known_poses: bool,
    /// Every n-th frame is never given to the mapper and measures the map; 0 holds none out.
    pub held_out_every: usize,
}

impl Default for Config {
    fn default() -> Self {
        Self {
            sequence: None,
            adapter: None,
            map_scale: 1.0,
            map_format: MapFormat::default(),
            initial_map: None,
            refined: None,
            checkpoint_every: None,
            replay: ReplayConfig::default(),
            tracking: TrackingConfig::default(),
            mapping: MappingConfig::default(),
        }
    }
}

impl Default for ReplayConfig {
    fn default() -> Self {
        Self { every: 1, frames: None, real_time: false, known_poses: false, held_out_every: 8 }
    }
}

impl ReplayConfig {
    /// Whether frame `index` of the replay is kept from the mapper: the last of each group, so that the first frame is not.
    pub fn is_held_out(&self, index: usize) -> bool {
        self.held_out_every > 0 && index % self.held_out_every == self.held_out_every - 1
    }
}

/// A configuration that cannot be read or used.
#[derive(Debug, thiserror::Error)]
pub enum ConfigError {
    /// The file cannot be read.
    #[error("cannot read the configuration {path}: {source}")]
    Read {
        /// The file or folder.
        path: PathBuf,
        /// The cause.
        source: std::io::Error,
    },
    /// Not TOML, an unknown key, or a value of the wrong type.
    #[error("{path}: {source}")]
    Syntax {
        /// The file or folder.
        path: PathBuf,
        /// The cause.
        source: Box<toml::de::Error>,
    },
    /// A value out of its range; the message names key and range.
    #[error("{0}")]
    Value(String),
    /// A key of an earlier version.
    #[error("`{old}` is called `{new}` now; CHANGELOG.md says whether its unit differs")]
    Renamed {
        /// Dotted key as found.
        old: &'static str,
        /// Dotted key that replaced it.
        new: &'static str,
    },
    /// An error in a file.
    #[error("{path}: {source}")]
    In {
        /// The file or folder.
        path: PathBuf,
        /// The cause.
        source: Box<ConfigError>,
    },
}

/// Dotted keys of earlier versions, and those that replaced them; keys of a section before the section itself.
const RENAMED: [(&str, &str); 18] = [
    ("mapping.density.multi_view.absolute_gradient", "mapping.density.multi_view.pixel_gradient"),
    ("mapping.limits.max_keyframes", "mapping.limits.max_gpu_images"),
    ("mapping.density.vcd.min_worth", "mapping.density.multi_view.min_contribution"),
    ("mapping.density.vcd.wrong_pixels", "mapping.density.multi_view.error_pixels"),
    ("mapping.density.multi_view.min_worth", "mapping.density.multi_view.min_contribution"),
    ("mapping.density.vcd", "mapping.density.multi_view"),
    ("mapping.adam.position_rate", "mapping.adam.lr_position"),
    ("mapping.adam.opacity_rate", "mapping.adam.lr_opacity"),
    ("mapping.adam.scale_rate", "mapping.adam.lr_log_scale"),
    ("mapping.adam.rotation_rate", "mapping.adam.lr_rotation"),
    ("mapping.adam.color_rate", "mapping.adam.lr_color"),
    ("mapping.adam.harmonics_rate", "mapping.adam.lr_harmonics"),
    ("mapping.adam.averaged_steps", "mapping.adam.ema_steps"),
    ("mapping.refine.final_position_rate", "mapping.refine.final_lr_scale_position"),
    ("mapping.refine.final_rate", "mapping.refine.final_lr_scale"),
    ("mapping.plane_sweep.trust", "mapping.plane_sweep.depth_confidence"),
    ("replay.paced", "replay.real_time"),
    ("mapping.seeding", "mapping.insertion"),
];

/// Refuses keys of earlier versions by their new names.
fn check_renamed(table: &toml::Table) -> Result<(), ConfigError> {
    let contains = |key: &str| {
        let mut parts = key.split('.').peekable();
        let mut inner = table;
        while let Some(part) = parts.next() {
            match (inner.get(part), parts.peek()) {
                (Some(_), None) => return true,
                (Some(toml::Value::Table(next)), Some(_)) => inner = next,
                _ => return false,
            }
        }
        false
    };
    let found = RENAMED.iter().find(|(old, _)| contains(old));
    found.map_or(Ok(()), |(old, new)| Err(ConfigError::Renamed { old, new }))
}

/// Puts the values of `over` in the place of those of `under`, table by table.
fn overlay(under: &mut toml::Table, over: toml::Table) {
    for (key, value) in over {
        match (under.get_mut(&key), value) {
            (Some(toml::Value::Table(under)), toml::Value::Table(over)) => overlay(under, over),
            (_, value) => {
                under.insert(key, value);
            }
        }
    }
}

impl Config {
    /// The defaults, for a recording's folder or video.
    pub fn for_recording(path: &Path) -> Self {
        let path = std::path::absolute(path).unwrap_or_else(|_| path.into());
        Self { sequence: Some(SequenceConfig { path, ..SequenceConfig::default() }), ..Self::default() }
    }

    /// The defaults for recordings whose poses are known.
    pub fn offline() -> Self {
        let replay = ReplayConfig { known_poses: true, ..ReplayConfig::default() };
        Self { replay, mapping: MappingConfig::offline(), ..Self::default() }
    }

    /// Settings to refine a finished run with: its own, but each keyframe only arrives, and poses and exposures stay as they are. No Gaussian is
    /// pruned for what it contributes: its best views are not among the few that score a round, and their record ended with the run.
    ///
    /// # Errors
    /// [`ConfigError`] if the run's `config.toml` cannot be read.
    pub fn refining(run: &Path) -> Result<Self, ConfigError> {
        let run = std::path::absolute(run).unwrap_or_else(|_| run.into());
        let config = Self::read(&run.join("config.toml"))?;
        let replay = ReplayConfig { real_time: false, known_poses: true, ..config.replay };
        let refine = RefineConfig { steps_per_keyframe: 0, seconds: None, ..config.mapping.refine };
        let exposure = ExposureConfig { refinements: 0, ..config.mapping.exposure };
        let mut density = config.mapping.density;
        (density.multi_view.min_weight, density.multi_view.min_contribution) = (0.0, 0.0);
        let mapping = MappingConfig {
            density,
            iterations_per_keyframe: 0,
            first_iterations: 0,
            yields_to_keyframes: false,
            refine,
            exposure,
            ..config.mapping
        };
        let refined = Some(RefinedConfig { run, region: None });
        Ok(Self { initial_map: None, refined, checkpoint_every: None, replay, mapping, ..config })
    }

    /// Reads and checks a TOML file; keys that it leaves out keep their defaults, unknown ones are errors. The defaults are those of
    /// [`Self::offline`] if the file says that poses are known.
    ///
    /// # Errors
    /// [`ConfigError`] if the file cannot be read or parsed, has an unknown or renamed key, or a value out of range.
    pub fn read(path: &Path) -> Result<Self, ConfigError> {
        Self::read_with(path, false)
    }

    /// Reads as [`Self::read`]; `known_poses` overrides the file.
    ///
    /// # Errors
    /// As [`Self::read`].
    pub fn read_with(path: &Path, known_poses: bool) -> Result<Self, ConfigError> {
        let text = std::fs::read_to_string(path).map_err(|source| ConfigError::Read { path: path.into(), source })?;
        Self::parse(&text, path, known_poses)
    }

    /// Parses and checks a configuration; `path` is named in errors.
    ///
    /// # Errors
    /// As [`Self::read`], except for reading.
    pub fn parse(text: &str, path: &Path, known_poses: bool) -> Result<Self, ConfigError> {
        let syntax = |source| ConfigError::Syntax { path: path.into(), source: Box::new(source) };
        let in_file = |source| ConfigError::In { path: path.into(), source: Box::new(source) };
        check_renamed(&toml::from_str(text).map_err(syntax)?).map_err(in_file)?;
        let mut config: Self = toml::from_str(text).map_err(syntax)?;
        if known_poses || config.replay.known_poses {
            let mut table = toml::Table::try_from(Self::offline()).expect("a configuration is plain data");
            overlay(&mut table, toml::from_str(text).map_err(syntax)?);
            config = table.try_into().map_err(syntax)?;
            config.replay.known_poses = true;
        }
        config.validate().map_err(in_file)?;
        Ok(config)
    }

    /// A copy with single values changed, each written `key.of.value=value` as in TOML; a bare word counts as text. Checked.
    ///
    /// # Errors
    /// [`ConfigError::Value`] if a setting is no `key=value`, names no key, or is out of range; [`ConfigError::Renamed`] for a key of an earlier version.
    pub fn with_settings<S: AsRef<str>>(&self, settings: &[S]) -> Result<Self, ConfigError> {
        if settings.is_empty() {
            self.validate()?;
            return Ok(self.clone());
        }
        let mut table = toml::Table::try_from(self).map_err(|e| ConfigError::Value(e.to_string()))?;
        for setting in settings.iter().map(AsRef::as_ref) {
            let wrong = |why: &str| ConfigError::Value(format!("`{setting}`: {why}"));
            let (key, value) = setting.split_once('=').ok_or_else(|| wrong("write key=value, like mapping.seed=1"))?;
            let value = toml::from_str::<toml::Table>(&format!("v = {value}")).ok().and_then(|mut t| t.remove("v"));
            let value = value.unwrap_or_else(|| toml::Value::String(setting[key.len() + 1..].into()));
            let is_below = |old: &str| key.trim().strip_prefix(old).is_some_and(|rest| rest.is_empty() || rest.starts_with('.'));
            if let Some((old, new)) = RENAMED.iter().find(|(old, _)| is_below(old)) {
                return Err(ConfigError::Renamed { old, new });
            }
            let mut parts: Vec<&str> = key.trim().split('.').collect();
            let last = parts.pop().unwrap_or_default();
            let mut inner = &mut table;
            for part in parts {
                inner =
                    inner.get_mut(part).and_then(toml::Value::as_table_mut).ok_or_else(|| wrong("there is no such setting"))?;
            }
            inner.insert(last.into(), value);
        }
        let text = toml::to_string(&table).expect("a table is TOML");
        let config: Self = toml::from_str(&text).map_err(|e| ConfigError::Value(e.message().to_string()))?;
        config.validate()?;
        Ok(config)
    }

    /// Checks all values.
    ///
    /// # Errors
    /// [`ConfigError::Value`] with the first key that is out of range.
    pub fn validate(&self) -> Result<(), ConfigError> {
        let value = |message: String| Err(ConfigError::Value(message));
        if !(self.map_scale > 0.0 && self.map_scale <= 1.0) {
            return value(format!("map_scale must be above 0 and at most 1, not {}", self.map_scale));
        }
        if self.replay.every == 0 {
            return value("replay.every must be at least 1".into());
        }
        if self.initial_map.is_some() && !self.replay.known_poses {
            return value("an initial map needs the world of known poses: use --known-poses (replay.known_poses), too".into());
        }
        if let Some(refined) = &self.refined {
            if !self.replay.known_poses || self.initial_map.is_some() {
                return value("a refined run has poses and map of its own: set replay.known_poses, and no initial_map".into());
            }
            refined.region.map_or(Ok(()), |region| region.validate()).map_err(|e| ConfigError::Value(format!("refined.{e}")))?;
        }
        if self.mapping.antialiased && !self.map_format.keeps_antialiasing() {
            let name = self.map_format.name();
            return value(format!(
                "files of {name} do not say that a map is antialiased; use another --format, or mapping.antialiased = false"
            ));
        }
        if self.checkpoint_every == Some(0) {
            return value("checkpoint_every must be at least 1".into());
        }
        if self.checkpoint_every.is_some() && (self.replay.real_time || self.mapping.depends_on_time()) {
            return value(
                "a run against the clock does not repeat and cannot be resumed: leave --checkpoint-every out, or --real-time, --time and \
                 --preset realtime (replay.real_time, mapping.yields_to_keyframes, mapping.refine.seconds)"
                    .into(),
            );
        }
        if self.replay.held_out_every == 1 {
            return value("replay.held_out_every = 1 would keep every frame from the mapper; use 0 to hold none out".into());
        }
        self.tracking.validate().map_err(|e| ConfigError::Value(format!("tracking: {e}")))?;
        self.mapping.validate().map_err(ConfigError::Value)
    }

    /// The resolved configuration as TOML.
    pub fn to_toml(&self) -> String {
        toml::to_string(self).expect("a configuration is plain data")
    }

    /// The resolved configuration without the place of the recording and the checkpoints: equal for runs that should give equal results.
    pub fn identity(&self) -> String {
        Self { sequence: None, checkpoint_every: None, ..self.clone() }.to_toml()
    }
}

#[cfg(test)]
mod tests;
