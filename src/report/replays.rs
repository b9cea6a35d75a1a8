//! Many replays of recordings by the tracker: distributions of its errors, and what a choice of settings is worth on recordings that had no
//! part in it.

use std::fmt::Write;
use std::path::Path;

use plotters::prelude::*;
use serde::{Deserialize, Serialize};

use super::{ReportError, names, quoted};
use crate::files::write_atomically;

const PANEL: (u32, u32) = (420, 320);
/// Panels in a row of the plot.
const COLUMNS: usize = 3;
const BOOTSTRAP_DRAWS: usize = 400;

/// One replay of a recording.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ReplayRow {
    /// Name of the recording, with the sensor if not all of it was used.
    pub recording: String,
    /// Name of the settings.
    pub variant: String,
    /// First frame, in the order of the recording.
    pub start: usize,
    /// Whether its frames came in reverse.
    pub backwards: bool,
    /// Stride: of so many frames one was replayed.
    pub every: usize,
    /// Share of frames that were left out, percent.
    pub missing_percent: u32,
    /// Frames replayed.
    pub frames: usize,
    /// Frames without a pose.
    pub lost: usize,
    /// Keyframes.
    pub keyframes: usize,
    /// ATE RMSE of the frames with a pose, metres; `None` if there are too few of them.
    pub ate_rmse_m: Option<f64>,
    /// Mean time from frame to frame, milliseconds: decoding, features and tracking, beside each other.
    pub ms_per_frame: f64,
    /// Time after the last frame, milliseconds: the adjustment of all keyframes, and the poses of frames by its result.
    pub final_ms: f64,
}

impl ReplayRow {
    /// Name of a row as a file of its own.
    pub const FILE: &str = "replay.json";
}

/// What a variant does on a recording.
#[derive(Clone, Debug, PartialEq)]
pub struct Distribution {
    /// Name of the recording.
    pub recording: String,
    /// Name of the settings.
    pub variant: String,
    /// Number of replays.
    pub replays: usize,
    /// Median ATE RMSE, centimetres; infinite where half of the replays failed.
    pub median_cm: f64,
    /// Its mean over the worst quarter of the replays.
    pub worst_quarter_cm: f64,
    /// Its maximum.
    pub worst_cm: f64,
    /// Frames without a pose, percent of all.
    pub lost_percent: f64,
    /// Mean time from frame to frame, milliseconds: decoding, features and tracking, beside each other.
    pub ms_per_frame: f64,
    /// Mean time after the last frame, milliseconds a frame.
    pub final_ms_per_frame: f64,
    /// All errors, centimetres, ascending.
    errors_cm: Vec<f64>,
}

impl Distribution {
    fn of(recording: &str, variant: &str, rows: &[&ReplayRow]) -> Self {
        let mut errors_cm: Vec<f64> =
            rows.iter().map(|row| row.ate_rmse_m.map_or(f64::INFINITY, |metres| 100.0 * metres)).collect();
        errors_cm.sort_by(f64::total_cmp);
        let n = errors_cm.len();
        let frames = rows.iter().map(|row| row.frames).sum::<usize>().max(1) as f64;
        Self {
            recording: recording.into(),
            variant: variant.into(),
            replays: n,
            median_cm: f64::midpoint(errors_cm[(n - 1) / 2], errors_cm[n / 2]),
            worst_quarter_cm: mean_of_worst_quarter(&errors_cm),
            worst_cm: errors_cm[n - 1],
            lost_percent: 100.0 * rows.iter().map(|row| row.lost).sum::<usize>() as f64 / frames,
            ms_per_frame: rows.iter().map(|row| row.ms_per_frame * row.frames as f64).sum::<f64>() / frames,
            final_ms_per_frame: rows.iter().map(|row| row.final_ms).sum::<f64>() / frames,
            errors_cm,
        }
    }
}

/// `errors` are ascending.
fn mean_of_worst_quarter(errors: &[f64]) -> f64 {
    let worst = &errors[errors.len() - errors.len().div_ceil(4)..];
    worst.iter().sum::<f64>() / worst.len() as f64
}

/// The distribution of each recording and variant, in the order of the rows.
pub fn distributions(rows: &[ReplayRow]) -> Vec<Distribution> {
    let (recordings, variants) = (names(rows, |row| &row.recording), names(rows, |row| &row.variant));
    let mut all = Vec::new();
    for recording in &recordings {
        for variant in &variants {
            let own: Vec<&ReplayRow> = rows.iter().filter(|row| row.recording == *recording && row.variant == *variant).collect();
            if !own.is_empty() {
                all.push(Distribution::of(recording, variant, &own));
            }
        }
    }
    all
}

