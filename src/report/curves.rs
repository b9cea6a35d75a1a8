//! Time against error as SVG: one panel a figure, one colour a sequence; what nobody undercuts is filled and joined.

use plotters::prelude::*;

use super::names;
use super::sweep::{Figure, Point, Spread, pareto};

const PANEL: (u32, u32) = (460, 380);
/// Room for the names of the sequences.
const LEGEND: u32 = 28;
const COLORS: [RGBColor; 6] = [
    RGBColor(46, 120, 210),
    RGBColor(214, 110, 40),
    RGBColor(70, 160, 90),
    RGBColor(160, 90, 190),
    RGBColor(190, 160, 40),
    RGBColor(90, 90, 90),
];

type Drawn = Result<(), Box<dyn std::error::Error>>;
type Area<'a> = DrawingArea<SVGBackend<'a>, plotters::coord::Shift>;

/// Whole-run time against ATE, held-out PSNR and Gaussians; white behind it.
///
/// # Errors
/// The text of the drawing library, if it cannot draw.
pub fn draw(points: &[Point]) -> Result<String, String> {
    const PANELS: [Figure; 3] = [Figure::Ate, Figure::Psnr, Figure::Gaussians];
    let mut svg = String::new();
    {
        let root = SVGBackend::with_string(&mut svg, (PANEL.0 * 3, PANEL.1 + LEGEND)).into_drawing_area();
        let drawn = || -> Drawn {
            root.fill(&WHITE)?;
            let (above, below) = root.split_vertically(LEGEND);
            let mut x = 12;
            for (sequence, color) in sequences(points) {
                above.draw(&Rectangle::new([(x, 9), (x + 12, 21)], color.filled()))?;
                above.draw(&Text::new(sequence.to_owned(), (x + 18, 7), ("sans-serif", 16)))?;
                x += 40 + 9 * sequence.len() as i32;
            }
            for (area, figure) in below.split_evenly((1, 3)).iter().zip(PANELS) {
                panel(area, points, figure)?;
            }
            Ok(root.present()?)
        };
        drawn().map_err(|e| e.to_string())?;
    }
    Ok(svg)
}

fn sequences(points: &[Point]) -> Vec<(&str, RGBColor)> {
    names(points, |point| &point.sequence).into_iter().zip(COLORS.into_iter().cycle()).collect()
}

fn panel(area: &Area<'_>, points: &[Point], figure: Figure) -> Drawn {
    let values: Vec<(&Point, Spread)> = points.iter().filter_map(|p| Some((p, figure.of(p)?))).collect();
    let range = |of: &dyn Fn(&(&Point, Spread)) -> [f64; 2]| {
        let all = || values.iter().flat_map(of);
        let (low, high) = (all().fold(f64::INFINITY, f64::min), all().fold(0.0, f64::max));
        (if low.is_finite() { low } else { 0.0 }, high)
    };
    let (_, end) = range(&|(p, _)| [p.wall_s.least, p.wall_s.most]);
    let (low, high) = range(&|(_, s)| [s.least, s.most]);
    let air = (0.1 * (high - low)).max(0.02 * high).max(1e-6);
    let bottom = if figure == Figure::Psnr { low - air } else { 0.0 };
    let mut chart = ChartBuilder::on(area)
        .margin(10)
        .caption(figure.name(), ("sans-serif", 18))
        .x_label_area_size(40)
        .y_label_area_size(60)
        .build_cartesian_2d(0.0..1.08 * end.max(1e-3), bottom..high + air)?;
    chart
        .configure_mesh()
        .light_line_style(TRANSPARENT)
        .bold_line_style(BLACK.mix(0.12))
        .label_style(("sans-serif", 14))
        .x_desc("whole run, s")
        .draw()?;
    for (sequence, color) in sequences(points) {
        let own: Vec<&(&Point, Spread)> = values.iter().filter(|(p, _)| p.sequence == sequence).collect();
        let at = |(p, s): &(&Point, Spread)| (p.wall_s.median, s.median);
        let costs: Vec<(f64, f64)> = own.iter().map(|v| (at(v).0, figure.cost(at(v).1))).collect();
        let front = pareto(&costs);
        let mut joined: Vec<(f64, f64)> = own.iter().zip(&front).filter(|(_, on)| **on).map(|(v, _)| at(v)).collect();
        joined.sort_by(|a, b| a.0.total_cmp(&b.0));
        chart.draw_series(LineSeries::new(joined, color.stroke_width(2)))?;
        for ((p, s), on) in own.iter().zip(front) {
            let middle = (p.wall_s.median, s.median);
            chart.draw_series([
                PathElement::new(vec![(middle.0, s.least), (middle.0, s.most)], color.stroke_width(1)),
                PathElement::new(vec![(p.wall_s.least, middle.1), (p.wall_s.most, middle.1)], color.stroke_width(1)),
            ])?;
            let style = if on { color.filled() } else { color.stroke_width(2) };
            chart.draw_series([Circle::new(middle, 4, style)])?;
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_point_is_drawn_and_fronts_are_joined() {
        let exactly = |v: f64| Spread { median: v, least: v, most: v };
        let point = |sequence: &str, wall: f64, psnr: f64| Point {
            sequence: sequence.into(),
            variant: "v".into(),
            runs: 1,
            wall_s: exactly(wall),
            ate_cm: None,
            psnr_db: Some(exactly(psnr)),
            gaussians: Some(exactly(1e4)),
        };
        let svg = draw(&[point("a", 10.0, 25.0), point("a", 20.0, 27.0), point("b", 15.0, 22.0)]).unwrap();
        assert!(svg.contains("\na\n") && svg.contains("\nb\n"));
        assert_eq!(svg.matches("<circle").count(), 6);
        assert!(draw(&[]).is_ok());
    }
}
