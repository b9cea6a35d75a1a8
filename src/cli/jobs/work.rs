//! The work of each kind of task, and the signals that end it early.

use std::path::{Path, PathBuf};
use std::time::Duration;

use clap::Parser;
use keysplat::jobs::{CellRow, CellTask, JobError, Made, Plan, ReplayTask, RunTask, Task, Work, WorkError};
use keysplat::pipeline::{PipelineError, Replay};
use keysplat::report::replays::ReplayRow;
use keysplat::report::sweep::SweepRow;
use keysplat::run_folder::{CheckpointError, OutputError, outputs};
use keysplat::{Progress, Session, SessionError};
use miette::IntoDiagnostic;

use crate::cli::Verbosity;
use crate::cli::bench::track;
use crate::cli::run::RunArgs;

/// Keyframes, or rounds of a refinement, between two checkpoints.
const CHECKPOINT_EVERY: usize = 10;
/// Time for the next checkpoint after a signal; Slurm's leaves a minute.
const LEAVE_WITHIN: Duration = Duration::from_secs(40);

/// Options of a run, as a command of their own.
#[derive(Parser)]
#[command(no_binary_name = true)]
struct Options {
    #[command(flatten)]
    run: RunArgs,
}

/// The progress of a task, which SIGUSR1, SIGTERM and Ctrl-C end at its next checkpoint.
pub struct Signals(Progress);

impl Signals {
    /// Listens from now on.
    ///
    /// # Errors
    /// If the system refuses.
    pub fn listen() -> Result<Self, JobError> {
        let progress = Progress::default();
        listen(progress.clone()).map_err(|reason| JobError::Engine { command: "listening to signals".into(), reason })?;
        Ok(Self(progress))
    }

    /// Whether there was a signal.
    pub fn is_leaving(&self) -> bool {
        self.0.control().is_leaving()
    }
}

#[cfg(unix)]
fn listen(progress: Progress) -> Result<(), String> {
    use signal_hook::consts::{SIGINT, SIGTERM, SIGUSR1};
    let mut signals = signal_hook::iterator::Signals::new([SIGUSR1, SIGTERM, SIGINT]).map_err(|error| error.to_string())?;
    let leave = move || {
        // A scheduler may send one signal twice, by way of its shell.
        if signals.forever().next().is_some() {
            leave(&progress);
        }
    };
    std::thread::Builder::new().name("signals".into()).spawn(leave).map(drop).map_err(|error| error.to_string())
}

#[cfg(not(unix))]
fn listen(progress: Progress) -> Result<(), String> {
    ctrlc::set_handler(move || leave(&progress)).map_err(|error| error.to_string())
}

fn leave(progress: &Progress) {
    tracing::warn!("leaving with a checkpoint");
    progress.control().leave();
    std::thread::sleep(LEAVE_WITHIN);
    progress.control().stop();
}

fn parse(recording: &Path, out: &Path, options: &[String]) -> miette::Result<RunArgs> {
    let arguments = [recording.as_os_str(), "--out".as_ref(), out.as_os_str()];
    let arguments = arguments.into_iter().chain(options.iter().map(AsRef::as_ref));
    Ok(Options::try_parse_from(arguments).into_diagnostic()?.run)
}

/// Files that a run with these options reads.
pub fn inputs_of_run(recording: &Path, options: &[String]) -> miette::Result<Vec<PathBuf>> {
    parse(recording, Path::new("out"), options)?.inputs()
}