/// A recording left out: the settings that the other recordings choose, on this one.
#[derive(Clone, Debug, PartialEq)]
pub struct LeftOut {
    /// Name of the recording.
    pub recording: String,
    /// Settings of least cost over the other recordings.
    pub chosen: String,
    /// Mean error of its worst quarter of replays with these, centimetres.
    pub chosen_cm: f64,
    /// Settings of least error on this recording.
    pub best: String,
    /// Mean error of its worst quarter of replays with those, centimetres.
    pub best_cm: f64,
    /// Ratio of the two errors that chance gives where all settings are as good as the chosen ones: the median of bootstrap draws.
    pub ratio_by_chance: f64,
}

/// Cost of a variant over recordings: geometric mean of the ratios of its worst quarter to the best variant's.
fn cost(variant: &str, all: &[Distribution], left_out: Option<&str>) -> f64 {
    let own = all.iter().filter(|d| d.variant == variant && left_out != Some(&d.recording));
    let ratios: Vec<f64> = own.map(|d| ratio(d.worst_quarter_cm, best(all, &d.recording).worst_quarter_cm).ln()).collect();
    (ratios.iter().sum::<f64>() / ratios.len().max(1) as f64).exp()
}

/// Ratio of two errors; two that failed are alike.
fn ratio(error: f64, least: f64) -> f64 {
    if error == least { 1.0 } else { error / least }
}

fn best<'a>(all: &'a [Distribution], recording: &str) -> &'a Distribution {
    let own = all.iter().filter(|d| d.recording == recording);
    own.min_by(|a, b| a.worst_quarter_cm.total_cmp(&b.worst_quarter_cm)).expect("the recording has a distribution")
}

/// For each recording what the others choose for it; nothing with one recording or one variant.
pub fn leave_one_out(all: &[Distribution]) -> Vec<LeftOut> {
    let (recordings, variants) = (names(all, |d| &d.recording), names(all, |d| &d.variant));
    if recordings.len() < 2 || variants.len() < 2 {
        return Vec::new();
    }
    let choice = |recording: &&str| {
        let of = |variant: &str| cost(variant, all, Some(recording));
        let chosen = *variants.iter().min_by(|a, b| of(a).total_cmp(&of(b))).expect("there are variants");
        let own = all.iter().find(|d| d.recording == **recording && d.variant == chosen)?;
        let best = best(all, recording);
        Some(LeftOut {
            recording: (*recording).into(),
            chosen: chosen.into(),
            chosen_cm: own.worst_quarter_cm,
            best: best.variant.clone(),
            best_cm: best.worst_quarter_cm,
            ratio_by_chance: ratio_by_chance(&own.errors_cm, variants.len()),
        })
    };
    recordings.iter().filter_map(choice).collect()
}

/// Median over draws of the ratio of the worst quarter of one sample to the least of `variants` samples, all drawn from the same errors.
fn ratio_by_chance(errors: &[f64], variants: usize) -> f64 {
    let mut random = fastrand::Rng::with_seed(0);
    let mut sample = || {
        let mut drawn: Vec<f64> = errors.iter().map(|_| errors[random.usize(..errors.len())]).collect();
        drawn.sort_by(f64::total_cmp);
        mean_of_worst_quarter(&drawn)
    };
    let mut draw = || {
        let of_each: Vec<f64> = (0..variants).map(|_| sample()).collect();
        ratio(of_each[0], of_each.iter().copied().fold(f64::INFINITY, f64::min))
    };
    let mut ratios: Vec<f64> = (0..BOOTSTRAP_DRAWS).map(|_| draw()).collect();
    ratios.sort_by(f64::total_cmp);
    ratios[BOOTSTRAP_DRAWS / 2]
}

/// All rows as CSV with a header.
pub fn to_csv(rows: &[ReplayRow]) -> String {
    let mut csv = String::from(
        "recording,variant,start,backwards,every,missing_percent,frames,lost,keyframes,ate_rmse_m,ms_per_frame,final_ms\n",
    );
    for row in rows {
        let ReplayRow { recording, variant, start, backwards, every, missing_percent, frames, lost, keyframes, .. } = row;
        let ate = row.ate_rmse_m.map_or_else(String::new, |metres| format!("{metres:.6}"));
        let _ = writeln!(
            csv,
            "{},{},{start},{backwards},{every},{missing_percent},{frames},{lost},{keyframes},{ate},{:.3},{:.3}",
            quoted(recording),
            quoted(variant),
            row.ms_per_frame,
            row.final_ms
        );
    }
    csv
}

