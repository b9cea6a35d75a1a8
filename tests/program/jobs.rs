//! Plans as the program makes, runs and merges them: killed tasks, early signals, spoilt inputs, Slurm's script.

use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use crate::common::recording::{
    Finished, color_file, copy_of_recording, finish, keysplat, recording, scratch, skipped_without_adapter, truncate,
};

/// No task here takes longer to a checkpoint.
const HANGS_AFTER: Duration = Duration::from_secs(180);
/// A keyframe for nearly each frame and a checkpoint for each keyframe: most of the work follows the first.
const OPTIONS: [&str; 9] = [
    "--",
    "--set",
    "tracking.keyframe_translation=0.02",
    "--set",
    "mapping.first_iterations=20",
    "--set",
    "mapping.iterations_per_keyframe=10",
    "--checkpoint-every",
    "1",
];

fn jobs(what: &str, plan: &Path, more: &[&str]) -> Command {
    let mut command = keysplat(["jobs", what]);
    command.arg(plan).args(more);
    command
}

fn sweep(recording: &Path, place: &str, folder: &Path) -> Finished {
    let mut command = keysplat(["bench", "sweep", recording.to_str().unwrap(), "--epochs", "1,2", place]);
    command.arg(folder).args(OPTIONS);
    finish(command).succeeded()
}

/// All columns but the time and the memory of a run.
fn figures(folder: &Path) -> Vec<String> {
    let csv = std::fs::read_to_string(folder.join("sweep.csv")).unwrap();
    let kept = |line: &str| {
        let cells: Vec<&str> = line.split(',').collect();
        [&cells[..5], &cells[6..12], &cells[13..]].concat().join(",")
    };
    csv.lines().map(kept).collect()
}

/// Starts a task and waits until it has a checkpoint of its own.
fn started(plan: &Path, task: &str) -> Child {
    let checkpoint = plan.join("tasks").join(format!("{task:0>4}")).join("working/checkpoint.bin");
    let mut child = jobs("run", plan, &["--task", task]).stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
    let began = Instant::now();
    while !checkpoint.exists() {
        assert!(child.try_wait().unwrap().is_none(), "it ended before its first checkpoint");
        assert!(began.elapsed() < HANGS_AFTER, "no checkpoint");
        std::thread::sleep(Duration::from_millis(1));
    }
    child
}

fn states(plan: &Path) -> serde_json::Value {
    serde_json::from_str(&finish(jobs("status", plan, &["--json"])).succeeded().stdout).unwrap()
}

#[cfg(unix)]
#[test]
fn killed_and_interrupted_tasks_merge_to_the_table_of_the_sweep() {
    if skipped_without_adapter() {
        return;
    }
    let (plan, out) = (scratch().join("plan"), scratch().join("sweep"));
    sweep(recording(), "--out", &out);
    sweep(recording(), "--plan", &plan);
    let mut killed = started(&plan, "0");
    finish(jobs("run", &plan, &["--task", "0"])).refused(&["another process works on the task"]);
    assert_eq!(states(&plan)["tasks"][0]["state"], "running");
    killed.kill().unwrap();
    assert_eq!(killed.wait().unwrap().code(), None);
    let mut interrupted = started(&plan, "1");
    assert!(Command::new("kill").args(["-USR1", &interrupted.id().to_string()]).status().unwrap().success());
    assert_eq!(interrupted.wait().unwrap().code(), Some(75));
    assert!(plan.join("tasks/0001/working/checkpoint.bin").exists());
    let states_then = states(&plan);
    assert_eq!(
        (&states_then["tasks"][0]["reason"], &states_then["tasks"][1]["reason"]),
        (&"interrupted".into(), &"interrupted".into())
    );
    finish(jobs("merge", &plan, &[])).refused(&["task 0 (recording, 1 epochs, seed 0)", "task 1", "2 of 2 tasks"]);

    let merged = finish(jobs("submit", &plan, &["--local", "2"])).succeeded();
    assert!(merged.stdout.contains("| recording | 2 epochs | 1 |"), "{}", merged.stdout);
    assert_eq!(figures(&plan), figures(&out));
    assert_eq!(std::fs::read_to_string(plan.join("sweep.json")).unwrap().lines().count(), {
        std::fs::read_to_string(out.join("sweep.json")).unwrap().lines().count()
    });
    let resumed = std::fs::read_to_string(plan.join("tasks/0000/result/metrics.json")).unwrap();
    assert!(resumed.contains("\"resumed\": 1"), "{resumed}");
    // Nothing is left to do.
    let digest = states(&plan)["digest"].clone();
    assert!(digest.is_string());
    finish(jobs("submit", &plan, &["--local", "1"])).succeeded();
    assert_eq!(states(&plan)["digest"], digest);
    // A damaged result is made anew.
    let map = plan.join("tasks/0000/result/map.ply");
    truncate(&map, 100);
    finish(jobs("merge", &plan, &[])).refused(&["map.ply is damaged"]);
    finish(jobs("submit", &plan, &["--local", "1"])).succeeded();
    assert_eq!(states(&plan)["digest"], digest);
    assert!(std::fs::metadata(&map).unwrap().len() > 100);
}

