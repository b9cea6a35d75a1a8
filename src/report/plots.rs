//! The report's plots as SVG. Black is what the page shows in its own text colour, light or dark.

use std::ops::Range;

use plotters::coord::Shift;
use plotters::prelude::*;

use crate::evaluation::Comparison;
use crate::run_folder::{FrameRecord, KeyframeRecord};

type Drawn = Result<(), Box<dyn std::error::Error>>;
type Area<'a> = DrawingArea<SVGBackend<'a>, Shift>;

const SIZE: (u32, u32) = (560, 320);
const SQUARE: (u32, u32) = (560, 440);
const TRUTH: RGBColor = RGBColor(140, 140, 140);
const LINE: RGBColor = RGBColor(46, 120, 210);
const SECOND: RGBColor = RGBColor(214, 110, 40);
/// Names and colours of the tracker's stages, in their order.
pub const STAGES: [(&str, RGBColor); 5] = [
    ("features", RGBColor(46, 120, 210)),
    ("localise", RGBColor(214, 110, 40)),
    ("map points", RGBColor(70, 160, 90)),
    ("bundle", RGBColor(160, 90, 190)),
    ("loops", RGBColor(190, 160, 40)),
];
/// Bars in a chart of times; frames share them evenly.
const BARS: usize = 80;
const FONT: (&str, u32) = ("sans-serif", 17);

