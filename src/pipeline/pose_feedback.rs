//! Pose feedback, mapper to tracker: refined relative poses of the window's keyframes after each mapped keyframe.
//!
//! In real time the tracker takes the feedback that is there, and a full channel drops it. In deterministic replay the tracker blocks after each keyframe
//! until the feedback of the keyframe [`LAG`] before has arrived, so that feedback is applied at fixed frames. The mapper never blocks on the
//! tracker, and has all input for that feedback by then: no deadlock.

use std::collections::VecDeque;

use crossbeam::channel::{Receiver, Sender, bounded};

use crate::config::Config;
use crate::mapping::{KeyframeId, RefinedPair};
use crate::tracking::PoseMeasurement;

/// Keyframes by which the mapper may lag in deterministic replay: one in work, one queued.
const LAG: usize = 2;

/// Measurements after one mapped keyframe.
#[derive(Clone, Debug)]
pub(super) struct PoseFeedback {
    pub keyframe: KeyframeId,
    pub measurements: Vec<PoseMeasurement>,
}

/// The mapper's end.
#[derive(Clone, Debug, Default)]
pub(super) struct PoseFeedbackSender(Option<Sender<PoseFeedback>>);

/// The tracker's end.
#[derive(Debug, Default)]
pub(super) struct PoseFeedbackReceiver {
    reports: Option<Receiver<PoseFeedback>>,
    real_time: bool,
    /// Keyframes sent whose feedback has not arrived.
    awaited: VecDeque<KeyframeId>,
}

/// Both ends; inert ones where the configuration has no pose feedback.
pub(super) fn channel(config: &Config) -> (PoseFeedbackSender, PoseFeedbackReceiver) {
    if !(config.mapping.refine_poses.enabled && config.mapping.refine_poses.tell_tracker) {
        return Default::default();
    }
    // Capacity for all feedback that can be in flight in deterministic replay.
    let (sender, reports) = bounded(LAG + 1);
    (
        PoseFeedbackSender(Some(sender)),
        PoseFeedbackReceiver { reports: Some(reports), real_time: config.replay.real_time, awaited: VecDeque::new() },
    )
}

impl PoseFeedbackSender {
    /// Sends the feedback of a mapped keyframe, even an empty one. Never blocks.
    pub fn send(&self, keyframe: KeyframeId, refined: &[RefinedPair]) {
        let Some(sender) = &self.0 else { return };
        // Full: real time, and newer feedback follows. Disconnected: the tracker has finished.
        let _ = sender.try_send(PoseFeedback { keyframe, measurements: refined.iter().map(measurement).collect() });
    }
}

impl PoseFeedbackReceiver {
    /// Feedback to apply after a frame that sent `keyframe` to the mapper.
    pub fn receive(&mut self, keyframe: Option<KeyframeId>) -> Vec<PoseMeasurement> {
        let Some(reports) = &self.reports else { return Vec::new() };
        if self.real_time {
            return reports.try_iter().flat_map(|report| report.measurements).collect();
        }
        self.awaited.extend(keyframe);
        let mut received = Vec::new();
        while self.awaited.len() > LAG {
            let awaited = self.awaited.pop_front();
            // A mapper thread that has ended closes the channel.
            while let Ok(report) = reports.recv() {
                received.extend(report.measurements);
                if Some(report.keyframe) >= awaited {
                    break;
                }
            }
        }
        received
    }
}

fn measurement(refined: &RefinedPair) -> PoseMeasurement {
    PoseMeasurement {
        keyframe: refined.keyframe,
        relative_to: refined.relative_to,
        keyframe_from_relative: refined.keyframe_from_relative,
        sigma_translation_metres: refined.sigma_translation_metres,
        sigma_rotation_rad: refined.sigma_rotation_rad,
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    const KEYFRAMES: usize = 60;
    /// Longer means a deadlock.
    const HANGS_AFTER: Duration = Duration::from_secs(60);

    fn config(real_time: bool) -> Config {
        let mut config = Config::default();
        config.mapping.refine_poses.enabled = true;
        config.replay.real_time = real_time;
        config
    }

    fn pair(keyframe: KeyframeId) -> RefinedPair {
        let keyframe_from_relative = crate::geometry::Se3::identity();
        RefinedPair { keyframe, relative_to: 0, keyframe_from_relative, sigma_translation_metres: 0.1, sigma_rotation_rad: 0.1 }
    }

    /// A tracker that sends keyframes until `tracked` and a mapper that maps those before `mapped`; the feedback after each.
    fn converse(real_time: bool, tracked: usize, mapped: usize) -> Vec<Vec<KeyframeId>> {
        let (done, result) = bounded(1);
        std::thread::spawn(move || {
            let (to_mapper, keyframes) = bounded::<KeyframeId>(4);
            let (sender, mut receiver) = channel(&config(real_time));
            let mapper = std::thread::spawn(move || {
                for keyframe in keyframes.iter().take(mapped) {
                    sender.send(keyframe, &[pair(keyframe)]);
                }
            });
            let mut received = Vec::new();
            for keyframe in 0..tracked {
                let _ = to_mapper.send(keyframe);
                received.push(receiver.receive(Some(keyframe)).iter().map(|m| m.keyframe).collect());
                assert!(real_time || receiver.receive(None).is_empty());
            }
            drop((to_mapper, receiver));
            mapper.join().unwrap();
            done.send(received).unwrap();
        });
        result.recv_timeout(HANGS_AFTER).expect("tracker and mapper wait for each other")
    }

    #[test]
    fn deterministic_feedback_arrives_at_a_fixed_keyframe() {
        let received = converse(false, KEYFRAMES, KEYFRAMES);
        let expected: Vec<Vec<KeyframeId>> = (0..KEYFRAMES).map(|k| k.checked_sub(LAG).into_iter().collect()).collect();
        assert_eq!(received, expected);
    }

    #[test]
    fn a_thread_that_has_ended_blocks_nobody() {
        for mapped in [0, 1, 7, KEYFRAMES - 1] {
            let received = converse(false, KEYFRAMES, mapped).concat();
            assert_eq!(received, (0..mapped.min(KEYFRAMES - LAG)).collect::<Vec<_>>());
            converse(true, KEYFRAMES, mapped);
        }
        converse(false, 5, KEYFRAMES);
        converse(true, 5, KEYFRAMES);
    }

    #[test]
    fn in_real_time_nobody_blocks() {
        let (sender, mut receiver) = channel(&config(true));
        (0..KEYFRAMES).for_each(|k| sender.send(k, &[pair(k)]));
        assert_eq!(receiver.receive(Some(KEYFRAMES)).len(), LAG + 1);
        assert!(receiver.receive(None).is_empty());
    }

    #[test]
    fn without_refined_poses_there_is_nothing_to_wait_for() {
        let (sender, mut receiver) = channel(&Config::default());
        sender.send(0, &[pair(0)]);
        assert!((0..KEYFRAMES).all(|k| receiver.receive(Some(k)).is_empty()));
    }
}
