//! `keysplat jobs`

mod work;

use std::path::PathBuf;
use std::process::ExitCode;

use clap::{Args, Subcommand};
use keysplat::jobs::{self, AGAIN, Ended, JobError, Plan, WITH_HOLES, kubernetes, local, slurm};
use miette::{IntoDiagnostic, Report};

pub use work::{inputs_of_run, refining};

use super::{Verbosity, print, print_error, progress};

#[derive(Args)]
pub struct JobsArgs {
    #[command(subcommand)]
    what: What,
}

#[derive(Subcommand)]
enum What {
    /// Run one task. Ends with 0 if its result is there, 75 if it is to be run again, 65 if it never will succeed.
    Run(RunTaskArgs),
    /// List all tasks with their states.
    Status(StatusArgs),
    /// Write the table of all results into the plan's folder. Ends with 3 if holes were allowed and there are some.
    Merge(MergeArgs),
    /// Run all tasks that are not done, then merge.
    Submit(SubmitArgs),
}

#[derive(Args)]
struct RunTaskArgs {
    /// Folder of the plan.
    plan: PathBuf,
    /// Number of the task.
    #[arg(long, value_name = "N")]
    task: usize,
}

#[derive(Args)]
struct StatusArgs {
    /// Folder of the plan.
    plan: PathBuf,
    /// Print JSON instead of a table.
    #[arg(long)]
    json: bool,
}

#[derive(Args)]
struct MergeArgs {
    /// Folder of the plan.
    plan: PathBuf,
    /// Merge what is done, and record the tasks without a result.
    #[arg(long)]
    allow_holes: bool,
}

#[derive(Args)]
struct SubmitArgs {
    /// Folder of the plan.
    plan: PathBuf,
    #[command(flatten)]
    engine: Engine,
    /// Options of `sbatch`, e.g. -- --time=60 --gres=gpu:1
    #[arg(last = true)]
    options: Vec<String>,
}

#[derive(Args)]
#[group(required = true, multiple = false)]
struct Engine {
    /// On this machine: so many processes at the same time.
    #[arg(long, value_name = "N")]
    local: Option<usize>,
    /// On Slurm: a job array, and a job that merges.
    #[arg(long)]
    slurm: bool,
    /// Print an Indexed Job of Kubernetes.
    #[arg(long)]
    print_k8s: bool,
}

pub fn jobs(args: &JobsArgs, verbosity: Verbosity) -> miette::Result<ExitCode> {
    let ended = match &args.what {
        What::Run(args) => run(args, verbosity),
        What::Status(args) => return status(args).map(|()| ExitCode::SUCCESS),
        What::Merge(args) => Plan::read(&args.plan).and_then(|plan| merge(&plan, args.allow_holes)),
        What::Submit(args) => submit(args, verbosity),
    };
    ended.map_or_else(
        |error| {
            let status = error.exit_status();
            print_error(&Report::from_err(error), verbosity);
            Ok(ExitCode::from(status))
        },
        |ended| {
            print(&ended.text)?;
            Ok(ExitCode::from(ended.status))
        },
    )
}

/// What a command prints at its end, and its exit status.
struct End {
    text: String,
    status: u8,
}

impl End {
    fn well(text: String) -> Self {
        Self { text, status: 0 }
    }
}

fn run(args: &RunTaskArgs, verbosity: Verbosity) -> Result<End, JobError> {
    let plan = Plan::read(&args.plan)?;
    let signals = work::Signals::listen()?;
    let ended = jobs::run_task(&plan, args.task, &mut |task, folder| work::work(&plan, task, folder, &signals, verbosity))?;
    let how = if ended == Ended::Made { "done" } else { "done already" };
    let text = format!("Task {} ({}) is {how}.\n", args.task, plan.task(args.task)?.name);
    Ok(End::well(if verbosity.quiet { String::new() } else { text }))
}

fn status(args: &StatusArgs) -> miette::Result<()> {
    let plan = Plan::read(&args.plan).into_diagnostic()?;
    let all = jobs::status(&plan, &slurm::states(&plan));
    let digest = jobs::digest(&plan);
    if args.json {
        let value = serde_json::json!({ "tasks": all, "digest": digest });
        return print(&format!("{}\n", serde_json::to_string_pretty(&value).into_diagnostic()?));
    }
    let digest = digest.map_or_else(String::new, |digest| format!("digest of the results without times: {digest}\n"));
    print(&(jobs::to_table(&all) + &digest))
}

fn merge(plan: &Plan, allow_holes: bool) -> Result<End, JobError> {
    let merged = jobs::merge(plan, &slurm::states(plan), allow_holes)?;
    merged.holes.iter().for_each(|hole| tracing::warn!("{hole}"));
    Ok(End { text: merged.table, status: if merged.holes.is_empty() { 0 } else { WITH_HOLES } })
}

fn submit(args: &SubmitArgs, verbosity: Verbosity) -> Result<End, JobError> {
    let plan = Plan::read(&args.plan)?;
    if args.engine.print_k8s {
        return Ok(End::well(kubernetes::to_yaml(&plan)));
    }
    let open = jobs::open_tasks(&plan);
    let program = std::env::current_exe()
        .map_err(|error| JobError::Engine { command: "keysplat jobs run".into(), reason: error.to_string() })?;
    let Some(processes) = args.engine.local else {
        let slurm::Submitted { arrays, merge } = slurm::submit(&plan, &open, &program, &args.options)?;
        let arrays: Vec<String> = arrays.iter().map(u64::to_string).collect();
        let text = format!("{} tasks in the arrays [{}]; job {merge} merges.\n", open.len(), arrays.join(", "));
        return Ok(End::well(text + &format!("keysplat jobs status {}\n", plan.folder().display())));
    };
    let signals = work::Signals::listen()?;
    let bar = progress::bar(verbosity, open.len() as u64, "{wide_bar} {pos}/{len} tasks");
    local::run_all(&plan, &open, processes, &program, &|| signals.is_leaving(), &|_task| bar.inc(1))?;
    bar.finish_and_clear();
    if signals.is_leaving() {
        return Ok(End { text: String::new(), status: AGAIN });
    }
    merge(&plan, false)
}

/// Prints what was planned, and what comes next.
pub fn print_plan(plan: &Plan) -> miette::Result<()> {
    let folder = plan.folder().display();
    print(&format!("{} tasks planned in {folder}\nkeysplat jobs submit {folder} --local 1\n", plan.tasks.len()))
}
