//! A run's exposures over time: those of its keyframes, and in between.

use std::io::ErrorKind;
use std::path::Path;

use serde::{Deserialize, Serialize};

use crate::splat::Exposure;

/// The camera's exposure at moments, ascending; without any, all pictures have the map's colours.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Exposures(Vec<ExposureRecord>);

/// The camera's exposure at one moment.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct ExposureRecord {
    /// Seconds, by the clock of the recording.
    pub timestamp_s: f64,
    /// Natural logarithm of image over map, for red, green and blue.
    pub log_gain: Exposure,
}

/// Timestamps of one moment in two files, to the digits of either.
const SAME_MOMENT_S: f64 = 1e-5;
/// A log gain beyond this is no exposure's.
const MAX_LOG_GAIN: f32 = 5.0;

impl Exposures {
    /// Exposures from records in any order.
    pub fn new(mut records: Vec<ExposureRecord>) -> Self {
        records.sort_by(|a, b| a.timestamp_s.total_cmp(&b.timestamp_s));
        Self(records)
    }

    /// Reads the file of a run; nothing where the run estimated none.
    ///
    /// # Errors
    /// What is wrong with the file.
    pub fn read(path: &Path) -> Result<Self, String> {
        match std::fs::read_to_string(path) {
            Ok(text) => Self::parse(&text).ok_or_else(|| "does not hold exposures".into()),
            Err(error) if error.kind() == ErrorKind::NotFound => Ok(Self::default()),
            Err(error) => Err(format!("cannot be read: {error}")),
        }
    }

    /// From its JSON; `None` if that is something else, or holds what no camera does.
    pub fn parse(json: &str) -> Option<Self> {
        let records: Vec<ExposureRecord> = serde_json::from_str(json).ok()?;
        let sane = |r: &ExposureRecord| r.timestamp_s.is_finite() && r.log_gain.0.iter().all(|g| g.abs() <= MAX_LOG_GAIN);
        records.iter().all(sane).then(|| Self::new(records))
    }

    /// Whether there is no record.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// Whether there is a record of this very moment.
    pub fn has(&self, timestamp_s: f64) -> bool {
        let at = self.0.partition_point(|r| r.timestamp_s < timestamp_s - SAME_MOMENT_S);
        self.0.get(at).is_some_and(|r| r.timestamp_s <= timestamp_s + SAME_MOMENT_S)
    }

    /// At any moment: between two records in proportion, beyond them as at the nearest.
    pub fn at(&self, timestamp_s: f64) -> Exposure {
        let after = self.0.partition_point(|r| r.timestamp_s <= timestamp_s);
        match (after.checked_sub(1).map(|before| self.0[before]), self.0.get(after)) {
            (Some(before), Some(after)) => {
                let share = (timestamp_s - before.timestamp_s) / (after.timestamp_s - before.timestamp_s);
                before.log_gain.towards(&after.log_gain, share as f32)
            }
            (Some(only), None) => only.log_gain,
            (None, only) => only.map_or_else(Exposure::default, |r| r.log_gain),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn record(timestamp_s: f64, log_gain: f32) -> ExposureRecord {
        ExposureRecord { timestamp_s, log_gain: Exposure([log_gain; 3]) }
    }

    #[test]
    fn exposures_are_interpolated_and_held_at_the_ends() {
        let exposures = Exposures::new(vec![record(3.0, 0.3), record(1.0, 0.1)]);
        let at = |t: f64| exposures.at(t).0[1];
        assert_eq!([at(0.0), at(1.0), at(3.0), at(9.0)], [0.1, 0.1, 0.3, 0.3]);
        assert!((at(1.5) - 0.15).abs() < 1e-6);
        assert_eq!(Exposures::default().at(1.0), Exposure::default());
        assert!(Exposures::default().is_empty() && !exposures.is_empty());
    }

    #[test]
    fn text_round_trips_and_nonsense_is_refused() {
        let exposures = Exposures::new(vec![record(1.0, 0.1), record(2.0, -0.2)]);
        assert_eq!(Exposures::parse(&serde_json::to_string(&exposures).unwrap()), Some(exposures));
        for bad in ["", "{}", r#"[{"timestamp_s":1,"log_gain":[0,0]}]"#, r#"[{"timestamp_s":1,"log_gain":[0,0,90]}]"#] {
            assert_eq!(Exposures::parse(bad), None, "{bad}");
        }
    }
}