fn svg(size: (u32, u32), draw: impl FnOnce(&Area<'_>) -> Drawn) -> Result<String, String> {
    let mut text = String::new();
    {
        let root = SVGBackend::with_string(&mut text, size).into_drawing_area();
        draw(&root).and_then(|()| Ok(root.present()?)).map_err(|e| e.to_string())?;
    }
    // Labels of axes are rounded, and some round to a negative zero.
    Ok(text.replace("\n-0.0\n", "\n0.0\n"))
}

/// `0..highest` with air above; never empty.
fn from_zero(values: impl Iterator<Item = f64>) -> Range<f64> {
    0.0..1.1 * values.filter(|v| v.is_finite()).fold(1e-6, f64::max)
}

fn around(values: impl Iterator<Item = f64> + Clone) -> Range<f64> {
    let finite = || values.clone().filter(|v| v.is_finite());
    let (low, high) = (finite().fold(f64::INFINITY, f64::min), finite().fold(f64::NEG_INFINITY, f64::max));
    if low > high {
        return 0.0..1.0;
    }
    let air = (0.08 * (high - low)).max(0.05);
    low - air..high + air
}

/// Lines over a common axis; each with its colour.
fn lines(
    [x_name, y_name]: [&str; 2],
    range: Range<f64>,
    series: &[(&[(f64, f64)], RGBColor)],
    dots: bool,
) -> Result<String, String> {
    let end = series.iter().flat_map(|(points, _)| points.iter()).map(|p| p.0).fold(1e-6, f64::max);
    svg(SIZE, |root| {
        let mut chart =
            ChartBuilder::on(root).margin(10).x_label_area_size(40).y_label_area_size(64).build_cartesian_2d(0.0..end, range)?;
        chart
            .configure_mesh()
            .light_line_style(TRANSPARENT)
            .bold_line_style(BLACK.mix(0.12))
            .label_style(FONT)
            .x_desc(x_name)
            .y_desc(y_name)
            .draw()?;
        for (points, color) in series {
            chart.draw_series(LineSeries::new(points.iter().copied(), color.stroke_width(2)))?;
            if dots {
                chart.draw_series(points.iter().map(|p| Circle::new(*p, 2, color.filled())))?;
            }
        }
        Ok(())
    })
}

/// Blue over green to yellow for 0 to 1, equally far apart for the eye (viridis, roughly).
pub fn color_of(share: f64) -> RGBColor {
    const STOPS: [[f64; 3]; 5] =
        [[68.0, 1.0, 84.0], [59.0, 82.0, 139.0], [33.0, 145.0, 140.0], [94.0, 201.0, 98.0], [253.0, 231.0, 37.0]];
    let share = if share.is_nan() { 0.0 } else { share.clamp(0.0, 1.0) };
    let at = share * 4.0;
    let (k, t) = ((at as usize).min(3), at - (at as usize).min(3) as f64);
    let channel = |c: usize| (STOPS[k][c] + t * (STOPS[k + 1][c] - STOPS[k][c])).round() as u8;
    RGBColor(channel(0), channel(1), channel(2))
}

/// The path along axes `(across, up)`, its colour the error, from one frame with truth to the next; the truth in grey.
pub fn path(comparison: &Comparison, across: usize, up: usize, worst_m: f64) -> Result<String, String> {
    const NAMES: [&str; 3] = ["x, metres", "y, metres", "z, metres"];
    let positions: Vec<[f64; 3]> = comparison.poses.iter().map(|p| p.position).collect();
    let extent = |axis: usize| around(positions.iter().chain(&comparison.truth).map(move |p| p[axis]));
    // One scale for both axes.
    let (a, b) = (extent(across), extent(up));
    let (width, height) = (f64::from(SQUARE.0 - 90), f64::from(SQUARE.1 - 60));
    let per_pixel = ((a.end - a.start) / width).max((b.end - b.start) / height);
    let centred = |r: &Range<f64>, pixels: f64| {
        let (middle, half) = ((r.start + r.end) / 2.0, per_pixel * pixels / 2.0);
        middle - half..middle + half
    };
    svg(SQUARE, |root| {
        let mut chart = ChartBuilder::on(root)
            .margin(10)
            .x_label_area_size(40)
            .y_label_area_size(64)
            .build_cartesian_2d(centred(&a, width), centred(&b, height))?;
        chart
            .configure_mesh()
            .light_line_style(TRANSPARENT)
            .bold_line_style(BLACK.mix(0.12))
            .label_style(FONT)
            .x_desc(NAMES[across])
            .y_desc(NAMES[up])
            .draw()?;
        let truth = comparison.truth.iter().map(|p| (p[across], p[up]));
        chart.draw_series(LineSeries::new(truth, TRUTH.mix(0.6).stroke_width(5)))?;
        let mut error_m = None;
        chart.draw_series(comparison.poses.windows(2).map(|pair| {
            error_m = pair[0].error_m.or(error_m);
            let color = error_m.map_or(LINE, |error| color_of(error / worst_m.max(1e-9)));
            PathElement::new(pair.iter().map(|p| (p.position[across], p.position[up])).collect::<Vec<_>>(), color.stroke_width(3))
        }))?;
        Ok(())
    })
}

/// The error in centimetres over the seconds.
pub fn error_over_time(comparison: &Comparison) -> Result<String, String> {
    let start = comparison.poses.first().map_or(0.0, |p| p.timestamp_s);
    let points: Vec<(f64, f64)> =
        comparison.poses.iter().filter_map(|p| Some((p.timestamp_s - start, 100.0 * p.error_m?))).collect();
    lines(["seconds", "error, cm"], from_zero(points.iter().map(|p| p.1)), &[(&points, LINE)], false)
}

/// PSNR of the held-out views over their frames.
pub fn view_quality(comparison: &Comparison) -> Result<String, String> {
    let points: Vec<(f64, f64)> = comparison.views.iter().filter_map(|v| Some((v.frame as f64, v.psnr_db?))).collect();
    lines(["frame", "PSNR, dB"], around(points.iter().map(|p| p.1)), &[(&points, LINE)], true)
}

/// PSNR of the mapper's own views over its keyframes.
pub fn keyframe_quality(keyframes: &[KeyframeRecord]) -> Result<String, String> {
    let points: Vec<(f64, f64)> = numbered(keyframes, |k| f64::from(k.report.psnr_db));
    lines(["keyframe", "PSNR, dB"], around(points.iter().map(|p| p.1)), &[(&points, LINE)], true)
}

/// Thousands of Gaussians over the seconds.
pub fn gaussians(keyframes: &[KeyframeRecord]) -> Result<String, String> {
    let points: Vec<(f64, f64)> = keyframes.iter().map(|k| (k.done_s, k.report.gaussians as f64 / 1e3)).collect();
    lines(["seconds", "Gaussians, thousand"], from_zero(points.iter().map(|p| p.1)), &[(&points, LINE)], true)
}

/// Resident megabytes over the seconds.
pub fn memory(keyframes: &[KeyframeRecord]) -> Result<String, String> {
    let points: Vec<(f64, f64)> = keyframes.iter().filter_map(|k| Some((k.done_s, k.host_bytes? as f64 / 1e6))).collect();
    lines(["seconds", "MB"], from_zero(points.iter().map(|p| p.1)), &[(&points, LINE)], true)
}

/// Seconds that each keyframe took the mapper, and messages that waited meanwhile.
pub fn mapper_load(keyframes: &[KeyframeRecord]) -> Result<String, String> {
    let busy = numbered(keyframes, |k| k.busy_s);
    let waiting = numbered(keyframes, |k| k.waiting as f64);
    let range = from_zero(busy.iter().chain(&waiting).map(|p| p.1));
    lines(["keyframe", "seconds; messages"], range, &[(&busy, LINE), (&waiting, SECOND)], false)
}

fn numbered(keyframes: &[KeyframeRecord], value: impl Fn(&KeyframeRecord) -> f64) -> Vec<(f64, f64)> {
    keyframes.iter().enumerate().map(|(i, k)| (i as f64, value(k))).collect()
}

/// Milliseconds of the tracker's stages, stacked, each bar the mean of some frames.
pub fn stage_times(frames: &[FrameRecord]) -> Result<String, String> {
    let per_bar = frames.len().div_ceil(BARS).max(1);
    let stages = |f: &FrameRecord| {
        let t = &f.times;
        [t.features_ms, t.localise_ms, t.mapping_ms, t.bundle_ms, t.loops_ms]
    };
    let mean = |group: &[FrameRecord]| {
        let mut sums = [0.0; STAGES.len()];
        for times in group.iter().map(stages) {
            sums.iter_mut().zip(times).for_each(|(sum, ms)| *sum += ms / group.len() as f64);
        }
        sums
    };
    let bars: Vec<[f64; STAGES.len()]> = frames.chunks(per_bar).map(mean).collect();
    let range = from_zero(bars.iter().map(|bar| bar.iter().sum()));
    svg(SIZE, |root| {
        let mut chart = ChartBuilder::on(root)
            .margin(10)
            .x_label_area_size(40)
            .y_label_area_size(64)
            .build_cartesian_2d(0.0..frames.len().max(1) as f64, range)?;
        chart
            .configure_mesh()
            .disable_x_mesh()
            .light_line_style(TRANSPARENT)
            .bold_line_style(BLACK.mix(0.12))
            .label_style(FONT)
            .x_desc("frame")
            .y_desc("ms per frame")
            .draw()?;
        for (k, (_, color)) in STAGES.iter().enumerate() {
            chart.draw_series(bars.iter().enumerate().map(|(i, bar)| {
                let below: f64 = bar[..k].iter().sum();
                let (left, right) = ((i * per_bar) as f64, ((i + 1) * per_bar).min(frames.len()) as f64);
                Rectangle::new([(left, below), (right, below + bar[k])], color.filled())
            }))?;
        }
        Ok(())
    })
}

/// The axes along which the path extends, most first.
pub fn axes_by_extent(comparison: &Comparison) -> [usize; 3] {
    let extent = |axis: usize| {
        let range = around(comparison.poses.iter().map(move |p| p.position[axis]));
        range.end - range.start
    };
    let mut axes = [0, 1, 2];
    axes.sort_by(|a, b| extent(*b).total_cmp(&extent(*a)));
    axes
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn colours_run_from_dark_to_bright() {
        let light = |share| {
            let RGBColor(r, g, b) = color_of(share);
            u32::from(r) + u32::from(g) + u32::from(b)
        };
        assert!((0..10).all(|i| light(f64::from(i) / 10.0) < light(f64::from(i + 1) / 10.0)));
        assert_eq!(color_of(f64::NAN), color_of(0.0));
    }

    #[test]
    fn nothing_to_draw_is_drawn_too() {
        assert!(stage_times(&[]).unwrap().starts_with("<svg"));
        assert!(gaussians(&[]).unwrap().starts_with("<svg"));
        assert!(path(&Comparison::default(), 0, 1, 0.0).unwrap().starts_with("<svg"));
    }
}
