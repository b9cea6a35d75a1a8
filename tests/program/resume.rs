//! Runs that were killed and go on from their checkpoint end as if nothing had happened, to the byte; what cannot go on says why.

use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::OnceLock;
use std::time::{Duration, Instant};

use crate::common::pairs::stereo_recording;
use crate::common::recording::{
    Finished, change_line, color_file, copy_folder, copy_of_recording, finish, keysplat, metrics, recording, run_command,
    scratch, skipped_without_adapter, truncate,
};
use keysplat::sequence::SensorKind;
use keysplat::synthetic::{self, CameraConfig, FurnitureConfig, PathConfig, PathKind, RoomConfig, SceneConfig};

/// A keyframe for nearly each frame, so that there are many moments between two.
const KEYFRAMES: [&str; 4] = ["--set", "tracking.keyframe_translation=0.02", "--set", "mapping.iterations_per_keyframe=10"];
/// No run here takes longer.
const HANGS_AFTER: Duration = Duration::from_secs(180);

fn checkpoint(out: &Path) -> PathBuf {
    out.join("checkpoint.bin")
}

fn keeping(recording: &Path, out: &Path, more: &[&str]) -> Command {
    run_command(recording, out, &[&KEYFRAMES[..], &["--checkpoint-every", "1"], more].concat())
}

fn resume(out: &Path) -> Command {
    keysplat([Path::new("resume"), out])
}

/// An unbroken run without checkpoints.
fn unbroken(name: &str, recording: &Path, more: &[&str]) -> PathBuf {
    let out = scratch().join(name);
    finish(run_command(recording, &out, &[&KEYFRAMES[..], more].concat())).succeeded();
    assert!(!checkpoint(&out).exists());
    out
}

/// What tells a checkpoint from the one before it.
fn written(out: &Path) -> Option<std::time::SystemTime> {
    std::fs::metadata(checkpoint(out)).and_then(|file| file.modified()).ok()
}

/// Starts a command and waits until `count` further checkpoints have been seen.
fn started(mut command: Command, out: &Path, count: usize) -> Child {
    let mut last = written(out);
    let mut child = command.stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
    let (began, mut seen) = (Instant::now(), 0);
    while seen < count {
        assert!(child.try_wait().unwrap().is_none(), "it ended before its checkpoint {count}");
        assert!(began.elapsed() < HANGS_AFTER, "no checkpoint");
        let now = written(out);
        seen += usize::from(now.is_some() && now != last);
        last = now;
        std::thread::sleep(Duration::from_millis(1));
    }
    child
}

/// Kills a command once `count` further checkpoints have been seen.
fn killed(command: Command, out: &Path, count: usize) {
    kill(started(command, out, count), out);
}

/// Kills a resumed run when it begins to replay what came before its checkpoint.
fn killed_while_catching_up(mut command: Command, out: &Path) {
    let mut child = command.stdout(Stdio::null()).spawn().unwrap();
    let mut log = BufReader::new(child.stderr.take().unwrap()).lines();
    assert!(log.any(|line| line.unwrap().contains("replaying into")), "it ended before it was killed");
    kill(child, out);
}

fn kill(mut child: Child, out: &Path) {
    child.kill().unwrap();
    assert!(!child.wait().unwrap().success(), "it ended before it was killed");
    assert!(checkpoint(out).exists());
}

/// Everything that a run decides is the same in both folders, and nothing else is there.
fn assert_same_run(a: &Path, b: &Path) {
    let read = |out: &Path, file: &str| std::fs::read(out.join(file)).unwrap();
    for file in ["trajectory.txt", "keyframes.txt", "map.ply", "trajectory.svg", "views/000007.png"] {
        assert!(read(a, file) == read(b, file), "{file} differs");
    }
    let decided = |out: &Path| {
        let m = metrics(out);
        (m.map_hash, m.config_hash, m.ate_rmse_m, m.images, m.gaussians, m.keyframes, m.mapping.unwrap().iterations)
    };
    assert_eq!(decided(a), decided(b));
    let reports = |out: &Path| {
        let history: serde_json::Value = serde_json::from_slice(&read(out, "history.json")).unwrap();
        let keyframes = history["keyframes"].as_array().unwrap().clone();
        keyframes
            .into_iter()
            .map(|mut keyframe| {
                ["done_s", "busy_s", "waiting", "host_bytes"].iter().for_each(|time| keyframe[*time] = 0.into());
                keyframe
            })
            .collect::<Vec<_>>()
    };
    assert_eq!(reports(a), reports(b));
    let names = |out: &Path| {
        let mut names: Vec<_> = std::fs::read_dir(out).unwrap().map(|entry| entry.unwrap().file_name()).collect();
        names.sort();
        names
    };
    assert_eq!(names(a), names(b));
}

