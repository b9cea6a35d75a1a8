//! Pictures of a trajectory: its path beside the true one, and its error over time, as SVG.

use std::ops::Range;

use plotters::coord::Shift;
use plotters::prelude::*;

use super::trajectory::{MAX_TIME_DIFFERENCE_S, TrajectoryErrors, associate};
use crate::geometry::Trajectory;

const SIZE: (u32, u32) = (900, 760);
const PATH_HEIGHT: u32 = 500;
/// Pixels beside and above a plot, for its labels.
const MARGINS: (u32, u32) = (80, 80);
/// Of a plot's range to the path's.
const MARGIN: f64 = 1.15;
/// Scale of a path that stands still.
const LEAST_METRES_PER_PIXEL: f64 = 1e-6;
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
    let over_time = error_over_time(truth, estimate, &real, &aligned);
    let mut svg = String::new();
    {
        let root = SVGBackend::with_string(&mut svg, SIZE).into_drawing_area();
        draw(&root, &real, &aligned, &over_time, errors.ate_rmse_m).map_err(|e| e.to_string())?;
    }
    Ok(svg)
}

/// Distance of each associated pose in centimetres, by seconds since the estimate's first pose, ascending.
fn error_over_time(truth: &Trajectory, estimate: &Trajectory, real: &[[f64; 3]], aligned: &[[f64; 3]]) -> Vec<(f64, f64)> {
    let distance = |a: &[f64; 3], b: &[f64; 3]| a.iter().zip(b).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt();
    let start = estimate.poses.first().map_or(0.0, |p| p.timestamp_s);
    let mut errors: Vec<(f64, f64)> = associate(truth, estimate, MAX_TIME_DIFFERENCE_S)
        .iter()
        .map(|p| (estimate.poses[p.estimate].timestamp_s - start, 100.0 * distance(&aligned[p.estimate], &real[p.truth])))
        .collect();
    errors.sort_by(|a, b| a.0.total_cmp(&b.0));
    errors
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
    let (width, height) = area.dim_in_pixel();
    let plot = [width - MARGINS.0, height - MARGINS.1];
    let [across, up] = equal_spans(truth, estimate, [a, b], plot);
    const NAMES: [&str; 3] = ["x, metres", "y, metres", "z, metres"];
    let mut chart = ChartBuilder::on(area)
        .margin(12)
        .caption("true path (grey) and estimated path (blue), aligned", ("sans-serif", 16))
        .x_label_area_size(34)
        .y_label_area_size(56)
        .build_cartesian_2d(across, up)?;
    chart.configure_mesh().light_line_style(TRANSPARENT).x_desc(NAMES[a]).y_desc(NAMES[b]).draw()?;
    let line = |points: &[[f64; 3]]| points.iter().map(|p| (p[a], p[b])).collect::<Vec<_>>();
    chart.draw_series(LineSeries::new(line(truth), TRUTH.stroke_width(5)))?;
    chart.draw_series(LineSeries::new(line(estimate), ESTIMATE.stroke_width(2)))?;
    Ok(())
}