/// Writes `track.csv`, `track.md` and `track.svg` into a folder; returns the table in Markdown.
///
/// # Errors
/// If the figure cannot be drawn or a file cannot be written.
pub fn write(folder: &Path, rows: &[ReplayRow]) -> Result<String, ReportError> {
    let all = distributions(rows);
    let table = to_markdown(&all);
    let svg = draw(&all).map_err(ReportError::Drawing)?;
    for (name, text) in [("track.csv", &to_csv(rows)), ("track.md", &table), ("track.svg", &svg)] {
        write_atomically(&folder.join(name), text.as_bytes())?;
    }
    Ok(table)
}

/// The distributions, the cost of each variant, and what recordings that are left out cost, as Markdown.
pub fn to_markdown(all: &[Distribution]) -> String {
    let cm = |value: f64| if value.is_finite() { format!("{value:.2}") } else { "failed".into() };
    let mut text = String::from(
        "| recording | settings | replays | ATE RMSE, cm: median | worst quarter | worst | lost, % | ms a frame | ms a frame at the end |\n|---|---|---|---|---|---|---|---|---|\n",
    );
    for d in all {
        let (median, quarter, worst) = (cm(d.median_cm), cm(d.worst_quarter_cm), cm(d.worst_cm));
        let _ = writeln!(
            text,
            "| {} | {} | {} | {median} | {quarter} | {worst} | {:.1} | {:.1} | {:.1} |",
            d.recording, d.variant, d.replays, d.lost_percent, d.ms_per_frame, d.final_ms_per_frame
        );
    }
    let variants = names(all, |d| &d.variant);
    if variants.len() > 1 {
        text += "\n| settings | worst quarter to the best settings' of each recording, geometric mean |\n|---|---|\n";
        for variant in variants {
            let _ = writeln!(text, "| {variant} | {:.3} |", cost(variant, all, None));
        }
    }
    let left_out = leave_one_out(all);
    if !left_out.is_empty() {
        text += "\n| recording left out | settings by the others | worst quarter, cm | its own best | worst quarter, cm | ratio | by chance |\n|---|---|---|---|---|---|---|\n";
        for l in left_out {
            let (chosen, best) = (cm(l.chosen_cm), cm(l.best_cm));
            let _ = writeln!(
                text,
                "| {} | {} | {chosen} | {} | {best} | {:.2} | {:.2} |",
                l.recording,
                l.chosen,
                l.best,
                ratio(l.chosen_cm, l.best_cm),
                l.ratio_by_chance
            );
        }
    }
    text
}

