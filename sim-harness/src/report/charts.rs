//! The charts, each a list of SVG texts; an empty list where there is nothing to show.

use std::collections::{BTreeMap, BTreeSet};

use kuva::plot::scatter3d::Scatter3DPlot;
use kuva::plot::{BarPlot, ColorMap, Heatmap, Histogram, LegendPosition, LinePlot};
use kuva::render::annotations::ReferenceLine;
use kuva::render::layout::Layout;
use kuva::render::plots::Plot;

use super::Report;
use crate::metrics::Interval;
use crate::results::Results;
use crate::trace::Trace;

/// Colours that stay apart for most eyes (Okabe and Ito), darkest first.
const COLORS: [&str; 6] = [
    "#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9",
];

/// At most so many episodes are drawn as timelines.
const TIMELINES: usize = 6;

/// Bars of the latency histogram.
const BINS: usize = 40;

fn svg(plots: Vec<Plot>, layout: Layout) -> String {
    kuva::render_to_svg(plots, layout)
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

/// Figure 3 of the paper.
pub fn k_rates(results: &Results) -> Vec<String> {
    let splits = results.splits.0.iter();
    let splits = splits.filter(|(_, result)| result.score.episodes > 0);
    let plots: Vec<Plot> = splits
        .zip(COLORS)
        .map(|((name, result), color)| {
            let score = &result.score;
            let points = (1..).zip(score.k_rate);
            let points = points.filter_map(|(k, rate)| Some((f64::from(k), rate?)));
            let bounds = score.k_rate_interval;
            LinePlot::new()
                .with_data(points)
                .with_band(
                    bounds.map(|Interval(low, _)| low),
                    bounds.map(|Interval(_, high)| high),
                )
                .with_color(color)
                .with_stroke_width(2.5)
                .with_legend(name.clone())
                .into()
        })
        .collect();
    if plots.is_empty() {
        return Vec::new();
    }
    let layout = sized(&plots, "", 560.0, 340.0)
        .with_x_label("K")
        .with_y_label("K-rate")
        .with_x_tick_step(1.0)
        .with_y_axis_min(0.0)
        .with_y_axis_max(1.0);
    vec![svg(plots, layout)]
}

/// The plan in force over control steps, with completions.
pub fn timelines(report: &Report<'_>) -> Vec<String> {
    let mut traces: Vec<&Trace> = report
        .traces
        .iter()
        .filter(|t| !t.steps.is_empty())
        .collect();
    traces.sort_by_key(|trace| trace.outcome.success);
    // One per instruction.
    let mut seen = BTreeSet::new();
    traces.retain(|trace| seen.insert(trace.instruction));
    let chosen = traces.into_iter().take(TIMELINES);
    chosen.map(|trace| timeline(report, trace)).collect()
}

fn timeline(report: &Report<'_>, trace: &Trace) -> String {
    let steps = (0..).zip(&trace.steps);
    let points = steps.map(|(number, step)| (f64::from(number), f64::from(step.plan)));
    let plots: Vec<Plot> = vec![
        LinePlot::new()
            .with_data(points)
            .with_step()
            .with_color(COLORS[0])
            .with_stroke_width(2.0)
            .into(),
    ];
    let known = report.contract.instruction(trace.instruction as usize);
    let title = format!(
        "{}, episode {}: {}",
        known.map_or("?", |known| known.id),
        trace.episode,
        if trace.outcome.success {
            "carried out"
        } else {
            "failed"
        }
    );
    let mut layout = sized(&plots, &title, 620.0, 280.0)
        .with_x_label("control step")
        .with_y_label("plan")
        .with_y_axis_min(0.0)
        .with_y_axis_max(report.contract.codebook_len() as f64);
    for done in &trace.outcome.completions {
        let name = report.sub_tasks.get(done.sub_task).copied().unwrap_or("?");
        layout = layout.with_reference_line(
            ReferenceLine::vertical(done.step as f64)
                .with_color(COLORS[1])
                .with_label(name),
        );
    }
    svg(plots, layout)
}

/// Mean softmax of the first decision's logits, by instruction.
fn starts(report: &Report<'_>) -> BTreeMap<u32, Vec<f64>> {
    let mut starts: BTreeMap<u32, (Vec<f64>, f64)> = BTreeMap::new();
    for trace in report.traces {
        let Some(first) = trace.steps.first().filter(|step| !step.logits.is_empty()) else {
            continue;
        };
        let most = first.logits.iter().copied().fold(f32::MIN, f32::max);
        let weights: Vec<f64> = first
            .logits
            .iter()
            .map(|&logit| f64::from(logit - most).exp())
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

/// Figure 4 of the paper, and the same for all instructions as a heat map.
pub fn start_distributions(report: &Report<'_>) -> Vec<String> {
    let starts = starts(report);
    let id = |i: u32| {
        report
            .contract
            .instruction_id(i as usize)
            .unwrap_or("?")
            .to_owned()
    };
    let rows = starts
        .iter()
        .map(|(&i, row)| (id(i), row.clone()))
        .collect();
    let mut svgs = heat_map("first decision", rows, report.contract.codebook_len());
    let words = |i: u32| -> Vec<&str> {
        let known = report.contract.instruction(i as usize);
        known.map_or(Vec::new(), |known| {
            known.sub_tasks.split(',').map(str::trim).collect()
        })
    };
    for (&composite, line) in &starts {
        let whole = words(composite);
        let atoms: Vec<u32> = starts
            .keys()
            .copied()
            .filter(|&atom| words(atom).len() == 1 && whole.len() > 1)
            .filter(|&atom| words(atom).iter().all(|part| whole.contains(part)))
            .collect();
        if let [a, b, ..] = atoms[..] {
            svgs.push(parts(
                &id(composite),
                line,
                [(&id(a), &starts[&a]), (&id(b), &starts[&b])],
            ));
        }
        if svgs.len() > 3 {
            break;
        }
    }
    svgs
}

fn parts(composite: &str, line: &[f64], atoms: [(&String, &Vec<f64>); 2]) -> String {
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
    let layout = sized(&plots, composite, 620.0, 300.0)
        .with_x_label("plan")
        .with_y_label("probability");
    svg(plots, layout)
}

/// Rows of shares over the plans; plans that no row has are left out.
fn heat_map(title: &str, rows: Vec<(String, Vec<f64>)>, plans: usize) -> Vec<String> {
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
    let plots: Vec<Plot> = vec![
        Heatmap::new()
            .with_data(data)
            .with_color_map(ColorMap::Viridis)
            .with_tooltips()
            .into(),
    ];
    let layout = sized(&plots, title, width.max(420.0), height.max(260.0))
        .with_x_label("plan")
        .with_x_categories(used.iter().map(ToString::to_string).collect())
        .with_y_categories(rows.into_iter().map(|(name, _)| name).collect());
    vec![svg(plots, layout)]
}

/// Figures 5 and 10 of the paper: the gripper's way while a plan is in force.
pub fn gripper(report: &Report<'_>) -> Vec<String> {
    let horizon = report.contract.horizon();
    let mut ways: BTreeMap<u32, Vec<[f64; 3]>> = BTreeMap::new();
    let mut uses: BTreeMap<u32, usize> = BTreeMap::new();
    for segment in report
        .traces
        .iter()
        .flat_map(|trace| trace.steps.chunks(horizon))
    {
        let Some((plan, Some(from))) = segment.first().map(|step| (step.plan, step.gripper)) else {
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
                .with_x_label("x")
                .with_y_label("y")
                .with_z_label("z")
                .with_legend(format!("plan {plan}"));
            Some(plot.into())
        })
        .collect();
    if plots.is_empty() {
        return Vec::new();
    }
    let layout =
        sized(&plots, "", 620.0, 480.0).with_legend_position(LegendPosition::OutsideRightTop);
    vec![svg(plots, layout)]
}

/// Figure 9 of the paper.
pub fn heat_maps(report: &Report<'_>) -> Vec<String> {
    let size = report.contract.codebook_len();
    let mut by_word: BTreeMap<String, Vec<f64>> = BTreeMap::new();
    let mut by_task: BTreeMap<String, Vec<f64>> = BTreeMap::new();
    for trace in report.traces {
        let text = report.contract.instruction_text(trace.instruction as usize);
        let words: BTreeSet<String> = text
            .unwrap_or_default()
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
    let mut svgs = heat_map("plan by word", shares(by_word), size);
    svgs.extend(heat_map(
        "plan by completed sub-task",
        shares(by_task),
        size,
    ));
    svgs
}

fn count(rows: &mut BTreeMap<String, Vec<f64>>, name: &str, plan: u32, size: usize) {
    let row = rows
        .entry(name.to_owned())
        .or_insert_with(|| vec![0.0; size]);
    if let Some(count) = row.get_mut(plan as usize) {
        *count += 1.0;
    }
}

/// All control steps by duration.
pub fn latency(report: &Report<'_>) -> Vec<String> {
    let steps = report.traces.iter().flat_map(|trace| &trace.steps);
    let mut all: Vec<f64> = steps
        .clone()
        .map(|s| s.controller_ns as f64 / 1e3)
        .collect();
    all.sort_by(f64::total_cmp);
    let Some(&edge) = all.get(all.len().saturating_sub(1) * 99 / 100) else {
        return Vec::new();
    };
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
    let layout = sized(&plots, "", 620.0, 320.0)
        .with_x_label("µs")
        .with_y_label("control steps");
    vec![svg(plots, layout)]
}
