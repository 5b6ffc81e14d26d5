//! Charts of the report, each a list of pictures, which is empty where there is nothing to show: the form
//! that all of them have, and those of success rates and latency.

use kuva::plot::line::LineStyle;
use kuva::plot::{BarPlot, Histogram, LinePlot};
use kuva::render::layout::Layout;
use kuva::render::plots::Plot;

use super::Report;
use lads_proof::metrics::{Interval, Score};

/// Colours that stay apart for most eyes (Okabe and Ito), darkest first.
pub const COLORS: [&str; 6] = [
    "#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9",
];

/// Number of bars of the latency histogram.
const BINS: usize = 40;

/// Width of a chart that shares its row with another, in pixels.
pub const HALF: f64 = 560.0;

/// Width of a chart that has a row to itself, in pixels.
pub const WHOLE: f64 = 900.0;

/// Largest factor by which the page may enlarge a chart.
const ENLARGED: f64 = 1.3;

/// Smallest factor by which the page may reduce a chart; a narrower page lets it be pushed aside. Its smallest letters are 11 pixels high
/// as laid out.
const REDUCED: f64 = 0.85;

/// A chart with its texts.
pub struct Chart {
    /// SVG text of the chart.
    pub svg: String,
    /// Whether the chart takes a row to itself.
    pub wide: bool,
    /// Completions that are marked in the chart, explained below it.
    pub marks: Vec<Mark>,
    /// What the colours stand for, listed below a chart that has no room for a legend.
    pub key: Vec<Key>,
    /// Remark below the chart.
    pub note: String,
}

/// What a colour of a chart stands for.
pub struct Key {
    /// The colour, as CSS has it.
    pub color: &'static str,
    /// Sign of what is drawn in it, a character.
    pub sign: &'static str,
    /// What it stands for.
    pub text: String,
}

/// A completion that is marked in a timeline.
pub struct Mark {
    /// Number of the completion in the chart.
    pub number: usize,
    /// Name of the sub-task.
    pub name: String,
    /// Control step of the completion.
    pub step: usize,
    /// Whether the instruction commands the sub-task.
    pub asked: bool,
}

/// Renders plots as a chart that the page can scale.
pub fn chart(plots: Vec<Plot>, layout: Layout) -> Chart {
    let (width, height) = (layout.width.unwrap_or(HALF), layout.height.unwrap_or(HALF));
    let svg = kuva::render_to_svg(plots, layout);
    // With it, the page may show the picture in any size, but letters no larger than the page's.
    let (least, most) = (REDUCED * width, ENLARGED * width);
    let size = format!("min-width:{least}px;max-width:{most}px");
    let scalable = format!("<svg viewBox=\"0 0 {width} {height}\" style=\"{size}\" ");
    Chart {
        svg: svg.replacen("<svg ", &scalable, 1),
        wide: width > HALF,
        marks: Vec::new(),
        key: Vec::new(),
        note: String::new(),
    }
}

/// Lays out plots with a title, in the size and letters of the page.
pub fn sized(plots: &[Plot], title: &str, width: f64, height: f64) -> Layout {
    Layout::auto_from_plots(plots)
        .with_title(title)
        .with_title_size(15)
        .with_label_size(13)
        .with_tick_size(11)
        .with_width(width)
        .with_height(height)
}

/// A line of a chart of K-rates, or a bar of one of success.
pub struct Series<'s> {
    /// Name in the legend.
    pub name: &'s str,
    /// Scores of the episodes.
    pub score: &'s Score,
}

/// Arms of an interval below and above its rate.
fn arms(rate: f64, Interval(low, high): Interval) -> (f64, f64) {
    ((rate - low).max(0.0), (high - rate).max(0.0))
}