#[test]
fn a_spoilt_input_is_a_hole_that_is_named() {
    if skipped_without_adapter() {
        return;
    }
    let (spoilt, plan) = (copy_of_recording("spoilt"), scratch().join("spoilt-plan"));
    sweep(&spoilt, "--plan", &plan);
    assert_eq!(finish(jobs("run", &plan, &["--task", "0"])).succeeded().code, Some(0));
    truncate(&color_file(&spoilt, 5), 100);
    let refused = finish(jobs("run", &plan, &["--task", "1"]));
    assert_eq!(refused.code, Some(65));
    refused.refused(&[color_file(Path::new(""), 5).to_str().unwrap(), "is not what it was", "plan anew"]);
    let merged = finish(jobs("merge", &plan, &["--allow-holes"]));
    assert_eq!(merged.code, Some(3));
    let json = std::fs::read_to_string(plan.join("sweep.json")).unwrap();
    assert!(json.contains("hole: task 1 (spoilt, 2 epochs, seed 0)") && json.contains("is not what it was"), "{json}");
    assert_eq!(finish(jobs("run", &plan, &["--task", "7"])).code, Some(65));
}

#[test]
fn replays_merge_to_the_table_of_track() {
    let (plan, out) = (scratch().join("track-plan"), scratch().join("track"));
    let track = |place: &str, folder: &PathBuf| {
        let mut command =
            keysplat(["bench", "track", recording().to_str().unwrap(), "--starts", "2", "--every", "1", "--missing", "20"]);
        command.args(["--variant", "usual:", "--variant", "few: tracking.features=500", place]).arg(folder);
        finish(command).succeeded()
    };
    track("--out", &out);
    track("--plan", &plan);
    finish(jobs("submit", &plan, &["--local", "2"])).succeeded();
    // Without the two times, which are the only figures that may differ.
    let figures = |folder: &Path| {
        let csv = std::fs::read_to_string(folder.join("track.csv")).unwrap();
        csv.lines().map(|line| line.rsplitn(3, ',').last().unwrap().to_owned()).collect::<Vec<_>>()
    };
    assert_eq!(figures(&plan).len(), 9);
    assert_eq!(figures(&plan), figures(&out));
}

/// Stands in for Slurm: records what is submitted, or requeued.
#[cfg(unix)]
fn slurm_that_records() -> PathBuf {
    use std::os::unix::fs::PermissionsExt;
    let bin = scratch().join("bin");
    std::fs::create_dir_all(&bin).unwrap();
    for (name, answer) in [("sbatch", "echo 17"), ("scontrol", ""), ("squeue", "echo '17_1|TIMEOUT|TimeLimit'")] {
        let path = bin.join(name);
        std::fs::write(&path, format!("#!/bin/bash\necho {name} \"$@\" >>\"$(dirname \"$0\")/log\"\n{answer}\n")).unwrap();
        std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o755)).unwrap();
    }
    bin
}

#[cfg(unix)]
#[test]
fn slurm_gets_an_array_that_requeues_itself() {
    let (plan, bin) = (scratch().join("slurm-plan"), slurm_that_records());
    let mut track =
        keysplat(["bench", "track", recording().to_str().unwrap(), "--starts", "1", "--every", "1", "--missing", "0"]);
    finish({
        track.arg("--plan").arg(&plan);
        track
    })
    .succeeded();
    let path = format!("{}:{}", bin.display(), std::env::var("PATH").unwrap());
    let mut submit = jobs("submit", &plan, &["--slurm", "--", "--time=60"]);
    submit.env("PATH", &path);
    assert!(finish(submit).succeeded().stdout.contains("2 tasks in the arrays [17]; job 17 merges"));
    let log = std::fs::read_to_string(bin.join("log")).unwrap();
    let lines: Vec<&str> = log.lines().collect();
    assert!(["--requeue", "--signal=B:USR1@60", "--array=0-1", "--time=60"].iter().all(|part| lines[0].contains(part)), "{log}");
    assert!(lines[1].contains("--dependency=afterany:17") && lines[1].contains("jobs merge"), "{log}");

    let run = |task: &str| {
        let mut script = Command::new("bash");
        script.arg(plan.join("slurm/tasks.sh")).arg("0").env("PATH", &path).stdout(Stdio::piped()).stderr(Stdio::piped());
        finish({
            script.env("SLURM_ARRAY_JOB_ID", "17").env("SLURM_ARRAY_TASK_ID", task);
            script
        })
    };
    assert_eq!(run("0").code, Some(0));
    let mut status = jobs("status", &plan, &[]);
    status.env("PATH", &path);
    let table = finish(status).succeeded().stdout;
    assert!(table.contains("| done |") && table.contains("Slurm ended it: TIMEOUT (TimeLimit; give it more time)"), "{table}");
    // Another process has the task: it is requeued.
    let folder = plan.join("tasks/0001");
    std::fs::create_dir_all(&folder).unwrap();
    let lock = std::fs::File::create(folder.join(".lock")).unwrap();
    lock.lock().unwrap();
    assert_eq!(run("1").code, Some(75));
    drop(lock);
    assert!(std::fs::read_to_string(bin.join("log")).unwrap().contains("scontrol requeue 17_1"));
    assert_eq!(run("1").code, Some(0));
}
