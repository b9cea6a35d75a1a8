//! Rate and gaps of the frames' timestamps.

use super::{Inspection, quantile};
use crate::sequence::Sequence;

/// An interval of so many usual ones is a gap, if it is long enough to lose the camera.
const GAP_INTERVALS: f64 = 5.0;
const GAP_S: f64 = 0.5;
/// Consecutive frames further apart than this show little of the same surface.
const SPARSE_S: f64 = 0.2;
/// No camera takes frames at such intervals: the unit is another.
const TOO_LONG_S: f64 = 10.0;
const TOO_SHORT_S: f64 = 0.0005;

pub fn inspect(sequence: &Sequence, found: &mut Inspection) {
    let times: Vec<f64> = sequence.entries.iter().map(|entry| entry.timestamp_s).collect();
    if sequence.layout.is_photos() {
        found.fact("photos", times.len().to_string());
        return;
    }
    let intervals: Vec<f64> = times.windows(2).map(|pair| pair[1] - pair[0]).collect();
    if intervals.is_empty() {
        found.fact("frames", times.len().to_string());
        found.problem("there is one frame: a map needs several".into());
        return;
    }
    let mut sorted = intervals.clone();
    sorted.sort_by(f64::total_cmp);
    let usual = quantile(&sorted, 0.5);
    let longest = (0..intervals.len()).max_by(|a, b| intervals[*a].total_cmp(&intervals[*b])).unwrap_or(0);
    let span = times[times.len() - 1] - times[0];
    found.fact("frames", format!("{} over {span:.2} s, {:.1} Hz", times.len(), 1.0 / usual));
    let repeated = intervals.iter().filter(|interval| **interval <= 0.0).count();
    if repeated > 0 {
        found.warn(format!("{repeated} frames have the timestamp of the frame before them: motion between them has no speed"));
    }
    if usual > TOO_LONG_S || (usual < TOO_SHORT_S && repeated == 0) {
        found.warn(format!("the usual interval is {usual} s: timestamps are seconds; divide those of another unit"));
    } else if usual > SPARSE_S {
        found.warn(format!("frames are {usual:.2} s apart: tracking needs the same surface in consecutive frames"));
    }
    let gaps = intervals.iter().filter(|interval| **interval > GAP_S.max(GAP_INTERVALS * usual)).count();
    if gaps > 0 {
        let (index, seconds) = (longest + 1, intervals[longest]);
        found.warn(format!(
            "{gaps} gaps between frames, the longest {seconds:.1} s before frame {index}: the camera may be lost there, and the map \
             continues where a place is recognised"
        ));
    }
}
