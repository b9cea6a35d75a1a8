//! Many runs side by side: what time buys. Medians and spreads over seeds, Pareto fronts, and whether one sweep is better than another.

use std::collections::BTreeMap;
use std::fmt::Write;
use std::path::Path;

use serde::{Deserialize, Serialize};

use super::{ReportError, curves, quoted};
use crate::evaluation::Metrics;
use crate::files::write_atomically;

/// One run of a sweep.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SweepRow {
    /// Name of the recording.
    pub sequence: String,
    /// Name of the preset or variant.
    pub variant: String,
    /// Seed of the mapper.
    pub seed: u64,
    /// Frames replayed.
    pub frames: u64,
    /// Frames with a pose.
    pub frames_tracked: u64,
    /// The whole run.
    pub wall_s: f64,
    /// ATE RMSE over all frames, metres.
    pub ate_rmse_m: Option<f64>,
    /// Held-out views.
    pub psnr_db: Option<f64>,
    /// Held-out SSIM.
    pub ssim: Option<f64>,
    /// Held-out depth error, mean absolute, metres.
    pub depth_l1_m: Option<f64>,
    /// Gaussians in the exported map.
    pub gaussians: Option<u64>,
    /// Optimisation steps.
    pub iterations: Option<u64>,
    /// Peak resident memory, bytes.
    pub peak_host_bytes: Option<u64>,
    /// SHA-256 of the exported map.
    pub map_hash: Option<String>,
}

/// A sweep with the machine that it ran on: `sweep.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Sweep {
    /// Name of the adapter.
    pub adapter: String,
    /// Model name of the processor.
    pub cpu: Option<String>,
    /// Hardware threads.
    pub threads: u64,
    /// Version of keysplat.
    pub version: String,
    /// All runs.
    pub rows: Vec<SweepRow>,
    /// Runs that were planned and have no row, with the reason.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub holes: Vec<String>,
}

/// Median, least and most of some runs.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Spread {
    /// Median.
    pub median: f64,
    /// Minimum.
    pub least: f64,
    /// Maximum.
    pub most: f64,
}

/// The runs of a variant on a sequence.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Point {
    /// Name of the recording.
    pub sequence: String,
    /// Name of the preset or variant.
    pub variant: String,
    /// Runs of the point.
    pub runs: usize,
    /// Time of a run, seconds.
    pub wall_s: Spread,
    /// ATE RMSE, centimetres.
    pub ate_cm: Option<Spread>,
    /// Held-out PSNR, dB.
    pub psnr_db: Option<Spread>,
    /// Gaussians in the exported map.
    pub gaussians: Option<Spread>,
}

/// Figure that is compared between sweeps.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Figure {
    /// Time of a run; lower is better.
    Time,
    /// ATE RMSE; lower is better.
    Ate,
    /// Held-out PSNR; higher is better.
    Psnr,
    /// Size of the map; lower is better.
    Gaussians,
}

/// A figure that two sweeps have in common.
#[derive(Clone, Debug, PartialEq)]
pub struct Change {
    /// Name of the recording.
    pub sequence: String,
    /// Name of the preset or variant.
    pub variant: String,
    /// The figure compared.
    pub figure: Figure,
    /// Spread of the earlier sweep.
    pub before: Spread,
    /// Spread of the later sweep.
    pub after: Spread,
    /// Direction of the change.
    pub verdict: Verdict,
}

/// Direction of a change.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Verdict {
    /// Beyond the spread, for the better.
    Better,
    /// Beyond the spread, for the worse.
    Worse,
    /// Within the spread.
    Same,
}

impl SweepRow {
    /// The row of a run with these metrics.
    pub fn new(sequence: &str, variant: &str, seed: u64, m: &Metrics) -> Self {
        let held_out = m.images.held_out;
        Self {
            sequence: sequence.into(),
            variant: variant.into(),
            seed,
            frames: m.frames,
            frames_tracked: m.frames_tracked,
            wall_s: m.wall_s.unwrap_or_default(),
            ate_rmse_m: m.ate_rmse_m.all_frames,
            psnr_db: held_out.and_then(|h| h.psnr_db),
            ssim: held_out.and_then(|h| h.ssim),
            depth_l1_m: held_out.and_then(|h| h.depth_l1_m),
            gaussians: m.gaussians,
            iterations: m.mapping.map(|mapping| mapping.iterations),
            peak_host_bytes: m.peak_host_bytes,
            map_hash: m.map_hash.clone(),
        }
    }
}

