//! The way back, mapper → tracker: how the images place the window's keyframes, after each keyframe that was mapped.
//!
//! Paced, the tracker takes what is there, and what finds no room is dropped. Unpaced, it waits: once it has handed a keyframe on it
//! takes the report on the one [`LAG`] before, so that every report comes at a fixed frame. The mapper never waits for the tracker, and
//! all that it needs for that report has been sent by then; hence the two cannot wait for each other.

use std::collections::VecDeque;

use crossbeam::channel::{Receiver, Sender, bounded};

use crate::config::Config;
use crate::mapping::{KeyframeId, RefinedPair};
use crate::tracking::PoseMeasurement;

/// Keyframes that the mapper may be behind when the unpaced tracker waits for it: one that it works on, and one that lies ready.
const LAG: usize = 2;

/// What mapping one keyframe said of the window's poses.
#[derive(Clone, Debug)]
pub(super) struct Report {
    pub keyframe: KeyframeId,
    pub measurements: Vec<PoseMeasurement>,
}

/// The mapper's end.
#[derive(Clone, Debug, Default)]
pub(super) struct Teller(Option<Sender<Report>>);

/// The tracker's end.
#[derive(Debug, Default)]
pub(super) struct Listener {
    reports: Option<Receiver<Report>>,
    paced: bool,
    /// Keyframes handed on whose reports have not been waited for.
    awaited: VecDeque<KeyframeId>,
}

/// Both ends; ends that say and hear nothing if the configuration has no refined poses for the tracker.
pub(super) fn channel(config: &Config) -> (Teller, Listener) {
    if !(config.mapping.refine_poses.enabled && config.mapping.refine_poses.tell_tracker) {
        return Default::default();
    }
    // Room for every report that can be under way unpaced.
    let (sender, reports) = bounded(LAG + 1);
    (Teller(Some(sender)), Listener { reports: Some(reports), paced: config.replay.paced, awaited: VecDeque::new() })
}

impl Teller {
    /// Reports on a keyframe, mapped whether or not that made anything known. Never waits.
    pub fn tell(&self, keyframe: KeyframeId, refined: &[RefinedPair]) {
        let Some(sender) = &self.0 else { return };
        // Full: paced, and newer ones will come. Disconnected: the tracker is done.
        let _ = sender.try_send(Report { keyframe, measurements: refined.iter().map(measurement).collect() });
    }
}

impl Listener {
    /// What is to be heard after a frame, of which `keyframe` has been handed on to the mapper.
    pub fn hear(&mut self, keyframe: Option<KeyframeId>) -> Vec<PoseMeasurement> {
        let Some(reports) = &self.reports else { return Vec::new() };
        if self.paced {
            return reports.try_iter().flat_map(|report| report.measurements).collect();
        }
        self.awaited.extend(keyframe);
        let mut heard = Vec::new();
        while self.awaited.len() > LAG {
            let awaited = self.awaited.pop_front();
            // A mapper that is no more ends the waiting.
            while let Ok(report) = reports.recv() {
                heard.extend(report.measurements);
                if Some(report.keyframe) >= awaited {
                    break;
                }
            }
        }
        heard
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
    /// Whoever takes longer waits for ever.
    const HANGS_AFTER: Duration = Duration::from_secs(60);

    fn config(paced: bool) -> Config {
        let mut config = Config::default();
        config.mapping.refine_poses.enabled = true;
        config.replay.paced = paced;
        config
    }

    fn pair(keyframe: KeyframeId) -> RefinedPair {
        let keyframe_from_relative = crate::geometry::Se3::identity();
        RefinedPair { keyframe, relative_to: 0, keyframe_from_relative, sigma_translation_metres: 0.1, sigma_rotation_rad: 0.1 }
    }

    /// A tracker that hands on keyframes until `tracked` and a mapper that maps those before `mapped`; what was heard after each.
    fn converse(paced: bool, (tracked, mapped): (usize, usize)) -> Vec<Vec<KeyframeId>> {
        let (done, result) = bounded(1);
        std::thread::spawn(move || {
            let (sender, keyframes) = bounded::<KeyframeId>(4);
            let (teller, mut listener) = channel(&config(paced));
            let mapper = std::thread::spawn(move || {
                for keyframe in keyframes.iter().take(mapped) {
                    teller.tell(keyframe, &[pair(keyframe)]);
                }
            });
            let mut heard = Vec::new();
            for keyframe in 0..tracked {
                let _ = sender.send(keyframe);
                heard.push(listener.hear(Some(keyframe)).iter().map(|m| m.keyframe).collect());
                assert!(paced || listener.hear(None).is_empty());
            }
            drop((sender, listener));
            mapper.join().unwrap();
            done.send(heard).unwrap();
        });
        result.recv_timeout(HANGS_AFTER).expect("tracker and mapper wait for each other")
    }

    #[test]
    fn unpaced_each_report_is_heard_at_a_fixed_keyframe() {
        let heard = converse(false, (KEYFRAMES, KEYFRAMES));
        let expected: Vec<Vec<KeyframeId>> = (0..KEYFRAMES).map(|k| k.checked_sub(LAG).into_iter().collect()).collect();
        assert_eq!(heard, expected);
    }

    #[test]
    fn nobody_waits_for_one_who_has_gone() {
        for mapped in [0, 1, 7, KEYFRAMES - 1] {
            let heard = converse(false, (KEYFRAMES, mapped)).concat();
            assert_eq!(heard, (0..mapped.min(KEYFRAMES - LAG)).collect::<Vec<_>>());
            converse(true, (KEYFRAMES, mapped));
        }
        converse(false, (5, KEYFRAMES));
        converse(true, (5, KEYFRAMES));
    }

    #[test]
    fn paced_nobody_waits_at_all() {
        let (teller, mut listener) = channel(&config(true));
        (0..KEYFRAMES).for_each(|k| teller.tell(k, &[pair(k)]));
        assert_eq!(listener.hear(Some(KEYFRAMES)).len(), LAG + 1);
        assert!(listener.hear(None).is_empty());
    }

    #[test]
    fn without_refined_poses_there_is_nothing_to_wait_for() {
        let (teller, mut listener) = channel(&Config::default());
        teller.tell(0, &[pair(0)]);
        assert!((0..KEYFRAMES).all(|k| listener.hear(Some(k)).is_empty()));
    }
}
