//! `keysplat bench sweep` and `keysplat bench compare`

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use clap::{Args, ValueEnum};
use keysplat::evaluation::Metrics;
use keysplat::files::write_atomically;
use keysplat::jobs::{Draft, RunTask, Task, Work};
use keysplat::presets::Preset;
use keysplat::report::sweep::{self as report, Sweep, SweepRow, Verdict, compare as changes, with_spread};
use keysplat::run_folder::outputs;
use keysplat::synthetic::SceneConfig;
use miette::{IntoDiagnostic, miette};

use super::ablation::{Variant, parse_variant};
use crate::cli::{Verbosity, generate, jobs, print, progress};

/// Scenes that need no recording.
const SCENES: [(&str, &str); 5] = [
    ("demo", include_str!("../../../sequences/demo.toml")),
    ("room-clean", include_str!("../../../sequences/room-clean.toml")),
    ("room-noisy", include_str!("../../../sequences/room-noisy.toml")),
    ("room-stereo", include_str!("../../../sequences/room-stereo.toml")),
    ("hall-drive", include_str!("../../../sequences/hall-drive.toml")),
];
/// Origin of a run, in its folder: an identical run is not repeated.
const MADE_BY: &str = "made-by.json";
/// Default, without numbers of epochs or presets.
const USUAL_EPOCHS: [usize; 4] = [4, 8, 17, 34];

#[derive(Args)]
pub(super) struct SweepArgs {
    /// Recordings, or names of synthetic scenes: demo, room-clean, room-noisy, room-stereo, hall-drive.
    #[arg(required = true)]
    sequences: Vec<String>,
    /// Folder for all runs, sweep.csv, sweep.json, sweep.md and curves.svg; a sweep that was interrupted goes on there.
    #[arg(short, long, required_unless_present = "plan")]
    out: Option<PathBuf>,
    /// Write a plan of tasks into this folder instead, for `keysplat jobs`.
    #[arg(long, value_name = "FOLDER", conflicts_with = "out")]
    plan: Option<PathBuf>,
    /// Epochs after the last keyframe: each number is a point of the curves. 4, 8, 17 and 34 if there are no presets either.
    #[arg(long, value_delimiter = ',')]
    epochs: Vec<usize>,
    /// Presets of `keysplat run`: each is a point of the curves, with its own number of epochs, or with all of --epochs.
    #[arg(long, value_delimiter = ',', value_enum)]
    presets: Vec<Preset>,
    /// Seeds: each point is run with all of them.
    #[arg(long, value_delimiter = ',', default_values_t = [0u64])]
    seeds: Vec<u64>,
    /// A variant: its name and the settings in which it differs, run with all presets and numbers of epochs (may be given again).
    #[arg(long = "variant", value_name = "NAME: KEY=VALUE …", value_parser = parse_variant)]
    variants: Vec<Variant>,
    /// Options of `keysplat run` for all runs, e.g. -- --map-scale 0.5 --frames 0..200
    #[arg(last = true)]
    run: Vec<String>,
}

#[derive(Args)]
pub(super) struct CompareArgs {
    /// Folder of the earlier sweep.
    before: PathBuf,
    /// Folder of the later one.
    after: PathBuf,
    /// End with an error if anything got worse beyond the spread.
    #[arg(long)]
    fail: bool,
}

/// One run to be made.
struct Cell {
    sequence: String,
    recording: PathBuf,
    variant: String,
    seed: u64,
    options: Vec<String>,
    out: PathBuf,
}

pub(super) fn sweep(args: &SweepArgs, verbosity: Verbosity) -> miette::Result<()> {
    let folder = args.plan.as_ref().or(args.out.as_ref()).ok_or_else(|| miette!("give a folder with --out or --plan"))?;
    std::fs::create_dir_all(folder).into_diagnostic()?;
    let cells = cells(args, folder, verbosity)?;
    if args.plan.is_some() {
        return plan(&cells, folder);
    }
    let bar = progress::bar(verbosity, cells.len() as u64, "{wide_bar} {pos}/{len} runs  {msg}");
    let (mut rows, mut last) = (Vec::new(), None);
    for cell in &cells {
        bar.set_message(format!("{} {} seed {}", cell.sequence, cell.variant, cell.seed));
        let metrics = cell.measure()?;
        rows.push(SweepRow::new(&cell.sequence, &cell.variant, cell.seed, &metrics));
        last = Some(metrics);
        bar.inc(1);
    }
    bar.finish_and_clear();
    let last = last.ok_or_else(|| miette!("there is nothing to run; give at least one seed"))?;
    print(&report::write(folder, &Sweep::of(rows, &last, Vec::new())).into_diagnostic()?)
}