/// Share of the replays that stay below an error, one panel a recording, one colour a variant, as SVG.
///
/// # Errors
/// The text of the drawing library, if it cannot draw.
pub fn draw(all: &[Distribution]) -> Result<String, String> {
    let mut svg = String::new();
    let (recordings, variants) = (names(all, |d| &d.recording), names(all, |d| &d.variant));
    let rows = recordings.len().div_ceil(COLUMNS).max(1);
    let size = (PANEL.0 * recordings.len().clamp(1, COLUMNS) as u32, PANEL.1 * rows as u32);
    {
        let root = SVGBackend::with_string(&mut svg, size).into_drawing_area();
        let drawn = || -> Result<(), Box<dyn std::error::Error>> {
            root.fill(&WHITE)?;
            let panels = root.split_evenly((rows, recordings.len().clamp(1, COLUMNS)));
            for (panel, recording) in panels.iter().zip(&recordings) {
                let own = || all.iter().filter(|d| d.recording == *recording);
                let errors = own().flat_map(|d| &d.errors_cm).copied().filter(|cm| cm.is_finite());
                let end = errors.fold(0.0f64, f64::max).max(1e-3) * 1.05;
                let mut chart = ChartBuilder::on(panel)
                    .margin(10)
                    .caption(recording, ("sans-serif", 17))
                    .x_label_area_size(36)
                    .y_label_area_size(44)
                    .build_cartesian_2d(0.0..end, 0.0..1.0)?;
                let mesh = &mut chart.configure_mesh();
                mesh.light_line_style(TRANSPARENT).bold_line_style(BLACK.mix(0.12)).label_style(("sans-serif", 13));
                mesh.x_desc("ATE RMSE, cm").y_desc("share of replays").draw()?;
                for d in own() {
                    let color = Palette99::pick(variants.iter().position(|name| *name == d.variant).unwrap_or(0));
                    let n = d.errors_cm.len() as f64;
                    let step = |(i, cm): (usize, &f64)| [(cm.min(end), i as f64 / n), (cm.min(end), (i + 1) as f64 / n)];
                    let line =
                        [(0.0, 0.0)].into_iter().chain(d.errors_cm.iter().filter(|cm| cm.is_finite()).enumerate().flat_map(step));
                    chart
                        .draw_series(LineSeries::new(line, color.stroke_width(2)))?
                        .label(&d.variant)
                        .legend(move |(x, y)| PathElement::new([(x, y), (x + 14, y)], color.stroke_width(2)));
                }
                if variants.len() > 1 {
                    let place = SeriesLabelPosition::LowerRight;
                    chart.configure_series_labels().position(place).label_font(("sans-serif", 13)).draw()?;
                }
            }
            Ok(root.present()?)
        };
        drawn().map_err(|error| error.to_string())?;
    }
    Ok(svg)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn row(recording: &str, variant: &str, ate_cm: f64, lost: usize) -> ReplayRow {
        ReplayRow {
            recording: recording.into(),
            variant: variant.into(),
            start: 0,
            backwards: false,
            every: 1,
            missing_percent: 0,
            frames: 100,
            lost,
            keyframes: 10,
            ate_rmse_m: ate_cm.is_finite().then_some(ate_cm / 100.0),
            ms_per_frame: 10.0,
            final_ms: 200.0,
        }
    }

    #[test]
    fn a_distribution_has_its_median_its_worst_quarter_and_failures_at_its_end() {
        let rows: Vec<ReplayRow> = [3.0, 1.0, 8.0, 2.0, 6.0].map(|cm| row("a", "v", cm, 2)).into();
        let all = distributions(&rows);
        assert_eq!((all[0].median_cm, all[0].worst_quarter_cm, all[0].worst_cm), (3.0, 7.0, 8.0));
        assert!((all[0].lost_percent - 2.0).abs() < 1e-12);
        let failed = distributions(&[row("a", "v", f64::INFINITY, 99), row("a", "v", 1.0, 0)]);
        assert!(failed[0].worst_cm.is_infinite());
        assert!(to_markdown(&failed).contains("failed"));
        assert_eq!(to_csv(&rows).lines().count(), 6);
    }

    #[test]
    fn what_is_left_out_has_no_part_in_the_choice() {
        let errors = [("a", 1.0, 2.0), ("b", 1.0, 2.0), ("c", 9.0, 3.0)];
        let rows: Vec<ReplayRow> = errors.iter().flat_map(|&(name, x, y)| [row(name, "x", x, 0), row(name, "y", y, 0)]).collect();
        let all = distributions(&rows);
        let left = leave_one_out(&all);
        // Of `a` and `c`, y is the better one by the geometric mean; of `a` and `b`, x.
        assert_eq!(left.iter().map(|l| l.chosen.as_str()).collect::<Vec<_>>(), ["y", "y", "x"]);
        assert_eq!((left[2].chosen_cm, left[2].best_cm), (9.0, 3.0));
        // One replay of each varies by nothing.
        assert!(left.iter().all(|l| l.ratio_by_chance == 1.0));
        let varied = ratio_by_chance(&[1.0, 1.1, 1.3, 1.4, 2.0, 2.4, 3.0, 5.0], 5);
        assert!((1.1..3.0).contains(&varied) && ratio_by_chance(&[2.0; 8], 5) == 1.0, "{varied}");
        assert!(leave_one_out(&all[..1]).is_empty());
        let all_fail: Vec<ReplayRow> = ["x", "y"].map(|variant| row("d", variant, f64::INFINITY, 99)).into();
        let with_failures = distributions(&[rows, all_fail].concat());
        assert_eq!((cost("x", &with_failures, Some("c")), leave_one_out(&with_failures)[2].chosen.as_str()), (1.0, "x"));
        let svg = draw(&all).unwrap();
        assert_eq!(svg.matches("ATE RMSE, cm").count(), 3);
    }
}