/// Killed between two checkpoints, again while it catches up, and again later, the run ends as it would have, and says that it was
/// interrupted.
fn survives(name: &str, recording: &Path, more: &[&str], checkpoints: usize) {
    let whole = unbroken(&format!("{name}-whole"), recording, more);
    let out = scratch().join(name);
    killed(keeping(recording, &out, more), &out, checkpoints);
    killed_while_catching_up(resume(&out), &out);
    killed(resume(&out), &out, 2);
    let said = finish(resume(&out)).succeeded();
    assert!(said.stderr.contains("checkpoint reached"), "{}", said.stderr);
    assert_same_run(&out, &whole);
    // The second part may not have come to a checkpoint.
    let resumed = metrics(&out).resumed;
    assert!((2..=3).contains(&resumed) && metrics(&whole).resumed == 0, "resumed {resumed} times");
    assert!(said.stdout.contains(&format!("resumed {resumed}×")), "{}", said.stdout);
}

#[test]
fn a_killed_run_ends_as_the_unbroken_one() {
    if !skipped_without_adapter() {
        survives("killed", recording(), &[], 3);
    }
}

/// Depth then comes from the right eye: for the tracker's landmarks, and swept for between them.
#[test]
fn a_killed_stereo_run_ends_as_the_unbroken_one() {
    if skipped_without_adapter() {
        return;
    }
    survives("stereo", stereo_recording(), &[], 3);
    let whole = metrics(&scratch().join("stereo-whole"));
    assert!(whole.sensor == SensorKind::Stereo && whole.frames_tracked == whole.frames, "{whole}");
    assert!(whole.ate_rmse_m.all_frames.unwrap() < 0.02, "{whole}");
}

/// The mapper then counts every byte that it uses, and has given images back.
#[test]
fn what_memory_allows_comes_again() {
    if skipped_without_adapter() {
        return;
    }
    let settings = ["tracking.keyframe_translation=0.005", "mapping.limits.max_gpu_images=8"];
    let more: Vec<&str> = settings.iter().flat_map(|s| ["--set", s]).chain(["--max-gpu-memory", "18M"]).collect();
    survives("limited", recording(), &more, 11);
    let whole = metrics(&scratch().join("limited-whole"));
    assert!(whole.keyframes > Some(12) && whole.gaussians < Some(4000), "neither limit matters: {whole}");
}

/// A walk through three rooms, of which the GPU holds one and a half.
fn walk() -> PathBuf {
    let camera = CameraConfig { width: 96, height: 72, fx: 80.0, fy: 80.0, cx: 47.5, cy: 35.5, ..CameraConfig::default() };
    let few = FurnitureConfig { pictures: 3, tables: 1, shelves: 1, ..FurnitureConfig::NONE };
    let room = RoomConfig { width: 5.0, depth: 4.6, rooms: [3, 1], ..RoomConfig::default() };
    let path = PathConfig { kind: PathKind::Walk, speed: 3.0, turn_rate: 180.0, ..PathConfig::default() };
    let scene = SceneConfig { seed: 5, frames: 100, fps: 6.0, camera, room, furniture: few, path, ..SceneConfig::default() };
    let folder = scratch().join("rooms");
    synthetic::generate(&scene, &folder, &|_, _| ()).unwrap();
    folder
}

/// What a checkpoint names in the file of Gaussians is there, whatever was written after it.
#[test]
fn a_map_larger_than_the_gpu_comes_again() {
    if skipped_without_adapter() {
        return;
    }
    let settings = ["refine.steps=150", "refine.density_every=50", "first_iterations=10", "refine.steps_per_keyframe=2"];
    let settings: Vec<String> = settings.iter().map(|setting| format!("mapping.{setting}")).collect();
    let bound = ["--known-poses", "--max-gpu-memory", "28M", "--set", "mapping.iterations_per_keyframe=4"];
    let more: Vec<&str> = settings.iter().flat_map(|s| ["--set", s]).chain(bound).collect();
    survives("rooms-run", &walk(), &more, 60);
    let (out, whole) = (scratch().join("rooms-run"), metrics(&scratch().join("rooms-run-whole")));
    let paging = whole.mapping.unwrap().paging.expect("Gaussians have left the GPU");
    assert!(paging.gaussians_out > 10_000 && paging.gaussians_in > 1000 && paging.most_away > 5000, "{paging:?}");
    assert!(whole.peak_gpu_bytes.unwrap() <= 28 << 20 && whole.gaussians.unwrap() > 15_000, "{whole}");
    assert!(!out.join("chunks.bin").exists(), "it is of no use after the end");
    // Killed after its checkpoint, and the file is gone.
    let lost = scratch().join("rooms-lost");
    killed(keeping(&scratch().join("rooms"), &lost, &more), &lost, 60);
    std::fs::remove_file(lost.join("chunks.bin")).unwrap();
    let message = finish(resume(&lost));
    assert!(message.stderr.contains("chunks.bin") && message.stderr.contains("cannot be opened"), "{}", message.stderr);
}