impl Sweep {
    /// A sweep on the machine of one of its runs.
    pub fn of(rows: Vec<SweepRow>, run: &Metrics, holes: Vec<String>) -> Self {
        let adapter = run.adapter.as_ref().map_or_else(String::new, |a| format!("{}, {}", a.name, a.driver));
        Self { adapter, cpu: run.cpu.clone(), threads: run.threads, version: run.version.clone(), rows, holes }
    }
}

impl Spread {
    /// `None` without values, or where one is not finite.
    fn of(values: impl Iterator<Item = f64>) -> Option<Self> {
        let mut values: Vec<f64> = values.collect();
        values.sort_by(f64::total_cmp);
        let n = values.len();
        let finite = n > 0 && values.iter().all(|v| v.is_finite());
        finite.then(|| Self { median: (values[(n - 1) / 2] + values[n / 2]) / 2.0, least: values[0], most: values[n - 1] })
    }
}

impl Figure {
    /// All figures, in the order of tables.
    pub const ALL: [Self; 4] = [Self::Time, Self::Ate, Self::Psnr, Self::Gaussians];

    /// Column heading with unit.
    pub fn name(self) -> &'static str {
        match self {
            Self::Time => "whole run, s",
            Self::Ate => "ATE RMSE, cm",
            Self::Psnr => "held-out PSNR, dB",
            Self::Gaussians => "Gaussians",
        }
    }

    /// The figure's spread at a point; `None` where it was not measured.
    pub fn of(self, point: &Point) -> Option<Spread> {
        match self {
            Self::Time => Some(point.wall_s),
            Self::Ate => point.ate_cm,
            Self::Psnr => point.psnr_db,
            Self::Gaussians => point.gaussians,
        }
    }

    /// Smaller is better, whatever the figure.
    pub fn cost(self, value: f64) -> f64 {
        if self == Self::Psnr { -value } else { value }
    }

    /// Least difference that counts, beside the spread: few runs do not show all of it.
    fn tolerance(self, value: f64) -> f64 {
        match self {
            Self::Time => 0.1 * value,
            Self::Ate => 0.05 * value,
            Self::Psnr => 0.2,
            Self::Gaussians => 0.03 * value,
        }
    }
}

/// The points of a sweep, in the order of its rows.
pub fn points(rows: &[SweepRow]) -> Vec<Point> {
    let mut order: Vec<(&str, &str)> = Vec::new();
    let mut groups: BTreeMap<(&str, &str), Vec<&SweepRow>> = BTreeMap::new();
    for row in rows {
        let key = (row.sequence.as_str(), row.variant.as_str());
        let group = groups.entry(key).or_default();
        if group.is_empty() {
            order.push(key);
        }
        group.push(row);
    }
    let point = |key: &(&str, &str)| {
        let group = &groups[key];
        // A figure that one run lacks has no median.
        let spread = |value: &dyn Fn(&SweepRow) -> Option<f64>| {
            let values: Vec<f64> = group.iter().filter_map(|row| value(row)).collect();
            if values.len() == group.len() { Spread::of(values.into_iter()) } else { None }
        };
        Point {
            sequence: key.0.into(),
            variant: key.1.into(),
            runs: group.len(),
            wall_s: spread(&|row| Some(row.wall_s)).unwrap_or(Spread { median: 0.0, least: 0.0, most: 0.0 }),
            ate_cm: spread(&|row| row.ate_rmse_m.map(|v| 100.0 * v)),
            psnr_db: spread(&|row| row.psnr_db),
            gaussians: spread(&|row| row.gaussians.map(|g| g as f64)),
        }
    };
    order.iter().map(point).collect()
}

/// Which of `(time, cost)` nobody undercuts in both; of equal ones all.
pub fn pareto(points: &[(f64, f64)]) -> Vec<bool> {
    let beats = |a: &(f64, f64), b: &(f64, f64)| a.0 <= b.0 && a.1 <= b.1 && a != b;
    points.iter().map(|p| !points.iter().any(|other| beats(other, p))).collect()
}

