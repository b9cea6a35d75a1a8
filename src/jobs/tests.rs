//! Plans of tasks that write one file: round trip, idempotence, faults, holes.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use super::*;
use crate::run_folder::FolderLock;

struct Bench {
    folder: tempfile::TempDir,
    plan: Plan,
}

impl Bench {
    fn new(tasks: usize) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let recording = folder.path().join("recording");
        std::fs::create_dir_all(recording.join("rgb")).unwrap();
        std::fs::write(recording.join("rgb/0.png"), b"one").unwrap();
        std::fs::write(recording.join("list.txt"), b"two").unwrap();
        let plan = Self::draft(folder.path(), tasks).finish().unwrap();
        Self { folder, plan }
    }

    fn draft(folder: &Path, tasks: usize) -> Draft {
        let mut draft = Draft::new(&folder.join("plan")).unwrap();
        let recording = folder.join("recording");
        let input = draft.input(&recording).unwrap();
        for start in 0..tasks {
            let replay = ReplayTask {
                name: "recording".into(),
                recording: draft.place(&recording).unwrap(),
                sensor: None,
                variant: "default".into(),
                settings: Vec::new(),
                start,
                backwards: false,
                every: 1,
                missing_percent: 5,
                most: None,
            };
            draft.task(Task {
                name: format!("replay {start}"),
                seed: start as u64,
                inputs: vec![input],
                work: Work::Replay(replay),
            });
        }
        draft
    }

    fn run(&self, task: usize) -> Result<Ended, JobError> {
        run_task(&self.plan, task, &mut |task, folder| Ok(write_row(task, folder)))
    }

    fn file(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }
}

fn write_row(task: &Task, folder: &Path) -> Made {
    let row = serde_json::json!({
        "recording": "recording", "variant": "default", "start": task.seed, "backwards": false, "every": 1, "missing_percent": 5,
        "frames": 10, "lost": 0, "keyframes": 2, "ate_rmse_m": 0.01, "ms_per_frame": 3.0, "final_ms": 40.0,
    });
    std::fs::write(folder.join("replay.json"), row.to_string()).unwrap();
    Made { figures: row, files: vec!["replay.json".into()], timed_files: Vec::new() }
}

fn never(_: &Task, _: &Path) -> Result<Made, WorkError> {
    panic!("there is nothing to do")
}

#[test]
fn a_plan_is_read_as_it_was_written() {
    let bench = Bench::new(2);
    let read = Plan::read(bench.plan.folder()).unwrap();
    assert_eq!(read, bench.plan);
    assert_eq!(read.inputs.len(), 1);
    let digests = std::fs::read_to_string(bench.plan.folder().join(&read.inputs[0].digests)).unwrap();
    assert_eq!(digests.lines().map(|line| &line[64..]).collect::<Vec<_>>(), ["  list.txt", "  rgb/0.png"]);
    // The same again, and another one.
    Bench::draft(bench.folder.path(), 2).finish().unwrap();
    assert!(matches!(Bench::draft(bench.folder.path(), 3).finish(), Err(JobError::AnotherPlan { .. })));
    assert_eq!(read.task(2).unwrap_err().exit_status(), NEVER_AGAIN);
    let text = std::fs::read_to_string(bench.file("plan/plan.json")).unwrap();
    std::fs::write(bench.file("plan/plan.json"), text.replace("\"format\": 1", "\"format\": 2")).unwrap();
    assert!(matches!(Plan::read(bench.plan.folder()), Err(JobError::Version { .. })));
}

#[test]
fn a_task_is_made_once() {
    let bench = Bench::new(1);
    assert_eq!(digest(&bench.plan), None);
    assert_eq!(bench.run(0).unwrap(), Ended::Made);
    let first = digest(&bench.plan);
    assert_eq!(run_task(&bench.plan, 0, &mut never).unwrap(), Ended::WasThere);
    // A result that was damaged is made again, and is the same.
    let row = bench.file("plan/tasks/0000/result/replay.json");
    std::fs::write(&row, b"{}").unwrap();
    assert!(merge(&bench.plan, &BTreeMap::new(), true).unwrap_err().to_string().contains("replay.json is damaged"));
    assert_eq!(bench.run(0).unwrap(), Ended::Made);
    assert_eq!(digest(&bench.plan), first);
    let left: Vec<_> = std::fs::read_dir(bench.plan.task_folder(0)).unwrap().map(|entry| entry.unwrap().file_name()).collect();
    assert_eq!(left.len(), 2, "a lock and a result: {left:?}");
}

#[test]
fn a_changed_input_is_named_and_never_tried_again() {
    let bench = Bench::new(1);
    let image = bench.file("recording/rgb/0.png");
    std::fs::write(&image, b"One").unwrap();
    let error = run_task(&bench.plan, 0, &mut never).unwrap_err();
    assert_eq!(error.exit_status(), NEVER_AGAIN);
    assert!(error.to_string().contains("rgb/0.png is not what it was"), "{error}");
    let all = status(&bench.plan, &BTreeMap::new());
    assert!(all[0].state == State::Failed && all[0].reason.contains("rgb/0.png") && all[0].reason.contains("status 65"));
    std::fs::remove_file(&image).unwrap();
    assert!(run_task(&bench.plan, 0, &mut never).unwrap_err().to_string().contains("rgb/0.png is missing"));
    std::fs::write(&image, b"one").unwrap();
    std::fs::write(bench.file("recording/new.txt"), b"").unwrap();
    assert!(run_task(&bench.plan, 0, &mut never).unwrap_err().to_string().contains("new.txt is not what it was"));
    std::fs::remove_file(bench.file("recording/new.txt")).unwrap();
    assert_eq!(bench.run(0).unwrap(), Ended::Made);
}