/// Writes the runs as tasks.
fn plan(cells: &[Cell], folder: &Path) -> miette::Result<()> {
    let mut draft = Draft::new(folder).into_diagnostic()?;
    for Cell { sequence, recording, variant, seed, options, .. } in cells {
        let mut inputs = Vec::new();
        for path in jobs::inputs_of_run(recording, options)? {
            inputs.push(draft.input(&path).into_diagnostic()?);
        }
        let recording = draft.place(recording).into_diagnostic()?;
        let run = RunTask { sequence: sequence.clone(), variant: variant.clone(), recording, options: options.clone() };
        draft.task(Task { name: format!("{sequence}, {variant}, seed {seed}"), seed: *seed, inputs, work: Work::Run(run) });
    }
    jobs::print_plan(&draft.finish().into_diagnostic()?)
}

/// The runs that each sequence and seed gets, name and options: each variant with each preset and each number of epochs.
fn settings(args: &SweepArgs) -> Vec<(String, Vec<String>)> {
    let plain = [Variant { name: String::new(), settings: Vec::new() }];
    let variants = if args.variants.is_empty() { &plain[..] } else { &args.variants };
    let mut presets: Vec<_> = args.presets.iter().copied().map(Some).collect();
    let mut epochs: Vec<_> = args.epochs.iter().copied().map(Some).collect();
    if epochs.is_empty() {
        epochs = if presets.is_empty() { USUAL_EPOCHS.map(Some).to_vec() } else { vec![None] };
    }
    if presets.is_empty() {
        presets.push(None);
    }
    let mut settings = Vec::new();
    for variant in variants {
        for preset in presets.iter().map(|preset| preset.and_then(|b| b.to_possible_value())) {
            for epochs in &epochs {
                let preset = preset.as_ref().map(|value| value.get_name().to_owned());
                let variant_name = Some(variant.name.clone()).filter(|name| !name.is_empty());
                let names = [variant_name, preset.clone(), epochs.map(|n| format!("{n} epochs"))];
                let mut options = preset.map_or_else(Vec::new, |name| vec!["--preset".into(), name]);
                let of_epochs = epochs.map(|n| format!("mapping.refine.final_epochs={n}"));
                for setting in of_epochs.into_iter().chain(variant.settings.clone()) {
                    options.extend(["--set".into(), setting]);
                }
                settings.push((names.into_iter().flatten().collect::<Vec<_>>().join(", "), options));
            }
        }
    }
    settings
}

fn cells(args: &SweepArgs, folder: &Path, verbosity: Verbosity) -> miette::Result<Vec<Cell>> {
    let mut cells = Vec::new();
    for (name, recording) in recordings(&args.sequences, folder, verbosity)? {
        for (variant, settings) in settings(args) {
            for &seed in &args.seeds {
                let of_seed = ["--set".into(), format!("mapping.seed={seed}")];
                let options = args.run.iter().chain(&settings).chain(&of_seed).cloned().collect();
                let out = folder.join("runs").join(slug(&name)).join(format!("{}-{seed}", slug(&variant)));
                let (sequence, recording, variant) = (name.clone(), recording.clone(), variant.clone());
                cells.push(Cell { sequence, recording, variant, seed, options, out });
            }
        }
    }
    let mut folders = BTreeSet::new();
    match cells.iter().find(|cell| !folders.insert(&cell.out)) {
        Some(twice) => Err(miette!("two runs are named {}, {}; give each variant and seed once", twice.sequence, twice.variant)),
        None => Ok(cells),
    }
}

/// A name that any file system takes.
fn slug(name: &str) -> String {
    name.chars().map(|c| if c.is_ascii_alphanumeric() { c } else { '-' }).collect()
}

/// Recordings with names that tell them apart; synthetic scenes are rendered where they are not yet.
pub(super) fn recordings(sequences: &[String], out: &Path, verbosity: Verbosity) -> miette::Result<Vec<(String, PathBuf)>> {
    let recording = |sequence: &String| {
        let path = PathBuf::from(sequence);
        if path.exists() {
            return Ok(path);
        }
        let folder = out.join("recordings").join(sequence);
        generate::render_if_changed(&scene(sequence)?, &folder, verbosity)?;
        Ok(folder)
    };
    let paths = sequences.iter().map(recording).collect::<miette::Result<Vec<_>>>()?;
    let names = distinct_names(&paths).ok_or_else(|| miette!("a recording is given twice; give each one once"))?;
    Ok(names.into_iter().zip(paths).collect())
}

