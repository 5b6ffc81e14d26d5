//! Charts of the report, each a list of pictures; an empty list where there is nothing to show.

use std::collections::{BTreeMap, BTreeSet};

use kuva::plot::scatter3d::Scatter3DPlot;
use kuva::plot::{BarPlot, ColorMap, Heatmap, Histogram, LegendPosition, LinePlot};
use kuva::render::annotations::ReferenceLine;
use kuva::render::layout::Layout;
use kuva::render::plots::Plot;

use super::Report;
use crate::results::Results;
use crate::trace::Trace;
use lads_proof::metrics::Interval;

/// Colours that stay apart for most eyes (Okabe and Ito), darkest first.
const COLORS: [&str; 6] = [
    "#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9",
];

/// Completions that are nearer than this share of an episode have one label in a timeline.
const TOGETHER: f64 = 0.04;

/// Vertical room above the plans of a timeline for the numbers of completions, as a factor.
const HEADROOM: f64 = 1.12;

/// Colour of completions that nobody asked for.
const UNASKED: &str = "#777777";

/// Number of bars of the latency histogram.
const BINS: usize = 40;

/// Width of a chart that shares its row with another, in pixels.
const HALF: f64 = 560.0;

/// Width of a chart that has a row to itself, in pixels.
const WHOLE: f64 = 900.0;

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
    /// Remark below the chart.
    pub note: String,
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

fn chart(plots: Vec<Plot>, layout: Layout) -> Chart {
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
        note: String::new(),
    }
}

fn sized(plots: &[Plot], title: &str, width: f64, height: f64) -> Layout {
    Layout::auto_from_plots(plots)
        .with_title(title)
        .with_title_size(15)
        .with_label_size(13)
        .with_tick_size(11)
        .with_width(width)
        .with_height(height)
}

/// Draws the K-rates, Figure 3 of the paper.
pub fn k_rates(results: &Results) -> Vec<Chart> {
    let splits = results.splits.0.iter();
    let splits = splits.filter(|(_, result)| result.score.episodes > 0);
    let plots: Vec<Plot> = splits
        .zip(COLORS)
        .enumerate()
        .map(|(place, ((name, result), color))| {
            let score = &result.score;
            // Intervals of splits stand side by side.
            let aside = 0.04 * place as f64;
            let points: Vec<(f64, f64, Interval)> = (1..)
                .zip(score.k_rate.into_iter().zip(score.k_rate_interval))
                .filter_map(|(k, (rate, bounds))| Some((f64::from(k) + aside, rate?, bounds)))
                .collect();
            let ends = points.iter().map(|&(_, rate, Interval(low, high))| {
                ((rate - low).max(0.0), (high - rate).max(0.0))
            });
            LinePlot::new()
                .with_color(color)
                .with_data(points.iter().map(|&(k, rate, _)| (k, rate)))
                .with_y_err_asymmetric(ends)
                .with_stroke_width(2.5)
                .with_legend(name.clone())
                .into()
        })
        .collect();
    if plots.is_empty() {
        return Vec::new();
    }
    let layout = sized(&plots, "", WHOLE, 360.0)
        .with_x_label("K")
        .with_y_label("K-rate")
        .with_x_tick_step(1.0)
        .with_y_axis_min(0.0)
        .with_x_axis_min(0.8)
        .with_x_axis_max(4.4)
        .with_y_axis_max(1.02);
    vec![chart(plots, layout)]
}

/// Draws the plan in force over control steps, with completions.
pub fn timelines(report: &Report<'_>) -> Vec<Chart> {
    let chosen = super::chosen(report.traces).into_iter();
    chosen.map(|trace| timeline(report, trace)).collect()
}

fn timeline(report: &Report<'_>, trace: &Trace) -> Chart {
    let steps = (0..).zip(&trace.steps);
    let points =
        steps.filter_map(|(number, step)| Some((f64::from(number), f64::from(step.plan?))));
    let plots: Vec<Plot> = vec![
        LinePlot::new()
            .with_data(points)
            .with_step()
            .with_color(COLORS[0])
            .with_stroke_width(2.0)
            .into(),
    ];
    let title = super::title(report.contract, trace);
    let steps = trace.steps.len() as f64;
    let mut layout = sized(&plots, &title, HALF, 300.0)
        .with_x_label("control step")
        .with_y_label("plan")
        .with_x_axis_max(steps)
        .with_y_axis_min(0.0)
        .with_y_axis_max(HEADROOM * report.plans as f64);
    let marks = marks(report, trace);
    // Numbers of completions that are close to each other stand at the first of their lines.
    let mut together: Vec<(f64, Vec<&Mark>)> = Vec::new();
    for mark in &marks {
        let at = mark.step as f64;
        match together.last_mut() {
            Some((first, near)) if at - *first < TOGETHER * steps => near.push(mark),
            _ => together.push((at, vec![mark])),
        }
    }
    for (_, near) in together {
        for (place, mark) in near.iter().enumerate() {
            let color = if mark.asked { COLORS[1] } else { UNASKED };
            let dashes = if mark.asked { "6 3" } else { "2 3" };
            let mut line = ReferenceLine::vertical(mark.step as f64)
                .with_color(color)
                .with_dasharray(dashes);
            if place == 0 {
                let numbers: Vec<_> = near.iter().map(|it| it.number.to_string()).collect();
                line = line.with_label(numbers.join(", "));
            }
            layout = layout.with_reference_line(line);
        }
    }
    Chart {
        marks,
        ..chart(plots, layout)
    }
}