/// Does the work of a task in a folder.
pub fn work(plan: &Plan, task: &Task, folder: &Path, signals: &Signals, verbosity: Verbosity) -> Result<Made, WorkError> {
    if let Err(error) = std::env::set_current_dir(&plan.working_folder) {
        tracing::warn!("relative paths in options begin at {}: {error}", plan.working_folder.display());
    }
    match &task.work {
        Work::Run(run) => {
            let recording = plan.folder().join(&run.recording);
            let replayed = Replayed { recording: &recording, options: run.options.clone(), folder, signals, verbosity };
            replayed.make(&|session, replay| session.finish(replay, &|_views| ()).map(drop))?;
            measured(run, task.seed, folder)
        }
        Work::Cell(cell) => {
            let recording = plan.folder().join(&cell.recording);
            let options = options_of_cell(plan, cell).map_err(failed)?;
            let replayed = Replayed { recording: &recording, options, folder, signals, verbosity };
            replayed.make(&|session, replay| write_cell(session, replay, folder))?;
            refined(folder)
        }
        Work::Replay(replay) => {
            let recording = plan.folder().join(&replay.recording);
            write_replay(&ReplayTask { recording, ..replay.clone() }, folder, signals)
        }
    }
}

fn failed(error: impl ToString) -> WorkError {
    WorkError::Failed(error.to_string())
}

fn bad_input(error: impl ToString) -> WorkError {
    WorkError::BadInput(error.to_string())
}

fn write_replay(task: &ReplayTask, folder: &Path, signals: &Signals) -> Result<Made, WorkError> {
    let row = track::replay(task, &|| signals.is_leaving()).map_err(bad_input)?.ok_or(WorkError::Interrupted)?;
    let text = serde_json::to_string(&row).map_err(failed)?;
    keysplat::files::write_durably(&folder.join(ReplayRow::FILE), text.as_bytes()).map_err(failed)?;
    let figures = serde_json::to_value(ReplayRow { ms_per_frame: 0.0, final_ms: 0.0, ..row }).map_err(failed)?;
    Ok(Made { figures, files: Vec::new(), timed_files: vec![ReplayRow::FILE.into()] })
}

/// A whole run in a task's folder.
struct Replayed<'a> {
    recording: &'a Path,
    options: Vec<String>,
    folder: &'a Path,
    signals: &'a Signals,
    verbosity: Verbosity,
}

/// Writes the results of a replay that reached its end.
type Finish<'a> = &'a dyn Fn(&Session, Replay) -> Result<(), SessionError>;

impl Replayed<'_> {
    /// Runs to the end, from a checkpoint if there is one.
    fn make(&self, finish: Finish<'_>) -> Result<(), WorkError> {
        let resumed = match self.resume(finish) {
            // Of another adapter, for example: a result is that of one adapter.
            Err(error) if is_of_no_use(&error) => {
                tracing::warn!("{error}; the task begins anew");
                None
            }
            resumed => resumed.map_err(of_session)?,
        };
        let done = match resumed {
            Some(done) => done,
            None => self.finish(self.begin()?, finish).map_err(of_session)?,
        };
        if done { Ok(()) } else { Err(WorkError::Interrupted) }
    }

    /// Goes on from a checkpoint, if there is one; whether the run reached its end.
    fn resume(&self, finish: Finish<'_>) -> Result<Option<bool>, SessionError> {
        if !self.folder.join(outputs::CHECKPOINT).exists() {
            return Ok(None);
        }
        match Session::resume(self.folder, Some(self.recording)).and_then(|session| self.finish(session, finish)) {
            // It stopped before it reached its checkpoint, which stays.
            Err(_) if self.signals.is_leaving() => Ok(Some(false)),
            ended => ended.map(Some),
        }
    }

    fn begin(&self) -> Result<Session, WorkError> {
        let mut args = parse(self.recording, self.folder, &self.options).map_err(bad_input)?;
        args = args.calibrated(self.verbosity).map_err(bad_input)?;
        args.keep_checkpoints(CHECKPOINT_EVERY).map_err(bad_input)?;
        let (recording, gpu) = args.open().map_err(failed)?;
        Session::with_device(recording, gpu, self.folder).map_err(of_session)
    }

    /// Runs to the end; `false` if a signal ended the run early.
    fn finish(&self, mut session: Session, finish: Finish<'_>) -> Result<bool, SessionError> {
        let Signals(progress) = self.signals;
        let replay = session.run(progress)?;
        if replay.stopped {
            return Ok(false);
        }
        finish(&session, replay)?;
        Ok(true)
    }
}