#[test]
fn inputs_are_read_again_only_after_a_change() {
    let bench = Bench::new(1);
    let (folder, input) = (bench.plan.folder(), &bench.plan.inputs[0]);
    // Reading the files finds that they are not these.
    let others = Input { sha256: "0".repeat(64), ..input.clone() };
    let image = bench.file("recording/rgb/0.png");
    std::fs::write(&image, b"one").unwrap();
    assert!(others.verify(folder).is_err());
    std::thread::sleep(std::time::Duration::from_millis(50));
    input.verify(folder).unwrap();
    others.verify(folder).unwrap();
    std::fs::write(&image, b"One").unwrap();
    assert!(input.verify(folder).unwrap_err().to_string().contains("rgb/0.png is not what it was"));
    std::fs::write(&image, b"one").unwrap();
    input.verify(folder).unwrap();
}

#[test]
fn one_process_at_a_time_has_a_task() {
    let bench = Bench::new(1);
    std::fs::create_dir_all(bench.plan.task_folder(0)).unwrap();
    let lock = FolderLock::take(&bench.plan.task_folder(0)).unwrap();
    assert_eq!(status(&bench.plan, &BTreeMap::new())[0].state, State::Running);
    assert_eq!(run_task(&bench.plan, 0, &mut never).unwrap_err().exit_status(), AGAIN);
    drop(lock);
    assert_eq!(bench.run(0).unwrap(), Ended::Made);
}

#[test]
fn an_interrupted_task_goes_on_until_it_gets_nowhere() {
    let bench = Bench::new(1);
    let interrupt = |checkpoint: &'static [u8]| {
        let mut work = |_: &Task, folder: &Path| {
            std::fs::write(folder.join("checkpoint.bin"), checkpoint).unwrap();
            Err(WorkError::Interrupted)
        };
        run_task(&bench.plan, 0, &mut work).unwrap_err()
    };
    for length in 1..9 {
        assert_eq!(interrupt(&[0; 9][..length]).exit_status(), AGAIN, "each attempt got further");
    }
    assert_eq!(status(&bench.plan, &BTreeMap::new())[0].reason, "interrupted");
    let mut stuck = |_: &Task, _: &Path| Err(WorkError::Interrupted);
    let ends: Vec<u8> = (0..4).map(|_| run_task(&bench.plan, 0, &mut stuck).unwrap_err().exit_status()).collect();
    assert_eq!(ends, [AGAIN, AGAIN, AGAIN, FAILED]);
    assert!(status(&bench.plan, &BTreeMap::new())[0].reason.contains("3 attempts ended"));
    // Whoever runs it once more begins anew.
    let mut work = |task: &Task, folder: &Path| {
        assert!(!folder.join("checkpoint.bin").exists());
        Ok(write_row(task, folder))
    };
    assert_eq!(run_task(&bench.plan, 0, &mut work).unwrap(), Ended::Made);
}

#[test]
fn holes_are_named_and_refused_or_recorded() {
    let bench = Bench::new(3);
    bench.run(0).unwrap();
    let mut poison = |_: &Task, _: &Path| Err(WorkError::Failed("it always fails".into()));
    assert_eq!(run_task(&bench.plan, 1, &mut poison).unwrap_err().exit_status(), FAILED);
    let refused = merge(&bench.plan, &BTreeMap::new(), false).unwrap_err().to_string();
    for part in ["task 1 (replay 1): it always fails", "task 2 (replay 2): it has no result", "2 of 3 tasks", "--allow-holes"] {
        assert!(refused.contains(part), "{refused}");
    }
    let merged = merge(&bench.plan, &BTreeMap::new(), true).unwrap();
    assert_eq!((merged.done, merged.holes.len()), (1, 2));
    let text = std::fs::read_to_string(bench.file("plan/merge.json")).unwrap();
    assert!(text.contains("it always fails") && merged.table.contains("| recording | default | 1 |"));
    (1..3).for_each(|task| assert_eq!(bench.run(task).unwrap(), Ended::Made));
    let merged = merge(&bench.plan, &BTreeMap::new(), false).unwrap();
    assert_eq!(Some(merged.digest), digest(&bench.plan));
    let table = to_table(&status(&bench.plan, &BTreeMap::new()));
    assert!(table.contains("3 done, 0 waiting, 0 running, 0 failed"), "{table}");
}

#[test]
fn a_job_of_kubernetes_has_one_index_a_task() {
    #[derive(serde::Deserialize)]
    #[serde(rename_all = "camelCase")]
    struct Job {
        kind: String,
        spec: Spec,
    }
    #[derive(serde::Deserialize)]
    #[serde(rename_all = "camelCase")]
    struct Spec {
        completion_mode: String,
        completions: usize,
        pod_failure_policy: Policy,
    }
    #[derive(serde::Deserialize)]
    struct Policy {
        rules: Vec<Rule>,
    }
    #[derive(serde::Deserialize)]
    #[serde(rename_all = "camelCase")]
    struct Rule {
        action: String,
        on_exit_codes: Option<Codes>,
    }
    #[derive(serde::Deserialize)]
    struct Codes {
        values: Vec<u8>,
    }
    let job: Job = serde_saphyr::from_str(&kubernetes::to_yaml(&Bench::new(3).plan)).unwrap();
    assert_eq!((job.kind.as_str(), job.spec.completion_mode.as_str(), job.spec.completions), ("Job", "Indexed", 3));
    let action = |code: u8| {
        let of_code = |rule: &&Rule| rule.on_exit_codes.as_ref().is_some_and(|codes| codes.values == [code]);
        job.spec.pod_failure_policy.rules.iter().find(of_code).map(|rule| rule.action.as_str())
    };
    assert_eq!((action(NEVER_AGAIN), action(AGAIN)), (Some("FailIndex"), Some("Ignore")));
}