/// Lists the completions of an episode in their order, and whether the instruction asks for them.
fn marks(report: &Report<'_>, trace: &Trace) -> Vec<Mark> {
    let known = crate::results::asked(report.contract, trace.instruction as usize);
    let asked = |name: &str| {
        // A sentence outside the table asks for what `--sub-tasks` says, which is not in the contract.
        known
            .as_ref()
            .is_none_or(|known| known.sub_tasks.contains(&name))
    };
    let mut completions: Vec<_> = trace.outcome.completions.iter().collect();
    completions.sort_by_key(|done| done.step);
    let mark = |(number, done): (usize, &crate::environment::Completion)| {
        let name = report.sub_tasks.get(done.sub_task).copied().unwrap_or("?");
        Mark {
            number,
            name: name.to_owned(),
            step: done.step,
            asked: asked(name),
        }
    };
    (1..).zip(completions).map(mark).collect()
}

/// Mean softmax of the first decision's scores, by instruction.
fn starts(report: &Report<'_>) -> BTreeMap<u32, Vec<f64>> {
    let mut starts: BTreeMap<u32, (Vec<f64>, f64)> = BTreeMap::new();
    for trace in report.traces {
        let Some(first) = trace.steps.first().filter(|step| !step.scores.is_empty()) else {
            continue;
        };
        let most = first.scores.iter().copied().fold(f32::MIN, f32::max);
        let weights: Vec<f64> = first
            .scores
            .iter()
            .map(|&score| f64::from(score - most).exp())
            .collect();
        let total: f64 = weights.iter().sum();
        let (sums, count) = starts.entry(trace.instruction).or_default();
        sums.resize(weights.len(), 0.0);
        for (sum, weight) in sums.iter_mut().zip(weights) {
            *sum += weight / total;
        }
        *count += 1.0;
    }
    let mean = |(sums, count): (Vec<f64>, f64)| sums.iter().map(|sum| sum / count).collect();
    starts
        .into_iter()
        .map(|(i, sums)| (i, mean(sums)))
        .collect()
}

/// Draws the first decision's distribution over plans: Figure 4 of the paper, and a heat map of all instructions.
pub fn start_distributions(report: &Report<'_>) -> Vec<Chart> {
    let starts = starts(report);
    let id = |i: u32| {
        let known = report.contract.instructions.get(i as usize);
        known.map_or("?", |known| known.id.as_str()).to_owned()
    };
    let rows = starts
        .iter()
        .map(|(&i, row)| (id(i), row.clone()))
        .collect();
    let mut charts = heat_map("first decision: mean probability", rows, report.plans);
    let words = |i: u32| report.contract.evaluated(i as usize).0;
    for (&composite, line) in &starts {
        let whole = words(composite);
        let atoms: Vec<u32> = starts
            .keys()
            .copied()
            .filter(|&atom| words(atom).len() == 1 && whole.len() > 1)
            .filter(|&atom| words(atom).iter().all(|part| whole.contains(part)))
            .collect();
        if let [a, b, ..] = atoms[..] {
            charts.push(parts(
                &id(composite),
                line,
                [(&id(a), &starts[&a]), (&id(b), &starts[&b])],
            ));
        }
        if charts.len() > 4 {
            break;
        }
    }
    charts
}

fn parts(composite: &str, line: &[f64], atoms: [(&String, &Vec<f64>); 2]) -> Chart {
    let [(a, of_a), (b, of_b)] = atoms;
    let mut bars = BarPlot::new().with_legend(vec![a.as_str(), b.as_str()]);
    for (plan, (&a, &b)) in of_a.iter().zip(of_b).enumerate() {
        bars = bars.with_group(plan.to_string(), vec![(a, COLORS[4]), (b, COLORS[5])]);
    }
    let points = (1..).zip(line).map(|(place, &p)| (f64::from(place), p));
    let line = LinePlot::new()
        .with_data(points)
        .with_color(COLORS[0])
        .with_legend(composite.to_owned());
    let plots = vec![bars.into(), line.into()];
    let layout = sized(&plots, composite, HALF, 300.0)
        .with_x_label("plan")
        .with_y_label("probability");
    chart(plots, layout)
}

