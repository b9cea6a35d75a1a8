//! `keysplat stress`

use std::path::{Path, PathBuf};

use clap::Args;
use keysplat::files::write_atomically;
use keysplat::gpu::AdapterSummary;
use keysplat::verification::stress::{CaseId, FamilyReport, Machine, Part, StressConfig, StressReport};
use miette::{IntoDiagnostic, miette};
use serde::Serialize;

use super::print;

#[derive(Args)]
pub struct StressArgs {
    /// Cases of each family; those that take long get a share of it.
    #[arg(long, default_value_t = 100)]
    cases: usize,
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// One part alone.
    #[arg(long, value_enum)]
    only: Option<Part>,
    /// Steps of the long run.
    #[arg(long, default_value_t = 20_000)]
    long_steps: usize,
    /// Folder for `stress.json`, and for each family's worst case as a file for --replay.
    #[arg(short, long)]
    out: Option<PathBuf>,
    /// Run one case again, from a file that an earlier run has written.
    #[arg(long, conflicts_with_all = ["cases", "seed", "only", "out"])]
    replay: Option<PathBuf>,
    /// Print JSON instead of tables.
    #[arg(long)]
    json: bool,
    /// Part of the name of the adapter to use.
    #[arg(long)]
    adapter: Option<String>,
}

#[derive(Serialize)]
struct Output<'a> {
    adapter: Option<&'a AdapterSummary>,
    cpu: Option<String>,
    version: &'static str,
    #[serde(flatten)]
    report: &'a StressReport,
}

pub fn stress(args: &StressArgs) -> miette::Result<()> {
    let config = StressConfig { cases: args.cases.max(1), seed: args.seed, only: args.only, long_steps: args.long_steps };
    if let Some(file) = &args.replay {
        return replay(args, &config, file);
    }
    let machine = machine(args, args.only)?;
    if !args.json {
        print(&format!("{:<36}{:>10}{:>10}{:>10}{:>10}\n", "", "median", "95%", "worst", "limit"))?;
    }
    let tell = |family: &FamilyReport| {
        if !args.json {
            let _ = print(&family.to_string());
        }
    };
    let report = keysplat::verification::stress::run(machine.as_ref(), &config, tell).into_diagnostic()?;
    let adapter = machine.as_ref().map(|machine| &machine.gpu.adapter);
    let cpu = keysplat::evaluation::machine::cpu_name();
    let text = serde_json::to_string_pretty(&Output { adapter, cpu, version: env!("CARGO_PKG_VERSION"), report: &report });
    let text = text.into_diagnostic()?;
    if let Some(out) = &args.out {
        write(out, &text, &report)?;
    }
    print(&if args.json { format!("{text}\n") } else { format!("{} cases, {} failed\n", report.cases(), report.failed()) })?;
    if report.failed() == 0 { Ok(()) } else { Err(miette!("{} of {} cases failed", report.failed(), report.cases())) }
}

/// The adapter, unless only the tracker is tried.
fn machine(args: &StressArgs, only: Option<Part>) -> miette::Result<Option<Machine>> {
    let wanted = only != Some(Part::Tracker);
    wanted.then(|| Machine::open(args.adapter.as_deref())).transpose().into_diagnostic()
}

fn write(out: &Path, text: &str, report: &StressReport) -> miette::Result<()> {
    let cases = out.join("cases");
    std::fs::create_dir_all(&cases).into_diagnostic()?;
    write_atomically(&out.join("stress.json"), text.as_bytes()).into_diagnostic()?;
    for family in &report.families {
        for case in family.failures.iter().map(|failure| failure.case.clone()).chain(family.worst()) {
            let plain = |c: char| if c.is_alphanumeric() || c == '.' { c } else { '-' };
            let name: String = format!("{}-{}.json", case.family, case.index).chars().map(plain).collect();
            let text = serde_json::to_string_pretty(&case).into_diagnostic()?;
            write_atomically(&cases.join(name), text.as_bytes()).into_diagnostic()?;
        }
    }
    Ok(())
}

fn replay(args: &StressArgs, config: &StressConfig, file: &Path) -> miette::Result<()> {
    let text = std::fs::read_to_string(file).map_err(|error| miette!("cannot read {}: {error}", file.display()))?;
    let case: CaseId = serde_json::from_str(&text).map_err(|error| miette!("{} is no case: {error}", file.display()))?;
    let outcome =
        keysplat::verification::stress::replay(machine(args, Some(case.part))?.as_ref(), config, &case).into_diagnostic()?;
    let outcome = outcome.ok_or_else(|| miette!("{}: there is no family `{}`", file.display(), case.family))?;
    print(&format!("{}\n", serde_json::to_string_pretty(&outcome).into_diagnostic()?))?;
    let failures = outcome.failures();
    if failures.is_empty() { Ok(()) } else { Err(miette!("{}", failures.join("; "))) }
}