/// Ranges in metres along the two `axes` that hold both paths with a margin, at one scale on a plot of so many pixels.
fn equal_spans(truth: &[[f64; 3]], estimate: &[[f64; 3]], axes: [usize; 2], plot: [u32; 2]) -> [Range<f64>; 2] {
    let extents = axes.map(|axis| {
        let values = || truth.iter().chain(estimate).map(move |p| p[axis]);
        (values().fold(f64::INFINITY, f64::min), values().fold(f64::NEG_INFINITY, f64::max))
    });
    let per_pixel = extents.iter().zip(plot).map(|((low, high), pixels)| (high - low) / f64::from(pixels));
    let per_pixel = (MARGIN * per_pixel.fold(0.0, f64::max)).max(LEAST_METRES_PER_PIXEL);
    [0, 1].map(|i| {
        let middle = (extents[i].0 + extents[i].1) / 2.0;
        let half = per_pixel * f64::from(plot[i]) / 2.0;
        middle - half..middle + half
    })
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

    fn path(wobble: f64) -> Trajectory {
        let pose = |i: i32| {
            let t = f64::from(i) * 0.1;
            let wobble = wobble * (7.0 * t).sin();
            StampedPose { timestamp_s: 5.0 + t, world_from_camera: Se3::translation(t.cos() + wobble, 0.1 * t, 2.0 * t.sin()) }
        };
        Trajectory { poses: (0..40).map(pose).collect() }
    }

    fn points(trajectory: &Trajectory) -> Vec<[f64; 3]> {
        trajectory.poses.iter().map(|p| p.world_from_camera.translation.vector.into()).collect()
    }

    /// The points of the SVG's polylines of a colour, pixels.
    fn polylines(svg: &str, color: RGBColor) -> Vec<Vec<(f64, f64)>> {
        let stroke = format!("stroke=\"#{:02X}{:02X}{:02X}\"", color.0, color.1, color.2);
        let point = |p: &str| p.split_once(',').map(|(x, y)| (x.parse().unwrap(), y.parse().unwrap())).unwrap();
        let line =
            |l: &str| l.split("points=\"").nth(1).unwrap().split('"').next().unwrap().split_whitespace().map(point).collect();
        svg.lines().filter(|l| l.starts_with("<polyline") && l.contains(&stroke)).map(line).collect()
    }

    fn extent(points: &[(f64, f64)]) -> [f64; 4] {
        let of = |value: fn(&(f64, f64)) -> f64| {
            let values = || points.iter().map(value);
            (values().fold(f64::INFINITY, f64::min), values().fold(f64::NEG_INFINITY, f64::max))
        };
        let (x, y) = (of(|p| p.0), of(|p| p.1));
        [x.0, x.1, y.0, y.1]
    }

    #[test]
    fn a_path_and_its_error_are_drawn() {
        let (truth, estimate) = (path(0.0), path(0.02));
        let errors = evaluate_trajectory(&truth, &estimate, Alignment::Rigid).unwrap();
        let svg = draw_trajectory(&truth, &estimate, &errors).unwrap();
        assert!(svg.starts_with("<svg") && svg.trim_end().ends_with("</svg>"));
        assert!(svg.contains("x, metres") && svg.contains("z, metres") && !svg.contains("y, metres") && svg.contains("seconds"));
        assert!(svg.contains(&format!("RMSE {:.2} cm", 100.0 * errors.ate_rmse_m)));
        // The path is 2 m wide along x and 2 + 2 sin(0.76) m along z: one scale, above the error, inside the picture.
        let [drawn_truth, drawn_estimate] = [TRUTH, ESTIMATE].map(|color| extent(&polylines(&svg, color)[0]));
        let [left, right, top, bottom] = drawn_truth;
        assert!(((bottom - top) / (right - left) - 1.687).abs() < 0.02, "{drawn_truth:?}");
        assert!(left > 56.0 && right < f64::from(SIZE.0) && top > 12.0 && bottom < f64::from(PATH_HEIGHT));
        assert!(bottom - top > 0.7 * f64::from(PATH_HEIGHT - MARGINS.1), "it fills its plot");
        assert!(drawn_truth.iter().zip(drawn_estimate).all(|(a, b)| (a - b).abs() < 10.0), "{drawn_estimate:?}");
        let [left, right, top, bottom] = extent(&polylines(&svg, ERROR)[0]);
        assert!(top > f64::from(PATH_HEIGHT) && bottom < f64::from(SIZE.1) && left > 56.0);
        assert!(right > 0.95 * f64::from(SIZE.0), "over the whole time");
        assert!((148.0..166.0).contains(&(bottom - top)), "the highest is a tenth below the plot's edge: {top} to {bottom}");
    }

    #[test]
    fn a_camera_that_stands_still_is_drawn() {
        let still = Trajectory { poses: path(0.0).poses[..3].to_vec() };
        let errors = evaluate_trajectory(&still, &still, Alignment::Rigid).unwrap();
        assert!(draw_trajectory(&still, &still, &errors).is_ok());
        let spans = equal_spans(&[[1.0; 3]], &[[1.0; 3]], [0, 2], [200, 100]);
        assert_eq!(spans, [1.0 - 1e-4..1.0 + 1e-4, 1.0 - 5e-5..1.0 + 5e-5]);
    }

    #[test]
    fn errors_are_centimetres_by_seconds_in_order() {
        let truth = path(0.0);
        let mut moved = truth.clone();
        moved.poses.truncate(3);
        moved.poses[1].world_from_camera.translation.vector.y += 0.03;
        moved.poses[2].world_from_camera.translation.vector.x += 0.04;
        moved.poses[2].world_from_camera.translation.vector.z -= 0.03;
        let errors = error_over_time(&truth, &moved, &points(&truth), &points(&moved));
        let expected = [(0.0, 0.0), (0.1, 3.0), (0.2, 5.0)];
        assert_eq!(errors.len(), 3);
        assert!(errors.iter().zip(expected).all(|(a, b)| (a.0 - b.0).abs() < 1e-9 && (a.1 - b.1).abs() < 1e-9), "{errors:?}");
    }

    #[test]
    fn both_paths_fit_their_plot_at_one_scale() {
        // 4 m by 1 m on 400 by 300 pixels: x decides.
        let spans = equal_spans(&[[0.0, 7.0, 1.0], [3.0, 7.0, 2.0]], &[[-1.0, 9.0, 1.5]], [0, 2], [400, 300]);
        let expected = [1.0 - 2.3..1.0 + 2.3, 1.5 - 1.725..1.5 + 1.725];
        let near = |a: &Range<f64>, b: &Range<f64>| (a.start - b.start).abs() < 1e-9 && (a.end - b.end).abs() < 1e-9;
        assert!(spans.iter().zip(&expected).all(|(a, b)| near(a, b)), "{spans:?}");
    }

    #[test]
    fn the_path_is_seen_along_its_narrowest_axis() {
        let along = |extent: [f64; 3]| widest_axes(&[[1.0, 1.0, 1.0]], &[[1.0 + extent[0], 1.0 + extent[1], 1.0 + extent[2]]]);
        assert_eq!(along([1.0, 2.0, 3.0]), (1, 2));
        assert_eq!(along([2.0, -1.0, 3.0]), (0, 2));
        assert_eq!(along([-3.0, 2.0, 1.0]), (0, 1));
    }
}