#[test]
fn consolidation_ends_as_in_an_unbroken_run() {
    if skipped_without_adapter() {
        return;
    }
    let settings = ["tracking.keyframe_translation=0.005", "mapping.refine.steps_per_keyframe=3"];
    let final_epochs = ["--set", "mapping.refine.final_epochs=2", "--set", "mapping.refine.density_every=15"];
    let more: Vec<&str> = settings.iter().flat_map(|s| ["--set", s]).chain(final_epochs).collect();
    survives("consolidated", recording(), &more, 11);
}

#[test]
fn a_refinement_goes_on_where_it_stood() {
    if skipped_without_adapter() {
        return;
    }
    let refine = ["--known-poses", "--set", "mapping.refine.steps=60", "--set", "mapping.refine.density_every=15"];
    let whole = unbroken("refined-whole", recording(), &refine);
    let keyframes = metrics(&whole).keyframes.unwrap() as usize;
    let out = scratch().join("refined");
    // The first checkpoint comes before any keyframe, and a round follows them.
    killed(keeping(recording(), &out, &refine), &out, keyframes + 2);
    finish(resume(&out)).succeeded();
    assert_same_run(&out, &whole);
    assert_eq!(metrics(&out).resumed, 1);
    // The report says it too.
    finish(keysplat(["report".as_ref(), out.as_os_str()])).succeeded();
    assert!(std::fs::read_to_string(out.join("report.html")).unwrap().contains("deterministic, resumed 1×"));
}

#[cfg(unix)]
#[test]
fn what_a_signal_ended_early_can_go_on() {
    if skipped_without_adapter() {
        return;
    }
    let many = ["--set", "tracking.keyframe_translation=0.005"];
    let whole = unbroken("stopped-whole", recording(), &many);
    let out = scratch().join("stopped");
    let mut child = started(keeping(recording(), &out, &many), &out, 3);
    assert!(Command::new("kill").args(["-TERM", &child.id().to_string()]).status().unwrap().success());
    assert!(child.wait().unwrap().success());
    let steps = |out: &Path| metrics(out).mapping.unwrap().iterations;
    assert!(steps(&out) < steps(&whole) && checkpoint(&out).exists());
    finish(resume(&out)).succeeded();
    assert_same_run(&out, &whole);
}

/// A run that was killed after its third keyframe; tests only copy it.
fn interrupted() -> &'static Path {
    static OUT: OnceLock<PathBuf> = OnceLock::new();
    OUT.get_or_init(|| {
        let (copy, out) = (copy_of_recording("theirs"), scratch().join("interrupted"));
        killed(keeping(&copy, &out, &[]), &out, 4);
        out
    })
}

/// Resumes a copy of the interrupted run after `spoil` had it; the checkpoint stays as it is.
fn resumed_after(name: &str, spoil: impl FnOnce(&Path)) -> Finished {
    let out = scratch().join(name);
    copy_folder(interrupted(), &out);
    spoil(&out);
    let before = std::fs::read(checkpoint(&out)).unwrap();
    let said = finish(resume(&out));
    assert!(std::fs::read(checkpoint(&out)).unwrap() == before);
    assert!(!out.join("trajectory.txt").exists());
    said
}

#[test]
fn a_damaged_checkpoint_is_refused() {
    if skipped_without_adapter() {
        return;
    }
    let damaged = |name: &str, spoil: fn(&Path)| {
        let said = resumed_after(name, |out| spoil(&checkpoint(out)));
        said.refused(&[checkpoint(&scratch().join(name)).to_str().unwrap(), "damaged or cut off", "keysplat run"]);
    };
    damaged("empty", |file| truncate(file, 0));
    damaged("cut-off", |file| truncate(file, std::fs::metadata(file).unwrap().len() - 1));
    damaged("flipped", |file| {
        let mut bytes = std::fs::read(file).unwrap();
        let middle = bytes.len() / 2;
        bytes[middle] ^= 1;
        std::fs::write(file, bytes).unwrap();
    });
}