/// Changes of the figures that both sweeps measured.
pub fn compare(before: &[SweepRow], after: &[SweepRow]) -> Vec<Change> {
    let before = points(before);
    let mut changes = Vec::new();
    for now in points(after) {
        let Some(then) = before.iter().find(|p| (&p.sequence, &p.variant) == (&now.sequence, &now.variant)) else { continue };
        for figure in Figure::ALL {
            let (Some(a), Some(b)) = (figure.of(then), figure.of(&now)) else { continue };
            let change = figure.cost(b.median) - figure.cost(a.median);
            let apart = a.most < b.least || b.most < a.least;
            let counts = apart && change.abs() > figure.tolerance(a.median);
            let verdict = match counts {
                false => Verdict::Same,
                true if change < 0.0 => Verdict::Better,
                true => Verdict::Worse,
            };
            let (sequence, variant) = (now.sequence.clone(), now.variant.clone());
            changes.push(Change { sequence, variant, figure, before: a, after: b, verdict });
        }
    }
    changes
}

/// Rows as CSV with a header; empty where a figure does not apply.
pub fn to_csv(rows: &[SweepRow]) -> String {
    fn cell<T: ToString>(value: Option<T>) -> String {
        value.map_or_else(String::new, |v| v.to_string())
    }
    let mut csv = String::from(
        "sequence,variant,seed,frames,frames_tracked,wall_s,ate_rmse_m,psnr_db,ssim,depth_l1_m,gaussians,iterations,peak_host_bytes,map_hash\n",
    );
    for r in rows {
        let _ = writeln!(
            csv,
            "{},{},{},{},{},{},{},{},{},{},{},{},{},{}",
            quoted(&r.sequence),
            quoted(&r.variant),
            r.seed,
            r.frames,
            r.frames_tracked,
            r.wall_s,
            cell(r.ate_rmse_m),
            cell(r.psnr_db),
            cell(r.ssim),
            cell(r.depth_l1_m),
            cell(r.gaussians),
            cell(r.iterations),
            cell(r.peak_host_bytes),
            cell(r.map_hash.as_deref())
        );
    }
    csv
}

/// The points as a table in Markdown, each figure with its spread where there is one.
pub fn to_markdown(rows: &[SweepRow]) -> String {
    let names = Figure::ALL.map(Figure::name).join(" | ");
    let mut table = format!("| sequence | variant | runs | {names} |");
    table += "\n|---|---|---|---|---|---|---|\n";
    for point in points(rows) {
        let _ = write!(table, "| {} | {} | {} |", point.sequence, point.variant, point.runs);
        for figure in Figure::ALL {
            let _ = write!(table, " {} |", figure.of(&point).map_or_else(|| "–".into(), |s| with_spread(figure, &s)));
        }
        table.push('\n');
    }
    table
}

/// Writes `sweep.json`, `sweep.csv`, `sweep.md` and `curves.svg` into a folder; returns the table in Markdown.
///
/// # Errors
/// If the curves cannot be drawn or a file cannot be written.
pub fn write(folder: &Path, sweep: &Sweep) -> Result<String, ReportError> {
    let table = to_markdown(&sweep.rows);
    let svg = curves::draw(&points(&sweep.rows)).map_err(ReportError::Drawing)?;
    let json = serde_json::to_string_pretty(sweep).expect("a sweep is text and numbers");
    for (name, text) in [("sweep.json", &json), ("sweep.csv", &to_csv(&sweep.rows)), ("sweep.md", &table), ("curves.svg", &svg)] {
        write_atomically(&folder.join(name), text.as_bytes())?;
    }
    Ok(table)
}

/// A median and, where runs differ, their range.
pub fn with_spread(figure: Figure, s: &Spread) -> String {
    let decimals = match figure {
        Figure::Time => 1,
        Figure::Ate | Figure::Psnr => 2,
        Figure::Gaussians => 0,
    };
    let median = format!("{:.decimals$}", s.median);
    if s.least == s.most { median } else { format!("{median} ({:.decimals$}–{:.decimals$})", s.least, s.most) }
}

#[cfg(test)]
mod tests;
