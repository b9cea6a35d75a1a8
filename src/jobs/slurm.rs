//! A plan as job arrays of Slurm: the script, its submission, and the states that Slurm reports.
//!
//! The script forwards Slurm's early signal and requeues its own task after status 75 or a signal. Whether a task is worth another attempt is
//! decided by the task itself, so a poisonous one ends. States are those of `squeue` and `sacct`, all of them; a state that is not known
//! counts as an end, so that nothing waits for it.

use std::collections::BTreeMap;
use std::fmt::{Display, Formatter};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use serde::{Deserialize, Serialize};

use super::input::create_folder;
use super::{AGAIN, JobError, Plan};
use crate::files::{write_atomically, write_durably};

/// Folder of the script, the logs and the records of submissions, in a plan.
const SLURM: &str = "slurm";
const SCRIPT: &str = "tasks.sh";
/// Tasks of one array; Slurm's default `MaxArraySize` is 1001.
const ARRAY: usize = 1000;
/// Early signal: a minute for the checkpoint.
const SIGNAL: &str = "--signal=B:USR1@60";

/// A submitted array: `slurm/<job>.json`.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
struct Submission {
    job: u64,
    /// Number of the task with index 0.
    first: usize,
}

/// State that Slurm reports for a task.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SlurmState {
    /// In capitals, as Slurm writes it: `TIMEOUT`.
    name: String,
    /// Slurm's reason, where there is one.
    reason: String,
}

/// Arrays and merge that were submitted.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Submitted {
    /// Jobs of the arrays.
    pub arrays: Vec<u64>,
    /// Job of the merge.
    pub merge: u64,
}

/// Submits the given tasks and the merge that follows them. `options` go to each `sbatch`, behind those that the plan needs.
///
/// # Errors
/// If a file cannot be written, or `sbatch` is missing or refuses; arrays submitted before that stay.
pub fn submit(plan: &Plan, tasks: &[usize], program: &Path, options: &[String]) -> Result<Submitted, JobError> {
    let folder = plan.folder().join(SLURM);
    create_folder(&folder)?;
    let script = folder.join(SCRIPT);
    write_atomically(&script, text_of_script(plan, program).as_bytes())?;
    let log = |name: &str| format!("--output={}", folder.join(name).display());
    let mut arrays = Vec::new();
    for block in tasks.chunk_by(|a, b| a / ARRAY == b / ARRAY) {
        let first = block[0] / ARRAY * ARRAY;
        let mut sbatch = sbatch(options, "keysplat");
        sbatch.args(["--requeue", "--open-mode=append", &log("task-%A_%a.log")]);
        sbatch.args([SIGNAL, &format!("--array={}", ranges(block, first))]).args(options);
        let job = submitted(sbatch.arg(&script).arg(first.to_string()))?;
        let text = serde_json::to_string(&Submission { job, first }).expect("numbers");
        write_durably(&folder.join(format!("{job}.json")), text.as_bytes())?;
        arrays.push(job);
    }
    let after = arrays.iter().map(u64::to_string).collect::<Vec<_>>().join(":");
    let mut sbatch = sbatch(options, "keysplat-merge");
    sbatch.arg(log("merge-%j.log")).args(options);
    if !arrays.is_empty() {
        sbatch.arg(format!("--dependency=afterany:{after}"));
    }
    let merge = submitted(sbatch.arg(format!("--wrap={} jobs merge {}", quoted(program), quoted(plan.folder()))))?;
    Ok(Submitted { arrays, merge })
}

fn sbatch(options: &[String], name: &str) -> Command {
    let mut sbatch = Command::new("sbatch");
    sbatch.arg("--parsable");
    if !options.iter().any(|option| option.starts_with("--job-name") || option.starts_with("-J")) {
        sbatch.arg(format!("--job-name={name}"));
    }
    sbatch
}