/// Draws the K-rates up to `most`, Figure 3 of the paper: one line for each of the series, told apart by colour, then by dashes.
pub fn k_rates(title: &str, series: &[Series<'_>], most: usize) -> Vec<Chart> {
    // Short, so that the legend's little lines show them.
    let dash = |dashes: &str| LineStyle::Custom(dashes.to_owned());
    let dashes = [LineStyle::Solid, dash("4 3"), dash("1.5 3")];
    let places = series.len().max(2) as f64 - 1.0;
    let plots: Vec<Plot> = series
        .iter()
        .enumerate()
        .map(|(place, Series { name, score })| {
            // Intervals of the series stand side by side.
            let aside = place as f64 * (0.3 / places).min(0.04);
            let rates = score.k_rate.into_iter().zip(score.k_rate_interval);
            let points: Vec<(f64, f64, Interval)> = (1..)
                .zip(rates.take(most))
                .filter_map(|(k, (rate, bounds))| Some((f64::from(k) + aside, rate?, bounds)))
                .collect();
            let ends = points.iter().map(|&(_, rate, bounds)| arms(rate, bounds));
            let dash = dashes[place / COLORS.len() % dashes.len()].clone();
            LinePlot::new()
                .with_color(COLORS[place % COLORS.len()])
                .with_line_style(dash)
                .with_data(points.iter().map(|&(k, rate, _)| (k, rate)))
                .with_y_err_asymmetric(ends)
                .with_stroke_width(2.5)
                .with_legend(*name)
                .into()
        })
        .collect();
    if plots.is_empty() {
        return Vec::new();
    }
    let layout = sized(&plots, title, WHOLE, 360.0)
        .with_x_label("K")
        .with_y_label("K-rate")
        .with_x_tick_step(1.0)
        .with_y_axis_min(0.0)
        .with_x_axis_min(0.8)
        .with_x_axis_max(most as f64 + 0.4)
        .with_y_axis_max(1.02);
    vec![chart(plots, layout)]
}

/// Draws the rates of full success as bars with their intervals, for instructions with one sub-task each.
pub fn successes(title: &str, series: &[Series<'_>]) -> Vec<Chart> {
    let rates = series.iter().filter_map(|Series { name, score }| {
        let rate = score.full_success?;
        Some((*name, rate, arms(rate, score.full_success_interval)))
    });
    let rates: Vec<_> = rates.collect();
    if rates.is_empty() {
        return Vec::new();
    }
    let colored: Vec<_> = rates.iter().zip(COLORS.iter().cycle()).collect();
    // The first of the series on top.
    let bars = colored.iter().rev();
    let bars = bars.map(|&(&(name, rate, _), &color)| (name, rate, color));
    let plots: Vec<Plot> = vec![
        BarPlot::new()
            .with_colored_bars(bars)
            .with_asymmetric_error(rates.iter().rev().map(|&(_, _, arms)| arms))
            .with_horizontal(true)
            .into(),
    ];
    let height = 110.0 + 34.0 * rates.len() as f64;
    let layout = sized(&plots, title, WHOLE, height)
        .with_x_label("success rate")
        .with_x_axis_min(0.0)
        .with_x_axis_max(1.0);
    vec![chart(plots, layout)]
}

/// A point of a curve: where it stands, its value and the interval of that.
pub type Point = (f64, f64, Interval);

/// Draws values by a size, Figure 6 of the paper: one line for each of the named curves; `None` without any.
pub fn curves(size: &str, measure: &str, curves: &[(&str, Vec<Point>)]) -> Option<Chart> {
    let plots: Vec<Plot> = curves
        .iter()
        .zip(COLORS.iter().cycle())
        .map(|((name, points), &color)| {
            LinePlot::new()
                .with_color(color)
                .with_data(points.iter().map(|&(x, value, _)| (x, value)))
                .with_y_err_asymmetric(points.iter().map(|&(_, value, bounds)| arms(value, bounds)))
                .with_stroke_width(2.5)
                .with_legend(*name)
                .into()
        })
        .collect();
    let layout = sized(&plots, size, HALF, 340.0)
        .with_x_label(size)
        .with_y_label(measure)
        .with_x_axis_min(0.0)
        .with_y_axis_min(0.0);
    (!plots.is_empty()).then(|| chart(plots, layout))
}

/// Rounds `value` up to the next number that is easy to read: 1, 2, 2.5 or 5 times a power of ten.
fn round_up(value: f64) -> f64 {
    let power = 10_f64.powf(value.max(f64::MIN_POSITIVE).log10().floor());
    let easy = [1.0, 2.0, 2.5, 5.0].map(|step| step * power);
    let next = easy.into_iter().find(|&easy| easy >= value);
    next.unwrap_or(10.0 * power)
}

/// Draws a histogram of all control steps by duration.
pub fn latency(report: &Report<'_>) -> Vec<Chart> {
    let steps = report.traces.iter().flat_map(|trace| &trace.steps);
    let mut all: Vec<f64> = steps
        .clone()
        .map(|s| s.controller_ns as f64 / 1e3)
        .collect();
    all.sort_by(f64::total_cmp);
    let quantile = |percent: usize| all.get(all.len().saturating_sub(1) * percent / 100);
    let (Some(&usual), Some(&most)) = (quantile(50), quantile(99)) else {
        return Vec::new();
    };
    // A machine that does other work has steps that are hundreds of times slower; the usual ones are what there is to see.
    let edge = 4.0 * round_up(most.min(8.0 * usual) / 4.0);
    let beyond = all.iter().filter(|&&us| us > edge).count();
    let of_kind = |decided: bool, name: &str, color: &str| -> Plot {
        let of_kind = steps.clone().filter(|step| step.decided == decided);
        let durations = of_kind.map(|step| step.controller_ns as f64 / 1e3);
        Histogram::new()
            .with_data(durations.filter(|&us| us <= edge))
            .with_bins(BINS)
            .with_range((0.0, edge))
            .with_color(color)
            .with_legend(name.to_owned())
            .into()
    };
    let plots = vec![
        of_kind(false, "ordinary step", COLORS[5]),
        of_kind(true, "decision step", COLORS[1]),
    ];
    let layout = sized(&plots, "Duration of a control step", WHOLE, 340.0)
        .with_x_label("duration (µs)")
        .with_y_label("control steps");
    let note = match beyond {
        0 => String::new(),
        _ => format!("{beyond} of {} steps lie beyond the right edge.", all.len()),
    };
    vec![Chart {
        note,
        ..chart(plots, layout)
    }]
}

#[cfg(test)]
mod tests {
    use super::round_up;

    #[test]
    fn numbers_are_rounded_up_to_easy_ones() {
        for (value, easy) in [(1051.6, 2000.0), (80.0, 100.0), (0.21, 0.25), (5.0, 5.0)] {
            assert!((round_up(value) - easy).abs() < 1e-9 * easy, "{value}");
        }
    }
}
