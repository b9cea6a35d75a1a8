//! Tasks on this machine: one process each, so many at a time.

use std::collections::VecDeque;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use super::{AGAIN, JobError, Plan};

/// Pause before a task that another process has is tried again.
const BUSY_WAIT: Duration = Duration::from_secs(1);

/// How often a process is looked at.
const LOOK_EVERY: Duration = Duration::from_millis(50);

/// Runs the given tasks, at most `processes` at the same time, each by `program jobs run`. A task that ends with status 75 or by a signal goes
/// on; no failure ends another task. `is_stopped` makes processes leave with a checkpoint, and keeps others from starting. `on_end` receives the number of each task that is over.
///
/// # Errors
/// If a process cannot be started.
pub fn run_all(
    plan: &Plan,
    tasks: &[usize],
    processes: usize,
    program: &Path,
    is_stopped: &(dyn Fn() -> bool + Sync),
    on_end: &(dyn Fn(usize) + Sync),
) -> Result<(), JobError> {
    let queue: Mutex<VecDeque<usize>> = Mutex::new(tasks.iter().copied().collect());
    let next = || queue.lock().unwrap_or_else(PoisonError::into_inner).pop_front();
    let failed = |error: std::io::Error| JobError::Engine { command: "keysplat jobs run".into(), reason: error.to_string() };
    let worker = || -> Result<(), JobError> {
        while let Some(number) = next().filter(|_| !is_stopped()) {
            let mut command = Command::new(program);
            command.arg("--quiet").args(["jobs", "run"]).arg(plan.folder()).args(["--task", &number.to_string()]);
            let mut child = command.stdin(Stdio::null()).stdout(Stdio::null()).spawn().map_err(failed)?;
            let code = wait(&mut child, is_stopped).map_err(failed)?;
            let again = code == Some(i32::from(AGAIN));
            if (again || code.is_none()) && !is_stopped() {
                if again {
                    std::thread::sleep(BUSY_WAIT);
                }
                queue.lock().unwrap_or_else(PoisonError::into_inner).push_back(number);
            } else {
                on_end(number);
            }
        }
        Ok(())
    };
    std::thread::scope(|scope| {
        let workers: Vec<_> = (0..processes.max(1)).map(|_| scope.spawn(worker)).collect();
        workers.into_iter().try_for_each(|worker| worker.join().unwrap_or(Ok(())))
    })
}

/// Exit status of a process; `None` if a signal ended it. Once this is stopped, the process receives SIGTERM.
fn wait(child: &mut Child, is_stopped: &dyn Fn() -> bool) -> std::io::Result<Option<i32>> {
    let mut is_leaving = false;
    loop {
        if let Some(status) = child.try_wait()? {
            return Ok(status.code());
        }
        if !is_leaving && is_stopped() {
            is_leaving = true;
            leave(child)?;
        }
        std::thread::sleep(LOOK_EVERY);
    }
}

#[cfg(unix)]
fn leave(child: &mut Child) -> std::io::Result<()> {
    let id = i32::try_from(child.id()).ok().and_then(rustix::process::Pid::from_raw);
    let sent = id.map(|id| rustix::process::kill_process(id, rustix::process::Signal::TERM));
    Ok(sent.unwrap_or(Ok(()))?)
}

#[cfg(not(unix))]
fn leave(child: &mut Child) -> std::io::Result<()> {
    child.kill()
}