/// The job that a `sbatch` has submitted.
fn submitted(sbatch: &mut Command) -> Result<u64, JobError> {
    let error = |reason: String| JobError::Engine { command: "sbatch".into(), reason };
    let output = sbatch.stdin(Stdio::null()).output().map_err(|e| error(format!("{e}; is Slurm installed here?")))?;
    let said = String::from_utf8_lossy(&output.stdout);
    // `job` or `job;cluster`.
    let job = said.trim().split(';').next().and_then(|job| job.parse().ok()).filter(|_| output.status.success());
    job.ok_or_else(|| error(String::from_utf8_lossy(&output.stderr).trim().to_owned()))
}

/// The script of a task. The shell stays, because Slurm sends the early signal to it alone, and a process cannot requeue itself after its end.
fn text_of_script(plan: &Plan, program: &Path) -> String {
    let (program, folder) = (quoted(program), quoted(plan.folder()));
    format!(
        r#"#!/bin/bash
# One task of a keysplat plan; $1 is the number of the array's first task.
task=$(($1 + SLURM_ARRAY_TASK_ID))
leave() {{ leaving=1; [ -z "$child" ] || kill -USR1 "$child" 2>/dev/null; }}
trap leave USR1 TERM
{program} --quiet jobs run {folder} --task "$task" &
child=$!
[ -z "$leaving" ] || leave
wait "$child"
status=$?
# A trapped signal ends `wait`, not the task.
while kill -0 "$child" 2>/dev/null; do
    wait "$child"
    status=$?
done
if [ "$status" -eq {AGAIN} ] || [ "$status" -gt 128 ]; then
    echo "task $task ended with status $status and is requeued" >&2
    scontrol requeue "${{SLURM_ARRAY_JOB_ID}}_$SLURM_ARRAY_TASK_ID"
fi
exit "$status"
"#
    )
}

/// In single quotes, for a shell.
fn quoted(path: &Path) -> String {
    format!("'{}'", path.to_string_lossy().replace('\'', r"'\''"))
}

/// `0-3,5` for ascending numbers, counted from `first`.
fn ranges(numbers: &[usize], first: usize) -> String {
    let runs = numbers.chunk_by(|a, b| a + 1 == *b).map(|run| match run {
        [one] => (one - first).to_string(),
        run => format!("{}-{}", run[0] - first, run[run.len() - 1] - first),
    });
    runs.collect::<Vec<_>>().join(",")
}

/// The states of tasks in the plan's submissions, newest last; without Slurm none.
pub fn states(plan: &Plan) -> BTreeMap<usize, SlurmState> {
    let mut states: BTreeMap<usize, SlurmState> = BTreeMap::new();
    for Submission { job, first } in submissions(&plan.folder().join(SLURM)) {
        let job = job.to_string();
        let squeue = ["--noheader", "--array", "--states=all", "--format=%i|%T|%r", "--jobs", &job];
        let sacct = ["--noheader", "--parsable2", "--allocations", "--format=JobID,State,Reason", "--jobs", &job];
        // Slurm's controller forgets what has ended; its accounting, where there is one, does not.
        let text = output("squeue", &squeue).filter(|text| !text.is_empty()).or_else(|| output("sacct", &sacct));
        for (index, state) in text.unwrap_or_default().lines().filter_map(parse) {
            let known = states.entry(first + index).or_insert_with(|| state.clone());
            // What an earlier submission still has to do counts more than the end of a later one.
            if state.is_open() || !known.is_open() {
                *known = state;
            }
        }
    }
    states
}

fn submissions(folder: &Path) -> Vec<Submission> {
    let entries = std::fs::read_dir(folder).into_iter().flatten().filter_map(Result::ok);
    let paths = entries.map(|entry| entry.path()).filter(|path: &PathBuf| path.extension().is_some_and(|e| e == "json"));
    let mut all: Vec<Submission> = paths.filter_map(|path| serde_json::from_slice(&std::fs::read(path).ok()?).ok()).collect();
    all.sort_by_key(|submission| submission.job);
    all
}

/// Standard output of a command that succeeds.
fn output(command: &str, arguments: &[&str]) -> Option<String> {
    let output = Command::new(command).args(arguments).stdin(Stdio::null()).output().ok()?;
    output.status.success().then(|| String::from_utf8_lossy(&output.stdout).into_owned())
}

