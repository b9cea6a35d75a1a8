//! The tracker on the first frames.

use super::{Inspection, measures_depth, quantile};
use crate::sequence::{Frame, Sequence};
use crate::tracking::{Tracker, TrackingConfig, TrackingError, TrackingState};

/// Frames that are tracked.
const FRAMES: usize = 40;
/// Least share of them that should have a pose.
const MIN_TRACKED: f64 = 0.9;

struct Trial {
    tracked: usize,
    /// Landmarks that agree with a pose, median.
    inliers: f64,
}

pub fn inspect(sequence: &Sequence, config: &TrackingConfig, found: &mut Inspection) -> Result<(), TrackingError> {
    let count = sequence.entries.len().min(FRAMES);
    let frames: Vec<Frame> = sequence.load_all(&(0..count).collect::<Vec<_>>()).into_iter().filter_map(Result::ok).collect();
    if measures_depth(sequence) && frames.first().is_none_or(|frame| frame.depth.is_none()) {
        found.problem("the first frame has no depth image, and the map starts there: leave it out by --frames".into());
        return Ok(());
    }
    let trial = track(sequence, &frames, config)?;
    found.fact("tracking", format!("{} of the first {} frames, median {} inliers", trial.tracked, frames.len(), trial.inliers));
    if trial.tracked == 0 {
        found.warn(format!(
            "none of the first {} frames could be tracked: they show no motion or no texture, or the calibration is wrong",
            frames.len()
        ));
    } else if (trial.tracked as f64) < MIN_TRACKED * frames.len() as f64 && measures_depth(sequence) {
        found.warn(format!("the camera was lost in {} of the first {} frames", frames.len() - trial.tracked, frames.len()));
    }
    Ok(())
}

fn track(sequence: &Sequence, frames: &[Frame], config: &TrackingConfig) -> Result<Trial, TrackingError> {
    let mut tracker = Tracker::new(sequence.camera, sequence.sensor, config)?;
    let mut inliers = Vec::new();
    for frame in frames {
        let tracked = tracker.track(frame, true)?;
        if tracked.state == TrackingState::Tracking {
            inliers.push(tracked.inliers as f64);
        }
    }
    tracker.finish()?;
    inliers.sort_by(f64::total_cmp);
    Ok(Trial { tracked: inliers.len(), inliers: if inliers.is_empty() { 0.0 } else { quantile(&inliers, 0.5) } })
}