/// The ends of paths, as long as it takes to tell them apart.
fn distinct_names(paths: &[PathBuf]) -> Option<Vec<String>> {
    let end = |path: &PathBuf, parts: usize| {
        let mut parts: Vec<_> =
            path.with_extension("").iter().rev().take(parts).map(|part| part.to_string_lossy().into_owned()).collect();
        parts.reverse();
        parts.join("/")
    };
    let most = paths.iter().map(|path| path.iter().count()).max().unwrap_or(1);
    let names = (1..=most).map(|parts| paths.iter().map(|path| end(path, parts)).collect::<Vec<_>>());
    let mut distinct = names.filter(|names| names.iter().map(|name| slug(name)).collect::<BTreeSet<_>>().len() == names.len());
    distinct.next()
}

/// The synthetic scene of a name.
pub(super) fn scene(name: &str) -> miette::Result<SceneConfig> {
    let Some((_, scene)) = SCENES.iter().find(|(scene, _)| *scene == name) else {
        let names: Vec<&str> = SCENES.iter().map(|(name, _)| *name).collect();
        return Err(miette!("there is no recording {name}; give its folder, or a synthetic scene: {}", names.join(", ")));
    };
    toml::from_str(scene).into_diagnostic()
}

impl Cell {
    /// The run's figures; made by a process of its own, so that its memory is its own, unless it was made already.
    fn measure(&self) -> miette::Result<Metrics> {
        let made_by =
            serde_json::json!({ "recording": self.recording, "options": self.options, "version": env!("CARGO_PKG_VERSION") });
        let made_by = made_by.to_string();
        let metrics = self.out.join(outputs::METRICS);
        let is_made = std::fs::read_to_string(self.out.join(MADE_BY)).is_ok_and(|text| text == made_by) && metrics.is_file();
        if !is_made {
            let program = std::env::current_exe().into_diagnostic()?;
            let output = Command::new(program)
                .arg("run")
                .arg(&self.recording)
                .arg("--out")
                .arg(&self.out)
                .args(&self.options)
                .arg("--quiet")
                .stdin(Stdio::null())
                .output()
                .into_diagnostic()?;
            if !output.status.success() {
                let said = String::from_utf8_lossy(&output.stderr);
                return Err(miette!("the run into {} failed; what is done stays done.\n{}", self.out.display(), said.trim()));
            }
            write_atomically(&self.out.join(MADE_BY), made_by.as_bytes()).into_diagnostic()?;
        }
        let text = std::fs::read_to_string(&metrics).into_diagnostic()?;
        serde_json::from_str(&text).map_err(|error| miette!("{} is damaged ({error}); remove the folder", metrics.display()))
    }
}

pub(super) fn compare(args: &CompareArgs) -> miette::Result<()> {
    let read = |folder: &Path| -> miette::Result<Sweep> {
        let path = folder.join("sweep.json");
        let text =
            std::fs::read_to_string(&path).map_err(|e| miette!("cannot read {}: {e}; give a sweep's folder", path.display()))?;
        serde_json::from_str(&text).map_err(|e| miette!("{} is no sweep of this version: {e}", path.display()))
    };
    let (before, after) = (read(&args.before)?, read(&args.after)?);
    let machine = |s: &Sweep| (s.adapter.clone(), s.cpu.clone(), s.threads);
    if machine(&before) != machine(&after) {
        tracing::warn!("the sweeps ran on different machines: their times do not compare");
    }
    let changes = changes(&before.rows, &after.rows);
    if changes.is_empty() {
        return Err(miette!("the sweeps have no sequence and variant in common"));
    }
    let mut table = String::from("| sequence | variant | figure | before | after | |\n|---|---|---|---|---|---|\n");
    for c in &changes {
        let verdict = match c.verdict {
            Verdict::Better => "better",
            Verdict::Worse => "**worse**",
            Verdict::Same => "",
        };
        let (before, after) = (with_spread(c.figure, &c.before), with_spread(c.figure, &c.after));
        table += &format!("| {} | {} | {} | {before} | {after} | {verdict} |\n", c.sequence, c.variant, c.figure.name());
    }
    print(&table)?;
    let worse = changes.iter().filter(|c| c.verdict == Verdict::Worse).count();
    if args.fail && worse > 0 { Err(miette!("{worse} figures got worse beyond the spread")) } else { Ok(()) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn recordings_are_named_by_what_tells_them_apart() {
        let names = |paths: &[&str]| distinct_names(&paths.iter().map(PathBuf::from).collect::<Vec<_>>());
        assert_eq!(names(&["/data/redkitchen", "walk.mp4"]).unwrap(), ["redkitchen", "walk"]);
        assert_eq!(
            names(&["chess/seq-01", "fire/seq-01/", "fire/seq-02"]).unwrap(),
            ["chess/seq-01", "fire/seq-01", "fire/seq-02"]
        );
        assert_eq!(names(&["seq-01", "fire/seq-01"]).unwrap(), ["seq-01", "fire/seq-01"]);
        assert_eq!(names(&["a", "a"]), None);
    }
}