/// Index and state of a line `job_index|state|reason`.
fn parse(line: &str) -> Option<(usize, SlurmState)> {
    let mut fields = line.trim().split('|');
    let index = fields.next()?.split_once('_')?.1.parse().ok()?;
    // `CANCELLED by 1000`
    let name = fields.next()?.split_whitespace().next()?.trim_end_matches('+').to_owned();
    let reason = fields.next().filter(|reason| !["None", ""].contains(reason)).unwrap_or_default().to_owned();
    Some((index, SlurmState { name, reason }))
}

impl SlurmState {
    /// Whether Slurm will start the task.
    pub fn is_waiting(&self) -> bool {
        ["PENDING", "CONFIGURING", "REQUEUED", "REQUEUE_FED", "REQUEUE_HOLD", "SPECIAL_EXIT", "RESV_DEL_HOLD", "POWER_UP_NODE"]
            .contains(&self.name.as_str())
    }

    /// Whether Slurm has started the task and not seen its end.
    pub fn is_running(&self) -> bool {
        ["RUNNING", "COMPLETING", "SUSPENDED", "STOPPED", "SIGNALING", "STAGE_OUT", "RESIZING", "EXPEDITING", "UPDATE_DB"]
            .contains(&self.name.as_str())
    }

    fn is_open(&self) -> bool {
        self.is_waiting() || self.is_running()
    }
}

impl Display for SlurmState {
    fn fmt(&self, f: &mut Formatter<'_>) -> std::fmt::Result {
        let advice = match self.name.as_str() {
            "TIMEOUT" | "DEADLINE" => "give it more time",
            "OUT_OF_MEMORY" => "give it more memory",
            "NODE_FAIL" | "BOOT_FAIL" | "LAUNCH_FAILED" | "RECONFIG_FAIL" => "its node failed; submit again",
            "PREEMPTED" | "REVOKED" | "CANCELLED" => "submit again",
            "COMPLETED" => "it ended well without a result; see its log",
            "FAILED" => "see its log",
            _ => "",
        };
        let rest: Vec<&str> = [self.reason.as_str(), advice].into_iter().filter(|part| !part.is_empty()).collect();
        write!(f, "{}", self.name)?;
        if rest.is_empty() { Ok(()) } else { write!(f, " ({})", rest.join("; ")) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tasks_become_ranges() {
        assert_eq!(ranges(&[0, 1, 2, 3, 5, 8, 9], 0), "0-3,5,8-9");
        assert_eq!(ranges(&[1000, 1001, 1999], 1000), "0-1,999");
    }

    #[test]
    fn every_state_of_slurm_waits_runs_or_ends() {
        let state = |line: &str| parse(line).unwrap().1;
        let waits = ["PENDING", "CONFIGURING", "REQUEUED", "SPECIAL_EXIT"];
        let runs = ["RUNNING", "COMPLETING", "SUSPENDED"];
        let ends =
            ["BOOT_FAIL", "CANCELLED", "COMPLETED", "DEADLINE", "FAILED", "NODE_FAIL", "OUT_OF_MEMORY", "PREEMPTED", "TIMEOUT"];
        for (names, expected) in
            [(&waits[..], (true, false)), (&runs, (false, true)), (&ends, (false, false)), (&["NEW"], (false, false))]
        {
            for name in names {
                let state = state(&format!("17_3|{name}|None"));
                assert_eq!((state.is_waiting(), state.is_running()), expected, "{name}");
            }
        }
        assert_eq!(parse("17_3|TIMEOUT|TimeLimit").unwrap().0, 3);
        assert_eq!(state("17_3|TIMEOUT|TimeLimit").to_string(), "TIMEOUT (TimeLimit; give it more time)");
        assert_eq!(state("17_3|CANCELLED by 1000|None").to_string(), "CANCELLED (submit again)");
        assert_eq!(parse("17|RUNNING|None"), None, "the array as a whole");
    }

    #[test]
    fn quotes_in_paths_stay_in_them() {
        assert_eq!(quoted(Path::new("/a b/it's")), r"'/a b/it'\''s'");
    }
}
