//! Where a run stands and how long it will take, from the progress of its threads.

use std::time::Instant;

use super::Progress;
use super::progress::{MappingProgress, TrackingProgress};
use crate::mapping::RefineConfig;

/// The rate of frames is that of about so many seconds.
const RATE_SECONDS: f64 = 20.0;

/// A run as it stands.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct RunState {
    /// Seconds since it began.
    pub s: f64,
    /// Frames tracked.
    pub frames: usize,
    /// Frames of the recording.
    pub all_frames: usize,
    /// Progress of the tracker.
    pub tracking: TrackingProgress,
    /// Progress of the mapper.
    pub mapping: MappingProgress,
    /// Frames a second, of the last seconds.
    pub rate: f64,
    /// Estimated seconds to the end, where they can be estimated.
    pub left_s: Option<f64>,
    /// Whether it is held.
    pub paused: bool,
}

/// Estimates how long a run will take.
#[derive(Debug)]
pub struct Outlook {
    started: Instant,
    all_frames: usize,
    /// The refinement that follows.
    refine: RefineConfig,
    /// Frames a second.
    rate: f64,
    /// Seconds and frames when it was measured.
    last: Option<(f64, usize)>,
    /// Seconds at the first look at the refinement, moved by pauses.
    refining_since: Option<f64>,
}

impl Outlook {
    /// Of a run over so many frames, and the refinement after them, that begins now.
    pub fn new(all_frames: usize, refine: &RefineConfig) -> Self {
        Self { started: Instant::now(), all_frames, refine: refine.clone(), rate: 0.0, last: None, refining_since: None }
    }

    /// Looks at the run; to be called every now and then.
    pub fn look(&mut self, progress: &Progress) -> RunState {
        let s = self.started.elapsed().as_secs_f64();
        let tracking = progress.tracking().get().map(|tracking| *tracking).unwrap_or_default();
        let mapping = progress.mapping().get().map(|mapping| *mapping).unwrap_or_default();
        let frames = tracking.frames_done;
        let paused = progress.control().is_paused();
        if paused {
            // Its time is none of the rate's, and none of the refinement's.
            let held = s - self.last.map_or(s, |(last, _)| last);
            self.refining_since = self.refining_since.map(|since| since + held);
            self.last = Some((s, frames));
        }
        self.measure(s, frames);
        if mapping.refinement.is_some() {
            self.refining_since.get_or_insert(s);
        }
        let left_s = self.left_s(s, frames, &mapping).filter(|_| !paused);
        RunState { s, frames, all_frames: self.all_frames, tracking, mapping, rate: self.rate, left_s, paused }
    }

    fn measure(&mut self, s: f64, frames: usize) {
        let (last_s, last_frames) = *self.last.get_or_insert((s, frames));
        let seconds = s - last_s;
        if seconds < 1.0 {
            return;
        }
        let rate = (frames - last_frames) as f64 / seconds;
        let weight = if self.rate > 0.0 { (seconds / RATE_SECONDS).min(1.0) } else { 1.0 };
        self.rate += weight * (rate - self.rate);
        self.last = Some((s, frames));
    }

    /// Frames that are left at the present rate, and the refinement's steps or its time; `s`: seconds since the run began.
    fn left_s(&self, s: f64, frames: usize, mapping: &MappingProgress) -> Option<f64> {
        match mapping.refinement {
            Some((done, Some(planned))) => Some((planned - done) as f64 * mapping.step_ms / 1e3),
            Some((_, None)) => Some(self.refining_since? + self.refine.seconds? - s).filter(|left| *left >= 0.0),
            None => (self.rate > 0.0).then(|| {
                let frames_s = self.all_frames.saturating_sub(frames) as f64 / self.rate;
                frames_s + self.refinement_s(frames, mapping)
            }),
        }
    }

    /// Seconds of the refinement, with as many keyframes a frame as so far.
    fn refinement_s(&self, frames: usize, mapping: &MappingProgress) -> f64 {
        let keyframes = (mapping.keyframes * self.all_frames).div_ceil(frames.max(1));
        let steps = self.refine.steps.max(self.refine.final_epochs * keyframes);
        self.refine.seconds.unwrap_or(steps as f64 * mapping.step_ms / 1e3)
    }
}

impl RunState {
    /// What matters of it, in a line: frames a second, keyframes, Gaussians, quality, time left, and whether the camera is lost.
    pub fn line(&self) -> String {
        let mut parts = vec![format!("{:.1}/s", self.rate), format!("{} keyframes", self.tracking.keyframes)];
        if self.mapping.gaussians > 0 {
            parts.push(format!("{} Gaussians", self.mapping.gaussians));
            parts.push(format!("{:.1} dB", self.mapping.psnr_db));
        }
        if let Some((done, planned)) = self.mapping.refinement {
            parts[0] = planned.map_or_else(|| format!("refining, step {done}"), |all| format!("refining, step {done}/{all}"));
        }
        parts.extend(self.left_s.map(|s| format!("{} left", duration(s))));
        parts.extend(self.paused.then(|| "PAUSED".into()));
        parts.extend(self.tracking.lost.then(|| "LOST".into()));
        parts.join("  ")
    }
}

fn duration(s: f64) -> String {
    let s = s.round() as u64;
    match (s / 3600, s / 60 % 60, s % 60) {
        (0, 0, s) => format!("{s} s"),
        (0, m, s) => format!("{m}:{s:02} min"),
        (h, m, _) => format!("{h}:{m:02} h"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn time_left_is_that_of_the_frames_and_then_of_the_refinement() {
        let refine = RefineConfig { steps: 0, final_epochs: 3, seconds: None, ..RefineConfig::default() };
        let mut outlook = Outlook::new(100, &refine);
        outlook.measure(0.0, 0);
        outlook.measure(2.0, 20);
        let mapping = MappingProgress { keyframes: 10, gaussians: 5, psnr_db: 21.5, step_ms: 20.0, ..MappingProgress::default() };
        // 80 frames at 10 a second, and three epochs over 50 keyframes.
        assert_eq!(outlook.left_s(2.0, 20, &mapping), Some(8.0 + 3.0));
        let refining = MappingProgress { refinement: Some((50, Some(250))), ..mapping };
        assert_eq!(outlook.left_s(10.0, 100, &refining), Some(4.0));
        // Bounded by time, and beyond it where the user keeps refining.
        let endless = MappingProgress { refinement: Some((50, None)), ..mapping };
        assert_eq!(outlook.left_s(30.0, 100, &endless), None);
        outlook.refine.seconds = Some(60.0);
        outlook.refining_since = Some(10.0);
        assert_eq!(outlook.left_s(30.0, 100, &endless), Some(40.0));
        assert_eq!(outlook.left_s(71.0, 100, &endless), None);
        let state = RunState { rate: 10.0, mapping, left_s: Some(83.0), ..RunState::default() };
        assert_eq!(state.line(), "10.0/s  0 keyframes  5 Gaussians  21.5 dB  1:23 min left");
        let lost = TrackingProgress { lost: true, ..TrackingProgress::default() };
        let refining = RunState { mapping: refining, tracking: lost, left_s: Some(7200.0), paused: true, ..state };
        assert!(refining.line().starts_with("refining, step 50/250") && refining.line().ends_with("2:00 h left  PAUSED  LOST"));
    }
}
