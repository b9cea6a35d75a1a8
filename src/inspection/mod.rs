//! Inspection of a recording before a run: what it holds, and whether its calibration, timestamps, images and depth look right.
//!
//! A sample of frames is decoded, and the first ones are tracked. Nothing is written.

mod calibration;
mod images;
mod timestamps;
mod trial;

use std::fmt;

use serde::Serialize;

use crate::evaluation::MAX_TIME_DIFFERENCE_S;
use crate::sequence::{FrameEntry, Sensor, Sequence};
use crate::tracking::{TrackingConfig, TrackingError};

/// How much a finding matters.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Severity {
    /// A run is possible; its result may suffer.
    Warning,
    /// A run would fail, or its result mean nothing.
    Problem,
}

/// What looks wrong, and what to do about it.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Finding {
    /// How much it matters.
    pub severity: Severity,
    /// One sentence or two.
    pub message: String,
}

/// One property of a recording.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Fact {
    /// Its name.
    pub name: &'static str,
    /// Its value with units.
    pub value: String,
}

/// Result of an inspection.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Inspection {
    /// What the recording holds.
    pub facts: Vec<Fact>,
    /// What looks wrong, problems among warnings.
    pub findings: Vec<Finding>,
}

impl Inspection {
    fn fact(&mut self, name: &'static str, value: String) {
        self.facts.push(Fact { name, value });
    }

    fn warn(&mut self, message: String) {
        self.findings.push(Finding { severity: Severity::Warning, message });
    }

    fn problem(&mut self, message: String) {
        self.findings.push(Finding { severity: Severity::Problem, message });
    }

    /// Number of problems.
    pub fn problems(&self) -> usize {
        self.findings.iter().filter(|finding| finding.severity == Severity::Problem).count()
    }
}

/// A fact a line, then a finding a line.
impl fmt::Display for Inspection {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for Fact { name, value } in &self.facts {
            writeln!(f, "{name:<16}{value}")?;
        }
        for Finding { severity, message } in &self.findings {
            let severity = if *severity == Severity::Problem { "problem" } else { "warning" };
            writeln!(f, "{severity}: {message}")?;
        }
        if self.findings.is_empty() { writeln!(f, "nothing looks wrong") } else { Ok(()) }
    }
}

/// Inspects an opened recording.
///
/// # Errors
/// [`TrackingError`] if OpenCV fails or the system gives no thread. What is wrong with the recording is a finding.
pub fn inspect(sequence: &Sequence) -> Result<Inspection, TrackingError> {
    let mut found = Inspection::default();
    found.fact("recording", format!("{} ({}, {})", sequence.name, sequence.layout.name(), sequence.sensor.kind()));
    timestamps::inspect(sequence, &mut found);
    calibration::inspect(sequence, &mut found);
    let readable = images::inspect(sequence, &mut found);
    truth(sequence, &mut found);
    if !sequence.layout.is_photos() && sequence.has_one_camera() && readable {
        trial::inspect(sequence, &TrackingConfig::default(), &mut found)?;
    }
    Ok(found)
}

/// Known poses and points.
fn truth(sequence: &Sequence, found: &mut Inspection) {
    if !sequence.points.is_empty() {
        found.fact("points", format!("{} of the scene", sequence.points.len()));
    }
    let Some(truth) = &sequence.groundtruth else {
        found.fact("true poses", "none, so there will be no ATE".into());
        return;
    };
    if sequence.layout.is_photos() {
        found.fact("poses", format!("{}, known: map with --known-poses", truth.poses.len()));
        return;
    }
    let has_pose = |entry: &&FrameEntry| truth.nearest(entry.timestamp_s, MAX_TIME_DIFFERENCE_S).is_some();
    let matched = sequence.entries.iter().filter(has_pose).count();
    found.fact("true poses", format!("{}, at the time of {matched} of {} frames", truth.poses.len(), sequence.entries.len()));
    if matched == 0 {
        found.warn("no true pose has the time of a frame: the two have different clocks, and there will be no ATE".into());
    }
}

/// Whether frames bring depth.
fn measures_depth(sequence: &Sequence) -> bool {
    sequence.sensor == Sensor::Rgbd
}

/// The value of a sorted list at a share of it.
fn quantile(sorted: &[f64], share: f64) -> f64 {
    sorted[((sorted.len() - 1) as f64 * share).round() as usize]
}