/// Whether nothing can ever be resumed from the checkpoint. It stays where something else failed.
fn is_of_no_use(error: &SessionError) -> bool {
    let of_no_use = |error: &CheckpointError| matches!(error, CheckpointError::Damaged { .. } | CheckpointError::Differs { .. });
    let error = match error {
        SessionError::Checkpoint(error) => return of_no_use(error),
        SessionError::Pipeline(error) => error,
        SessionError::EndedEarly { error, .. } | SessionError::EndedEarlyUnwritten { error, .. } => error.as_ref(),
        _ => return false,
    };
    match error {
        PipelineError::Checkpoint(error) => of_no_use(error),
        error => matches!(error, PipelineError::NotRepeated { .. }),
    }
}

/// The result of a run that was measured.
fn measured(run: &RunTask, seed: u64, folder: &Path) -> Result<Made, WorkError> {
    let text = std::fs::read_to_string(folder.join(outputs::METRICS)).map_err(failed)?;
    let metrics = serde_json::from_str(&text).map_err(failed)?;
    let row = SweepRow::new(&run.sequence, &run.variant, seed, &metrics);
    let figures = serde_json::to_value(SweepRow { wall_s: 0.0, peak_host_bytes: None, ..row }).map_err(failed)?;
    let files = map_name(folder).into_iter().chain([outputs::TRAJECTORY, outputs::KEYFRAMES].map(String::from)).collect();
    Ok(Made { figures, files, timed_files: vec![outputs::METRICS.into()] })
}

fn map_name(folder: &Path) -> Option<String> {
    outputs::find_map(folder).and_then(|(map, _)| Some(map.file_name()?.to_string_lossy().into_owned()))
}

/// Options of a run that refines another. The map is lossless, whatever the format of the merged one.
pub fn refining(run: &Path, options: &[String]) -> Vec<String> {
    let own = ["--refine".into(), run.to_string_lossy().into_owned(), "--format".into(), "ply".into()];
    options.iter().cloned().chain(own).collect()
}

/// The same for one cell.
fn options_of_cell(plan: &Plan, cell: &CellTask) -> Result<Vec<String>, toml::ser::Error> {
    let mut region = String::new();
    serde::Serialize::serialize(&cell.region, toml::ser::ValueSerializer::new(&mut region))?;
    let of_cell = ["--set".into(), format!("refined.region={region}")];
    Ok(refining(&plan.folder().join(&cell.run), &cell.options).into_iter().chain(of_cell).collect())
}

fn write_cell(session: &Session, replay: Replay, folder: &Path) -> Result<(), SessionError> {
    let result = session.write(replay)?;
    let row = CellRow {
        keyframes: result.keyframes.len(),
        steps: result.step_ms.len(),
        gaussians: result.cloud.len(),
        wall_s: result.wall_s,
    };
    let text = serde_json::to_string(&row).expect("a row is numbers");
    Ok(keysplat::files::write_durably(&folder.join(CellRow::FILE), text.as_bytes()).map_err(OutputError::from)?)
}

/// The result of a cell that was refined.
fn refined(folder: &Path) -> Result<Made, WorkError> {
    let text = std::fs::read_to_string(folder.join(CellRow::FILE)).map_err(failed)?;
    let row: CellRow = serde_json::from_str(&text).map_err(failed)?;
    let figures = serde_json::to_value(CellRow { wall_s: 0.0, ..row }).map_err(failed)?;
    Ok(Made { figures, files: map_name(folder).into_iter().collect(), timed_files: vec![CellRow::FILE.into()] })
}

fn of_session(error: SessionError) -> WorkError {
    match error {
        SessionError::Recording(_) | SessionError::NothingTracked { .. } => bad_input(error),
        error => failed(error),
    }
}
