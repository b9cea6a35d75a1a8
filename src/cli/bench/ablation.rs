//! `keysplat bench ablation`

use std::collections::BTreeSet;
use std::sync::Arc;

use clap::Args;
use keysplat::evaluation::metrics::{ImageFigures, ImageProtocols};
use keysplat::evaluation::views::{ViewSelection, ViewSource, evaluate_views};
use keysplat::pipeline::{MappedLog, TrackedLog};
use keysplat::{Config, Gpu, Progress, Recording};
use miette::IntoDiagnostic;
use serde::Serialize;

use super::super::run::RunArgs;

#[derive(Args)]
pub(super) struct AblationArgs {
    #[command(flatten)]
    run: RunArgs,
    /// A variant: its name and the settings in which it differs, e.g. "no pruning: mapping.density.min_opacity=0" (may be given again).
    #[arg(long = "variant", value_name = "NAME: KEY=VALUE …", value_parser = parse_variant)]
    variants: Vec<Variant>,
    /// Epochs after the last keyframe: every variant is run with each of these numbers, which gives it a curve.
    #[arg(long, value_delimiter = ',')]
    epochs: Vec<usize>,
    /// Print a row about every so many steps of the refinement, too; the time of measuring is not counted.
    #[arg(long, value_name = "STEPS")]
    rows_every: Option<usize>,
}

/// Settings that differ from the base.
#[derive(Clone, Debug, Serialize)]
pub(super) struct Variant {
    pub name: String,
    pub settings: Vec<String>,
}

pub(super) fn parse_variant(text: &str) -> Result<Variant, String> {
    let (name, settings) = text.split_once(':').ok_or("write NAME: KEY=VALUE KEY=VALUE")?;
    Ok(Variant { name: name.trim().into(), settings: settings.split_whitespace().map(Into::into).collect() })
}

/// One row of the table.
#[derive(Debug, Serialize)]
struct Row {
    variant: String,
    final_epochs: usize,
    mapping_s: f64,
    steps: usize,
    gaussians: usize,
    held_out: Option<ImageFigures>,
    held_out_map_colors: Option<ImageFigures>,
}

impl Row {
    fn new(variant: &Variant, final_epochs: usize, mapped: &MappedLog, images: &ImageProtocols) -> Self {
        let (mapping_s, steps, gaussians) = (mapped.wall_s, mapped.steps, mapped.cloud.len());
        let (held_out, held_out_map_colors) = (images.held_out, images.held_out_map_colors);
        Self { variant: variant.name.clone(), final_epochs, mapping_s, steps, gaussians, held_out, held_out_map_colors }
    }
}

pub(super) fn ablation(args: &AblationArgs) -> miette::Result<()> {
    let (recording, gpu) = args.run.open()?;
    let base = recording.config();
    let given = Variant { name: "as given".into(), settings: Vec::new() };
    let variants = if args.variants.is_empty() { std::slice::from_ref(&given) } else { &args.variants };
    // A wrong setting fails before anything runs.
    let configs: Vec<Config> =
        variants.iter().map(|v| base.with_settings(&v.settings)).collect::<Result<_, _>>().into_diagnostic()?;
    std::fs::create_dir_all(&args.run.out).into_diagnostic()?;
    let log = TrackedLog::record(&recording, &Progress::default()).into_diagnostic()?;
    println!("| variant | final epochs | mapping s | steps | Gaussians | PSNR exposure dB | PSNR own dB | SSIM | depth L1 cm |");
    println!("|---|---|---|---|---|---|---|---|---|");
    let mut rows = Vec::new();
    for (variant, config) in variants.iter().zip(configs) {
        let own = [config.mapping.refine.final_epochs];
        for &epochs in if args.epochs.is_empty() { &own } else { args.epochs.as_slice() } {
            let mut config = config.clone();
            config.mapping.refine.final_epochs = epochs;
            let mut row = |mapped: &MappedLog| -> miette::Result<()> {
                let held_out = held_out(&recording, &log, &gpu, mapped);
                rows.push(Row::new(variant, epochs, mapped, &held_out?));
                print(rows.last().expect("one was pushed"));
                Ok(())
            };
            let every = args.rows_every.unwrap_or(usize::MAX).max(1);
            let (mut next, mut last, mut failed) = (every, 0, Ok(()));
            let mut on_round = |mapped: MappedLog| {
                if mapped.steps >= next && failed.is_ok() {
                    next = (mapped.steps / every + 1).saturating_mul(every);
                    last = mapped.steps;
                    failed = row(&mapped);
                }
            };
            let mapped = log.map(&gpu, &config.mapping, &Progress::default(), &mut on_round).into_diagnostic()?;
            failed?;
            if mapped.steps != last {
                row(&mapped)?;
            }
        }
    }
    let text = serde_json::to_string_pretty(&rows).into_diagnostic()?;
    keysplat::files::write_atomically(&args.run.out.join("ablation.json"), text.as_bytes()).into_diagnostic()?;
    Ok(())
}

/// Figures of a map's held-out views.
fn held_out(recording: &Recording, log: &TrackedLog, gpu: &Arc<Gpu>, mapped: &MappedLog) -> miette::Result<ImageProtocols> {
    let config = recording.config();
    let is_held_out = |index: usize| config.replay.is_held_out(index);
    let poses: Vec<_> = log.poses().iter().filter(|(index, _)| is_held_out(*index)).copied().collect();
    let MappedLog { cloud, exposures, .. } = mapped;
    let selection = ViewSelection { poses: &poses, keyframes: &BTreeSet::new(), is_held_out: &is_held_out, exposures };
    let source = ViewSource {
        sequence: recording.sequence(),
        map_scale: config.map_scale,
        gpu,
        cloud,
        most_gaussians: config.mapping.limits.most_rendered(gpu.bytes(), cloud.sh_degree),
        surface: config.mapping.surface,
    };
    Ok(evaluate_views(source, &selection, &|_| (), &|_| ()).into_diagnostic()?.0)
}

fn print(row: &Row) {
    let figures = row.held_out.as_ref().map_or_else(String::new, |f| {
        let depth = f.depth_l1_m.map_or_else(String::new, |d| format!("{:.2}", d * 100.0));
        let (psnr, ssim) = (f.psnr_db.unwrap_or_default(), f.ssim.unwrap_or_default());
        let own = row.held_out_map_colors.and_then(|f| f.psnr_db).unwrap_or(psnr);
        format!("{psnr:.2} | {own:.2} | {ssim:.4} | {depth}")
    });
    let Row { variant, final_epochs, mapping_s, steps, gaussians, .. } = row;
    println!("| {variant} | {final_epochs} | {mapping_s:.1} | {steps} | {gaussians} | {figures} |");
}
