//! The page around the plots.

use std::fmt::Write;

use base64::Engine;
use base64::engine::general_purpose::STANDARD;

use super::{ReportError, Run, plots};
use crate::evaluation::Metrics;
use crate::run_folder::outputs;
use crate::viewing::{self, Embedded, Finished};

const TEMPLATE: &str = include_str!("page.html");
/// Held-out views in the page: so many, evenly spread, and the worst.
const VIEWS: usize = 8;
/// Keyframes whose images are in the page.
const KEYFRAME_IMAGES: usize = 16;

pub fn html(run: &Run) -> Result<String, ReportError> {
    let parts = [
        ("TITLE", escaped(&run.metrics.sequence)),
        ("SUMMARY", summary(&run.metrics)),
        ("CARDS", cards(&run.metrics)),
        ("PLOTS", plots_of(run).map_err(ReportError::Drawing)?),
        ("MAP", map(run)),
        ("VIEWS", views(run)?),
        ("TABLE", escaped(&run.metrics.to_string())),
        ("CONFIG", run.config.as_deref().map(escaped).unwrap_or_default()),
    ];
    let mut page = TEMPLATE.to_owned();
    for (name, text) in parts {
        page = page.replace(&format!("<!--{name}-->"), &text);
    }
    Ok(page)
}

/// The viewer with the map and the images of some keyframes; nothing where the folder has no map.
fn map(run: &Run) -> String {
    let finished = match Finished::open(&run.folder) {
        Ok(finished) => finished,
        Err(error) => {
            tracing::warn!("the report shows no map: {error}");
            return String::new();
        }
    };
    let Embedded { style, script, messages } = viewing::embedded(&finished.messages(KEYFRAME_IMAGES));
    format!(
        "<h2>The map</h2>\n<style>\n{style}</style>\n<section id=\"viewer\" class=\"embedded\"></section>\n{messages}\
         <script type=\"module\">\n{script}</script>\n"
    )
}

fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

fn summary(m: &Metrics) -> String {
    let replay = if m.paced { "real time" } else { "deterministic" };
    let resumed = if m.resumed > 0 { format!(", resumed {}×", m.resumed) } else { String::new() };
    let adapter = m.adapter.as_ref().map_or_else(String::new, |a| format!(", on {}", a.name));
    escaped(&format!("{} of {} frames tracked, {}, {replay}{resumed}{adapter}", m.frames_tracked, m.frames, m.sensor))
}

fn cards(m: &Metrics) -> String {
    let held_out = m.images.held_out;
    let figure = |value: Option<f64>, decimals: usize| value.map(|v| format!("{v:.decimals$}"));
    let cards = [
        ("ATE RMSE", figure(m.ate_rmse_m.all_frames.map(|v| 100.0 * v), 2), "cm"),
        ("held-out PSNR", figure(held_out.and_then(|h| h.psnr_db), 2), "dB"),
        ("held-out SSIM", figure(held_out.and_then(|h| h.ssim), 3), ""),
        ("depth L1", figure(held_out.and_then(|h| h.depth_l1_m).map(|v| 100.0 * v), 1), "cm"),
        ("Gaussians", m.gaussians.map(|g| g.to_string()), ""),
        ("whole run", figure(m.wall_s, 1), "s"),
        ("tracking, median", figure(m.tracking_ms.map(|t| t.median), 1), "ms"),
        ("mapping step", figure(m.mapping.and_then(|s| s.ms_per_iteration).map(|t| t.median), 1), "ms"),
    ];
    let mut html = String::new();
    for (name, value, unit) in cards {
        if let Some(value) = value {
            let _ = write!(html, "<div class=\"card\"><b>{value}</b> <small>{unit}</small><span>{name}</span></div>");
        }
    }
    html
}

