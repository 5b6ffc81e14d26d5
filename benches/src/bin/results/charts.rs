//! Charts of the results page, as SVG.

use kuva::backend::svg::SvgBackend;
use kuva::plot::LinePlot;
use kuva::render::layout::Layout;
use kuva::render::plots::Plot;
use kuva::render::render::render_multiple;

/// Line colours, one per contender, readable on white for colour-blind people too.
const COLOURS: [&str; 8] = [
    "#0072b2", "#56b4e9", "#d55e00", "#e69f00", "#009e73", "#cc79a7", "#999999", "#000000",
];

/// Name of a line, and its points.
pub type Line = (String, Vec<(f64, f64)>);

/// Draws lines over a common axis.
pub fn lines(title: &str, x: &str, y: &str, lines: &[Line], log: bool) -> String {
    let plots: Vec<Plot> = lines
        .iter()
        .zip(COLOURS.iter().cycle())
        .filter(|((_, points), _)| !points.is_empty())
        .map(|((name, points), colour)| {
            let line = LinePlot::new()
                .with_data(points.clone())
                .with_color(*colour);
            Plot::Line(line.with_stroke_width(2.0).with_legend(name.as_str()))
        })
        .collect();
    let layout = Layout::auto_from_plots(&plots)
        .with_title(title)
        .with_x_label(x)
        .with_y_label(y);
    let layout = if log {
        layout.with_log_scale()
    } else {
        layout.with_log_y()
    };
    SvgBackend.render_scene(&render_multiple(plots, layout))
}

/// Computes the share of calls that took longer than so many microseconds, for one contender.
pub fn tail(took_us: &mut [f64]) -> Vec<(f64, f64)> {
    took_us.sort_by(f64::total_cmp);
    let count = took_us.len() as f64;
    let share = |i: usize| (count - i as f64) / count;
    took_us
        .iter()
        .enumerate()
        .map(|(i, &x)| (x, share(i)))
        .collect()
}
