//! Tracks a recorded sequence and says how well: `track <sequence folder> [trajectory.txt] [key=value …]` prints frames tracked,
//! keyframes, ATE RMSE after SE(3) alignment, and the time per frame by stage. `key=value` sets a field of the
//! tracking config; `every=N` takes every N-th frame, `hold_out=N` lets no N-th frame become a keyframe.

use std::error::Error;
use std::path::Path;

use keysplat::geometry::{StampedPose, Trajectory};
use keysplat::sequence::Sequence;
use keysplat::tracking::{StageTimes, Tracker, TrackingConfig, TrackingState};
use nalgebra::{Matrix3, Vector3};

/// Poses further apart in time than this are not compared.
const MAX_TIME_DIFFERENCE_S: f64 = 0.02;

fn main() -> Result<(), Box<dyn Error>> {
    let (settings, paths): (Vec<String>, Vec<String>) = std::env::args().skip(1).partition(|a| a.contains('='));
    let folder = paths.first().ok_or("usage: track <sequence folder> [trajectory.txt] [key=value …]")?;
    let number = |key: &str| settings.iter().find_map(|s| s.strip_prefix(key)).map(str::parse::<usize>).transpose();
    let (every, hold_out) = (number("every=")?.unwrap_or(1), number("hold_out=")?.unwrap_or(usize::MAX));
    let own = |s: &&String| !s.starts_with("every=") && !s.starts_with("hold_out=");
    let config: TrackingConfig = toml::from_str(&settings.iter().filter(own).cloned().collect::<Vec<_>>().join("\n"))?;
    let mut sequence = Sequence::open(Path::new(folder), None, None)?;
    sequence.select(None, every)?;
    let mut tracker = Tracker::new(sequence.camera, &config)?;
    let (mut times, mut lost, mut inliers) = (Vec::<StageTimes>::new(), Vec::new(), Vec::new());
    let mut shared = Vec::new();
    for index in 0..sequence.entries.len() {
        let tracked = tracker.track(&sequence.load(index)?, (index + 1) % hold_out != 0)?;
        times.push(tracked.times);
        inliers.push(tracked.inliers);
        shared.extend(tracked.keyframe.map(|k| k.covisible.first().map_or(0, |c| c.1)));
        if tracked.state == TrackingState::Lost {
            lost.push(index);
        }
    }
    let trajectory = Trajectory { poses: tracker.trajectory().into_iter().map(|(_, pose)| pose).collect() };
    println!("tracked {}/{}, {} keyframes", trajectory.poses.len(), times.len(), tracker.keyframes().len());
    if !lost.is_empty() {
        println!("lost: {lost:?}");
    }
    inliers.sort_unstable();
    println!("inliers: least {}, 5% {}, median {}", inliers[0], inliers[inliers.len() / 20], inliers[inliers.len() / 2]);
    shared.sort_unstable();
    println!("landmarks shared by neighbouring keyframes: median {}", shared[shared.len() / 2]);
    if let Some(truth) = &sequence.groundtruth {
        print_ate(&trajectory, truth);
    }
    print_times(&times);
    if let Some(path) = paths.get(1) {
        trajectory.write_tum(Path::new(path))?;
    }
    Ok(())
}

/// A position estimated and its truth, metres.
struct Pair {
    timestamp_s: f64,
    ours: Vector3<f64>,
    truth: Vector3<f64>,
}

fn print_ate(trajectory: &Trajectory, truth: &Trajectory) {
    let nearest = |t: f64| {
        let by_time = |a: &&StampedPose, b: &&StampedPose| (a.timestamp_s - t).abs().total_cmp(&(b.timestamp_s - t).abs());
        trajectory.poses.iter().min_by(by_time).filter(|p| (p.timestamp_s - t).abs() <= MAX_TIME_DIFFERENCE_S)
    };
    let pair = |t: &StampedPose| {
        nearest(t.timestamp_s).map(|p| Pair { timestamp_s: t.timestamp_s, ours: position(p), truth: position(t) })
    };
    let mut pairs: Vec<Pair> = truth.poses.iter().filter_map(pair).collect();
    if pairs.len() < 3 {
        println!("too few poses with truth");
        return;
    }
    let count = pairs.len() as f64;
    let ours_mean = pairs.iter().map(|p| p.ours).sum::<Vector3<f64>>() / count;
    let truth_mean = pairs.iter().map(|p| p.truth).sum::<Vector3<f64>>() / count;
    for p in &mut pairs {
        p.ours -= ours_mean;
        p.truth -= truth_mean;
    }
    let covariance: Matrix3<f64> = pairs.iter().map(|p| p.truth * p.ours.transpose()).sum();
    let svd = covariance.svd(true, true);
    let (u, v_t) = (svd.u.unwrap_or_default(), svd.v_t.unwrap_or_default());
    let flip = Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, (u * v_t).determinant().signum()));
    let rotation = u * flip * v_t;
    let errors: Vec<(f64, f64)> = pairs.iter().map(|p| (p.timestamp_s, (rotation * p.ours - p.truth).norm())).collect();
    let rmse = (errors.iter().map(|e| e.1 * e.1).sum::<f64>() / errors.len() as f64).sqrt();
    let worst = errors.iter().max_by(|a, b| a.1.total_cmp(&b.1)).copied().unwrap_or_default();
    // What scale would fit best says whether depth or drift is at fault.
    let spread: f64 = pairs.iter().map(|p| p.ours.norm_squared()).sum();
    let scale = pairs.iter().map(|p| (rotation * p.ours).dot(&p.truth)).sum::<f64>() / spread;
    println!(
        "ATE RMSE {:.3} cm over {} poses, worst {:.2} cm at {:.2} s, best scale {scale:.4}",
        rmse * 100.0,
        errors.len(),
        worst.1 * 100.0,
        worst.0
    );
}

fn position(pose: &StampedPose) -> Vector3<f64> {
    pose.world_from_camera.translation.vector
}

fn print_times(times: &[StageTimes]) {
    let row = |name: &str, pick: fn(&StageTimes) -> f64| {
        let mut values: Vec<f64> = times.iter().map(pick).filter(|ms| *ms > 0.0).collect();
        values.sort_by(f64::total_cmp);
        let at = |share: f64| values.get((share * values.len() as f64) as usize).copied().unwrap_or_default();
        let sum: f64 = values.iter().sum();
        let (mean, per_frame) = (sum / values.len().max(1) as f64, sum / times.len() as f64);
        println!(
            "{name:>9} ms: median {:6.1}  mean {mean:6.1}  p95 {:6.1}  ({} times, {per_frame:.1} per frame)",
            at(0.5),
            at(0.95),
            values.len()
        );
    };
    row("total", StageTimes::total_ms);
    row("features", |t| t.features_ms);
    row("localise", |t| t.localise_ms);
    row("mapping", |t| t.mapping_ms);
    row("bundle", |t| t.bundle_ms);
}
