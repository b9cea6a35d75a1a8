//! Pictures of a trajectory: its path beside the true one, and its error over time, as SVG.

use plotters::coord::Shift;
use plotters::prelude::*;

use super::trajectory::{MAX_TIME_DIFFERENCE_S, TrajectoryErrors, associate};
use crate::geometry::Trajectory;

const SIZE: (u32, u32) = (900, 760);
const PATH_HEIGHT: u32 = 500;
const TRUTH: RGBColor = RGBColor(130, 130, 130);
const ESTIMATE: RGBColor = RGBColor(20, 90, 200);
const ERROR: RGBColor = RGBColor(200, 60, 40);

/// The path as seen along the axis in which it extends least, truth in grey, and below it the error in centimetres over time.
///
/// # Errors
/// The text of the drawing library, if it cannot draw.
pub fn draw_trajectory(truth: &Trajectory, estimate: &Trajectory, errors: &TrajectoryErrors) -> Result<String, String> {
    let aligned: Vec<[f64; 3]> = estimate
        .poses
        .iter()
        .map(|p| errors.alignment.act(&p.world_from_camera.translation.vector.into()).coords.into())
        .collect();
    let real: Vec<[f64; 3]> = truth.poses.iter().map(|p| p.world_from_camera.translation.vector.into()).collect();
    let pairs = associate(truth, estimate, MAX_TIME_DIFFERENCE_S);
    let error = |a: &[f64; 3], b: &[f64; 3]| a.iter().zip(b).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt();
    let start = estimate.poses.first().map_or(0.0, |p| p.timestamp_s);
    let mut over_time: Vec<(f64, f64)> = pairs
        .iter()
        .map(|p| (estimate.poses[p.estimate].timestamp_s - start, 100.0 * error(&aligned[p.estimate], &real[p.truth])))
        .collect();
    over_time.sort_by(|a, b| a.0.total_cmp(&b.0));
    let mut svg = String::new();
    {
        let root = SVGBackend::with_string(&mut svg, SIZE).into_drawing_area();
        draw(&root, &real, &aligned, &over_time, errors.ate_rmse_m).map_err(|e| e.to_string())?;
    }
    Ok(svg)
}

type Drawn = Result<(), Box<dyn std::error::Error>>;
type Area<'a> = DrawingArea<SVGBackend<'a>, Shift>;

fn draw(root: &Area<'_>, truth: &[[f64; 3]], estimate: &[[f64; 3]], errors: &[(f64, f64)], ate_metres: f64) -> Drawn {
    root.fill(&WHITE)?;
    let (above, below) = root.split_vertically(PATH_HEIGHT);
    draw_paths(&above, truth, estimate)?;
    let end = errors.iter().map(|e| e.0).fold(1e-3, f64::max);
    let highest = errors.iter().map(|e| e.1).fold(1e-3, f64::max) * 1.1;
    let mut chart = ChartBuilder::on(&below)
        .margin(12)
        .caption(format!("error over time: RMSE {:.2} cm", 100.0 * ate_metres), ("sans-serif", 16))
        .x_label_area_size(34)
        .y_label_area_size(56)
        .build_cartesian_2d(0.0..end, 0.0..highest)?;
    chart.configure_mesh().light_line_style(TRANSPARENT).x_desc("seconds").y_desc("cm").draw()?;
    chart.draw_series(LineSeries::new(errors.iter().copied(), ERROR.stroke_width(2)))?;
    root.present()?;
    Ok(())
}

fn draw_paths(area: &Area<'_>, truth: &[[f64; 3]], estimate: &[[f64; 3]]) -> Drawn {
    let (a, b) = widest_axes(truth, estimate);
    let both = || truth.iter().chain(estimate);
    let range = |axis: usize| {
        let values = || both().map(move |p| p[axis]);
        (values().fold(f64::INFINITY, f64::min), values().fold(f64::NEG_INFINITY, f64::max))
    };
    // One scale for both axes.
    let (width, height) = area.dim_in_pixel();
    let per_pixel = 1.15
        * ((range(a).1 - range(a).0) / f64::from(width - 100)).max((range(b).1 - range(b).0) / f64::from(height - 80)).max(1e-6);
    let span = |axis: usize, pixels: u32| {
        let (low, high) = range(axis);
        let (middle, half) = ((low + high) / 2.0, per_pixel * f64::from(pixels) / 2.0);
        middle - half..middle + half
    };
    const NAMES: [&str; 3] = ["x, metres", "y, metres", "z, metres"];
    let mut chart = ChartBuilder::on(area)
        .margin(12)
        .caption("true path (grey) and estimated path (blue), aligned", ("sans-serif", 16))
        .x_label_area_size(34)
        .y_label_area_size(56)
        .build_cartesian_2d(span(a, width - 100), span(b, height - 80))?;
    chart.configure_mesh().light_line_style(TRANSPARENT).x_desc(NAMES[a]).y_desc(NAMES[b]).draw()?;
    let line = |points: &[[f64; 3]]| points.iter().map(|p| (p[a], p[b])).collect::<Vec<_>>();
    chart.draw_series(LineSeries::new(line(truth), TRUTH.stroke_width(5)))?;
    chart.draw_series(LineSeries::new(line(estimate), ESTIMATE.stroke_width(2)))?;
    Ok(())
}

/// The two axes along which the paths extend most, in order.
fn widest_axes(truth: &[[f64; 3]], estimate: &[[f64; 3]]) -> (usize, usize) {
    let extent = |axis: usize| {
        let values = || truth.iter().chain(estimate).map(move |p| p[axis]);
        values().fold(f64::NEG_INFINITY, f64::max) - values().fold(f64::INFINITY, f64::min)
    };
    let narrowest = (0..3).min_by(|a, b| extent(*a).total_cmp(&extent(*b))).unwrap_or(2);
    [(1, 2), (0, 2), (0, 1)][narrowest]
}

#[cfg(test)]
mod tests {
    use super::super::{Alignment, evaluate_trajectory};
    use super::*;
    use crate::geometry::{Se3, StampedPose};

    #[test]
    fn a_path_and_its_error_are_drawn() {
        let path = |wobble: f64| Trajectory {
            poses: (0..40)
                .map(|i| {
                    let t = f64::from(i) * 0.1;
                    let wobble = wobble * (7.0 * t).sin();
                    StampedPose { timestamp_s: t, world_from_camera: Se3::translation(t.cos() + wobble, 0.1 * t, 2.0 * t.sin()) }
                })
                .collect(),
        };
        let (truth, estimate) = (path(0.0), path(0.02));
        let errors = evaluate_trajectory(&truth, &estimate, Alignment::Rigid).unwrap();
        let svg = draw_trajectory(&truth, &estimate, &errors).unwrap();
        assert!(svg.starts_with("<svg") && svg.trim_end().ends_with("</svg>"));
        assert!(svg.contains("seconds") && svg.contains("z, metres") && svg.matches("<polyline").count() >= 3);
        let still = Trajectory { poses: truth.poses[..3].to_vec() };
        let errors = evaluate_trajectory(&still, &still, Alignment::Rigid).unwrap();
        assert!(draw_trajectory(&still, &still, &errors).is_ok());
    }
}
