//! Tracks a recorded sequence and says how well: `track <sequence folder> [trajectory.txt] [key=value …]` prints frames tracked,
//! keyframes, ATE RMSE after alignment (with scale for one camera alone), and the time per frame by stage. `key=value` sets a field of the
//! tracking config; `sensor=mono` leaves depth or the right eye out, `every=N` takes every N-th frame, `hold_out=N` lets no N-th frame become a keyframe,
//! `real_time=true` applies bundle adjustment when it is ready, as a real-time run does, though frames come as fast as they are tracked.

use std::error::Error;
use std::path::Path;

use clap::ValueEnum;
use keysplat::evaluation::{Alignment, evaluate_trajectory};
use keysplat::geometry::Trajectory;
use keysplat::sequence::{SensorKind, Sequence};
use keysplat::tracking::{StageTimes, Tracker, TrackingConfig, TrackingState};

fn main() -> Result<(), Box<dyn Error>> {
    let (settings, paths): (Vec<String>, Vec<String>) = std::env::args().skip(1).partition(|a| a.contains('='));
    let folder = paths.first().ok_or("usage: track <sequence folder> [trajectory.txt] [key=value …]")?;
    let number = |key: &str| settings.iter().find_map(|s| s.strip_prefix(key)).map(str::parse::<usize>).transpose();
    let (every, hold_out) = (number("every=")?.unwrap_or(1), number("hold_out=")?.unwrap_or(usize::MAX));
    let real_time = settings.iter().any(|s| s == "real_time=true");
    let own = |s: &&String| !["sensor=", "every=", "hold_out=", "real_time="].iter().any(|key| s.starts_with(key));
    let config: TrackingConfig = toml::from_str(&settings.iter().filter(own).cloned().collect::<Vec<_>>().join("\n"))?;
    let mut sequence = Sequence::open(Path::new(folder), None, None)?;
    if let Some(kind) = settings.iter().find_map(|s| s.strip_prefix("sensor=")) {
        sequence.restrict_to(SensorKind::from_str(kind, true)?)?;
    }
    let sensor = sequence.sensor.kind();
    sequence.select(None, every)?;
    let mut tracker = Tracker::new(sequence.camera, sequence.sensor, &config)?.real_time(real_time);
    let (mut times, mut lost, mut inliers) = (Vec::<StageTimes>::new(), Vec::new(), Vec::new());
    let mut shared = Vec::new();
    for index in 0..sequence.entries.len() {
        let Ok(frame) = sequence.load(index) else {
            lost.push(index);
            continue;
        };
        let tracked = tracker.track(&frame, (index + 1) % hold_out != 0)?;
        times.push(tracked.times);
        inliers.push(tracked.inliers);
        shared.extend(tracked.keyframe.map(|k| k.covisible.first().map_or(0, |c| c.1)));
        if tracked.state == TrackingState::Lost {
            lost.push(index);
        }
    }
    tracker.finish()?;
    let trajectory = Trajectory { poses: tracker.trajectory().into_iter().map(|(_, pose)| pose).collect() };
    println!(
        "tracked {}/{}, {} keyframes, {} live",
        trajectory.poses.len(),
        times.len(),
        tracker.keyframes().len(),
        tracker.living_keyframes()
    );
    if !lost.is_empty() {
        println!("lost: {lost:?}");
    }
    inliers.sort_unstable();
    println!("inliers: least {}, 5% {}, median {}", inliers[0], inliers[inliers.len() / 20], inliers[inliers.len() / 2]);
    shared.sort_unstable();
    println!("landmarks shared by neighbouring keyframes: median {}", shared[shared.len() / 2]);
    if let Some(truth) = &sequence.groundtruth {
        print_errors(&trajectory, truth, if sensor == SensorKind::Mono { Alignment::Similarity } else { Alignment::Rigid });
    }
    print_times(&times);
    if let Some(path) = paths.get(1) {
        trajectory.write_tum(Path::new(path))?;
    }
    Ok(())
}

fn print_errors(trajectory: &Trajectory, truth: &Trajectory, alignment: Alignment) {
    match evaluate_trajectory(truth, trajectory, alignment) {
        Ok(e) => println!(
            "ATE RMSE {:.3} cm over {} poses, median {:.2} cm, worst {:.2} cm",
            100.0 * e.ate_rmse_m,
            e.pairs,
            100.0 * e.ate_median_m,
            100.0 * e.ate_max_m
        ),
        Err(error) => println!("no ATE: {error}"),
    }
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
    row("loops", |t| t.loops_ms);
}