fn plots_of(run: &Run) -> Result<String, String> {
    let mut html = String::new();
    let mut add = |caption: &str, svg: String| {
        let _ = write!(html, "<figure class=\"plot\">{svg}<figcaption>{caption}</figcaption></figure>");
    };
    if let Some(comparison) = run.comparison.as_ref().filter(|c| c.poses.len() > 1) {
        let worst = comparison.poses.iter().filter_map(|p| p.error_m).fold(0.0, f64::max);
        let colored = if comparison.truth.is_empty() {
            String::new()
        } else {
            format!(
                ": truth in grey; error from <i style=\"background:{}\"></i> 0 over <i style=\"background:{}\"></i> to \
                 <i style=\"background:{}\"></i> {:.1} cm",
                css(plots::color_of(0.0)),
                css(plots::color_of(0.5)),
                css(plots::color_of(1.0)),
                100.0 * worst
            )
        };
        let [first, second, third] = plots::axes_by_extent(comparison);
        add(&format!("The path from where it is widest{colored}"), plots::path(comparison, first, second, worst)?);
        add("The same from the side", plots::path(comparison, first, third, worst)?);
        if worst > 0.0 {
            add("Distance from the truth, after alignment", plots::error_over_time(comparison)?);
        }
        if !comparison.views.is_empty() {
            add("Held-out views: what the mapper never saw", plots::view_quality(comparison)?);
        }
    }
    if let Some(history) = &run.history {
        if !history.frames.is_empty() {
            let names: Vec<String> = plots::STAGES
                .iter()
                .map(|(name, color)| format!("<i style=\"background:{}\"></i> {name}", css(*color)))
                .collect();
            add(&format!("Tracking, stage by stage: {}", names.join(" ")), plots::stage_times(&history.frames)?);
        }
        if !history.keyframes.is_empty() {
            add("Views that the mapper learns from, before each step", plots::keyframe_quality(&history.keyframes)?);
            add("Size of the map", plots::gaussians(&history.keyframes)?);
            if history.keyframes.iter().any(|k| k.host_bytes.is_some()) {
                add("Memory of the process", plots::memory(&history.keyframes)?);
            }
            let caption = "Seconds for each keyframe (blue), and messages that waited for the mapper (orange)";
            add(caption, plots::mapper_load(&history.keyframes)?);
        }
    }
    Ok(html)
}

fn css(color: plotters::style::RGBColor) -> String {
    format!("rgb({},{},{})", color.0, color.1, color.2)
}

/// Some held-out views: recorded and rendered one over the other, with a slider between them.
fn views(run: &Run) -> Result<String, ReportError> {
    let Some(comparison) = &run.comparison else { return Ok(String::new()) };
    let folder = run.folder.join(outputs::VIEWS);
    let kept: Vec<_> = comparison.views.iter().filter(|v| folder.join(outputs::picture_name(v.frame)).is_file()).collect();
    let mut chosen: Vec<usize> = (0..VIEWS.min(kept.len())).map(|k| k * kept.len() / VIEWS.min(kept.len())).collect();
    let quality = |k: usize| kept[k].psnr_db.unwrap_or(f64::INFINITY);
    let worst = (0..kept.len()).min_by(|a, b| quality(*a).total_cmp(&quality(*b)));
    chosen.extend(worst);
    chosen.sort_unstable();
    chosen.dedup();
    let mut html = String::new();
    for k in chosen {
        let view = kept[k];
        let path = folder.join(outputs::picture_name(view.frame));
        let png = std::fs::read(&path).map_err(|source| ReportError::Read { path: path.clone(), source })?;
        let (width, height) = image::ImageReader::new(std::io::Cursor::new(&png))
            .with_guessed_format()
            .and_then(|reader| reader.into_dimensions().map_err(std::io::Error::other))
            .map_err(|source| ReportError::Read { path, source })?;
        let psnr = view.psnr_db.map_or_else(|| "equal".into(), |v| format!("{v:.1} dB"));
        let remark = if Some(k) == worst { ", the worst" } else { "" };
        let _ = write!(
            html,
            "<figure class=\"view\"><div class=\"pair\" style=\"aspect-ratio:{}/{height};--pair:url(data:image/png;base64,{})\">\
             <div class=\"rendered\"></div><div class=\"recorded\"></div></div>\
             <input type=\"range\" min=\"0\" max=\"100\" value=\"50\" aria-label=\"share of the recorded image, frame {}\">\
             <figcaption>frame {}: {psnr}, SSIM {:.3}{remark}</figcaption></figure>",
            width / 2,
            STANDARD.encode(&png),
            view.frame,
            view.frame,
            view.ssim
        );
    }
    Ok(html)
}