#[test]
fn another_recording_is_refused() {
    if skipped_without_adapter() {
        return;
    }
    // One after the other: they change the recording of the interrupted run.
    interrupted();
    let theirs = scratch().join("theirs");
    let list = theirs.join("rgb.txt");
    let original = std::fs::read_to_string(&list).unwrap();
    let shorter = original.lines().take(original.lines().count() - 2).map(|line| format!("{line}\n")).collect::<String>();
    std::fs::write(&list, shorter).unwrap();
    resumed_after("shorter", |_| ()).refused(&["checkpoint.bin is of another run", "number of frames was 24 and is 22"]);
    std::fs::write(&list, &original).unwrap();
    change_line(&list, 9, |line| line.replacen(' ', "1 ", 1));
    resumed_after("later", |_| ()).refused(&["checkpoint.bin is of another run", "camera or times"]);
    std::fs::write(&list, &original).unwrap();
    let image = color_file(&theirs, 0);
    let mut picture = image::open(&image).unwrap().into_rgb8();
    picture.get_pixel_mut(0, 0).0[0] ^= 1;
    picture.save(&image).unwrap();
    resumed_after("a-bit", |_| ()).refused(&["checkpoint.bin cannot be resumed", "put the recording back"]);
}

#[test]
fn a_recording_that_moved_is_named_anew() {
    if skipped_without_adapter() {
        return;
    }
    let (there, elsewhere) = (copy_of_recording("there"), scratch().join("elsewhere"));
    let out = scratch().join("moved");
    killed(keeping(&there, &out, &[]), &out, 3);
    std::fs::rename(&there, &elsewhere).unwrap();
    finish(resume(&out)).refused(&["no longer at", there.to_str().unwrap(), "--sequence"]);
    let resume_with = |recording: &Path| {
        let mut command = resume(&out);
        command.current_dir(scratch()).arg("--sequence").arg(recording);
        command
    };
    finish(resume_with(stereo_recording())).refused(&["checkpoint.bin is of another run", "camera or times"]);
    // It stays where it was named, for the part after this one too.
    killed(resume_with(Path::new("elsewhere")), &out, 2);
    finish(resume(&out)).succeeded();
    assert_same_run(&out, &unbroken("moved-whole", recording(), &[]));
}

#[test]
fn a_folder_takes_one_run_at_a_time() {
    if skipped_without_adapter() {
        return;
    }
    let out = scratch().join("twice");
    let mut first = started(keeping(recording(), &out, &["--set", "mapping.iterations_per_keyframe=200"]), &out, 2);
    let busy = ["another keysplat is at work in", out.to_str().unwrap(), "choose another folder"];
    finish(run_command(recording(), &out, &[])).refused(&busy);
    finish(resume(&out)).refused(&busy);
    assert!(first.try_wait().unwrap().is_none(), "it ended too early to be in the way");
    first.kill().unwrap();
    first.wait().unwrap();
    // What is left of it is in nobody's way.
    assert!(out.join(".lock").exists());
    finish(run_command(recording(), &out, &[])).succeeded();
}

#[test]
fn what_is_finished_or_was_never_begun_says_so() {
    if skipped_without_adapter() {
        return;
    }
    let out = unbroken("finished", recording(), &[]);
    let map = std::fs::metadata(out.join("map.ply")).unwrap().modified().unwrap();
    let said = finish(resume(&out)).succeeded();
    assert!(said.stdout.contains("finished; there is nothing to resume"), "{said:?}");
    assert_eq!(std::fs::metadata(out.join("map.ply")).unwrap().modified().unwrap(), map);
    finish(resume(&scratch().join("nowhere"))).refused(&["there is no", "checkpoint.bin", "--checkpoint-every"]);
}

#[test]
fn runs_that_do_not_repeat_keep_no_checkpoints() {
    let out = scratch().join("never");
    for more in
        [&["--real-time"][..], &["--preset", "realtime"], &["--set", "mapping.yields_to_keyframes=true"], &["--time", "5"]]
    {
        finish(keeping(recording(), &out, more)).refused(&["cannot be resumed", "--checkpoint-every", "--real-time"]);
    }
    finish(run_command(recording(), &out, &["--checkpoint-every", "0"])).refused(&["checkpoint_every must be at least 1"]);
    assert!(!out.exists());
}