/// Draws rows of shares over the plans as a heat map; plans that no row has are left out.
fn heat_map(title: &str, rows: Vec<(String, Vec<f64>)>, plans: usize) -> Vec<Chart> {
    let share = |row: &[f64], plan: usize| row.get(plan).copied().unwrap_or(0.0);
    let used = |&plan: &usize| rows.iter().any(|(_, row)| share(row, plan) >= 0.005);
    let used: Vec<usize> = (0..plans).filter(used).collect();
    if rows.is_empty() || used.is_empty() {
        return Vec::new();
    }
    let data: Vec<Vec<f64>> = rows
        .iter()
        .map(|(_, row)| used.iter().map(|&plan| share(row, plan)).collect())
        .collect();
    let (width, height) = (
        200.0 + 20.0 * used.len() as f64,
        130.0 + 20.0 * rows.len() as f64,
    );
    let names: Vec<String> = rows.into_iter().map(|(name, _)| name).collect();
    let plan = |plan: &usize| format!("plan {plan}");
    let plots: Vec<Plot> = vec![
        Heatmap::new()
            .with_data(data)
            .with_labels(names.clone(), used.iter().map(plan).collect())
            .with_color_map(ColorMap::Viridis)
            .with_tooltips()
            .into(),
    ];
    let layout = sized(&plots, title, width.max(420.0), height.max(260.0))
        .with_x_label("plan")
        .with_x_categories(used.iter().map(ToString::to_string).collect())
        .with_y_categories(names);
    vec![chart(plots, layout)]
}

/// Draws the gripper's path while a plan is in force: Figures 5 and 10 of the paper.
pub fn gripper(report: &Report<'_>) -> Vec<Chart> {
    let Some(period) = report.contract.period() else {
        return Vec::new();
    };
    let mut ways: BTreeMap<u32, Vec<[f64; 3]>> = BTreeMap::new();
    let mut uses: BTreeMap<u32, usize> = BTreeMap::new();
    for segment in report
        .traces
        .iter()
        .flat_map(|trace| trace.steps.chunks(period))
    {
        let Some((Some(plan), Some(from))) = segment.first().map(|step| (step.plan, step.gripper))
        else {
            continue;
        };
        *uses.entry(plan).or_default() += 1;
        let way = segment.iter().filter_map(|step| step.gripper);
        let way = way.map(|at| [at[0] - from[0], at[1] - from[1], at[2] - from[2]]);
        ways.entry(plan).or_default().extend(way);
    }
    let mut most: Vec<u32> = ways.keys().copied().collect();
    most.sort_by_key(|plan| std::cmp::Reverse(uses.get(plan).copied().unwrap_or(0)));
    let plots: Vec<Plot> = most
        .into_iter()
        .zip(COLORS)
        .filter_map(|(plan, color)| {
            let way = ways.get(&plan)?.iter().map(|&[x, y, z]| (x, y, z));
            let plot = Scatter3DPlot::new()
                .with_data(way)
                .with_color(color)
                .with_size(2.0)
                .with_x_label("x (m)")
                .with_y_label("y (m)")
                .with_z_label("z (m)")
                .with_grid_lines(3)
                .with_legend(format!("plan {plan}"));
            Some(plot.into())
        })
        .collect();
    if plots.is_empty() {
        return Vec::new();
    }
    let layout =
        sized(&plots, "", WHOLE, 520.0).with_legend_position(LegendPosition::OutsideRightTop);
    vec![chart(plots, layout)]
}

/// Draws the heat maps of Figure 9 of the paper.
pub fn heat_maps(report: &Report<'_>) -> Vec<Chart> {
    let size = report.plans;
    let mut by_word: BTreeMap<String, Vec<f64>> = BTreeMap::new();
    let mut by_task: BTreeMap<String, Vec<f64>> = BTreeMap::new();
    for trace in report.traces {
        let known = report.contract.instructions.get(trace.instruction as usize);
        let words: BTreeSet<String> = known
            .map_or("", |known| known.text.as_str())
            .split(|letter: char| !letter.is_alphanumeric())
            .filter(|word| !word.is_empty())
            .map(str::to_lowercase)
            .collect();
        for step in trace.steps.iter().filter(|step| step.decided) {
            for word in &words {
                count(&mut by_word, word, step.plan, size);
            }
        }
        for done in &trace.outcome.completions {
            let name = report.sub_tasks.get(done.sub_task).copied();
            let step = done
                .step
                .checked_sub(1)
                .and_then(|step| trace.steps.get(step));
            if let (Some(name), Some(step)) = (name, step) {
                count(&mut by_task, name, step.plan, size);
            }
        }
    }
    let shares = |counts: BTreeMap<String, Vec<f64>>| {
        let share = |mut row: Vec<f64>| {
            let total: f64 = row.iter().sum();
            for count in &mut row {
                *count /= total.max(1.0);
            }
            row
        };
        counts
            .into_iter()
            .map(|(name, row)| (name, share(row)))
            .collect()
    };
    let mut charts = heat_map("plan by word: share of decisions", shares(by_word), size);
    charts.extend(heat_map(
        "plan by completed sub-task: share of completions",
        shares(by_task),
        size,
    ));
    charts
}

fn count(rows: &mut BTreeMap<String, Vec<f64>>, name: &str, plan: Option<u32>, size: usize) {
    let Some(plan) = plan else {
        return;
    };
    let row = rows
        .entry(name.to_owned())
        .or_insert_with(|| vec![0.0; size]);
    if let Some(count) = row.get_mut(plan as usize) {
        *count += 1.0;
    }
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
