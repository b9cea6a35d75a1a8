//! The command line: one file per subcommand.

mod adapters;
mod bench;
mod calibrate;
mod check;
mod demo;
mod eval;
mod eval_mesh;
mod export;
mod generate;
mod jobs;
mod keys;
mod mesh;
mod progress;
mod render;
mod report;
mod resume;
mod run;
mod signals;
mod source;
mod split;
mod stress;
mod view;

use std::io::{ErrorKind, IsTerminal, Write};
use std::process::ExitCode;

use clap::{Parser, Subcommand, ValueEnum};
use miette::{IntoDiagnostic, MietteHandlerOpts};
use tracing_subscriber::EnvFilter;

/// Replays recorded image sequences into a camera trajectory and a photorealistic Gaussian map.
#[derive(Parser)]
#[command(version, max_term_width = 110)]
struct Cli {
    /// Say nothing but errors.
    #[arg(short, long, global = true)]
    quiet: bool,
    /// How to log on standard error. `RUST_LOG` chooses what.
    #[arg(long, global = true, value_enum, default_value_t = LogFormat::Text)]
    log: LogFormat,
    #[command(subcommand)]
    command: Command,
}

#[derive(Clone, Copy, PartialEq, Eq, ValueEnum)]
enum LogFormat {
    /// Lines for people, and a progress bar.
    Text,
    /// One JSON object a line, and no progress bar.
    Json,
}

#[derive(Subcommand)]
enum Command {
    /// Say what a recording holds and what in it looks wrong, before a run.
    Check(check::CheckArgs),
    /// Find the camera of a recording that comes without a calibration, from its frames.
    Calibrate(calibrate::CalibrateArgs),
    /// Replay a recording into a trajectory and a map.
    Run(run::RunArgs),
    /// Go on with a run that was interrupted and kept checkpoints.
    Resume(resume::ResumeArgs),
    /// Render the demo's synthetic room and map it.
    Demo(demo::DemoArgs),
    /// Render a synthetic scene as a recording.
    Generate(generate::GenerateArgs),
    /// Measure a finished run, of ours or anybody's.
    Eval(eval::EvalArgs),
    /// Measure a mesh against a true surface.
    EvalMesh(eval_mesh::EvalMeshArgs),
    /// Write a map in another file format, whole or in part.
    Export(export::ExportArgs),
    /// Write the surface of a finished run as a triangle mesh.
    Mesh(mesh::MeshArgs),
    /// Draw a finished run as one HTML file that needs nothing else.
    Report(report::ReportArgs),
    /// Render a moving picture of a finished run's map.
    Render(render::RenderArgs),
    /// Show a finished run, or a map, in a browser.
    View(view::ViewArgs),
    /// Measure speed.
    Bench(bench::BenchArgs),
    /// Plan the refinement of a finished run's map in parts, one task each, for `keysplat jobs`.
    Split(split::SplitArgs),
    /// Run the tasks of a plan, on this machine or on a cluster, and merge their results.
    Jobs(jobs::JobsArgs),
    /// Try thousands of nasty cases against what is known of them.
    Stress(stress::StressArgs),
    /// List the adapters that the mapper could use.
    Adapters,
}

/// How much to say, and how.
#[derive(Clone, Copy)]
struct Verbosity {
    quiet: bool,
    json: bool,
}

impl Verbosity {
    fn shows_progress(self) -> bool {
        !self.quiet && !self.json
    }
}

pub fn main() -> ExitCode {
    let cli = Cli::parse();
    let verbosity = Verbosity { quiet: cli.quiet, json: cli.log == LogFormat::Json };
    match start_log(verbosity).and_then(|()| execute(cli.command, verbosity)) {
        Ok(status) => status,
        Err(report) => {
            print_error(&report, verbosity);
            ExitCode::FAILURE
        }
    }
}

/// Prints an error on standard error, in the requested form.
fn print_error(report: &miette::Report, verbosity: Verbosity) {
    if verbosity.json {
        tracing::error!("{report}");
    } else {
        eprintln!("Error: {report:?}");
    }
}

fn execute(command: Command, verbosity: Verbosity) -> miette::Result<ExitCode> {
    match command {
        Command::Jobs(args) => return jobs::jobs(&args, verbosity),
        Command::Check(args) => check::check(&args, verbosity),
        Command::Calibrate(args) => calibrate::calibrate(&args, verbosity),
        Command::Run(args) => run::run(&args, verbosity),
        Command::Resume(args) => resume::resume(&args, verbosity),
        Command::Demo(args) => demo::demo(&args, verbosity),
        Command::Generate(args) => generate::generate(&args, verbosity),
        Command::Eval(args) => eval::eval(&args, verbosity),
        Command::EvalMesh(args) => eval_mesh::eval_mesh(&args, verbosity),
        Command::Export(args) => export::export(&args, verbosity),
        Command::Mesh(args) => mesh::mesh(&args, verbosity),
        Command::Report(args) => report::report(&args, verbosity),
        Command::Render(args) => render::render(&args, verbosity),
        Command::View(args) => view::view(&args, verbosity),
        Command::Bench(args) => bench::bench(&args, verbosity),
        Command::Split(args) => split::split(&args),
        Command::Stress(args) => stress::stress(&args),
        Command::Adapters => adapters::adapters(),
    }?;
    Ok(ExitCode::SUCCESS)
}

fn start_log(verbosity: Verbosity) -> miette::Result<()> {
    // Our messages name their causes themselves; wrapped lines would tear paths and file:line apart.
    let report = |_: &_| Box::new(MietteHandlerOpts::new().wrap_lines(false).without_cause_chain().build()) as Box<_>;
    miette::set_hook(Box::new(report)).into_diagnostic()?;
    let level = if verbosity.quiet { "error" } else { "keysplat=info,warn" };
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new(level));
    let log = tracing_subscriber::fmt().with_env_filter(filter).with_writer(std::io::stderr).with_target(false);
    let log = log.with_ansi(std::io::stderr().is_terminal());
    if verbosity.json { log.json().try_init() } else { log.without_time().try_init() }.map_err(|e| miette::miette!("{e}"))?;
    // A panic of a worker thread is reported once, where it is joined.
    let default_hook = std::panic::take_hook();
    std::panic::set_hook(Box::new(move |info| {
        if std::thread::current().name() == Some("main") {
            default_hook(info);
        } else {
            tracing::error!("{info}");
        }
    }));
    Ok(())
}

/// Prints figures on standard output, in the requested form.
fn print_metrics(metrics: &keysplat::evaluation::Metrics, verbosity: Verbosity) -> miette::Result<()> {
    if verbosity.json {
        print(&format!("{}\n", serde_json::to_string(metrics).into_diagnostic()?))
    } else if !verbosity.quiet {
        print(&metrics.to_string())
    } else {
        Ok(())
    }
}

/// Prints on standard output. A reader that has gone, as `head` does, has read enough.
fn print(text: &str) -> miette::Result<()> {
    let mut out = std::io::stdout().lock();
    match out.write_all(text.as_bytes()).and_then(|()| out.flush()) {
        Err(error) if error.kind() != ErrorKind::BrokenPipe => miette::bail!("cannot write to standard output: {error}"),
        _ => Ok(()),
    }
}
